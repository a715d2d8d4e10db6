"""Modes by the factors of a similar matrix, with products of the model's own.

A factorisation of 10^6 equations takes as long as hundreds of solved columns. There the factors
of an earlier model do as well, as long as it is near (`block_davidson`): K and M new, the inverse
old. Residuals are held to the same bound; where their fall over the first blocks says that a
factorisation is the shorter way, that is gone from where they are. Where nothing is
counted, random vectors beside the start shapes stay in the block to the end and turn to the lowest
of what the others lack, and a mode among the lowest has to converge like the rest. A count then
takes the one factorisation, just below the last eigenvalue.

Factors in single precision (core/algebra/factor_room) are those of a similar matrix too, some 6e-8
of K away. They take half the memory, and modes come from them in the same way as from an earlier
model's, with products in double precision, from random vectors on where nothing is known.
"""

from __future__ import annotations

import logging

import numpy as np

from modetune.core.algebra.krylov import DAVIDSON, GUARD, RitzPairs, block_davidson
from modetune.core.algebra.pencil import Pencil, singular_together, triangle_product
from modetune.core.algebra.solved_modes import TOLERANCE, SolvedModes
from modetune.core.errors import SolverExhausted
from modetune.core.modes import Floats

logger = logging.getLogger(__name__)

#: Blocks with an earlier model's factors: fewer are too few to try, more never came to an end.
LEAST_BLOCKS, MOST_BLOCKS = 3, 8
#: The same with factors in single precision, for which there are no others.
SINGLE_BLOCKS = 30
#: Solved columns that a column of such a block costs, with its products and its part of the basis,
#: and that a mode costs with factors of its own (three blocks, the later ones smaller).
BLOCK_COLUMN, KRYLOV_MODE = 2.5, 4.5


def similar_vectors(n_modes: int) -> int:
    """Vectors beside the factors of a similar matrix."""
    return DAVIDSON * (n_modes + GUARD)


def blocks_worth(factorisation_columns: float, n_modes: int) -> int:
    """How many blocks with an earlier model's factors cost no more than new ones; 0 if too few.

    factorisation_columns: solved columns that take as long as a factorisation.
    """
    columns = factorisation_columns + KRYLOV_MODE * n_modes
    blocks = int(columns / (BLOCK_COLUMN * (n_modes + GUARD)))
    return min(blocks, MOST_BLOCKS) if blocks >= LEAST_BLOCKS else 0


def pairs_by_similar(
    pencil: Pencil, n_modes: int, shift: float, start: Floats, blocks: int
) -> RitzPairs | None:
    """By the factors at hand, from start (n, n_start) and random vectors; as `block_davidson`."""

    def mass(block: Floats) -> Floats:
        return triangle_product(pencil.mass, block)

    def shifted(block: Floats, out: Floats) -> None:
        pencil.shifted(block, shift, out)

    n_random = max(n_modes - start.shape[1], 0) + GUARD
    return block_davidson(
        pencil.inverse,
        shifted,
        mass,
        start,
        n_modes,
        TOLERANCE,
        blocks,
        n_random,
        pencil.room_for,
    )


def similar_modes(pairs: RitzPairs, n_modes: int, shift: float, way: str) -> SolvedModes:
    """The first modes of such pairs."""
    values, shapes = 1.0 / pairs.inverted[:n_modes] + shift, pairs.vectors[:, :n_modes]
    residuals = pairs.residuals[:n_modes]
    return SolvedModes(values, shapes, residuals, shift, way, False, pairs.solutions)


def modes_in_single_precision(
    pencil: Pencil, n_modes: int, shift: float, start: Floats | None
) -> SolvedModes:
    """By this model's factors in single precision, made at the shift; start: (n, n_start).

    Raises ModelError where K and M are singular together, SolverExhausted where it is in vain.
    """
    if not pencil.is_invertible():
        raise singular_together(pencil)
    shapes = np.zeros((pencil.n, 0)) if start is None else start
    pairs = pairs_by_similar(pencil, n_modes, shift, shapes, SINGLE_BLOCKS)
    if pairs is None or not pairs.converged:
        largest = np.inf if pairs is None else float(pairs.residuals[:n_modes].max())
        raise SolverExhausted(
            f"{n_modes} modes of {pencil.n} equations were not found with factors in single "
            f"precision: the largest residual is {largest:.1e}; take factors in double "
            "precision, which need up to twice the memory, or take that of the disk"
        )
    solved = similar_modes(pairs, n_modes, shift, "single precision")
    bounds = solved.residuals * np.abs(1.0 - shift / solved.eigenvalues)
    logger.info(
        "%d modes of %d equations with factors in single precision: residuals at most %.1e, "
        "eigenvalues within %.1e of their own size, and a mode that random vectors lack is not "
        "counted",
        n_modes,
        pencil.n,
        float(solved.residuals.max()),
        float(bounds[solved.eigenvalues > -shift].max(initial=0.0)),
    )
    return solved
