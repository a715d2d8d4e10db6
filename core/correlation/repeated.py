"""Repeated modes: shapes of one eigenvalue, of which any rotation are modes too.

A solver gives some rotation of them, a test another. Before two sets are compared, or one set is
differentiated and another used, the shapes of one are turned within their common space to lie as
the other's (orthogonal Procrustes, Schoenemann 1966). A mode alone can be turned the other way
round, which is the same with one shape. Derivatives of the turned shapes are those of Ojalvo
(1988) and Dailey (1989): out of the common space, and along it only what keeps the modal mass.
"""

from __future__ import annotations

import numpy as np

from modetune.core.correlation.pairing import Pairing
from modetune.core.modes import REPEATED, Floats, Integers, ModeSet, common_dofs

#: Singular values of the members' shapes at the sensors below this share of the largest: the
#: sensors see fewer directions than there are members.
UNSEEN = 1e-3


def repeated_modes(eigenvalues: Floats) -> list[Integers]:
    """Positions (n_members,) of each set of modes of one eigenvalue; eigenvalues ascending."""
    apart = np.diff(eigenvalues) > REPEATED * np.abs(eigenvalues[1:])
    return np.split(np.arange(eigenvalues.size, dtype=np.int64), np.flatnonzero(apart) + 1)


def rotation_onto(shapes: Floats, wanted: Floats, eigenvalues: Floats) -> Floats:
    """The rotation R (n_modes, n_modes) with which shapes @ R lie as the wanted ones.

    shapes, wanted: (n_dof, n_modes), mass-normalised modes of one model at the same degrees of
    freedom, in the same order but for the order within one eigenvalue; eigenvalues: (n_modes,).
    Only modes of one eigenvalue are mixed.
    """
    rotation = np.zeros((eigenvalues.size, eigenvalues.size))
    for members in repeated_modes(eigenvalues):
        inner = shapes[:, members].T @ wanted[:, members]
        left, _, right = np.linalg.svd(inner)
        rotation[np.ix_(members, members)] = left @ right
    return rotation


def rotation_to_test(measured: ModeSet, computed: ModeSet, pairing: Pairing) -> Floats | None:
    """The rotation of computed modes within one eigenvalue that brings them to the test's shapes.

    Measured shapes may have any scale, and be of some of the members only; the others are what is
    left of the space. None where no paired mode is repeated, or the sensors cannot tell how the
    members lie.
    """
    rows_m, rows_c = common_dofs(measured, computed)
    rotation = np.eye(computed.n_modes)
    turned = False
    for members in repeated_modes(computed.eigenvalues):
        pairs = np.flatnonzero(np.isin(pairing.computed, members))
        if members.size < 2 or not pairs.size or not rows_m.size:
            continue
        basis = np.real(computed.mode_shapes[rows_c][:, members])
        wanted = np.real(measured.mode_shapes[rows_m][:, pairing.measured[pairs]])
        own = _orthonormal(np.linalg.lstsq(basis, wanted, rcond=UNSEEN)[0])
        if own is None:
            continue
        places = np.searchsorted(members, pairing.computed[pairs])
        others = np.setdiff1d(np.arange(members.size), places)
        block = np.zeros((members.size, members.size))
        block[:, places] = own
        if others.size:
            block[:, others] = np.linalg.svd(own)[0][:, pairs.size :]
        rotation[np.ix_(members, members)] = block
        turned = True
    return rotation if turned else None


def _orthonormal(columns: Floats) -> Floats | None:
    """The orthonormal columns closest to these, each first brought to length 1; None where they
    lie in fewer directions than they are."""
    lengths = np.linalg.norm(columns, axis=0)
    if not lengths.all():
        return None
    left, values, right = np.linalg.svd(columns / lengths, full_matrices=False)
    return np.asarray(left @ right) if values[-1] > UNSEEN * values[0] else None
