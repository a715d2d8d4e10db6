"""Cross-sections of Nastran bars, beams and rods, station by station.

y and z are the element's axes, plane 1 is x-y, and the origin is the shear centre. Between stations
all numbers change in proportion to the distance, as Nastran has it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import astuple, dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np

from modetune.adapters.nastran.section_shapes import SectionShape, shape_of
from modetune.core.modes import Floats

#: Numbers along a beam this alike differ by rounded digits.
SAME = 1e-3


@dataclass(frozen=True, slots=True)
class Station:
    """A cross-section at one place. All of the deck's units, without WTMASS.

    inertia_1: of y^2; inertia_12: of y z. neutral_y, neutral_z: of the centroid; mass_y, mass_z: of
    the non-structural mass, whose moment of inertia about x is turning (both per length).
    """

    area: float
    inertia_1: float = 0.0
    inertia_2: float = 0.0
    inertia_12: float = 0.0
    torsion: float = 0.0
    neutral_y: float = 0.0
    neutral_z: float = 0.0
    nonstructural_mass: float = 0.0
    mass_y: float = 0.0
    mass_z: float = 0.0
    turning: float = 0.0

    @property
    def neutral(self) -> Floats:
        """(2,)"""
        return np.array([self.neutral_y, self.neutral_z])

    @property
    def moments(self) -> Floats:
        """(2, 2), of area: the integral of (y, z) by (y, z) about the centroid."""
        cross = self.inertia_12
        return np.array([[self.inertia_1, cross], [cross, self.inertia_2]])


@dataclass(frozen=True)
class CrossSection:
    """places: of the stations, 0 to 1 of the length; shear_1, shear_2: factors on the area in
    planes 1 and 2, 0 for no shear strain.
    """

    places: tuple[float, ...]
    stations: tuple[Station, ...]
    shear_1: float
    shear_2: float
    youngs_modulus: float
    shear_modulus: float
    density: float

    def at(self, place: float) -> Station:
        """The cross-section at 0..1 of the length."""
        if self.is_uniform:
            return self.stations[0]
        rows = np.array([astuple(station) for station in self.stations])
        return Station(*(float(np.interp(place, self.places, row)) for row in rows.T))

    @cached_property
    def is_uniform(self) -> bool:
        return all(
            station is self.stations[0] or station == self.stations[0]
            for station in self.stations[1:]
        )

    @property
    def stretches(self) -> list[tuple[float, float]]:
        """Between the stations; the whole length where they are all one."""
        return [(0.0, 1.0)] if self.is_uniform else list(pairwise(self.places))

    @property
    def is_constant(self) -> bool:
        """Whether all stations are alike, to rounded digits."""
        rows = np.array([astuple(station) for station in self.stations])
        return bool(np.allclose(rows, rows[0], rtol=SAME, atol=0.0))

    def mass(self, place: float) -> tuple[float, Floats, Floats]:
        """At a place and per length: mass, centre (2,), second moments about it (2, 2)."""
        station = self.at(place)
        own = self.density * station.area
        total = own + station.nonstructural_mass
        second = self.density * station.moments + 0.5 * station.turning * np.eye(2)
        if not total:
            return 0.0, np.zeros(2), second
        other = np.array([station.mass_y, station.mass_z])
        apart = other - station.neutral
        share = station.nonstructural_mass / total
        centre = station.neutral + share * apart
        return total, centre, second + own * share * np.outer(apart, apart)

    @property
    def end_masses(self) -> tuple[float, float]:
        """What each end has of the mass where it is lumped, per length of the beam.

        Each place shares its mass as the lever does: integrals of m (1 - x) and m x.
        """
        whole = first = 0.0
        for start, stop in self.stretches:
            a, b = self.mass(start)[0], self.mass(stop)[0]
            own = 0.5 * (stop - start) * (a + b)
            whole += own
            first += start * own + (stop - start) ** 2 * (a + 2.0 * b) / 6.0
        return whole - first, first


def cross_section(card: Any) -> CrossSection:
    """The cross-section of a property card, or of a CONROD. Raises ValueError with the reason."""
    readers: dict[str, Callable[[Any], CrossSection]] = {
        "PBAR": _pbar,
        "PBARL": _pbarl,
        "PBEAM": _pbeam,
        "PBEAML": _pbeaml,
        "PROD": _prod,
        "CONROD": _prod,
        "PTUBE": _ptube,
    }
    if card.type not in readers:
        raise ValueError(f"{card.type} is not translated")
    return readers[card.type](card)


def check_warping(element: Any) -> None:
    """Raise ValueError where warping is tied to other elements: it has stiffness there alone."""
    card = element.pid_ref
    resists = card.type == "PBEAML" or any(getattr(card, name, 0.0) for name in ("cwa", "cwb"))
    if resists and any(getattr(element, name, 0) for name in ("sa", "sb")):
        raise ValueError("warping points (SA, SB)")


def _made(
    card: Any,
    stations: Sequence[Station],
    shear: tuple[float, float] = (0.0, 0.0),
    places: Sequence[float] = (0.0,),
) -> CrossSection:
    material = card.mid_ref
    if material is None or material.type != "MAT1":
        raise ValueError("its material is not a MAT1")
    if not material.e:
        raise ValueError(f"MAT1 {material.mid} has no E")
    if places[-1] != 1.0:  # one at end A alone, or none at end B
        places, stations = (*places, 1.0), (*stations, stations[0])
    return CrossSection(
        tuple(float(place) for place in places),
        tuple(stations),
        float(shear[0]),
        float(shear[1]),
        float(material.e),
        float(material.g or 0.0),
        float(material.rho or 0.0),
    )


def _pbar(card: Any) -> CrossSection:
    area, i1, i2, i12, torsion = _numbers((card.A, card.i1, card.i2, card.i12, card.j))
    extra = float(card.nsm or 0.0)
    station = Station(area, i1, i2, i12, torsion, nonstructural_mass=extra)
    return _made(card, [station], (card.k1 or 0.0, card.k2 or 0.0))


def _pbarl(card: Any) -> CrossSection:
    """A bar's axis is its centroid's and its shear centre's, whatever the shape."""
    shape = _shape(card, card.dim)
    station = replace(_station(shape, card.nsm), neutral_y=0.0, neutral_z=0.0)
    return _made(card, [station], (shape.shear_1, shape.shear_2))


def _pbeam(card: Any) -> CrossSection:
    """The ends' neutral axis and non-structural mass lie on straight lines between them."""
    ends = np.array([
        [card.n1a, card.n2a, card.m1a, card.m2a, card.nsia],
        [card.n1b, card.n2b, card.m1b, card.m2b, card.nsib],
    ], dtype=np.float64)  # fmt: skip
    columns = (card.A, card.i1, card.i2, card.i12, card.j, card.nsm)
    stations = []
    for place, *values in zip(card.xxb, *columns, strict=True):
        area, i1, i2, i12, torsion, extra = _numbers(values)
        n1, n2, m1, m2, turning = _numbers((1.0 - place) * ends[0] + place * ends[1])
        stations.append(Station(area, i1, i2, i12, torsion, n1, n2, extra, m1, m2, turning))
    return _made(card, stations, (card.k1 or 0.0, card.k2 or 0.0), card.xxb)


def _pbeaml(card: Any) -> CrossSection:
    """The non-structural mass is the shear centre's, as by default in a PBEAM."""
    shapes = [_shape(card, dimensions) for dimensions in card.dim]
    stations = [_station(shape, extra) for shape, extra in zip(shapes, card.nsm, strict=True)]
    return _made(card, stations, (shapes[0].shear_1, shapes[0].shear_2), card.xxb)


def _shape(card: Any, dimensions: Sequence[float]) -> SectionShape:
    return shape_of(card.beam_type, tuple(float(value) for value in dimensions))


def _station(shape: SectionShape, extra: float | None) -> Station:
    return Station(
        shape.area,
        shape.inertia_1,
        shape.inertia_2,
        shape.inertia_12,
        shape.torsion,
        shape.neutral_y,
        shape.neutral_z,
        float(extra or 0.0),
    )


def _numbers(values: Iterable[float | None]) -> list[float]:
    return [float(value or 0.0) for value in values]


def _prod(card: Any) -> CrossSection:
    extra = float(card.nsm or 0.0)
    station = Station(float(card.A), torsion=float(card.j or 0.0), nonstructural_mass=extra)
    return _made(card, [station])


def _ptube(card: Any) -> CrossSection:
    stations = []
    for diameter in (card.OD1, card.OD2 or card.OD1):
        inner = diameter / 2.0 - card.t if card.t else 0.0
        tube = shape_of("TUBE", (diameter / 2.0, inner))
        extra = float(card.nsm or 0.0)
        stations.append(Station(tube.area, torsion=tube.torsion, nonstructural_mass=extra))
    return _made(card, stations, places=(0.0, 1.0))
