"""`modetune model expand`: measured shapes on the whole mesh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.storage.keys import Json
from modetune.flows.report.tables import Column, Table, json_object, table_of
from modetune.flows.studies.expand.request import ExpansionRequest
from modetune.flows.studies.result import StudyResult
from modetune.flows.studies.study import Figures, ModelOptions, StudyContext, study

if TYPE_CHECKING:
    from modetune.flows.studies.expand.expansion import Expansions


@dataclass(frozen=True)
class ExpandOptions(ModelOptions):
    """Options of the expansion, which draws figures."""

    figures: Figures = None


@study(ExpandOptions)
def expand(
    on: StudyContext,
    request: ExpansionRequest,
    out: Annotated[
        Path | None, typer.Option(help="Test file for the shapes at all nodes: .csv, .h5 or .unv.")
    ] = None,
    paraview: Annotated[
        Path | None, typer.Option(help="Folder for expanded.pvd, which ParaView opens.")
    ] = None,
) -> StudyResult:
    """Expand measured shapes to the whole mesh, and compute the error at held-out sensors."""
    from modetune.flows.studies.expand.expansion import (
        check_files,
        error_chart,
        expand_shapes,
        write_files,
    )

    check_files(on.campaign, out, paraview)
    found = expand_shapes(on.campaign, on.values, request.method, request.modes)
    lines = [f"{item.method}: {item.unavailable}" for item in found.methods if item.unavailable]
    if found.left_out:
        lines.append(f"held in place in the model, so left out: {', '.join(found.left_out)}")
    charts = {"held_out": error_chart(found)}
    lines.append(found.sentence)
    return StudyResult(
        found,
        found.sentence,
        summary(found),
        [_table(found)],
        lines,
        charts=charts,
        outputs=[lambda: write_files(on.campaign, found, out, paraview)],
    )


@dataclass(frozen=True, slots=True)
class ExpandedRow:
    """A method: its error at held-out sensors for all modes and for each, and its change of
    measured values."""

    method: Annotated[str, Column("method")]
    error: Annotated[float, Column("at held-out sensors", "%", ".2f")]
    held_out: Annotated[tuple[float, ...], Column("of each mode", "%", ".1f")]
    at_sensors: Annotated[float, Column("changes measured values by", "%", ".2f")]
    basis_modes: int
    condition: Annotated[float, Column("condition number", form=".1e")]
    unavailable: str


def _rows(found: Expansions) -> list[ExpandedRow]:
    return [
        ExpandedRow(
            f"{item.method}, basis of {item.n_basis}" if item.n_basis else item.method,
            item.error,
            tuple(item.held_out.tolist()),
            float((item.at_sensors**2).mean() ** 0.5),
            item.n_basis,
            item.condition,
            item.unavailable,
        )
        for item in found.methods
    ]


def summary(found: Expansions) -> dict[str, Json]:
    """Return the JSON object of an expansion."""
    return json_object(
        found,
        "best left_out frequencies_hz",
        status="done",
        modes=found.numbers,
        methods=_rows(found),
    )


def _table(found: Expansions) -> Table:
    rows = [row for row in _rows(found) if not row.unavailable]
    modes = ", ".join(map(str, found.numbers))
    return table_of(f"Error of the expansion of modes {modes}", rows, ExpandedRow)
