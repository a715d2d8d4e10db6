"""Where the axis of a Nastran bar or beam lies, and its element coordinate system."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from modetune.core.modes import Floats

#: What OFFT may be: of the orientation vector, of the offset at end A, at end B.
OFFSET_TYPES = frozenset(first + a + b for first in "GB" for a in "GO" for b in "GO")

#: In the place of OFFT old decks say how the orientation is given, by components or a grid point.
OLD_VECTOR, OLD_GRID = "1", "2"


@dataclass(frozen=True, slots=True)
class BeamAxes:
    """offsets: (2, 3), from the grid points to the axis' ends; ends: (2, 3), of the axis; axes:
    (3, 3), x, y, z of the element as rows. Basic coordinates.
    """

    offsets: Floats
    ends: Floats
    axes: Floats

    @property
    def length(self) -> float:
        return float(np.linalg.norm(self.ends[1] - self.ends[0]))


def beam_axes(element: Any, places: Mapping[int, Floats], frames: Mapping[int, Floats]) -> BeamAxes:
    """Of a bar, beam or rod. Raises ValueError with what is wrong with it.

    places: (3,) of each grid point; frames: (3, 3) of those whose output frame is not the basic
    one. OFFT says what the orientation vector and the offsets are parallel to: the output frame of
    their grid point (G), the basic system (B), or x from grid point to grid point with y and z by
    the orientation vector (O).
    """
    nodes = element.node_ids[:2]
    grids = np.array([places[node] for node in nodes])
    if getattr(element, "wa", None) is None:
        x = _unit(grids[1] - grids[0])
        axes = _axes(x, np.eye(3)[int(np.argmin(np.abs(x)))])
        return BeamAxes(np.zeros((2, 3)), grids, axes)
    kind = str(getattr(element, "offt", None) or "GGG").upper()
    if kind == (OLD_GRID if element.g0 else OLD_VECTOR):
        kind = "GGG"
    if kind not in OFFSET_TYPES:
        raise ValueError(f"OFFT={kind} is not one of {', '.join(sorted(OFFSET_TYPES))}")
    towards = _orientation(element, kind, places, frames)
    offsets = np.zeros((2, 3))
    for end, (given, node, system) in enumerate(
        zip((element.wa, element.wb), nodes, kind[1:], strict=True)
    ):
        if np.any(given):
            frame = frames.get(node, np.eye(3))
            if system == "O":
                frame = _axes(_unit(grids[1] - grids[0]), towards)
            offsets[end] = np.asarray(given, dtype=np.float64) @ frame
    ends = grids + offsets
    return BeamAxes(offsets, ends, _axes(_unit(ends[1] - ends[0]), towards))


def _unit(span: Floats) -> Floats:
    length = float(np.linalg.norm(span))
    if not length > 0.0:
        raise ValueError("its ends coincide")
    return span / length


def _axes(x: Floats, towards: Floats) -> Floats:
    z = np.cross(x, towards)
    size = float(np.linalg.norm(z))
    if not size > 1e-6 * float(np.linalg.norm(towards)):
        raise ValueError("its orientation vector is along its axis")
    z = z / size
    return np.array([x, np.cross(z, x), z])


def _orientation(
    element: Any, kind: str, places: Mapping[int, Floats], frames: Mapping[int, Floats]
) -> Floats:
    """The orientation vector, basic coordinates."""
    if element.g0:
        return np.asarray(places[element.g0] - places[element.node_ids[0]])
    if element.x is None or any(value is None for value in element.x):
        raise ValueError("it has no orientation vector")
    frame = frames.get(element.node_ids[0], np.eye(3)) if kind[0] == "G" else np.eye(3)
    return np.asarray(np.asarray(element.x, dtype=np.float64) @ frame)
