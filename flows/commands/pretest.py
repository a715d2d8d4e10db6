"""`modetune pretest`: where sensors and exciters go, from the model alone.

Heavy packages are imported where they are needed.
"""

from __future__ import annotations

import json
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modetune.flows.commands.stopping import stoppable

if TYPE_CHECKING:
    from rich.table import Table

    from modetune.core.keys import Json
    from modetune.core.placement import Quality
    from modetune.flows.pretest.running import Pretest


def pretest(
    campaign_file: Annotated[
        Path, typer.Argument(help="Campaign file (YAML); test and parameters may be missing.")
    ],
    modes: Annotated[
        str, typer.Option(help="Elastic modes, as 1-8 or 1,3,5-7; default: the first eight.")
    ] = "",
    sensors: Annotated[
        int | None, typer.Option(help="How many; default: twice as many as modes.")
    ] = None,
    method: Annotated[
        str,
        typer.Option(help="effective_independence, auto_mac, kinetic_energy or information."),
    ] = "effective_independence",
    candidates: Annotated[
        str, typer.Option(help="surface, all, or a file with a node number in front of each line.")
    ] = "surface",
    directions: Annotated[str, typer.Option(help="xyz, or normal: out of the surface.")] = "xyz",
    triaxial: Annotated[
        bool, typer.Option("--triaxial", help="Three directions at a place are one sensor.")
    ] = False,
    distance: Annotated[
        float | None,
        typer.Option(
            help="Least distance of sensors, the deck's length; default: 5 % of the structure."
        ),
    ] = None,
    mass: Annotated[
        bool, typer.Option("--mass", help="Weight shapes by the mass at each candidate.")
    ] = False,
    exciters: Annotated[int, typer.Option(help="How many exciters.")] = 1,
    out: Annotated[
        Path | None, typer.Option(help="Write the sensors as points of a test (CSV).")
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="Write a PNG of all places.")] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="KEY.KEY=VALUE over the campaign file; may be repeated."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """Choose places for sensors and exciters from the model alone; the test is not read."""
    from modetune.flows.pretest.settings import (
        PretestSettings,
        directions_named,
        method_named,
        parse_modes,
    )

    asked = PretestSettings(
        parse_modes(modes), sensors, method_named(method), candidates,
        directions_named(directions), triaxial, distance, exciters, mass,
    )  # fmt: skip
    found = _run(campaign_file, settings or [], asked, out, picture)
    if as_json:
        typer.echo(json.dumps(told_pretest(found, out, picture)))
        return
    _show(found)
    for name, path in (("sensor file", out), ("picture", picture)):
        if path is not None:
            typer.echo(f"{name}: {path}")


def register(app: typer.Typer) -> None:
    """Add this file's commands to the command line."""
    app.command()(pretest)


def _run(
    campaign_file: Path, settings: list[str], asked: Any, out: Path | None, picture: Path | None
) -> Pretest:
    """Run the pretest and write its files; their names are looked at first."""
    from modetune.flows.campaign import load_campaign
    from modetune.flows.model_file import ModelFile
    from modetune.flows.pretest.file import check_out, write_sensor_file
    from modetune.flows.pretest.running import run_pretest

    campaign = load_campaign(campaign_file, settings, ModelFile)
    mesh = campaign.solver.mesh()
    if out is not None:
        check_out(out, mesh)
    if picture is not None:
        from modetune.flows.report.mesh_picture import check_picture

        check_picture(picture, mesh)
    with stoppable():
        found = run_pretest(campaign, asked)
    if out is not None:
        write_sensor_file(out, found, campaign.units)
    if picture is not None:
        from modetune.flows.report.pretest_figures import save_pretest_picture

        save_pretest_picture(picture, found, mesh)
    return found


def told_pretest(
    found: Pretest, out: Path | None = None, picture: Path | None = None
) -> dict[str, Json]:
    """A pretest for machines."""
    return {
        "status": "doubtful" if found.doubtful else "good",
        "method": found.settings.method,
        "modes": list(found.mode_numbers),
        "frequencies_hz": found.frequencies_hz.tolist(),
        "rigid_modes": found.n_rigid,
        "candidates": found.n_candidates,
        "distance": found.distance,
        "sensors": _told_sensors(found),
        "quality": _told_quality(found.quality, found.mode_numbers),
        "all_candidates": _told_quality(found.whole, found.mode_numbers),
        "needed": found.needed,
        **_told_excitation(found),
        "parameters": [
            {
                "name": item.name,
                "beforehand": item.beforehand,
                "by_frequencies": item.by_frequencies,
                "by_sensors": item.by_sensors,
                "by_all": item.by_all,
            }
            for item in found.knowledge
        ],
        "notes": list(found.notes),
        "solver_runs": {
            "modal": found.runs.modal,
            "sensitivity": found.runs.sensitivity,
            "reused": found.runs.reused,
        },
        "sensor_file": str(out) if out else None,
        "picture": str(picture) if picture else None,
    }


def _told_sensors(found: Pretest) -> list[Json]:
    from modetune.flows.pretest.file import sensor_dofs

    return [
        {
            "node": item.node,
            "direction": item.label,
            "dofs": list(sensor_dofs(item)),
            "place": list(item.place),
            "vectors": [list(way) for way in item.frame],
            "contribution": item.contribution,
            "reason": item.reason,
        }
        for item in found.sensors
    ]


def _told_excitation(found: Pretest) -> dict[str, Json]:
    return {
        "exciters": [
            {
                "node": item.node,
                "direction": item.label,
                "place": list(item.place),
                "vector": list(item.direction),
                "shares": list(item.shares),
                "rigid_kg": item.rigid_kg,
            }
            for item in found.exciters
        ],
        "suspension": [
            {"node": item.node, "place": list(item.place), "share": item.share}
            for item in found.suspension
        ],
    }


def _told_quality(quality: Quality, numbers: tuple[int, ...]) -> dict[str, Json]:
    return {
        "auto_mac": quality.auto_mac.tolist(),
        "largest_auto_mac": quality.largest,
        "most_alike": [numbers[place] for place in quality.pair] if len(numbers) > 1 else [],
        "condition": quality.condition if isfinite(quality.condition) else None,
        "determinant": quality.determinant,
        "efficiency": quality.efficiency,
    }


def _show(found: Pretest) -> None:
    from rich.text import Text

    from modetune.flows.terminal import terminal

    console = terminal()
    console.print(_sensor_table(found))
    for line in quality_lines(found):
        console.print(Text(line), soft_wrap=True)
    if found.knowledge:
        console.print(_knowledge_table(found))
    if found.exciters:
        console.print(_exciter_table(found))
    if found.suspension:
        held = ", ".join(f"{item.node} ({100 * item.share:.0f} %)" for item in found.suspension)
        console.print(Text(f"moves least, for a suspension: nodes {held}"), soft_wrap=True)
    for note in found.notes:
        console.print(Text(f"note: {note}"), soft_wrap=True)


def quality_lines(found: Pretest) -> list[str]:
    """How well the choice tells the modes apart, beside all candidates."""
    quality, whole, numbers = found.quality, found.whole, found.mode_numbers
    lines = []
    if len(numbers) > 1:
        first, second = (numbers[place] for place in quality.pair)
        lines.append(
            f"auto-MAC off the diagonal: at most {quality.largest:.3f} (modes {first} and "
            f"{second}); {whole.largest:.3f} with all {found.n_candidates} candidates"
        )
    lines.append(
        f"condition of the shapes: {quality.condition:.3g} (all: {whole.condition:.3g}); "
        f"determinant {quality.determinant:.2e} of that of all, {quality.efficiency:.2f} times "
        "the mean candidate a sensor and mode"
    )
    runs = found.runs
    lines.append(
        f"solver runs: {runs.modal} modal, {runs.sensitivity} sensitivity, {runs.reused} answered "
        "by the store"
    )
    return lines


def _sensor_table(found: Pretest) -> Table:
    from rich.table import Table

    title = f"{len(found.sensors)} sensors of {found.n_candidates} candidates by {_words(found)}"
    table = Table(title=title, title_justify="left")
    for heading in ("", "node", "direction", "x", "y", "z", "worth"):
        table.add_column(heading, justify="right")
    table.add_column("why")
    for number, item in enumerate(found.sensors, start=1):
        place = (f"{value:.5g}" for value in item.place)
        table.add_row(str(number), str(item.node), item.label, *place,
                      f"{item.contribution:.3g}", item.reason)  # fmt: skip
    return table


def _words(found: Pretest) -> str:
    return found.settings.method.replace("_", " ").replace("mac", "MAC").replace("to M", "to-M")


def _exciter_table(found: Pretest) -> Table:
    from rich.table import Table

    table = Table(title="Exciters: % of each mode's largest motion", title_justify="left")
    for heading in ("node", "direction", *map(str, found.mode_numbers), "rigid kg"):
        table.add_column(heading, justify="right")
    for item in found.exciters:
        rigid = "-" if item.rigid_kg is None else f"{item.rigid_kg:.3g}"
        shares = (f"{100 * share:.0f}" for share in item.shares)
        table.add_row(str(item.node), item.label, *shares, rigid)
    return table


def _knowledge_table(found: Pretest) -> Table:
    from rich.table import Table

    table = Table(title="Standard deviations of the parameters, %", title_justify="left")
    table.add_column("parameter")
    for heading in ("beforehand", "frequencies", "and these sensors", "and all candidates"):
        table.add_column(heading, justify="right")
    for item in found.knowledge:
        values = (item.beforehand, item.by_frequencies, item.by_sensors, item.by_all)
        table.add_row(item.name, *(f"{100 * value:.3g}" for value in values))
    return table
