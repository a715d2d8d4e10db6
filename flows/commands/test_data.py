"""`inspect`: what files of a test hold, and the same test in another form.

Heavy packages are imported where they are needed.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from modetune.adapters.measurements import Inspection
    from modetune.core.measurement import Measurement

__test__ = False  # tests are what it reads, not what it is

#: Names of units of length, by their metres.
UNIT_NAMES = {
    "metres": 1.0,
    "centimetres": 1e-2,
    "millimetres": 1e-3,
    "inches": 0.0254,
    "feet": 0.3048,
}


def inspect(
    files: Annotated[list[Path], typer.Argument(help="Files of one test: UFF, CSV, HDF5.")],
    write: Annotated[
        Path | None, typer.Option(help="Write the test as .csv, .h5 or .unv, by the suffix.")
    ] = None,
    metres: Annotated[
        float | None, typer.Option(help="Length unit of the coordinates, in metres.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """Tell what the files of a test hold, and what was left out; write it in another form."""
    from modetune.adapters.measurements import inspect_files

    inspection = inspect_files(files, metres)
    told = {"status": "good", **_told(inspection)}
    told["written"] = [] if write is None else [
        str(path) for path in _write(write, files, inspection.measurement)
    ]  # fmt: skip
    if as_json:
        typer.echo(json.dumps(told))
        return
    for line in _lines(told):
        typer.echo(line)


def register(app: typer.Typer) -> None:
    """Add this file's commands to the command line."""
    app.command()(inspect)


def _write(path: Path, files: list[Path], measurement: Measurement) -> list[Path]:
    """Write a test by the suffix of the path; as CSV, points go into a file beside the modes."""
    from modetune.adapters.geometry_csv import write_geometry_csv
    from modetune.adapters.measurements import CSV, HDF5, UNIVERSAL
    from modetune.adapters.modes_csv import write_modes_csv
    from modetune.adapters.test_hdf5 import write_test_hdf5
    from modetune.adapters.universal.write import write_universal
    from modetune.core.errors import CampaignError

    suffix = path.suffix.lower()
    if measurement.is_empty:
        raise CampaignError([f"nothing of the files can be written to {path}", *measurement.notes])
    if path.is_dir() or (path.parent.exists() and not path.parent.is_dir()):
        raise CampaignError(f"{path} cannot be written: it is a folder, or lies in what is none")
    if path.resolve() in [file.resolve() for file in files]:
        raise CampaignError(f"{path} is one of the files that are read; name another")
    if suffix in HDF5:
        write_test_hdf5(path, measurement)
        return [path]
    if suffix in UNIVERSAL:
        write_universal(path, measurement)
        return [path]
    if suffix not in CSV:
        raise CampaignError(f"{path}: a test is written as .csv, .h5 or .unv, by the suffix")
    comment = [f"from {', '.join(file.name for file in files)}", *measurement.notes]
    written = []
    if measurement.modes is not None:
        write_modes_csv(path, measurement.modes.numbers, measurement.modes.modes, comment)
        written.append(path)
    if measurement.geometry is not None:
        points = path.with_name(f"{path.stem}-points.csv") if written else path
        write_geometry_csv(points, measurement.geometry, comment[:1])
        written.append(points)
    if not written:
        raise CampaignError(f"{path}: response functions are not written as CSV; name an .h5")
    return written


def _told(inspection: Inspection) -> dict[str, Any]:
    measurement = inspection.measurement
    told: dict[str, Any] = {
        "files": [
            {"path": str(file.path), "form": file.form, "datasets": dict(Counter(file.datasets))}
            for file in inspection.files
        ],
        "points": None,
        "modes": [],
        "sensors": 0,
        "response_functions": None,
        "functions": inspection.n_functions,
        "notes": list(measurement.notes),
    }
    points, frfs = measurement.geometry, measurement.frfs
    if points is not None:
        told["points"] = {
            "count": points.nodes.size,
            "metres": None if math.isnan(points.metres) else points.metres,
            "size": (points.coordinates.max(axis=0) - points.coordinates.min(axis=0)).tolist(),
            "lines": len(points.lines),
            "faces": len(points.faces),
        }
    if measurement.modes is not None:
        told["modes"] = _told_modes(inspection)
        told["sensors"] = measurement.modes.modes.n_dof
    if frfs is not None:
        ends = zip(frfs.reference_nodes.tolist(), frfs.reference_components.tolist(), strict=True)
        told["response_functions"] = {
            "kind": frfs.kind,
            "count": frfs.values.shape[1],
            "frequencies": frfs.frequencies_hz.size,
            "band_hz": [float(frfs.frequencies_hz[0]), float(frfs.frequencies_hz[-1])],
            "references": len(set(ends)),
            "coherences": bool(frfs.coherences.size),
        }
    return told


def _told_modes(inspection: Inspection) -> list[dict[str, Any]]:
    assert inspection.measurement.modes is not None
    numbers, modes = inspection.measurement.modes.numbers, inspection.measurement.modes.modes
    known = inspection.collinearity.size == modes.n_modes
    return [
        {
            "number": number,
            "frequency_hz": float(modes.frequencies_hz[mode]),
            "damping_ratio": float(modes.damping_ratios[mode])
            if modes.damping_ratios.size
            else None,
            "phase_collinearity": float(inspection.collinearity[mode]) if known else None,
        }
        for mode, number in enumerate(numbers)
    ]


def _unit(metres: float) -> str:
    """A unit of length by its name where it has one; files give its factor with few digits."""
    for name, length in UNIT_NAMES.items():
        if math.isclose(metres, length, rel_tol=1e-4):
            return f"in {name}"
    return f"in units of {metres:g} m"


def _lines(told: dict[str, Any]) -> list[str]:
    """What is told, for people."""
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
        unit = "unit of length not told" if points["metres"] is None else _unit(points["metres"])
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
        lines.append(f"functions  {told['functions']}, none a response function that can be used")
    if told["modes"]:
        lines.append(f"modes      {len(told['modes'])} at {told['sensors']} sensors")
        lines.append("   mode    frequency (Hz)   damping    MPC")
        for mode in told["modes"]:
            damping, mpc = mode["damping_ratio"], mode["phase_collinearity"]
            lines.append(
                f"   {mode['number']:4d} {mode['frequency_hz']:17.6g} "
                f"{'-' if damping is None else f'{damping:.5f}':>9} "
                f"{'-' if mpc is None else f'{mpc:.3f}':>6}"
            )
    lines += [f"note: {note}" for note in told["notes"]]
    return lines + [f"written: {path}" for path in told["written"]]
