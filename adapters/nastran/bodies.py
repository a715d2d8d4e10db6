"""Rigid bodies at grid points, as CONM2 cards give them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from modetune.adapters.nastran.geometry import local_axes
from modetune.core.modes import Floats


@dataclass(frozen=True, slots=True)
class PointMass:
    """A rigid body at a grid point, in basic coordinates and the deck's own unit (no WTMASS).

    centre: (3,), of gravity; inertia: (3, 3), about the centre, as a tensor. eid: of its element,
    0 where it is of several. group: of masses that are always alike.
    """

    eid: int
    node: int
    mass: float
    centre: Floats
    inertia: Floats
    group: str = ""

    @property
    def name(self) -> str:
        """Of its set and material in CalculiX: that of its group, or its own."""
        return self.group or f"CONM2_{self.eid}_{self.node}"


def point_mass(element: Any) -> PointMass:
    """The body of a cross-referenced CONM2."""
    node = element.nid_ref
    place = np.asarray(node.get_position(), dtype=np.float64)
    offset = np.asarray(element.X, dtype=np.float64)
    xx, xy, yy, xz, yz, zz = element.I
    # The card has the products of inertia as positive integrals; the tensor has them negative.
    inertia = np.array([[xx, -xy, -xz], [-xy, yy, -yz], [-xz, -yz, zz]])
    if element.cid == -1:
        return PointMass(element.eid, element.Nid(), element.mass, offset, inertia)
    axes = local_axes(element.cid_ref, place)
    centre = place + offset @ axes
    return PointMass(element.eid, element.Nid(), element.mass, centre, axes.T @ inertia @ axes)
