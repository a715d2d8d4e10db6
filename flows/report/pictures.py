"""The report's figures as files for print, PNG or SVG."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from matplotlib.figure import Figure

from modetune.core.record import CampaignRecord
from modetune.flows.report import figures
from modetune.flows.report.comparison import (
    fresh_matrices,
    mac_table,
    mode_rows,
    residual_norm,
    sensor_agreement,
)

Form = Literal["png", "svg"]


def write_pictures(record: CampaignRecord, folder: Path, form: Form) -> tuple[Path, ...]:
    """Write every figure that the record gives. Raises StorageUnavailable."""
    return tuple(
        figures.save(figure, folder / f"{name}.{form}") for name, figure in drawn_figures(record)
    )


def drawn_figures(record: CampaignRecord) -> Iterator[tuple[str, Figure]]:
    """Name and figure of everything the record gives, one after the other."""
    rows, first, last = mode_rows(record), record.iterations[0], record.best
    title = figures.plain(record.name)
    if record.test.has_shapes and mac_table(record, last).size:
        tables = [("before", mac_table(record, first)), ("after", mac_table(record, last))]
        yield "mac", figures.mac_figure(title, tables)
        yield "mac_map", figures.mac_map_figure(title, tables, record.test.numbers)
    hz = [np.array([getattr(row, name) for row in rows])
          for name in ("test_hz", "before_hz", "after_hz")]  # fmt: skip
    yield "frequencies", figures.frequency_figure(title, [row.number for row in rows], *hz)
    kept = [item for item in record.iterations if item.accepted]
    names = [figures.plain(name) for name in record.parameters.names]
    yield (
        "parameters",
        figures.parameter_figure(
            title,
            names,
            [item.number for item in kept],
            np.array([item.parameters for item in kept]),
        ),
    )
    if matrices := fresh_matrices(record):
        numbers = [row.number for row in rows]
        yield "sensitivities", figures.sensitivity_figure(title, numbers, names, matrices)
    yield (
        "convergence",
        figures.convergence_figure(
            title,
            [item.number for item in record.iterations],
            np.array([residual_norm(item) for item in record.iterations]),
            np.array([item.slope for item in record.iterations]),
            np.array([item.sensitivity_skipped for item in record.iterations]),
            record.e2,
        ),
    )
    found = sensor_agreement(record)
    if found is not None and record.test.has_shapes:
        yield "comac", figures.comac_figure(title, found.labels, found.before, found.after)
