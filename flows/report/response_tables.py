"""The table of responses other than frequencies and shapes, before and after."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.updating.parameter_steps import breach
from modetune.core.updating.responses.response import block_parts
from modetune.flows.report.tables import Column, Table, table_of
from modetune.flows.responses.residuals import response_types
from modetune.flows.responses.response import ResponseSection


@dataclass(frozen=True, slots=True)
class ResponseRow:
    """A measured value and the model's, in the same unit; NaN for a mere limit."""

    kind: str
    item: Annotated[str, Column("response")]
    measured: Annotated[float, Column("test", form=".6g")]
    initial: Annotated[float, Column("before", form=".6g")]
    updated: Annotated[float, Column("after", form=".6g")]
    deviation: Annotated[float, Column("deviation", form=".3g")]
    least: Annotated[float, Column("at least", form=".6g")]
    most: Annotated[float, Column("at most", form=".6g")]
    breaks: bool


def response_rows(record: CampaignRecord) -> tuple[ResponseRow, ...]:
    """Return a row for each response other than frequencies and shapes."""
    return tuple(_rows(record))


def _rows(record: CampaignRecord) -> Iterator[ResponseRow]:
    first, types = block_parts(record.iterations[0].residual), response_types()
    for before, after in zip(first, block_parts(record.best.residual), strict=True):
        block = after.blocks[0]
        scores = types[block.kind].scores if block.kind in types else ResponseSection.scores
        initial, updated = scores(before), scores(after)
        if initial is not None and updated is not None:
            for (item, target, start), (_, _, end) in zip(initial, updated, strict=True):
                numbers = item, target, start, end, np.nan, np.nan, np.nan
                yield ResponseRow(block.kind, *numbers, False)
            continue
        limits = after.limits
        outside = breach(after.values, limits) > 0.0
        for row, label in enumerate(after.labels if block.measured.size else ()):
            target, used = float(block.measured[row]), bool(after.weights[row] > 0.0)
            ends = np.where(np.isfinite(limits[row]), target - limits[row], np.nan)
            yield ResponseRow(
                kind=block.kind,
                item=label,
                measured=target if used else np.nan,
                initial=target - float(before.values[row]),
                updated=target - float(after.values[row]),
                deviation=float(np.sqrt(after.noise[row])) if used else np.nan,
                least=float(ends[1]),
                most=float(ends[0]),
                breaks=bool(outside[row]),
            )


def response_table(record: CampaignRecord) -> Table:
    """Return the table of other responses; values that violate a limit are marked."""
    rows = response_rows(record)
    broken = [(place, "updated") for place, row in enumerate(rows) if row.breaks]
    return table_of("Other responses", rows, ResponseRow, outside=broken)
