"""The record of a scatter study, scatter.h5: what repeated tests say of the parameters' scatter.

The file is the dataclass ScatterRecord below as `core/storage/codec` writes it, behind a seal.
Values of parameters are relative to the deck's, measured ones to their means; covariances are of
one test. There may be several answers that explain the mean of the tests.
"""

from __future__ import annotations

from dataclasses import dataclass

from modetune.core.brief import brief
from modetune.core.modes import Floats
from modetune.core.storage.campaign_record import RunCounts
from modetune.core.storage.sealed_file import RecordFile
from modetune.core.updating.reduced_basis import RangeUse


@dataclass(frozen=True, slots=True, repr=False)
class ScatterAnswer:
    """One answer.

    share: of the posterior of the mean (Laplace). mean: (n_parameters,); covariance: (n_free,
    n_free), of the parameters that scatter, by sampling; linear_covariance: by perturbation.
    mean_interval: (2, n_parameters), deviation_interval: (2, n_free), noise_interval: (2,): 95 %.
    draws: (n, n_parameters) of the mean; deviation_draws: (n, n_free). predicted: (m,),
    predicted_covariance: (m, m), of the measured values with the measurement's own scatter;
    noise: its deviation. lack: how likely the tests scatter so where this is right; cut: what of
    the covariance was negative; rounds: until nothing moved, 0: not reached. off: how much of the
    measured scatter full solutions at drawn sets are away from what the answer was found by, NaN
    where none was made.
    """

    share: float
    mean: Floats
    covariance: Floats
    linear_covariance: Floats
    mean_interval: Floats
    deviation_interval: Floats
    noise_interval: Floats
    draws: Floats
    deviation_draws: Floats
    predicted: Floats
    predicted_covariance: Floats
    noise: float
    lack: float
    cut: float
    rounds: int
    off: float


@dataclass(frozen=True, slots=True, repr=False)
class ScatterRecord:
    """A scatter study from its tests to its judgement.

    names: of the parameters; free: of those that scatter; measured: names of the measured values;
    means: (m,), of the tests, in their units. tests: (n_tests, m), less the means and over `sizes`
    (m,), which are the means of frequencies, NaN where missing or left out; covariance: (m, m),
    measured, across all kinds; worth: independent tests that they are worth. noise_told: whether
    the measurement's own scatter was given. notes: of the tests.
    """

    name: str
    seed: int
    solver: str
    solver_version: str
    modetune_version: str
    campaign_text: str
    wall_s: float
    names: tuple[str, ...]
    free: tuple[str, ...]
    measured: tuple[str, ...]
    means: Floats
    sizes: Floats
    tests: Floats
    covariance: Floats
    worth: float
    noise_told: bool
    notes: tuple[str, ...]
    answers: tuple[ScatterAnswer, ...]
    runs: RunCounts
    reduced_model: RangeUse | None

    __repr__ = brief


SCATTER = RecordFile(ScatterRecord, "scatter study", "scatter.h5", 2)
