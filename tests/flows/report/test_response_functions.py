"""Response functions of the model beside measured ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from modetune.core.measurement.measurement import MeasuredFrfs
from modetune.core.measurement.response_functions import NormalModes, modal_frf
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.flows.report.page import page
from modetune.flows.report.response_functions import response_pairs


@pytest.fixture
def tested(record: CampaignRecord) -> CampaignRecord:
    """A test whose functions are those of the updated model itself, in SI; two of three known."""
    best, lines = record.best.computed, np.linspace(5.0, 40.0, 300)
    damping = record.test.modes.damping_ratios
    modes = NormalModes(best.eigenvalues, np.real(best.mode_shapes), damping)
    values = modal_frf(lines, modes, [17, 22], [22], "accelerance")[:, :, 0] / 1e3  # tonnes to kg
    nodes = np.array([best.nodes[17], best.nodes[22], 99_999])
    ones = np.ones(3)
    frfs = MeasuredFrfs(
        "accelerance",
        lines,
        np.column_stack([values, values[:, 0]]),
        nodes,
        np.full(3, 3),
        ones,
        np.full(3, best.nodes[22]),
        np.full(3, 3),
        ones,
        np.zeros((0, 0)),
    )
    return replace(record, frfs=frfs)


def test_the_model_that_was_measured_answers_itself(tested: CampaignRecord) -> None:
    driving, other = response_pairs(tested)  # the third has no sensor
    assert driving.title == f"{tested.best.computed.nodes[22]}.z for a force at " + (
        f"{tested.best.computed.nodes[22]}.z"
    )
    for pair in (driving, other):
        np.testing.assert_allclose(pair.after, pair.measured, rtol=1e-10)
        assert pair.fracs[1] == pytest.approx(1.0)
        assert pair.fracs[0] < 0.9  # 5 % off in frequency at 1 and 2 % damping


def test_a_sensor_that_looks_the_other_way_is_turned(tested: CampaignRecord) -> None:
    assert tested.frfs is not None
    turned = replace(tested.frfs, signs=-np.ones(3), values=-tested.frfs.values)
    (driving, _) = response_pairs(replace(tested, frfs=turned))
    np.testing.assert_allclose(driving.after, driving.measured, rtol=1e-10)


def test_the_page_shows_them_where_there_are_some(
    tested: CampaignRecord, record: CampaignRecord
) -> None:
    assert 'id="responses"' in page(tested)
    assert 'id="responses"' not in page(record)


def test_without_damping_or_modal_mass_there_are_none(tested: CampaignRecord) -> None:
    modes = replace(tested.test.modes, damping_ratios=np.zeros(0))
    assert response_pairs(replace(tested, test=replace(tested.test, modes=modes))) == ()
    items = tuple(
        replace(item, computed=replace(item.computed, normalisation="max"))
        for item in tested.iterations
    )
    assert response_pairs(replace(tested, iterations=items)) == ()
