"""`modetune sensors`: where the test's sensors are read in the model.

Heavy packages are imported where they are needed.
"""

from __future__ import annotations

import json
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from modetune.core.keys import Json
    from modetune.flows.sensors.mapping import Mapping, SensorRow


def sensors(
    campaign_file: Annotated[Path, typer.Argument(help="Campaign file (YAML).")],
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="KEY.KEY=VALUE over the campaign file; may be repeated."),
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Write a PNG of the sensors on the model.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """Tell at which node and along which direction each sensor is read. Runs no solver."""
    from modetune.flows.campaign import load_campaign

    campaign = load_campaign(campaign_file, settings or [])
    mapping: Mapping = campaign.mapping
    if picture is not None:
        from modetune.flows.report.sensor_figure import save_sensor_picture

        save_sensor_picture(picture, mapping, campaign.solver.mesh())
    if as_json:
        typer.echo(json.dumps(told_sensors(mapping, picture)))
        return
    for line in sensor_lines(mapping):
        typer.echo(line)
    if picture is not None:
        typer.echo(f"picture: {picture}")


def register(app: typer.Typer) -> None:
    """Add this file's commands to the command line."""
    app.command()(sensors)


def sensor_lines(mapping: Mapping) -> list[str]:
    """The mapping for people: a table, the alignment, what is doubtful."""
    lines = []
    if mapping.table:
        lines.append(f"{'sensor':>12} {'node':>9} {'distance':>10}   direction in the model")
    lines += [_line(row) for row in mapping.table]
    counts = [len(mapping.table), len(mapping.doubtful), len(mapping.left_out)]
    lines.append(
        f"{counts[0]} sensors: {counts[0] - counts[1] - counts[2]} good, {counts[1]} doubtful, "
        f"{counts[2]} left out; tolerance {mapping.tolerance:.4g} {mapping.unit}".rstrip()
    )
    lines.append(alignment_line(mapping))
    return [*lines, *(f"note: {note}" for note in mapping.notes)]


def alignment_line(mapping: Mapping) -> str:
    """How the test lies over the model, in a line."""
    found = mapping.alignment
    if found is None:
        return "sensors are the model's nodes of the same number"
    place = ", ".join(f"{value:.4g}" for value in found.translation)
    line = f"alignment: scale {found.scale:.6g}, turned {found.degrees:.4g} degrees, moved {place}"
    if not found.residuals.size:
        return f"{line} (given)"
    return (
        f"{line} {mapping.unit}".rstrip() + f"; fitted to {int(found.used.sum())} points, "
        f"residual {found.rms:.4g} root mean square, {found.largest:.4g} at most"
    )


def _line(row: SensorRow) -> str:
    node = str(row.model_node) if row.model_node else "-"
    distance = "-" if isnan(row.distance) else f"{row.distance:.4g}"
    looks = " ".join(f"{part:+.3f}" for part in row.direction)
    said = "" if row.verdict == "good" else f"   {row.verdict}: {row.reason}"
    name = f"{row.test_node}.{row.component}"
    return f"{name:>12} {node:>9} {distance:>10}   {looks}{said}"


def told_sensors(mapping: Mapping, picture: Path | None = None) -> dict[str, Json]:
    """The mapping for machines."""
    found = mapping.alignment
    alignment: dict[str, Json] | None = None
    if found is not None:
        alignment = {
            "scale": found.scale,
            "rotation": found.rotation.tolist(),
            "translation": found.translation.tolist(),
            "fitted_points": int(found.used.sum()),
            "residual_rms": found.rms if found.residuals.size else None,
            "residual_largest": found.largest if found.residuals.size else None,
        }
    return {
        "status": "doubtful" if mapping.doubtful or mapping.left_out else "good",
        "sensors": [
            {
                "test_node": row.test_node,
                "component": row.component,
                "model_node": row.model_node or None,
                "distance": None if isnan(row.distance) else row.distance,
                "direction": list(row.direction),
                "verdict": row.verdict,
                "reason": row.reason,
            }
            for row in mapping.table
        ],
        "alignment": alignment,
        "tolerance": mapping.tolerance,
        "unit": mapping.unit,
        "notes": list(mapping.notes),
        "picture": str(picture) if picture else None,
    }
