"""The sensors of a pretest as a file of points, which a campaign reads as its test's geometry."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from modetune.adapters.test_files.geometry_csv import write_geometry_csv
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats
from modetune.flows.campaign.units import METRES, Units
from modetune.flows.studies.pretest.placement import PlacedSensor
from modetune.flows.studies.pretest.plan import Pretest


def check_out(path: Path, mesh: Mesh) -> None:
    """Raise CampaignError for another kind of file, or a model without places."""
    if path.suffix.lower() != ".csv":
        raise CampaignError(f"{path}: the sensor file is CSV; give a name that ends with .csv")
    if mesh.nodes.size == 0:
        raise CampaignError(
            f"{path}: the model has no places for sensors: it is matrices alone; leave --out away, "
            "the table names the degrees of freedom"
        )


def sensor_dofs(sensor: PlacedSensor) -> tuple[str, ...]:
    """How the rows of measured modes are to be named for a sensor: `node.component`."""
    if sensor.label == "normal":
        return (f"{sensor.node}.z",)
    return tuple(f"{sensor.node}.{axis}" for axis in sensor.label)


def write_sensor_file(path: Path, pretest: Pretest, units: Units) -> None:
    """Write one point a place, numbered as its node, and in comments what is measured there.

    A sensor along the normal is the local z of its point. Raises StorageUnavailable.
    """
    places = {item.node: item for item in pretest.sensors}
    found = list(places.values())
    comment = [
        f"modetune pretest of {pretest.name}: {len(pretest.sensors)} sensors at {len(found)} "
        "places",
        f"method {pretest.settings.method}, elastic modes "
        + ", ".join(map(str, pretest.mode_numbers)),
    ]
    comment += [
        f"sensor {number}: {' '.join(sensor_dofs(item))}"
        for number, item in enumerate(pretest.sensors, start=1)
    ]
    geometry = TestGeometry(
        nodes=np.array([item.node for item in found], dtype=np.int64),
        coordinates=np.array([item.place for item in found]),
        frames=np.array([_axes(item) for item in found]),
        metres=METRES[units],
    )
    write_geometry_csv(path, geometry, comment)


def _axes(sensor: PlacedSensor) -> Floats:
    """The point's own axes (3, 3), rows in global ones: z along a normal, else the global ones."""
    if sensor.label != "normal":
        return np.eye(3)
    z = np.array(sensor.frame[0])
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])
