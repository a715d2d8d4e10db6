"""Tables of iterations: their progress, costs, and jobs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from modetune.core.storage.campaign_record import CampaignRecord, IterationRecord
from modetune.flows.report.tables import Column, Table, table_of


@dataclass(frozen=True, slots=True)
class IterationRow:
    """An evaluated point: its agreement with the test, the decision, and the cost.

    sensitivity has method and age of the sensitivity behind the step to this point, and whether e2
    skipped a new one.
    """

    iteration: Annotated[int, Column("iteration")]
    largest_error: Annotated[float, Column("largest error", "%", ".2f")]
    mean_error: Annotated[float, Column("mean error", "%", ".2f")]
    least_mac: Annotated[float, Column("lowest MAC", form=".3f")]
    misfit: Annotated[float, Column("weighted residual", form=".3g")]
    slope: Annotated[float, Column("slope", form=".2g")]
    sensitivity: Annotated[str, Column("sensitivity of the step")]
    kept: Annotated[bool, Column("kept")]
    decision: Annotated[str, Column("decision")]
    modal_runs: Annotated[int, Column("modal runs")]
    sensitivity_runs: Annotated[int, Column("sensitivity runs")]
    reused: Annotated[int, Column("cached")]
    core_minutes: Annotated[float, Column("core-minutes", form=".3g")]
    licence_minutes: Annotated[float, Column("licence-minutes", form=".3g")]
    wall_s: Annotated[float, Column("time", "s", ".1f")]


#: Columns of the two tables.
PROGRESS = "iteration largest_error mean_error least_mac misfit slope sensitivity kept decision"
COSTS = "iteration modal_runs sensitivity_runs reused core_minutes licence_minutes wall_s"


def iteration_row(item: IterationRecord) -> IterationRow:
    errors, macs, runs = np.abs(item.frequency_errors), item.pairing.mac, item.runs
    return IterationRow(
        iteration=item.number,
        largest_error=float(errors.max()),
        mean_error=float(errors.mean()),
        least_mac=float(macs.min()),
        misfit=item.residual.misfit,
        slope=item.slope,
        sensitivity=_sensitivity(item),
        kept=item.accepted,
        decision=item.decision,
        modal_runs=runs.modal,
        sensitivity_runs=runs.sensitivity,
        reused=runs.reused,
        core_minutes=runs.core_s / 60.0,
        licence_minutes=runs.licence_s / 60.0,
        wall_s=item.wall_s,
    )


def iteration_table(iterations: Sequence[IterationRecord]) -> Table:
    """Return a table with one row per evaluated point."""
    rows = [iteration_row(item) for item in iterations]
    return table_of("Iterations", rows, IterationRow, PROGRESS)


def run_table(record: CampaignRecord) -> Table:
    """Return the table of solver runs and costs of each iteration, including failed runs."""
    runs = record.runs
    total = (
        "all",
        runs.modal,
        runs.sensitivity,
        runs.reused,
        runs.core_s / 60.0,
        runs.licence_s / 60.0,
        record.wall_s,
    )
    rows = [iteration_row(item) for item in record.iterations]
    return table_of("Solver runs", rows, IterationRow, COSTS, foot=[total])


def key_table(record: CampaignRecord) -> Table:
    """Return the keys of all solver jobs in the store."""
    columns = (Column("iteration"), Column("job", words=True), Column("key", words=True))
    rows = [
        (item.number, job, key)
        for item in record.iterations
        for job, keys in (("modal", (item.modal_key,)), ("sensitivity", item.sensitivity_keys))
        for key in dict.fromkeys(keys)
    ]
    return Table("", columns, tuple(rows))


def _sensitivity(item: IterationRecord) -> str:
    if not item.sensitivity_methods:
        return ""
    methods = ", ".join(dict.fromkeys(name.replace("_", " ") for name in item.sensitivity_methods))
    age = f", {item.sensitivity_age} iterations old" if item.sensitivity_age else ""
    skipped = "; new one skipped (e2)" if item.sensitivity_skipped else ""
    return f"{methods}{age}{skipped}"
