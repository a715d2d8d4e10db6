"""Sensors that are the model's own nodes, along its axes."""

from __future__ import annotations

import numpy as np

from modetune.core.measurement.sensor_map import SensorMap
from modetune.core.modes import Integers


def by_number(nodes: Integers, components: Integers) -> SensorMap:
    """Sensors at nodes of these numbers, which are the test's too."""
    return SensorMap(
        nodes=nodes,
        components=components,
        model_nodes=nodes,
        directions=np.eye(3)[(components - 1) % 3],
        turns=components > 3,
        distances=np.zeros(nodes.size),
    )
