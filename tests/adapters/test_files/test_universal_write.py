"""Universal files written and read back: the same within the format's digits."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings

from modetune.adapters.test_files.measurements import read_measurement
from modetune.adapters.test_files.universal.datasets import Function
from modetune.adapters.test_files.universal.file import read_universal, write_universal
from modetune.core.errors import ModesError, StorageUnavailable
from modetune.core.measurement.measurement import Measurement
from tests.adapters.test_files.measured_tests import Wanted, made, wanted_tests

#: Of numbers printed with six digits.
DIGITS = 5.1e-6


@settings(max_examples=60)
@given(wanted_tests)
def test_what_is_written_is_read_back(tmp_path: Path, wanted: Wanted) -> None:
    test, path = made(wanted), tmp_path / "t.unv"
    write_universal(path, test)
    found = read_measurement([path])
    same_modes(test, found)
    same_points(test, found)
    same_functions(test, found)


def same_modes(test: Measurement, found: Measurement) -> None:
    if test.modes is None:
        assert found.modes is None
        return
    assert found.modes is not None
    assert found.modes.numbers == test.modes.numbers
    mine, theirs = test.modes.modes, found.modes.modes
    np.testing.assert_array_equal(theirs.nodes, mine.nodes)
    np.testing.assert_array_equal(theirs.components, mine.components)
    for name in ("frequencies_hz", "mode_shapes", "damping_ratios"):
        np.testing.assert_allclose(getattr(theirs, name), getattr(mine, name), rtol=DIGITS)


def same_points(test: Measurement, found: Measurement) -> None:
    if test.geometry is None:
        assert found.geometry is None
        return
    mine, theirs = test.geometry, found.geometry
    assert theirs is not None
    for name in ("nodes", "coordinates", "lines", "faces"):
        np.testing.assert_array_equal(getattr(theirs, name), getattr(mine, name))
    np.testing.assert_allclose(theirs.frames, mine.frames, atol=1e-14)
    assert theirs.metres == pytest.approx(mine.metres, rel=1e-14, nan_ok=True)


def same_functions(test: Measurement, found: Measurement) -> None:
    if test.frfs is None:
        assert found.frfs is None
        return
    mine, theirs = test.frfs, found.frfs
    assert theirs is not None
    assert theirs.kind == mine.kind
    np.testing.assert_allclose(theirs.frequencies_hz, mine.frequencies_hz, rtol=DIGITS)
    for name in ("values", "coherences"):
        np.testing.assert_allclose(getattr(theirs, name), getattr(mine, name), rtol=1e-10)
    for name in ("nodes", "components", "signs"):
        np.testing.assert_array_equal(getattr(theirs, name), getattr(mine, name))
        name = f"reference_{name}"
        np.testing.assert_array_equal(getattr(theirs, name), getattr(mine, name))


def test_unit_modal_mass_is_written_and_read_back(tmp_path: Path) -> None:
    test = made(Wanted(1, parts=(True, False, False)))
    assert test.modes is not None
    scaled = replace(test.modes, modes=replace(test.modes.modes, normalisation="mass"))
    write_universal(tmp_path / "t.unv", replace(test, modes=scaled))
    found = read_measurement([tmp_path / "t.unv"]).modes
    assert found is not None
    assert found.modes.normalisation == "mass"


def test_the_same_test_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.unv", "b.unv"):
        write_universal(tmp_path / name, made(Wanted(2)))
    assert (tmp_path / "a.unv").read_bytes() == (tmp_path / "b.unv").read_bytes()


def test_many_lines_go_into_several_traces(tmp_path: Path) -> None:
    test = made(Wanted(3, n_nodes=300, parts=(False, True, False)))
    assert test.geometry is not None
    write_universal(tmp_path / "t.unv", test)
    measurement, files = read_universal([tmp_path / "t.unv"])
    assert files[0].datasets.count("82") == 4  # 299 lines, 83 in a trace of 250 numbers
    same_points(test, measurement)


def test_a_fine_uneven_grid_is_refused_rather_than_rounded(tmp_path: Path) -> None:
    test = made(Wanted(4, parts=(False, False, True)))
    assert test.frfs is not None
    grid = 1000.0 + 1e-4 * np.array([0, 1, 3, 4, 7, 8, 9])
    with pytest.raises(ModesError, match="write HDF5 instead"):
        write_universal(
            tmp_path / "t.unv", replace(test, frfs=replace(test.frfs, frequencies_hz=grid))
        )
    assert list(tmp_path.iterdir()) == []


def test_an_even_grid_with_an_endless_step_stays_even(tmp_path: Path) -> None:
    test = made(Wanted(4, parts=(False, False, True)))
    assert test.frfs is not None
    grid = 1.0 / 3.0 * np.arange(1, 8)
    write_universal(tmp_path / "t.unv", replace(test, frfs=replace(test.frfs, frequencies_hz=grid)))
    found = read_measurement([tmp_path / "t.unv"]).frfs
    assert found is not None
    np.testing.assert_allclose(found.frequencies_hz, grid, rtol=2e-6)
    np.testing.assert_allclose(np.diff(found.frequencies_hz), 0.333333, rtol=1e-9)


def test_what_the_format_cannot_hold_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "t.unv"
    with pytest.raises(ModesError, match="nothing to write"):
        write_universal(path, Measurement())
    test = made(Wanted(5, parts=(True, False, False)))
    assert test.modes is not None
    for shapes, message in (
        (replace(test.modes.modes, nodes=test.modes.modes.nodes + 10**10), "numbered 1 to"),
        (replace(test.modes.modes, mode_shapes=1j * test.modes.modes.mode_shapes), "real ones"),
        (test.modes.modes.rows([]), "without shapes"),
    ):
        with pytest.raises(ModesError, match=message):
            write_universal(path, replace(test, modes=replace(test.modes, modes=shapes)))
    assert not path.exists()


def test_a_place_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises((StorageUnavailable, FileExistsError)):
        write_universal(tmp_path / "file" / "t.unv", made(Wanted(6)))


def test_metres_that_are_not_known_are_not_written(tmp_path: Path) -> None:
    write_universal(tmp_path / "t.unv", made(Wanted(7, metres=math.nan)))
    assert "164" not in read_universal([tmp_path / "t.unv"])[1][0].datasets


@pytest.mark.parametrize("metres", [0.0254, math.nan])
def test_functions_are_written_in_the_units_that_the_file_tells(
    tmp_path: Path, metres: float
) -> None:
    test = made(Wanted(8, metres=metres))
    assert test.frfs is not None
    turned = replace(
        test.frfs,
        components=np.where(np.arange(test.frfs.nodes.size) % 2, 2, test.frfs.components),
    )
    write_universal(tmp_path / "t.unv", replace(test, frfs=turned))
    measurement, files = read_universal([tmp_path / "t.unv"])
    assert measurement.frfs is not None
    np.testing.assert_allclose(measurement.frfs.values, turned.values, rtol=1e-10)
    assert not any("contradict" in note for note in measurement.notes)
    written = [item for item in files[0].contents if isinstance(item, Function)]
    # the second is a translation over a force: in inches a newton it is SI divided by 0.0254
    expected = turned.values[:, 1] / (1.0 if math.isnan(metres) else metres)
    np.testing.assert_allclose(written[1].values, expected, rtol=1e-10)
