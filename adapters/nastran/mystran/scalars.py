"""Scalar springs, masses and points in terms of cards that MYSTRAN has right.

MYSTRAN 18 loses masses in models with scalar and grid points, takes one CMASS of a grid
point alone and none of its rotations, and no spring to ground. So a scalar point becomes a grid
point whose component 1 alone is free; ground is a grid point that is held; and a scalar mass is a
CONM2 at an additional grid point that shares one component with the user's. Its Lanczos solver
finds fewer modes than a small model has, so such a model gets springs with masses, tied to nothing,
far above its modes, whose modes are removed from the results.
"""

from __future__ import annotations

from collections.abc import Iterator

from modetune.adapters.cross_checks import SPARE_EIGENVALUE
from modetune.adapters.nastran.bulk import scalar_points
from modetune.adapters.nastran.deck import NastranDeck
from modetune.adapters.nastran.fields import NastranCard, format_number, read_number

#: A card to be written: its name and data fields.
Card = tuple[str, list[str]]

#: Scalar springs and masses: the fields of their value (of a property where it is one) and ends,
#: with their components where the ends may be grid points.
ELEMENTS = {
    "CELAS1": ((3, 4), (5, 6)), "CELAS2": ((3, 4), (5, 6)), "CELAS3": ((3, 0), (4, 0)),
    "CELAS4": ((3, 0), (4, 0)), "CMASS1": ((3, 4), (5, 6)), "CMASS2": ((3, 4), (5, 6)),
    "CMASS3": ((3, 0), (4, 0)), "CMASS4": ((3, 0), (4, 0)),
}  # fmt: skip
#: Their properties, of which a card may hold several: fields of numbers and of values.
PROPERTIES = {"PELAS": ((1, 2), (5, 6)), "PMASS": ((1, 2), (3, 4), (5, 6), (7, 8))}
BY_PROPERTY = {"CELAS1": "PELAS", "CELAS3": "PELAS", "CMASS1": "PMASS", "CMASS3": "PMASS"}
#: Constraints: the first field of a point, and how far the next one is. A component follows.
CONSTRAINTS = {"SPC": (2, 3), "MPC": (2, 3)}
#: Fields of a GRID: of its place (with CP), and its frame.
PLACE, CD = slice(2, 6), 6
ALL = "123456"
#: The solver requires some more unknowns than modes.
MORE_UNKNOWNS = 6
#: Models with more grid points have unknowns enough.
MOST_GRIDS = 1000
#: Mass of a spare unknown: too small for any model's weight.
SPARE_MASS = 1e-12


class Scalars:
    """The scalar parts of a deck, and numbers for additional cards."""

    def __init__(self, deck: NastranDeck) -> None:
        self._grids = {card.text(1): card for card in deck.named("GRID")}
        self.points = frozenset(map(str, scalar_points(deck))) - set(self._grids)
        self._last = max(
            (int(card.text(1)) for card in deck.cards if card.text(1).isdecimal()), default=0
        )
        self._last = max(self._last, *map(int, self.points), 0)
        self._ground = ""
        self._values = {
            (name, card.text(number)): card.text(value)
            for name, pairs in PROPERTIES.items()
            for card in deck.named(name)
            for number, value in pairs
        }

        self._bush_masses = {
            card.text(1): card.text(row + 1)
            for card in deck.named("PBUSH")
            for row in range(2, len(card.fields), 8)
            if card.text(row) == "M"
        }

    def new_number(self) -> str:
        """A number that no card has."""
        self._last += 1
        return str(self._last)

    def spring(self, card: NastranCard) -> list[Card]:
        """A scalar spring between two points, or to a grid point that is held."""
        ends = self._ends(card)
        if not ends:
            return []
        cards = [] if len(ends) == 2 or self._ground else [self._held()]
        fields = [card.text(1), self._value(card)]
        for point, component in (*ends, (self._ground, "1"))[:2]:
            fields += [point, component]
        return [*cards, ("CELAS2", fields)]

    def _held(self) -> Card:
        self._ground = self.new_number()
        return "GRID", [self._ground, "", "0.", "0.", "0.", "", ALL]

    def mass(self, card: NastranCard) -> list[Card]:
        """A scalar mass to ground."""
        ((point, component),) = self._ends(card)
        return self.mass_of(card.text(1), point, component, self._value(card))

    def mass_of(self, number: str, point: str, component: str, value: str) -> list[Card]:
        """A mass of one component of a point, or an inertia of one rotation."""
        if point in self.points:
            return [("CONM2", [number, point, "", value])]
        own = self.new_number()
        grid = self._grids[point]
        place = [grid.text(field) for field in range(8)][PLACE]
        body = ["", value] if component in "123" else ["", "0.", "", "", "", "", value, "", value]
        if component not in "123":
            body += ["", "", value]
        return [
            ("GRID", [own, *place, grid.text(CD), ALL.replace(component, "")]),
            ("RBE2", [self.new_number(), point, component, own]),
            ("CONM2", [number, own, *body]),
        ]

    def bush(self, card: NastranCard, fields: list[str]) -> list[Card]:
        """Return a bush with half its property's mass at each end, or a PBUSH without mass."""
        if card.name == "PBUSH":
            rows = range(1, len(fields), 8)
            kept = [fields[row : row + 8] for row in rows if fields[row] != "M"]
            texts = [fields[0], *(text for row in kept for text in row)]
            while not texts[-1]:
                texts.pop()
            return [("PBUSH", texts)]
        if card.text(4) in ("", "0"):  # to ground: a grid point at the same place that is held
            own, grid = self.new_number(), self._grids[card.text(3)]
            held = [own, *[grid.text(field) for field in range(8)][PLACE], "", ALL]
            ends = [*fields[:3], own, *fields[4:]]
            return [("GRID", held), ("CBUSH", ends)]
        mass = self._bush_masses.get(card.text(2), "")
        half = format_number(0.5 * read_number(mass), 16) if mass else ""
        ends = [card.text(field) for field in (3, 4)] if half else []
        return [("CBUSH", fields), *(("CONM2", [self.new_number(), e, "", half]) for e in ends)]

    def grids(self) -> Iterator[Card]:
        """A grid point for each scalar point."""
        for point in sorted(self.points, key=int):
            yield "GRID", [point, "", "0.", "0.", "0.", "", ALL[1:]]

    def constraint(self, card: NastranCard, fields: list[str]) -> list[Card]:
        """A constraint in which scalar points have component 1."""
        if card.name == "SPC1":
            known = fields[2:3] and fields[2] in self.points and fields[1] in ("", "0")
            return [(card.name, [fields[0], "1", *fields[2:]] if known else fields)]
        first, step = CONSTRAINTS[card.name]
        places = range(first, len(fields) + 1, step)
        if card.name == "MPC":  # a row has two points, and begins and ends with a blank field
            places = range(first, len(fields) + 1)
        for place in places:
            if card.name == "MPC" and place % 8 not in (2, 5):
                continue
            following = fields[place : place + 1] or [""]
            if fields[place - 1] in self.points and following[0] in ("", "0"):
                fields[place : place + 1] = ["1"]
        return [(card.name, fields)]

    def spare(self, n_modes: int) -> Iterator[Card]:
        """Yield spare unknowns for a model that may have too few for `n_modes` modes."""
        if len(self._grids) + len(self.points) > MOST_GRIDS:
            return
        if not self._ground:
            yield self._held()
        for place in range(n_modes + MORE_UNKNOWNS):
            # Each has its own eigenvalue: ARPACK may break off where many are equal.
            stiffness = format_number((1.0 + 0.1 * place) * SPARE_EIGENVALUE * SPARE_MASS, 16)
            point = self.new_number()
            yield "GRID", [point, "", "0.", "0.", "0.", "", ALL[1:]]
            yield "CELAS2", [self.new_number(), stiffness, point, "1", self._ground, "1"]
            yield "CONM2", [self.new_number(), point, "", format_number(SPARE_MASS, 16)]

    def obstacle(self, card: NastranCard) -> str:
        """Why a scalar element or bush cannot be written; empty if it can."""
        if card.name == "CBUSH":
            if card.text(3) not in self._grids:
                return f"CBUSH: grid point {card.text(3)} is not there"
            grounded = card.text(2) in self._bush_masses and card.text(4) in ("", "0")
            return "the mass of a PBUSH on the ground: give it as a CONM2" if grounded else ""
        ends = self._ends(card)
        unknown = [p for p, _ in ends if p not in self.points and p not in self._grids]
        if unknown:
            return f"{card.name}: point {unknown[0]} is not there"
        if card.name.startswith("CMASS") and len(ends) != 1:
            return f"MYSTRAN has no {card.name} between two points"
        try:
            read_number(self._value(card))
        except ValueError:
            kind = BY_PROPERTY.get(card.name, card.name)
            return f"{card.name}: its value is not there ({kind} {card.text(2)})"
        return ""

    def _value(self, card: NastranCard) -> str:
        kind = BY_PROPERTY.get(card.name)
        return self._values.get((kind, card.text(2)), "") if kind else card.text(2)

    def _ends(self, card: NastranCard) -> list[tuple[str, str]]:
        """Points and components of the ends that are not ground."""
        found = []
        for point, component in ELEMENTS[card.name]:
            if card.text(point) not in ("", "0"):
                given = card.text(component) if component else ""
                found.append((card.text(point), "1" if given in ("", "0") else given))
        return found
