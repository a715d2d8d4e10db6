"""PBARL and PBEAML sections against closed forms and a finite element solution of torsion."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy import integrate, sparse
from scipy.sparse.linalg import spsolve

from modetune.adapters.nastran.cross_sections import _WALLS, SectionShape, _union, shape_of
from modetune.core.modes import Floats

#: A section of each type that has walls, with walls of a tenth to a twentieth of their length.
DIMENSIONS = {
    "BOX": (50, 40, 4, 3),
    "BOX1": (60, 50, 4, 3, 2, 5),
    "I": (100, 60, 50, 4, 6, 5),
    "I1": (40, 4, 90, 100),
    "CHAN": (50, 100, 4, 5),
    "CHAN1": (46, 4, 90, 100),
    "CHAN2": (4, 5, 50, 100),
    "T": (60, 50, 5, 4),
    "T1": (60, 45, 5, 4),
    "T2": (60, 50, 5, 4),
    "CROSS": (60, 5, 60, 4),
    "H": (40, 10, 60, 5),
    "Z": (30, 4, 90, 100),
    "HAT": (50, 3, 40, 20),
    "HAT1": (80, 50, 40, 3, 4),
    "DBOX": (100, 50, 40, 3, 2, 3, 4, 4, 2, 2),
    "L": (60, 50, 4, 5),
}


def saint_venant(kind: str) -> tuple[float, Floats]:
    """Torsion constant, and centroid less shear centre (2,), by bilinear elements over the area.

    The warping w minimises the integral of |grad w + (-z, y)|^2; the shear centre is Trefftz's.
    """
    walls = _WALLS[kind](*(float(value) for value in DIMENSIONS[kind]))
    _, centre, (i1, i2, i12) = _union(walls)
    lines = []
    for axis in (0, 1):
        edges = sorted({edge for wall in walls for edge in wall.spans[axis]})
        steps = [np.linspace(a, b, max(6, int((b - a) / 1.0)) + 1)[:-1] for a, b in pairwise(edges)]
        lines.append(np.concatenate([*steps, [edges[-1]]]))
    rows, columns = lines
    number = np.arange(rows.size * columns.size).reshape(rows.size, columns.size)
    mid_y, mid_z = 0.5 * (rows[1:] + rows[:-1]), 0.5 * (columns[1:] + columns[:-1])
    inside = np.zeros((mid_y.size, mid_z.size), dtype=bool)
    for wall in walls:
        (a, b), (c, d) = wall.spans
        inside |= ((mid_y > a) & (mid_y < b))[:, None] & ((mid_z > c) & (mid_z < d))
    i, j = np.nonzero(inside)
    nodes = np.stack([number[i, j], number[i + 1, j], number[i + 1, j + 1], number[i, j + 1]], 1)
    dy, dz = rows[i + 1] - rows[i], columns[j + 1] - columns[j]
    y, z = mid_y[i] - centre[0], mid_z[j] - centre[1]
    load, polar = np.zeros((i.size, 4)), 0.0
    matrix = np.zeros((i.size, 4, 4))
    mass = np.zeros((i.size, 4))
    moments = np.zeros((2, i.size, 4))
    gauss = 0.5 / np.sqrt(3.0)
    for p in (-gauss, gauss):
        for q in (-gauss, gauss):
            shape = np.array([(0.5 - p) * (0.5 - q), (0.5 + p) * (0.5 - q),
                              (0.5 + p) * (0.5 + q), (0.5 - p) * (0.5 + q)])  # fmt: skip
            along = np.array([-(0.5 - q), 0.5 - q, 0.5 + q, -(0.5 + q)]) / dy[:, None]
            up = np.array([-(0.5 - p), -(0.5 + p), 0.5 + p, 0.5 - p]) / dz[:, None]
            weight = dy * dz / 4.0
            here_y, here_z = y + p * dy, z + q * dz
            matrix += weight[:, None, None] * (
                along[:, :, None] * along[:, None, :] + up[:, :, None] * up[:, None, :]
            )
            load += weight[:, None] * (here_z[:, None] * along - here_y[:, None] * up)
            polar += float(weight @ (here_y**2 + here_z**2))
            mass += weight[:, None] * shape
            moments[0] += (weight * here_y)[:, None] * shape
            moments[1] += (weight * here_z)[:, None] * shape
    used, place = np.unique(nodes, return_inverse=True)
    place = place.reshape(nodes.shape)
    pairs = (np.repeat(place, 4, axis=1).ravel(), np.tile(place, (1, 4)).ravel())
    stiffness = sparse.csc_array((matrix.ravel(), pairs), shape=(used.size, used.size))
    total = np.bincount(place.ravel(), load.ravel(), used.size)
    warping = np.zeros(used.size)
    warping[1:] = spsolve(stiffness[1:, 1:], total[1:])
    mean = (mass * warping[place]).sum() / mass.sum()
    about_y, about_z = (float((m * (warping[place] - mean)).sum()) for m in moments)
    # The pole P to whose warping w - P_z y + P_y z the moments are 0; y, z are the centroid's.
    pole = np.linalg.solve([[i12, -i1], [i2, -i12]], [-about_y, -about_z])
    return polar - float(total @ warping), -pole


@pytest.mark.parametrize("kind", DIMENSIONS)
def test_torsion_and_shear_centre_are_those_of_a_finite_element_solution(kind: str) -> None:
    shape = shape_of(kind, tuple(float(value) for value in DIMENSIONS[kind]))
    torsion, neutral = saint_venant(kind)
    # Thin-walled theory leaves out what corners and ends of walls add or take: t / l of the torsion
    # constant, a twentieth here; of closed walls also their own l t^3 / 3 (Bredt), and of a hat on
    # a plate that the brims are glued to it. The shear centre moves by a share of a thickness.
    assert shape.torsion == pytest.approx(torsion, rel=0.08 if kind == "HAT1" else 0.05)
    size = max(DIMENSIONS[kind][:4])
    assert [shape.neutral_y, shape.neutral_z] == pytest.approx(neutral, abs=0.005 * size)


def test_thin_walls_have_the_torsion_and_shear_centre_of_the_books() -> None:
    """Roark's formulas of a channel, and Bredt's of a box."""
    b, h, t = 0.05, 0.1, 1e-5
    channel = shape_of("CHAN", (b + t / 2, h + t, t, t))
    assert channel.torsion == pytest.approx((2 * b + h) * t**3 / 3, rel=1e-9)
    assert channel.neutral_z == pytest.approx(b**2 / (2 * b + h) + 3 * b**2 / (6 * b + h), rel=1e-3)
    assert channel.neutral_y == 0.0
    box = shape_of("BOX", (b + t, h + t, t, t))
    assert box.torsion == pytest.approx(2 * t * b**2 * h**2 / (b + h), rel=1e-9)
    angle = shape_of("L", (b + t / 2, b + t / 2, t, t))
    assert (angle.neutral_y, angle.neutral_z) == pytest.approx((b / 4, b / 4), rel=1e-3)


def test_shear_factors_are_those_of_the_books() -> None:
    """Strain energy of the shear flow V S / I t: 5/6 of a strip, and a thin square tube's."""
    t = 1e-6
    strip = shape_of("CROSS", (1e-9, 1e-9 + t, 1.0, 1e-9))
    assert strip.shear_1 == pytest.approx(5 / 6, rel=1e-3)
    a = 1.0
    tube = shape_of("BOX", (a + t, a + t, t, t))
    s = np.linspace(-a / 2, a / 2, 20001)
    inertia = 2 * t * a**3 / 12 + 2 * a * t * (a / 2) ** 2
    web = (a / 2) * t * (a / 2) + t * ((a / 2) ** 2 - s**2) / 2
    flange = t * (a / 2) * np.linspace(0, a / 2, 20001)
    energy = 2 * integrate.trapezoid(web**2, s) + 4 * integrate.trapezoid(
        flange**2, dx=a / 2 / 20000
    )
    assert tube.shear_1 == pytest.approx(inertia**2 * t / energy / (4 * a * t), rel=1e-3)
    assert tube.shear_2 == pytest.approx(tube.shear_1, rel=1e-9)


def test_a_regular_hexagon_has_its_closed_forms() -> None:
    """Moments 5 sqrt(3) / 16 a^4 (Roark); its torsion constant there is 1.03 a^4."""
    side = 2.0
    shape = shape_of("HEXA", (side / 2, 2 * side, side * np.sqrt(3.0)))
    assert shape.area == pytest.approx(1.5 * np.sqrt(3) * side**2, rel=1e-12)
    wanted = 5 * np.sqrt(3) / 16 * side**4
    assert [shape.inertia_1, shape.inertia_2] == pytest.approx([wanted, wanted], rel=1e-12)
    assert shape.torsion == pytest.approx(1.03 * side**4, rel=0.025)


@pytest.mark.parametrize(
    ("kind", "mirrored", "sign"), [("T", "T2", (-1.0, 1.0)), ("CHAN", "CHAN1", (1.0, 1.0))]
)
def test_types_that_are_one_shape_agree(
    kind: str, mirrored: str, sign: tuple[float, float]
) -> None:
    first, second = (shape_of(k, tuple(map(float, DIMENSIONS[k]))) for k in (kind, mirrored))
    names = [name for name in SectionShape.__slots__ if not name.startswith("neutral")]
    for name in names:
        assert getattr(first, name) == pytest.approx(getattr(second, name), rel=1e-9)
    assert first.neutral_y == pytest.approx(sign[0] * second.neutral_y, rel=1e-9)
    assert first.neutral_z == pytest.approx(sign[1] * second.neutral_z, rel=1e-9)


@pytest.mark.parametrize(
    ("kind", "dimensions"), [("I", (1.0,) * 5), ("BOX", (1.0, 1.0, 0.0, 0.1)), ("OCTAGON", ())]
)
def test_dimensions_that_are_no_section_are_refused(
    kind: str, dimensions: tuple[float, ...]
) -> None:
    with pytest.raises(ValueError, match=f"cross-section {kind}"):
        shape_of(kind, dimensions)
