"""Sensors of a test in terms of the equations of a model's matrices."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from scipy import sparse

from modetune.adapters.solver import Deck
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModelError
from modetune.core.measurement.sensors import SensorMap
from modetune.core.modes import dof_name
from modetune.core.updating.observation import sensor_observation


def observer(what: str, seen: SensorMap, deck: Deck) -> Callable[[MatrixResult], sparse.csr_array]:
    """Gives the sensors' rows (n_sensors, n_equations) for matrices; what: is compared there."""

    def observe(here: MatrixResult) -> sparse.csr_array:
        observed = sensor_observation(seen, partial(deck.observation, here))
        for row in np.flatnonzero(observed.unknown)[:1].tolist():
            dof = dof_name((int(seen.nodes[row]), int(seen.components[row])))
            raise ModelError(f"{what}: {dof} does not follow from the matrices' unknowns")
        return observed.matrix

    return observe


def nothing_seen(here: MatrixResult) -> sparse.csr_array:
    """No sensors."""
    return sparse.csr_array((0, here.nodes.size))
