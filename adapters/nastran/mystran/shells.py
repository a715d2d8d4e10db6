"""Laminates and shear panels as MYSTRAN has them right.

MYSTRAN takes a laminate with a soft core for much too soft (a honeycomb panel at two fifths of its
frequency) and plies of several densities for another mass. Where its plies are balanced about the
mid-surface, such a PCOMP is written as the PSHELL of the same stiffness: MAT2 for membrane and
bending, MAT8 for shear, its mass as non-structural mass.

Its CSHEAR is Nastran's where the panel is a rectangle, without mass and F1, F2: masses become CONM2
and the edges CONROD.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from modetune.adapters.nastran.bulk import Bulk
from modetune.adapters.nastran.fields import NastranCard, format_number
from modetune.adapters.nastran.mystran.scalars import Card
from modetune.adapters.nastran.shell_laws import ShellLaw, law_of
from modetune.core.modes import Floats

#: Transverse shear stiffness as a share of that in the plane, below which MYSTRAN's is too soft.
SOFT = 0.1
#: Cosine of a corner's angle of a panel that still counts as a rectangle: 0.1 % of stiffness.
RECTANGLE = 0.02
#: Above it F1 and F2 are areas of rods in squares of the thickness.
FULLY_EFFECTIVE = 1.01
#: Names of cards that may be written otherwise.
CARDS = ("PCOMP", "CSHEAR", "PSHEAR")


class ShellCards:
    """Writes the cards of one deck in place of those that MYSTRAN has wrong."""

    def __init__(self, bulk: Callable[[], Bulk], new_number: Callable[[], str]) -> None:
        """bulk: gives pyNastran's model of the deck as it is run; new_number: one no card has."""
        self._bulk = bulk
        self._new_number = new_number

    def cards(self, card: NastranCard) -> list[Card] | None:
        """What MYSTRAN reads in a card's place, None for the card as it is.

        Raises ValueError with a reason where it can read nothing that is right.
        """
        if card.name == "CSHEAR":
            return self._panel(self._bulk().elements[int(card.text(1))])
        if card.name == "PSHEAR":
            return [(card.name, [card.text(field) for field in (1, 2, 3)])]
        law = self._unlike(self._bulk().properties[int(card.text(1))])
        return self._plate(card.text(1), law) if law else None

    def _unlike(self, card: Any) -> ShellLaw | None:
        """The law of a laminate that MYSTRAN has wrong, None of others."""
        law = law_of(card)
        soft = np.linalg.eigvalsh(law.shear)[0] < SOFT * law.membrane[2, 2]
        if not soft and len({material.rho for material in card.mids_ref}) == 1:
            return None
        if law.coupling.any() or law.offset:
            raise ValueError(
                "plies of several densities or a soft core require a laminate that is balanced "
                "about the mid-surface"
            )
        return law

    def _plate(self, number: str, law: ShellLaw) -> list[Card]:
        t = law.thickness
        membrane, bending, shear = (self._new_number() for _ in range(3))
        return [
            _mat2(membrane, law.membrane / t),
            _mat2(bending, law.bending * 12.0 / t**3),
            ("MAT8", [shear, *map(_number, (
                law.membrane[0, 0] / t, law.membrane[1, 1] / t, 0.0, law.membrane[2, 2] / t,
                law.shear[0, 0] / t, law.shear[1, 1] / t,
            ))]),
            ("PSHELL", [
                number, membrane, _number(t), bending, "1.", shear, "1.",
                _number(law.mass),
            ]),
        ]  # fmt: skip

    def _panel(self, element: Any) -> list[Card]:
        """A rectangle with masses at the corners and rods on the edges."""
        card = element.pid_ref
        places = np.array([node.get_position() for node in element.nodes_ref])
        sides = np.roll(places, -1, axis=0) - places
        lengths = np.linalg.norm(sides, axis=1)
        sides /= lengths[:, None]
        if np.abs(np.sum(sides * np.roll(sides, -1, axis=0), axis=1)).max() > RECTANGLE:
            raise ValueError("its stiffness is right of rectangles alone")
        area = float(lengths[0] * lengths[1])
        mass = (card.mid_ref.rho * card.t + (card.nsm or 0.0)) * area / 4.0
        nodes = [str(node) for node in element.node_ids]
        found: list[Card] = [("CSHEAR", [str(element.eid), str(element.pid), *nodes])]
        if mass:
            found += [("CONM2", [self._new_number(), node, "", _number(mass)]) for node in nodes]
        if card.f1 or card.f2:
            massless = self._new_number()
            moduli = [_number(card.mid_ref.e), _number(card.mid_ref.g)]
            found.append(("MAT1", [massless, *moduli]))
        for place in range(4):
            factor = (card.f1, card.f2)[place % 2] or 0.0
            if factor:
                width = card.t if factor > FULLY_EFFECTIVE else area / float(lengths[place])
                ends = [nodes[place], nodes[(place + 1) % 4]]
                section = _number(0.5 * factor * card.t * width)
                rod = [self._new_number(), *ends, massless, section]
                found.append(("CONROD", rod))
        return found


def _mat2(number: str, law: Floats) -> Card:
    places = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    return "MAT2", [number, *(_number(float(law[place])) for place in places)]


def _number(value: float) -> str:
    return format_number(float(value), 16)
