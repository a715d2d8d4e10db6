"""A test in a MATLAB file: modes and points, recognised by the names and sizes of variables.

SciPy reads files of versions 4 to 7, a separate process those of 7.3, which are HDF5
(`adapters/hdf5_reader`). Nothing in them is executed. Names are compared in lower case, those in
structs by their last part:

    frequencies    fn, f, freq, frequencies, natural_frequencies, ... in Hz; wn, omega in rad/s
    damping        zeta, xi, dr, damping, damping_ratios, as fractions of critical
    shapes         phi, psi, ms, shapes, mode_shapes, ...: (n_dof, n_modes), or the other way round
    dof            n_dof numbers node.0c (12.03: node 12, z), rows [node, component], or names 12:+Z
    po, res, dof   frequencies with damping, shapes by rows and freedoms, as SDT writes them
    points         node, nodes, geometry, xyz: rows [node x y z], or [node 0 0 0 x y z]

Files without modes may hold a recording:

    time           t, time: in s; or fs, the samples a second; or dt, s
    values         y, data, acc, signals, ...: (n_times, n_channels), or the other way round
    dof            of each channel, as above
    unit           units: one text for all channels, or one each (m/s^2, g, N)
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from modetune.adapters.hdf5_reader import ALL, read_hdf5
from modetune.adapters.regular_file import largest, read_regular
from modetune.adapters.test_files.file_kind import FileKind, Format, kind_of
from modetune.adapters.test_files.histories import channel_unit, recording
from modetune.adapters.test_files.modes_csv import sensor_of
from modetune.core.correlation.complexity import real_shapes
from modetune.core.errors import CampaignError, ModelError, ModesError
from modetune.core.measurement.measurement import Measurement, TestGeometry
from modetune.core.measurement.time_histories import TimeHistories
from modetune.core.modes import Floats, Integers, MeasuredModes, mode_set

FREQUENCIES = {
    **dict.fromkeys(
        ("fn", "f", "freq", "freqs", "frequency", "frequencies", "frequencies_hz", "frequency_hz",
         "natural_frequencies", "naturalfrequencies", "natfreq", "eigenfrequencies", "fhz"), 1.0,
    ),
    **dict.fromkeys(("wn", "omega", "omegan"), 0.5 / np.pi),
}  # fmt: skip
DAMPING = (
    "zeta",
    "xi",
    "dr",
    "damping",
    "damping_ratios",
    "damping_ratio",
    "dampingratios",
    "damp",
)
SHAPES = ("phi", "psi", "ms", "shapes", "mode_shapes", "modeshapes", "modes", "shape", "v", "res")
DOFS = ("dof", "dofs", "sensors", "channels", "labels", "names", "channel_names")
POINTS = ("node", "nodes", "geometry", "points", "xyz", "coordinates", "grid")
TIMES, RATES, STEPS = ("t", "time", "times"), ("fs", "samplerate", "sampling_rate"), ("dt",)
RECORDED = (
    *("y", "data", "acc", "acceleration", "accelerations", "signals", "responses", "values", "x"),
    *("vel", "velocity", "velocities", "disp", "displacement", "displacements", "histories"),
)
UNITS = ("unit", "units")
#: Fewer values in a row are no recording.
LEAST_TIMES = 17
#: What SciPy raises on files that are damaged or something else.
_BROKEN = (
    *(ValueError, TypeError, KeyError, IndexError, OSError, EOFError, AttributeError),
    *(MemoryError, NotImplementedError, OverflowError, NameError, struct.error, zlib.error),
)
#: How files of version 5 mark the order of their bytes, and types of their elements.
MARKS_5 = {b"\x00\x01IM": "<", b"\x01\x00MI": ">"}
MATRIX, COMPRESSED, LAST_TYPE = 14, 15, 18
#: Structs and cells within each other; no file of a test has more than a few.
DEEPEST = 30
#: No number of a node is larger.
LARGEST = 2.0**53
Variables = dict[str, NDArray[Any]]


def read_mat(path: Path, kind: FileKind) -> Measurement:
    """Read the modes and points of a file. Raises CampaignError with what the file contains."""
    text = kind.description
    found = _variables(path, text)
    points = _points(found)
    modes, taken = _modes(path, found)
    if modes is None and points is None:
        raise CampaignError(
            f"{path} is {text} without modes (frequencies and shapes by names such as fn and phi): "
            f"it holds {_told(found)}"
        )
    note = (f"{path}: {', '.join(taken)}",) if taken else ()
    return Measurement(modes, points, notes=note)


def read_mat_histories(path: Path, notes: list[str]) -> list[TimeHistories]:
    """Read the recording of a file; none where it has modes, or no times.

    Raises CampaignError with what is missing.
    """
    found = _variables(path, kind_of(path).description)
    recorded = _recorded(found)
    if recorded is None or _modes_there(found):
        return []
    name, values, times = recorded
    nodes, components, signs, named = _dofs(path, found, name, values.shape[1], "channels")
    units = next((np.ravel(texts) for _, texts in _choices(found, UNITS)), np.zeros(0))
    labels = [str(text).strip() for text in units] if units.dtype.kind == "U" else []
    if len(labels) == 1:
        labels *= values.shape[1]
    scales = [channel_unit(label) for label in labels]
    if len(labels) != values.shape[1] or None in scales:
        raise CampaignError(
            f"{path}: no variable `unit` gives the unit of {name} ({', '.join(UNITS)}: 'm/s^2', "
            "'g', 'N'; one for all channels, or one for each)"
        )
    notes.append(f"{path}: channels are {name}, sensors are {named}, units are {labels[0]} ...")
    return [
        recording(
            [
                (int(node), int(part), float(sign), *scale, column, times, f"{path}, {name}")
                for node, part, sign, scale, column in zip(
                    nodes, components, signs, scales, values.T, strict=True
                )
                if scale is not None
            ]
        )
    ]


def _modes_there(found: Variables) -> bool:
    """Whether a file has frequencies with shapes of their number."""
    return any(
        shapes.ndim == 2 and frequencies.size in shapes.shape
        for _, frequencies, _ in _frequencies(found)
        for _, shapes in _choices(found, SHAPES)
    )


def _recorded(found: Variables) -> tuple[str, Floats, Floats] | None:
    """Return the name of the recorded values, (n_times, n_channels), and their times, s."""
    times = next((np.ravel(t) for _, t in _choices(found, TIMES) if _is_vector(t)), np.zeros(0))
    rates = [(v, 1.0) for _, v in _choices(found, RATES)]
    rates += [(v, -1.0) for _, v in _choices(found, STEPS)]
    steps = [float(np.ravel(v)[0]) ** -power for v, power in rates if v.size == 1 and v.min() > 0.0]
    for name, values in _choices(found, RECORDED):
        if values.dtype.kind not in "iuf" or values.ndim != 2 or max(values.shape) < LEAST_TIMES:
            continue
        if times.size >= LEAST_TIMES and times.size in values.shape:
            rows = values if values.shape[0] == times.size else values.T
            return name, rows.astype(np.float64), times.astype(np.float64)
        if not times.size and steps:
            rows = values if values.shape[0] == max(values.shape) else values.T
            return name, rows.astype(np.float64), steps[0] * np.arange(rows.shape[0])
    return None


def _variables(path: Path, said: str) -> Variables:
    """Return all numbers and texts, by name. Raises CampaignError."""
    if "7.3" in said:
        found = read_hdf5(path, (ALL,))[ALL]
        if isinstance(found, ModelError):
            raise CampaignError(f"{path} is {said} that cannot be read: {found}")
        return {name.replace("/", "."): np.atleast_1d(array) for name, array in found.items()}
    try:
        data = read_regular(path)
        if data[124:128] in MARKS_5:
            _check_elements(memoryview(data)[128:], MARKS_5[data[124:128]], 0)
        content = scipy.io.loadmat(io.BytesIO(data), chars_as_strings=True)  # type: ignore[arg-type]  # stream
    except (scipy.io.matlab.MatReadError, *_BROKEN) as error:
        raise CampaignError(f"{path} is {said} that cannot be read: {error}") from error
    return dict(
        item for name, value in content.items() if name[:2] != "__" for item in _flat(name, value)
    )


def _check_elements(data: memoryview, order: str, depth: int) -> None:
    """Raise ValueError where an element of a file of version 5 is of no type or is cut short.

    SciPy looks a type up without asking whether there is one, and crashes.
    """
    if depth > DEEPEST:
        raise ValueError(f"its variables are nested more than {DEEPEST} deep")
    place = 0
    while place + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, place)
        if kind >> 16:  # a small element, within its tag
            kind, size, start = kind & 0xFFFF, kind >> 16, place + 4
        else:
            start = place + 8
        inner = data[start : start + size]
        if not 1 <= kind <= LAST_TYPE or len(inner) < size or (start == place + 4 and size > 4):
            raise ValueError(f"an element at byte {place} has no type or is cut short")
        if kind == COMPRESSED:
            unpacked = zlib.decompressobj().decompress(inner, largest())
            _check_elements(memoryview(unpacked), order, depth + 1)
        elif kind == MATRIX:
            _check_elements(inner, order, depth + 1)
        place = (
            place + 8
            if start == place + 4
            else start + (size if kind == COMPRESSED else -(-size // 8) * 8)
        )


def _flat(name: str, value: object) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield arrays within structs by their path; a cell of texts as an array of them."""
    if not isinstance(value, np.ndarray):
        return
    if value.dtype.names is not None:
        for field in value.dtype.names if value.size == 1 else ():
            yield from _flat(f"{name}.{field}", value[field].flat[0])
    elif value.dtype.kind == "O":
        texts = [np.ravel(item)[:1].tolist() for item in value.flat]
        if texts and all(text and isinstance(text[0], str) for text in texts):
            yield name, np.array([text[0] for text in texts])
    elif value.dtype.kind in "iufcbU" and value.size:
        yield name, np.atleast_1d(value)


def _choices(found: Variables, names: tuple[str, ...]) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield variables of these names with their full names, in the order of the names."""
    for name in names:
        for full, values in found.items():
            if full.rpartition(".")[2].casefold() == name:
                yield full, values


def _is_vector(values: NDArray[Any]) -> bool:
    return values.dtype.kind in "iuf" and values.size == max(values.shape)


def _modes(path: Path, found: Variables) -> tuple[MeasuredModes | None, list[str]]:
    """Return the modes, and a sentence a variable that was taken. Raises CampaignError."""
    for source, frequencies, damping in _frequencies(found):
        for name, shapes in _choices(found, SHAPES):
            if shapes.ndim != 2 or frequencies.size not in shapes.shape:
                continue
            by_rows = shapes.shape[1] != frequencies.size or name.endswith("res")
            matrix = np.asarray(shapes.T if by_rows else shapes)
            taken = [
                f"frequencies are {source}",
                f"shapes are {name}, a {'row' if by_rows else 'column'} a mode",
            ]
            nodes, components, signs, named = _dofs(path, found, name, matrix.shape[0])
            real = real_shapes(matrix) if np.iscomplexobj(matrix) else matrix.astype(np.float64)
            try:
                modes = mode_set(frequencies, signs[:, None] * real, nodes, components, damping)
            except ModesError as error:
                raise CampaignError(f"{path}: {error}") from error
            numbers = tuple(range(1, frequencies.size + 1))
            return MeasuredModes(numbers, modes), [*taken, f"sensors are {named}"]
    return None, []


def _frequencies(found: Variables) -> Iterator[tuple[str, Floats, Floats]]:
    """Yield vectors that may be the frequencies in Hz, with damping of the same size if any."""
    for name, poles in _choices(found, ("po",)):
        if poles.ndim == 2 and poles.shape[1] == 2:
            yield name, poles[:, 0].astype(float), poles[:, 1].astype(float)
    for name, given in _choices(found, tuple(FREQUENCIES)):
        if _is_vector(given):
            scale = FREQUENCIES[name.rpartition(".")[2].casefold()]
            values = scale * np.ravel(given).astype(np.float64)
            damping = next(
                (
                    np.ravel(ratios).astype(np.float64)
                    for _, ratios in _choices(found, DAMPING)
                    if _is_vector(ratios) and ratios.size == values.size
                ),
                np.zeros(0),
            )
            if np.isfinite(values).all() and (values > 0.0).all():
                yield name, values, damping


def _dofs(
    path: Path, found: Variables, shapes: str, count: int, of: str = "rows"
) -> tuple[Integers, Integers, Floats, str]:
    """Return nodes, components 1..6 and signs of the rows (or `of` it), and the variable.

    Raises CampaignError.
    """
    for name, values in _choices(found, DOFS):
        if values.dtype.kind in "iuf" and not (np.abs(values.astype(float)) < LARGEST).all():
            continue
        if values.dtype.kind == "U" and values.size == count:
            sensors = [sensor_of(str(label)) for label in np.ravel(values)]
            dofs = [item for item in sensors if item is not None]
            table = np.array([[*dof, sign] for dof, sign in dofs]).reshape(-1, 3)
        elif values.dtype.kind in "iuf" and values.size == count:
            # SDT: the digits behind the point are a hundred components.
            node = np.floor(np.ravel(values) + 1e-6)
            component = np.rint(100.0 * (np.ravel(values) - node))
            table = np.stack([node, component, np.ones(count)], axis=1)
        elif values.dtype.kind in "iuf" and values.shape == (count, 2):
            table = np.column_stack([values[:, 0], np.abs(values[:, 1]), np.sign(values[:, 1])])
        else:
            continue
        if len(table) == count and np.isin(table[:, 1], np.arange(1, 7)).all():
            ids, components = table[:, :2].astype(np.int64).T
            return ids, components, table[:, 2], name
    raise CampaignError(
        f"{path}: {shapes} has {count} {of} and no variable names their nodes and directions; add "
        "`dof` with node.0c a row (12.03: node 12, z), or with names such as 12:+Z; the file holds "
        f"{_told(found)}"
    )


def _points(found: Variables) -> TestGeometry | None:
    """Return points with rows [node x y z], or SDT's seven columns."""
    for _, values in _choices(found, POINTS):
        if values.dtype.kind not in "iuf" or values.ndim != 2 or values.shape[1] not in (4, 7):
            continue
        nodes = values[:, 0].astype(np.float64)
        whole = (nodes == np.rint(nodes)).all() and ((nodes >= 0.0) & (nodes < LARGEST)).all()
        if whole and np.unique(nodes).size == nodes.size and np.isfinite(values).all():
            return TestGeometry(
                nodes.astype(np.int64),
                values[:, -3:].astype(np.float64),
                np.tile(np.eye(3), (nodes.size, 1, 1)),
            )
    return None


def _told(found: Variables) -> str:
    """Return names and sizes of what a file holds, the first few."""
    texts = [
        f"{name} ({'x'.join(map(str, np.atleast_2d(values).shape))})"
        for name, values in list(found.items())[:8]
    ]
    return ", ".join(texts) + (", ..." if len(found) > 8 else "") or "nothing that is numbers"


FORMAT = Format(read=read_mat, read_histories=read_mat_histories)
