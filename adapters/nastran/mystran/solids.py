"""Solids as MYSTRAN has them right.

MYSTRAN's PSOLID has no default for the integration. A blank IN becomes what CTETRA of ten nodes
require, 3 points a direction for hexahedra and pentahedra with midside nodes, as Nastran's default
is (with 2 a bar of 20-node bricks has modes without strain energy), and 2 for others. MYSTRAN's
masses of solids are consistent whatever the deck asks for: where that is lumped ones, they become
CONM2 at the grid points, and the solids get a copy of their material without density.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cached_property

from modetune.adapters.nastran.bulk import Bulk, filled
from modetune.adapters.nastran.deck import NastranDeck
from modetune.adapters.nastran.fields import LARGE, NastranCard, format_number
from modetune.adapters.nastran.masses import (
    lumped_properties,
    lumped_solids,
    lumps,
    solid_densities,
)
from modetune.adapters.nastran.mystran.scalars import Card

#: Names of cards that are written otherwise.
CARDS = ("PSOLID",)
#: Field of a PSOLID that says how many points a solid is integrated with.
INTEGRATION = 4
#: Its field for full integration of shear.
ISOP = 6
#: The field after the last corner of each solid, where midside nodes begin.
MIDSIDES = {"CTETRA": 7, "CPENTA": 9, "CHEXA": 11}
#: Field of a MAT1 of its density.
DENSITY = 5


class SolidCards:
    """Writes the properties of one deck's solids, and their masses."""

    def __init__(
        self,
        deck: NastranDeck,
        bulk: Callable[[], Bulk],
        new_number: Callable[[], str],
        lumped: bool,
    ) -> None:
        """bulk: gives pyNastran's model of the deck as it is run; new_number: one no card has."""
        self._bulk = bulk
        self._new_number = new_number
        self._lumps = lumped
        self._materials = {card.text(1): card for card in deck.named("MAT1")}
        #: Properties, and whether their solids are CTETRA of ten nodes.
        self._tens: dict[str, set[bool]] = {}
        #: Properties of other solids with midside nodes.
        self._curved = set[str]()
        for card in deck.named(*MIDSIDES):
            curved = bool(card.text(MIDSIDES[card.name]))
            self._tens.setdefault(card.text(2), set()).add(curved and card.name == "CTETRA")
            if curved and card.name != "CTETRA":
                self._curved.add(card.text(2))

    @cached_property
    def _lumped(self) -> frozenset[int]:
        """Properties whose masses are written as CONM2."""
        if not (self._lumps and self._tens):
            return frozenset()
        plain = lumped_properties(self._bulk())
        return plain & solid_densities(self._bulk(), plain).keys()

    def cards(self, card: NastranCard) -> list[Card]:
        """Return a PSOLID as MYSTRAN reads it, with a separate material if its mass is lumped."""
        fields = self._property(filled(card, None), self._tens.get(card.text(1), set()))
        if int(card.text(1)) not in self._lumped:
            return [("PSOLID", fields)]
        massless = filled(self._materials[fields[1]], None)
        massless[0], massless[DENSITY - 1] = self._new_number(), ""
        return [("MAT1", massless), ("PSOLID", [fields[0], massless[0], *fields[2:]])]

    def _property(self, fields: list[str], tens: set[bool]) -> list[str]:
        """Its material, frame and integration alone: of CTETRA with ten nodes a blank one."""
        fields += [""] * (ISOP - len(fields))
        given = fields[INTEGRATION - 1]
        known = given in ("3", "THREE") or (given in ("2", "TWO") and True not in tens)
        points = given if known else "3" if fields[0] in self._curved else "2"
        if points == "2" and True in tens:
            points = "3" if False in tens else ""
        full = "FULL" if fields[ISOP - 1] in ("1", "FULL") and True not in tens else ""
        return [*fields[: INTEGRATION - 1], points, *(["", full] if full else [])]

    def rest(self) -> Iterator[Card]:
        """The masses at the grid points."""
        if self._lumped:
            densities = solid_densities(self._bulk(), self._lumped)
            for lump in lumps(lumped_solids(self._bulk(), self._lumped)):
                mass = format_number(lump.mass(densities), LARGE)
                yield "CONM2", [self._new_number(), str(lump.node), "", mass]
