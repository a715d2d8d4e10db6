"""Axes of Nastran coordinate systems, and the output frames of grid points."""

from __future__ import annotations

from typing import Any

import numpy as np

from modetune.core.modes import Floats


def local_axes(frame: Any, place: Floats) -> Floats:
    """Axes of a coordinate system at a place, as rows in basic coordinates (3, 3).

    frame: a cross-referenced CORD card, or None for the basic system. In a cylindrical or
    spherical one the axes are those of the place's own radius and angles; on its z axis, where
    the radius has no direction, the system's x axis stands for it.
    """
    if frame is None:
        return np.eye(3)
    axes = np.asarray(frame.beta(), dtype=np.float64)
    if frame.type.endswith("R"):
        return axes
    x, y, z = axes @ (place - np.asarray(frame.origin, dtype=np.float64))
    radius = float(np.hypot(x, y))
    on_axis = radius <= 1e-12 * (1.0 + abs(float(z)))
    cos, sin = (1.0, 0.0) if on_axis else (float(x) / radius, float(y) / radius)
    if frame.type.endswith("C"):
        return np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]) @ axes
    polar = float(np.arctan2(radius, z))
    up, out = float(np.cos(polar)), float(np.sin(polar))
    turn = [[out * cos, out * sin, up], [up * cos, up * sin, -out], [-sin, cos, 0.0]]
    return np.asarray(np.array(turn) @ axes)


def output_frames(bulk: Any) -> dict[int, Floats]:
    """Basic-to-CD rotation (3, 3) of each grid point whose output frame is not the basic one."""
    frames = {}
    for number, grid in bulk.nodes.items():
        if grid.cd_ref is not None and grid.Cd() != 0:
            axes = local_axes(grid.cd_ref, np.asarray(grid.get_position(), dtype=np.float64))
            if not np.allclose(axes, np.eye(3), rtol=0.0, atol=1e-12):
                frames[number] = axes
    return frames
