"""`modetune files paraview`: write modes before and after updating for ParaView.

Heavy packages are imported where they are needed.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.errors import CampaignError
from modetune.core.storage.keys import Json
from modetune.flows.cli.options import AsJson, stoppable
from modetune.flows.cli.output import print_result
from modetune.flows.report.tables import json_object
from modetune.flows.studies.study import Settings

if TYPE_CHECKING:
    from modetune.flows.studies.paraview import ShapeSeries


def paraview(
    place: Annotated[Path, typer.Argument(help="Campaign file (YAML), or a run folder.")],
    state: Annotated[str, typer.Option(help="Model to write: initial, updated or both.")] = "both",
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for the files; default: paraview/ in the run folder."),
    ] = None,
    runs: Annotated[Path, typer.Option(help="Folder that contains the run folders.")] = Path(
        "runs"
    ),
    stored: Annotated[
        bool,
        typer.Option(
            "--stored",
            help="Write the paired modes on the surface that the record of a run folder "
            "keeps, without a solver run or campaign file.",
        ),
    ] = False,
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Write mode shapes on the whole mesh, before and after updating, for ParaView."""
    from modetune.flows.studies.paraview import (
        states_of,
        write_field_file,
        write_paraview,
        write_stored,
    )
    from modetune.flows.studies.run_source import open_run

    if stored:
        if settings or not place.is_dir():
            raise CampaignError(f"{place}: --stored requires a run folder, and takes no --set")
        written, unrun, fields = write_stored(place, state, out), False, None
    else:
        source = open_run(place, settings or [], runs)
        states = states_of(source, state)
        unrun = state == "both" and source.record is None
        place = out or source.run_folder / "paraview"
        with stoppable():
            written = write_paraview(source.campaign, states, place)
            fields = write_field_file(source, place)
    series = [series_json(item) for item in written]
    lines = [f"{x.state:8}  {x.file}  {x.n_modes} modes{_cost(x)}" for x in written]
    lines += [f"fields    {fields}"] if fields is not None else []
    lines += ["the campaign has not been run, so there is no updated model yet"] if unrun else []
    print_result(json_object(status="good", series=series, fields=fields), lines, as_json)


def series_json(item: ShapeSeries) -> dict[str, Json]:
    """Return the JSON object of a series of files."""
    converter = "ccx2paraview" if item.converted else "modetune"
    return json_object(
        item, "state file", modes=item.n_modes, solver_runs=int(item.ran), converter=converter
    )


def _cost(item: ShapeSeries) -> str:
    return ", one solver run" if item.ran else ", no solver run"
