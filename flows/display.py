"""What a person sees of a campaign: a line an iteration, tables at the end.

Progress goes to standard error, results to standard output.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import numpy as np
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

from modetune.core.judgement import trust_sentences
from modetune.core.record import CampaignRecord, IterationRecord
from modetune.flows.forecast import Forecast, cost_text, forecast_text
from modetune.flows.report.drawing import PAGE
from modetune.flows.running import CampaignRun
from modetune.flows.twin import Twin
from modetune.flows.validation.table import show_held_out

HEADER = " it   worst    mean     MAC    slope   age  new runs        s"


def iteration_line(record: IterationRecord) -> str:
    """One line: errors, least MAC, slope, age of the sensitivity behind the step, runs, time."""
    errors = 100.0 * np.abs(record.frequency_errors)
    mac = record.pairing.mac
    least = f"{mac.min():.3f}" if np.isfinite(mac).all() else "-"
    slope = f"{record.slope:.2g}" if np.isfinite(record.slope) else "-"
    ran = f"{record.runs.modal}+{record.runs.sensitivity}"
    age = str(record.sensitivity_age) if record.number else "-"
    notes = [] if record.accepted else ["not kept"]
    if record.sensitivity_skipped:
        notes.append("sensitivity skipped (e2)")
    if record.decision and record.number:
        notes.append(record.decision)
    line = (
        f"{record.number:3d} {errors.max():6.2f}% {errors.mean():6.2f}% {least:>7} {slope:>8} "
        f"{age:>5} {ran:>9} {record.wall_s:8.1f}"
    )
    return f"{line}  {'; '.join(notes)}".rstrip()


class ConsoleProgress:
    """Progress on a terminal: what is running with its time, and a line an iteration."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self._live = Progress(
            SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn(),
            console=console, transient=True, disable=not console.is_terminal,
        )  # fmt: skip
        self._task: TaskID | None = None
        self._told, self._left = False, ""

    @contextlib.contextmanager
    def shown(self) -> Iterator[ConsoleProgress]:
        """Show the display while a campaign runs."""
        with self._live:
            yield self

    def working(self, text: str) -> None:
        if self._task is not None:
            self._live.remove_task(self._task)
        self._task = self._live.add_task(f"{text}{self._left}", total=None)

    def forecast(self, forecast: Forecast) -> None:
        """A line as soon as all costs are known, then what is left, beside what is running."""
        left = (
            f"left at most: {cost_text(forecast.most)}" if forecast.known else "cost not known yet"
        )
        self._left = f" ({left})"
        if forecast.known and not self._told:
            self._told = True
            self.console.print(Text(forecast_text(forecast)), soft_wrap=True)

    def iteration(self, record: IterationRecord) -> None:
        if record.number == 0:
            self.console.print(Text(HEADER))
        # soft_wrap: a line stays a line where the output is no terminal.
        self.console.print(Text(iteration_line(record)), soft_wrap=True)


def mode_table(record: CampaignRecord) -> Table:
    """Frequencies and MAC before and after."""
    table = Table(title="Modes", title_justify="left")
    for heading in ("test", "model", "test Hz", "before Hz", "error %", "after Hz", "error %",
                    "MAC", "after"):  # fmt: skip
        table.add_column(heading, justify="right")
    first, last = record.iterations[0], record.best
    for pair in range(len(record.test.numbers)):
        number = int(first.pairing.measured[pair])
        before = first.computed.frequencies_hz[first.pairing.computed[pair]]
        after = last.computed.frequencies_hz[last.pairing.computed[pair]]
        table.add_row(
            str(record.test.numbers[number]),
            str(last.pairing.computed[pair] + 1),
            f"{record.test.modes.frequencies_hz[number]:.2f}",
            f"{before:.2f}",
            f"{100 * first.frequency_errors[pair]:+.2f}",
            f"{after:.2f}",
            f"{100 * last.frequency_errors[pair]:+.2f}",
            _share(first.pairing.mac[pair]),
            _share(last.pairing.mac[pair]),
        )
    means = [100 * float(np.abs(item.frequency_errors).mean()) for item in (first, last)]
    table.add_section()
    table.add_row("mean", "", "", "", f"{means[0]:.2f}", "", f"{means[1]:.2f}", "", "")
    return table


def pairing_lines(record: CampaignRecord) -> list[str]:
    """What pairing did that the order of frequencies does not tell, a line a mode."""
    pairing = record.best.pairing
    return [
        f"test mode {record.test.numbers[measured]} is elastic mode {computed + 1} of the model: "
        f"{reason}"
        for measured, computed, reason in zip(
            pairing.measured.tolist(), pairing.computed.tolist(), pairing.reasons, strict=True
        )
        # Side by side the modes of several configurations have other positions than alone.
        if (measured != computed and not record.configurations)
        or not reason.startswith(("highest MAC", "no shape", "continues"))
    ]


def parameter_table(record: CampaignRecord) -> Table:
    """Parameters before and after, relative to the deck and in its units."""
    table = Table(
        title="Parameters (±: standard error; by test: its share of the answer)",
        title_justify="left",
    )
    table.add_column("parameter", no_wrap=True)
    for heading in ("deck", "updated", "change %", "± %", "by test %", "bounds"):
        table.add_column(heading, justify="right")
    stuck = record.parameters.at_bounds(record.updated)
    for place, item in enumerate(record.parameters.parameters):
        error = record.standard_errors[place]
        table.add_row(
            item.name,
            f"{record.deck_values[place]:.6g}",
            f"{record.deck_values[place] * record.updated[place]:.6g}",
            f"{100 * (record.updated[place] - 1):+.2f}",
            f"{100 * error:.2f}" if np.isfinite(error) else "not known",
            _test_share(record, place),
            f"{item.lower:g} .. {item.upper:g}" + (" (on it)" if item.name in stuck else ""),
        )
    return table


def _test_share(record: CampaignRecord, place: int) -> str:
    share = None if record.trust is None else record.trust.parameters[place].test_share
    return "-" if share is None else f"{100 * share:.0f}"


def trust_lines(record: CampaignRecord) -> list[str]:
    """How far the parameters can be trusted: the verdict, then what is flagged, a line each."""
    if record.trust is None:
        return []
    flagged = [item.sentence for item in record.trust.flagged]
    return [*trust_sentences(record.trust), *(f"- {line}" for line in flagged)]


def show_run(console: Console, run: CampaignRun) -> None:
    """The end of a campaign: tables, the reason it ended, its cost, and where the files are."""
    record = run.record
    console.print(mode_table(record))
    for line in pairing_lines(record):
        console.print(Text(line), soft_wrap=True)
    show_held_out(console, record.held_out, record.configurations)
    console.print(parameter_table(record))
    for line in trust_lines(record):
        console.print(Text(line), soft_wrap=True)
    runs, skipped = record.runs, sum(item.sensitivity_skipped for item in record.iterations)
    console.print(Text(f"{record.status}: {record.reason}"), soft_wrap=True)
    console.print(
        Text(
            f"iterations: {record.iterations[-1].number}; solver runs: {runs.modal} modal, "
            f"{runs.sensitivity} sensitivity, {runs.reused} answered by the store; sensitivity "
            f"skipped by e2 in {skipped}; {record.wall_s:.1f} s, "
            f"{runs.core_s / 60.0:.1f} core-minutes"
            + (f", {runs.licence_s / 60.0:.1f} licence-minutes" if runs.licence_s else "")
        ),
        soft_wrap=True,
    )
    console.print(Text(f"record       {run.folder / 'campaign.h5'}"), soft_wrap=True)
    console.print(Text(f"updated deck {run.updated_deck}"), soft_wrap=True)
    if (page := run.folder / PAGE).exists():
        console.print(Text(f"report       {page}"), soft_wrap=True)


def show_twin(console: Console, twin: Twin) -> None:
    """Frequencies of all solvers side by side, differences and MAC from the first."""
    table = Table(title=f"Elastic modes of {twin.name}", title_justify="left")
    first, *others = twin.solvers
    table.add_column("mode", justify="right")
    table.add_column(f"{first.solver} Hz", justify="right")
    for other in others:
        for heading in (f"{other.solver} Hz", "mode", "differs %", "MAC"):
            table.add_column(heading, justify="right")
    for pair, frequency in enumerate(first.frequencies_hz.tolist()):
        row = [str(pair + 1), f"{frequency:.4f}"]
        for other in others:
            row += [
                f"{other.frequencies_hz[pair]:.4f}",
                str(other.pairing.computed[pair] + 1),
                f"{100 * twin.differences(other)[pair]:+.3f}",
                f"{other.pairing.judged_mac[pair]:.4f}",
            ]
        table.add_row(*row)
    console.print(table)
    for item in twin.solvers:
        console.print(
            Text(
                f"{item.solver} {item.version}: {item.result.n_rigid} rigid-body modes, mass "
                f"{item.result.mass:.6g}, {item.wall_s:.1f} s"
            ),
            soft_wrap=True,
        )
    for solver, reason in twin.absent:
        console.print(Text(f"{solver} did not run: {reason}"), soft_wrap=True)


def _share(value: float) -> str:
    return f"{value:.3f}" if np.isfinite(value) else "-"
