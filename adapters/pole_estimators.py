"""Poles from two identification packages: sdypy-EMA for response functions, pyOMA2 for responses.

`lscf_poles`: the least-squares complex frequency estimator of sdypy-EMA fits a common-denominator
polynomial in z = exp(-i w T) with real coefficients, where T makes the last line half a turn
(Guillaume et al. 2003). All references enter one fit, since they share the denominator. Two steps
precede it:

- The band is shifted to begin at 0 Hz, so that it fills the half circle. Without the shift, powers
  of z are nearly dependent and high orders lose all digits. Poles are shifted back. The effect on
  the conjugate half is smooth in the band, and the numerator absorbs it.
- Every function is scaled to the same root mean square, so that no strong one dominates the fit.

`ssi_poles`: the covariance-driven subspace identification of pyOMA2 makes the block Hankel matrix
of output covariances, and the state matrices A and C of all orders from one decomposition (Peeters
and De Roeck 1999). A pole of order n is log(mu) / step for an eigenvalue mu of A; its shape is C
times the eigenvector. pyOMA2 changes NumPy's error state for the whole process when it is imported;
the state is restored.
"""

from __future__ import annotations

import contextlib
import io
import logging
from collections.abc import Iterator
from typing import Any

import numpy as np

from modetune.core.errors import CampaignError
from modetune.core.measurement.response_functions import Complexes
from modetune.core.modes import Floats


def lscf_poles(frequencies_hz: Floats, values: Complexes, order: int) -> tuple[Complexes, ...]:
    """Return poles of polynomials with 1, 2, ..., order pairs, all of them, rad/s.

    frequencies_hz: (n_lines,), evenly spaced; values: (n_lines, n_functions), none zero. Half
    plane of positive frequency only; computational and unstable poles included. Raises
    CampaignError where lines are uneven or too few for the order.
    """
    from sdypy import EMA

    spacing = np.diff(frequencies_hz)
    if (np.abs(spacing - spacing.mean()) > 0.01 * spacing.mean()).any():
        raise CampaignError(
            "the frequencies of the response functions are not evenly spaced, which the estimator "
            "needs: export them with a fixed resolution"
        )
    # A polynomial of 2n + 1 unknowns from 2 n_lines numbers, with as many again for the numerator.
    if order < 2 or frequencies_hz.size < 2 * order + 2:
        raise CampaignError(
            f"--order {order} does not fit {frequencies_hz.size} lines in the band: "
            f"choose 2 to {max((frequencies_hz.size - 2) // 2, 2)}"
        )
    start = float(frequencies_hz[0])
    scaled = values / np.sqrt(np.mean(np.abs(values) ** 2, axis=0))
    # The model cuts its last line off.
    lines = np.append(frequencies_hz, frequencies_hz[-1] + spacing.mean()) - start
    model = EMA.Model(
        frf=np.vstack([scaled, scaled[-1:]]).T,
        freq=lines,
        lower=0.0,
        upper=float(lines[-1]),
        pol_order_high=order,
        frf_form="receptance",
    )
    model.get_poles(method="lscf", show_progress=False)
    moved = [np.asarray(poles, dtype=np.complex128) for poles in model.all_poles]
    return tuple(poles[poles.imag > 0.0] + 2j * np.pi * start for poles in moved)


#: Poles and their shapes, (n,) and (n_channels, n).
PolesOfOrder = tuple[Complexes, Complexes]


def ssi_poles(
    values: Floats, step_s: float, order: int, block_rows: int
) -> tuple[PolesOfOrder, ...]:
    """Return poles of models with 1, 2, ..., order pairs, rad/s, conjugates and all.

    values: (n_times, n_channels), evenly sampled. Raises CampaignError where there are too few of
    them for the order; ModuleNotFoundError without pyOMA2.
    """
    n_times, n_channels = values.shape
    if n_times < 20 * block_rows or 2 * order > n_channels * (block_rows - 1):
        raise CampaignError(
            f"{n_times} samples of {n_channels} channels are too few for --order {order}: record "
            "longer, or lower it"
        )
    with _pyoma2() as ssi:
        hankel, _ = ssi.build_hank(*_scaled(values), block_rows, "cov")
        _, states, outputs, _ = ssi.SSI_fast(hankel, block_rows, 2 * order, step=2)
    both = zip(states[1:], outputs[1:], strict=True)
    return tuple(_poles_of(a, c, values.std(axis=0), step_s) for a, c in both)


def ssi_poles_of_parts(
    values: Floats, step_s: float, order: int, block_rows: int, parts: int
) -> Iterator[tuple[PolesOfOrder, ...]]:
    """Yield what `ssi_poles` returns for the recording without one of its parts, for each part.

    values: (n_times, n_channels); parts: consecutive and of one length. The Hankel matrix of the
    rest is the mean of those of the other parts. Raises ModuleNotFoundError without pyOMA2.
    """
    length = values.shape[0] // parts
    scaled, _ = _scaled(values)
    with _pyoma2() as ssi:
        pieces = (scaled[:, part * length : (part + 1) * length] for part in range(parts))
        hankels = [ssi.build_hank(piece, piece, block_rows, "cov")[0] for piece in pieces]
        total = np.sum(hankels, axis=0)
        for hankel in hankels:
            rest = (total - hankel) / (parts - 1)
            _, states, outputs, _ = ssi.SSI_fast(rest, block_rows, 2 * order, step=2)
            both = zip(states[1:], outputs[1:], strict=True)
            yield tuple(_poles_of(a, c, values.std(axis=0), step_s) for a, c in both)


@contextlib.contextmanager
def _pyoma2() -> Iterator[Any]:
    """Yield pyOMA2's functions, without its progress bars, log lines and error state."""
    quiet = contextlib.redirect_stderr(io.StringIO())
    with np.errstate(), quiet, contextlib.redirect_stdout(io.StringIO()):
        from pyoma2.functions import ssi

        logging.getLogger("pyoma2").setLevel(logging.WARNING)
        yield ssi


def _scaled(values: Floats) -> tuple[Floats, Floats]:
    """Return channels of unit deviation (n_channels, n_times) as outputs and as references."""
    scaled = ((values - values.mean(axis=0)) / values.std(axis=0)).T
    return scaled, scaled


def _poles_of(a: Floats, c: Floats, scale: Floats, step_s: float) -> PolesOfOrder:
    """Return the poles of a state matrix (n, n), and shapes by the outputs (n_channels, n)."""
    mu, vectors = np.linalg.eig(a)
    moving = mu != 0.0
    poles = np.log(mu[moving].astype(np.complex128)) / step_s
    shapes = (c @ vectors[:, moving]) * scale[:, None]
    return poles, np.asarray(shapes, dtype=np.complex128)
