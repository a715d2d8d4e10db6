"""Unit translations and rotations of a model at the equations of its stored matrices."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from modetune.core.algebra.matrices import MatrixResult
from modetune.core.correlation.correlation import rigid_body_shapes
from modetune.core.errors import ModesError
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats

#: Forces on unknowns inside of elements, over the sum of their parts: fourteen digits cancel.
NO_FORCE = 1e-8


def rigid_motions(matrices: MatrixResult, mesh: Mesh, translations: bool = False) -> Floats:
    """Unit translations and rotations about the origin at the equations of matrices, (n, 6).

    translations: those alone are right; rotations need the nodes' places. Unknowns that are inside
    of elements move with no motion of their own. Raises ModesError where an equation is at no node
    of the mesh.
    """
    nodes, components = matrices.nodes, matrices.components
    _, first = np.unique(np.stack([nodes, components]), axis=1, return_index=True)
    named = np.zeros(nodes.size, dtype=bool)
    named[first] = True  # a name stands once more where elements have unknowns of their own
    places = np.zeros((nodes.size, 3))
    elsewhere = ~np.isin(nodes, mesh.nodes)
    placeless = translations and mesh.nodes.size == 0
    if not placeless:  # matrices alone have no places
        named &= ~elsewhere
    if not placeless and named.any():
        places[named] = mesh.coordinates[mesh.rows(nodes[named])]
    rigid = np.zeros((nodes.size, 6))
    if named.any():
        rigid[named] = rigid_body_shapes(places[named], components[named])
    for node, axes in mesh.frames.items():
        for row in np.flatnonzero((nodes == node) & named).tolist():
            turns = int(components[row]) > 3
            own = np.arange(4, 7) if turns else np.arange(1, 4)
            whole = rigid_body_shapes(np.repeat(places[[row]], 3, axis=0), own)
            rigid[row] = axes[(components[row] - 1) % 3] @ whole
    if elsewhere.any() and not placeless and not _inside(matrices.stiffness[elsewhere], rigid):
        raise ModesError(
            "mass properties: equations of the stored matrices are at no node of the model "
            "(shells and beams that the solver expands), so its rigid motions are not known "
            "there; they require solids, or a solver whose equations are at nodes"
        )
    return rigid


def _inside(stiffness: sparse.csr_array, rigid: Floats) -> bool:
    """Whether unknowns at no node (their rows of the stiffness) are inside of elements: each is
    joined to equations at nodes, whose translations put no force on it."""
    forces = np.abs(stiffness @ rigid[:, :3])
    joined = abs(stiffness) @ np.abs(rigid[:, :3])
    return bool(
        joined.any(axis=1).all() and (forces <= NO_FORCE * joined.max(axis=1)[:, None]).all()
    )
