"""Where a CBUSH acts, and in which axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from modetune.adapters.nastran.geometry import local_axes
from modetune.core.modes import Floats


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
