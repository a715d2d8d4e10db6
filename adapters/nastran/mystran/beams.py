"""Bars, beams and bodies as the CBAR, PBAR and CONM2 cards that MYSTRAN has right.

The energy of a beam is that of the tension of its neutral axis and, apart from it, that of bending,
shear and torsion about its shear centres. So a beam whose axes are two becomes two bars side by
side: one with an area alone, offset to the neutral axis, and one without an area, offset to the
shear centres. MYSTRAN moves the mass of a bar with its offset, but lumps it without its inertia
about the axis, which MSC Nastran gives a CBEAM and not a CBAR; a CONM2 at each grid point adds it.

A tapered beam is cut into uniform pieces with additional grid points.

MYSTRAN 18 reads the offset and the inertia of a CONM2 right in the grid point's output frame alone,
and takes the products of the offset's components with the wrong sign.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import astuple, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import special

from modetune.adapters.nastran.bulk import Bulk
from modetune.adapters.nastran.cross_sections import (
    CrossSection,
    Station,
    check_warping,
    cross_section,
)
from modetune.adapters.nastran.fields import LARGE, NastranCard, format_number
from modetune.adapters.nastran.masses import PointMass, point_mass
from modetune.adapters.nastran.mesh import BeamAxes, beam_axes, output_frames
from modetune.adapters.nastran.mystran.scalars import Card
from modetune.core.modes import Floats

#: Cards that are rewritten; a CBAR only where its OFFT is not MYSTRAN's one.
CARDS = frozenset(("CBAR", "CBEAM", "PBARL", "PBEAM", "PBEAML", "CTUBE", "PTUBE", "CONM2"))
#: Fields of a CONM2: offset and inertia.
BODY = (5, 6, 7, 9, 10, 11, 12, 13, 14)
#: Pieces of a tapered beam for each factor of e between its stations: 0.1 % of a cantilever's
#: frequency, as the error falls with their square.
PIECES, FEWEST, MOST = 8.0, 2, 32
#: What a bar without an area needs of one for its shear factors to have something to scale.
SLIVER = 1e-6
#: Share of their own size below which lengths and moments are rounding.
NOTHING = 1e-9


class BeamCards:
    """Writes the cards of one deck; what elements share is written once."""

    def __init__(self, bulk: Callable[[], Bulk], new_number: Callable[[], str]) -> None:
        """bulk: gives pyNastran's model of the deck as it is run; new_number: one no card has."""
        self._bulk = bulk
        self._new_number = new_number
        self._inertias: dict[int, Floats] = {}
        self._properties: dict[tuple[int, Station, tuple[float, float]], int] = {}

    @cached_property
    def _frames(self) -> dict[int, Floats]:
        return output_frames(self._bulk())

    @cached_property
    def _places(self) -> dict[int, Floats]:
        return {
            number: np.asarray(grid.get_position(), dtype=np.float64)
            for number, grid in self._bulk().nodes.items()
        }

    def cards(self, card: NastranCard) -> list[Card] | None:
        """What MYSTRAN reads in a card's place, None for the card as it is.

        Raises ValueError with what it cannot be given.
        """
        name, number = card.name, int(card.text(1))
        if name in ("PBEAM", "PBEAML"):
            return []  # their elements write them
        if name in ("PBARL", "PTUBE"):
            return [self._section(name, number)]
        if name == "CONM2":
            has_body = any(card.text(field) for field in BODY)
            return [self._body(point_mass(self._bulk().masses[number]))] if has_body else None
        element = self._bulk().elements[number]
        if name == "CTUBE":
            return [_card("CROD", number, element.pid, *element.node_ids)]
        if name == "CBAR" and element.offt == "GGG":
            return None
        where = beam_axes(element, self._places, self._frames)
        if name == "CBAR":
            ends = (element.node_ids[0], element.node_ids[1])
            return [
                self._bar(number, element.pid, ends, where.offsets, where.axes[1], _pins(element))
            ]
        return list(self._beam(element, where))

    def rest(self) -> Iterator[Card]:
        """Yield cards without one in the deck: beams' inertia about their axes."""
        for node, inertia in self._inertias.items():
            place = self._places[node]
            yield self._body(PointMass(int(self._new_number()), node, 0.0, place, inertia))

    def _body(self, body: PointMass) -> Card:
        frame = self._frames.get(body.node, np.eye(3))
        grid = self._bulk().nodes.get(body.node)
        offset = frame @ (body.centre - self._places[body.node])
        inertia = frame @ body.inertia @ frame.T
        products = 2.0 * body.mass * np.outer(offset, offset) - inertia
        moments = [
            inertia[0, 0], products[1, 0], inertia[1, 1],
            products[2, 0], products[2, 1], inertia[2, 2],
        ]  # fmt: skip
        system = grid.Cd() if grid else 0
        return _card("CONM2", body.eid, body.node, system, body.mass, *offset, "", *moments)

    def _section(self, name: str, number: int) -> Card:
        card = self._bulk().properties[number]
        section = cross_section(card)
        if not section.is_constant:
            raise ValueError("MYSTRAN has no tapered tubes")
        station = section.at(0.5)
        if name == "PTUBE":
            values = (station.area, station.torsion, "", station.nonstructural_mass)
            return _card("PROD", number, card.Mid(), *values)
        return _pbar(number, card.Mid(), station, (section.shear_1, section.shear_2))

    def _beam(self, element: Any, where: BeamAxes) -> Iterator[Card]:
        check_warping(element)
        section = cross_section(element.pid_ref)
        pins = _pins(element)
        if any(pins) and any(np.any(station.neutral) for station in section.stations):
            raise ValueError("MYSTRAN has no pin flags for a neutral axis off the shear centre")
        cuts, first = _cuts(section), element.node_ids[0]
        for piece, stretch in enumerate(pairwise(cuts)):
            is_last = piece == len(cuts) - 2
            second = element.node_ids[1] if is_last else int(self._new_number())
            offsets = np.zeros((2, 3))
            if piece == 0:
                offsets[0] = where.offsets[0]
            if is_last:
                offsets[1] = where.offsets[1]
            else:
                self._places[second] = where.ends[0] + stretch[1] * (where.ends[1] - where.ends[0])
                yield _card("GRID", second, "", *self._places[second])
            own = (pins[0] if piece == 0 else "", pins[1] if is_last else "")
            number = int(self._new_number()) if piece else element.eid
            yield from self._piece(element, where, stretch, (first, second), offsets, own, number)
            first = second

    def _piece(
        self,
        element: Any,
        where: BeamAxes,
        stretch: tuple[float, float],
        ends: tuple[int, int],
        offsets: Floats,
        pins: tuple[str, str],
        number: int,
    ) -> Iterator[Card]:
        """A uniform piece between two grid points, and what it adds to their inertia."""
        section = cross_section(element.pid_ref)
        station = _mean(section, stretch)
        mass, centre, second = (
            0.5 * (a + b) for a, b in zip(*(section.mass(x) for x in stretch), strict=True)
        )
        length = (stretch[1] - stretch[0]) * where.length
        across = where.axes[1:]
        self._turn(ends, 0.5 * length * float(np.trace(second)), where.axes[0])
        for part, shear, beside, towards in _parts(section, station, stretch, mass, centre):
            key = (element.pid_ref.Mid(), part, shear)
            if key not in self._properties:
                self._properties[key] = int(self._new_number())
                yield _pbar(self._properties[key], element.pid_ref.Mid(), part, shear)
            moved = offsets + beside @ across
            yield self._bar(number, self._properties[key], ends, moved, towards @ across, pins)
            number = int(self._new_number())

    def _turn(self, ends: tuple[int, int], polar: float, axis: Floats) -> None:
        """Add a moment of inertia about the axis to both ends."""
        if polar:
            for node in ends:
                inertia = polar * np.outer(axis, axis)
                self._inertias[node] = self._inertias.get(node, np.zeros((3, 3))) + inertia

    def _bar(
        self,
        number: int,
        pid: int,
        ends: tuple[int, int],
        offsets: Floats,
        y: Floats,
        pins: tuple[str, str],
    ) -> Card:
        """y, offsets: in basic coordinates; the card has them in the output frames."""
        frames = [self._frames.get(node, np.eye(3)) for node in ends]
        towards = frames[0] @ y
        moved = [
            value if abs(value) > NOTHING else 0.0
            for frame, offset in zip(frames, offsets, strict=True)
            for value in frame @ offset
        ]
        return _card("CBAR", number, pid, *ends, *towards, "", *pins, *moved)


def _parts(
    section: CrossSection,
    station: Station,
    stretch: tuple[float, float],
    mass: float,
    centre: Floats,
) -> Iterator[tuple[Station, tuple[float, float], Floats, Floats]]:
    """Bars side by side for a uniform piece: section, shear factors, place at both ends, y axis.

    Places (2, 2) and axis (2,) as y and z of the beam.
    """
    neutral = np.array([section.at(x).neutral for x in stretch])
    own = section.density * station.area
    other = mass - own
    place = (mass * centre - own * station.neutral) / other if other else station.neutral
    size = math.sqrt((station.inertia_1 + station.inertia_2) / station.area)
    together = bool(np.abs(place - station.neutral).max() <= NOTHING * size)
    bent, shear, towards = _principal(section, station)
    upright = np.array([1.0, 0.0])
    if not np.abs(neutral).max() > NOTHING * size:
        extra = other if together else 0.0
        yield replace(bent, nonstructural_mass=extra), shear, neutral, towards
    else:
        extra = other if together else 0.0
        yield Station(station.area, nonstructural_mass=extra), (0.0, 0.0), neutral, upright
        thin = replace(bent, area=SLIVER * station.area)
        yield thin, (shear[0] / SLIVER, shear[1] / SLIVER), np.zeros((2, 2)), towards
    if not together:
        sliver = Station(SLIVER * station.area, nonstructural_mass=other)
        yield sliver, (0.0, 0.0), np.array([place, place]), upright


def _principal(
    section: CrossSection, station: Station
) -> tuple[Station, tuple[float, float], Floats]:
    """Return a section in its principal axes, because MYSTRAN has no shear strain with an I12.

    Returns it, its shear factors and its y axis (2,); the factors' own product is left out.
    """
    shear = np.array([section.shear_1, section.shear_2])
    plain = replace(station, inertia_12=0.0, neutral_y=0.0, neutral_z=0.0, nonstructural_mass=0.0,
                    mass_y=0.0, mass_z=0.0, turning=0.0)  # fmt: skip
    if abs(station.inertia_12) <= NOTHING * max(station.inertia_1, station.inertia_2):
        return plain, (float(shear[0]), float(shear[1])), np.array([1.0, 0.0])
    moments, vectors = np.linalg.eigh(station.moments)
    y = vectors[:, 1] if vectors[0, 1] >= 0.0 else -vectors[:, 1]
    squares = y**2
    if shear.all():
        flexible = [squares @ (1.0 / shear), squares[::-1] @ (1.0 / shear)]
        shear = 1.0 / np.array(flexible)
    turned = replace(plain, inertia_1=float(moments[1]), inertia_2=float(moments[0]))
    return turned, (float(shear[0]), float(shear[1])), y


def _cuts(section: CrossSection) -> list[float]:
    """Where a beam is cut into uniform pieces, 0 and 1 included."""
    if section.is_constant:
        return [0.0, 1.0]
    cuts = [0.0]
    for start, stop in section.stretches:
        ends = [astuple(section.at(x))[:5] for x in (start, stop)]
        ratios = [max(pair) / min(pair) for pair in zip(*ends, strict=True) if min(pair) > 0.0]
        count = math.ceil(PIECES * math.log(max(ratios)))
        cuts += np.linspace(start, stop, min(max(count, FEWEST), MOST) + 1)[1:].tolist()
    return cuts


def _mean(section: CrossSection, stretch: tuple[float, float]) -> Station:
    """The uniform section that stretches, twists and bends as much over a stretch as the beam."""
    if section.is_uniform:
        return section.stations[0]
    gauss, weights = special.roots_legendre(8)
    places = 0.5 * (stretch[0] + stretch[1]) + 0.5 * (stretch[1] - stretch[0]) * gauss
    rows = np.array([astuple(section.at(float(x))) for x in places])
    plain = 0.5 * weights @ rows
    flexible = np.array([np.linalg.inv(section.at(float(x)).moments) for x in places])
    bent = np.linalg.inv(np.tensordot(0.5 * weights, flexible, 1))
    area, torsion = (
        1.0 / float(0.5 * weights @ (1.0 / rows[:, column])) if rows[:, column].all() else 0.0
        for column in (0, 4)
    )
    return Station(area, bent[0, 0], bent[1, 1], bent[0, 1], torsion, *map(float, plain[5:]))


def _pins(element: Any) -> tuple[str, str]:
    return str(element.pa or ""), str(element.pb or "")


def _pbar(pid: int, mid: int, station: Station, shear: tuple[float, float]) -> Card:
    numbers = (station.area, station.inertia_1, station.inertia_2, station.torsion)
    return _card("PBAR", pid, mid, *numbers, station.nonstructural_mass, *[""] * 9,
                 *shear, station.inertia_12)  # fmt: skip


def _card(name: str, *values: object) -> Card:
    texts = [format_number(float(v), LARGE) if isinstance(v, float) else str(v) for v in values]
    return name, texts
