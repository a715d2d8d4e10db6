"""The table, the findings (red ones first) and the JSON object of a sampling."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy.stats import truncnorm

from modetune.core.modes import Floats
from modetune.core.storage.keys import Json
from modetune.flows.report.tables import Column, Table, json_object, table_of
from modetune.flows.studies.sample.record import PosteriorRecord
from modetune.flows.studies.sample.refinement import GOOD, REFUSED

#: Ratio of the sampled to the linear deviation, and distance of the mean from the most likely
#: value in deviations, from which on the linear model is reported as invalid.
UNLIKE, SHIFTED = 1.25, 0.35
#: The test does not determine a parameter that keeps more than this share of the prior's width.
UNTOLD = 0.9
#: Share of the samples within a quarter of a deviation of an end, from which on the end cuts: a
#: normal distribution that is cut at 1.2 deviations has it.
CUT = 0.05
#: A second peak with a smaller share of the samples is not reported.
SECOND = 0.01
#: The test determines only a combination of two parameters with a larger correlation.
TIED = 0.95
#: The sentence where no surrogate of the reduced model was good enough.
ITSELF = (
    "no surrogate foresees the reduced model well enough here, so that each sample was a set of "
    "the reduced model itself, which takes longer"
)


#: Sentences, each behind whether it is red.
Sentences = Iterator[tuple[bool, str]]


@dataclass(frozen=True, slots=True)
class StudyFinding:
    """A sentence; red where what was found cannot be relied on."""

    red: bool
    text: str


def findings(record: PosteriorRecord) -> tuple[StudyFinding, ...]:
    """Return the findings about a posterior, red ones first."""
    texts = (_of_checks, _of_chains, _of_peaks, _of_ends, _of_shapes, _of_prior, _of_ties)
    return red_first(text for of in texts for text in of(record))


def red_first(said: Sentences) -> tuple[StudyFinding, ...]:
    """Findings, red ones first."""
    found = [StudyFinding(*item) for item in said]
    return tuple(sorted(found, key=lambda finding: not finding.red))


def _of_checks(record: PosteriorRecord) -> Sentences:
    names, errors = record.training.names, record.check_errors
    if not record.check_keys:
        yield False, "no point of the posterior was checked by the solver"
    elif errors.max() > REFUSED:
        worst = ", ".join(
            f"{names[place]} by {errors[place]:.2g}"
            for place in np.argsort(-errors).tolist()
            if errors[place] > REFUSED
        )
        yield (
            True,
            f"at {len(record.check_keys)} points of the posterior {_called(record)} misses "
            f"the solver: {worst} standard deviations of the test; do not rely on this "
            f"posterior, {_remedy(record)}",
        )
    if record.by_reduced_model:
        yield False, ITSELF
    elif record.density_error > GOOD:
        place = int(record.left_out.argmax())
        yield (
            False,
            f"the surrogate is coarse: with a run left out it misses the log density by "
            f"{record.density_error:.2g}, {names[place]} by {record.left_out[place]:.2g} "
            "standard deviations of the test",
        )


def _called(record: PosteriorRecord) -> str:
    return "the reduced model" if record.by_reduced_model else "the surrogate"


def _remedy(record: PosteriorRecord) -> str:
    own = "use the solver's own modes (`model.eigensolver: solver`)"
    return own if record.reduced_model else "raise --points"


def _of_chains(record: PosteriorRecord) -> Sentences:
    if record.enough:
        return
    kept = record.steps - record.burned
    place = int(record.autocorrelation_times.argmax())
    times = record.autocorrelation_times[place]
    yield (
        True,
        f"the chains are too short: {kept} steps are {kept / times:.0f} autocorrelation "
        f"times of {record.names[place]} (50 are wanted), R-hat is "
        f"{record.r_hat.max():.3f} (at most 1.05); raise --steps or --walkers",
    )


def _of_peaks(record: PosteriorRecord) -> Sentences:
    seen = np.flatnonzero(record.shares >= SECOND)
    if seen.size < 2:
        return
    places = "; ".join(
        f"{100 * record.shares[peak]:.0f} % at "
        + ", ".join(
            f"{name} {value:.3g}"
            for name, value in zip(record.names, record.peaks[peak], strict=True)
        )
        for peak in seen.tolist()
    )
    yield (
        True,
        f"{seen.size} separate regions of parameter values explain the test: {places}; mean and "
        "deviation mean little here: measure another mode or a shape that distinguishes them",
    )


def _of_ends(record: PosteriorRecord) -> Sentences:
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
                yield (
                    False,
                    f"the posterior of {name} is cut at its bound {at:.4g}",
                )
            else:
                yield (
                    True,
                    f"the posterior of {name} is cut at the end {at:.4g} of the learned range; "
                    "omit --record to learn the whole range between the bounds",
                )


def _of_shapes(record: PosteriorRecord) -> Sentences:
    """Where mean and deviation are not those of the linear model at the most likely values."""
    for place, name in enumerate(record.names):
        ratio = record.deviation[place] / record.linear_deviation[place]
        shift = (record.mean[place] - record.most_likely[place]) / record.deviation[place]
        texts = []
        if not 1.0 / UNLIKE <= ratio <= UNLIKE:
            texts.append(f"its deviation is {ratio:.2g} times the linear standard error")
        if abs(shift) > SHIFTED:
            texts.append(
                f"its mean lies {abs(shift):.2g} deviations "
                f"{'above' if shift > 0 else 'below'} the most likely value"
            )
        if texts:
            yield (
                False,
                (f"{name} differs from the linear model: {' and '.join(texts)}; use the interval"),
            )


def _of_prior(record: PosteriorRecord) -> Sentences:
    share = record.deviation / prior_width(record)
    for place in np.flatnonzero(share > UNTOLD).tolist():
        yield (
            False,
            f"the test gives almost no information on {record.names[place]}: its posterior is "
            "close to the prior",
        )


def prior_width(record: PosteriorRecord) -> Floats:
    """Standard deviation of the prior as it is cut at the range, (n_parameters,)."""
    mean, deviation = record.prior_mean, record.prior_deviation
    ends = (record.lower - mean) / deviation, (record.upper - mean) / deviation
    return np.asarray(truncnorm.std(*ends, loc=mean, scale=deviation), dtype=np.float64)


def _of_ties(record: PosteriorRecord) -> Sentences:
    rows, columns = np.nonzero(np.triu(np.abs(record.correlation) > TIED, 1))
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        yield (
            False,
            f"the test determines only a combination of {record.names[row]} and "
            f"{record.names[column]} (correlation {record.correlation[row, column]:+.2f})",
        )


@dataclass(frozen=True, slots=True)
class PosteriorRow:
    """A parameter's posterior, relative to the deck; linear_standard_error: of a linear model."""

    name: Annotated[str, Column("parameter")]
    prior_mean: Annotated[float, Column("prior mean", form=".3g")]
    prior_deviation: Annotated[float, Column("prior deviation", form=".2g")]
    mean: Annotated[float, Column("mean", form=".4f")]
    deviation: Annotated[float, Column("deviation", form=".2g")]
    linear_standard_error: Annotated[float, Column("linear standard error", form=".2g")]
    interval_95: Annotated[tuple[float, float], Column("95 % interval", form=".4f")]
    most_likely: Annotated[float, Column("most likely", form=".4f")]
    effective_size: float
    r_hat: float


def posterior_rows(record: PosteriorRecord) -> list[PosteriorRow]:
    """Every parameter, in the campaign's order."""
    columns = zip(
        record.names,
        record.prior_mean,
        record.prior_deviation,
        record.mean,
        record.deviation,
        record.linear_deviation,
        zip(record.interval_lower, record.interval_upper, strict=True),
        record.most_likely,
        record.effective_sizes,
        record.r_hat,
        strict=True,
    )
    return [PosteriorRow(*values) for values in columns]


def posterior_table(record: PosteriorRecord) -> Table:
    """Return the table of posterior values."""
    return table_of("Posterior, relative to the deck", posterior_rows(record), PosteriorRow)


def lines(record: PosteriorRecord) -> list[str]:
    """Return the sentences below the table."""
    by_model = record.by_reduced_model
    called = "reduced model" if by_model else "surrogate"
    left_out = "" if by_model else f"{record.left_out.max():.2g} with a set left out, "
    density = "" if by_model else f"; log density within {record.density_error:.2g}"
    return [
        *([record.points_by] if record.points_by else []),
        f"solver runs: {record.runs.modal}, {record.runs.reused} cached; points of the {called}: "
        f"{record.near.size}, {int(record.near.sum())} of them near the posterior; failed points: "
        f"{len(record.failures)}",
        f"{called}, in standard deviations of the test: worst response {left_out}"
        f"{record.check_errors.max():.2g} at {len(record.check_keys)} checks{density}",
        f"samples: {record.walkers} walkers, {record.steps - record.burned} steps kept, effective "
        f"sample size {record.effective_sizes.min():.0f}, R-hat {record.r_hat.max():.3f}",
    ]


def summary(record: PosteriorRecord) -> dict[str, Json]:
    """Return the JSON object of the record."""
    texts = findings(record)
    errors = zip(record.training.names, record.left_out, record.check_errors, strict=True)
    peaks = zip(record.shares, record.peaks, strict=True)
    return json_object(
        record,
        "correlation seed",
        status="doubtful" if any(finding.red for finding in texts) else "done",
        findings=texts,
        parameters=posterior_rows(record),
        peaks=[{"share": share, "point": point} for share, point in peaks],
        surrogate=[
            {"response": name, "left_out": left_out, "checked": checked}
            for name, left_out, checked in errors
        ],
        density_error=record.density_error,
        points_by=record.points_by,
        reduced_model=record.reduced_model,
        training_runs=record.near.size,
        training_runs_near=record.near.sum(),
        checks=len(record.check_keys),
        chains=json_object(record, "walkers steps burned acceptance enough"),
        solver_runs=record.runs,
        failed_runs=len(record.failures),
        wall_s=round(record.wall_s, 3),
    )
