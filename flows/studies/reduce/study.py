"""`modetune model reduce`: a model condensed to a few of its unknowns, for other programs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.storage.keys import Json
from modetune.flows.report.tables import Column, json_object, table_of
from modetune.flows.studies.reduce.request import ReductionRequest
from modetune.flows.studies.result import StudyResult
from modetune.flows.studies.study import ModelOptions, StudyContext, study

if TYPE_CHECKING:
    from modetune.flows.studies.reduce.reduction import ModelReduction


@study(ModelOptions)
def reduce(
    on: StudyContext,
    request: ReductionRequest,
    out: Annotated[
        Path | None,
        typer.Option(
            help="File for the matrices: .npz, .op4, .bdf (DMIG), or .yaml, a model that "
            "modetune reads."
        ),
    ] = None,
) -> StudyResult:
    """Reduce a model to a few unknowns, and compare its frequencies with the full model's."""
    from modetune.adapters.matrices.export import check_form, write_matrices
    from modetune.core.modes import dof_name
    from modetune.flows.studies.reduce.reduction import reduce_model

    if out is not None:
        check_form(out)
    found = reduce_model(on.campaign, on.values, request)
    outputs = [] if out is None else [lambda: write_matrices(out, found.matrices)]
    held = f"held in place, so left out: {', '.join(map(dof_name, found.held))}"
    lines = [*([held] if found.held else []), found.sentence]
    title = f"Reduced to {len(found.masters)} masters"
    tables = [table_of(title, _rows(found), ReducedMode)]
    return StudyResult(found, found.sentence, summary(found), tables, lines, outputs=outputs)


@dataclass(frozen=True, slots=True)
class ReducedMode:
    """A mode of the full model and of the reduced one; error: relative, NaN of rigid modes."""

    mode: Annotated[int, Column("mode")]
    full_hz: Annotated[float, Column("full model", "Hz", ".5g")]
    reduced_hz: Annotated[float, Column("reduced", "Hz", ".5g")]
    error: Annotated[float, Column("error", "%", "+.3g", "rigid")]
    shared: Annotated[float, Column("of its kinetic energy kept", "%", ".4g")]


def _rows(found: ModelReduction) -> list[ReducedMode]:
    columns = found.full_hz, found.reduced_hz, found.errors, found.shared
    values = zip(*(column.tolist() for column in columns), strict=True)
    return [ReducedMode(number, *row) for number, row in enumerate(values, start=1)]


def summary(found: ModelReduction) -> dict[str, Json]:
    """Return the JSON object of a reduction."""
    from modetune.core.modes import dof_name

    return json_object(
        found,
        "method",
        status="done",
        unknowns=found.n_full,
        masters=[dof_name(dof) for dof in found.masters],
        held=[dof_name(dof) for dof in found.held],
        condition=found.reduction.condition,
        converged=found.reduction.converged,
        modes=_rows(found),
    )
