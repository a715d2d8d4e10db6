"""Pairs by hand, modes that the model has not, and pairs that an update does not begin with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import modetune
from modetune.core.correlation.pairing import LostMode, NotAmongComputed, UncertainPairs
from modetune.core.errors import CampaignError, ModesError

#: Oscillators that share nothing: the fifth stands for a mode in the plane, which the test finds
#: at 60.7 Hz, below the fourth.
MODEL_HZ = np.array([10.0, 20.0, 40.0, 81.3, 107.5])
TEST_HZ = [10.0, 20.0, 40.0, 60.7, 81.3]
NAMES = [f"{place}.z" for place in range(1, 6)]


def campaign(
    folder: Path, test: dict[str, Any], bounds: list[float], e1: float = 0.01
) -> modetune.Campaign:
    stiffness = np.diag((2.0 * np.pi * MODEL_HZ) ** 2)
    bend, plane = np.diag([1.0, 1.0, 1.0, 1.0, 0.0]), np.diag([0.0, 0.0, 0.0, 0.0, 1.0])
    parts = {"bend": stiffness * bend, "plane": stiffness * plane}
    return modetune.load(
        {
            "name": "wing",
            "model": {
                "stiffness": stiffness,
                "mass": np.eye(5),
                "parts": {name: {"stiffness": part} for name, part in parts.items()},
                "dofs": NAMES,
                "units": "m-kg-s",
            },
            "test": test,
            "parameters": [
                {"name": name, "quantity": "matrix_factor", "part": name, "bounds": bounds}
                for name in parts
            ],
            "update": {"e1": {"frequency": e1}},
            "report": {"page": False},
            "run": {"parallel": 1},
            "store": str(folder / "store"),
        },
        folder=folder / "campaign",
    )


def test_pairs_by_the_order_of_frequencies_alone_stop_where_a_neighbour_is_far_nearer(
    tmp_path: Path,
) -> None:
    wing = campaign(tmp_path, {"frequencies_hz": TEST_HZ}, [0.2, 2.0])
    doubts = [item for item in modetune.check(wing).findings if item.level == "doubtful"]
    assert ["test mode 5"] == [item.where for item in doubts if item.subject == "pairing"]
    with pytest.raises(UncertainPairs, match=r"elastic mode 4 at 81.3 Hz is far nearer") as error:
        modetune.update(wing, tmp_path / "runs")
    assert "`test.pairs: {5: 5}` confirms them" in str(error.value)
    assert error.value.exit_code == 2


def test_named_pairs_end_at_the_truth(tmp_path: Path) -> None:
    test = {"frequencies_hz": TEST_HZ, "pairs": {4: 5}}
    run = modetune.update(campaign(tmp_path, test, [0.2, 2.0], 1e-6), tmp_path / "runs")
    # The plane's stiffness goes with the square of its frequency.
    np.testing.assert_allclose(run.record.updated, [1.0, (60.7 / 107.5) ** 2], rtol=1e-4)
    assert run.record.iterations[0].pairing.computed.tolist() == [0, 1, 2, 4, 3]
    assert run.record.best.pairing.computed.tolist() == [0, 1, 2, 3, 4]  # followed by its shape


def test_a_mode_out_of_reach_is_told_and_carries_no_response(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    test = {"frequencies_hz": TEST_HZ, "unmatched": "drop"}
    wing = campaign(tmp_path, test, [0.8, 1.25])
    run = modetune.update(wing, tmp_path / "runs")
    assert "mode 4 at 60.7 Hz has no partner" in caplog.text
    assert run.record.iterations[0].pairing.measured.tolist() == [0, 1, 2, 4]
    assert run.record.best.residual.values.size == 4
    assert [row["mode"] for row in run.summary["modes"]] == [1, 2, 3, 5]
    assert run.summary["unmatched"] == [4]


def shaped(extra: bool) -> dict[str, Any]:
    """The model's own modes 1-3, stiffer, and one that it has not."""
    shapes = np.eye(5)[:, :3]
    if not extra:
        return {"frequencies_hz": 1.05 * MODEL_HZ[:3], "mode_shapes": shapes, "dofs": NAMES}
    strange = np.array([1.0, -1.0, 1.0, -1.0, 1.0]) / np.sqrt(5.0)
    return {
        "frequencies_hz": [*1.05 * MODEL_HZ[:3], 30.0],
        "mode_shapes": np.column_stack([shapes, strange]),
        "dofs": NAMES,
    }


def test_a_mode_that_the_model_has_not_stops_the_run_after_one_solution_and_says_what_helps(
    tmp_path: Path,
) -> None:
    wing = campaign(tmp_path, shaped(extra=True), [0.5, 2.0])
    with pytest.raises(LostMode, match="the measured mode at 30 Hz") as error:
        modetune.update(wing, tmp_path / "runs")
    assert "`test.unmatched: drop`" in str(error.value)
    assert "`test.pairs`" in str(error.value)


def test_without_the_mode_that_the_model_has_not_the_others_are_updated(tmp_path: Path) -> None:
    test = {**shaped(extra=True), "unmatched": "drop"}
    told = modetune.update(campaign(tmp_path, test, [0.5, 2.0]), tmp_path / "runs")
    plain = modetune.update(
        campaign(tmp_path / "plain", shaped(extra=False), [0.5, 2.0]), tmp_path / "plain"
    )
    np.testing.assert_array_equal(told.record.updated, plain.record.updated)
    assert told.summary["unmatched"] == [4]
    assert plain.summary["unmatched"] == []


def test_a_test_of_which_no_mode_has_a_partner_is_refused(tmp_path: Path) -> None:
    strange = np.array([[1.0, -1.0, 1.0, -1.0, 1.0], [1.0, 1.0, -1.0, -1.0, 1.0]]).T
    test = {"frequencies_hz": [30.0, 34.0], "mode_shapes": strange, "dofs": NAMES}
    wing = campaign(tmp_path, {**test, "unmatched": "drop"}, [0.5, 2.0])
    with pytest.raises(ModesError, match=r"no measured mode has a partner .* nodes and directions"):
        modetune.update(wing, tmp_path / "runs")


@pytest.mark.parametrize(
    ("pairs", "said"),
    [
        (
            {7: 1},
            r"line \d+: `pairs` names test mode 7, which is not in the test; the nearest .* 5",
        ),
        ({4: 5, 5: 5}, r"line \d+: `pairs` gives test modes 4 and 5 the same elastic mode 5"),
        ({4: 0}, r"line \d+: test.pairs.4: Input should be greater than or equal to 1; found 0"),
        ({"four": 1}, r"line \d+: test.pairs.four.*valid integer"),
    ],
)
def test_pairs_that_cannot_be_are_refused_with_their_line(
    tmp_path: Path, pairs: dict[Any, int], said: str
) -> None:
    with pytest.raises(CampaignError, match=said):
        campaign(tmp_path, {"frequencies_hz": TEST_HZ, "pairs": pairs}, [0.5, 2.0])


def test_a_pair_of_a_mode_that_is_not_used_is_refused(tmp_path: Path) -> None:
    test = {"frequencies_hz": TEST_HZ, "use": [1, 2, 3], "pairs": {4: 4}}
    with pytest.raises(CampaignError, match=r"the campaign does not use; the nearest .* is 3"):
        campaign(tmp_path, test, [0.5, 2.0])


def test_a_pair_with_a_mode_that_is_not_computed_is_refused_with_the_nearest(
    tmp_path: Path,
) -> None:
    test = {"frequencies_hz": TEST_HZ, "pairs": {5: 12}}
    with pytest.raises(NotAmongComputed, match=r"elastic mode 4 at 81.3 Hz") as error:
        modetune.update(campaign(tmp_path, test, [0.5, 2.0]), tmp_path / "runs")
    assert error.value.exit_code == 2
