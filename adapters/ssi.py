"""Poles from responses alone by the covariance-driven subspace identification of pyOMA2.

pyOMA2 makes the block Hankel matrix of output covariances and the state matrices A and C of all
orders from one decomposition (Peeters and De Roeck 1999). A pole of order n is log(mu) / step of an
eigenvalue mu of A, its shape C times the eigenvector.

What the package sets for the whole process when it is loaded (NumPy's error state) is taken back.
"""

from __future__ import annotations

import contextlib
import io
import logging

import numpy as np

from modetune.core.errors import CampaignError
from modetune.core.measurement.frf import Complexes
from modetune.core.modes import Floats

#: Poles and their shapes, (n,) and (n_channels, n).
PolesOfOrder = tuple[Complexes, Complexes]


def ssi_poles(
    values: Floats, step_s: float, order: int, block_rows: int
) -> tuple[PolesOfOrder, ...]:
    """Poles of models with 1, 2, ..., order pairs, rad/s, conjugates and all.

    values: (n_times, n_channels), evenly sampled. Raises CampaignError where there are too few of
    them for the order; ModuleNotFoundError without pyOMA2.
    """
    n_times, n_channels = values.shape
    if n_times < 20 * block_rows or 2 * order > n_channels * (block_rows - 1):
        raise CampaignError(
            f"{n_times} samples of {n_channels} channels are too few for --order {order}: record "
            "longer, or lower it"
        )
    quiet = contextlib.redirect_stderr(io.StringIO())  # a bar of its own
    with np.errstate(), quiet, contextlib.redirect_stdout(io.StringIO()):
        from pyoma2.functions import ssi

        logging.getLogger("pyoma2").setLevel(logging.WARNING)  # its steps are not ours to tell
        scaled = ((values - values.mean(axis=0)) / values.std(axis=0)).T
        hankel, _ = ssi.build_hank(scaled, scaled, block_rows, "cov")
        _, states, outputs, _ = ssi.SSI_fast(hankel, block_rows, 2 * order, step=2)
    found = []
    for a, c in zip(states[1:], outputs[1:], strict=True):
        mu, vectors = np.linalg.eig(a)
        moving = mu != 0.0
        poles = np.log(mu[moving].astype(np.complex128)) / step_s
        shapes = (c @ vectors[:, moving]) * values.std(axis=0)[:, None]
        found.append((poles, np.asarray(shapes, dtype=np.complex128)))
    return tuple(found)
