"""The tables, the findings (red ones first) and the JSON object of a scatter study."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from modetune.core.storage.keys import Json
from modetune.flows.report.tables import Column, Table, json_object, table_of
from modetune.flows.studies.sample.summary import Sentences, StudyFinding, red_first
from modetune.flows.studies.scatter.record import ScatterAnswer, ScatterRecord

#: A likelihood of the measured scatter below it says that the parameters do not explain it.
UNLIKELY = 0.01
#: An answer with a smaller share is not reported as a second one.
SECOND = 0.01
#: The negative share of the covariance, and the error of the surrogate, that are reported.
NEGATIVE, ROUGH = 0.05, 0.2


@dataclass(frozen=True, slots=True)
class ScatterRow:
    """A parameter in one answer, relative to the deck. Scatter: the standard deviation from test to
    test, by sampling and by perturbation; None where it is the same in all."""

    name: Annotated[str, Column("parameter")]
    mean: Annotated[float, Column("mean", form=".4f")]
    mean_95: Annotated[tuple[float, float], Column("95 % of the mean", form=".4f")]
    scatter: Annotated[float | None, Column("scatter %", form=".3f")]
    scatter_95: Annotated[tuple[float, float] | None, Column("95 % of it", form=".3f")]
    by_perturbation: Annotated[float | None, Column("by perturbation %", form=".3f")]


def scatter_rows(record: ScatterRecord, answer: ScatterAnswer) -> list[ScatterRow]:
    """Every parameter of an answer, in the campaign's order."""
    rows = []
    for place, name in enumerate(record.names):
        low, high = answer.mean_interval[:, place].tolist()
        own: tuple[float | None, tuple[float, float] | None, float | None] = (None, None, None)
        if name in record.free:
            free = record.free.index(name)
            ends = 100.0 * answer.deviation_interval[:, free]
            own = (
                100.0 * float(np.sqrt(answer.covariance[free, free])),
                (float(ends[0]), float(ends[1])),
                100.0 * float(np.sqrt(answer.linear_covariance[free, free])),
            )
        rows.append(ScatterRow(name, float(answer.mean[place]), (low, high), *own))
    return rows


def scatter_tables(record: ScatterRecord) -> list[Table]:
    """A table an answer."""
    several = len(record.answers) > 1
    return [
        table_of(
            f"Parameters from test to test, relative to the deck{_which(place, answer, several)}",
            scatter_rows(record, answer),
            ScatterRow,
        )
        for place, answer in enumerate(record.answers)
    ]


def _which(place: int, answer: ScatterAnswer, several: bool) -> str:
    share = f"{100 * answer.share:.0f} %" if answer.share >= SECOND else "less than 1 %"
    return f": answer {place + 1} ({share} of the posterior)" if several else ""


def is_frequency(name: str) -> bool:
    """Whether a measured value is a frequency."""
    return name.startswith("frequency of ")


def lines(record: ScatterRecord) -> list[str]:
    """What was done, in sentences."""
    n_modes, n_tests = sum(map(is_frequency, record.measured)), len(record.tests)
    more = len(record.measured) - n_modes
    left = int(np.isnan(record.tests).sum())
    text = f"{n_tests} tests of {n_modes} frequencies"
    text += f" and {more} other values" if more else ""
    text += f", {left} values missing or left out" if left else ""
    text += f", worth {record.worth:.0f} independent ones" if record.worth < n_tests - 0.5 else ""
    noise = record.answers[0].noise
    own = (
        f"measurement scatter: {100 * noise:.3g} % of a frequency"
        if noise
        else "the measurement scatter is assumed to be zero: the parameters explain all "
        "differences between tests"
    )
    if not record.noise_told:
        low, high = (100.0 * record.answers[0].noise_interval).tolist()
        own += f", estimated from the tests ({low:.3g} to {high:.3g} %)"
    return [text, own, *record.notes]


def findings(record: ScatterRecord) -> tuple[StudyFinding, ...]:
    """Return the findings about the answers, red ones first."""
    return red_first(_findings(record))


def _findings(record: ScatterRecord) -> Sentences:
    seen = [answer for answer in record.answers if answer.share >= SECOND]
    if len(seen) > 1:
        yield (
            True,
            f"{len(seen)} separate solutions explain the mean of the tests, each with its own "
            "scatter: narrower bounds, a mode shape or another mode would distinguish them",
        )
    for place, answer in enumerate(record.answers):
        of = f"answer {place + 1}: " if len(record.answers) > 1 else ""
        yield from ((red, of + text) for red, text in _of_answer(answer))


def _of_answer(answer: ScatterAnswer) -> Sentences:
    if not answer.rounds:
        yield True, "mean and covariance did not converge; narrow the parameters' bounds"
    if answer.lack < UNLIKELY:
        yield (
            True,
            "these parameters do not explain the scatter of the frequencies (likelihood "
            f"{answer.lack:.1g}): other parameters vary too, or the measurement error is larger",
        )
    if answer.cut > NEGATIVE:
        yield (
            False,
            f"{100 * answer.cut:.0f} % of the covariance is negative and was set to zero: the "
            "measurement scatter is as large as that of some frequencies",
        )
    if answer.off > ROUGH:
        yield (
            answer.off > 1.0,
            f"full solutions differ from the surrogate by {answer.off:.2g} deviations of the "
            "tests; raise --points",
        )


def summary(record: ScatterRecord) -> dict[str, Json]:
    """Return the JSON object of the record."""
    texts = findings(record)
    return json_object(
        record,
        "names free measured means sizes covariance worth noise_told notes reduced_model",
        status="doubtful" if any(finding.red for finding in texts) else "done",
        findings=texts,
        answers=[
            json_object(
                answer,
                "share covariance linear_covariance predicted predicted_covariance noise lack off",
                parameters=scatter_rows(record, answer),
            )
            for answer in record.answers
        ],
        solver_runs=record.runs,
        wall_s=round(record.wall_s, 3),
    )
