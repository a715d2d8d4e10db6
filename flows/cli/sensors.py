"""`modetune sensors`: the model's node and direction for each sensor of a test.

Heavy packages are imported where they are needed.
"""

from __future__ import annotations

from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.storage.keys import Json
from modetune.flows.cli.options import AsJson, show_progress
from modetune.flows.cli.output import print_result
from modetune.flows.report.tables import Column, Table, json_object, table_of
from modetune.flows.studies.study import CampaignPath, Settings

if TYPE_CHECKING:
    from modetune.flows.campaign.mapping import Mapping, SensorRow

#: Maximum number of sensors in the table: a terminal takes minutes to print many more.
SHOWN = 500


def sensors(
    campaign_file: CampaignPath,
    settings: Settings = None,
    picture: Annotated[
        Path | None, typer.Option(help="Write a PNG of the sensors on the model.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the node and direction of each sensor. Runs no solver."""
    with show_progress(f"reading {campaign_file}"):
        from modetune.flows.campaign.campaign import load_campaign
        from modetune.flows.updating.poses import from_store

        campaign = load_campaign(campaign_file, settings or [])
        posed = from_store(campaign)
    mapping: Mapping = campaign.case.mapping
    if posed is not None:
        mapping = replace(posed[0].mapping, notes=(*posed[0].mapping.notes, posed[1]))
    if picture is not None:
        from modetune.flows.report.mesh_picture import save_sensor_picture

        save_sensor_picture(picture, mapping, campaign.case.solver.deck.mesh())
    drawn = [f"picture: {picture}"] if picture is not None else []
    parts: list[Table | str] = [sensor_table(mapping), *sensor_lines(mapping), *drawn]
    print_result(sensors_json(mapping, picture), parts, as_json)


def sensor_table(mapping: Mapping) -> Table:
    """Return the table of sensors with their nodes; omitted and doubtful ones are marked."""
    shown = shown_sensors(mapping)
    fitted = any(isfinite(row.misfit) for row in mapping.table)
    named = any(row.node_name for row in mapping.table)
    columns = (
        Column("sensor", name="sensor"),
        Column("node", name="model_node"),
        *((Column("node in the deck", words=True, name="node_name"),) if named else ()),
        Column("distance", mapping.unit, ".4g", name="distance"),
        *((Column("off the surface", mapping.unit, ".4g", name="misfit"),) if fitted else ()),
        Column("direction in the model", form="+.3f", name="direction"),
        Column("verdict", words=True, name="verdict"),
        Column("why", words=True, name="reason"),
    )
    outside = [(place, "verdict") for place, row in enumerate(shown) if row.verdict != "good"]
    return table_of("Sensors on the model", shown, columns, outside=outside)


def shown_sensors(mapping: Mapping) -> tuple[SensorRow, ...]:
    """Return all sensors in the test's order, or of very many the doubtful ones first."""
    if len(mapping.table) <= SHOWN:
        return mapping.table
    return tuple(sorted(mapping.table, key=lambda row: row.verdict == "good")[:SHOWN])


def sensor_lines(mapping: Mapping) -> list[str]:
    """Return the lines below the table: counts, the alignment, and doubts."""
    counts = [len(mapping.table), len(mapping.doubtful), len(mapping.left_out)]
    more = f"the table has {SHOWN} sensors, doubtful ones first; --json lists all"
    return [
        *([more] if counts[0] > SHOWN else []),
        f"{counts[0]} sensors: {counts[0] - counts[1] - counts[2]} good, {counts[1]} doubtful, "
        f"{counts[2]} left out"
        + (
            f"; tolerance {mapping.tolerance:.4g} {mapping.unit}".rstrip() * (mapping.tolerance > 0)
        ),
        alignment_line(mapping),
        *(f"note: {note}" for note in mapping.notes),
        *(f"uncertain: {what}. {remedy}" for what, remedy in mapping.uncertain),
    ]


def alignment_line(mapping: Mapping) -> str:
    """Return the alignment of test and model in one line."""
    found = mapping.alignment
    if found is None:
        return "sensors are the model's nodes of the same number"
    moved = ", ".join(f"{value:.4g}" for value in found.translation)
    turned = f"rotation {found.degrees:.4g} degrees, translation {moved}"
    line = f"alignment: scale {found.scale:.6g}, {turned}"
    if not found.residuals.size:
        return f"{line} (given)"
    return (
        f"{line} {mapping.unit}".rstrip() + f"; fitted to {int(found.used.sum())} points, "
        f"RMS residual {found.rms:.4g}, maximum {found.largest:.4g}"
    )


def sensors_json(mapping: Mapping, picture: Path | None = None) -> dict[str, Json]:
    """Return the `--json` object of `modetune sensors`."""
    found = mapping.alignment
    fitted = found is not None and bool(found.residuals.size)
    alignment = (
        None
        if found is None
        else json_object(
            found,
            "scale rotation translation",
            fitted_points=found.used.sum(),
            residual_rms=found.rms if fitted else None,
            residual_largest=found.largest if fitted else None,
        )
    )
    return json_object(
        mapping,
        "tolerance unit notes",
        status="doubtful" if mapping.doubtful or mapping.left_out or mapping.uncertain else "good",
        uncertain=[what for what, _ in mapping.uncertain],
        sensors=mapping.table,
        alignment=alignment,
        picture=picture,
    )
