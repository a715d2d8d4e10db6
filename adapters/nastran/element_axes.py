"""Where the axis of a Nastran bar, beam or bush lies, and its element coordinate system."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from modetune.adapters.nastran.geometry import local_axes
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


def bush_place(element: Any, coordinates: Mapping[int, Floats]) -> tuple[Floats, Floats]:
    """The point at which it acts, and the way from its first end to its second one (or none)."""
    first, second = [*element.node_ids, None][:2]
    start = np.asarray(coordinates[first])
    span = coordinates[second] - start if second else np.zeros(3)
    place = start + (0.5 if element.s is None else element.s) * span
    if element.ocid is not None and element.ocid >= 0:
        place = np.asarray(element.ocid_ref.transform_node_to_global(np.array(element.si)))
    return place, span


def bush_axes(
    element: Any,
    span: Floats,
    coordinates: Mapping[int, Floats],
    frames: Mapping[int, Floats],
    values: Sequence[float],
) -> Floats:
    """x, y, z of the bush as rows in basic coordinates.

    frames: output frames of grid points that are not basic; values: (6,), what it has in each
    direction. Raises ValueError where the deck does not tell.
    """
    place = coordinates[element.node_ids[0]]
    if element.cid is not None:
        return local_axes(element.cid_ref, place)
    length = float(np.linalg.norm(span))
    size = 1e-9 * (1.0 + float(np.abs(place).max()))
    if length <= size:
        raise ValueError("its ends coincide or one is grounded: it needs a CID")
    x = span / length
    given = element.x if element.x is not None and element.x[0] is not None else None
    if element.g0:
        guess = np.asarray(coordinates[element.g0] - place)
    elif given is not None:
        frame = frames.get(element.node_ids[0], np.eye(3))
        guess = np.asarray(np.asarray(given, dtype=np.float64) @ frame)
    elif any(values[1:3]) or any(values[4:6]):
        raise ValueError("it has no orientation vector, and stiffness across its axis")
    else:
        guess = np.eye(3)[int(np.argmin(np.abs(x)))]
    z = np.cross(x, guess)
    if not np.linalg.norm(z) > 1e-6 * np.linalg.norm(guess):
        raise ValueError("its orientation vector is along its axis")
    z = z / np.linalg.norm(z)
    return np.array([x, np.cross(z, x), z])
