"""A model whose measured motions are unknowns.

Reduction and expansion keep rows of a model. What a sensor sees need not be one: it may look along
an inclined direction, at a dependent node, or at a node whose motion is a sum of the solver's
equations (expanded shells). With u = W x what is seen, some columns p of W span it, and

    x_p = W_p^-1 (u - W_r x_r),   so   x = P y,   y_p = u,   y_r = x_r,

is another name for the same motion: P^T K P and P^T M P are the same model, and u are its rows p.
The columns are those of a QR factorisation with pivoting (Golub and Van Loan 2013, 5.4.2), so that
W_p is as well conditioned as a choice of columns allows. Where each sensor is an unknown, P is a
unit matrix.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import linalg, sparse

from modetune.core.assignment import least_cost
from modetune.core.errors import ModesError
from modetune.core.modes import Integers

#: A sensor whose part that others do not see is below this share of the largest sees nothing new.
_NEW = 1e-9


@dataclass(frozen=True, slots=True)
class MeasuredModel:
    """stiffness, mass: (n, n), on y; rows: (n_seen,), places of what is seen; back: P, (n, n)."""

    stiffness: sparse.csr_array
    mass: sparse.csr_array
    rows: Integers
    back: sparse.csr_array


def measured_model(
    stiffness: sparse.csr_array, mass: sparse.csr_array, seen: sparse.csr_array
) -> MeasuredModel:
    """The model (n, n) with the motions W x for unknowns; seen: W, (n_seen, n).

    Raises ModesError where one of them follows from the others, or moves nothing.
    """
    n, n_seen = stiffness.shape[0], seen.shape[0]
    columns = np.unique(seen.indices)
    small = seen[:, columns].toarray()
    r, order = linalg.qr(small, mode="r", pivoting=True)
    sizes = np.abs(np.diag(r)) if r.size else np.zeros(0)
    if columns.size < n_seen or sizes.min(initial=np.inf) < _NEW * sizes.max(initial=0.0):
        raise ModesError(
            f"{n_seen} measured unknowns have {int((sizes > _NEW * sizes.max(initial=0)).sum())} "
            "that do not follow from each other (two sensors in one direction at one node, or more "
            "than three there): leave out the redundant ones"
        )
    chosen, rest = order[:n_seen], order[n_seen:]
    # Each sensor takes the place of the unknown that it sees most of.
    chosen = chosen[least_cost(-np.abs(small[:, chosen]))[1]]
    own = np.linalg.inv(small[:, chosen])
    own[np.abs(own) < np.finfo(np.float64).eps * np.abs(own).max()] = 0.0
    rows = columns[chosen].astype(np.int64)
    keep = np.ones(n)
    keep[rows] = 0.0
    back = sparse.lil_array(sparse.diags_array(keep))
    for place, row in enumerate(rows.tolist()):
        back[row, rows] = own[place]
        back[row, columns[rest]] = -(own[place] @ small[:, rest])
    p = sparse.csr_array(back)
    p.eliminate_zeros()
    return MeasuredModel(
        sparse.csr_array(p.T @ stiffness @ p), sparse.csr_array(p.T @ mass @ p), rows, p
    )
