"""A straight beam as six springs and a shape: no solver's, no program's.

The strain energy of a uniform beam loaded at its ends has six terms: with u_x ... theta_z of the
ends a, b in the element's axes

    E A / L (u_xb - u_xa)^2 / 2            G J / L (theta_xb - theta_xa)^2 / 2
    E I1 / L (theta_zb - theta_za)^2 / 2   12 E I1 / L^3 (1 + phi1) (s_1)^2 / 2   and in plane 2,
    s_1 = u_yb - u_ya - L (theta_za + theta_zb) / 2,    phi1 = 12 E I1 / (K1 A G L^2)

which is Timoshenko's beam stiffness (Przemieniecki 1968, section 5.6) written as a sum of squares.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modetune.adapters.translation.cross_sections import CrossSection
from modetune.core.modes import Floats


@dataclass(frozen=True, slots=True)
class Beam:
    """A beam without its grid points' motion.

    ends: (2, 3), basic coordinates of the elastic axis; axes: (3, 3), x, y, z as rows.
    motion: (12, 12), from the grid points' basic displacements and rotations (of A, of B) to those
    of the beam's ends in its axes, released ends included. torsional_share: how much of its radius
    of gyration counts when it twists.
    """

    eid: int
    nodes: tuple[int, int]
    section: CrossSection
    ends: Floats
    axes: Floats
    motion: Floats
    torsional_share: float = 1.0

    @property
    def length(self) -> float:
        return float(np.linalg.norm(self.ends[1] - self.ends[0]))

    @property
    def shear(self) -> tuple[float, float]:
        """phi of planes 1 and 2."""
        section = self.section
        first, second = (
            12.0
            * section.youngs_modulus
            * inertia
            / (factor * section.area * section.shear_modulus * self.length**2)
            if factor and section.shear_modulus
            else 0.0
            for inertia, factor in (
                (section.inertia_1, section.shear_1),
                (section.inertia_2, section.shear_2),
            )
        )
        return first, second


def stiffnesses(beam: Beam) -> Floats:
    """(6,), of the six deformations."""
    section, length = beam.section, beam.length
    e = section.youngs_modulus
    phi1, phi2 = beam.shear
    bend1, bend2 = e * section.inertia_1 / length, e * section.inertia_2 / length
    stretch, twist = e * section.area / length, section.shear_modulus * section.torsion / length
    sway1 = 12.0 * bend1 / length**2 / (1.0 + phi1)
    sway2 = 12.0 * bend2 / length**2 / (1.0 + phi2)
    return np.array([stretch, twist, bend1, sway1, bend2, sway2])


def deformations(beam: Beam) -> Floats:
    """(6, 12), the six deformations of the ends' displacements in the beam's axes."""
    rows = np.zeros((6, 12))
    half = beam.length / 2.0
    rows[0, [0, 6]] = -1.0, 1.0
    rows[1, [3, 9]] = -1.0, 1.0
    rows[2, [5, 11]] = -1.0, 1.0
    rows[3, [1, 7, 5, 11]] = -1.0, 1.0, -half, -half
    rows[4, [4, 10]] = -1.0, 1.0
    rows[5, [2, 8, 4, 10]] = -1.0, 1.0, half, half
    return rows


def station(beam: Beam, place: float) -> Floats:
    """(6, 12), displacement and rotation of the axis at a share 0..1 of the length.

    The shape of a beam loaded at its ends alone, shear strain included (Przemieniecki 1968,
    equation 11.16).
    """
    x, length = place, beam.length
    rows = np.zeros((6, 12))
    rows[0, [0, 6]] = rows[3, [3, 9]] = 1.0 - x, x
    if beam.section.is_rod:
        rows[1, [1, 7]] = rows[2, [2, 8]] = 1.0 - x, x
        return rows
    for phi, across, turn, along, sign in zip(
        beam.shear, (1, 2), (5, 4), (5, 4), (1.0, -1.0), strict=True
    ):
        shapes = np.array([
            1.0 - 3.0 * x**2 + 2.0 * x**3 + phi * (1.0 - x),
            sign * length * (x - 2.0 * x**2 + x**3 + phi * (x - x**2) / 2.0),
            3.0 * x**2 - 2.0 * x**3 + phi * x,
            sign * length * (x**3 - x**2 - phi * (x - x**2) / 2.0),
        ])  # fmt: skip
        slopes = np.array([
            sign * 6.0 * (x**2 - x) / length, 1.0 - 4.0 * x + 3.0 * x**2 + phi * (1.0 - x),
            sign * 6.0 * (x - x**2) / length, 3.0 * x**2 - 2.0 * x + phi * x,
        ])  # fmt: skip
        columns = [across, along, across + 6, along + 6]
        rows[across, columns] = shapes / (1.0 + phi)
        rows[turn, columns] = slopes / (1.0 + phi)
    return rows


def cross_matrix(arm: Floats) -> Floats:
    """(3, 3), theta to theta x arm."""
    x, y, z = arm
    return np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
