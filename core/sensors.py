"""Which degrees of freedom of the model a test's sensors look at, and how the model is seen there.

A sensor measures motion along its direction d at a test point. On the model's side it is read at
the node next to that point, as d . u with u in the model's axes. Stacked over the sensors this is a
sparse matrix T (n_sensors, n_dof) that takes computed shapes, and derivatives of shapes, to what
the test would have measured; the test's own data are never turned.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers, ModeSet


@dataclass(frozen=True, slots=True)
class SensorMap:
    """The sensors of a test on the nodes of a model.

    nodes, components: (n_sensors,), as the test names them. model_nodes: (n_sensors,).
    directions: (n_sensors, 3), unit vectors in the axes in which the model's results stand at
    its node. turns: (n_sensors,), whether a rotation about the direction is measured.
    distances: (n_sensors,), from test point to node, the deck's length; 0 where given by number.
    """

    nodes: Integers
    components: Integers
    model_nodes: Integers
    directions: Floats
    turns: np.ndarray[tuple[int], np.dtype[np.bool_]]
    distances: Floats

    @property
    def n_sensors(self) -> int:
        return self.nodes.size

    def matrix(self, nodes: Integers, components: Integers) -> sparse.csr_array:
        """T (n_sensors, n_dof) for shapes whose rows are these nodes and components (1..6).

        A component the results lack is left out where its part of the direction is below 1e-6.
        Raises ModesError where a component that a sensor looks along is missing.
        """
        names = zip(nodes.tolist(), components.tolist(), strict=True)
        place = {dof: row for row, dof in enumerate(names)}
        rows, columns, values = [], [], []
        for sensor in range(self.n_sensors):
            for axis in range(3):
                part = float(self.directions[sensor, axis])
                dof = int(self.model_nodes[sensor]), axis + 1 + 3 * bool(self.turns[sensor])
                if dof in place:
                    rows.append(sensor)
                    columns.append(place[dof])
                    values.append(part)
                elif abs(part) > 1e-6:
                    raise ModesError(
                        f"the model's results have no component {dof[1]} at node {dof[0]}, along "
                        f"which the sensor at test point {self.nodes[sensor]} looks"
                    )
        return sparse.csr_array((values, (rows, columns)), shape=(self.n_sensors, nodes.size))

    def observe(self, modes: ModeSet) -> ModeSet:
        """Computed modes as the test's sensors see them, named by the test. Raises ModesError."""
        seen = self.matrix(modes.nodes, modes.components) @ modes.mode_shapes
        return replace(modes, mode_shapes=np.asarray(seen), nodes=self.nodes, components=self.components)


def by_number(nodes: Integers, components: Integers) -> SensorMap:
    """Sensors that are the model's own nodes, along its axes."""
    return SensorMap(
        nodes=nodes,
        components=components,
        model_nodes=nodes,
        directions=np.eye(3)[(components - 1) % 3],
        turns=components > 3,
        distances=np.zeros(nodes.size),
    )
