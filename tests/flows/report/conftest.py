"""Records of a campaign that never ran: a plate whose modes are products of sines."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from modetune.core.correlation.correlation import mac
from modetune.core.correlation.pairing import Pairing
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.modes import Floats, Integers, MeasuredModes, ModeSet, mode_set
from modetune.core.parameters import Parameter, ParameterSet
from modetune.core.storage.campaign_record import (
    CampaignRecord,
    IterationRecord,
    RunCounts,
    SensorPlaces,
)
from modetune.core.surface import Surface
from modetune.core.updating.responses.response import residual_of
from tests.node_sensors import by_number

#: Half waves along x and y of the three modes.
WAVES = ((1, 1), (2, 1), (1, 2))
TEST_HZ = np.array([10.0, 22.0, 31.0])


def plate(n: int) -> Surface:
    """A plate of 2 x 1 from n by n nodes."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 2, n), np.linspace(0, 1, n)))
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)[None]).ravel()
    below = np.stack([corner, corner + 1, corner + n + 1], axis=1)
    above = np.stack([corner, corner + n + 1, corner + n], axis=1)
    edge = np.stack([np.arange(n - 1), np.arange(1, n)], axis=1)
    return Surface(
        nodes=np.arange(1, n * n + 1),
        coordinates=np.stack([x, y, np.zeros_like(x)], axis=1),
        triangles=np.concatenate([below, above]),
        edges=np.concatenate([edge, edge + n * (n - 1), edge * n, edge * n + n - 1]),
    )


def heights(coordinates: Floats) -> Floats:
    """Deflections (n, 3) of the three modes."""
    x, y = coordinates[:, 0], coordinates[:, 1]
    return np.stack([np.sin(a * np.pi * x / 2.0) * np.sin(b * np.pi * y) for a, b in WAVES], axis=1)


def field(surface: Surface, frequencies_hz: Floats) -> ModeSet:
    n = surface.nodes.size
    shapes = np.zeros((3 * n, 3))
    shapes[2::3] = heights(surface.coordinates)
    return mode_set(frequencies_hz, shapes, np.repeat(surface.nodes, 3), np.tile([1, 2, 3], n))


def iteration(
    number: int, off: float, shapes: Floats, test: ModeSet, nodes: Integers, bent: float
) -> IterationRecord:
    """All frequencies off by a share; shapes bent towards each other by a share."""
    computed = mode_set(
        TEST_HZ * (1.0 + off),
        shapes + bent * np.roll(shapes, 1, axis=1),
        nodes,
        np.full(nodes.size, 3),
        normalisation="mass",
    )
    values = np.diag(mac(test.mode_shapes, computed.mode_shapes))
    positions = np.arange(3)
    z = 1.0 - (1.0 + off) ** 2 * np.ones(3)
    return IterationRecord(
        number=number,
        parameters=np.array([1.0, 1.0 + 0.1 * number]),
        step=np.zeros(2),
        computed=computed,
        pairing=Pairing(positions, positions, values, values, ("highest MAC",) * 3),
        frequency_errors=np.full(3, off),
        residual=residual_of(
            "frequencies",
            [f"frequency of mode {number}" for number in (1, 2, 3)],
            None,
            z,
            np.ones(3),
            np.full(3, 1e-4),
        ),
        sensitivity=np.zeros((0, 2)) if number == 0 else np.array([[1.0, 0.5]] * 3),
        sensitivity_methods=() if number == 0 else ("strain_energy", "semi_analytic"),
        sensitivity_keys=() if number == 0 else ("ab" * 32,),
        sensitivity_age=0,
        sensitivity_skipped=number == 2,
        slope=np.nan if number == 0 else 0.1 / number,
        accepted=True,
        decision="initial model" if number == 0 else "",
        regularisation=1.0,
        condition=2.0,
        modal_key=f"{number}" * 64,
        runs=RunCounts(1, 2, 0, 30.0, 15.0),
        wall_s=1.5,
    )


def plate_record(n: int = 12) -> CampaignRecord:
    """Three modes off by 5 % at first and 0.1 % at last, on a plate of n by n nodes."""
    surface = plate(n)
    sensors = surface.nodes[:: max(1, surface.nodes.size // 40)]
    shapes = heights(surface.coordinates[sensors - 1])
    test = mode_set(TEST_HZ, shapes, sensors, np.full(sensors.size, 3), [0.01, 0.02, 0.01])
    items = [
        iteration(number, off, shapes, test, sensors, bent)
        for number, off, bent in ((0, 0.05, 0.3), (1, 0.01, 0.1), (2, 0.001, 0.01))
    ]
    items[0] = replace(items[0], field=field(surface, TEST_HZ * 1.05))
    items[2] = replace(items[2], field=field(surface, TEST_HZ * 1.001))
    seen = by_number(sensors, np.full(sensors.size, 3))
    return CampaignRecord(
        name="plate",
        campaign_text="name: plate\n",
        settings=("run.parallel=2",),
        modetune_version="0",
        solver="scripted",
        solver_version="1",
        parameters=ParameterSet(
            (
                Parameter("E", "youngs_modulus", "material", ("STEEL",), 0.5, 2.0, 0.2),
                Parameter("t", "thickness", "elset", ("SKIN", "RIB"), 0.5, 1.2, 0.1, item=2),
            )
        ),
        deck_values=np.array([210e3, 2.0]),
        test=MeasuredModes((1, 2, 5), test),
        iterations=tuple(items),
        status="converged",
        reason="e1 is met",
        updated=items[2].parameters,
        standard_errors=np.array([0.01, 0.02]),
        repeatability=np.array([0.008, 0.02]),
        correlation=np.array([[1.0, 0.3], [0.3, 1.0]]),
        runs=RunCounts(3, 6, 1, 90.0, 45.0),
        wall_s=4.5,
        surface=surface,
        geometry=TestGeometry(
            sensors,
            surface.coordinates[sensors - 1],
            np.tile(np.eye(3), (sensors.size, 1, 1)),
            np.stack([sensors[:-1], sensors[1:]], axis=1),
            np.zeros((0, 3), dtype=np.int64),
            1e-3,
        ),
        sensors=seen,
        places=SensorPlaces(surface.coordinates[sensors - 1], seen.directions),
        units="mm-t-s",
        e1_frequency=0.01,
        e1_mac=0.9,
        e2=0.06,
        versions=("Python 3", "numpy 1"),
        deck_digest="d" * 64,
    )


@pytest.fixture
def record() -> CampaignRecord:
    return plate_record()


@pytest.fixture
def record_of() -> Callable[[int], CampaignRecord]:
    return plate_record
