"""What a sampling tells people and machines: sentences of findings, red ones first, and JSON."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import truncnorm

from modetune.core.keys import Json, number_or_null
from modetune.core.modes import Floats
from modetune.flows.posterior.learning import GOOD, REFUSED
from modetune.flows.posterior.record import PosteriorRecord

#: Ratio of the sampled to the linear deviation, and distance of the mean from the most likely
#: value in deviations, from which on the linear picture is said not to hold.
UNLIKE, SHIFTED = 1.25, 0.35
#: A parameter of which the test left more than this share of the prior's width is not told by it.
UNTOLD = 0.9
#: Share of the samples within a quarter of a deviation of an end, from which on the end cuts: a
#: normal distribution that is cut at 1.2 deviations has it.
CUT = 0.05
#: A second peak with a smaller share of the samples is not told.
SECOND = 0.01
#: Two parameters with a larger correlation are told together only.
TIED = 0.95


@dataclass(frozen=True, slots=True)
class Finding:
    """A sentence; red where the posterior cannot be relied on."""

    red: bool
    text: str


def findings(record: PosteriorRecord) -> tuple[Finding, ...]:
    """What is to be said of a posterior, red findings first."""
    found = [*_of_checks(record), *_of_chains(record), *_of_peaks(record)]
    found += [*_of_ends(record), *_of_shapes(record), *_of_prior(record), *_of_ties(record)]
    return tuple(sorted(found, key=lambda finding: not finding.red))


def _of_checks(record: PosteriorRecord) -> list[Finding]:
    names, errors = record.training.names, record.check_errors
    found = []
    if not record.check_keys:
        found.append(Finding(False, "no point of the posterior was checked by the solver"))
    elif errors.max() > REFUSED:
        worst = ", ".join(
            f"{names[place]} by {errors[place]:.2g}"
            for place in np.argsort(-errors).tolist()
            if errors[place] > REFUSED
        )
        found.append(Finding(True, (
            f"at {len(record.check_keys)} points of the posterior the surrogate misses the solver: "
            f"{worst} standard deviations of the test; do not rely on this posterior, raise "
            "--points"
        )))  # fmt: skip
    if GOOD < record.left_out.max() <= REFUSED:
        place = int(record.left_out.argmax())
        found.append(Finding(False, (
            f"the surrogate is coarse: with a run left out it misses {names[place]} by "
            f"{record.left_out[place]:.2g} standard deviations of the test"
        )))  # fmt: skip
    return found


def _of_chains(record: PosteriorRecord) -> list[Finding]:
    if record.enough:
        return []
    kept = record.steps - record.burned
    place = int(record.autocorrelation_times.argmax())
    times = record.autocorrelation_times[place]
    return [Finding(True, (
        f"the chains are too short: {kept} steps are {kept / times:.0f} autocorrelation times of "
        f"{record.names[place]} (50 are wanted), R-hat is {record.r_hat.max():.3f} (at most 1.05); "
        "raise --steps or --walkers"
    ))]  # fmt: skip


def _of_peaks(record: PosteriorRecord) -> list[Finding]:
    seen = np.flatnonzero(record.shares >= SECOND)
    if seen.size < 2:
        return []
    places = "; ".join(
        f"{100 * record.shares[peak]:.0f} % at "
        + ", ".join(
            f"{name} {value:.3g}" for name, value in zip(record.names, record.peaks[peak],
                                                         strict=True)
        )
        for peak in seen.tolist()
    )  # fmt: skip
    return [Finding(True, (
        f"{seen.size} sets of parameters explain the test, apart from each other: {places}; mean "
        "and deviation say little here, measure another mode or a shape that tells them apart"
    ))]  # fmt: skip


def _of_ends(record: PosteriorRecord) -> list[Finding]:
    found = []
    width = 0.25 * record.deviation
    by_test = record.deviation <= UNTOLD * prior_width(record)
    sides = (
        (record.lower, record.bound_lower, record.samples < record.lower + width),
        (record.upper, record.bound_upper, record.samples > record.upper - width),
    )
    for end, bound, cut in sides:
        for place in np.flatnonzero((cut.mean(axis=0) > CUT) & by_test).tolist():
            name, at = record.names[place], end[place]
            if at == bound[place]:
                found.append(Finding(False, f"{name} presses against its bound {at:.4g}; the test "
                                            "may want it beyond"))  # fmt: skip
            else:
                found.append(Finding(True, (
                    f"{name} presses against the end of the learned range, {at:.4g}, which cuts "
                    "its posterior; leave --record out to learn all between the bounds"
                )))  # fmt: skip
    return found


def _of_shapes(record: PosteriorRecord) -> list[Finding]:
    """Where mean and deviation are not those of the linear model at the most likely values."""
    found = []
    for place, name in enumerate(record.names):
        ratio = record.deviation[place] / record.linear_deviation[place]
        shift = (record.mean[place] - record.most_likely[place]) / record.deviation[place]
        said = []
        if not 1.0 / UNLIKE <= ratio <= UNLIKE:
            said.append(f"its deviation is {ratio:.2g} times the linear standard error")
        if abs(shift) > SHIFTED:
            said.append(f"its mean lies {abs(shift):.2g} deviations "
                        f"{'above' if shift > 0 else 'below'} the most likely value")  # fmt: skip
        if said:
            found.append(Finding(False, f"{name} is not as a linear model says: "
                                        f"{' and '.join(said)}; trust the interval"))  # fmt: skip
    return found


def _of_prior(record: PosteriorRecord) -> list[Finding]:
    share = record.deviation / prior_width(record)
    return [
        Finding(False, f"the test says next to nothing of {record.names[place]}: its posterior is "
                       "the knowledge from before")
        for place in np.flatnonzero(share > UNTOLD).tolist()
    ]  # fmt: skip


def prior_width(record: PosteriorRecord) -> Floats:
    """Standard deviation of the prior as it is cut at the range, (n_parameters,)."""
    mean, deviation = record.prior_mean, record.prior_deviation
    ends = (record.lower - mean) / deviation, (record.upper - mean) / deviation
    return np.asarray(truncnorm.std(*ends, loc=mean, scale=deviation), dtype=np.float64)


def _of_ties(record: PosteriorRecord) -> list[Finding]:
    rows, columns = np.nonzero(np.triu(np.abs(record.correlation) > TIED, 1))
    return [
        Finding(False, f"{record.names[row]} and {record.names[column]} are told together only "
                       f"(correlation {record.correlation[row, column]:+.2f})")
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True)
    ]  # fmt: skip


def told(record: PosteriorRecord, written: list[Path]) -> dict[str, Json]:
    """The `--json` object of `modetune sample`."""
    said = findings(record)
    return {
        "status": "doubtful" if any(finding.red for finding in said) else "done",
        "findings": [{"red": finding.red, "text": finding.text} for finding in said],
        "parameters": _told_parameters(record),
        "correlation": [[number_or_null(value) for value in row] for row in record.correlation],
        "peaks": [
            {"share": number_or_null(share), "point": [number_or_null(value) for value in point]}
            for share, point in zip(record.shares, record.peaks, strict=True)
        ],
        "surrogate": [
            {
                "response": name,
                "left_out": number_or_null(left_out),
                "checked": number_or_null(checked),
            }
            for name, left_out, checked in zip(
                record.training.names, record.left_out, record.check_errors, strict=True
            )
        ],
        "training_runs": int(record.near.size),
        "training_runs_near": int(record.near.sum()),
        "checks": len(record.check_keys),
        "chains": {
            "walkers": record.walkers, "steps": record.steps, "burned": record.burned,
            "acceptance": number_or_null(record.acceptance), "enough": record.enough,
        },
        "solver_runs": {"modal": record.runs.modal, "reused": record.runs.reused},
        "failed_runs": len(record.failures),
        "seed": record.seed,
        "wall_s": round(record.wall_s, 3),
        "written": [str(path) for path in written],
    }  # fmt: skip


def _told_parameters(record: PosteriorRecord) -> list[Json]:
    return [
        {
            "name": name,
            "mean": number_or_null(record.mean[place]),
            "deviation": number_or_null(record.deviation[place]),
            "interval_95": [
                number_or_null(record.interval_lower[place]),
                number_or_null(record.interval_upper[place]),
            ],
            "most_likely": number_or_null(record.most_likely[place]),
            "linear_standard_error": number_or_null(record.linear_deviation[place]),
            "prior_mean": number_or_null(record.prior_mean[place]),
            "prior_deviation": number_or_null(record.prior_deviation[place]),
            "effective_size": number_or_null(record.effective_sizes[place]),
            "r_hat": number_or_null(record.r_hat[place]),
        }
        for place, name in enumerate(record.names)
    ]
