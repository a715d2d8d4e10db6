"""Volumes, areas, their moments, and forces at nodes of finite elements, by Gauss integration.

An element is known by the natural coordinates of its nodes and the monomials that span its shape
functions: with V the monomials at the nodes, N(x) = monomials(x) inv(V). So the same few lines hold
for every element and every order of nodes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy

from modetune.core.mesh import CellKind
from modetune.core.modes import Floats

#: Exact for the moments of quadratic elements with straight sides.
GAUSS_POINTS = 4
#: Steps to the nearest point of a face: two on a plane parallelogram, a few on others.
NEAREST_STEPS = 20

Point = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ElementShape:
    """nodes: (n_nodes, n_dim) natural coordinates; exponents: (n_nodes, n_dim) of the monomials.

    simplex: how many of the leading coordinates span a triangle or tetrahedron from 0 to 1; the
    others run from -1 to 1.
    """

    nodes: Floats
    exponents: Floats
    simplex: int


def _shape(nodes: Sequence[Point], exponents: Sequence[Point], simplex: int) -> ElementShape:
    return ElementShape(
        np.array(nodes, dtype=np.float64), np.array(exponents, dtype=np.float64), simplex
    )


def _with_middles(corners: Sequence[Point], edges: Sequence[tuple[int, int]]) -> list[Point]:
    middles = [
        tuple((a + b) / 2.0 for a, b in zip(corners[i], corners[j], strict=True)) for i, j in edges
    ]
    return [*corners, *middles]


SQUARE = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
TRIANGLE = [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]
CUBE = [(x, y, z) for z in (-1.0, 1.0) for x, y in SQUARE]
WEDGE = [(x, y, z) for z in (-1.0, 1.0) for x, y in TRIANGLE]
TETRAHEDRON = [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]

_RING4 = [(0, 1), (1, 2), (2, 3), (3, 0)]
_RING3 = [(0, 1), (1, 2), (2, 0)]
_CUBE_TOP, _CUBE_UP = [(i + 4, j + 4) for i, j in _RING4], [(i, i + 4) for i in range(4)]
_WEDGE_TOP, _WEDGE_UP = [(i + 3, j + 3) for i, j in _RING3], [(i, i + 3) for i in range(3)]
_TETRA = [*_RING3, (0, 3), (1, 3), (2, 3)]

_LINEAR2 = [(0, 0), (1, 0), (0, 1)]
_QUADRATIC2 = [*_LINEAR2, (2, 0), (1, 1), (0, 2)]
_BILINEAR = list(product((0, 1), repeat=2))
_TRILINEAR = list(product((0, 1), repeat=3))
_SQUARE8 = [*_BILINEAR, (2, 0), (0, 2), (2, 1), (1, 2)]
#: Serendipity: at most one exponent is two, and then the others are zero or one.
_CUBE20 = [e for e in product((0, 1, 2), repeat=3) if e.count(2) <= 1]
_WEDGE6 = [(*e, z) for e in _LINEAR2 for z in (0, 1)]
_WEDGE15 = [(*e, z) for e in _QUADRATIC2 for z in (0, 1)] + [(*e, 2) for e in _LINEAR2]
_TETRA4 = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
_TETRA10 = [e for e in product((0, 1, 2), repeat=3) if sum(e) <= 2]

#: By ccx's or Nastran's name with the number of nodes.
SHAPES = {
    "C3D8": _shape(CUBE, _TRILINEAR, 0),
    "C3D20": _shape(_with_middles(CUBE, [*_RING4, *_CUBE_TOP, *_CUBE_UP]), _CUBE20, 0),
    "C3D6": _shape(WEDGE, _WEDGE6, 2),
    "C3D15": _shape(_with_middles(WEDGE, [*_RING3, *_WEDGE_TOP, *_WEDGE_UP]), _WEDGE15, 2),
    "C3D4": _shape(TETRAHEDRON, _TETRA4, 3),
    "C3D10": _shape(_with_middles(TETRAHEDRON, _TETRA), _TETRA10, 3),
    "S8R": _shape(_with_middles(SQUARE, _RING4), _SQUARE8, 0),
    "S4": _shape(SQUARE, _BILINEAR, 0),
    "S3": _shape(TRIANGLE, _LINEAR2, 2),
    "S6": _shape(_with_middles(TRIANGLE, _RING3), _QUADRATIC2, 2),
    "B31": _shape([(-1.0,), (1.0,)], [(0,), (1,)], 0),
    "B32": _shape([(-1.0,), (1.0,), (0.0,)], [(0,), (1,), (2,)], 0),
    "CHEXA8": _shape(CUBE, _TRILINEAR, 0),
    "CHEXA20": _shape(_with_middles(CUBE, [*_RING4, *_CUBE_UP, *_CUBE_TOP]), _CUBE20, 0),
    "CPENTA6": _shape(WEDGE, _WEDGE6, 2),
    "CPENTA15": _shape(_with_middles(WEDGE, [*_RING3, *_WEDGE_UP, *_WEDGE_TOP]), _WEDGE15, 2),
    "CTETRA4": _shape(TETRAHEDRON, _TETRA4, 3),
    "CTETRA10": _shape(_with_middles(TETRAHEDRON, _TETRA), _TETRA10, 3),
}
#: Of cells, whose nodes stand as VTK has them.
OF_CELLS: dict[CellKind, str] = {
    "line": "B31", "line3": "B32", "triangle": "S3", "triangle6": "S6", "quad": "S4",
    "quad8": "S8R", "tetra": "C3D4", "tetra10": "C3D10", "wedge": "C3D6", "wedge15": "C3D15",
    "hexahedron": "C3D8", "hexahedron20": "C3D20",
}  # fmt: skip
#: Corners of the faces of solids by their corners' number, in ccx's order of faces.
FACES: dict[int, tuple[tuple[int, ...], ...]] = {
    4: ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)),
    6: ((0, 1, 2), (3, 5, 4), (0, 3, 4, 1), (1, 4, 5, 2), (2, 5, 3, 0)),
    8: ((0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0)),
}


@dataclass(frozen=True, slots=True)
class Points:
    """places: (n_elements, n_points, 3); measures: (n_elements, n_points), volume, area or length
    of each.

    normals: (n_elements, n_points, 3), unit normals of surfaces, zeros of volumes and lines.
    """

    places: Floats
    measures: Floats
    normals: Floats


def integration_points(shape: ElementShape, corners: Floats) -> Points:
    """Where Gauss integration looks at elements of one shape; corners: (n_elements, n_nodes, 3)."""
    at, weights = _rule(shape)
    inverse = np.linalg.inv(_monomials(shape.exponents, shape.nodes))
    values = _monomials(shape.exponents, at) @ inverse
    places = np.einsum("pn,enk->epk", values, corners)
    slopes = [
        np.einsum("pn,enk->epk", _slopes(shape.exponents, at, axis) @ inverse, corners)
        for axis in range(shape.nodes.shape[1])
    ]
    if len(slopes) == 1:
        length = np.linalg.norm(slopes[0], axis=2)
        return Points(places, length * weights, np.zeros_like(places))
    cross = np.cross(slopes[0], slopes[1])
    if len(slopes) == 3:
        return Points(
            places, np.einsum("epk,epk->ep", cross, slopes[2]) * weights, np.zeros_like(places)
        )
    area = np.linalg.norm(cross, axis=2)
    return Points(places, area * weights, cross / area[..., None])


def nodal_measures(shape: ElementShape, corners: Floats) -> Floats:
    """(n_elements, n_nodes), integrals of the shape functions over volume, area or length."""
    return nodal_forces(shape, corners, lambda points: np.ones((*points.measures.shape, 1)))[..., 0]


def nodal_forces(shape: ElementShape, corners: Floats, field: Callable[[Points], Floats]) -> Floats:
    """Integrals of the shape functions times a field, (n_elements, n_nodes, k).

    field: of points its values there, (n_elements, n_points, k), per volume, area or length.
    """
    at, _ = _rule(shape)
    values = _monomials(shape.exponents, at) @ np.linalg.inv(
        _monomials(shape.exponents, shape.nodes)
    )
    points = integration_points(shape, corners)
    weighted = field(points) * points.measures[..., None]
    return np.asarray(np.tensordot(weighted, values, axes=(1, 0)).transpose(0, 2, 1))


def face_nodes(kind: CellKind, corners: Sequence[int]) -> tuple[tuple[int, ...], ElementShape]:
    """Positions of the nodes of a solid's face in its cell, and the face's shape.

    corners: positions of its corners, round it.
    """
    shape, found = SHAPES[OF_CELLS[kind]], list(corners)
    if shape.nodes.shape[0] > 8:  # the middle of each side
        for one, other in zip(corners, [*corners[1:], corners[0]], strict=True):
            middle = shape.nodes[[one, other]].mean(axis=0)
            found.append(int(np.flatnonzero((shape.nodes == middle).all(axis=1))[0]))
    names = {3: "S3", 4: "S4", 6: "S6", 8: "S8R"}
    return tuple(found), SHAPES[names[len(found)]]


def nearest_on_faces(shape: ElementShape, corners: Floats, places: Floats) -> tuple[Floats, Floats]:
    """Shape functions (n, n_nodes) at the point of each face nearest to a place, and the distance.

    corners: (n, n_nodes, 3), of triangles or quadrilaterals; places: (n, 3). By Gauss and Newton
    within the face.
    """
    inverse = np.linalg.inv(_monomials(shape.exponents, shape.nodes))
    at = np.full((len(places), 2), 1.0 / 3.0 if shape.simplex else 0.0)
    for _ in range(NEAREST_STEPS):
        away = places - _on(shape, at, inverse, corners)
        tangents = np.stack(
            [
                np.einsum("mn,mnk->mk", _slopes(shape.exponents, at, axis) @ inverse, corners)
                for axis in (0, 1)
            ],
            axis=2,
        )
        step = np.linalg.solve(
            np.einsum("mka,mkb->mab", tangents, tangents),
            np.einsum("mka,mk->ma", tangents, away)[..., None],
        )[..., 0]
        at = at + step
        if shape.simplex:
            at = at - np.maximum(at.sum(axis=1, keepdims=True) - 1.0, 0.0) / 2.0
            at = np.clip(at, 0.0, 1.0)
            at = at / np.maximum(at.sum(axis=1, keepdims=True), 1.0)
        else:
            at = np.clip(at, -1.0, 1.0)
    values = _monomials(shape.exponents, at) @ inverse
    return values, np.linalg.norm(places - _on(shape, at, inverse, corners), axis=1)


def _on(shape: ElementShape, at: Floats, inverse: Floats, corners: Floats) -> Floats:
    """Places (n, 3) of faces at natural coordinates (n, 2)."""
    return np.asarray(np.einsum("mn,mnk->mk", _monomials(shape.exponents, at) @ inverse, corners))


def _monomials(exponents: Floats, at: Floats) -> Floats:
    """(n_points, n_monomials)."""
    return np.asarray(np.prod(at[:, None, :] ** exponents[None, :, :], axis=2))


def _slopes(exponents: Floats, at: Floats, axis: int) -> Floats:
    """Derivatives of the monomials along one natural coordinate, (n_points, n_monomials)."""
    lowered = exponents.copy()
    lowered[:, axis] = np.maximum(lowered[:, axis] - 1.0, 0.0)
    return np.asarray(_monomials(lowered, at) * exponents[:, axis])


def _rule(shape: ElementShape) -> tuple[Floats, Floats]:
    """Points (n, n_dim) and weights (n,); a simplex is a cube with a side drawn together."""
    places, weights = scipy.special.roots_legendre(GAUSS_POINTS)
    n_dim = shape.nodes.shape[1]
    at = np.array(list(product(places, repeat=n_dim)))
    weight = np.prod(np.array(list(product(weights, repeat=n_dim))), axis=1)
    if shape.simplex:
        unit = (at[:, : shape.simplex] + 1.0) / 2.0
        weight = weight / 2.0**shape.simplex
        rest = np.ones(at.shape[0])
        for axis in range(shape.simplex):
            at[:, axis] = unit[:, axis] * rest
            weight = weight * rest
            rest = rest - at[:, axis]
    return at, weight
