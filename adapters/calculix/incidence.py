"""Which nodes belong to which elements of a CalculiX deck, and as what.

ccx expands shells and beams to solids: a node of the deck becomes several on the element's
normal, or a knot (a rigid body) where elements of different normals or thickness meet. What a node
is in its elements decides how many there are.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from typing import Literal

from modetune.adapters.calculix.mesh import CalculixMesh

#: solid and point (springs, masses, dashpots): the node's own three translations. Of shells and
#: beams linear, and quadratic with their corners or ends and their middle nodes.
Role = Literal[
    "solid", "point", "shell", "shell corner", "shell middle", "beam", "beam end", "beam middle",
    "other",
]  # fmt: skip
#: Types of elements with the roles of their nodes; the last one stands for all further nodes.
ROLES: tuple[tuple[re.Pattern[str], tuple[Role, ...]], ...] = (
    (re.compile(r"C3D(4|6|8[IR]?|10T?|15|20R?)"), ("solid",)),
    (re.compile(r"SPRING[12A]|MASS|DASHPOTA"), ("point",)),
    (re.compile(r"S3|S4R?"), ("shell",)),
    (re.compile(r"S6"), (*(("shell corner",) * 3), "shell middle")),
    (re.compile(r"S8R?"), (*(("shell corner",) * 4), "shell middle")),
    (re.compile(r"B31R?"), ("beam",)),
    (re.compile(r"B32R?"), ("beam end", "beam middle", "beam end")),
)
#: Roles whose nodes lie on a shell or a beam.
EXPANDED: frozenset[Role] = frozenset(
    {"shell", "shell corner", "shell middle", "beam", "beam end", "beam middle"}
)


@dataclass(frozen=True, slots=True)
class Incidence:
    """Nodes of each element by its number, in the deck's order, and the elements' types."""

    nodes_of: dict[int, tuple[int, ...]]
    mesh: CalculixMesh

    def nodes(self, elements: Iterable[int]) -> frozenset[int]:
        """All nodes of these elements."""
        return frozenset[int]().union(*map(self.nodes_of.__getitem__, elements))

    def roles(self, nodes: Collection[int]) -> dict[int, set[Role]]:
        """What each of these nodes is in its elements; nothing where it belongs to none."""
        found: dict[int, set[Role]] = {node: set() for node in nodes}
        by_kind: dict[str, tuple[Role, ...]] = {}
        for number, corners in self.nodes_of.items():
            kind = self.mesh.elements[number].kind
            if kind not in by_kind:
                by_kind[kind] = roles_of(kind)
            roles = by_kind[kind]
            for place, node in enumerate(corners):
                if node in found:
                    found[node].add(roles[min(place, len(roles) - 1)])
        return found


def roles_of(kind: str) -> tuple[Role, ...]:
    """Roles of an element type's nodes, `other` for types that are not followed."""
    return next((roles for pattern, roles in ROLES if pattern.fullmatch(kind)), ("other",))
