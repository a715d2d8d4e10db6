"""Where a pencil K - s M is factorised: below its spectrum, but not far.

A negative shift s makes K - s M positive definite even where K is singular, as a free
structure's is. It should be of the size of the first elastic eigenvalue: much closer to zero it
drowns the elastic modes of a free structure in the rigid ones, much farther away the modes crowd
together seen from it. Where the caller does not know that eigenvalue it is estimated: with a
shift just far enough below zero to be told from rounding, by two steps from random vectors.
"""

from __future__ import annotations

import numpy as np

from modetune.core.errors import ModelError
from modetune.core.krylov import RitzPairs, block_krylov
from modetune.core.modes import Floats
from modetune.core.pencil import Pencil

#: A shift of this share of the largest eigenvalue can be told from rounding.
LEAST_SHIFT = 1e-10
#: Eigenvalues of this many least shifts are not those of rigid motion.
STRAINED = 10.0
#: Shapes in the estimate of the first elastic eigenvalue: six rigid ones and some to spare.
BLOCK = 10
#: Eigenvalues are known to this share of the largest one, rigid ones for example.
ROUNDING = 1e-15


def estimate_shift(pencil: Pencil) -> float:
    """A shift below the spectrum, a tenth of about the first elastic eigenvalue, (rad/s)^2.

    Raises ModelError where the matrices are singular together. Source: Bathe 2014, 11.6
    (subspace iteration), 11.2.3 (shifts for free structures).
    """
    least = -LEAST_SHIFT * pencil.largest_eigenvalue()
    least = factorise_below(pencil, least)
    if not pencil.is_invertible():
        raise singular_together(pencil)
    start = with_random(np.zeros((pencil.n_with_mass, 0)), min(BLOCK, pencil.n_with_mass))
    pairs = largest_pairs(pencil, start, BLOCK, 0.0, 2)
    eigenvalues = 1.0 / np.maximum(pairs.inverted, 1e-300) + least
    elastic = eigenvalues[eigenvalues > -STRAINED * least]  # parts may move rigidly by themselves
    first = float(elastic[0] if elastic.size else abs(eigenvalues[-1]))
    return min(-0.1 * first, least)


def largest_pairs(
    pencil: Pencil,
    start: Floats,
    n_pairs: int,
    tolerance: float,
    n_blocks: int,
    *,
    least_inverted: float = 0.0,
) -> RitzPairs:
    """block_krylov of a factorised pencil; start: (n_with_mass, n_start), written over."""
    return block_krylov(
        pencil.apply_inside,
        pencil.inertia,
        start,
        n_pairs,
        tolerance,
        n_blocks,
        least_inverted=least_inverted,
    )


def factorise_below(pencil: Pencil, shift: float) -> float:
    """Factorise at the shift, or at a lower one where there are eigenvalues below it.

    shift: (rad/s)^2, negative. Returns the shift taken. Raises ModelError where stiffness and
    mass are singular together, or there are eigenvalues below any shift.
    """
    lowest = -1e3 * pencil.largest_eigenvalue()
    pencil.factorise(shift)
    while pencil.below > 0:
        if shift < lowest:
            raise ModelError(
                f"there are {pencil.below} eigenvalues below any that the stiffness could have: "
                "the mass matrix has negative eigenvalues, or an unknown without mass has "
                "negative stiffness"
            )
        shift *= 4.0
        pencil.factorise(shift)
    if pencil.below < 0:
        raise singular_together(pencil)
    return shift


def count_below(pencil: Pencil, eigenvalue: float, margin: float) -> tuple[float, int]:
    """A number beside an eigenvalue, and how many eigenvalues are below that number.

    margin: how far beside it, (rad/s)^2, negative for below; somewhat farther where a pivot is as
    good as zero there by chance. The count is -1 where that is so at each place tried. Leaves the
    pencil factorised there.
    """
    beside = eigenvalue
    for share in (1.0, 3.0, 10.0):
        beside = eigenvalue + share * margin
        pencil.factorise(beside)
        if pencil.below >= 0:
            break
    return beside, pencil.below


def singular_together(pencil: Pencil) -> ModelError:
    """The error to raise where K - s M has no inverse at any s."""
    return ModelError(
        f"stiffness and mass of {pencil.n} unknowns are singular together: an unknown has neither, "
        "or a mechanism without mass moves freely"
    )


def with_random(shapes: Floats, count: int, turn: int = 0) -> Floats:
    """Shapes (n_rows, n_shapes) and beside them `count` random columns.

    They are the same each time, and others for another turn.
    """
    block = np.empty((shapes.shape[0], shapes.shape[1] + count), order="F")
    block[:, : shapes.shape[1]] = shapes
    random = np.random.default_rng(2 + turn)
    block[:, shapes.shape[1] :] = random.standard_normal((len(block), count))
    return block
