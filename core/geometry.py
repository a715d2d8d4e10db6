"""Where the sensors of a test sit and which way they look."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers


@dataclass(frozen=True, slots=True)
class TestGeometry:
    """The points of a test.

    nodes: (n,), the test's own numbers, each once. coordinates: (n, 3), the test's global axes.
    frames: (n, 3, 3), rows are the directions x, y, z in which a point's motion was measured,
    unit vectors in the test's global axes; the identity where the file tells no other.
    lines: pairs of nodes (n_lines, 2) that draw the structure; faces: (n_faces, 3), triangles.
    metres: length of the coordinates' unit in metres, NaN where the file does not tell.
    Raises ModesError where arrays do not fit together.
    """

    __test__ = False  # not a test of pytest's

    nodes: Integers
    coordinates: Floats
    frames: Floats
    lines: Integers
    faces: Integers
    metres: float = float("nan")

    def __post_init__(self) -> None:
        n = self.nodes.size
        if self.coordinates.shape != (n, 3) or self.frames.shape != (n, 3, 3):
            raise ModesError(f"the coordinates or axes of the test do not fit its {n} points")
        if np.unique(self.nodes).size != n:
            raise ModesError("a point of the test is given twice")
        if not (np.isfinite(self.coordinates).all() and np.isfinite(self.frames).all()):
            raise ModesError("a coordinate or direction of the test is not a finite number")
