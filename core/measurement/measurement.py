"""What a test gives: modes, response functions, where its sensors sit and which way they look."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import get_args

import numpy as np
from numpy.typing import NDArray

from modetune.core.brief import brief
from modetune.core.errors import ModesError
from modetune.core.measurement.response_functions import Complexes, Response
from modetune.core.modes import Floats, Integers, MeasuredModes


@dataclass(frozen=True, slots=True)
class TestGeometry:
    """The points of a test.

    nodes: (n,), the test's own numbers, each once. coordinates: (n, 3), the test's global axes.
    frames: (n, 3, 3), rows are the directions x, y, z in which a point's motion was measured,
    unit vectors in the test's global axes; the identity if the file has none.
    lines: pairs of nodes (n_lines, 2) that draw the structure; faces: (n_faces, 3), triangles.
    metres: length of the coordinates' unit in metres, NaN if the file has none.
    Raises ModesError where arrays do not fit together.
    """

    __test__ = False  # not a test of pytest's

    nodes: Integers
    coordinates: Floats
    frames: Floats
    lines: Integers = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    faces: Integers = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int64))
    metres: float = float("nan")

    def __post_init__(self) -> None:
        n = self.nodes.size
        if self.coordinates.shape != (n, 3) or self.frames.shape != (n, 3, 3):
            raise ModesError(f"the coordinates or axes of the test do not fit its {n} points")
        if np.unique(self.nodes).size != n:
            raise ModesError("a point of the test is given twice")
        if not (np.isfinite(self.coordinates).all() and np.isfinite(self.frames).all()):
            raise ModesError("a coordinate or direction of the test is not a finite number")


@dataclass(frozen=True, slots=True, repr=False)
class MeasuredFrfs:
    """Frequency response functions of a test, all on the same frequencies.

    frequencies_hz: (n_lines,), ascending. values: (n_lines, n_functions), motion per force in
    SI: m, m/s or m/s^2 (rad for rotations) per N (Nm for moments).
    nodes, components: (n_functions,), where and which way the response was measured: test node,
    and 1..6; signs: (n_functions,), -1 where the sensor looks the other way.
    reference_nodes, reference_components, reference_signs: (n_functions,), of the force likewise.
    coherences: (n_lines, n_functions), empty where the test has none.
    Raises ModesError where arrays do not fit together.
    """

    kind: Response
    frequencies_hz: Floats
    values: Complexes
    nodes: Integers
    components: Integers
    signs: Floats
    reference_nodes: Integers
    reference_components: Integers
    reference_signs: Floats
    coherences: NDArray[np.float64]

    __repr__ = brief

    def __post_init__(self) -> None:
        if self.kind not in get_args(Response):
            raise ModesError(
                f"response functions are {', '.join(get_args(Response))}, not {self.kind!r}"
            )
        n_lines, n_functions = self.values.shape
        columns = (
            self.nodes,
            self.components,
            self.signs,
            self.reference_nodes,
            self.reference_components,
            self.reference_signs,
        )
        if self.frequencies_hz.shape != (n_lines,) or any(
            column.shape != (n_functions,) for column in columns
        ):
            raise ModesError("the columns of the response functions do not fit together")
        if self.coherences.size and self.coherences.shape != self.values.shape:
            raise ModesError("the coherences do not fit the response functions")
        finite = np.isfinite(self.frequencies_hz).all()
        if not finite or (np.diff(self.frequencies_hz) <= 0.0).any():
            raise ModesError("the frequencies of response functions must be finite and ascend")
        if not np.isfinite(self.values).all():
            raise ModesError("a response function holds values that are not finite numbers")

    def of(self, which: NDArray[np.bool_]) -> MeasuredFrfs:
        """Some of the functions; which: (n_functions,)."""
        return MeasuredFrfs(
            self.kind,
            self.frequencies_hz,
            self.values[:, which],
            self.nodes[which],
            self.components[which],
            self.signs[which],
            self.reference_nodes[which],
            self.reference_components[which],
            self.reference_signs[which],
            self.coherences[:, which] if self.coherences.size else self.coherences,
        )


@dataclass(frozen=True, slots=True)
class MeasuredDeviations:
    """Standard deviations of the modes of a test, NaN if unknown.

    frequencies: (n_modes,), relative standard deviations of the frequencies; shapes: (n_modes,), of
    the entries of each shape, relative to its root mean square. correlation: (n_modes, n_modes), of
    the frequencies, None where nothing is known of it.
    Raises ModesError for values that are not above zero.
    """

    frequencies: Floats
    shapes: Floats
    correlation: Floats | None = None

    def __post_init__(self) -> None:
        for values in (self.frequencies, self.shapes):
            if values.shape != self.frequencies.shape or (values <= 0.0).any():
                raise ModesError("each mode of a test needs deviations above zero")


@dataclass(frozen=True, slots=True)
class OtherValues:
    """Values of repeated tests other than modes, in the deck's units.

    names: as reports call the responses, "mass"; values: (n_tests, n_names), NaN where missing.
    """

    names: tuple[str, ...]
    values: Floats


@dataclass(frozen=True, slots=True, repr=False)
class RepeatedTests:
    """What tests of one structure found, each on its own.

    places: of each test, its file, or file and line; numbers: of the modes. frequencies_hz,
    damping_ratios: (n_tests, n_modes), NaN where not found. used: (n_tests, n_modes), which
    frequencies count, None before that is judged; worth: the share of an independent test in each;
    others: what else they measured.
    """

    places: tuple[str, ...]
    numbers: tuple[int, ...]
    frequencies_hz: Floats
    damping_ratios: Floats
    used: NDArray[np.bool_] | None = None
    worth: float = 1.0
    others: OtherValues | None = None

    __repr__ = brief

    def __post_init__(self) -> None:
        shape = len(self.places), len(self.numbers)
        if self.frequencies_hz.shape != shape or self.damping_ratios.shape != shape:
            raise ModesError(f"the values do not fit {shape[0]} tests of {shape[1]} modes")


@dataclass(frozen=True, slots=True, repr=False)
class Measurement:
    """A test as its files give it; each part may be missing.

    modes: real shapes at the test's own nodes, in the directions of `geometry.frames`.
    notes: what the reader decided or left out, a sentence each, for people.
    deviations: of the modes, in their order; repeats: the tests that the modes are the mean of.
    complex_shapes: (n_dof, n_modes), of the modes as measured, where they are not real.
    environment: what else was measured, such as temperature_C, by name. measured_at: when, in
    seconds since 1970, NaN if unknown.
    """

    modes: MeasuredModes | None = None
    geometry: TestGeometry | None = None
    frfs: MeasuredFrfs | None = None
    notes: tuple[str, ...] = ()
    deviations: MeasuredDeviations | None = None
    repeats: RepeatedTests | None = None
    complex_shapes: Complexes | None = None
    environment: Mapping[str, float] = field(default_factory=dict)
    measured_at: float = float("nan")

    __repr__ = brief

    @property
    def is_empty(self) -> bool:
        """Whether there are neither modes, geometry, response functions nor an environment."""
        parts = (self.modes, self.geometry, self.frfs)
        known = self.environment or self.measured_at == self.measured_at
        return all(part is None for part in parts) and not known
