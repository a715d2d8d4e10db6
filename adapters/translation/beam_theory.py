"""A straight beam as six springs and a shape: no solver's, no program's.

A beam that is loaded at its ends alone has six deformations q of its ends a, b. In the element's
axes, whose x runs through the shear centres, with d the displacement of the centroids,

    q1 = e . (d_b - d_a), e along the neutral axis     q2 = theta_xb - theta_xa
    q3 = theta_zb - theta_za,  q4 = u_yb - u_ya - L (theta_za + theta_zb) / 2,  in plane 1
    q5 = theta_yb - theta_ya,  q6 = u_zb - u_za + L (theta_ya + theta_yb) / 2,  in plane 2

Equilibrium gives what their forces Q make of tension, torque, shear and moments at every place,

    N = Q1   T = Q2   M_z = Q3 + Q4 (L/2 - x)   V_y = Q4   M_y = Q5 - Q6 (L/2 - x)   V_z = Q6

whatever the cross-section there, so that their flexibility is an integral along the beam, exact for
any taper (Spacone, Filippou and Taucer 1996, without inelasticity); its inverse K is the stiffness,
and K = L D L^T writes the energy as six squares. A uniform beam's are Timoshenko's (Przemieniecki
1968, section 5.6): E A / L, G J / L, E I / L and 12 E I / L^3 (1 + phi).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise

import numpy as np
from scipy import special

from modetune.adapters.nastran.cross_sections import CrossSection, Station
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
        """Gauss points and weights (lengths), not across a station."""
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
    """Of a positive definite matrix of 0 to 2 rows, where np.linalg takes a hundred times as long.

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
    """(3, 3), theta to theta x arm."""
    x, y, z = arm
    return np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
