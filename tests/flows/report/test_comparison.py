"""What the report works out of a record, by closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from modetune.core.correlation.correlation import Shapes
from modetune.core.modes import common_dofs, mode_set
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.flows.report import comparison
from modetune.flows.report.comparison import (
    fresh_matrices,
    mac_table,
    remarks,
    scaled_test,
    sensor_agreement,
)
from modetune.flows.report.mode_tables import mode_rows
from modetune.flows.report.scene import scene


def test_modes_are_told_before_and_after(record: CampaignRecord) -> None:
    rows = mode_rows(record)
    assert [row.mode for row in rows] == [1, 2, 5]
    assert rows[0].initial_hz == pytest.approx(10.5)  # 10 Hz and 5 %
    assert rows[0].updated_hz == pytest.approx(10.01)  # 10 Hz and 0.1 %
    assert rows[0].mac_initial < rows[0].mac_updated


def test_the_mac_of_a_mode_at_rest_is_zero(record: CampaignRecord) -> None:
    item = record.iterations[0]
    still = item.computed.mode_shapes.copy()
    still[:, 1] = 0.0
    table = mac_table(record, replace(item, computed=replace(item.computed, mode_shapes=still)))
    assert table[1].tolist() == [0.0, 0.0, 0.0]
    assert table[0, 0] == pytest.approx(item.pairing.mac[0])


def test_a_sensor_that_is_wrong_in_one_mode_stands_out_in_the_comac(record: CampaignRecord) -> None:
    shapes = record.test.modes.mode_shapes.copy()
    shapes[17, 0] *= 5.0  # in one of three modes; COMAC knows no signs
    modes = replace(record.test.modes, mode_shapes=shapes)
    found = sensor_agreement(replace(record, test=replace(record.test, modes=modes)))
    assert found is not None
    assert int(np.argmin(found.after)) == 17
    assert found.labels[17].endswith(".z")


def test_normalised_sensitivities_follow_from_the_residuals(record: CampaignRecord) -> None:
    (first, matrix), (last, later) = fresh_matrices(record)
    assert (first, last) == (0, 1)
    # S = 1.0 and 0.5 of lambda_c / lambda_m; at 5 % too high a frequency and values of 1:
    # df/f / (dp/p) = S / 2 * (1 / 1.05)^2.
    np.testing.assert_allclose(matrix[0], [0.5 / 1.05**2, 0.25 / 1.05**2])
    # At iteration 1: 1 % too high, the second parameter at 1.1.
    np.testing.assert_allclose(later[0], [0.5 / 1.01**2, 1.1 * 0.25 / 1.01**2])


def test_shapes_of_test_and_model_have_one_scale_and_sign(record: CampaignRecord) -> None:
    item = record.best
    turned = replace(item.computed, mode_shapes=-3.0 * item.computed.mode_shapes)
    test, model = scaled_test(record, replace(item, computed=turned))
    np.testing.assert_allclose(np.linalg.norm(test, axis=0), 1.0)
    # The nearest multiple of the model to a unit shape is its projection: cos = sqrt(MAC) long.
    np.testing.assert_allclose(np.linalg.norm(model, axis=0), np.sqrt(item.pairing.mac))


def test_what_is_in_doubt_is_remarked(record: CampaignRecord) -> None:
    doubtful = replace(
        record,
        standard_errors=np.array([0.5, 0.01]),
        repeatability=np.array([0.5, 0.01]),
        correlation=np.array([[1, -0.99], [-0.99, 1]]),
    )
    said = " ".join(remarks(doubtful))
    assert "On a bound: t." in said  # 1.2 is its upper bound
    assert "E is uncertain by ±50 %" in said
    assert "E and t are correlated (-0.99)" in said
    assert "Mode" not in said


def test_a_mode_outside_the_tolerance_is_remarked(record: CampaignRecord) -> None:
    said = " ".join(remarks(replace(record, e1_frequency=1e-4)))
    assert "Mode 1 has a frequency error of +0.10 %, above the tolerance of 0.01 %." in said


def test_many_remarks_of_one_kind_are_one_sentence(
    record: CampaignRecord, monkeypatch: pytest.MonkeyPatch
) -> None:
    strict = replace(record, e1_frequency=1e-4)
    kind = "frequency error"
    apart = [remark for remark in remarks(strict) if kind in remark]
    assert len(apart) == 3
    monkeypatch.setattr(comparison, "MOST_ALIKE", 2)
    (joined,) = (remark for remark in remarks(strict) if kind in remark)
    assert joined.startswith("3 modes have a frequency error above the tolerance of 0.01 %: ")
    assert "1 (+0.10 %)" in joined


def test_model_and_test_move_together(record: CampaignRecord) -> None:
    shown = scene(record)
    assert shown is not None
    after = shown.states["after"]
    model, test = after.modes[0], shown.tests[0]
    assert after.pairs.tolist() == [[0, 0], [1, 1], [2, 2]]
    # The largest motion is one by definition, here that of a sensor: shapes are bent, not fields.
    assert max(np.abs(model.surface).max(), np.abs(model.points).max()) == pytest.approx(1.0)
    assert np.linalg.norm(test.points, axis=1).max() == pytest.approx(1.0)
    at = np.searchsorted(np.arange(1, model.surface.shape[0] + 1), shown.nodes)
    # The sensors are nodes of the surface, and the best shapes are bent by 1 % of another's.
    np.testing.assert_allclose(model.points, model.surface[at], atol=0.03)
    np.testing.assert_allclose(shown.points, shown.coordinates[at], atol=1e-6)
    np.testing.assert_allclose(np.diag(after.mac), record.best.pairing.mac)


def test_a_computed_mode_without_a_partner_is_seen_at_the_sensors(record: CampaignRecord) -> None:
    items = []
    for item in record.iterations:  # the test's second mode is not paired with the model's second
        first_and_last = np.array([0, 2])
        pairing = replace(
            item.pairing,
            measured=first_and_last,
            computed=first_and_last,
            mac=item.pairing.mac[first_and_last],
            subspace_mac=item.pairing.subspace_mac[first_and_last],
            reasons=("highest MAC",) * 2,
        )
        field = item.field
        if field.n_dof:
            field = mode_set(
                field.frequencies_hz[[0, 2]],
                field.mode_shapes[:, [0, 2]],
                field.nodes,
                field.components,
            )
        items.append(replace(item, pairing=pairing, field=field))
    shown = scene(replace(record, iterations=tuple(items)))
    assert shown is not None
    alone = shown.states["after"].modes[1]
    assert alone.surface.size == 0
    test = shown.tests[1].points[:, 2]
    cosine = alone.points[:, 2] @ test / np.linalg.norm(alone.points) / np.linalg.norm(test)
    assert cosine**2 == pytest.approx(record.best.pairing.mac[1])


def test_a_tilted_sensor_moves_its_point_along_its_direction(record: CampaignRecord) -> None:
    assert record.places is not None
    tilted = np.tile([0.6, 0.0, 0.8], (record.places.directions.shape[0], 1))
    shown = scene(replace(record, places=replace(record.places, directions=tilted)))
    assert shown is not None
    for moved in (shown.tests[0].points, shown.states["after"].modes[0].points):
        np.testing.assert_allclose(moved[:, 0] * 0.8, moved[:, 2] * 0.6)
        assert not moved[:, 1].any()


def test_frequencies_alone_keep_the_phase_of_before(record: CampaignRecord) -> None:
    test = replace(record.test, modes=mode_set(record.test.modes.frequencies_hz))
    last = record.best
    turned = replace(last, field=replace(last.field, mode_shapes=-last.field.mode_shapes))
    bare = replace(
        record, test=test, iterations=(*record.iterations[:-1], turned), sensors=None, places=None
    )
    assert common_dofs(test.modes, last.computed)[0].size == 0
    shown = scene(bare)
    assert shown is not None
    before, after = (shown.states[name].modes[0] for name in ("before", "after"))
    assert after.points.size == 0
    np.testing.assert_allclose(after.surface, before.surface, atol=1e-12)


def with_shapes(record: CampaignRecord, shapes: Shapes) -> CampaignRecord:
    modes = replace(record.test.modes, mode_shapes=shapes)
    return replace(record, test=replace(record.test, modes=modes))


def of_sensors(record: CampaignRecord) -> list[str]:
    return [line for line in remarks(record) if line.startswith("Sensor")]


def test_a_sensor_that_looks_the_other_way_is_named(record: CampaignRecord) -> None:
    shapes = record.test.modes.mode_shapes.copy()
    turned = int(np.argmax(np.abs(shapes).mean(axis=1)))
    shapes[turned] *= -1.0
    found = sensor_agreement(with_shapes(record, shapes))
    assert found is not None
    (said,) = of_sensors(with_shapes(record, shapes))
    assert said.startswith(f"Sensor {found.labels[turned]} (")
    assert said.endswith("of the others) moves opposite to the model: check its sign.")
    assert found.after[turned] > 0.99  # a sign alone does not show in the COMAC


def test_a_swapped_pair_of_sensors_is_named(record: CampaignRecord) -> None:
    shapes = record.test.modes.mode_shapes.copy()
    # The two whose motions over the modes are most unlike: as good as at right angles.
    lengths = np.linalg.norm(shapes, axis=1)
    used = np.flatnonzero(lengths > 0.5 * lengths.max())
    unit = shapes[used] / lengths[used, None]
    unlike = np.unravel_index(np.argmin(np.abs(unit @ unit.T)), (used.size, used.size))
    one, other = (int(used[place]) for place in unlike)
    shapes[[one, other]] = shapes[[other, one]]
    found = sensor_agreement(with_shapes(record, shapes))
    assert found is not None
    (said,) = of_sensors(with_shapes(record, shapes))
    names = " and ".join(found.labels[place] for place in sorted((one, other)))
    assert said.startswith(f"Sensors {names} fit the model better when exchanged (")
    assert said.endswith("): check their channels.")


def test_where_no_sensor_agrees_none_is_named(record: CampaignRecord) -> None:
    generator = np.random.default_rng(5)
    shapes = generator.standard_normal(record.test.modes.mode_shapes.shape)
    assert of_sensors(with_shapes(record, shapes)) == []
    assert of_sensors(record) == []


def test_a_mac_that_fell_is_remarked(record: CampaignRecord) -> None:
    first, last = record.iterations[0], record.best
    macs = first.pairing.mac - [0.04, 0.06, 0.0]  # the first falls by less than is remarked
    worse = replace(last, pairing=replace(last.pairing, mac=macs))
    said = " ".join(remarks(replace(record, iterations=(*record.iterations[:-1], worse))))
    assert "The MAC of mode 2 fell" in said
    assert "The MAC of mode 1 fell" not in said


def test_modes_are_called_by_their_configuration(record: CampaignRecord) -> None:
    test = replace(record.test, numbers=(1, 2, 3))
    joint = replace(record, test=test, configurations=("full", "full", "empty"))
    assert [row.label for row in mode_rows(joint)] == ["1 of full", "2 of full", "3 of empty"]
    said = " ".join(remarks(replace(joint, e1_frequency=1e-4)))
    assert "Mode 3 of empty has a frequency error of +0.10 %" in said
