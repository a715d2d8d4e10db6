"""Boundary conditions: rigid-body motion that only the test or only the model has.

A free structure and one that is held have different modes, but each mode of either is a sum of a
few modes of the other and a rigid-body motion: the first mode of a cantilever is that of a free
beam, moved and turned until one end is at rest. So each measured shape is fitted by the lowest
computed shapes, alone and with the rigid-body motions added. If these explain most of what the
modes alone leave of several shapes, one side moves where the other is held. A shape that is a
rigid-body motion itself, in an otherwise matching test, is a mode of the suspension.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from modetune.core.correlation.correlation import Shapes, rigid_body_shapes
from modetune.core.errors import ModelError
from modetune.core.measurement.sensor_map import global_directions
from modetune.core.modes import Floats, common_dofs
from modetune.core.near_names import listed
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.case import Case
from modetune.flows.diagnosis.findings import MODEL, TEST, Finding, modes_left_out, setting

#: Share of a measured shape in rigid-body motions that makes it a rigid-body mode.
RIGID_SHARE = 0.98
#: Share of a measured shape that the computed modes must leave, and the part of it that may remain
#: after the rigid-body motions are added: far less than as many random shapes leave.
LEFT, REMAINS = 0.05, 0.4
#: A shape is fitted by computed modes up to this multiple of its frequency, two at least and one
#: for three sensors at most.
BAND = 1.5
#: Sensors in excess of the fitted shapes; with fewer, anything fits.
SPARE_SENSORS = 4
#: Relative singular value below which the sensors do not separate a rigid-body motion.
SEPARATE = 1e-3


def boundary_findings(case: Case, result: ModalResult) -> Iterator[Finding]:
    """Report rigid-body modes in the test, and shapes that differ by a rigid-body motion.

    result: modes of the model, rigid ones included. Raises ModesError.
    """
    test = case.measured
    seen = case.sensors.observe(result.elastic)
    rows, columns = common_dofs(test.modes, seen)
    motions = _motions(case, result)[rows]
    n = rows.size
    if not motions.shape[1] or n < n // 3 + motions.shape[1] + SPARE_SENSORS:
        return
    sizes = np.linalg.norm(test.modes.mode_shapes[rows], axis=0)
    measured = test.modes.mode_shapes[rows] / np.where(sizes > 0.0, sizes, 1.0)
    computed = seen.mode_shapes[columns]
    alone, moved = np.zeros(sizes.size), np.zeros(sizes.size)
    for place, hz in enumerate(test.modes.frequencies_hz.tolist()):
        below = int(np.sum(seen.frequencies_hz < BAND * hz))
        shapes = computed[:, : min(max(below, 2), n // 3)]
        alone[place] = _left(measured[:, place], shapes)
        moved[place] = _left(measured[:, place], np.hstack([shapes, motions]))
    differ = (alone > LEFT) & (moved < REMAINS * alone)
    rigid = differ & (np.linalg.norm(motions.T @ measured, axis=0) ** 2 > RIGID_SHARE)
    partly = differ & ~rigid
    free = result.n_rigid > 0
    if partly.sum() >= 2:
        yield MODEL.doubtful(
            f"the model is {'free' if free else 'held'} where the tested structure seems "
            f"{'held' if free else 'free'}: its modes leave {100 * alone[differ].mean():.2g} % of "
            f"the shapes of test modes {_listed(case, differ)}, and "
            f"{100 * moved[differ].mean():.2g} % with rigid-body motions added",
            "",
            "compare the supports in `model.deck` with those of the test",
            setting("model.deck"),
        )
    elif rigid.any():
        hz = listed(f"{value:.4g}" for value in test.modes.frequencies_hz[rigid].tolist())
        yield TEST.doubtful(
            f"a rigid-body motion at {hz} Hz"
            + (": a mode of the suspension" if free else ", but the model is held"),
            f"test mode {_listed(case, rigid)}",
            "leave it out with `test.use`"
            + ("" if free else ", or compare the supports in `model.deck` with those of the test"),
            modes_left_out(*(case.measured.numbers[row] for row in np.flatnonzero(rigid).tolist())),
        )


def _left(shape: Shapes, basis: Shapes) -> float:
    """Return the share of a unit shape outside the space of others."""
    left, values, _ = np.linalg.svd(basis, full_matrices=False)
    inside = left[:, values > SEPARATE * values.max(initial=0.0)].T @ shape
    return float(max(1.0 - np.sum(np.abs(inside) ** 2), 0.0))


def _listed(case: Case, which: NDArray[np.bool_]) -> str:
    return listed(case.measured.numbers[row] for row in np.flatnonzero(which).tolist())


def _motions(case: Case, result: ModalResult) -> Floats:
    """Return an orthonormal basis of the rigid-body motions at the sensors, (n_sensors, n).

    From the rigid modes of a free model; of a held one from the mesh, or without a mesh the
    translations alone.
    """
    if result.n_rigid:
        rigid = result.modes.select(np.arange(result.n_rigid))
        motions = np.asarray(case.sensors.observe(rigid).mode_shapes, dtype=np.float64)
    else:
        motions = _geometric(case)
    sizes = np.linalg.norm(motions, axis=0)
    if not motions.size or not sizes.any():
        return np.zeros((case.sensors.n_sensors, 0))
    left, values, _ = np.linalg.svd(motions[:, sizes > 0.0] / sizes[sizes > 0.0], False)
    return np.asarray(left[:, values > SEPARATE * values[0]])


def _geometric(case: Case) -> Floats:
    sensors = case.sensors
    try:
        mesh = case.solver.deck.mesh()
    except ModelError:  # code that requires the mesh reports it
        mesh = None
    if mesh is None or not np.isin(sensors.model_nodes, mesh.nodes).all():
        return np.where(sensors.turns[:, None], 0.0, sensors.directions)
    ways = global_directions(sensors.model_nodes, sensors.directions, mesh)
    places = case.mapping.read_at(mesh)
    places = places - places.mean(axis=0)
    along = np.zeros((sensors.n_sensors, 6))
    for axis in range(3):
        components = np.full(sensors.n_sensors, axis + 1) + 3 * sensors.turns
        along += ways[:, [axis]] * rigid_body_shapes(places, components)
    return along
