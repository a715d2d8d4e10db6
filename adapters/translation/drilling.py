"""The rotation of flat shells about their normal, where something else hangs on it.

A shell has no stiffness against it; Nastran gives it a little (K6ROT) or takes it out (AUTOSPC). A
mass, a beam or a rigid element on a shell node would turn freely. Here that rotation is the mean
rotation of the shell's surroundings: theta n = sum (n x r_i) u_i / sum |n x r_i|^2 over the nodes
of the adjacent elements, which is exact for rigid motion and stiffens nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from modetune.adapters.translation.freedoms import Form, Freedoms, difference
from modetune.adapters.translation.shells import KINDS, Edges, edges_of, material_axes
from modetune.core.modes import Floats

#: Shells whose normals are nearer than this (cosine, 5 degrees) hold no rotation about them.
FLAT = 0.9962
#: Lever arms below this share of the model's size hold nothing.
HELD = 1e-5


def hold_drilling(bulk: Any, freedoms: Freedoms, edges: Edges) -> None:
    """Tie the drilling rotation of all shell nodes that carry rotations; after all else."""
    around = _shells_around(bulk, freedoms.builder.knots, edges)
    for node, elements in around.items():
        normals = [_normal(element) for element in elements]
        rotations = freedoms.rotations(node)
        held = all(freedoms.is_dependent(f) or freedoms.builder.is_fixed(*f) for f in rotations)
        flat = all(abs(float(normal @ normals[0])) > FLAT for normal in normals)
        if not held and flat and not _is_held(freedoms, node, normals[0]):
            near = {n for element in elements for n in element.node_ids if n} - {node}
            form = _mean_rotation(freedoms, node, normals[0], near)
            own = freedoms.along(rotations, normals[0])
            freedoms.tie([difference(own, form)], rotations, f"rotation of {node} in its plane")


def _shells_around(bulk: Any, knots: set[int], edges: Edges) -> dict[int, list[Any]]:
    """The shells at each node; those of a midside node have both its corners."""
    around: dict[int, list[Any]] = {}
    for element in bulk.elements.values():
        if element.type in KINDS:
            # An element that was refused has left no middles.
            middles = [edges.middles[edge] for edge in edges_of(element) if edge in edges.middles]
            nodes = [*element.node_ids, *middles]
            for node in knots.intersection(nodes):
                around.setdefault(node, []).append(element)
    return around


def _normal(element: Any) -> Floats:
    return material_axes(element, [])[1]


def _is_held(freedoms: Freedoms, node: int, axis: Floats) -> bool:
    found = np.abs(freedoms.holds(node) @ axis)
    return bool((found > HELD * freedoms.builder.size).any())


def _mean_rotation(freedoms: Freedoms, node: int, normal: Floats, near: set[int]) -> Form:
    centre = freedoms.builder.coordinates[node]
    form: Form = {}
    total = 0.0
    for other in near:
        arm = np.cross(normal, freedoms.builder.coordinates[other] - centre)
        total += float(arm @ arm)
        places = (*freedoms.translations(other), *freedoms.translations(node))
        for (at, component), factor in zip(places, (*arm, *-arm), strict=True):
            form[(at, component)] = form.get((at, component), 0.0) + float(factor)
    return {freedom: factor / total for freedom, factor in form.items() if factor}


def hold_leaders(freedoms: Freedoms, leaders: set[int]) -> None:
    """Fix what no element hinders of the rotations of rigid elements' independent points.

    As AUTOSPC does; leaders: those without shells and without beams or springs on rotations.
    """
    for node in leaders:
        rotations = freedoms.rotations(node)
        if all(freedoms.is_dependent(f) or freedoms.builder.is_fixed(*f) for f in rotations):
            continue
        holds = freedoms.holds(node)
        _, sizes, axes = np.linalg.svd(np.vstack([holds, np.zeros((3, 3))]))
        free = axes[sizes < HELD * freedoms.builder.size]
        rows = [freedoms.along(rotations, axis) for axis in free]
        freedoms.tie(rows, rotations, f"rotation of {node}")
