"""`modetune pretest`: sensor and exciter positions, from the model alone.

Heavy packages are imported where they are needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.storage.keys import Json
from modetune.flows.report.tables import Column, Table, json_object, table_of
from modetune.flows.studies.pretest.request import PretestSettings
from modetune.flows.studies.result import StudyResult, near
from modetune.flows.studies.study import CampaignOptions, StudyContext, study

if TYPE_CHECKING:
    from modetune.core.planning.sensor_placement import Quality
    from modetune.flows.campaign.campaign import Campaign
    from modetune.flows.studies.pretest.plan import Pretest


@dataclass(frozen=True)
class PretestOptions(CampaignOptions):
    """Options of a study of a campaign that may lack test and parameters."""

    campaign_file: Annotated[
        Path, typer.Argument(help="Campaign file (YAML); test and parameters may be missing.")
    ]

    def load(self) -> Campaign:
        from modetune.flows.campaign.campaign import load_model

        return load_model(self.campaign_file, self.settings or [])


@study(PretestOptions)
def pretest(
    on: StudyContext,
    request: PretestSettings,
    out: Annotated[
        Path | None, typer.Option(help="Write the sensors as points of a test (CSV).")
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="Write a PNG of all positions.")] = None,
) -> StudyResult:
    """Choose sensor and exciter positions from the model alone, before the test."""
    from modetune.flows.studies.pretest.plan import check_out, run_pretest, write_sensor_file

    mesh = on.campaign.case.solver.deck.mesh()
    if out is not None:
        check_out(out, mesh)
    if picture is not None:
        from modetune.flows.report.mesh_picture import check_picture
        from modetune.flows.studies.pretest.figures import save_pretest_picture

        check_picture(picture, mesh)
    found = run_pretest(on.campaign, request)
    if out is not None:
        write_sensor_file(out, found, on.campaign.case.units)
    if picture is not None:
        save_pretest_picture(picture, found, mesh)
    return StudyResult(
        found,
        "; ".join(quality_lines(found)),
        pretest_summary(found, out, picture),
        _tables(found),
        _lines(found),
        [path for path in (out, picture) if path is not None],
        status="doubtful" if found.doubtful else "",
    )


def pretest_summary(
    found: Pretest, out: Path | None = None, picture: Path | None = None
) -> dict[str, Json]:
    """Return the JSON object of a pretest."""
    from modetune.flows.studies.pretest.plan import sensor_dofs

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
        quality=_quality_json(found.quality, found.mode_numbers),
        all_candidates=_quality_json(found.whole, found.mode_numbers),
        exciters=[
            json_object(
                item, "node place shares rigid_kg", direction=item.label, vector=item.direction
            )
            for item in found.exciters
        ],
        parameters=found.knowledge,
        solver_runs=found.runs,
        sensor_file=near(out) if out else None,
        picture=near(picture) if picture else None,
    )


def _quality_json(quality: Quality, numbers: tuple[int, ...]) -> dict[str, Json]:
    return json_object(
        quality,
        "auto_mac condition determinant efficiency",
        largest_auto_mac=quality.largest,
        most_alike=[numbers[place] for place in quality.pair] if len(numbers) > 1 else [],
    )


def _lines(found: Pretest) -> list[str]:
    held = ", ".join(f"{item.node} ({100 * item.share:.0f} %)" for item in found.suspension)
    suspension = [f"moves least, for a suspension: nodes {held}"] if held else []
    return [*quality_lines(found), *suspension, *(f"note: {note}" for note in found.notes)]


def _tables(found: Pretest) -> list[Table]:
    from modetune.flows.studies.pretest.information import Knowledge

    title = "Standard deviations of the parameters"
    known = table_of(title, found.knowledge, Knowledge)
    return [_sensor_table(found), known, _exciter_table(found)]


def quality_lines(found: Pretest) -> list[str]:
    """Return how well the sensors distinguish the modes, compared with all candidates."""
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
