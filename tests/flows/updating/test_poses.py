"""Poses that places cannot tell apart: chosen by measured shapes, or refused with what helps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.core.errors import CampaignError
from modetune.core.measurement.registration import Alignment
from modetune.core.modes import MeasuredModes, mode_set
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.studies.sample.posterior import sample_campaign
from modetune.flows.studies.sample.request import SamplingRequest
from modetune.flows.studies.screen.request import ScreeningRequest
from modetune.flows.studies.screen.screening import screen_campaign
from modetune.flows.studies.validate.validation import leave_one_out
from modetune.flows.updating.forecast import Unwatched
from modetune.flows.updating.poses import by_shapes, settled
from modetune.flows.updating.update import update_from_starts
from tests.flows.conftest import recased

TRUTH = {"k1": 1.1, "k4": 0.9}
HERE = Alignment(1.0, np.eye(3), np.zeros(3))
#: The chain the other way round.
TURNED = Alignment(1.0, np.diag([-1.0, -1.0, 1.0]), np.array([5.0, 0.0, 0.0]))


def of_two_poses(bench: Any, taken: str, other: str) -> Campaign:
    """A campaign whose sensors stand as the chain does ("straight"), or the other way round."""
    campaign: Campaign = bench.campaign(TRUTH, shapes=True)
    straight = replace(campaign.case.mapping, alignment=HERE)
    sensors = straight.sensors
    back = replace(sensors, model_nodes=sensors.model_nodes[::-1].copy())
    poses = {"straight": straight, "back": replace(straight, sensors=back, alignment=TURNED)}
    return recased(campaign, mapping=replace(poses[taken], others=(poses[other],)))


@pytest.mark.parametrize(("taken", "other"), [("straight", "back"), ("back", "straight")])
def test_measured_shapes_choose_the_pose(bench: Any, taken: str, other: str) -> None:
    found = settled(of_two_poses(bench, taken, other))
    # The springs of the chain are not symmetric; its own sensors are nodes in ascending order.
    assert (np.diff(found.case.sensors.model_nodes) > 0).all()
    assert found.case.mapping.uncertain == ()
    assert bench.runs() == 1


def test_poses_that_shapes_cannot_tell_apart_stop_the_update(bench: Any, tmp_path: Path) -> None:
    campaign = of_two_poses(bench, "straight", "straight")
    with pytest.raises(CampaignError) as raised:
        update_from_starts(campaign, tmp_path / "run", Unwatched())
    assert raised.value.exit_code == 2
    assert "measured shapes cannot distinguish its poses" in str(raised.value)
    assert "with `align: fit`" in str(raised.value)
    assert bench.runs() == 1


def test_an_alignment_in_doubt_stops_the_update_before_any_run(bench: Any, tmp_path: Path) -> None:
    campaign = bench.campaign(TRUTH, shapes=True)
    doubted = recased(campaign, mapping=replace(campaign.case.mapping, doubts=("points slide",)))
    with pytest.raises(CampaignError, match=r"uncertain: points slide.*landmarks in `match`"):
        update_from_starts(doubted, tmp_path / "run", Unwatched())
    assert bench.runs() == 0


SAMPLING = SamplingRequest(None, None, 2000, 1, None)
SCREENING = ScreeningRequest("morris", None, 1, 4, False)


@pytest.mark.parametrize(
    "study",
    [
        lambda campaign: screen_campaign(campaign, SCREENING, Unwatched().working),
        lambda campaign: sample_campaign(campaign, SAMPLING, Unwatched().working),
        lambda campaign: leave_one_out(campaign, print),
    ],
    ids=["screen", "sample", "validate"],
)
def test_an_alignment_in_doubt_stops_each_study_before_any_run(bench: Any, study: Any) -> None:
    campaign = bench.campaign(TRUTH, shapes=True)
    doubted = recased(campaign, mapping=replace(campaign.case.mapping, doubts=("points slide",)))
    with pytest.raises(CampaignError, match=r"uncertain: points slide.*landmarks") as raised:
        study(doubted)
    assert raised.value.exit_code == 2
    assert bench.runs() == 0


def test_a_certain_alignment_costs_nothing(bench: Any) -> None:
    campaign = bench.campaign(TRUTH, shapes=True)
    assert settled(campaign).cases == campaign.cases
    assert bench.runs() == 0


def test_a_ring_of_alike_masses_has_no_pose_of_its_own_wherever_its_repeated_modes_stand(
    bench: Any,
) -> None:
    """Turned by one mass a ring is itself; its modes of one nodal diameter span the same space.

    The computed ones stand as the measured ones do in one pose, at 60 degrees to them in the other:
    single MAC of 1 and cos^2 60 = 0.25, which says nothing of the test.
    """
    angles = np.pi / 3.0 * np.arange(6)
    shapes = np.column_stack([np.cos(angles), np.sin(angles), (-1.0) ** np.arange(6)])
    measured = shapes[:, [0, 2]]
    hz, nodes = np.array([10.0, 10.0, 25.0]), np.arange(1, 7)
    test = MeasuredModes((1, 2), mode_set(hz[[0, 2]], measured, nodes, np.ones(6, int)))
    campaign: Campaign = bench.campaign(TRUTH, modes=(1, 2), shapes=True)
    straight = replace(campaign.case.mapping, alignment=HERE)
    rolled = replace(straight.sensors, model_nodes=np.roll(straight.sensors.model_nodes, 1))
    turned = replace(straight, sensors=rolled, alignment=TURNED)
    case = recased(campaign, test=test, mapping=replace(straight, others=(turned,))).case
    ring = ModalResult.of_shapes((2.0 * np.pi * hz) ** 2, shapes, nodes, np.ones(6, int), hz, 0)
    found, said = by_shapes(case, ring)
    assert found.mapping.uncertain
    assert said.startswith("measured shapes cannot distinguish its poses")
    assert said.count("mean MAC 1.000") == 2
