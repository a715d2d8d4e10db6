"""What of model and test a record keeps to be looked at: surface, sensor places, shapes on it."""

from __future__ import annotations

import numpy as np

from modetune.core.measurement.sensors import global_directions
from modetune.core.mesh import Mesh, global_shapes
from modetune.core.modes import ModeSet, mode_set
from modetune.core.storage.record import SensorPlaces
from modetune.core.surface import Surface
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import Case
from modetune.flows.updating.evaluation import Evaluation


def shown_surface(case: Case) -> Surface | None:
    """The model's surface, None where it has no places (matrices alone)."""
    return case.surface if case.surface.nodes.size else None


def sensor_places(case: Case) -> SensorPlaces | None:
    """Sensors on the model in global axes, None where the model has no places."""
    mesh, mapping = case.solver.deck.mesh(), case.mapping
    if mesh.nodes.size == 0 or mapping.sensors.n_sensors == 0:
        return None
    sensors, places = mapping.sensors, mapping.places[mapping.rows]
    at_nodes = mesh.coordinates[mesh.rows(sensors.model_nodes)]
    return SensorPlaces(
        coordinates=np.where(np.isfinite(places), places, at_nodes),
        directions=global_directions(sensors.model_nodes, sensors.directions, mesh),
    )


def shown_field(campaign: Campaign, evaluation: Evaluation) -> ModeSet:
    """The paired modes' translations at the nodes of the surface, in global axes."""
    case, part = campaign.only, evaluation.parts[0]
    if case is None or case.surface.nodes.size == 0:
        return mode_set([])
    surface, paired = case.surface, part.field.select(part.pairing.computed)
    frames = case.solver.deck.mesh().frames
    shown = set(surface.nodes.tolist())
    turned = {node: axes for node, axes in frames.items() if node in shown}
    shapes = global_shapes(Mesh(surface.nodes, surface.coordinates, (), turned), paired)
    return mode_set(
        paired.frequencies_hz,
        shapes.transpose(1, 2, 0).reshape(3 * surface.nodes.size, paired.n_modes),
        np.repeat(surface.nodes, 3),
        np.tile((1, 2, 3), surface.nodes.size),
    )
