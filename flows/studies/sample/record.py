"""The record of a sampling, posterior.h5: samples, what they came from, and how they were judged.

The file is the dataclass PosteriorRecord below as `core/storage/codec` writes it, behind a seal:
single values are attributes, arrays and tuples datasets, dataclasses groups, each by the name of
its field.

    attributes      name, seed, walkers, steps (of each walker), burned, acceptance, enough (chains
                    long enough), begun (training points before
                    any was added near the posterior), solver, solver_version,
                    modetune_version, units, campaign_text, wall_s
    (n_parameters,) names, lower, upper (range of the samples), bound_lower, bound_upper,
                    prior_mean, prior_deviation, mean, deviation, interval_lower, interval_upper
                    (95 %), most_likely, linear_deviation, autocorrelation_times,
                    effective_sizes, r_hat; correlation (n_par, n_par)
    samples         (n, n_parameters), thinned; log_densities (n,), up to a constant
    peaks           (n_peaks, n_parameters); shares (n_peaks,), by the samples
    training/       points (n_points, n_parameters), values (n_points, n_residuals) in standard
                    deviations of the test, responses (n_residuals,), names
    training_keys   of the jobs (n_points,); near (n_points,), whether a point counts as near the
                    posterior
    check_points    (n_checks, n_parameters); check_keys; check_errors, left_out (n_responses,):
                    errors of the surrogate in standard deviations of the test, at the checks and
                    with each near training point left out, NaN where a reduced model gave the
                    samples themselves; attribute density_error: of the log density in the 95 %
                    region, at sets of the posterior where these cost little, else left out
    failures        texts of solver runs that were left out
    reduced_model/  where sets were evaluated by one: attributes sets, vectors, solutions, asked,
                    error, estimate, in_full, solver, apart, where (`core/updating/reduced_basis`)
    runs/           attributes modal, sensitivity, reused, core_s, licence_s

Values of parameters are relative to the deck's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modetune.core.brief import brief
from modetune.core.modes import Floats
from modetune.core.storage.campaign_record import RunCounts
from modetune.core.storage.sealed_file import RecordFile
from modetune.core.updating.reduced_basis import RangeUse
from modetune.flows.studies.sample.surrogate import Training


@dataclass(frozen=True, slots=True, repr=False)
class PosteriorRecord:
    """A sampling from its solver runs to its judgement; the module says what each field is."""

    name: str
    seed: int
    walkers: int
    steps: int
    burned: int
    acceptance: float
    enough: bool
    solver: str
    solver_version: str
    modetune_version: str
    units: str
    wall_s: float
    campaign_text: str
    names: tuple[str, ...]
    lower: Floats
    upper: Floats
    bound_lower: Floats
    bound_upper: Floats
    prior_mean: Floats
    prior_deviation: Floats
    mean: Floats
    deviation: Floats
    interval_lower: Floats
    interval_upper: Floats
    most_likely: Floats
    linear_deviation: Floats
    correlation: Floats
    autocorrelation_times: Floats
    effective_sizes: Floats
    r_hat: Floats
    samples: Floats
    log_densities: Floats
    peaks: Floats
    shares: Floats
    training: Training
    training_keys: tuple[str, ...]
    near: NDArray[np.bool_]
    begun: int
    left_out: Floats
    density_error: float
    check_points: Floats
    check_keys: tuple[str, ...]
    check_errors: Floats
    failures: tuple[str, ...]
    runs: RunCounts
    reduced_model: RangeUse | None

    __repr__ = brief

    @property
    def by_reduced_model(self) -> bool:
        """Whether samples are those of the reduced model itself, and not of a surrogate."""
        return bool(np.isnan(self.left_out).all())

    @property
    def points_by(self) -> str:
        """How sets were evaluated, where not each took a run of the solver."""
        return self.reduced_model.sentence if self.reduced_model else ""


POSTERIOR = RecordFile(PosteriorRecord, "sampling", "posterior.h5", 5)
