"""`modetune direct`: whole matrices corrected from measured modes, and what that breaks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.near_names import named
from modetune.core.storage.keys import Json
from modetune.flows.cli.ending import StudyEnd
from modetune.flows.cli.study import ModelOptions, Opened, study
from modetune.flows.report.tables import Column, Table, json_object, table_of

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
    from modetune.flows.studies.condensation.direct import FILLINGS, METHODS, correct_directly

    if out is not None:
        check_form(out)
    ways = named("--method", method, METHODS), named("--filling", filling, FILLINGS)
    found = correct_directly(on.campaign, on.values, *ways, mass_normalised, on.pages)
    written = write_matrices(out, found.matrices) if out is not None else ()
    lines = [*found.notes, found.sentence]
    return StudyEnd(found.sentence, told(found), _tables(found), lines, written)


@dataclass(frozen=True, slots=True)
class CorrectedRow:
    """A mode of the corrected model; test: the imposed mode that it is, 0 where it is none."""

    mode: Annotated[int, Column("mode")]
    corrected_hz: Annotated[float, Column("corrected", "Hz", ".5g")]
    test: Annotated[str, Column("test mode")]
    difference: Annotated[float, Column("off the test", "%", "+.2g")]
    initial_hz: Annotated[float, Column("most like before", "Hz", ".5g")]
    mac: Annotated[float, Column("by MAC", form=".3f")]


def _tables(found: DirectCorrection) -> list[Table]:
    rows = [
        CorrectedRow(
            place,
            item.corrected_hz,
            str(item.test or ""),
            item.difference,
            item.initial_hz,
            item.mac,
        )
        for place, item in enumerate(found.modes, start=1)
    ]
    return [table_of("Modes of the corrected model", rows, CorrectedRow)]


def told(found: DirectCorrection) -> dict[str, Json]:
    """The `--json` object of `modetune direct`."""
    return json_object(
        found,
        "method filling imposed lost modes why_no_modes damage residual rigid_hz condition notes",
        status="done",
        unknowns=found.n,
        measured=found.n_seen,
    )
