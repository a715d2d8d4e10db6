"""The display of a campaign on a terminal: a line per iteration, and tables at the end.

Progress goes to standard error, results to standard output.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path

from rich.console import Console
from rich.text import Text

from modetune.core.correlation.holdout import HeldOut
from modetune.core.storage.campaign_record import CampaignRecord, IterationRecord
from modetune.core.updating.trust import trust_sentences
from modetune.flows.jobs.progress import JobProgress
from modetune.flows.report.field_tables import brief_record
from modetune.flows.report.headline import first_line
from modetune.flows.report.iteration_tables import IterationRow, iteration_row
from modetune.flows.report.mode_tables import (
    held_out_lines,
    held_out_table,
    mode_label,
    mode_table,
    unmatched_sentence,
)
from modetune.flows.report.parameter_tables import BRIEF_PARAMETERS, parameter_table
from modetune.flows.report.report_file import PAGE
from modetune.flows.report.response_tables import response_table
from modetune.flows.report.tables import OUTSIDE, Table, columns_of, show
from modetune.flows.updating.forecast import Forecast, cost_text, forecast_text
from modetune.flows.updating.record import CampaignRun


def iteration_line(record: IterationRecord) -> str:
    """Return one line: the difference from the test, the decision, and the cost."""
    row = iteration_row(record)
    shown = {
        column.name: column.shown(getattr(row, column.name)) for column in columns_of(IterationRow)
    }
    text = f"frequencies within {shown['largest_error']} % (mean {shown['mean_error']} %)"
    if math.isfinite(row.least_mac):
        text += f", MAC at least {shown['least_mac']}"
    notes = [text] if record.accepted else [f"{text}, not accepted"]
    if record.number and record.sensitivity_age:
        age = record.sensitivity_age
        notes.append(f"with a sensitivity from {age} iteration{'' if age == 1 else 's'} ago")
    if record.sensitivity_skipped:
        notes.append("no new sensitivity: the errors change too little (e2)")
    if record.decision and record.number:
        notes.append(record.decision)
    runs = [
        f"{number} {kind} job{'' if number == 1 else 's'}"
        for number, kind in ((row.modal_runs, "modal"), (row.sensitivity_runs, "sensitivity"))
        if number
    ]
    without = "cached" if row.reused else "no solver job"
    ran = " and ".join(runs) or without
    name = f"iteration {record.number}" if record.number else "start"
    return f"{name}: {'; '.join([*notes, ran])}, {shown['wall_s']} s"


class ConsoleProgress:
    """Progress on a terminal: running jobs with the remaining time, and a line per iteration.

    jobs: an existing display of jobs.
    """

    def __init__(self, console: Console, jobs: JobProgress | None = None) -> None:
        self.console = console
        self._jobs = jobs or JobProgress(console)
        self._told = False

    @contextlib.contextmanager
    def shown(self) -> Iterator[ConsoleProgress]:
        """Show the display while a campaign runs."""
        with self._jobs.shown():
            yield self

    def keep(self, folder: Path) -> None:
        """Also write the progress of the jobs to a file in a run folder."""
        self._jobs.keep(folder)

    def working(self, text: str) -> None:
        self._jobs.working(text)

    def forecast(self, forecast: Forecast) -> None:
        """Print a line once all costs are known; then show the rest next to running jobs."""
        self._jobs.ahead(f"to the end at most {cost_text(forecast.most)}" if forecast.known else "")
        if forecast.known and not self._told:
            self._told = True
            self.console.print(Text(forecast_text(forecast)), soft_wrap=True)

    def iteration(self, record: IterationRecord) -> None:
        # soft_wrap: a line stays a line where the output is not a terminal.
        self.console.print(Text(iteration_line(record)), soft_wrap=True)

    def page(self, address: str) -> None:
        self.console.print(Text(f"this run's page: {address}"), soft_wrap=True)


def pairing_lines(record: CampaignRecord) -> list[str]:
    """Return a line for each mode that is not paired by the order of frequencies."""
    pairing = record.best.pairing
    return [
        f"test mode {mode_label(record, measured)} is elastic mode {computed + 1} of the model: "
        f"{reason}"
        for measured, computed, order, reason in zip(
            pairing.measured.tolist(),
            pairing.computed.tolist(),
            pairing.computed.argsort().argsort() - pairing.measured.argsort().argsort(),
            pairing.reasons,
            strict=True,
        )
        # Modes of several configurations have other positions together than in their own case.
        if (order and not record.configurations)
        or not reason.startswith(("highest MAC", "no shape", "continues"))
    ]


def trust_lines(record: CampaignRecord) -> list[str]:
    """Return the verdict on the parameters, then a line for each flag."""
    if record.trust is None:
        return []
    flagged = [item.sentence for item in record.trust.flagged]
    return [*trust_sentences(record.trust), *(f"- {line}" for line in flagged)]


def structure_lines(record: CampaignRecord) -> list[Text]:
    """Return the state of the structure over its runs, red where it has changed."""
    if not record.drift:
        return []
    style = OUTSIDE if record.state == "changed" else ""
    return [Text(f"structure: {record.drift}", style=style)]


def held_out_parts(held: HeldOut | None) -> list[Table | Text]:
    """Return a table and sentences about held-out modes; empty if there are none."""
    return [held_out_table(held), *(Text(line, style=OUTSIDE) for line in held_out_lines(held))]


def show_run(console: Console, run: CampaignRun) -> None:
    """Print the end of a campaign: tables, the reason it ended, its cost and its files."""
    record, page = run.record, run.folder / PAGE
    brief = brief_record(record)
    runs, skipped = record.runs, sum(item.sensitivity_skipped for item in record.iterations)
    by_e2 = f"; sensitivity skipped (e2) {skipped} time{'' if skipped == 1 else 's'}" * (
        skipped > 0
    )
    licences = f", {runs.licence_s / 60.0:.1f} licence-minutes" if runs.licence_s else ""
    parts = [
        first_line(record),
        mode_table(record),
        *filter(None, (*pairing_lines(record), unmatched_sentence(record))),
        response_table(record),
        *held_out_parts(record.held_out),
        parameter_table(brief, BRIEF_PARAMETERS),
        *brief.splits,
        *trust_lines(record),
        *structure_lines(record),
        f"{record.status}: {record.reason}",
        f"iterations: {record.iterations[-1].number}; {runs.sentence}{by_e2}; "
        f"{record.wall_s:.1f} s, {runs.core_s / 60.0:.1f} core-minutes{licences}",
        f"record       {run.folder / 'campaign.h5'}",
        f"updated deck {run.updated_deck}",
        *([f"report       {page}"] if page.exists() else []),
    ]
    show(parts, console)
