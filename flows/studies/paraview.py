"""Modes of a campaign's model before and after updating, as files for ParaView.

Each state takes one modal job with shapes at all nodes. For a CalculiX deck it leaves its .frd
file, which ccx2paraview converts; where the store has the result of an earlier job and the file is
gone, and for all other solvers, the files are written from mesh and result, in the same form.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from modetune.adapters.calculix.frd import convert_frd
from modetune.adapters.calculix.model import CalculixModel
from modetune.adapters.calculix.solver import JOB, CalculixProgram
from modetune.adapters.paraview import check_series, mode_grids, write_fields, write_series
from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import CampaignError
from modetune.core.near_names import named
from modetune.core.parameters import Values
from modetune.core.storage.campaign_record import CAMPAIGN, read_record
from modetune.core.storage.files import check_writable
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.job import Job
from modetune.flows.report.field_tables import field_map
from modetune.flows.studies.run_source import RunSource

#: Which models of a campaign: as it started, as updating left it.
State = Literal["initial", "updated"]
STATES: tuple[State, ...] = ("initial", "updated")


@dataclass(frozen=True, slots=True)
class ShapeSeries:
    """Files of one state. ran: whether a solver had to run; converted: by ccx2paraview."""

    state: State
    file: Path
    n_modes: int
    ran: bool
    converted: bool


def states_of(source: RunSource, wanted: str) -> dict[State, Values]:
    """Parameter values of the wanted states: initial, updated, or both. Raises CampaignError.

    `both` of a campaign that was never run is its initial state alone.
    """
    named("--state", wanted, (*STATES, "both"))
    campaign, record = source.campaign, source.record
    if record is None:
        if wanted == "updated":
            raise CampaignError(
                f"{source.run_folder / CAMPAIGN.file} is not there, so there is no updated model; "
                "run `modetune update` first, or say --state initial"
            )
        return {"initial": campaign.parameters.values(campaign.start)}
    first = next(item for item in record.iterations if item.accepted)
    found: dict[State, Values] = {
        "initial": campaign.parameters.values(first.parameters),
        "updated": campaign.parameters.values(record.updated),
    }
    return {state: values for state, values in found.items() if wanted in (state, "both")}


def write_stored(place: Path, wanted: str, out: Path | None) -> tuple[ShapeSeries, ...]:
    """The paired modes on the displayed surface, as the record in a run folder keeps them.

    Runs nothing and reads no campaign. Raises CampaignError, StoreError.
    """
    named("--state", wanted, (*STATES, "both"))
    record, out = read_record(place / CAMPAIGN.file), out or place / "paraview"
    if record.surface is None or not record.best.field.n_dof:
        raise CampaignError(
            f"{place / CAMPAIGN.file} keeps no shapes on a surface: the campaign has several "
            "configurations, or a model of matrices"
        )
    check_writable(out, "name another place with --out")
    items = {"initial": record.iterations[0], "updated": record.best}
    mesh, written = record.surface.mesh(), []
    for state in STATES:
        if wanted in (state, "both"):
            field = items[state].field
            series = write_series(out, state, mode_grids(mesh, field), field.frequencies_hz)
            written.append(ShapeSeries(state, series, field.n_modes, False, False))
    return tuple(written)


def write_paraview(
    campaign: Campaign, states: Mapping[State, Values], out: Path
) -> tuple[ShapeSeries, ...]:
    """Write STATE.pvd and its .vtu files for each state: one modal job each, the store first.

    Raises CampaignError where the model has no geometry; SolverError, StoreError.
    """
    if not campaign.case.solver.deck.mesh().cells:
        raise CampaignError(
            f"{campaign.file}: a model of the solver {campaign.solver_name} has no elements, so "
            "there is nothing to show in ParaView"
        )
    check_writable(out, "name another place with --out")
    for state in states:
        check_series(out, state)
    return tuple(_write_state(campaign, state, values, out) for state, values in states.items())


def write_field_file(source: RunSource, out: Path) -> Path | None:
    """Write fields.vtu with what updating found of fields; None where there are none.

    Of each field its values relative to the deck, their standard errors, and by how many deviations
    of the test a change of a zone alone is seen. Raises StorageUnavailable.
    """
    record = source.record
    if record is None or not record.fields:
        return None
    named = {}
    for item in record.fields:
        found = field_map(record, item)
        named[found.name] = (found.elements, found.values)
        named[f"{found.name}_standard_error"] = (found.elements, found.errors)
        named[f"{found.name}_seen"] = (found.elements, item.strengths[item.field.owners])
    mesh = source.campaign.case.solver.deck.mesh()
    return write_fields(out / "fields.vtu", mesh, named)


def _write_state(campaign: Campaign, state: State, values: Values, out: Path) -> ShapeSeries:
    solver, keep_jobs = campaign.case.solver, campaign.run.keep_jobs
    job = Job(
        values, ModalAnalysis(campaign.case.n_modes, tuple(sorted(solver.deck.summary.node_ids)))
    )
    if isinstance(solver.program, CalculixProgram) and isinstance(solver.deck, CalculixModel):
        # Its job's folder stays until the .frd file there is converted.
        kept = campaign.run.model_copy(update={"keep_jobs": True})
        program = replace(solver.program, with_frd=True)
        case = replace(campaign.case, solver=replace(solver, program=program))
        campaign = replace(campaign, cases=(case,), run=kept)
    engine = job_engine(campaign)
    outcome = engine.solve(job)
    result = outcome.result(ModalResult)
    frequencies = result.modes.frequencies_hz
    folder = campaign.store.folder / "jobs" / outcome.key
    frd = folder / f"{JOB}.frd"
    converted = frd.is_file()
    if converted:
        with tempfile.TemporaryDirectory(prefix="modetune-") as work:
            grids = convert_frd(frd, frequencies.size, Path(work))
            series = write_series(out, state, grids, frequencies)
        if not keep_jobs:
            shutil.rmtree(folder, ignore_errors=True)
    else:
        series = write_series(out, state, mode_grids(solver.deck.mesh(), result.modes), frequencies)
    return ShapeSeries(state, series, frequencies.size, not outcome.reused, converted)
