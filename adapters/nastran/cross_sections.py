"""Cross-sections of Nastran bars, beams and rods: their properties, station by station.

y and z are the element's axes, plane 1 is x-y, and the origin is the shear centre. Between stations
all numbers change in proportion to the distance, as Nastran has it.

Sections given by dimensions (PBARL, PBEAML) have area, moments, torsion constant, shear centre and
shear factors of their shape. y points up and z to the right, as the figures of these cards are
drawn. Round, rectangular and hexagonal sections have closed forms. All others are walls: area and
moments are those of the union of the walls' rectangles, exactly; all else follows from the walls'
midlines (thin-walled theory, Vlasov 1961), open and closed walls alike. With s along the midlines,
t the thickness, rho the distance of a wall's tangent from the pole:

    warping   minimises  sum of t (dw/ds + rho)^2 over the midlines
    torsion   J = sum of t (dw/ds + rho)^2  + sum of l t^3 / 3 over walls without circulating flow
    shear     minimises  sum of t (dp/ds)^2 / 2 - t g p,  g = (I2 y - I12 z) / (I1 I2 - I12^2)

The first gives Bredt's formula in closed walls. The shear centre is the pole to which the warping
has no moment, sum of t w y = sum of t w z = 0. The energy of the shear flow t dp/ds of a unit force
is 1 / k A: its factor k in this plane (in the other one g has y and z exchanged).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import astuple, dataclass, replace
from functools import cached_property, lru_cache
from itertools import pairwise, product
from typing import Any

import numpy as np

from modetune.core.modes import Floats, Integers

#: Pieces of a wall between two joints for the shear flow, quadratic in each: k to 0.1 %.
PIECES = 4
#: Lengths and flows below this share of the section's own are rounding.
NOTHING = 1e-9


@dataclass(frozen=True, slots=True)
class SectionShape:
    """area, second moments (inertia_1 of y^2, inertia_12 of y z), torsion, factors on the area.

    neutral_y, neutral_z: of the centroid, from the shear centre. shear_1, shear_2: 0 for no shear
    strain.
    """

    area: float
    inertia_1: float
    inertia_2: float
    inertia_12: float
    torsion: float
    shear_1: float = 0.0
    shear_2: float = 0.0
    neutral_y: float = 0.0
    neutral_z: float = 0.0


@dataclass(frozen=True, slots=True)
class Wall:
    """A rectangle with its long side along z (lying) or y; across: of its midline."""

    lying: bool
    across: float
    start: float
    stop: float
    thickness: float

    @property
    def spans(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Its extent along y and along z."""
        half = 0.5 * self.thickness
        across, along = (self.across - half, self.across + half), (self.start, self.stop)
        return (across, along) if self.lying else (along, across)


def lying(y: float, start: float, stop: float, thickness: float) -> Wall:
    return Wall(True, y, start, stop, thickness)


def standing(z: float, start: float, stop: float, thickness: float) -> Wall:
    return Wall(False, z, start, stop, thickness)


@lru_cache(maxsize=4096)
def shape_of(kind: str, dimensions: tuple[float, ...]) -> SectionShape:
    """The numbers of a PBARL or PBEAML type. Raises ValueError for a type that is not known."""
    if kind not in _SOLID and kind not in _WALLS:
        raise ValueError(f"cross-section {kind} is not known; give it as PBAR or PBEAM")
    text = f"cross-section {kind} with {list(dimensions)}"
    try:
        if kind in _SOLID:
            shape = _SOLID[kind](*dimensions)
        else:
            walls = _WALLS[kind](*dimensions)
            if min(min(w.thickness, w.stop - w.start) for w in walls) <= 0.0:
                raise ValueError(f"{text} has a wall without thickness or length")
            shape = _walled(walls)
    except (ZeroDivisionError, TypeError, np.linalg.LinAlgError) as error:
        raise ValueError(f"{text}: {error}") from error
    if not min(shape.area, shape.inertia_1, shape.inertia_2) > 0.0:
        raise ValueError(f"{text} encloses no area")
    return shape


def _walled(walls: Sequence[Wall]) -> SectionShape:
    area, centre, moments = _union(walls)
    lines = Midlines.of(walls)
    torsion, pole = lines.torsion()
    arm = np.where(np.abs(centre - pole) > NOTHING * lines.size, centre - pole, 0.0)
    cross = moments[2] if abs(moments[2]) > NOTHING * math.sqrt(moments[0] * moments[1]) else 0.0
    factors = (1.0 / (area * flexibility) for flexibility in lines.shear())
    return SectionShape(area, moments[0], moments[1], cross, torsion, *factors, *map(float, arm))


def _union(walls: Sequence[Wall]) -> tuple[float, Floats, tuple[float, float, float]]:
    """Area, centroid (2,), and moments of y^2, z^2 and y z about it, of all walls together."""
    rows, columns = (sorted({e for w in walls for e in w.spans[axis]}) for axis in (0, 1))
    cells = []
    for (low, high), (left, right) in product(pairwise(rows), pairwise(columns)):
        y, z = 0.5 * (low + high), 0.5 * (left + right)
        if any(a < y < b and c < z < d for (a, b), (c, d) in (wall.spans for wall in walls)):
            cells.append((y, z, high - low, right - left))
    y, z, dy, dz = np.array(cells).T
    areas = dy * dz
    area = float(areas.sum())
    centre = np.array([areas @ y, areas @ z]) / area
    y, z = y - centre[0], z - centre[1]
    i1, i2 = areas @ (y**2 + dy**2 / 12.0), areas @ (z**2 + dz**2 / 12.0)
    return area, centre, (float(i1), float(i2), float(areas @ (y * z)))


@dataclass(frozen=True, slots=True)
class Midlines:
    """Straight pieces of the midlines of walls.

    ends: (n, 2, 2), y and z of both ends about the midlines' centroid; centre: (2,), of that;
    node: (n, 2), which ends are one; thickness: (n,); size: the larger of their extents.
    """

    ends: Floats
    centre: Floats
    node: Integers
    thickness: Floats
    size: float

    @classmethod
    def of(cls, walls: Sequence[Wall]) -> Midlines:
        pieces = np.array([piece for wall in walls for piece in _pieces(wall, walls)])
        ends, thickness = pieces[:, :4].reshape(-1, 2, 2), pieces[:, 4]
        points = ends.reshape(-1, 2)
        size = float(np.ptp(points, axis=0).max())
        # Ends within rounding of each other are one.
        same = np.round(points / (NOTHING * size))
        node = np.unique(same, axis=0, return_inverse=True)[1].reshape(-1, 2)
        weight = thickness * np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        centre = weight @ ends.mean(axis=1) / weight.sum()
        return cls(ends - centre, centre, node, thickness, size)

    @property
    def lengths(self) -> Floats:
        return np.asarray(np.linalg.norm(self.ends[:, 1] - self.ends[:, 0], axis=1))

    def solved(self, load: Floats) -> Floats:
        """w (n, 2) of which sum of t (dw/ds)^2 / 2 - load w is least; load: (n, 2), at the ends."""
        count = int(self.node.max()) + 1
        stiffness = np.zeros((count, count))
        for a, b in product((0, 1), (0, 1)):
            sign = 1.0 if a == b else -1.0
            places = (self.node[:, a], self.node[:, b])
            np.add.at(stiffness, places, sign * self.thickness / self.lengths)
        total = np.bincount(self.node.ravel(), load.ravel(), count)
        values = np.zeros(count)
        values[1:] = np.linalg.solve(stiffness[1:, 1:], total[1:])
        return np.asarray(values[self.node])

    def integral(self, f: Floats, g: Floats) -> float:
        """Of t f g, both linear on each piece and (n, 2) at its ends."""
        both = 2.0 * (f * g).sum(axis=1) + f[:, 0] * g[:, 1] + f[:, 1] * g[:, 0]
        return float((self.thickness * self.lengths) @ both / 6.0)

    def torsion(self) -> tuple[float, Floats]:
        """The torsion constant, and the shear centre (2,) in the walls' coordinates."""
        y, z = self.ends[:, :, 0], self.ends[:, :, 1]
        weight = self.thickness * self.lengths
        tangent = (self.ends[:, 1] - self.ends[:, 0]) / self.lengths[:, None]
        rho = y[:, 0] * tangent[:, 1] - z[:, 0] * tangent[:, 0]
        warping = self.solved((self.thickness * rho)[:, None] * np.array([1.0, -1.0]))
        twist = (warping[:, 1] - warping[:, 0]) / self.lengths + rho
        still = np.abs(twist) < NOTHING * self.size
        own = np.where(still, weight * self.thickness**2, 0.0).sum() / 3.0
        warping -= weight @ warping.mean(axis=1) / weight.sum()
        i1, i2, i12 = self.moments()
        wanted = [-self.integral(warping, y), -self.integral(warping, z)]
        pole = np.linalg.solve([[i12, -i1], [i2, -i12]], wanted)
        return float(weight @ twist**2 + own), self.centre + pole

    def moments(self) -> tuple[float, float, float]:
        y, z = self.ends[:, :, 0], self.ends[:, :, 1]
        return self.integral(y, y), self.integral(z, z), self.integral(y, z)

    def shear(self) -> Iterator[float]:
        """1 / k A in planes 1 and 2: twice the energy of a unit shear force, with G = 1."""
        i1, i2, i12 = self.moments()
        y, z = self.ends[:, :, 0], self.ends[:, :, 1]
        weight = self.thickness * self.lengths
        for gradient in (i2 * y - i12 * z, i1 * z - i12 * y):
            g = gradient / (i1 * i2 - i12**2)
            load = weight[:, None] * (2.0 * g + g[:, ::-1]) / 6.0
            # p is linear on each piece here; the energy of what bows it is added.
            bowed = weight @ (self.lengths * g.mean(axis=1)) ** 2 / 12.0
            yield float((load * self.solved(load)).sum() + bowed)


def _pieces(wall: Wall, walls: Sequence[Wall]) -> Iterator[tuple[float, ...]]:
    """A wall's midline between joints and free ends: y, z of both ends, thickness.

    Midlines meet where they cross within the walls' rectangles; a projection of at most half of
    the other wall's thickness is the corner, not a wall.
    """
    joints = {
        other.across: (0.5 + NOTHING) * other.thickness
        for other in walls
        if other.lying != wall.lying
        if wall.start <= other.across <= wall.stop and other.start <= wall.across <= other.stop
    }
    places = sorted(joints)
    if not places or places[0] - wall.start > joints[places[0]]:
        places.insert(0, wall.start)
    if places[-1] not in joints or wall.stop - places[-1] > joints[places[-1]]:
        places.append(wall.stop)
    for a, b in pairwise(places):
        for c, d in pairwise(np.linspace(a, b, PIECES + 1).tolist()):
            ends = (
                (wall.across, c, wall.across, d) if wall.lying else (c, wall.across, d, wall.across)
            )
            yield (*ends, wall.thickness)


def _ring(outer: float, inner: float) -> SectionShape:
    area = math.pi * (outer**2 - inner**2)
    second = math.pi / 4.0 * (outer**4 - inner**4)
    shear = 0.5 if inner else 0.9
    return SectionShape(area, second, second, 0.0, 2.0 * second, shear, shear)


def _bar(width: float, height: float) -> SectionShape:
    """Torsion: Roark's series."""
    long, short = max(width, height), min(width, height)
    ratio = short / long
    torsion = long * short**3 * (1.0 / 3.0 - 0.21 * ratio * (1.0 - ratio**4 / 12.0))
    area = width * height
    moments = (area * height**2 / 12.0, area * width**2 / 12.0)
    return SectionShape(area, *moments, 0.0, torsion, 5.0 / 6.0, 5.0 / 6.0)


def _hexa(corner: float, width: float, height: float) -> SectionShape:
    """Torsion: Saint-Venant's A^4 / 40 Ip, 2 % high for a regular hexagon."""
    inner = width - 2.0 * corner
    area = height * (inner + corner)
    i1 = height**3 * (inner / 12.0 + corner / 24.0)
    i2 = height * (inner**3 / 12.0 + corner**3 / 18.0 + corner * (inner / 2.0 + corner / 3.0) ** 2)
    torsion = area**4 / (40.0 * (i1 + i2))
    return SectionShape(area, i1, i2, 0.0, torsion, 5.0 / 6.0, 5.0 / 6.0)


_SOLID: dict[str, Callable[..., SectionShape]] = {
    "ROD": lambda radius: _ring(radius, 0.0),
    "TUBE": _ring,
    "TUBE2": lambda outer, thickness: _ring(outer, outer - thickness),
    "BAR": _bar,
    "HEXA": _hexa,
}


def _box1(
    width: float, height: float, top: float, bottom: float, right: float, left: float
) -> list[Wall]:
    return [
        lying(bottom / 2, 0.0, width, bottom), lying(height - top / 2, 0.0, width, top),
        standing(left / 2, 0.0, height, left), standing(width - right / 2, 0.0, height, right),
    ]  # fmt: skip


def _i(h: float, low: float, high: float, web: float, t_low: float, t_high: float) -> list[Wall]:
    return [
        lying(t_low / 2, -low / 2, low / 2, t_low), standing(0.0, 0.0, h, web),
        lying(h - t_high / 2, -high / 2, high / 2, t_high),
    ]  # fmt: skip


def _chan1(overhang: float, web: float, inner: float, height: float) -> list[Wall]:
    flange, width = (height - inner) / 2, web + overhang
    return [
        standing(web / 2, 0.0, height, web),
        lying(flange / 2, 0.0, width, flange), lying(height - flange / 2, 0.0, width, flange),
    ]  # fmt: skip


def _chan2(leg: float, flange: float, height: float, width: float) -> list[Wall]:
    return [
        lying(flange / 2, 0.0, width, flange),
        standing(leg / 2, 0.0, height, leg), standing(width - leg / 2, 0.0, height, leg),
    ]  # fmt: skip


def _t1(height: float, stem: float, flange: float, web: float) -> list[Wall]:
    return [
        standing(0.0, -height / 2, height / 2, flange), lying(0.0, -flange / 2 - stem, 0.0, web)
    ]  # fmt: skip


def _h(inner: float, legs: float, height: float, bar: float) -> list[Wall]:
    leg, arm = legs / 2, (inner + legs / 2) / 2
    posts = [standing(sign * arm, -height / 2, height / 2, leg) for sign in (-1.0, 1.0)]
    return [lying(0.0, -arm, arm, bar), *posts]


def _z(overhang: float, web: float, inner: float, height: float) -> list[Wall]:
    flange, reach = (height - inner) / 2, web / 2 + overhang
    return [
        standing(0.0, 0.0, height, web), lying(flange / 2, -web / 2, reach, flange),
        lying(height - flange / 2, -reach, web / 2, flange),
    ]  # fmt: skip


def _hat(height: float, t: float, crown: float, brim: float) -> list[Wall]:
    side, reach = (crown - t) / 2, crown / 2 + brim
    return [
        lying(height - t / 2, -crown / 2, crown / 2, t),
        *(standing(sign * side, 0.0, height, t) for sign in (-1.0, 1.0)),
        lying(t / 2, -reach, t - crown / 2, t), lying(t / 2, crown / 2 - t, reach, t),
    ]  # fmt: skip


def _hat1(base: float, height: float, crown: float, t: float, plate: float) -> list[Wall]:
    """A hat on a plate as wide as its brims."""
    hat = _hat(height - plate, t, crown, (base - crown) / 2)
    lifted = [
        replace(w, across=w.across + plate) if w.lying else replace(w, stop=height) for w in hat
    ]
    return [lying(plate / 2, -base / 2, base / 2, plate), *lifted]


def _dbox(
    width: float, height: float, middle: float, left: float, web: float = 0.0, right: float = 0.0,
    *skins: float,
) -> list[Wall]:  # fmt: skip
    """skins: thicknesses of the left cell's top and bottom, and of the right cell's."""
    top_left, bottom_left, top_right, bottom_right = skins
    return [
        *(standing(z, 0.0, height, t)
          for z, t in ((left / 2, left), (middle, web), (width - right / 2, right))),
        lying(height - top_left / 2, 0.0, middle, top_left),
        lying(bottom_left / 2, 0.0, middle, bottom_left),
        lying(height - top_right / 2, middle, width, top_right),
        lying(bottom_right / 2, middle, width, bottom_right),
    ]  # fmt: skip


_WALLS: dict[str, Callable[..., list[Wall]]] = {
    "BOX": lambda width, height, skin, side: _box1(width, height, skin, skin, side, side),
    "BOX1": _box1,
    "I": _i,
    "I1": lambda overhang, web, inner, height: _i(
        height, overhang + web, overhang + web, web, (height - inner) / 2, (height - inner) / 2
    ),
    "CHAN": lambda width, height, web, flange: _chan1(
        width - web, web, height - 2 * flange, height
    ),
    "CHAN1": _chan1,
    "CHAN2": _chan2,
    "T": lambda width, height, flange, web: [
        lying(height - flange / 2, -width / 2, width / 2, flange), standing(0.0, 0.0, height, web)
    ],
    "T1": _t1,
    "T2": lambda width, height, flange, web: [
        lying(flange / 2, -width / 2, width / 2, flange), standing(0.0, 0.0, height, web)
    ],
    "L": lambda width, height, foot, leg: [
        lying(foot / 2, 0.0, width, foot), standing(leg / 2, 0.0, height, leg)
    ],
    "H": _h,
    "CROSS": lambda arms, web, height, bar: [
        standing(0.0, -height / 2, height / 2, web),
        lying(0.0, -(arms + web) / 2, (arms + web) / 2, bar),
    ],
    "Z": _z,
    "HAT": _hat,
    "HAT1": _hat1,
    "DBOX": _dbox,
}  # fmt: skip


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
