"""Poles of response functions by the least-squares complex frequency estimator of sdypy-EMA.

sdypy-EMA fits a common-denominator polynomial in z = exp(-i w T) with real coefficients, T such
that its last line is half a turn (Guillaume et al. 2003). Two things are done for it here:

- The band is moved to begin at 0 Hz, so that it fills the half circle; else powers of z are nearly
  dependent and high orders lose all digits. Poles are moved back. What the move does to the
  conjugate half is smooth in the band and is taken up by the numerator.
- Every function is scaled to the same root mean square, so that a strong one does not decide alone.

All references enter one fit: the denominator is common to them.
"""

from __future__ import annotations

import numpy as np

from modetune.core.errors import CampaignError
from modetune.core.measurement.frf import Complexes
from modetune.core.modes import Floats


def lscf_poles(frequencies_hz: Floats, values: Complexes, order: int) -> tuple[Complexes, ...]:
    """Poles of polynomials with 1, 2, ..., order pairs, all of them, rad/s.

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
            f"2 to {max((frequencies_hz.size - 2) // 2, 2)} can be told"
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
