"""`modetune pretest`: where sensors and exciters go, from the model alone.

Heavy packages are imported where they are needed.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from modetune.core.near_names import named
from modetune.core.storage.keys import Json
from modetune.flows.cli.ending import tell_end
from modetune.flows.cli.options import AsJson, NoPrefect, Settings, begun, paged, stoppable
from modetune.flows.report.tables import Column, Table, json_object, table_of

if TYPE_CHECKING:
    from modetune.core.planning.placement import Quality
    from modetune.flows.studies.pretest.running import Pretest


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
        str, typer.Option(help="effective_independence, auto_mac, kinetic_energy or information.")
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
    settings: Settings = None,
    no_prefect: NoPrefect = False,
    as_json: AsJson = False,
) -> None:
    """Choose places for sensors and exciters from the model alone, before there is a test."""
    with begun(f"reading {campaign_file}") as tell:
        from modetune.flows.studies.pretest.candidates import Directions
        from modetune.flows.studies.pretest.choice import Method, PretestSettings, parse_modes

        asked = PretestSettings(
            parse_modes(modes),
            sensors,
            named("--method", method, get_args(Method)),
            candidates,
            named("--directions", directions, get_args(Directions)),
            triaxial,
            distance,
            exciters,
            mass,
        )
        found = _run(campaign_file, settings or [], asked, out, picture, no_prefect, tell)
    files = {"sensor file": out, "picture": picture}
    written = [f"{name}: {path}" for name, path in files.items() if path is not None]
    tell_end(told_pretest(found, out, picture), [*_parts(found), *written], as_json)


def _run(
    campaign_file: Path,
    settings: list[str],
    asked: Any,
    out: Path | None,
    picture: Path | None,
    no_prefect: bool,
    tell: Callable[[str], None],
) -> Pretest:
    """Run the pretest and write its files; their names are looked at first."""
    from modetune.flows.campaign.campaign import load_model
    from modetune.flows.studies.pretest.file import check_out, write_sensor_file
    from modetune.flows.studies.pretest.running import run_pretest

    campaign = load_model(campaign_file, settings)
    mesh = campaign.case.solver.deck.mesh()
    if out is not None:
        check_out(out, mesh)
    if picture is not None:
        from modetune.flows.report.mesh_picture import check_picture

        check_picture(picture, mesh)
    with stoppable(), paged("pretest", campaign.name, no_prefect) as pages:
        tell("modes of the model")
        found = run_pretest(campaign, asked, pages)
        if out is not None:
            write_sensor_file(out, found, campaign.case.units)
        if picture is not None:
            from modetune.flows.studies.pretest.figures import save_pretest_picture

            save_pretest_picture(picture, found, mesh)
        if pages is not None:
            written = [path for path in (out, picture) if path is not None]
            status = "doubtful" if found.doubtful else "completed"
            pages.done("; ".join(quality_lines(found)), _tables(found), written, status)
    return found


def told_pretest(
    found: Pretest, out: Path | None = None, picture: Path | None = None
) -> dict[str, Json]:
    """The `--json` object of `modetune pretest`."""
    from modetune.flows.studies.pretest.file import sensor_dofs

    return json_object(
        found,
        "frequencies_hz distance needed suspension notes",
        status="doubtful" if found.doubtful else "good",
        method=found.settings.method,
        modes=found.mode_numbers,
        rigid_modes=found.n_rigid,
        candidates=found.n_candidates,
        sensors=[
            json_object(
                item,
                "node place contribution reason",
                direction=item.label,
                dofs=sensor_dofs(item),
                vectors=item.frame,
            )
            for item in found.sensors
        ],
        quality=_told_quality(found.quality, found.mode_numbers),
        all_candidates=_told_quality(found.whole, found.mode_numbers),
        exciters=[
            json_object(
                item, "node place shares rigid_kg", direction=item.label, vector=item.direction
            )
            for item in found.exciters
        ],
        parameters=found.knowledge,
        solver_runs=found.runs,
        sensor_file=out,
        picture=picture,
    )


def _told_quality(quality: Quality, numbers: tuple[int, ...]) -> dict[str, Json]:
    return json_object(
        quality,
        "auto_mac condition determinant efficiency",
        largest_auto_mac=quality.largest,
        most_alike=[numbers[place] for place in quality.pair] if len(numbers) > 1 else [],
    )


def _parts(found: Pretest) -> list[Table | str]:
    sensors, *others = _tables(found)
    held = ", ".join(f"{item.node} ({100 * item.share:.0f} %)" for item in found.suspension)
    suspension = [f"moves least, for a suspension: nodes {held}"] if held else []
    notes = [f"note: {note}" for note in found.notes]
    return [sensors, *quality_lines(found), *others, *suspension, *notes]


def _tables(found: Pretest) -> list[Table]:
    from modetune.flows.studies.pretest.information import Knowledge

    title = "Standard deviations of the parameters"
    known = table_of(title, found.knowledge, Knowledge)
    return [_sensor_table(found), known, _exciter_table(found)]


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
        f"condition of the shapes: {quality.condition:.3g} ({whole.condition:.3g} with all "
        f"candidates); determinant of the information {quality.determinant:.2e} of that of all "
        f"candidates, per sensor and mode {quality.efficiency:.2f} times that of a mean candidate"
    )
    return [*lines, found.runs.sentence]


def _sensor_table(found: Pretest) -> Table:
    columns = (
        Column("sensor"),
        Column("node"),
        Column("direction"),
        *(Column(axis, form=".5g") for axis in "xyz"),
        Column("contribution", form=".3g"),
        Column("why", words=True),
    )
    rows = tuple(
        (number, item.node, item.label, *item.place, item.contribution, item.reason)
        for number, item in enumerate(found.sensors, start=1)
    )
    title = (
        f"{len(found.sensors)} sensors of {found.n_candidates} candidates by {_words(found)}; "
        "x, y, z in the deck's length"
    )
    return Table(title, columns, rows)


def _words(found: Pretest) -> str:
    return found.settings.method.replace("_", " ").replace("mac", "MAC").replace("to M", "to-M")


def _exciter_table(found: Pretest) -> Table:
    known = any(item.rigid_kg is not None for item in found.exciters)
    columns = (
        Column("node"),
        Column("direction"),
        *(Column(f"mode {number}", form=".0f") for number in found.mode_numbers),
        *([Column("rigid mass", "kg", ".3g")] if known else []),
    )
    rows = tuple(
        (item.node, item.label, *(100.0 * share for share in item.shares),
         *([item.rigid_kg] if known else []))
        for item in found.exciters
    )  # fmt: skip
    return Table("Exciters: % of each mode's largest motion", columns, rows)
