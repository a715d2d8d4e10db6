"""What the datasets of universal files say, as typed values with the place each comes from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from modetune.core.measurement.frf import Complexes
from modetune.core.modes import Floats, Integers


@dataclass(frozen=True, slots=True)
class DatasetPlace:
    """Where a dataset stands: file, the line of its number, that number."""

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
