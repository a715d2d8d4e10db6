"""`modetune history`: how a structure and its updates went over time, and what changed."""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modetune.core.errors import CampaignError
from modetune.core.storage.keys import Json
from modetune.flows.report.tables import json_object
from modetune.flows.studies.result import StudyResult, near
from modetune.flows.studies.study import (
    Figures,
    Page,
    Runs,
    StudyContext,
    StudyOptions,
    study,
)

if TYPE_CHECKING:
    from rich.console import Console

    from modetune.core.monitoring.drift import Drift
    from modetune.core.monitoring.past_runs import PastRun
    from modetune.flows.campaign.campaign import Campaign
    from modetune.flows.studies.history.differences import RunDifference
    from modetune.flows.updating.forecast import Progress

#: Rows of the table on a terminal; a page has all.
SHOWN = 20
Csv = Annotated[
    Path | None, typer.Option("--csv", help="File for the table with all columns (CSV).")
]


@dataclass(frozen=True, slots=True, repr=False)
class StructureHistory:
    """The history of a structure: its past runs, oldest first, and its drift at the newest.

    folder: the run folder. drift: None where no campaign says how to watch the structure: then its
    state is what the newest run found. problems: files that were left out, a sentence each.
    """

    name: str
    folder: Path
    runs: tuple[PastRun, ...]
    drift: Drift | None
    problems: tuple[str, ...]

    @property
    def frame(self) -> Any:
        """A row a run (pandas): the table of `--csv`."""
        import pandas as pd

        head, *rows = csv_rows(self.runs)
        return pd.DataFrame(rows, columns=head)

    def __repr__(self) -> str:
        return f"{self.name}: {len(self.runs)} runs, {self.sentence}"

    @property
    def sentence(self) -> str:
        """The state of the structure in a sentence."""
        return self._state[1]

    @property
    def state(self) -> str:
        """The state of the structure: learning, steady, changed or unknown."""
        return self._state[0]

    @property
    def _state(self) -> tuple[str, str]:
        if self.drift is not None:
            return self.drift.state, self.drift.sentence
        state = self.runs[-1].state or "unknown"
        return state, self.runs[-1].drift or state.capitalize()


@dataclass(frozen=True)
class HistoryOptions(StudyOptions):
    """Options of the history, which reads no model and no test."""

    of: Annotated[
        tuple[Path, ...],
        typer.Argument(
            help="Campaign file or run folder, alone or with one or two dates (UTC) of its runs; "
            "or two runs: files of histories, records, or folders."
        ),
    ]
    figures: Figures = None
    page: Page = None
    runs: Runs = Path("runs")

    def open(self, progress: Progress, campaign: Campaign | None) -> StudyContext:
        from modetune.flows.report.page import check_page
        from modetune.flows.studies.history.named_runs import run_folder

        check_page(self.page)
        if not self.of:
            raise CampaignError("name a campaign: modetune history campaign.yaml")
        if len(self.of) == 1:
            place, _ = run_folder(self.of[0], self.runs, self.settings or [])
            name = place.resolve().name
        else:
            name = " and ".join(word.name for word in self.of)
        return StudyContext(name, progress, folder=self.runs)

    @property
    def solves(self) -> bool:
        return False


@study(HistoryOptions)
def history(on: StudyContext, options: HistoryOptions, csv: Csv = None) -> StudyResult:
    """Show the history of a structure: its runs in a table, trends, and whether it changed.

    With dates or two runs: what changed between them, in repeatability errors.
    """
    from modetune.flows.studies.history.differences import difference
    from modetune.flows.studies.history.named_runs import named

    found = named(options.of, on.folder, options.settings or [])
    if found.two is not None:
        if csv is not None:
            raise CampaignError("--csv writes the table of a history, not of two runs")
        return _of_two(difference(*found.two))
    from modetune.core.monitoring.past_runs import in_time
    from modetune.flows.updating.run_history import drift_at

    newest = found.history.runs[-1]
    whole = StructureHistory(
        newest.name,
        found.folder,
        in_time(found.history.runs),
        None if found.monitoring is None else drift_at(found.history, newest, found.monitoring),
        found.history.problems,
    )
    return _of_one(whole, csv)


def _of_one(whole: StructureHistory, csv: Path | None) -> StudyResult:
    from modetune.flows.studies.history.trends import run_table, trend_charts

    runs, left = whole.runs, [f"left out: {problem}" for problem in whole.problems]
    count = f"{len(runs)} run{'' if len(runs) == 1 else 's'}"
    title = "Runs, oldest first"
    return StudyResult(
        whole,
        f"{whole.name}: {count}; {whole.sentence}",
        json_object(
            status=whole.state,
            sentence=whole.sentence,
            name=whole.name,
            run_dir=near(whole.folder),
            drift=whole.drift,
            runs=[run_json(run) for run in runs],
            problems=whole.problems,
        ),
        [run_table(runs, title)],
        [whole.sentence, f"{count} of {whole.name}", *left],
        [write_csv(csv, runs)] if csv is not None else [],
        trend_charts(whole.name, runs),
        status=whole.state,
        shown=partial(_show, whole),
    )


def _show(whole: StructureHistory, console: Console) -> None:
    """Print the newest runs."""
    from modetune.flows.report.tables import show
    from modetune.flows.studies.history.trends import run_table

    runs = whole.runs[-SHOWN:]
    more = len(whole.runs) - len(runs)
    lines = [f"{more} earlier runs: see --csv, --json or --page"] if more else []
    left = [f"left out: {problem}" for problem in whole.problems]
    show([run_table(runs), *lines, f"{whole.name}: {whole.sentence}", *left], console)


def _of_two(found: RunDifference) -> StudyResult:
    return StudyResult(
        found,
        found.sentence,
        json_object(
            found,
            "sentence parameters modes deck deck_remark",
            status="compared",
            before=run_json(found.before),
            after=run_json(found.after),
            lines=found.lines,
        ),
        found.tables,
        [found.sentence, *found.lines],
        written=None,
        status="compared",
    )


def run_json(run: PastRun) -> dict[str, Json]:
    """Return a past run as JSON."""
    from modetune.flows.report.parameter_tables import unit_of
    from modetune.flows.studies.history.trends import frequency_errors

    parameters = [
        json_object(
            name=name,
            value=run.values[place],
            unit=unit_of(run.units, run.quantities[place]),
            deck_value=run.deck_values[place],
            relative=run.values[place] / run.references[place],
            standard_error=run.standard_errors[place],
            repeatability=run.repeatability[place],
        )
        for place, name in enumerate(run.names)
    ]
    errors = frequency_errors(run)
    modes = [
        json_object(
            mode=label,
            test_hz=run.test_hz[place],
            damping_ratio=run.damping_ratios[place],
            updated_hz=run.updated_hz[place],
            error=errors[place],
            mac=run.macs[place],
            elastic_mode=int(run.elastic_modes[place]) or None,
        )
        for place, label in enumerate(run.modes)
    ]
    return json_object(
        run,
        "at number state drift status verdict reason environment test_digest deck_digest settings "
        "solver solver_version modetune_version",
        parameters=parameters,
        modes=modes,
    )


def csv_rows(runs: tuple[PastRun, ...]) -> list[list[object]]:
    """Return the table of runs with all columns, its heading first; unknown values are None."""
    names = tuple(dict.fromkeys(name for run in runs for name in run.names))
    modes = tuple(dict.fromkeys(label for run in runs for label in run.modes))
    quantities = tuple(dict.fromkeys(name for run in runs for name in run.environment))
    head = ["run", "at", "state", "status", "verdict", "drift"]
    head += [
        f"{name}{what}" for name in names for what in ("", " repeatability", " standard error")
    ]
    head += [f"mode {label} {what}" for label in modes for what in ("test_hz", "updated_hz", "mac")]
    head += quantities
    rows: list[list[object]] = [list(head)]
    for run in runs:
        row: list[object] = [
            run.number, run.at, run.state, run.status, run.verdict.value, run.drift
        ]  # fmt: skip
        for name in names:
            at = run.names.index(name) if name in run.names else None
            for values in (run.values, run.repeatability, run.standard_errors):
                row.append(None if at is None else _number(values[at]))
        for label in modes:
            at = run.modes.index(label) if label in run.modes else None
            for values in (run.test_hz, run.updated_hz, run.macs):
                row.append(None if at is None else _number(values[at]))
        row += [run.environment.get(name) for name in quantities]
        rows.append(row)
    return rows


def _number(value: Any) -> float | None:
    return float(value) if value == value else None  # NaN is an empty cell


def write_csv(path: Path, runs: tuple[PastRun, ...]) -> Path:
    """Write the table of runs. Raises StorageUnavailable."""
    from modetune.core.storage.files import writing

    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(csv_rows(runs))
    with writing(path, "name another file with --csv") as part:
        part.write_text(text.getvalue(), encoding="utf-8")
    return path
