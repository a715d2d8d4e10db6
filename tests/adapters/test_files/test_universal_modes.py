"""Modes of universal files: complex ones, parts of modes, references, what was not measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.test_files.universal.file import read_universal
from modetune.core.errors import CampaignError
from modetune.core.modes import ModeSet
from tests.adapters.test_files.universal_text import dataset, e13, mode_55, save

HZ = 2.0 * np.pi


def read(*paths: Path) -> tuple[ModeSet, tuple[int, ...], str]:
    measurement = read_universal(paths)[0]
    assert measurement.modes is not None
    return measurement.modes.modes, measurement.modes.numbers, "\n".join(measurement.notes)


def test_a_normal_mode_has_its_frequency_damping_and_mass(tmp_path: Path) -> None:
    values = {3: [1.0, 2.0, -3.0], 7: [0.5, 0.0, 1e-12]}
    path = save(tmp_path / "t.unv", mode_55(4, 12.5, values, damping=0.02, modal_mass=1.0))
    modes, numbers, _ = read(path)
    assert numbers == (4,)
    assert modes.frequencies_hz.tolist() == [12.5]
    assert modes.damping_ratios.tolist() == [0.02]
    assert modes.normalisation == "mass"
    dofs = list(zip(modes.nodes.tolist(), modes.components.tolist(), strict=True))
    assert dofs == [(3, 1), (3, 2), (3, 3), (7, 1), (7, 3)]
    assert modes.mode_shapes[:, 0].tolist() == [1.0, 2.0, -3.0, 0.5, 1e-12]


def test_half_the_loss_factor_is_the_damping_ratio(tmp_path: Path) -> None:
    modes, _, _ = read(save(tmp_path / "t.unv", mode_55(1, 5.0, {1: [1, 0, 0]}, hysteretic=0.06)))
    assert modes.damping_ratios[0] == pytest.approx(0.03)


def test_rotations_and_the_exponent_letter_d_are_read(tmp_path: Path) -> None:
    text = mode_55(1, 5.0, {1: [1.5, 2, 3, 4, 5, -6]}, letter="D")
    modes, _, _ = read(save(tmp_path / "t.unv", text))
    assert modes.components.tolist() == [1, 2, 3, 4, 5, 6]
    assert modes.mode_shapes[:, 0].tolist() == [1.5, 2, 3, 4, 5, -6]


def test_a_complex_mode_with_rotations_is_read(tmp_path: Path) -> None:
    shape = np.array([1.0, -2.0, 3.0, 0.5, -0.25, 2.0])
    turned = shape * np.exp(0.3j)
    pole = complex(-0.02 * HZ * 10, np.sqrt(1 - 0.02**2) * HZ * 10)
    path = save(
        tmp_path / "t.unv", mode_55(1, pole, {1: turned.tolist(), 5: (2 * turned).tolist()})
    )
    modes, _, notes = read(path)
    np.testing.assert_allclose(modes.mode_shapes[:6, 0], shape, rtol=2e-5)
    np.testing.assert_allclose(modes.mode_shapes[6:, 0], 2 * shape, rtol=2e-5)
    assert modes.frequencies_hz[0] == pytest.approx(10.0, rel=1e-5)
    assert modes.damping_ratios[0] == pytest.approx(0.02, rel=1e-5)
    assert "mode 1 1.000" in notes
    assert "doubtful" not in notes


def test_a_mode_far_from_real_is_named_as_doubtful(tmp_path: Path) -> None:
    shape = [1.0 + 0j, 0.9j, 0.5 - 0.5j]
    good = [1.0 + 0j, -2.0 + 0j, 0.5 + 0j]
    path = save(
        tmp_path / "t.unv",
        mode_55(1, complex(-1, 60), {1: good}),
        mode_55(2, complex(-1, 90), {1: shape}),
    )
    assert "doubtful: modes 2 are far from real" in read(path)[2]


def test_set_ups_of_roving_sensors_become_one_mode(tmp_path: Path) -> None:
    # one phase over both files: turned apart, the second set-up could change its sign
    shape = {node: np.array([0.1 * node, -node, 2.0]) * np.exp(1j) for node in range(1, 7)}
    pole = complex(-0.3, 50.0)
    first = save(tmp_path / "a.unv", mode_55(2, pole, {n: shape[n].tolist() for n in (1, 2, 3)}))
    second = save(tmp_path / "b.unv", mode_55(2, pole, {n: shape[n].tolist() for n in (4, 5, 6)}))
    modes, numbers, _ = read(first, second)
    assert numbers == (2,)
    assert np.unique(modes.nodes).tolist() == [1, 2, 3, 4, 5, 6]
    expected = np.concatenate([(shape[n] * np.exp(-1j)).real for n in range(1, 7)])
    np.testing.assert_allclose(modes.mode_shapes[:, 0], expected, rtol=2e-5)


def test_a_sensor_that_stays_while_others_rove_may_be_in_both_files(tmp_path: Path) -> None:
    first = save(tmp_path / "a.unv", mode_55(1, 9.0, {1: [1, 2, 3], 2: [4, 5, 6]}))
    second = save(tmp_path / "b.unv", mode_55(1, 9.0, {1: [1, 2, 3], 3: [7, 8, 9]}))
    modes, _, _ = read(first, second)
    assert modes.mode_shapes[:, 0].tolist() == [1, 2, 3, 4, 5, 6, 7, 8, 9]


def test_set_ups_that_are_scaled_differently_are_refused(tmp_path: Path) -> None:
    first = save(tmp_path / "a.unv", mode_55(1, 9.0, {1: [1, 2, 3], 2: [4, 5, 6]}))
    second = save(tmp_path / "b.unv", mode_55(1, 9.0, {1: [2, 4, 6], 3: [7, 8, 9]}))
    with pytest.raises(CampaignError, match=r"different values at node 1") as raised:
        read(first, second)
    assert f"{first}, line 2" in str(raised.value)
    assert f"{second}, line 2" in str(raised.value)


def test_files_of_different_tests_are_refused_with_both_places(tmp_path: Path) -> None:
    first = save(tmp_path / "a.unv", mode_55(1, 9.0, {1: [1, 2, 3]}))
    second = save(tmp_path / "b.unv", mode_55(1, 9.5, {2: [1, 2, 3]}))
    with pytest.raises(CampaignError, match=r"mode 1 at 9\.5 Hz.*at 9 Hz") as raised:
        read(first, second)
    assert f"{first}, line 2" in str(raised.value)


def test_of_several_references_the_strongest_is_taken_and_told(tmp_path: Path) -> None:
    path = save(
        tmp_path / "t.unv",
        mode_55(1, 9.00, {1: [1, 2, 3], 4: [0.5, 0.5, 0.5]}, damping=0.01),
        mode_55(1, 9.01, {4: [-1, -1, -1], 1: [-2, -4, -6]}, damping=0.02),
        mode_55(2, 20.0, {1: [1, 1, 1], 4: [1, 1, 1]}, damping=0.03),
    )
    modes, numbers, notes = read(path)
    assert numbers == (1, 2)
    assert modes.mode_shapes[:, 0].tolist() == [-2, -4, -6, -1, -1, -1]
    assert modes.frequencies_hz.tolist() == [9.01, 20.0]
    assert modes.damping_ratios.tolist() == [0.02, 0.03]
    assert "mode 1 is given 2 times" in notes


def test_set_ups_with_several_references_are_put_together_from_one(tmp_path: Path) -> None:
    # the second reference is the stronger one over all, the first one over nodes 3 and 4
    path = save(
        tmp_path / "t.unv",
        mode_55(1, 9.0, {1: [1, 1, 1], 2: [2, 2, 2]}),
        mode_55(1, 9.0, {1: [-7, -7, -7], 2: [-14, -14, -14]}),
        mode_55(1, 9.0, {3: [3, 3, 3], 4: [4, 4, 4]}),
        mode_55(1, 9.0, {3: [-2, -2, -2], 4: [-1, -1, -1]}),
    )
    modes, _, notes = read(path)
    assert modes.mode_shapes[::3, 0].tolist() == [-7, -14, -2, -1]
    assert "mode 1 is given 2 times" in notes


def test_one_sensor_that_was_turned_at_each_point_gives_all_components(tmp_path: Path) -> None:
    path = save(
        tmp_path / "t.unv",
        mode_55(1, 9.0, {1: [1, 0, 0], 2: [2, 0, 0]}),
        mode_55(1, 9.0, {1: [0, 3, 0], 2: [0, 4, 0]}),
    )
    modes, _, notes = read(path)
    assert modes.components.tolist() == [1, 2, 1, 2]
    assert modes.mode_shapes[:, 0].tolist() == [1, 3, 2, 4]
    assert "reference" not in notes


def test_references_that_only_some_set_ups_have_are_refused(tmp_path: Path) -> None:
    path = save(
        tmp_path / "t.unv",
        mode_55(1, 9.0, {1: [1, 1, 1]}),
        mode_55(1, 9.0, {1: [2, 2, 2]}),
        mode_55(1, 9.0, {3: [3, 3, 3]}),
    )
    with pytest.raises(CampaignError, match="keep the shapes of one reference"):
        read(path)


def test_modes_without_numbers_are_numbered_anew(tmp_path: Path) -> None:
    modes_of = [mode_55(0, hz, {1: [1, 2, 3 + hz]}) for hz in (5.0, 7.0, 8.0)]
    modes, numbers, notes = read(save(tmp_path / "t.unv", *modes_of))
    assert numbers == (1, 2, 3)
    assert modes.frequencies_hz.tolist() == [5.0, 7.0, 8.0]
    assert "renumbered" in notes


def test_one_number_for_two_modes_of_a_file_is_numbered_anew(tmp_path: Path) -> None:
    modes_of = [mode_55(1, hz, {1: [1, 2, 3]}) for hz in (5.0, 7.0)]
    assert read(save(tmp_path / "t.unv", *modes_of))[1] == (1, 2)


def test_what_was_not_measured_is_left_out_and_told(tmp_path: Path) -> None:
    path = save(
        tmp_path / "t.unv",
        mode_55(1, 5.0, {1: [0, 0, 1], 2: [0, 0, 0], 3: [1, 0, 2]}),
        mode_55(2, 7.0, {1: [0, 0, 2], 2: [0, 0, 0], 3: [0, 0, 1]}),
    )
    modes, _, notes = read(path)
    dofs = list(zip(modes.nodes.tolist(), modes.components.tolist(), strict=True))
    assert dofs == [(1, 3), (3, 1), (3, 3)]  # 3.x is zero in one mode only: measured
    assert modes.mode_shapes.tolist() == [[1, 2], [1, 0], [2, 1]]
    assert "nodes that move in no mode were not measured: 2" in notes
    assert "3 translations that are zero in all modes" in notes  # 1.x, 1.y and 3.y


def test_nodes_that_some_modes_lack_are_left_out(tmp_path: Path) -> None:
    path = save(
        tmp_path / "t.unv",
        mode_55(1, 5.0, {1: [1, 1, 1], 9: [1, 2, 3]}),
        mode_55(2, 7.0, {1: [1, 1, -1]}),
    )
    modes, _, notes = read(path)
    assert np.unique(modes.nodes).tolist() == [1]
    assert "nodes that some modes lack are left out: 9" in notes


def test_conjugates_statics_and_modes_at_zero_are_passed_over_with_their_line(
    tmp_path: Path,
) -> None:
    path = save(
        tmp_path / "t.unv",
        mode_55(1, complex(-1, 60), {1: [1 + 0j, 0j, 0j]}),
        mode_55(2, complex(-1, -60), {1: [1 + 0j, 0j, 0j]}),
        mode_55(3, 0.0, {1: [1, 0, 0]}),
        mode_55(4, 1.0, {1: [1, 0, 0]}, analysis=1),
    )
    _, numbers, notes = read(path)
    assert numbers == (1,)
    assert f"{path}, line 15 (dataset 55) is the conjugate of a mode" in notes
    assert "is of a mode at 0 Hz" in notes
    assert "holds no mode (its analysis type is 1)" in notes


def test_a_file_of_statics_alone_is_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "t.unv", mode_55(4, 1.0, {1: [1, 0, 0]}, analysis=1))
    with pytest.raises(CampaignError, match="holds nothing of a test") as raised:
        read_universal([path])
    assert "line 2 (dataset 55) holds no mode" in str(raised.value)


def test_a_mode_that_is_zero_everywhere_is_refused(tmp_path: Path) -> None:
    path = save(
        tmp_path / "t.unv", mode_55(1, 5.0, {1: [1, 0, 0]}), mode_55(2, 6.0, {1: [0, 0, 0]})
    )
    with pytest.raises(CampaignError, match=r"line 15 \(dataset 55\): mode 2 is zero"):
        read(path)


def test_missing_and_negative_dampings_are_told(tmp_path: Path) -> None:
    path = save(
        tmp_path / "t.unv",
        mode_55(1, 5.0, {1: [1, 0, 0]}, damping=0.01),
        mode_55(2, 6.0, {1: [1, 0, 0]}),
        mode_55(3, complex(1.0, 60.0), {1: [1 + 0j, 0j, 0j]}),
    )
    modes, _, notes = read(path)
    assert modes.damping_ratios[:2].tolist() == [0.01, 0.0]
    assert "modes without damping in the file get 0: 2" in notes
    assert "doubtful: modes with negative damping: 3" in notes


def analysis_data(location: int, record: list[str], values: list[str]) -> str:
    head = [f"{7:10d}", "a shape", f"{location:10d}", *["NONE"] * 5]
    return dataset(2414, *head, *record, *values)


def test_modes_of_dataset_2414_are_read(tmp_path: Path) -> None:
    record = [
        f"{1:10d}{2:10d}{3:10d}{8:10d}{2:10d}{6:10d}",
        "".join(f"{field:10d}" for field in (0, 0, 0, 0, 0, 3, 0, 0)),
        f"{0:10d}{0:10d}",
        e13([0.0, 31.5, 0.0, 1.0, 0.004, 0.0], "D"),
        e13([0.0] * 6),
    ]
    values = [f"{11:10d}", e13([1, 2, 3, 4, 5, 6]), f"{12:10d}", e13([-1, -2, -3, -4, -5, -6], "D")]
    modes, numbers, _ = read(save(tmp_path / "t.unv", analysis_data(1, record, values)))
    assert numbers == (3,)
    assert (modes.frequencies_hz[0], modes.damping_ratios[0]) == (31.5, 0.004)
    assert modes.mode_shapes[:, 0].tolist() == [1, 2, 3, 4, 5, 6, -1, -2, -3, -4, -5, -6]


def test_complex_modes_of_dataset_2414_over_two_rows_are_read(tmp_path: Path) -> None:
    record = [
        f"{1:10d}{3:10d}{3:10d}{8:10d}{5:10d}{6:10d}",
        "".join(f"{field:10d}" for field in (0, 0, 0, 0, 0, 1, 0, 0)),
        f"{0:10d}{0:10d}",
        e13([0.0] * 6),
        e13([-3.0, 4.0, 0.0, 0.0, 0.0, 0.0]),
    ]
    values = [f"{11:10d}", e13([1, 1, 2, 2, 3, 3]), e13([4, 4, 5, 5, -6, -6])]
    modes, _, _ = read(save(tmp_path / "t.unv", analysis_data(1, record, values)))
    assert modes.frequencies_hz[0] == pytest.approx(5.0 / HZ)  # |-3 + 4i| = 5
    assert modes.damping_ratios[0] == pytest.approx(0.6)
    np.testing.assert_allclose(
        modes.mode_shapes[:, 0], np.sqrt(2) * np.array([1, 2, 3, 4, 5, -6]), rtol=1e-12
    )


def test_data_on_elements_are_passed_over(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = analysis_data(5, [f"{1:10d}{2:10d}{3:10d}{8:10d}{2:10d}{3:10d}"] * 5, [])
    path = save(tmp_path / "t.unv", mode_55(1, 5.0, {1: [1, 0, 0]}), text)
    assert "holds data on elements or at points" in read(path)[2]
    assert capsys.readouterr().out == ""  # pyuff would print
