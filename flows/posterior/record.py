"""The record of a sampling, posterior.h5: samples, what they came from, and how they were judged.

    /               attributes: format, name, seed, walkers, steps (of each walker), burned,
                    acceptance, enough (chains long enough), solver, solver_version,
                    modetune_version, units, campaign (the file's text), runs_modal, runs_reused,
                    core_s, wall_s
    parameters/     names, lower, upper (range of the samples), bound_lower, bound_upper,
                    prior_mean, prior_deviation, mean, deviation, interval_lower, interval_upper
                    (95 %), most_likely, linear_deviation, autocorrelation_times,
                    effective_sizes, r_hat (n_parameters,); correlation (n_par, n_par)
    samples/        points (n, n_parameters), thinned; log_densities (n,), but for a constant
    peaks/          points (n_peaks, n_parameters), shares (n_peaks,), by the samples
    training/       points (n_points, n_parameters), values (n_points, n_residuals) in standard
                    deviations of the test, responses (n_residuals,), names, keys of the jobs,
                    near (n_points,), whether a point counts as near the posterior; attribute
                    begun: points before any was added near the posterior
    checks/         points (n_checks, n_parameters), keys, errors (n_responses,), left_out
                    (n_responses,): errors of the surrogate in standard deviations of the test, at
                    the checks and with each near training point left out
    failures        texts of solver runs that were left out

Values of parameters are relative to the deck's.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from modetune.core.errors import CampaignError
from modetune.core.groups import texts
from modetune.core.modes import Floats
from modetune.core.record import RunCounts
from modetune.core.store import writing
from modetune.flows.posterior.surrogate import Training

FORMAT = 1
FILE = "posterior.h5"
UNREADABLE = (OSError, KeyError, IndexError, TypeError, ValueError, RuntimeError, AttributeError)
#: Fields that are attributes of the file, and those that are datasets of `parameters/`.
ATTRIBUTES = ("name", "seed", "walkers", "steps", "burned", "acceptance", "enough", "solver",
              "solver_version", "modetune_version", "units", "wall_s")  # fmt: skip
COLUMNS = ("lower", "upper", "bound_lower", "bound_upper", "prior_mean", "prior_deviation", "mean",
           "deviation", "interval_lower", "interval_upper", "most_likely", "linear_deviation",
           "correlation", "autocorrelation_times", "effective_sizes", "r_hat")  # fmt: skip


@dataclass(frozen=True, slots=True)
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
    check_points: Floats
    check_keys: tuple[str, ...]
    check_errors: Floats
    failures: tuple[str, ...]
    runs: RunCounts


def write_posterior(path: Path, record: PosteriorRecord) -> None:
    """Write the record whole or not at all. Raises StorageUnavailable."""
    training, runs = record.training, record.runs
    with writing(path) as part, h5py.File(part, "w") as file:
        file.attrs.update({name: getattr(record, name) for name in ATTRIBUTES})
        file.attrs.update(format=FORMAT, campaign=record.campaign_text, runs_modal=runs.modal,
                          runs_reused=runs.reused, core_s=runs.core_s)  # fmt: skip
        columns = {name: getattr(record, name) for name in COLUMNS}
        _put(file, "parameters", names=record.names, **columns)
        _put(file, "samples", points=record.samples, log_densities=record.log_densities)
        _put(file, "peaks", points=record.peaks, shares=record.shares)
        _put(file, "training", points=training.points, values=training.values,
             responses=training.responses, names=training.names, keys=record.training_keys,
             near=record.near)  # fmt: skip
        file["training"].attrs["begun"] = record.begun
        _put(file, "checks", points=record.check_points, keys=record.check_keys,
             errors=record.check_errors, left_out=record.left_out)  # fmt: skip
        _put(file, "", failures=record.failures)


def read_posterior(path: Path) -> PosteriorRecord:
    """The record as it was written. Raises CampaignError."""
    try:
        with h5py.File(path, "r") as file:
            if int(file.attrs["format"]) > FORMAT:
                raise CampaignError(f"{path} was written by a newer modetune; install that version")
            return _read(file)
    except UNREADABLE as error:
        raise CampaignError(
            f"{path} is no record of a sampling (a {FILE} as `modetune sample` leaves it), or it "
            f"is damaged: {error}"
        ) from error


def _put(file: h5py.File, name: str, **columns: NDArray[Any] | tuple[str, ...]) -> None:
    group = file.create_group(name) if name else file
    for key, value in columns.items():
        if isinstance(value, tuple):
            group.create_dataset(key, data=list(value), dtype=h5py.string_dtype())
        else:
            group[key] = value


def _read(file: h5py.File) -> PosteriorRecord:
    attrs, columns, training, checks = (
        file.attrs, file["parameters"], file["training"], file["checks"],
    )  # fmt: skip
    return PosteriorRecord(
        **{name: _plain(attrs[name]) for name in ATTRIBUTES},
        **{name: columns[name][()] for name in COLUMNS},
        campaign_text=str(attrs["campaign"]),
        names=tuple(texts(columns, "names")),
        samples=file["samples/points"][()],
        log_densities=file["samples/log_densities"][()],
        peaks=file["peaks/points"][()],
        shares=file["peaks/shares"][()],
        training=Training(
            training["points"][()],
            training["values"][()],
            training["responses"][()],
            tuple(texts(training, "names")),
        ),
        training_keys=tuple(texts(training, "keys")),
        near=training["near"][()],
        begun=int(training.attrs["begun"]),
        left_out=checks["left_out"][()],
        check_points=checks["points"][()],
        check_keys=tuple(texts(checks, "keys")),
        check_errors=checks["errors"][()],
        failures=tuple(texts(file, "failures")),
        runs=RunCounts(
            modal=int(attrs["runs_modal"]),
            reused=int(attrs["runs_reused"]),
            core_s=float(attrs["core_s"]),
        ),
    )


def _plain(value: Any) -> Any:
    """An attribute as a plain number, truth value or text."""
    return value.item() if isinstance(value, np.generic) else value
