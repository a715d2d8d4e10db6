"""The largest eigenvalues of A = (K - s M)^-1 M from a block of start vectors.

A is symmetric in the inner product of M. In the space spanned by [X, A X, A^2 X, ...], with the
M-orthonormal basis Q,

    T = Q^T M A Q,   T s = theta s,   x = Q s,

gives the Rayleigh-Ritz approximations theta of 1 / (lambda - s), from below. A Q = Q T + Y with
Y in the last block only, so the residual ||A x - theta x||_M = ||Y s_last||_M costs no product.
There is an eigenvalue of A within it of each theta, and as many as there are theta together
(Kahan); with a gap to the others the error is its square over the gap. Columns of Y that add
less than the tolerance to any residual are left out of the next block, so the block becomes
smaller where start vectors are good. Source: Golub and Underwood 1977; Parlett 1998, 11.5, 13.10.

Where only P, the inverse of a similar matrix, is at hand, the next block is P r of the residuals
r = (K - s M) x - M x / theta: with the inverse itself that is A x / theta less x, and so the same
space (generalised Davidson: Morgan and Scott 1986). Its basis V is orthonormal with respect to
K - s M, which needs no mass, and theta are the eigenvalues of V^T M V. ||P r||_M / ||x||_M is then
the residual above, apart from the error of P. The basis is limited to a few blocks: without room
for the next one, the best pairs stay, and what they were one block before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh
from scipy.linalg.blas import dgemm

from modetune.core.algebra.vector_room import Room, in_memory
from modetune.core.modes import Floats

#: A product with a block (n_rows, n_columns), in Fortran order, and where to put it.
Product = Callable[[Floats, Floats], object]

#: Number of random vectors added to known shapes: they contain a little of every mode.
GUARD = 4

_ROWS_AT_ONCE = 4096  # of tall blocks that are combined in their place

#: Vectors that `block_davidson` has in memory, in pairs that it looks at: its basis, K - s M times
#: that, and one block that a product or a solution works with.
DAVIDSON = 7
_BASIS_BLOCKS = 3  # two of which stay at a restart

_DEPENDENT = 1e-14  # of a Gram matrix of unit columns: directions that are rounding
_TOLD_APART = 1e-2  # residual below which a pair beyond those wanted counts as separate
_DROPPED = 1e-2  # of the tolerance: what a column left out may add to a residual


@dataclass(frozen=True, slots=True)
class RitzPairs:
    """Approximate eigenpairs of A, theta descending.

    inverted: theta (n_pairs,). vectors: x (n_rows, n_pairs), M-orthonormal. images: A x, (n_rows,
    n_pairs). residuals: (n_pairs,), ||A x - theta x||_M / |theta|. solutions: columns that A was
    applied to. converged: whether all residuals are within the tolerance.
    """

    inverted: Floats
    vectors: Floats
    images: Floats
    residuals: Floats
    solutions: int
    converged: bool


def block_krylov(
    solve: Product,
    mass: Product,
    start: Floats,
    n_pairs: int,
    tolerance: float,
    n_blocks: int,
    *,
    least_inverted: float = 0.0,
    room_for: Room = in_memory,
) -> RitzPairs:
    """The n_pairs largest eigenvalues of A; fewer where the start vectors span less.

    solve: (K - s M)^-1 of a block, mass: M of a block; start: (n_rows, n_start), in Fortran
    order, written over; tolerance: largest relative
    residual; n_blocks: number of blocks after which to stop. It continues, though residuals are
    small, until the last theta is above least_inverted: a pair that start vectors lack needs a few
    blocks to show. room_for: where the basis is.
    """
    room = start.shape[1] * n_blocks
    # Large blocks are made once: first touches of memory cost as much as the products.
    q, mq = (room_for(start.shape[0], room) for _ in range(2))
    y, my = start, np.empty_like(start, order="F")
    mass(y, my)
    t = np.zeros((room, room))
    used, cutoff, invariant, converged = 0, 0.0, False, False
    inverted, ritz, residuals = np.zeros(0), np.zeros((0, 0)), np.zeros(0)
    block = slice(0, 0)
    for _ in range(n_blocks):
        new = _append_orthonormal(y, my, q, mq, used, cutoff)
        invariant = new == 0
        if invariant:  # what the space holds is exact
            break
        block = slice(used, used + new)
        used = block.stop
        y, my = y[:, :new], my[:, :new]
        solve(mq[:, block], y)
        for _ in range(2):  # the second pass takes what rounding left of the first
            part = mq[:, :used].T @ y
            _subtract(y, q[:, :used], part)
            t[:used, block] += part
        t[block, : block.start] = t[: block.start, block].T
        mass(y, my)
        small = 0.5 * (t[:used, :used] + t[:used, :used].T)
        inverted, ritz, residuals = _ritz_pairs(small, block, y.T @ my)
        converged = used >= n_pairs and bool(
            (residuals[:n_pairs] <= tolerance).all() and inverted[n_pairs - 1] > least_inverted
        )
        if converged:
            break
        cutoff = _DROPPED * tolerance * float(inverted[min(n_pairs, used) - 1])
    ritz, inverted = np.asfortranarray(ritz[:, :n_pairs]), inverted[:n_pairs]
    residuals = np.zeros_like(inverted) if invariant else residuals[:n_pairs]
    vectors = dgemm(1.0, q[:, :used], ritz)
    images = vectors * inverted
    if not invariant:
        _subtract(images, y, -ritz[block])
    converged = converged or (invariant and used >= n_pairs and inverted[-1] > least_inverted)
    return RitzPairs(inverted, vectors, images, residuals, used, bool(converged))


def block_davidson(
    nearly: Product,
    shifted: Product,
    mass: Callable[[Floats], Floats],
    start: Floats,
    n_pairs: int,
    tolerance: float,
    n_blocks: int,
    n_random: int,
    room_for: Room = in_memory,
) -> RitzPairs | None:
    """The n_pairs largest eigenvalues of A by the inverse of a similar matrix.

    nearly: P of a block (n, n_columns); shifted: K - s M of it; mass: M of it; start: (n, n_start);
    n_random: additional random columns, more than n_pairs in all; n_blocks: number of blocks after
    which to stop, or earlier if residuals fall too slowly. It continues until the pair next to
    those wanted is accurate enough to be none of them. It returns as many pairs as start and random
    have columns, without images, for the next solution; None if K - s M is
    not positive. room_for: where the basis and its images are. There and in memory are DAVIDSON
    vectors (n,) a pair, one of them in memory: blocks are made in their place in the basis.
    """
    known = start.shape[1]
    new = width = known + n_random
    room = width * min(n_blocks + 1, _BASIS_BLOCKS)
    v, sv = (room_for(start.shape[0], room) for _ in range(2))
    v[:, :new] = with_random(start, n_random)
    nearly(mass(v[:, known:new]), v[:, known:new])
    t = np.zeros((room, room))
    slow, used, solutions, before, residuals = 0, 0, n_random, np.inf, np.full(width, np.inf)
    ritz, last = np.zeros((0, 0)), np.zeros((0, 0))
    for left in range(n_blocks, -1, -1):
        w, sw = v[:, used : used + new], sv[:, used : used + new]
        shifted(w, sw)
        part = sv[:, :used].T @ w
        _subtract(w, v[:, :used], part)
        _subtract(sw, sv[:, :used], part)
        block = slice(used, used + _append_orthonormal(w, sw, v, sv, used, 0.0))
        used = block.stop
        t[:used, block] = v[:, :used].T @ mass(v[:, block])
        t[block, : block.start] = t[: block.start, block].T
        theta, found = eigh(0.5 * (t[:used, :used] + t[:used, :used].T))
        theta, found = theta[: -width - 1 : -1], np.asfortranarray(found[:, : -width - 1 : -1])
        if theta.size <= n_pairs or not theta[-1] > 0.0:
            return None
        last, ritz = ritz, found
        worst, beside = float(residuals[:n_pairs].max()), theta[n_pairs - 1] / theta[n_pairs] - 1.0
        converged = worst <= tolerance and residuals[n_pairs] <= max(beside, _TOLD_APART)
        # At the rate of the last two blocks the residuals are too large after the last one there
        # is. A mode that the start lacked lifts them once.
        falls = worst / tolerance * (worst / before) ** left
        slow = slow + 1 if worst < before and falls > 1.0 else 0
        if converged or left == 0 or slow == 2:
            x = dgemm(1.0, v[:, :used], ritz / np.sqrt(theta))
            return RitzPairs(theta, x, x, residuals, solutions, bool(converged))
        if used + theta.size > room:
            used, ritz = _restart(v, sv, t, used, ritz, last)
        w, r = (vectors[:, used : used + theta.size] for vectors in (v, sv))
        _force_residuals(v[:, :used], sv[:, :used], ritz, theta, mass, r)
        nearly(r, w)
        solutions += theta.size
        squares = np.array([x @ mass(x) for x in w.T]) / theta
        before, residuals = worst, np.sqrt(np.maximum(squares, 0.0))
        going_on = np.flatnonzero(residuals > _DROPPED * tolerance)
        new = going_on.size
        for place, own in enumerate(going_on):
            w[:, place] = w[:, own]
    raise AssertionError("the last block ends it")


def _force_residuals(
    v: Floats,
    sv: Floats,
    ritz: Floats,
    theta: Floats,
    mass: Callable[[Floats], Floats],
    out: Floats,
) -> None:
    """(K - s M) x - M x / theta of the pairs x = v ritz, put into out; sv: K - s M times v."""
    out[...] = 0.0
    _subtract(out, sv, -ritz)
    x = dgemm(1.0, v, ritz / theta)
    for pair in range(theta.size):  # M x of all would be another block as large as any here
        out[:, pair] -= mass(x[:, pair])


def _restart(
    v: Floats, sv: Floats, t: Floats, used: int, ritz: Floats, last: Floats
) -> tuple[int, Floats]:
    """Keep of a basis the pairs and what they were a block ago, as LOBPCG does, in its place.

    ritz (used, width), last: both in the basis, last's on its first vectors. Returns how many
    vectors there are now and the pairs in them. Source: Stathopoulos and Saad 1998; Knyazev 2001.
    """
    before = np.pad(last, ((0, used - last.shape[0]), (0, 0)))
    kept = np.asfortranarray(np.linalg.qr(np.hstack([ritz, before]))[0])
    size = kept.shape[1]
    for vectors in (v, sv):
        _combined(vectors[:, :used], kept, vectors)
    t[:size, :size] = kept.T @ t[:used, :used] @ kept
    return size, np.asfortranarray(kept.T @ ritz)


def with_random(shapes: Floats, count: int, turn: int = 0) -> Floats:
    """Return shapes (n_rows, n_shapes) followed by `count` random columns.

    They are the same each time, and others for another turn.
    """
    block = np.empty((shapes.shape[0], shapes.shape[1] + count), order="F")
    block[:, : shapes.shape[1]] = shapes
    random = np.random.default_rng(2 + turn)
    block[:, shapes.shape[1] :] = random.standard_normal((len(block), count))
    return block


def unit_combinations(gram: Floats, cutoff: float) -> Floats:
    """F with F^T gram F = 1, (n_columns, n_kept), of a Gram matrix (n_columns, n_columns).

    Columns not longer than the cutoff, and directions that are rounding, are left out.
    """
    lengths = np.sqrt(np.maximum(np.diag(gram), 0.0))
    kept = np.flatnonzero(lengths > cutoff)
    if kept.size == 0:
        return np.zeros((gram.shape[0], 0), order="F")
    scale = 1.0 / lengths[kept]
    squares, turned = eigh(gram[np.ix_(kept, kept)] * scale[:, None] * scale)
    own = squares > _DEPENDENT * max(float(squares[-1]), 1.0)
    factor = np.zeros((gram.shape[0], int(own.sum())), order="F")
    factor[kept] = scale[:, None] * turned[:, own] / np.sqrt(squares[own])
    return factor


def _ritz_pairs(small: Floats, block: slice, gram: Floats) -> tuple[Floats, Floats, Floats]:
    inverted, ritz = eigh(small)
    inverted, ritz = inverted[::-1], ritz[:, ::-1]
    last = ritz[block]
    squares = np.sum(last * (gram @ last), axis=0)
    scale = np.maximum(np.abs(inverted), np.finfo(np.float64).tiny)
    return inverted, ritz, np.sqrt(np.maximum(squares, 0.0)) / scale


def _append_orthonormal(
    y: Floats, my: Floats, q: Floats, mq: Floats, used: int, cutoff: float
) -> int:
    """An M-orthonormal basis of y without what q has of it, put behind q, and M times it.

    y, my are written over. Returns how many columns are new.
    """
    factor = unit_combinations(y.T @ my, cutoff)
    y, my = _combined(y, factor, y), _combined(my, factor, my)
    # To unit length rounding has grown too: what it has of q, M times which is known, goes.
    part = mq[:, :used].T @ y
    _subtract(y, q[:, :used], part)
    _subtract(my, mq[:, :used], part)
    # Half: a direction that lies mostly in q is not independent.
    factor = unit_combinations(y.T @ my, 0.5)
    _combined(y, factor, q[:, used:])
    _combined(my, factor, mq[:, used:])
    return factor.shape[1]


def _combined(block: Floats, factor: Floats, out: Floats) -> Floats:
    """block factor in the first columns of out, which may be block itself."""
    into = out[:, : factor.shape[1]]
    for start in range(0, block.shape[0], _ROWS_AT_ONCE):
        rows = slice(start, start + _ROWS_AT_ONCE)
        into[rows] = block[rows] @ factor
    return into


def _subtract(y: Floats, q: Floats, part: Floats) -> None:
    """q part off y, in the place of y."""
    if q.shape[1] and y.shape[1]:
        done = dgemm(-1.0, q, part, beta=1.0, c=y, overwrite_c=1)
        assert done is y or np.shares_memory(done, y)
