"""Weights and deviations of a campaign file: what they come to, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from modetune.core.errors import CampaignError
from modetune.flows.campaign.campaign import load_campaign
from tests.flows.campaign.test_campaign import DECK, GOOD

SHAPES = """\
mode,1,2,4
frequency_hz,10,20,30
2.x,1,0.5,0
2.z,0,1,1
7.x,1,-1,1
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "bar.inp").write_text(DECK)
    (tmp_path / "measured.csv").write_text(SHAPES)
    return tmp_path


def loaded(folder: Path, residuals: str, *settings: str):  # type: ignore[no-untyped-def]
    (folder / "campaign.yaml").write_text(f"{GOOD}residuals:\n{residuals}")
    return load_campaign(folder / "campaign.yaml", list(settings))


def problems(folder: Path, residuals: str, *settings: str) -> str:
    with pytest.raises(CampaignError) as caught:
        loaded(folder, residuals, *settings)
    return str(caught.value)


def test_one_value_goes_for_all_modes(folder: Path) -> None:
    found = loaded(folder, "  {frequency_weight: 2, shape_deviation: 0.1}\n").case.weighting
    assert found.frequency_weights.tolist() == [2.0, 2.0, 2.0]
    assert found.frequency_deviations.tolist() == [0.002] * 3
    assert found.shape_deviations.tolist() == [0.1] * 3
    assert found.shape_weights.tolist() == [1.0] * 3  # as the test measured shapes


@pytest.mark.parametrize(
    ("residuals", "settings"),
    [
        ("  {shape_weight: 0}\n", []),
        ("  {mac: {}}\n", []),  # compares the shapes
        ("  {}\n", ["update.step=pseudo_inverse"]),  # knows no deviations
        ("  {}\n", ["sensitivity.method=strain_energy"]),  # gives no derivatives of shapes
    ],
)
def test_shapes_are_left_out_where_asked_or_where_something_else_excludes_them(
    folder: Path, residuals: str, settings: list[str]
) -> None:
    weighting = loaded(folder, residuals, *settings).case.weighting
    assert not weighting.with_shapes
    assert weighting.frequency_weights.tolist() == [1.0] * 3


def test_values_go_by_the_tests_numbers_and_the_others_have_theirs(folder: Path) -> None:
    text = """\
  frequency_weight: {1: 10, 4: 0, others: 2}
  shape_weight: {2: 0.5}
  frequency_deviation: {4: 0.01}
"""
    found = loaded(folder, text).case.weighting
    assert found.frequency_weights.tolist() == [10.0, 2.0, 0.0]
    assert found.shape_weights.tolist() == [1.0, 0.5, 1.0]  # the others as by default
    assert found.frequency_deviations.tolist() == [0.002, 0.002, 0.01]
    by_setting = loaded(folder, text, "residuals.frequency_weight.1=3").case.weighting
    assert by_setting.frequency_weights.tolist() == [3.0, 2.0, 0.0]


def test_values_follow_the_modes_that_are_used(folder: Path) -> None:
    text = "  {frequency_weight: {4: 7}, frequency_deviation: {1: 0.05}}\n"
    case = loaded(folder, text, "test.use=[4, 2]", "test.hold_out=[1]").case
    assert case.weighting.frequency_weights.tolist() == [7.0, 1.0]
    assert case.held_out_deviations.tolist() == [0.05]


def test_sensors_go_by_name_or_by_point_and_those_of_no_weight_are_left_out(folder: Path) -> None:
    text = """\
  shape_weight: 1
  sensor_weight: {2: 0.5, 2.z: 3, 7.x: 0}
  sensor_deviation: {2.x: 4}
"""
    case = loaded(folder, text).case
    assert case.test.modes.nodes.tolist() == [2, 2]
    assert case.weighting.sensor_weights.tolist() == [0.5, 3.0]
    assert case.weighting.sensor_deviations.tolist() == [4.0, 1.0]
    assert case.sensors.nodes.tolist() == [2, 2]


@pytest.mark.parametrize(
    ("residuals", "line", "said"),
    [
        ("  frequency_weight: {1: 2,\n    9: 1}\n", 11, "no mode 9; the nearest is 4 (it has 1, 2"),
        ("  shape_deviation: {3: 0.1}\n", 10, "the test has no mode 3; the nearest is 2"),
        ("  frequency_weight: {other: 1}\n", 10, "'other' is neither the number of a mode"),
        ("  frequency_weight: {yes: 1}\n", 10, "'True' is neither the number of a mode"),
        ("  frequency_weight:\n    2: -1\n", 11, "greater than or equal to 0; found -1"),
        ("  frequency_deviation:\n    2: 0\n", 11, "greater than 0; found 0"),
        ("  frequency_deviation: 0\n", 10, "greater than 0; found 0"),
        ("  shape_deviation: {2: .nan}\n", 10, "finite number; found nan"),
        ("  shape_weight: 1\n  sensor_weight: {7.z: 2}\n", 11, "no sensor 7.z; did you mean 7.x?"),
        ("  shape_weight: 1\n  sensor_weight: {22: 2}\n", 11, "no sensor 22 (there are 2.x"),
        ("  shape_weight: 1\n  sensor_deviation:\n    2.x: 0\n", 12, "greater than 0; found 0"),
        ("  shape_weight: 1\n  sensor_weight: {2: 0, 7: 0}\n", 11, "leaves out every sensor"),
        (
            "  shape_weight: 0\n  sensor_weight: {2.x: 2}\n",
            11,
            "has a weight, but no shapes are compared",
        ),
        ("  frequency_weight: 0\n", 9, "all weights are 0"),
        ("  frequency_weight: {others: 0}\n", 9, "all weights are 0"),
    ],
)
def test_bad_weights_are_refused_with_their_line(
    folder: Path, residuals: str, line: int, said: str
) -> None:
    found = problems(folder, residuals)
    assert f"campaign.yaml, line {line}: residuals" in found
    assert said in found


def test_values_of_modes_that_are_not_used_are_refused(folder: Path) -> None:
    found = problems(folder, "  shape_deviation: {2: 0.1}\n", "test.use=[1, 4]")
    assert "mode 2 is not used, so this has no effect" in found


def test_steps_that_know_no_weights_refuse_them(folder: Path) -> None:
    text = "  frequency_weight: {1: 10}\n"
    found = problems(folder, text, "update.step=pseudo_inverse")
    assert "`step: pseudo_inverse` ignores weights other than 0" in found
    kept = loaded(folder, "  frequency_weight: {1: 0}\n", "update.step=pseudo_inverse")
    assert kept.case.weighting.frequency_weights.tolist() == [0.0, 1.0, 1.0]


def test_sensors_of_a_test_without_shapes_are_refused(folder: Path) -> None:
    (folder / "measured.csv").write_text("mode,1,2\nfrequency_hz,10,20\n")
    found = problems(folder, "  sensor_deviation: {2.x: 2}\n")
    assert "the test has only frequencies, no sensors" in found


TOLD = SHAPES.replace("2.x", "frequency_deviation,0.001,0.004,0.01\n2.x", 1)


def test_what_the_campaign_leaves_open_the_test_file_tells(folder: Path) -> None:
    (folder / "measured.csv").write_text(TOLD)
    told = loaded(folder, "  {shape_weight: 1}\n").case.weighting
    assert told.frequency_deviations.tolist() == [0.001, 0.004, 0.01]
    assert told.shape_deviations.tolist() == [0.05, 0.05, 0.05]  # of which the file says nothing
    one = loaded(folder, "  {frequency_deviation: {2: 0.1}}\n").case.weighting
    assert one.frequency_deviations.tolist() == [0.001, 0.1, 0.01]
    all_of_them = loaded(folder, "  {frequency_deviation: 0.03}\n").case.weighting
    assert all_of_them.frequency_deviations.tolist() == [0.03] * 3


def test_repeated_tests_tell_mean_and_deviations(folder: Path) -> None:
    for name, factor in (("b", 1.002), ("c", 0.998)):
        text = SHAPES.replace("10,20,30", ",".join(str(factor * hz) for hz in (10, 20, 30)))
        (folder / f"{name}.csv").write_text(text.replace("7.x,1,-1", f"7.x,{factor},-1.1"))
    case = loaded(folder, "  {shape_weight: 1}\n", "test.repeats=[b.csv, c.csv]").case
    assert case.test.modes.frequencies_hz == pytest.approx([10.0, 20.0, 30.0])
    # s = 0.002 of all modes, over the root of three tests
    assert case.weighting.frequency_deviations == pytest.approx(0.002 / 3**0.5)
    assert (case.weighting.shape_deviations > 0.0).all()


def test_files_that_do_not_repeat_the_test_are_refused(folder: Path) -> None:
    (folder / "b.csv").write_text(SHAPES.replace("30", "45"))
    found = problems(folder, "  {shape_weight: 1}\n", "test.repeats=[b.csv, nowhere.csv]")
    assert "b.csv does not repeat the test: mode 4 at 45 Hz, and at 30 Hz in the first" in found
    assert "nowhere.csv cannot be read" in found
    (folder / "measured.csv").write_text(TOLD)
    found = problems(folder, "  {shape_weight: 1}\n", "test.repeats=[b.csv]")
    assert "but the test has its own" in found


@pytest.mark.parametrize("value", ["0", "-0.1"])
def test_deviations_of_the_file_are_above_zero(folder: Path, value: str) -> None:
    (folder / "measured.csv").write_text(TOLD.replace("0.004", value))
    found = problems(folder, "  {shape_weight: 1}\n")
    assert f"measured.csv, line 3: `frequency_deviation` must be above zero, found {value}" in found
