"""A scene as the page's script takes it, small enough for a file."""

from __future__ import annotations

import base64

import numpy as np

from modetune.core.keys import Json
from modetune.core.modes import Floats, Integers
from modetune.flows.report.scene import Motion, Scene

#: Motions are whole numbers of this many steps, which no eye tells from more.
STEPS = 32767


def told_scene(shown: Scene) -> dict[str, Json]:
    """What `shapes.js` draws: arrays as base64 of little-endian numbers, row after row."""
    return {
        "length": shown.length,
        "coordinates": _packed(shown.coordinates, "<f4"),
        "triangles": _packed(shown.triangles, "<u4"),
        "edges": _packed(shown.edges, "<u4"),
        "nodes": shown.nodes.tolist(),
        "points": _packed(shown.points, "<f4"),
        "lines": _packed(shown.lines, "<u4"),
        "modes": [
            {
                "label": mode.label,
                "test_hz": mode.test_hz,
                "before": _told_motion(mode.before),
                "after": _told_motion(mode.after),
            }
            for mode in shown.modes
        ],
    }


def _told_motion(motion: Motion) -> dict[str, Json]:
    return {
        "hz": motion.frequency_hz,
        "mac": motion.mac if np.isfinite(motion.mac) else None,
        "model": _packed(np.rint(STEPS * motion.model), "<i2"),
        "test": _packed(motion.test, "<f4"),
    }


def _packed(values: Floats | Integers, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values).astype(kind).tobytes()).decode()
