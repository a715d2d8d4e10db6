"""What of a deck may be uncertain, by how much, and why: candidates for updating parameters.

A quantity is free in what is written where few structures are known to better than a test tells it
(stiffness of materials and joints); what is weighed or measured more easily than updated stands
behind a `#` for a person to decide.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace

from modetune.adapters.solver import Solver, Target
from modetune.core.errors import ModelError
from modetune.core.parameters import Parameter, Quantity, TargetKind

#: Materials that are free at most; the others, which weigh less, are comments.
FREE = 20
#: Dimensions of a cross-section that are looked for.
DIMENSIONS = 12


@dataclass(frozen=True, slots=True)
class Expected:
    """How uncertain a quantity commonly is.

    letter: its names begin with it; by: what names it; free: whether it is updated unless somebody
    takes it out. bounds and deviation are relative to the deck's value.
    """

    quantity: Quantity
    letter: str
    by: tuple[TargetKind, ...]
    bounds: tuple[float, float]
    deviation: float
    free: bool
    why: str


#: In the order in which they are written.
EXPECTED = (
    Expected(
        "youngs_modulus", "E", ("material",), (0.7, 1.3), 0.1, True,
        "a modulus itself is known to 2-5 % (laminates 10-15 %), but it also takes up what the "
        "mesh, joints and fillets leave out",
    ),
    Expected(
        "shear_modulus", "G", ("material",), (0.7, 1.3), 0.1, True,
        "this material gives G and not E; otherwise as a Young's modulus",
    ),
    Expected(
        "spring_stiffness", "k", ("elset", "property", "element"), (0.1, 10.0), 0.5, True,
        "stiffness of joints and mounts is mostly an estimate, often wrong by a factor",
    ),
    Expected(
        "matrix_factor", "p", ("part",), (0.5, 2.0), 0.2, True,
        "a part of the matrices is scaled as a whole",
    ),
    Expected(
        "density", "rho", ("material",), (0.9, 1.1), 0.03, False,
        "weigh the structure instead where you can: E and density of one material change "
        "frequencies in opposite ways and cannot both be told from them",
    ),
    Expected(
        "thickness", "t", ("elset", "property"), (0.9, 1.1), 0.03, False,
        "sheets are rolled to 2-5 %; bending follows its cube, so measure it, or free it in place "
        "of the modulus",
    ),
    Expected(
        "mass", "m", ("elset", "element"), (0.9, 1.1), 0.05, False,
        "masses can mostly be weighed",
    ),
    Expected(
        "inertia_1", "I1", ("property",), (0.8, 1.25), 0.1, False,
        "of a cross-section that stands for a built-up beam; of a plain bar it is as exact as "
        "its drawing, and acts as the modulus does",
    ),
    Expected("inertia_2", "I2", ("property",), (0.8, 1.25), 0.1, False, "as inertia_1"),
    Expected(
        "torsion_constant", "J", ("property",), (0.7, 1.4), 0.15, False,
        "of open or built-up sections it is an estimate",
    ),
    Expected(
        "area", "A", ("property", "element"), (0.9, 1.1), 0.05, False,
        "it changes stiffness and mass at once",
    ),
    Expected(
        "dimension", "d", ("elset", "property"), (0.9, 1.1), 0.03, False,
        "measured more easily than updated",
    ),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Candidate:
    """A number of the deck that could be a parameter; value: the deck's first one."""

    parameter: Parameter
    expected: Expected
    target: Target
    value: float
    where: str
    free: bool

    @property
    def said(self) -> str:
        """What it is in the deck."""
        count = self.target.n_elements
        of = f", {count} element{'' if count == 1 else 's'}"
        title = f' "{self.target.title}"' if self.target.title else ""
        return f"{self.target.kind}{title}{of}; the deck has {self.value:.6g}"


def candidates(solver: Solver) -> list[Candidate]:
    """Candidates of a model, those of one quantity together; at least one is free if any is there.

    What the deck itself refuses (a blank field, a material that nothing uses) is left out.
    """
    deck, names = solver.deck, set[str]()
    masses = deck.material_masses()
    found: list[Candidate] = []
    for expected in EXPECTED:
        for target in deck.targets():
            if target.by in expected.by:
                found += _of_target(solver, expected, target, names)
    # G follows from E in the same material; free are those of most mass.
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
    """Return a unique name from quantity and target."""
    several = f"{target.kind}s" if len(target.names) > 1 else target.names[0]
    text = f"{expected.letter}{item or ''}_{several}"
    plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", text)[:56].rstrip("_.-")
    name, count = plain, 2
    while name in taken:
        name, count = f"{plain}_{count}", count + 1
    return name
