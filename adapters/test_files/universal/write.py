"""A test as a universal file: header (151), units (164), axes (2420), points (2411), lines (82),
triangles (2412), modes (55), response functions and coherences (58).

Numbers have the digits of the format: 6 for shapes, frequencies and damping ratios, 12 for response
functions, 17 for points. Response functions are written in the units of dataset 164, and with
their SI units as labels where the unit of length is not known. HDF5 keeps all (`test_hdf5.py`).
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyuff

from modetune.core.errors import ModesError
from modetune.core.measurement.frf import Response
from modetune.core.measurement.measurement import MeasuredFrfs, Measurement, TestGeometry
from modetune.core.modes import Floats, MeasuredModes
from modetune.core.storage.files import writing

QUANTITIES: dict[Response, int] = {"receptance": 8, "mobility": 11, "accelerance": 12}
LABELS: dict[Response, str] = {"receptance": "m", "mobility": "m/s", "accelerance": "m/s^2"}
FREQUENCY, FORCE = 18, 13
#: Numbers that a trace line may hold (Record 1 of dataset 82), in pairs and the zero after each.
PAIRS_A_TRACE = 250 // 3
#: The largest number of the ten columns that it has.
LARGEST = 10**10 - 1

Fields = dict[Any, Any]  # pyuff's own form of a dataset


def write_universal(path: Path, measurement: Measurement) -> None:
    """Write a test whole or not at all.

    Raises ModesError where there is nothing to write or the format cannot hold it,
    StorageUnavailable.
    """
    if measurement.is_empty:
        raise ModesError(f"{path}: there is nothing to write")
    if measurement.deviations is not None:
        raise ModesError(
            f"{path}: a universal file has no place for deviations; write .csv or .h5, or leave "
            "them out of the test"
        )
    with writing(path) as part, part.open("wb") as file, tempfile.TemporaryDirectory() as folder:
        # a file for each dataset: pyuff reads its whole file again after each one it appends
        one = Path(folder) / "one.uff"
        for dataset in _datasets(measurement):
            pyuff.UFF(str(one)).write_sets(dataset, mode="overwrite")
            file.write(one.read_bytes())


def _datasets(measurement: Measurement) -> Iterator[Fields]:
    yield {
        "type": 151, "model_name": "NONE", "description": "test data", "db_app": "modetune",
        "program": "modetune", "date_db_created": "", "time_db_created": "", "date_db_saved": "",
        "time_db_saved": "", "date_file_written": "", "time_file_written": "",
    }  # fmt: skip
    if measurement.geometry is not None:
        yield from _geometry(measurement.geometry)
    if measurement.modes is not None:
        yield from _modes(measurement.modes)
    if measurement.frfs is not None:
        metres = math.nan if measurement.geometry is None else measurement.geometry.metres
        yield from _functions(measurement.frfs, metres)


def _geometry(points: TestGeometry) -> Iterator[Fields]:
    _check_numbers(points.nodes)
    if not math.isnan(points.metres):
        yield {
            "type": 164, "units_code": 1 if points.metres == 1.0 else 9,
            "length": 1.0 / points.metres, "force": 1.0, "temp": 1.0, "temp_offset": 273.15,
        }  # fmt: skip
    frames, which = np.unique(points.frames.reshape(-1, 9), axis=0, return_inverse=True)
    turned = np.flatnonzero((frames != np.eye(3).ravel()).any(axis=1))
    numbers = np.zeros(len(frames), dtype=np.int64)
    numbers[turned] = np.arange(2, turned.size + 2)  # 1 is the global system for many programs
    if turned.size:
        yield {
            "type": 2420,
            "Part_UID": 1,
            "Part_Name": "NONE",
            "CS_sys_labels": numbers[turned].tolist(),
            "CS_types": [0] * turned.size,
            "CS_colors": [8] * turned.size,
            "CS_names": [f"CS{number}" for number in numbers[turned].tolist()],
            "CS_matrices": [np.vstack([frames[row].reshape(3, 3), np.zeros(3)]) for row in turned],
        }
    n = points.nodes.size
    yield {
        "type": 2411,
        "node_nums": points.nodes,
        "def_cs": np.zeros(n, dtype=np.int64),
        "disp_cs": numbers[which.ravel()],
        "color": np.full(n, 8),
        "x": points.coordinates[:, 0],
        "y": points.coordinates[:, 1],
        "z": points.coordinates[:, 2],
    }
    for first in range(0, len(points.lines), PAIRS_A_TRACE):
        pairs = points.lines[first : first + PAIRS_A_TRACE]
        trace = np.column_stack([pairs, np.zeros(len(pairs), dtype=np.int64)]).ravel()[:-1]
        yield {"type": 82, "trace_num": first // PAIRS_A_TRACE + 1, "nodes": trace}
    if len(points.faces):
        yield {"type": 2412, 91: [
            {
                "element_nums": number, "fe_descriptor": 91, "phys_table": 1, "mat_table": 1,
                "color": 8, "num_nodes": 3, "nodes_nums": nodes,
            }
            for number, nodes in enumerate(points.faces.tolist(), start=1)
        ]}  # fmt: skip


def _modes(measured: MeasuredModes) -> Iterator[Fields]:
    modes = measured.modes
    if np.iscomplexobj(modes.mode_shapes):
        raise ModesError("the shapes of a test are written as real ones")
    if not modes.n_dof:
        raise ModesError("modes without shapes cannot be written as a universal file; write CSV")
    _check_numbers(modes.nodes)
    nodes, rows = np.unique(modes.nodes, return_inverse=True)
    damping = modes.damping_ratios if modes.damping_ratios.size else np.zeros(modes.n_modes)
    width = 6 if modes.components.max() > 3 else 3
    for mode, number in enumerate(measured.numbers):
        values = np.zeros((nodes.size, width))
        values[rows, modes.components - 1] = modes.mode_shapes[:, mode]
        dataset: Fields = {
            "type": 55,
            "analysis_type": 2,
            "data_ch": 2 if width == 3 else 3,
            "spec_data_type": QUANTITIES["receptance"],
            "load_case": 0,
            "mode_n": number,
            "freq": float(modes.frequencies_hz[mode]),
            "node_nums": nodes,
            "modal_m": 1.0 if modes.normalisation == "mass" else 0.0,
            "modal_damp_vis": float(damping[mode]),
        }
        dataset.update({f"r{column + 1}": values[:, column] for column in range(width)})
        yield dataset


def _functions(frfs: MeasuredFrfs, metres: float) -> Iterator[Fields]:
    """Functions and coherences; metres: the file's unit of length, NaN where it gives none."""
    _check_numbers(np.concatenate([frfs.nodes, frfs.reference_nodes]))
    even = _even(frfs.frequencies_hz)
    directions = (frfs.components * frfs.signs).astype(np.int64)
    references = (frfs.reference_components * frfs.reference_signs).astype(np.int64)
    # SI divided by the units of dataset 164: lengths of translations, and of moments
    unit = 1.0 if math.isnan(metres) else metres
    turning = (frfs.components > 3).astype(np.int64)
    moments = (frfs.reference_components > 3).astype(np.int64)
    values = frfs.values * unit ** (moments + turning - 1.0)
    labels = (LABELS[frfs.kind], "N") if math.isnan(metres) else ("NONE", "NONE")
    kinds = [(4, values, QUANTITIES[frfs.kind], FORCE)]
    if frfs.coherences.size:
        kinds.append((6, frfs.coherences, 0, 0))
    for kind, values, numerator, denominator in kinds:
        for column in range(values.shape[1]):
            yield {
                "type": 58,
                "func_type": kind,
                "rsp_node": int(frfs.nodes[column]),
                "rsp_dir": int(directions[column]),
                "ref_dir": int(references[column]),
                "ref_node": int(frfs.reference_nodes[column]),
                "x": frfs.frequencies_hz,
                "data": values[:, column],
                "abscissa_spacing": int(even),
                "abscissa_spec_data_type": FREQUENCY,
                "abscissa_axis_units_lab": "Hz",
                "ordinate_spec_data_type": numerator,
                "orddenom_spec_data_type": denominator,
                "ordinate_axis_units_lab": labels[0] if numerator else "NONE",
                "orddenom_axis_units_lab": labels[1] if numerator else "NONE",
            }


def _even(frequencies_hz: Floats) -> bool:
    """Whether first frequency and step, printed with 6 digits, give the others."""
    if frequencies_hz.size < 2:
        raise ModesError("response functions at one frequency cannot be written")
    printed = [
        float(f"{value:.5e}")
        for value in (frequencies_hz[0], frequencies_hz[1] - frequencies_hz[0])
    ]
    grid = printed[0] + printed[1] * np.arange(frequencies_hz.size)
    if np.abs(grid - frequencies_hz).max() <= 0.01 * printed[1]:
        return True
    rounded = np.array([float(f"{value:.5e}") for value in frequencies_hz])
    if (np.diff(rounded) <= 0.0).any():
        raise ModesError(
            "the frequencies of the response functions lie closer than the 6 digits of a universal "
            "file can tell; write HDF5 instead"
        )
    return False


def _check_numbers(nodes: np.ndarray[Any, np.dtype[np.int64]]) -> None:
    if nodes.size and (nodes.max() > LARGEST or nodes.min() < 1):
        raise ModesError(f"nodes in a universal file are numbered 1 to {LARGEST}")
