"""`modetune files inspect`: list the contents of test files, and convert them.

Heavy packages are imported where they are needed.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from modetune.core.errors import CampaignError
from modetune.flows.cli.options import AsJson
from modetune.flows.cli.output import print_result
from modetune.flows.report.tables import Column, json_object, table_of

if TYPE_CHECKING:
    from modetune.adapters.test_files.measurements import Inspection
    from modetune.core.measurement.measurement import Measurement

__test__ = False  # pytest collects no class of this module

#: Names of units of length, by their metres.
UNIT_NAMES = {
    "metres": 1.0,
    "centimetres": 1e-2,
    "millimetres": 1e-3,
    "inches": 0.0254,
    "feet": 0.3048,
}


def inspect(
    files: Annotated[
        list[Path], typer.Argument(help="Files of one test: UFF, CSV, Excel, MATLAB, HDF5.")
    ],
    write: Annotated[
        Path | None, typer.Option(help="File to convert the test to: .csv, .h5 or .unv.")
    ] = None,
    metres: Annotated[
        float | None, typer.Option(help="Length unit of the coordinates, in metres.")
    ] = None,
    axes: Annotated[
        Literal["auto", "rows", "columns"],
        typer.Option(help="Whether the axes in dataset 2420 are rows or columns of its matrices."),
    ] = "auto",
    as_json: AsJson = False,
) -> None:
    """List what the files of a test contain and what was left out, and convert them."""
    from modetune.adapters.test_files.measurements import inspect_files

    inspection = inspect_files(files, metres, axes)
    told = {"status": "good", **_told(inspection)}
    told["written"] = (
        []
        if write is None
        else [str(path) for path in _write(write, files, inspection.measurement)]
    )
    modes = table_of("", _modes(inspection), MeasuredMode)
    notes = [f"note: {note}" for note in told["notes"]]
    written = [f"written: {path}" for path in told["written"]]
    print_result(told, [*_lines(told), modes, *notes, *written], as_json)


def _write(path: Path, files: list[Path], measurement: Measurement) -> list[Path]:
    from modetune.adapters.test_files.measurements import write_test

    if measurement.is_empty:
        raise CampaignError(
            [f"the files contain nothing that can be written to {path}", *measurement.notes]
        )
    if path.is_dir() or (path.parent.exists() and not path.parent.is_dir()):
        raise CampaignError(
            f"{path} cannot be written: it is a folder, or its parent is not a folder"
        )
    if path.resolve() in [file.resolve() for file in files]:
        raise CampaignError(f"{path} is one of the files to read; choose another")
    names = ", ".join(file.name for file in files)
    return write_test(path, measurement, [f"from {names}", *measurement.notes])


@dataclass(frozen=True, slots=True)
class MeasuredMode:
    """A mode of a test; NaN where the test gives no value."""

    number: Annotated[int, Column("mode")]
    frequency_hz: Annotated[float, Column("frequency", "Hz", ".6g")]
    damping_ratio: Annotated[float, Column("damping ratio", form=".5f")]
    phase_collinearity: Annotated[float, Column("phase collinearity", form=".3f")]


def _told(inspection: Inspection) -> dict[str, Any]:
    measurement = inspection.measurement
    points, frfs, modes = measurement.geometry, measurement.frfs, measurement.modes
    references = (frfs.reference_nodes.tolist(), frfs.reference_components.tolist()) if frfs else ()
    files = [
        {"path": file.path, "form": file.form, "datasets": dict(Counter(file.datasets))}
        for file in inspection.files
    ]
    return json_object(
        measurement,
        "notes",
        files=files,
        points=points
        and {
            "count": points.nodes.size,
            "metres": points.metres,
            "size": points.coordinates.max(axis=0) - points.coordinates.min(axis=0),
            "lines": len(points.lines),
            "faces": len(points.faces),
        },
        modes=_modes(inspection),
        sensors=modes.modes.n_dof if modes else 0,
        response_functions=frfs
        and {
            "kind": frfs.kind,
            "count": frfs.values.shape[1],
            "frequencies": frfs.frequencies_hz.size,
            "band_hz": [frfs.frequencies_hz[0], frfs.frequencies_hz[-1]],
            "references": len(set(zip(*references, strict=True))),
            "coherences": bool(frfs.coherences.size),
        },
        functions=inspection.n_functions,
        environment=dict(measurement.environment),
    )


def _modes(inspection: Inspection) -> list[MeasuredMode]:
    if inspection.measurement.modes is None:
        return []
    modes = inspection.measurement.modes.modes
    unknown = [math.nan] * modes.n_modes
    damping = modes.damping_ratios.tolist() or unknown
    known = inspection.collinearity.size == modes.n_modes
    collinearity = inspection.collinearity.tolist() if known else unknown
    values = zip(
        inspection.measurement.modes.numbers,
        modes.frequencies_hz.tolist(),
        damping,
        collinearity,
        strict=True,
    )
    return [MeasuredMode(*item) for item in values]


def _unit(metres: float) -> str:
    """Return a unit of length by name if it has one; files give its factor with few digits."""
    for name, length in UNIT_NAMES.items():
        if math.isclose(metres, length, rel_tol=1e-4):
            return f"in {name}"
    return f"in units of {metres:g} m"


def _lines(told: dict[str, Any]) -> list[str]:
    """Return the contents as lines of text."""
    lines = []
    for file in told["files"]:
        datasets = ", ".join(
            name if count == 1 else f"{count} x {name}" for name, count in file["datasets"].items()
        )
        lines.append(
            f"{file['path']}: {file['form']}" + (f", datasets {datasets}" if datasets else "")
        )
    points, frfs = told["points"], told["response_functions"]
    if points is not None:
        unit = "unit of length unknown" if points["metres"] is None else _unit(points["metres"])
        size = " x ".join(f"{length:.4g}" for length in points["size"])
        lines.append(
            f"points     {points['count']}, {size}, {unit}; {points['lines']} lines, "
            f"{points['faces']} triangles"
        )
    if frfs is not None:
        lines.append(
            f"functions  {frfs['count']} x {frfs['kind']}, {frfs['references']} references, "
            f"{frfs['frequencies']} lines from {frfs['band_hz'][0]:g} to {frfs['band_hz'][1]:g} Hz"
            + (", with coherence" if frfs["coherences"] else "")
        )
    elif told["functions"]:
        lines.append(f"functions  {told['functions']}, without a usable response function")
    if told["environment"]:
        values = ", ".join(f"{name} {value:g}" for name, value in told["environment"].items())
        lines.append(f"environment {values}")
    if told["modes"]:
        lines.append(f"modes      {len(told['modes'])} at {told['sensors']} sensors")
    return lines
