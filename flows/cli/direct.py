"""`modetune direct`: whole matrices corrected from measured modes, and what that breaks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.near_names import named
from modetune.core.storage.keys import Json
from modetune.flows.cli.ending import StudyEnd
from modetune.flows.cli.study import ModelOptions, Opened, study
from modetune.flows.report.tables import json_object, table_of

if TYPE_CHECKING:
    from modetune.flows.studies.condensation.direct import DirectCorrection


@study(ModelOptions)
def direct(
    on: Opened,
    method: Annotated[
        str,
        typer.Option(
            help="berman (mass and stiffness), baruch (stiffness alone) or error_matrix "
            "(first order)."
        ),
    ] = "berman",
    filling: Annotated[
        str,
        typer.Option(help="How unmeasured unknowns are filled: kidder, static, serep or model."),
    ] = "kidder",
    mass_normalised: Annotated[
        bool,
        typer.Option(
            "--mass-normalised",
            help="The test's shapes are of unit modal mass in the model's own unit.",
        ),
    ] = False,
    out: Annotated[
        Path | None, typer.Option(help="Corrected matrices: .npz, .op4, .bdf (DMIG) or .yaml.")
    ] = None,
) -> StudyEnd:
    """Correct stiffness and mass as whole matrices, and tell what that breaks in them."""
    from modetune.adapters.matrices.exchange import check_form, write_matrices
    from modetune.flows.studies.condensation.direct import (
        FILLINGS,
        METHODS,
        CorrectedMode,
        correct_directly,
    )

    if out is not None:
        check_form(out)
    ways = named("--method", method, METHODS), named("--filling", filling, FILLINGS)
    found = correct_directly(on.campaign, on.values, *ways, mass_normalised, on.pages)
    written = write_matrices(out, found.matrices) if out is not None else ()
    lines = [*found.notes, found.sentence]
    tables = [table_of("Modes of the corrected model", found.modes, CorrectedMode)]
    return StudyEnd(found.sentence, told(found), tables, lines, written)


def told(found: DirectCorrection) -> dict[str, Json]:
    """The `--json` object of `modetune direct`."""
    return json_object(
        found,
        "method filling imposed lost modes why_no_modes damage residual rigid_hz condition notes",
        status="done",
        unknowns=found.n,
        measured=found.n_seen,
    )
