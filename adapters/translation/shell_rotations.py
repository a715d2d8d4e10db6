"""Rotations of shell nodes that no shell holds.

A shell has no stiffness against rotation about its normal; Nastran gives it a little (K6ROT) or
takes it out (AUTOSPC). A mass, a beam or a rigid element on a shell node would turn freely. Here
that rotation is that of the shell's surroundings: theta n = sum (J^-1 n x r_i) u_i with J = sum
(r_i^2 I - r_i r_i) over the nodes of the adjacent elements, the rotation that fits their
displacements best, which is exact for rigid motion and stiffens nothing.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modetune.adapters.translation.freedoms import Form, Freedoms, difference, total, trimmed
from modetune.adapters.translation.shells import Edges, Shell
from modetune.core.modes import Floats

#: Shells whose normals are nearer than this (cosine, 5 degrees) hold no rotation about them.
FLAT = 0.9962
#: Normals nearer than this are those of one plane.
SAME_PLANE = 1.0 - 1e-10
#: Lever arms below this share of the model's size hold nothing.
HELD = 1e-5


def hold_rest(
    shells: Sequence[Shell],
    edges: Edges,
    freedoms: Freedoms,
    turned: frozenset[int],
    held: set[int],
) -> None:
    """Hold what the shells leave free; turned: nodes where anything but shells has rotations."""
    around: dict[int, list[int]] = {}
    for place, shell in enumerate(shells):
        for node in shell.nodes:
            around.setdefault(node, []).append(place)
    middles = {middle: edge for edge, middle in edges.middles.items() if middle in edges.made}
    normals = np.array([shell.normal for shell in shells])
    near = np.concatenate([np.array(places) for places in around.values()])
    starts = np.cumsum([0, *(len(places) for places in around.values())])[:-1]
    firsts = np.repeat(near[starts], np.diff([*starts, len(near)]))
    cosines = np.abs(np.einsum("ni,ni->n", normals[near], normals[firsts]))
    least = dict(zip(around, np.minimum.reduceat(cosines, starts).tolist(), strict=True))
    axes: dict[int, Floats] = {}
    for node, places in around.items():
        if least[node] > FLAT and any(shells[place].law.bends for place in places):
            axis = shells[places[0]].normal
            own = freedoms.along(freedoms.rotations(node), axis)
            if _is_loose(freedoms, own) and not _is_held(freedoms, node, axis):
                axes[node] = axis
    mean = [node for node in axes if node in turned or least[node] <= SAME_PLANE]
    others = {node: {n for p in around[node] for n in shells[p].nodes} - {node} for node in mean}
    forms = _mean_rotations(freedoms, others, axes)
    for node, places in around.items():
        if node in axes:
            rotations = freedoms.rotations(node)
            row = difference(freedoms.along(rotations, axes[node]), forms.get(node, {}))
            freedoms.tie([row], rotations, f"rotation of {node} in its plane")
        if node not in held and least[node] > FLAT:
            _hold_loose(freedoms, node, [shells[p] for p in places], middles.get(node, ()))


def _hold_loose(
    freedoms: Freedoms, node: int, near: Sequence[Shell], ends: tuple[int, ...]
) -> None:
    """Hold the directions in which shells of one plane have no stiffness, as AUTOSPC does.

    ends: the corners beside a midside node, which moves as their mean does there.
    """
    axes = []
    if not any(shell.law.stretches for shell in near):
        axes += [near[0].axis, np.cross(near[0].normal, near[0].axis)]
    if not any(shell.law.bends for shell in near):
        axes += [near[0].normal]
    for axis in axes:
        own = freedoms.along(freedoms.translations(node), axis)
        if _is_loose(freedoms, own):
            mean = [freedoms.along(freedoms.translations(end), 0.5 * axis) for end in ends]
            form = difference(own, total(mean))
            freedoms.tie([form], list(own), f"displacement of {node} across its shells")


def _is_loose(freedoms: Freedoms, form: Form) -> bool:
    """Whether some freedom of the form is neither fixed nor dependent."""
    return any(not freedoms.is_dependent(f) and not freedoms.builder.is_fixed(*f) for f in form)


def _is_held(freedoms: Freedoms, node: int, axis: Floats) -> bool:
    found = np.abs(freedoms.holds(node) @ axis)
    return bool((found > HELD * freedoms.builder.size).any())


def _mean_rotations(
    freedoms: Freedoms, near: dict[int, set[int]], axes: dict[int, Floats]
) -> dict[int, Form]:
    """Of nodes, the rotations about axes that fit the displacements of the nodes near best."""
    if not near:
        return {}
    coordinates = freedoms.builder.coordinates
    others = [sorted(nodes) for nodes in near.values()]
    counts = np.array([len(nodes) for nodes in others])
    starts = np.cumsum(counts) - counts
    arms = np.array([coordinates[node] for nodes in others for node in nodes])
    arms -= np.repeat([coordinates[node] for node in near], counts, axis=0)
    outer = np.add.reduceat(np.einsum("ni,nj->nij", arms, arms), starts)
    spread = np.trace(outer, axis1=1, axis2=2)[:, None, None] * np.eye(3) - outer
    turning = np.linalg.solve(spread, np.array([axes[node] for node in near])[:, :, None])
    factors = np.cross(np.repeat(turning[:, :, 0], counts, axis=0), arms)
    own = -np.add.reduceat(factors, starts)
    forms = {}
    for node, nodes, start, last in zip(near, others, starts.tolist(), own.tolist(), strict=True):
        rows = factors[start : start + len(nodes)].ravel().tolist()
        freedoms_near = [(other, c) for other in (*nodes, node) for c in (1, 2, 3)]
        forms[node] = trimmed(dict(zip(freedoms_near, (*rows, *last), strict=True)))
    return forms


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
