"""How a test lies over a model, found once and kept in the campaign's store.

The search takes seconds; the same points on the same surface give the same poses. What the store
has is believed where its checksum holds; what cannot be kept is searched again next time.
"""

from __future__ import annotations

import hashlib
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from modetune.core.errors import StorageUnavailable
from modetune.core.measurement.alignment import Alignment, Registration
from modetune.core.measurement.closest_points import SurfacePoints
from modetune.core.modes import Floats
from modetune.core.storage.keys import Json, canonical_json, content_key
from modetune.core.storage.store import Entry, Store

logger = logging.getLogger(__name__)

#: Grows whenever the search may answer otherwise.
SEARCH = 2


@dataclass(frozen=True, slots=True)
class PoseSearch:
    """Searches a model's surface, triangles (n, 3, 3), and nodes (n, 3) for a test.

    surface: the triangles, once they are asked for distances. store: None keeps nothing.
    """

    corners: Floats
    nodes: Floats
    surface: Callable[[], SurfacePoints]
    store: Store | None = None

    def register(
        self, points: Floats, scale: float | None, near: Alignment | None = None
    ) -> Registration:
        """All poses of points (n, 3) that cannot be told apart (`registration.register`).

        Raises ModesError where points or nodes allow no fit.
        """
        if self.store is None:
            return self._search(points, scale, near)
        asked = canonical_json(self._asked(points, scale, near))
        key, begun = content_key(asked), time.monotonic()
        entry = self.store.get(key)
        if entry is not None and isinstance(entry.result, Registration):
            return entry.result
        found = self._search(points, scale, near)
        try:
            self.store.put(Entry(key, found, "modetune", "", time.monotonic() - begun), asked)
        except StorageUnavailable as error:
            logger.info("the pose of the test is not kept: %s", error)
        return found

    def _search(self, points: Floats, scale: float | None, near: Alignment | None) -> Registration:
        from modetune.core.measurement.registration import register  # what is kept needs no search

        logger.info("laying %d test points over the model", len(points))
        return register(points, self.surface(), self.nodes, scale, near)

    def _asked(self, points: Floats, scale: float | None, near: Alignment | None) -> Json:
        return {
            "search of poses": SEARCH,
            "points": _digest(points),
            "corners": _digest(self.corners),
            "nodes": _digest(self.nodes),
            "scale": scale,
            "near": None
            if near is None
            else [near.scale, near.rotation.tolist(), near.translation.tolist()],
        }


def _digest(values: Floats) -> str:
    exact = np.ascontiguousarray(values, "<f8")
    return hashlib.sha256(repr(exact.shape).encode() + exact.tobytes()).hexdigest()
