"""The content of universal datasets as typed values, each with its place in the file.

The functions convert what pyuff returns for geometry, units, functions and mode shapes. Each takes
the place of a dataset, its rows and the result of pyuff. It raises ValueError, with a predicate
("has ..."), where the result does not fit what the dataset announces.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modetune.adapters.test_files.universal.blocks import (
    HEADERS,
    DataKind,
    DatasetBlock,
    data_kind,
    node_rows,
)
from modetune.core.measurement.response_functions import Complexes
from modetune.core.modes import Floats, Integers


@dataclass(frozen=True, slots=True)
class DatasetPlace:
    """The place of a dataset: file, the line of its number, that number."""

    path: Path
    line: int
    dataset: str

    def __str__(self) -> str:
        return f"{self.path}, line {self.line} (dataset {self.dataset})"


@dataclass(frozen=True, slots=True)
class Units:
    """Dataset 164. metres, newtons: the file's units of length and force in SI.

    newtons: NaN where the file gives no factor that can be one. doubt: "" where there is none.
    """

    place: DatasetPlace
    metres: float
    newtons: float
    doubt: str = ""


@dataclass(frozen=True, slots=True)
class NodeTable:
    """Datasets 15 and 2411.

    nodes: (n,). coordinates: (n, 3), in the systems `definition` (n,), 0 being the global one.
    displacement: (n,), the systems along whose axes motions are measured.
    """

    place: DatasetPlace
    nodes: Integers
    coordinates: Floats
    definition: Integers
    displacement: Integers


@dataclass(frozen=True, slots=True)
class CoordinateSystem:
    """One system of datasets 18 and 2420.

    kind: 0 Cartesian, 1 cylindrical, 2 spherical. origin: (3,), axes: (3, 3), rows x, y, z, both in
    the system `reference`, 0 being the global one.
    """

    number: int
    kind: int
    reference: int
    origin: Floats
    axes: Floats


@dataclass(frozen=True, slots=True)
class CoordinateSystems:
    """A dataset 18 or 2420."""

    place: DatasetPlace
    systems: tuple[CoordinateSystem, ...]


@dataclass(frozen=True, slots=True)
class Drawing:
    """Datasets 82 and 2412: lines (n, 2) and triangles (n, 3) between nodes."""

    place: DatasetPlace
    lines: Integers
    faces: Integers


@dataclass(frozen=True, slots=True)
class DatasetShape:
    """A mode of datasets 55 and 2414.

    number: the mode's, 0 where the file gives none. damping: ratio, NaN where not given. values:
    (n, 3) or (n, 6), real or complex, zero where nothing was measured. modal_mass: NaN where none.
    doubt: "" where there is none.
    """

    place: DatasetPlace
    number: int
    frequency_hz: float
    damping: float
    nodes: Integers
    values: Floats | Complexes
    modal_mass: float
    doubt: str = ""


@dataclass(frozen=True, slots=True)
class Function:
    """A dataset 58: values (n,) over abscissae (n,).

    kind: 4 response function, 6 coherence, ... direction: 1..6 with the sensor's sign, 0 for a
    scalar. numerator, denominator: kinds of quantity, 8 displacement, 11 velocity, 12 acceleration,
    13 force. unit, denominator_unit: labels of their units. part, reference_part: the components of
    the structure that the nodes are of, "" where they have no name.
    """

    place: DatasetPlace
    kind: int
    abscissae: Floats
    values: NDArray[np.float64] | Complexes
    node: int
    direction: int
    reference_node: int
    reference_direction: int
    numerator: int
    denominator: int
    unit: str
    denominator_unit: str
    part: str = ""
    reference_part: str = ""


Content = Units | NodeTable | CoordinateSystems | Drawing | DatasetShape | Function


@dataclass(frozen=True, slots=True)
class UniversalFile:
    """A file's datasets (their names, in order), what they say, and what was passed over.

    program: what wrote it, as its header (dataset 151) says, empty where it has none.
    """

    path: Path
    datasets: tuple[str, ...]
    contents: tuple[Content, ...]
    notes: tuple[str, ...]
    program: str = ""


#: Units of length by the code of dataset 164, metres; 9 is one of the user's.
CODES = {1: 1.0, 2: 0.3048, 3: 1.0, 4: 0.3048, 5: 1e-3, 6: 1e-2, 7: 0.0254, 8: 1e-3}
#: A point as test systems name it, where it has no number: wing:12, wing:12:+Z.
_POINT = re.compile(r"(?:.*:)?(\d+)(?::?([+-]?)([XYZ]))?", re.IGNORECASE)
#: Coordinates beyond this are garbled text, in whatever unit; their squares are still numbers.
FARTHEST = 1e30


def units(place: DatasetPlace, block: DatasetBlock, read: Any) -> Units:
    """Dataset 164, whose factors turn SI into the file's units: 1000 for millimetres."""
    factor = float(read["length"])
    if not (math.isfinite(factor) and factor > 0.0):
        raise ValueError(f"has {factor:g} as factor of lengths, which must be above zero")
    force = float(read["force"])
    newtons = 1.0 / force if math.isfinite(force) and force > 0.0 else math.nan
    named = CODES.get(int(read["units_code"]))
    if named is None or math.isclose(named, 1.0 / factor, rel_tol=0.01):
        return Units(place, 1.0 / factor, newtons)
    text = f"its code {read['units_code']} means lengths in {named:g} m, its factor {factor:g}"
    if math.isclose(named, factor, rel_tol=0.01):  # the factor is the other way round
        return Units(place, factor, 1.0 / newtons, f"{text} the inverse; the code is taken")
    return Units(place, 1.0 / factor, newtons, f"{text} {1.0 / factor:g} m; the factor is taken")


def node_table(place: DatasetPlace, block: DatasetBlock, read: Any) -> NodeTable:
    """Datasets 15 and 2411; coordinates of 2411 are global, whatever its export system."""
    columns = [np.asarray(read[name], dtype=np.float64) for name in ("x", "y", "z")]
    names = ("node_nums", "def_cs", "disp_cs")
    numbers = [np.asarray(read[name], dtype=np.float64) for name in names]
    if len({column.size for column in (*columns, *numbers)}) != 1 or not columns[0].size:
        raise ValueError("does not have seven numbers for each of its nodes")
    coordinates = np.column_stack(columns)
    if not (np.abs(coordinates) < FARTHEST).all():
        raise ValueError("has a coordinate that is not a length")
    nodes, definition, displacement = map(_whole, numbers)
    if block.kind == 2411:
        definition = np.zeros_like(definition)
    return NodeTable(place, nodes, coordinates, definition, displacement)


def systems_of_points(place: DatasetPlace, block: DatasetBlock, read: Any) -> CoordinateSystems:
    """Dataset 18: origin, a point on the x axis, and one in the x-z plane."""
    numbers, kinds, references = (
        _whole(np.asarray(read[name])) for name in ("cs_num", "cs_type", "ref_cs_num")
    )
    points = [np.asarray(read[name]) for name in ("ref_o", "x_point", "xz_point")]
    if (
        any(point.shape != (numbers.size, 3) for point in points)
        or not numbers.size == kinds.size == references.size > 0
    ):
        raise ValueError("does not have nine numbers for each coordinate system")
    if not (np.abs(points) < FARTHEST).all():
        raise ValueError("has a coordinate that is not a length")
    systems = []
    for row, number in enumerate(numbers.tolist()):
        origin, x_point, xz_point = (point[row] for point in points)
        x, in_plane = x_point - origin, xz_point - origin
        y = np.cross(in_plane, x)
        lengths = np.linalg.norm(x), np.linalg.norm(y)
        if lengths[1] <= 1e-6 * lengths[0] * np.linalg.norm(in_plane) or not lengths[0]:
            raise ValueError(f"gives coordinate system {number} by three points on one line")
        x, y = x / lengths[0], y / lengths[1]
        axes = np.vstack([x, y, np.cross(x, y)])
        systems.append(
            CoordinateSystem(number, int(kinds[row]), int(references[row]), origin, axes)
        )
    return CoordinateSystems(place, tuple(systems))


def systems_2420(place: DatasetPlace, block: DatasetBlock, read: Any) -> CoordinateSystems:
    """Dataset 2420: rows 1 to 3 of a matrix are a system's axes, row 4 its origin."""
    labels, kinds, matrices = read["CS_sys_labels"], read["CS_types"], read["CS_matrices"]
    if not len(labels) == len(kinds) == len(matrices):
        raise ValueError("does not have a matrix for each coordinate system")
    systems = []
    for number, kind, matrix in zip(labels, kinds, matrices, strict=True):
        values = np.asarray(matrix, dtype=np.float64)
        if values.shape != (4, 3) or not np.isfinite(values).all():
            raise ValueError(f"has no whole matrix of coordinate system {number}")
        axes = values[:3]
        if np.abs(axes @ axes.T - np.eye(3)).max() > 1e-3 or np.linalg.det(axes) < 0.0:
            raise ValueError(f"gives coordinate system {number} axes that are not right angles")
        left, _, right = np.linalg.svd(axes)  # orthonormal beyond the printed digits
        axes = np.asarray(left @ right)
        systems.append(CoordinateSystem(int(number), int(kind), 0, values[3], axes))
    return CoordinateSystems(place, tuple(systems))


def drawing_of_trace(place: DatasetPlace, block: DatasetBlock, read: Any) -> Drawing:
    """Dataset 82: a line from node to node; a zero starts another line."""
    nodes = _whole(np.asarray(read["nodes"], dtype=np.float64))[: max(int(read["n_nodes"]), 0)]
    pairs = np.column_stack([nodes[:-1], nodes[1:]])
    pairs = pairs[(pairs > 0).all(axis=1) & (pairs[:, 0] != pairs[:, 1])]
    return Drawing(place, pairs, np.zeros((0, 3), dtype=np.int64))


def drawing_of_elements(place: DatasetPlace, block: DatasetBlock, read: Any) -> Drawing:
    """Dataset 2412: two-node elements as lines, the sides of all others as triangles."""
    lines: list[tuple[int, ...]] = []
    faces: list[tuple[int, ...]] = []
    for descriptor, elements in read.items():
        if not isinstance(descriptor, int):
            continue
        for element in elements:
            nodes = tuple(element["nodes_nums"])
            side_lines, triangles = _sides(descriptor, nodes)
            lines += side_lines
            faces += triangles
    return Drawing(
        place,
        _whole(np.array(lines, dtype=np.float64)).reshape(-1, 2),
        _whole(np.array(faces, dtype=np.float64)).reshape(-1, 3),
    )


#: Corners of the sides of solids: tetrahedron, wedge, brick.
_SOLIDS: dict[int, tuple[tuple[int, ...], ...]] = {
    111: ((0, 2, 1), (0, 1, 3), (1, 2, 3), (2, 0, 3)),
    112: ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    115: ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
}


def _sides(
    descriptor: int, nodes: tuple[int, ...]
) -> tuple[list[tuple[int, ...]], list[tuple[int, ...]]]:
    """Return lines and triangles that draw an element; nothing for one that is not known."""
    if len(nodes) == 2:
        return [nodes], []
    if descriptor in _SOLIDS:
        corners = _SOLIDS[descriptor]
        if len(nodes) <= max(max(side) for side in corners):
            return [], []
        sides = [tuple(nodes[corner] for corner in side) for side in corners]
    elif 41 <= descriptor <= 99 and descriptor % 10 in (1, 4):
        sides = [nodes]
    elif 41 <= descriptor <= 99 and descriptor % 10 in (2, 5):  # a node amid each edge
        sides = [nodes[::2]]
    elif descriptor == 24:
        return [nodes[:2], nodes[1:3]], []
    else:
        return [], []
    return [], [
        (side[0], side[last], side[last + 1]) for side in sides for last in range(1, len(side) - 1)
    ]


def function(place: DatasetPlace, block: DatasetBlock, read: Any) -> Function:
    """Convert dataset 58."""
    values, abscissae = np.asarray(read["data"]), np.asarray(read["x"], dtype=np.float64)
    count = int(read["num_pts"])
    if values.size < count or abscissae.size < count:
        raise ValueError(f"announces {count} values and has {values.size}")
    part, node, direction = _end(read, "rsp")
    reference_part, reference_node, reference_direction = _end(read, "ref")
    return Function(
        place=place,
        kind=int(read["func_type"]),
        abscissae=abscissae[:count],
        values=values[:count],
        node=node,
        direction=direction,
        reference_node=reference_node,
        reference_direction=reference_direction,
        numerator=int(read["ordinate_spec_data_type"]),
        denominator=int(read["orddenom_spec_data_type"]),
        unit=str(read["ordinate_axis_units_lab"]).strip(),
        denominator_unit=str(read["orddenom_axis_units_lab"]).strip(),
        part=part,
        reference_part=reference_part,
    )


def _end(read: Any, end: str) -> tuple[str, int, int]:
    """Return component, node and direction of one end of a function.

    By its name if it has no number.
    """
    name = str(read[f"{end}_ent_name"]).strip()
    part = "" if name.upper() == "NONE" else name
    node, direction = int(read[f"{end}_node"]), int(read[f"{end}_dir"])
    named = _POINT.fullmatch(part)
    if node or named is None:
        return part, node, direction
    if not direction and named[3]:
        direction = ("XYZ".index(named[3].upper()) + 1) * (-1 if named[2] == "-" else 1)
    return part.rpartition(named[1])[0].strip(":"), int(named[1]), direction


def _whole(values: Floats) -> Integers:
    if not np.isfinite(values).all() or (np.abs(values) > 2**53).any():
        raise ValueError("has a number that is not a whole number")
    whole = values.astype(np.int64)
    if (whole != values).any():
        raise ValueError("has a broken number where a whole one must be")
    return whole


NORMAL_MODE, COMPLEX_MODES = 2, (3, 7)
#: Quantities that move: unknown, general, displacement, velocity, acceleration. Forms that do not.
MOTIONS, TENSORS = (0, 1, 8, 11, 12), (4, 5)
#: A frequency in an id line, and how near a pole is to one that was printed with few digits.
_HERTZ = re.compile(r"(\d+(?:[.,]\d*)?(?:e[+-]?\d+)?)\s*hz\b", re.IGNORECASE)
SAME_HZ = 5e-3
_WIDTH = 13  # of a value: E13.5


def shape_55(place: DatasetPlace, block: DatasetBlock, read: Any) -> DatasetShape | None:
    """Dataset 55; nothing where it has no values. Raises ValueError where it is not a mode."""
    text, doubt = data_kind(block.rows[6]), ""
    _check_mode(text)
    if text.analysis == NORMAL_MODE:
        pole = _normal(read["freq"], read["modal_damp_vis"], read["modal_damp_his"])
        mass = float(read["modal_m"])
    else:
        pole, doubt = _by_its_text(complex(read["eig"]), " ".join(block.rows[1:6]))
        mass = math.nan
    if text.is_complex and text.count == 6:
        nodes, values = complex_with_rotations(block)
    else:
        nodes = np.asarray(read["node_nums"], dtype=np.int64)
        columns = [np.asarray(read[f"r{component}"]) for component in range(1, text.count + 1)]
        if any(column.size != nodes.size for column in columns):
            raise ValueError("does not have as many values at each node as it announces")
        values = np.column_stack(columns)
    return _shape(place, int(read["mode_n"]), pole, nodes, values, mass, doubt)


def shape_2414(place: DatasetPlace, block: DatasetBlock, read: Any) -> DatasetShape | None:
    """Dataset 2414 with data at nodes. Raises ValueError where it is not a mode."""
    text = data_kind(block.rows[9])
    _check_mode(text)
    reals = [float(read[f"record12_field{field}"]) for field in range(1, 7)]
    if text.analysis == NORMAL_MODE:
        pole, mass = _normal(reals[1], reals[4], reals[5]), reals[3]
    else:
        eigenvalue = complex(read["record13_field1"], read["record13_field2"])
        pole, mass = _complex(eigenvalue), math.nan
    nodes = np.asarray(read["node_nums"], dtype=np.int64)
    values = np.asarray(read["data_at_node"], dtype=np.float64)
    if values.ndim != 2 or values.shape[1] != text.count * (1 + text.is_complex):
        raise ValueError("does not have as many values at each node as it announces")
    if text.is_complex:
        values = values[:, ::2] + 1j * values[:, 1::2]
    return _shape(place, int(read["record10_field6"]), pole, nodes, values, mass)


def complex_with_rotations(block: DatasetBlock) -> tuple[Integers, Complexes]:
    """Read nodes (n,) and values (n, 6) of a dataset 55 of the kind that pyuff refuses."""
    nodes, values = [], []
    for node, rows in node_rows([row.rstrip() for row in block.rows], HEADERS[55], 55):
        fields = [
            row[start : start + _WIDTH] for row in rows for start in range(0, len(row), _WIDTH)
        ]
        if len(fields) != 12:
            raise ValueError(f"has {len(fields)} of 12 numbers at node {node.strip()}")
        numbers = [float(field.replace("D", "E").replace("d", "e")) for field in fields]
        nodes.append(int(node))
        values.append(numbers)
    table = np.array(values).reshape(-1, 12)
    return np.array(nodes, dtype=np.int64), table[:, ::2] + 1j * table[:, 1::2]


def _check_mode(said: DataKind) -> None:
    if said.analysis not in (NORMAL_MODE, *COMPLEX_MODES):
        raise ValueError(f"holds no mode (its analysis type is {said.analysis})")
    if said.quantity not in MOTIONS or said.form in TENSORS:
        raise ValueError(f"holds no motion (its data type is {said.quantity})")
    if said.count not in (3, 6):
        raise ValueError(f"has {said.count} values a node, where a shape has 3 or 6")


def _normal(frequency_hz: Any, viscous: Any, hysteretic: Any) -> tuple[float, float]:
    """Return frequency and damping ratio.

    Half the loss factor where no viscous damping is given.
    """
    damping = float(viscous) or 0.5 * float(hysteretic)
    return float(frequency_hz), damping or math.nan


def _complex(eigenvalue: complex) -> tuple[float, float]:
    """Return frequency and damping ratio of a pole in rad/s."""
    magnitude = abs(eigenvalue)
    if not magnitude > 0.0:
        raise ValueError("has the eigenvalue 0")
    if eigenvalue.imag < 0.0:
        raise ValueError("is the conjugate of a mode (its eigenvalue's imaginary part is negative)")
    return magnitude / (2.0 * math.pi), -eigenvalue.real / magnitude


def _by_its_text(eigenvalue: complex, text: str) -> tuple[tuple[float, float], str]:
    """Return frequency and damping ratio of a pole, and a doubt where its dataset names it in Hz.

    The format has poles in rad/s; programs that write Hz often say the frequency in an id line.
    """
    frequency_hz, damping = _complex(eigenvalue)
    for found in _HERTZ.finditer(text):
        named = float(found[1].replace(",", "."))
        if named > 0.0 and math.isclose(named, abs(eigenvalue), rel_tol=SAME_HZ):
            return (abs(eigenvalue), damping), "its text has the pole in Hz, which is taken"
    return (frequency_hz, damping), ""


def _shape(
    place: DatasetPlace,
    number: int,
    pole: tuple[float, float],
    nodes: Integers,
    values: NDArray[np.float64] | Complexes | Floats,
    mass: float,
    doubt: str = "",
) -> DatasetShape | None:
    if nodes.size == 0:
        return None
    if values.shape[0] != nodes.size or np.unique(nodes).size != nodes.size:
        raise ValueError("gives a node twice or without values")
    if not (np.isfinite(values).all() and math.isfinite(pole[0])):
        raise ValueError("has a value that is not a finite number")
    if not pole[0] > 0.0:
        raise ValueError(f"is of a mode at {pole[0]:g} Hz, which must be above zero")
    order = np.argsort(nodes)
    return DatasetShape(place, number, *pole, nodes[order], values[order], mass or math.nan, doubt)
