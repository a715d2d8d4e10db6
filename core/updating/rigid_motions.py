"""Unit translations and rotations R of a model at the equations of its stored matrices.

Where equations are displacements of nodes, R follows from their places. Where elements are
expanded to new nodes (shells and beams of ccx), the nodes of the mesh are sums W u of
equations, and R is the motion without strain that these have: the least of u^T K u with W u =
R_nodes. It is found from the augmented matrix, whatever soft springs to the ground add to K:

    (K + s W^T W) u_k = W^T (s R_nodes + l_k),        l_k+1 = l_k + s (R_nodes - W u_k).

Such an R follows parameters that move the expanded nodes, as thickness does: K R = 0 gives
K dR = -dK R with W dR = 0, which is solved alike.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.algebra.factorisation import Factorisation, factorise
from modetune.core.algebra.matrices import MatrixResult, upper_product
from modetune.core.correlation.correlation import rigid_body_shapes
from modetune.core.errors import ModelError, ModesError
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats, Integers
from modetune.core.updating.observation import Observation

Observe = Callable[[MatrixResult, Integers, Integers], Observation]
#: Forces on unknowns inside of elements, over the sum of their parts: fourteen digits cancel.
NO_FORCE = 1e-8
#: Motions of nodes are met to this share of the largest, in at most this many steps: each is better
#: by the stiffness to the ground over that of the elements.
MET, STEPS = 1e-11, 60


@dataclass(frozen=True, slots=True)
class RigidMotions:
    """shapes: R, (n_equations, 6); factors, rows: of K + s W^T W and W where R was solved for."""

    shapes: Floats
    factors: Factorisation | None = None
    rows: sparse.csr_array | None = None
    scale: float = 0.0

    def change(self, stiffness: sparse.csr_array) -> Floats:
        """dR, (n_equations, 6), by the upper triangle of dK. Raises ModesError."""
        if self.factors is None or self.rows is None or not stiffness.nnz:
            return np.zeros_like(self.shapes)
        forces = -upper_product(stiffness, self.shapes)
        still = np.zeros((self.rows.shape[0], 6))
        return _motion(self.factors, self.rows, self.scale, still, forces)


def rigid_motions(
    matrices: MatrixResult, mesh: Mesh, translations: bool = False, observe: Observe | None = None
) -> RigidMotions:
    """Unit translations and rotations about the origin at the equations of matrices.

    translations: those alone are right; rotations need the nodes' places. observe: degrees of
    freedom in terms of the equations; these are at the nodes themselves where it is left out.
    Unknowns inside elements follow their nodes. Raises ModesError if the motions of some equations
    are unknown.
    """
    nodes, components = matrices.nodes, matrices.components
    _, first = np.unique(np.stack([nodes, components]), axis=1, return_index=True)
    named = np.zeros(nodes.size, dtype=bool)
    named[first] = True  # a name occurs twice if elements have unknowns beyond the nodes
    rigid = np.zeros((nodes.size, 6))
    if translations and mesh.nodes.size == 0:  # matrices alone have no places
        rigid[named] = rigid_body_shapes(np.zeros((named.sum(), 3)), components[named])
        return RigidMotions(rigid)
    named &= np.isin(nodes, mesh.nodes)
    rigid[named] = _at_nodes(mesh, nodes[named], components[named])
    if _at_nodes_alone(matrices, named, rigid, observe):
        return RigidMotions(rigid)
    if observe is None:
        raise ModesError(
            "equations of the stored matrices are at no node of the model (shells and beams that "
            "the solver expands), so its rigid motions are not known there; use a solver whose "
            "equations are at nodes (MYSTRAN)"
        )
    return _completed(matrices, mesh, observe)


def _at_nodes(mesh: Mesh, nodes: Integers, components: Integers) -> Floats:
    """R at degrees of freedom of the mesh, in the nodes' own axes, (n, 6)."""
    if not nodes.size:
        return np.zeros((0, 6))
    places = mesh.coordinates[mesh.rows(nodes)]
    rigid = rigid_body_shapes(places, components)
    for node, axes in mesh.frames.items():
        for row in np.flatnonzero(nodes == node).tolist():
            own = np.arange(4, 7) if int(components[row]) > 3 else np.arange(1, 4)
            whole = rigid_body_shapes(np.repeat(places[[row]], 3, axis=0), own)
            rigid[row] = axes[(components[row] - 1) % 3] @ whole
    return rigid


def _at_nodes_alone(
    matrices: MatrixResult, named: NDArray[np.bool_], rigid: Floats, observe: Observe | None
) -> bool:
    """Whether named equations are displacements of nodes, and all others inside of elements: each
    is joined to equations at nodes, whose translations put no force on it."""
    if observe is not None:
        seen = observe(matrices, matrices.nodes[named], matrices.components[named]).matrix
        own = sparse.csr_array(sparse.eye_array(named.size, format="csr")[np.flatnonzero(named)])
        if abs(seen - own).nnz:
            return False
    if named.all():
        return True
    others = matrices.stiffness[~named]
    forces = np.abs(others @ rigid[:, :3])
    joined = abs(others) @ np.abs(rigid[:, :3])
    return bool(
        joined.any(axis=1).all() and (forces <= NO_FORCE * joined.max(axis=1)[:, None]).all()
    )


def _completed(matrices: MatrixResult, mesh: Mesh, observe: Observe) -> RigidMotions:
    nodes, components = np.repeat(mesh.nodes, 3), np.tile([1, 2, 3], mesh.nodes.size)
    seen = observe(matrices, nodes, components)
    known = np.diff(seen.matrix.indptr) > 0
    rows = sparse.csr_array(seen.matrix[np.flatnonzero(known)])
    stiffness = matrices.stiffness
    scale = float(stiffness.diagonal().max())
    try:
        factors = factorise(sparse.csr_array(stiffness + scale * (rows.T @ rows)))
    except ModelError as error:
        raise ModesError(
            "the nodes of the model do not determine all of its rigid-body motions, as those of "
            f"one straight beam leave its roll open ({error}); use a solver whose equations are "
            "at nodes (MYSTRAN), or leave mass properties out"
        ) from error
    wanted = _at_nodes(mesh, nodes[known], components[known])
    still = np.zeros((stiffness.shape[0], 6))
    shapes = _motion(factors, rows, scale, wanted, still)
    return RigidMotions(shapes, factors, rows, scale)


def _motion(
    factors: Factorisation, rows: sparse.csr_array, scale: float, wanted: Floats, forces: Floats
) -> Floats:
    """Return u with W u = wanted (n_rows, 6) and K u = forces (n_equations, 6) outside W's rows."""
    carried = np.zeros_like(wanted)
    found = factors.solve(forces + rows.T @ (scale * wanted))
    largest = max(float(np.abs(wanted).max(initial=0.0)), float(np.abs(found).max(initial=0.0)))
    for _ in range(STEPS):
        missed = wanted - rows @ found
        if np.abs(missed).max(initial=0.0) <= MET * largest:
            return np.asarray(found)
        carried += scale * missed
        found = factors.solve(forces + rows.T @ (scale * wanted + carried))
    raise ModesError(
        "supports are too stiff to determine the structure's rigid motions; free it (on soft "
        "springs, as in the test), or leave mass properties out"
    )
