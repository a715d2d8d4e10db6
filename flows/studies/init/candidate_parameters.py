"""Candidate parameters: the uncertain quantities of a deck, their uncertainty and the reason.

The draft makes a quantity free if a test usually determines it better than prior knowledge
(stiffness of materials and joints). Quantities that are easier to weigh or measure become comments,
which the user can activate.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace

from modetune.adapters.solver import Solver, Target
from modetune.core.errors import ModelError
from modetune.core.parameters import Parameter, Quantity, TargetKind

#: Maximum number of free materials; the others, which have less mass, become comments.
FREE = 20
#: Maximum number of dimensions of a cross-section.
DIMENSIONS = 12


@dataclass(frozen=True, slots=True)
class Expected:
    """How uncertain a quantity commonly is.

    letter: first letter of its names. by: kinds of target. free: whether the draft updates it.
    bounds, deviation: relative to the deck's value.
    """

    quantity: Quantity
    letter: str
    by: tuple[TargetKind, ...]
    bounds: tuple[float, float]
    deviation: float
    free: bool
    why: str


#: In the order of the draft.
EXPECTED = (
    Expected(
        "youngs_modulus", "E", ("material",), (0.7, 1.3), 0.1, True,
        "a modulus is known to 2-5 % (laminates 10-15 %), but it also compensates for mesh, "
        "joints and fillets",
    ),
    Expected(
        "shear_modulus", "G", ("material",), (0.7, 1.3), 0.1, True,
        "this material has G instead of E; otherwise like a Young's modulus",
    ),
    Expected(
        "spring_stiffness", "k", ("elset", "property", "element"), (0.1, 10.0), 0.5, True,
        "the stiffness of joints and mounts is usually an estimate, often wrong by a factor",
    ),
    Expected(
        "matrix_factor", "p", ("part",), (0.5, 2.0), 0.2, True,
        "a part of the matrices is scaled as a whole",
    ),
    Expected(
        "density", "rho", ("material",), (0.9, 1.1), 0.03, False,
        "weigh the structure instead where you can: E and density of one material change "
        "frequencies in opposite directions, and frequencies cannot determine both",
    ),
    Expected(
        "thickness", "t", ("elset", "property"), (0.9, 1.1), 0.03, False,
        "sheets are rolled to 2-5 %; bending follows its cube, so measure it, or free it in place "
        "of the modulus",
    ),
    Expected(
        "mass", "m", ("elset", "element"), (0.9, 1.1), 0.05, False,
        "masses can usually be weighed",
    ),
    Expected(
        "inertia_1", "I1", ("property",), (0.8, 1.25), 0.1, False,
        "uncertain if the section represents a built-up beam; for a plain bar the drawing is "
        "exact, and I1 acts like the modulus",
    ),
    Expected("inertia_2", "I2", ("property",), (0.8, 1.25), 0.1, False, "as inertia_1"),
    Expected(
        "torsion_constant", "J", ("property",), (0.7, 1.4), 0.15, False,
        "an estimate for open or built-up sections",
    ),
    Expected(
        "area", "A", ("property", "element"), (0.9, 1.1), 0.05, False,
        "it changes both stiffness and mass",
    ),
    Expected(
        "dimension", "d", ("elset", "property"), (0.9, 1.1), 0.03, False,
        "easier to measure than to update",
    ),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Candidate:
    """A number of the deck that could be a parameter. value: its first value in the deck."""

    parameter: Parameter
    expected: Expected
    target: Target
    value: float
    where: str
    free: bool

    @property
    def description(self) -> str:
        count = self.target.n_elements
        of = f", {count} element{'' if count == 1 else 's'}"
        title = f' "{self.target.title}"' if self.target.title else ""
        return f"{self.target.kind}{title}{of}; the deck has {self.value:.6g}"


def candidates(solver: Solver) -> list[Candidate]:
    """Return the candidates of a model, sorted by quantity; at least one of them is free.

    Numbers that the deck refuses (a blank field, an unused material) are left out.
    """
    deck, names = solver.deck, set[str]()
    masses = deck.material_masses()
    found: list[Candidate] = []
    for expected in EXPECTED:
        for target in deck.targets():
            if target.by in expected.by:
                found += _of_target(solver, expected, target, names)
    # E determines G of the same material. The materials with most mass are free.
    given = {item.target for item in found if item.expected.quantity == "youngs_modulus"}
    found = [
        item
        for item in found
        if item.expected.quantity != "shear_modulus" or item.target not in given
    ]
    materials = sorted(
        (item for item in found if item.free and item.target.by == "material"),
        key=lambda item: -_weight(item.target, masses),
    )
    others = [item for item in found if item.free and item.target.by != "material"]
    kept = [*materials[:FREE], *others] or found[:1]
    return [replace(item, free=item in kept) for item in found]


def _weight(target: Target, masses: dict[str, float]) -> float:
    return max(
        masses.get(target.names[0], 0.0), masses.get(f"{target.kind} {target.names[0]}", 0.0)
    )


def _of_target(
    solver: Solver, expected: Expected, target: Target, names: set[str]
) -> Iterator[Candidate]:
    items = range(1, DIMENSIONS + 1) if expected.quantity == "dimension" else (0,)
    for item in items:
        parameter = Parameter(
            _name(expected, target, item, names),
            expected.quantity,
            target.by,
            target.names,
            *expected.bounds,
            expected.deviation,
            item=item,
        )
        try:
            number = solver.deck.numbers(parameter)[0]
        except ModelError:
            return
        if not solver.deck.problems((parameter,)):
            names.add(parameter.name)
            where, free = number.where, expected.free
            yield Candidate(parameter, expected, target, number.value, where, free)


def _name(expected: Expected, target: Target, item: int, taken: set[str]) -> str:
    """Return a unique name from quantity and target: by the deck's comment if it has a number."""
    several = f"{target.kind}s" if len(target.names) > 1 else target.names[0]
    called = target.title if several.isdecimal() and target.title else several
    text = f"{expected.letter}{item or ''}_{called}"
    plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", text)[:56].rstrip("_.-")
    name, count = plain, 2
    while name in taken:
        name, count = f"{plain}_{count}", count + 1
    return name
