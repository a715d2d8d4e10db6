"""Nastran springs (CELAS1, CELAS2, CBUSH) in CalculiX.

Each stiffness is one spring on the difference of two freedoms, rotations included, so that its
strain energy is its own (`grounded_springs`). A CBUSH acts at one point of the line between its
grid points, which carry it as rigid bodies do, in axes of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from modetune.adapters.translation.calculix_text import CalculixText
from modetune.adapters.translation.frames import local_axes
from modetune.adapters.translation.freedoms import Form, Freedoms, difference
from modetune.adapters.translation.grounded_springs import GroundedSprings
from modetune.adapters.translation.shells import SetsOf
from modetune.core.modes import Floats

SCALAR = ("CELAS1", "CELAS2", "CELAS3", "CELAS4")
KINDS = (*SCALAR, "CBUSH")

#: Linear forms and their stiffnesses.
Deformations = list[tuple[Form, float]]


def translate_springs(
    bulk: Any,
    builder: CalculixText,
    freedoms: Freedoms,
    problems: list[str],
    wtmass: float,
    sets_of: SetsOf,
) -> None:
    """Add all springs; after the constraints, which say what is fixed. They have no mass."""
    springs = GroundedSprings(builder, freedoms)
    readers: dict[str, Callable[[Any, Freedoms], Deformations]] = {
        "CELAS1": _scalar_spring, "CELAS2": _scalar_spring, "CELAS3": _no_scalar_points,
        "CELAS4": _no_scalar_points, "CBUSH": _bush,
    }  # fmt: skip
    for element in bulk.elements.values():
        if element.type not in readers:
            continue
        try:
            deformations = readers[element.type](element, freedoms)
            springs.add(deformations, sets_of(element))
        except ValueError as reason:
            problems.append(f"{element.type} {element.eid}: {reason}")


def _no_scalar_points(element: Any, freedoms: Freedoms) -> Deformations:
    raise ValueError("scalar points are not translated")


def _scalar_spring(element: Any, freedoms: Freedoms) -> Deformations:
    stiffness = element.pid_ref.k if element.type == "CELAS1" else element.k
    forms = []
    for node, component in zip(element.nodes, (element.c1, element.c2), strict=True):
        if not node:
            continue
        if node not in freedoms.builder.coordinates or not component:
            raise ValueError(f"point {node} is no GRID: scalar points are not translated")
        forms.append(_freedom(freedoms, node, int(component)))
    if not forms:
        raise ValueError("both its ends are grounded")
    return [(difference(forms[0], forms[1] if len(forms) > 1 else {}), float(stiffness))]


def _freedom(freedoms: Freedoms, node: int, component: int) -> Form:
    """Raises ValueError where the grid point has no such rotation."""
    form = freedoms.form(node, component)
    if not form:
        raise ValueError(f"point {node} is of solids and has no rotation {component}")
    return form


def _bush(element: Any, freedoms: Freedoms) -> Deformations:
    """The six deformations, of the second end against the first (or the ground)."""
    if element.pid_ref.type != "PBUSH":
        raise ValueError(f"{element.pid_ref.type} is not translated")
    if element.pid_ref.mass:
        raise ValueError("the mass of its PBUSH is not translated; give it as a CONM2")
    values = [float(value or 0.0) for value in element.pid_ref.Ki]
    values += [0.0] * (6 - len(values))
    first, second = [*element.node_ids, None][:2]
    start = freedoms.builder.coordinates[first]
    span = freedoms.builder.coordinates[second] - start if second else np.zeros(3)
    if element.ocid is not None and element.ocid >= 0:
        raise ValueError(f"an offset in system OCID={element.ocid}")
    place = start + (0.5 if element.s is None else element.s) * span
    axes = _bush_axes(element, start, span, values, freedoms)
    found = []
    for component, stiffness in enumerate(values):
        if stiffness == 0.0:
            continue
        ends = [
            _motion(freedoms, node, place, axes[component % 3], turns=component > 2)
            for node in (second, first) if node
        ]  # fmt: skip
        found.append((difference(ends[0], ends[1]) if len(ends) == 2 else ends[0], stiffness))
    return found


def _motion(freedoms: Freedoms, node: int, place: Floats, axis: Floats, turns: bool) -> Form:
    """Displacement or rotation along an axis, of a place that is rigid with a grid point."""
    if not turns:
        return freedoms.rigid_motion(node, place, axis)
    rotations = freedoms.rotations(node)
    if not rotations:
        raise ValueError(f"point {node} is of solids and has no rotations")
    return freedoms.along(rotations, axis)


def _bush_axes(
    element: Any, place: Floats, span: Floats, values: list[float], freedoms: Freedoms
) -> Floats:
    """x, y, z of the bush as rows in basic coordinates."""
    if element.cid is not None:
        return local_axes(element.cid_ref, place)
    length = float(np.linalg.norm(span))
    size = 1e-9 * (1.0 + float(np.abs(place).max()))
    if length <= size:
        raise ValueError("its ends coincide or one is grounded: it needs a CID")
    x = span / length
    given = element.x if element.x is not None and element.x[0] is not None else None
    if element.g0:
        guess = np.asarray(freedoms.builder.coordinates[element.g0] - place)
    elif given is not None:
        frame = freedoms.frames.get(element.node_ids[0], np.eye(3))
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
