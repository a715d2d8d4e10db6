"""What a correction of a whole matrix breaks in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from modetune.core.modes import Floats

#: Eigenvalues and couplings below this part of the largest, an unknown, are rounding.
ROUNDING = 1e-13


@dataclass(frozen=True, slots=True)
class MatrixDamage:
    """What a change breaks in one matrix, each entry by the roots of its diagonal ones, so that
    units do not count.

    size: of the change over that of the matrix; couplings: entries that were zero and are not;
    outside: the part of the change's size at entries that were zero; unmeasured: that at rows or
    columns that no sensor sees; negative: negative eigenvalues that it brought.
    """

    matrix: str
    size: float
    couplings: int
    outside: float
    unmeasured: float
    negative: int


def damage_of(
    name: str, before: sparse.csr_array, change: Floats, watched: sparse.csr_array
) -> MatrixDamage:
    """What a change (n, n) breaks in a matrix."""
    matrix: Floats = before.toarray()
    diagonal = np.abs(np.diag(matrix))
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, diagonal[diagonal > 0.0].mean()))
    whole, added = matrix * np.outer(scale, scale), change * np.outer(scale, scale)
    new = (matrix == 0.0) & (np.abs(added) > ROUNDING * np.abs(whole).max())
    unseen = np.ones(matrix.shape[0], dtype=np.bool_)
    unseen[watched.indices] = False
    size = float(np.linalg.norm(added))
    part = size or 1.0
    return MatrixDamage(
        matrix=name,
        size=size / float(np.linalg.norm(whole)),
        couplings=int(new.sum()),
        outside=float(np.linalg.norm(added[new])) / part,
        unmeasured=float(np.linalg.norm(added[unseen[:, None] | unseen])) / part,
        negative=_negative(np.asarray(whole + added)) - _negative(whole),
    )


def _negative(matrix: Floats) -> int:
    """Eigenvalues below zero by more than rounding (n eps of the largest, and sums of it)."""
    values = np.linalg.eigvalsh(matrix)
    return int((values < -ROUNDING * values.size * np.abs(values).max()).sum())
