"""`modetune model direct`: direct correction of stiffness and mass matrices."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.storage.keys import Json
from modetune.flows.report.tables import json_object, table_of
from modetune.flows.studies.direct.request import DirectRequest
from modetune.flows.studies.result import StudyResult
from modetune.flows.studies.study import ModelOptions, StudyContext, study

if TYPE_CHECKING:
    from modetune.flows.studies.direct.correction import DirectCorrection


@study(ModelOptions)
def direct(
    on: StudyContext,
    request: DirectRequest,
    out: Annotated[
        Path | None,
        typer.Option(help="File for the corrected matrices: .npz, .op4, .bdf (DMIG) or .yaml."),
    ] = None,
) -> StudyResult:
    """Correct stiffness and mass matrices directly, and report what that breaks."""
    from modetune.adapters.matrices.export import check_form, write_matrices
    from modetune.flows.studies.direct.correction import CorrectedMode, correct_directly

    if out is not None:
        check_form(out)
    found = correct_directly(
        on.campaign, on.values, request.method, request.filling, request.mass_normalised
    )
    outputs = [] if out is None else [lambda: write_matrices(out, found.matrices)]
    lines = [*found.notes, found.sentence]
    tables = [table_of("Modes of the corrected model", found.modes, CorrectedMode)]
    return StudyResult(found, found.sentence, summary(found), tables, lines, outputs=outputs)


def summary(found: DirectCorrection) -> dict[str, Json]:
    """Return the JSON object of a direct correction."""
    return json_object(
        found,
        "method filling imposed lost modes why_no_modes damage residual rigid_hz condition notes",
        status="done",
        unknowns=found.n,
        measured=found.n_seen,
    )
