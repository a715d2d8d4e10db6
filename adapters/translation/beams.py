"""Nastran bars, beams and rods in CalculiX, exact for any cross-section.

ccx expands its beams to solids of a few cross-sections, and its user element U1 has no mass in a
frequency step. So the translation writes the strain energy of a beam: six springs on linear forms
of the freedoms of the grid points, which include offsets and released ends.

A beam that is loaded only at its ends has six deformations q of its ends a, b. In the axes of the
element, whose x runs through the shear centres, with d the displacement of the centroids,

    q1 = e . (d_b - d_a), e along the neutral axis     q2 = theta_xb - theta_xa
    q3 = theta_zb - theta_za,  q4 = u_yb - u_ya - L (theta_za + theta_zb) / 2,  in plane 1
    q5 = theta_yb - theta_ya,  q6 = u_zb - u_za + L (theta_ya + theta_yb) / 2,  in plane 2

By equilibrium their forces Q give tension, torque, shear and moments at every place,

    N = Q1   T = Q2   M_z = Q3 + Q4 (L/2 - x)   V_y = Q4   M_y = Q5 - Q6 (L/2 - x)   V_z = Q6

whatever the cross-section there. So their flexibility is an integral along the beam, exact for any
taper (Spacone, Filippou and Taucer 1996, without inelasticity). Its inverse K is the stiffness, and
K = L D L^T writes the energy as six squares. For a uniform beam these are Timoshenko's values
(Przemieniecki 1968, section 5.6): E A / L, G J / L, E I / L and 12 E I / L^3 (1 + phi).

The mass between two stations is two C3D8 without stiffness. The eight integration points of each
are two Gauss stations along the beam times the radii of gyration across it, and they move with the
shape of the beam: the corners are tied to the straight line through the two stations. Four stations
integrate a uniform beam's consistent matrix exactly; the width varies as the mass along the beam
does. A CBAR has the coupled matrix of the NASTRAN Theoretical Manual (section 5.2): cubic shapes,
no rotary inertia, and along the bar 5/12 of the mass at each end and 1/12 between both. If the deck
lumps masses, one C3D8 whose Gauss stations are the ends has the share of each end, with the
torsional inertia of a CBEAM and no inertia about the other axes, as Nastran lumps it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from scipy import special

from modetune.adapters.nastran.cross_sections import (
    CrossSection,
    Station,
    check_warping,
    cross_section,
)
from modetune.adapters.nastran.mesh import beam_axes
from modetune.adapters.translation.assembly import Assembly, Form, Freedoms, difference, trimmed
from modetune.adapters.translation.calculix_text import BRICK_CORNERS, CalculixText, number_list
from modetune.adapters.translation.springs import GroundedSprings
from modetune.core.modes import Floats

#: Gauss points between two stations: two are exact for a uniform beam, whose integrands are
#: quadratic; eight give a taper of 1 to 10 in inertia to 1e-6.
UNIFORM_POINTS, POINTS = 2, 8
#: Couplings of deformations below this share of both are rounding: a uniform beam has none.
ROUNDING = 1e-13


@dataclass(frozen=True)
class Beam:
    """A beam without its grid points' motion.

    ends: (2, 3), basic coordinates of the line of shear centres; axes: (3, 3), x, y, z as rows.
    motion: (12, 12), from the grid points' basic displacements and rotations (of A, of B) to those
    of the beam's ends in its axes, released ends included; carried: where nothing is released.
    torsional_share: how much of its radius of gyration counts when it twists.
    """

    eid: int
    nodes: tuple[int, int]
    section: CrossSection
    ends: Floats
    axes: Floats
    motion: Floats
    carried: Floats
    torsional_share: float = 1.0

    @property
    def length(self) -> float:
        return float(np.linalg.norm(self.ends[1] - self.ends[0]))

    def place(self, x: float, across: Floats) -> Floats:
        """(3,), basic coordinates at a share 0..1 of the length; across: (2,), y and z there."""
        along: Floats = self.ends[0] + x * (self.ends[1] - self.ends[0])
        return along + across @ self.axes[1:]

    @cached_property
    def deformations(self) -> Floats:
        """(6, 12), q of the ends' displacements in the beam's axes."""
        rows = np.zeros((6, 12))
        half = self.length / 2.0
        neutral = [self.section.at(place).neutral for place in (0.0, 1.0)]
        line = np.array([self.length, *(neutral[1] - neutral[0])])
        line /= np.linalg.norm(line)
        for sign, start, (y, z) in ((-1.0, 0, neutral[0]), (1.0, 6, neutral[1])):
            rows[0, start : start + 3] = sign * line
            rows[0, start + 3 : start + 6] = sign * np.cross([0.0, y, z], line)
        rows[1, [3, 9]] = -1.0, 1.0
        rows[2, [5, 11]] = -1.0, 1.0
        rows[3, [1, 7, 5, 11]] = -1.0, 1.0, -half, -half
        rows[4, [4, 10]] = -1.0, 1.0
        rows[5, [2, 8, 4, 10]] = -1.0, 1.0, half, half
        return rows

    @cached_property
    def stiffness(self) -> Floats:
        """(6, 6), of the deformations; nothing in those that the cross-section does not carry."""
        flexibility = np.zeros((6, 6))
        for x, weight in self._points(0.0, 1.0):
            forces = self._forces(x)
            flexibility += weight * forces.T @ self._flexible(x) @ forces
        size = np.sqrt(np.outer(flexibility.diagonal(), flexibility.diagonal()))
        flexibility[np.abs(flexibility) <= ROUNDING * size] = 0.0
        carried = self._carried
        stiffness = np.zeros((6, 6))
        if _is_diagonal(flexibility):
            stiffness[carried, carried] = 1.0 / flexibility[carried, carried]
        else:
            chosen = np.ix_(carried, carried)
            stiffness[chosen] = np.linalg.inv(flexibility[chosen])
        return stiffness

    @property
    def springs(self) -> tuple[Floats, Floats]:
        """Six forms (6, 12) of the ends' displacements, and the stiffness of each (6,)."""
        carried = self._carried
        lower, values = np.eye(6), self.stiffness.diagonal().copy()
        if not _is_diagonal(self.stiffness):
            root = np.linalg.cholesky(self.stiffness[np.ix_(carried, carried)])
            size = root.diagonal()
            lower[np.ix_(carried, carried)] = root / size
            values[carried] = size**2
        return lower.T @ self.deformations, values

    def station(self, x: float) -> Floats:
        """(6, 12), displacement and rotation of the shear centre at a share 0..1 of the length.

        By the strains on the way there from end A; where there is no stiffness, by a straight line
        between the ends.
        """
        length = self.length
        strains = np.zeros((6, 6))
        lever = np.zeros((6, 6))
        for place, weight in self._points(0.0, x):
            row = self._flexible(place) @ self._forces(place)
            strains += weight * row
            lever += weight * (x - place) * length * row
        forces = self.stiffness @ self.deformations
        strains, lever = strains @ forces, lever @ forces
        rows = np.zeros((6, 12))
        rows[3:, 3:6] = np.eye(3)
        rows[3:] += strains[[1, 4, 2]]
        rows[1, [1, 5]] = 1.0, x * length
        rows[1] += lever[2] + strains[3]
        rows[2, [2, 4]] = 1.0, -x * length
        rows[2] += strains[5] - lever[4]
        for plane, (across, turn) in enumerate(((1, 5), (2, 4))):
            if not self._carried[2 + 2 * plane]:
                rows[[across, turn]] = 0.0
                rows[across, [across, across + 6]] = 1.0 - x, x
        y, z = self.section.at(x).neutral
        first_y, first_z = self.section.at(0.0).neutral
        rows[0, [0, 5, 4]] = 1.0, -first_y, first_z
        rows[0] += strains[0]
        for across in (0, 3):
            if not self._carried[across // 3]:
                rows[across] = 0.0
                rows[across, [across, across + 6]] = 1.0 - x, x
        rows[0] += y * rows[5] - z * rows[4]
        return rows

    @cached_property
    def _carried(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        stations = self.section.stations
        names = ("area", "torsion", "inertia_1", "inertia_1", "inertia_2", "inertia_2")
        least = [min(getattr(station, name) for station in stations) for name in names]
        least[1] *= self.section.shear_modulus
        return np.array(least) > 0.0

    def _points(self, start: float, stop: float) -> list[tuple[float, float]]:
        """Return Gauss points and weights (lengths), not across a station."""
        inner = [place for place in self.section.places if start < place < stop]
        count = UNIFORM_POINTS if self.section.is_uniform else POINTS
        gauss, weights = _gauss(count)
        found: list[tuple[float, float]] = []
        for a, b in pairwise([start, *inner, stop]):
            places = 0.5 * (a + b) + 0.5 * (b - a) * gauss
            lengths = 0.5 * (b - a) * self.length * weights
            found += zip(places.tolist(), lengths.tolist(), strict=True)
        return found

    def _forces(self, x: float) -> Floats:
        """(6, 6), N, T, M_z, V_y, M_y, V_z at a place of the forces of the deformations."""
        rows = np.eye(6)
        arm = self.length * (0.5 - x)
        rows[2, 3], rows[4, 5] = arm, -arm
        return rows

    @cached_property
    def _uniform(self) -> Floats:
        return self._flexibility_of(self.section.stations[0])

    def _flexible(self, x: float) -> Floats:
        """As `_flexibility_of` at a place."""
        return (
            self._uniform if self.section.is_uniform else self._flexibility_of(self.section.at(x))
        )

    def _flexibility_of(self, station: Station) -> Floats:
        """(6, 6), strains of N, T, M_z, V_y, M_y, V_z; 0 for what is not carried."""
        section = self.section
        e, g = section.youngs_modulus, section.shear_modulus
        rows = np.zeros((6, 6))
        carried = self._carried
        if carried[0]:
            rows[0, 0] = 1.0 / (e * station.area)
        if carried[1]:
            rows[1, 1] = 1.0 / (g * station.torsion)
        bent = [place for place in (2, 4) if carried[place]]
        # theta_z' and theta_y' of M_z and M_y: strain is -y theta_z' + z theta_y'.
        moments = np.array([[1.0, -1.0], [-1.0, 1.0]]) * station.moments
        inner = [place // 2 - 1 for place in bent]
        rows[np.ix_(bent, bent)] = _inverse(e * moments[np.ix_(inner, inner)])
        for place, factor in ((3, section.shear_1), (5, section.shear_2)):
            if carried[place] and factor and g and station.area:
                rows[place, place] = 1.0 / (factor * g * station.area)
        return rows


def _is_diagonal(matrix: Floats) -> bool:
    return np.count_nonzero(matrix) == np.count_nonzero(matrix.diagonal())


def _inverse(matrix: Floats) -> Floats:
    """Invert a positive definite matrix of 0 to 2 rows, a hundred times faster than np.linalg.

    Raises LinAlgError.
    """
    if len(matrix) < 2:
        return 1.0 / matrix
    (a, b), (_, c) = matrix
    determinant = a * c - b * b
    if not determinant > 0.0:
        raise np.linalg.LinAlgError("not positive definite")
    return np.asarray(np.array([[c, -b], [-b, a]]) / determinant)


@cache
def _gauss(count: int) -> tuple[Floats, Floats]:
    points, weights = special.roots_legendre(count)
    return points, weights


def cross_matrix(arm: Floats) -> Floats:
    """Return the matrix (3, 3) from theta to theta x arm."""
    x, y, z = arm
    return np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])


BEAMS = ("CBAR", "CBEAM")
RODS = ("CROD", "CONROD", "CTUBE")
KINDS = (*BEAMS, *RODS)
#: Stiffness of the mass carriers as a share of the beam's own E: nothing in double precision, and
#: so little that carriers which do not move as their own shape would leave rigid modes rigid.
NO_STIFFNESS = 1e-24
#: Share of its radius of gyration with which a CBAR's mass resists twisting: Nastran gives it no
#: torsional inertia (except with MDLPRM,BARMASS), and a free bar must have some to spin with.
BAR_TORSION = 0.01
#: Where the two Gauss stations of a C3D8 are, in units of half its length.
GAUSS = math.sqrt(1.0 / 3.0)
#: Pairs of Gauss stations that integrate consistent masses exactly: distance from the middle in
#: units of half a stretch, and the share of the mass that both have.
CONSISTENT = (
    (0.3399810435848563, 0.6521451548625461),
    (0.8611363115940526, 0.3478548451374538),
)
#: Factors on the axial motion of stations apart from its mean that couple two ends by 1/12 of the
#: mass: of a rod's two at the ends, and of a bar's at CONSISTENT, where linear motion has 1/6.
COUPLED_ROD, COUPLED_BAR = math.sqrt(2.0 / 3.0), math.sqrt(2.0)
#: Largest change of its width to an end: a beam whose mass ends in a point keeps a face there.
SLOPE = 0.999


def translate_beams(model: Assembly) -> None:
    """Add all bars, beams and rods; after the constraints, which say what is fixed."""
    freedoms = model.freedoms
    springs = GroundedSprings(freedoms)
    for element in model.elements(*KINDS):
        try:
            beam = beam_of(element, freedoms)
            forms, stiffnesses = beam.springs
        except (ValueError, np.linalg.LinAlgError) as error:
            impossible = isinstance(error, np.linalg.LinAlgError)
            reason = "I12 is more than I1 and I2 allow" if impossible else error
            model.refuse(element, reason)
            continue
        sets = model.sets_of(element)
        springs.add(
            [
                (_form(row, beam, freedoms), stiffness)
                for row, stiffness in zip(forms @ beam.motion, stiffnesses, strict=True)
            ],
            sets,
        )
        is_rod = element.type in RODS
        for carrier in _carriers(beam, is_rod, model.lumped):
            _add_mass(model, beam, carrier, sets)


def beam_of(element: Any, freedoms: Freedoms) -> Beam:
    """Return a bar, beam or rod. Raises ValueError with what cannot be translated."""
    is_rod = element.type in RODS
    section = cross_section(element if element.type == "CONROD" else element.pid_ref)
    where = beam_axes(element, freedoms.builder.coordinates, freedoms.frames)
    turn = np.kron(np.eye(4), where.axes)
    turn[:3, 3:6] = where.axes @ cross_matrix(where.offsets[0])
    turn[6:9, 9:12] = where.axes @ cross_matrix(where.offsets[1])
    share = BAR_TORSION if element.type == "CBAR" else 1.0
    first, second = element.node_ids
    beam = Beam(element.eid, (first, second), section, where.ends, where.axes, turn, turn, share)
    return beam if is_rod else _released(beam, element)


def _released(beam: Beam, element: Any) -> Beam:
    """Condense the freedoms between beam and grid point that pin flags release."""
    check_warping(element)
    flags = [(getattr(element, name) or 0, base) for name, base in (("pa", 0), ("pb", 6))]
    free = [base + int(digit) - 1 for flag, base in flags for digit in str(flag) if digit != "0"]
    stiffness = beam.deformations.T @ beam.stiffness @ beam.deformations
    free = [place for place in free if stiffness[place, place] > 0.0]  # without I1 no hinge for it
    if not free:
        return beam
    kept = [place for place in range(12) if place not in free]
    condensed = np.eye(12)
    inner = stiffness[np.ix_(free, free)]
    scale = np.sqrt(np.where(inner.diagonal() > 0.0, inner.diagonal(), 1.0))
    scaled = inner / np.outer(scale, scale)
    if np.linalg.cond(scaled) > 1e10:
        raise ValueError("its pin flags leave it a mechanism")
    condensed[free] = 0.0
    condensed[np.ix_(free, kept)] = -np.linalg.solve(inner, stiffness[np.ix_(free, kept)])
    return replace(beam, motion=condensed @ beam.motion)


def _form(row: Floats, beam: Beam, freedoms: Freedoms) -> Form:
    """Return a linear form of the grid points' 12 basic freedoms (a row of factors)."""
    form: Form = {}
    largest = np.abs(row).max()
    for place, node in enumerate(beam.nodes):
        for three, factors in enumerate(row[6 * place : 6 * place + 6].reshape(2, 3)):
            if np.abs(factors).max() <= 1e-12 * largest:
                continue
            names = freedoms.rotations(node) if three else freedoms.translations(node)
            for freedom, factor in zip(names, factors, strict=bool(names)):
                form[freedom] = form.get(freedom, 0.0) + float(factor)
    return trimmed(form)


@dataclass(frozen=True, slots=True)
class Carrier:
    """A box whose mass moves as two stations of a beam do, where its Gauss points are.

    stretch: where it begins and ends, 0..1 of the beam's length; mass: mean, per length; slope: its
    change to an end, as a share; centres: (2,) at both ends. Of each station its shape (6, 12) and
    its mass, centre and second moments; turning: (3,), share of the levers that turns with it.
    """

    stretch: tuple[float, float]
    mass: float
    slope: float
    centres: tuple[Floats, Floats]
    shapes: tuple[Floats, Floats]
    stations: tuple[tuple[float, Floats, Floats], ...]
    turning: Floats


def _carriers(beam: Beam, is_rod: bool, lumped: bool) -> Iterator[Carrier]:
    """Yield the carriers of the whole beam, or of each stretch with linear mass.

    Lumped masses, and those of all rods, are at the ends, which twist and do not turn otherwise.
    """
    is_bar = beam.torsional_share == BAR_TORSION
    turning = np.array([beam.torsional_share, 1.0, 1.0])
    if lumped or is_rod:
        first, last = beam.section.end_masses
        mean = first + last
        slope = (last - first) / mean if mean else 0.0
        shapes = beam.carried[:6], beam.carried[6:]
        yield _carrier(
            beam.section,
            (0.0, 1.0),
            (1.0, mean, slope),
            shapes if lumped else _coupled(shapes, COUPLED_ROD),
            turning * [1.0, 0.0, 0.0],
        )
        return
    if is_bar:
        section = replace(beam.section, shear_1=0.0, shear_2=0.0)
        beam, turning = replace(beam, section=section), turning * [1.0, 0.0, 0.0]
    for start, stop in beam.section.stretches:
        first, last = (beam.section.mass(place)[0] for place in (start, stop))
        mean = 0.5 * (first + last)
        slope = 0.5 * (last - first) / mean if mean else 0.0
        # Four stations of a mass that ends in a point would need boxes turned inside out.
        steep = abs(slope) * CONSISTENT[-1][0] > SLOPE * GAUSS
        for station, share in ((GAUSS, 1.0),) if steep else CONSISTENT:
            middle, reach = 0.5 * (start + stop), 0.5 * station * (stop - start)
            near, far = (beam.station(middle + sign * reach) for sign in (-1.0, 1.0))
            if is_bar:
                near, far = _coupled((near, far), COUPLED_BAR)
            shapes = near @ beam.motion, far @ beam.motion
            masses = station, mean * share, slope
            yield _carrier(beam.section, (start, stop), masses, shapes, turning)


def _carrier(
    section: CrossSection,
    stretch: tuple[float, float],
    masses: tuple[float, float, float],
    shapes: tuple[Floats, Floats],
    turning: Floats,
) -> Carrier:
    """Return the carrier whose Gauss points are the two stations of a stretch.

    masses: the stations' distance from the middle in units of half the stretch, what both have of
    its mass, per length, and the change of its mass to an end as a share.
    """
    station, mass, slope = masses
    middle, half = 0.5 * sum(stretch), 0.5 * (stretch[1] - stretch[0])
    reach = station / GAUSS
    centres = [section.mass(place)[1] for place in stretch]
    apart = 0.5 * (reach - 1.0) * (centres[1] - centres[0])
    return Carrier(
        (middle - reach * half, middle + reach * half),
        mass / reach,
        slope * reach,
        (centres[0] - apart, centres[1] + apart),
        shapes,
        tuple(section.mass(middle + sign * station * half) for sign in (-1.0, 1.0)),
        turning,
    )


def _coupled(shapes: tuple[Floats, Floats], factor: float) -> tuple[Floats, Floats]:
    """Return the shapes at two stations with the axial mass matrix of PARAM,COUPMASS.

    Along a rod or bar each end has 5/12 of the mass and 1/12 couples both, the mean of the
    consistent matrix and the lumped one; across a rod the ends have a half each. MSC Nastran's
    eight frequencies of a ten-bar truss follow from it to five digits.
    """
    near, far = (shape.copy() for shape in shapes)
    middle, half = 0.5 * (near[0] + far[0]), 0.5 * factor * (far[0] - near[0])
    near[0], far[0] = middle - half, middle + half
    return near, far


def _add_mass(model: Assembly, beam: Beam, carrier: Carrier, sets: Sequence[str]) -> None:
    """Add a carrier, if there is anything to carry."""
    if not carrier.mass:
        return
    start, stop = carrier.stretch
    # Roots of the second moments: levers at which four masses have these.
    levers = [_root(second / own) for own, _, second in carrier.stations]
    radii = np.sqrt(np.mean([(lever @ lever).diagonal() for lever in levers], axis=0))
    # Sides of a uniform box with these radii of gyration; a box needs some extent all the same.
    sides = np.maximum(math.sqrt(12.0) * radii, 1e-3 * (stop - start) * beam.length)
    slope = np.clip(carrier.slope, -SLOPE, SLOPE)
    nodes = []
    for along, *across in BRICK_CORNERS:
        arm = 0.5 * np.array(across) * sides * [1.0, 1.0 + along * slope]
        end = int(along > 0.0)
        place = beam.place(carrier.stretch[end], carrier.centres[end] + arm)
        node = model.builder.new_node(place)
        near, far = (
            _moved(shape, centre, lever @ across, carrier.turning)
            for shape, (_, centre, _), lever in zip(
                carrier.shapes, carrier.stations, levers, strict=True
            )
        )
        moved = 0.5 * (near + far) + 0.5 * along / GAUSS * (far - near)
        for component, row in enumerate(beam.axes.T @ moved, start=1):
            own = (node, component)
            form = difference({own: 1.0}, _form(row, beam, model.freedoms))
            model.freedoms.tie([form], [own], f"node {node}")
        nodes.append(node)
    density = carrier.mass * model.wtmass / float(np.prod(sides))
    name = _mass_material(model.builder, density, beam.section.youngs_modulus)
    model.builder.new_element("C3D8", nodes, (name, *sets))


def _moved(station: Floats, centre: Floats, lever: Floats, turning: Floats) -> Floats:
    """(3, n), displacement of a place off the shear centre; centre, lever: (2,), y and z.

    The lever is a radius of gyration at the integration points, which turns by shares (3,) alone.
    """
    corner = lever / GAUSS
    return np.asarray(
        station[:3]
        + cross_matrix(np.array([0.0, *centre])) @ station[3:]
        + cross_matrix(np.array([0.0, *corner])) @ (turning[:, None] * station[3:])
    )


def _root(second: Floats) -> Floats:
    """Return the symmetric square root of a positive semi-definite (2, 2) matrix."""
    middle = math.sqrt(max(second[0, 0] * second[1, 1] - second[0, 1] ** 2, 0.0))
    size = math.sqrt(second[0, 0] + second[1, 1] + 2.0 * middle)
    return (second + middle * np.eye(2)) / size if size else np.zeros((2, 2))


def _mass_material(builder: CalculixText, density: float, youngs_modulus: float) -> str:
    """Return the material and section (of one name) of mass carriers of this density."""
    lines = [
        "*ELASTIC",
        number_list((NO_STIFFNESS * youngs_modulus, 0.0)),
        "*DENSITY",
        number_list((density,)),
    ]
    count = 1
    while not builder.can_be_material(f"MASS_{count}", lines):
        count += 1
    name = f"MASS_{count}"
    if name not in builder.sets:
        builder.material(name, lines)
        builder.section([f"*SOLID SECTION, ELSET={name}, MATERIAL={name}"])
    return name
