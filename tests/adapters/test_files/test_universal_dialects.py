"""What test systems write differently in universal files: read as meant, or told.

Written from the format's text and from what people report of exports: binary functions of
Simcenter Testlab end with a line break before the mark (github.com/ladisk/pyuff/issues/88) and have
datasets 1858 beside them; FE programs write reaction forces of a mode beside its shape.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.adapters.test_files.file_kind import kind_of
from modetune.adapters.test_files.universal.file import read_universal
from modetune.core.measurement.measurement import Measurement
from tests.adapters.test_files.universal_text import (
    binary_58,
    dataset,
    e13,
    even_58,
    mode_55,
    nodes_15,
    save,
)

POINTS = nodes_15((1, 0, 0, (0.0, 0.0, 0.0)), (2, 0, 0, (1.0, 0.0, 0.0)))
SHAPE = {1: (0.0, 0.0, 1.0), 2: (0.0, 0.0, -0.5)}
VALUES = [complex(n, -n) for n in range(1, 9)]


def read(folder: Path, *datasets: str | bytes) -> tuple[Measurement, str]:
    found = read_universal([save(folder / "lab.unv", *datasets)])[0]
    return found, "\n".join(found.notes)


def z_shape(found: Measurement) -> Any:
    assert found.modes is not None
    assert found.modes.modes.components.tolist() == [3] * len(found.modes.modes.nodes)
    return np.real(found.modes.modes.mode_shapes).T.tolist()


WHOLE = POINTS + mode_55(1, 10.0, SHAPE, damping=0.01)


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("\n", "\r\n"),
        lambda text: text.replace("\n", "   \n"),
        lambda text: text.replace("    -1\n", "   -1\n"),
        lambda text: text.replace("    -1\n", "-1 \n"),
        lambda text: text.replace("    -1\n", "\t-1\r\n"),
        lambda text: text.replace("    -1\n    55", "  -1\n    55"),
        lambda text: text.replace("         1         2         2         8", "1\t2\t2\t8\t"),
        lambda text: text.replace("         1         2         2         8", " 1 2 2 8 "),
    ],
    ids=["CRLF", "blanks", "three blanks", "none", "tab", "mixed", "tabs", "free"],
)
def test_blanks_tabs_and_line_ends_change_nothing(
    tmp_path: Path, change: Callable[[str], str]
) -> None:
    text = change(WHOLE)
    assert text != WHOLE
    found, _ = read(tmp_path, text.encode())
    assert z_shape(found) == [[1.0, -0.5]]
    assert found.geometry is not None
    assert found.geometry.coordinates[1].tolist() == [1.0, 0.0, 0.0]
    assert kind_of(tmp_path / "lab.unv").form == "universal"


@pytest.mark.parametrize("analysis", [3, 7])
def test_poles_of_first_and_second_order_are_in_rad_s(tmp_path: Path, analysis: int) -> None:
    pole = 2.0 * math.pi * 20.0 * complex(-0.02, math.sqrt(1.0 - 0.02**2))
    found, notes = read(tmp_path, POINTS, mode_55(4, pole, SHAPE, analysis=analysis))
    assert found.modes is not None
    assert found.modes.numbers == (4,)
    np.testing.assert_allclose(found.modes.modes.frequencies_hz, [20.0], rtol=1e-4)
    np.testing.assert_allclose(found.modes.modes.damping_ratios, [0.02], rtol=1e-4)
    assert "in Hz" not in notes


@pytest.mark.parametrize("line", ["Mode 1: 20.0 Hz, 2.0 %", "FREQ=20,00 HZ", "2.00E+01Hz"])
def test_a_pole_that_its_own_text_has_in_hz_is_taken_so_and_told(tmp_path: Path, line: str) -> None:
    pole = 20.0 * complex(-0.02, math.sqrt(1.0 - 0.02**2))
    text = mode_55(1, pole, SHAPE).replace("NONE", line, 1)
    found, notes = read(tmp_path, POINTS, text)
    assert found.modes is not None
    np.testing.assert_allclose(found.modes.modes.frequencies_hz, [20.0], rtol=1e-4)
    np.testing.assert_allclose(found.modes.modes.damping_ratios, [0.02], rtol=1e-3)
    assert "doubtful" in notes
    assert "its text has the pole in Hz" in notes


def test_a_normal_mode_may_be_complex_and_a_complex_mode_real(tmp_path: Path) -> None:
    pole = 2.0 * math.pi * 20.0 * complex(-0.02, 1.0)
    complex_mode = mode_55(2, pole, {1: (0, 0, 1j), 2: (0, 0, -0.5j)})
    reals = f"{2:10d}{6:10d}{1:10d}{2:10d}\n{e13([pole.real, pole.imag, 0, 0, 0, 0])}"
    normal = complex_mode.replace(f"{1:10d}{3:10d}", f"{1:10d}{2:10d}").replace(
        reals, f"{2:10d}{4:10d}{1:10d}{1:10d}\n{e13([10.0, 1.0, 0.01, 0.0])}"
    )
    real = mode_55(2, 20.0, SHAPE).replace(f"{1:10d}{2:10d}{2:10d}", f"{1:10d}{3:10d}{2:10d}")
    real = real.replace(f"{2:10d}{4:10d}{1:10d}{2:10d}\n{e13([20.0, 0, 0, 0])}", reals)
    found, _ = read(tmp_path, POINTS, normal, real)
    assert found.modes is not None
    np.testing.assert_allclose(found.modes.modes.frequencies_hz, [10.0, 20.004], rtol=1e-4)
    shapes = np.array(z_shape(found))
    np.testing.assert_allclose(np.abs(shapes), [[1.0, 0.5]] * 2, atol=1e-5)
    assert (shapes[:, 0] * shapes[:, 1] < 0.0).all()


@pytest.mark.parametrize(
    ("quantity", "what"), [(9, "reaction forces"), (2, "stress"), (3, "strain")]
)
def test_forces_and_strains_of_the_same_mode_are_no_shape(
    tmp_path: Path, quantity: int, what: str
) -> None:
    large = {1: (5e6, 0.0, 0.0), 2: (0.0, 5e6, 0.0)}
    other = mode_55(1, 10.0, large).replace(
        f"{2:10d}{8:10d}{2:10d}", f"{2:10d}{quantity:10d}{2:10d}"
    )
    found, notes = read(tmp_path, POINTS, mode_55(1, 10.0, SHAPE), other)
    assert z_shape(found) == [[1.0, -0.5]], what
    assert f"holds no motion (its data type is {quantity})" in notes


def test_damping_that_may_be_in_per_cent_is_doubtful(tmp_path: Path) -> None:
    modes = [mode_55(n, 10.0 * n, SHAPE, damping=0.02 * n**4) for n in (1, 2)]
    _, notes = read(tmp_path, POINTS, *modes)
    assert "doubtful: modes with a damping ratio above 0.2: 2; is it in per cent" in notes


def units(code: int, length: float, force: float) -> str:
    return dataset(
        164,
        f"{code:10d}{'named':20}{2:10d}",
        "".join(f"{value:25.16E}" for value in (length, force, 1.0)),
        f"{273.15:25.16E}",
    )


@pytest.mark.parametrize(
    ("code", "length", "metres", "said"),
    [
        (5, 1000.0, 1e-3, ""),
        (7, 39.3701, 0.0254, ""),
        (9, 1000.0, 1e-3, ""),
        (5, 1e-3, 1e-3, "its code 5 means lengths in 0.001 m, its factor 0.001 the inverse; the"),
        (1, 1000.0, 1e-3, "its code 1 means lengths in 1 m, its factor 1000 0.001 m; the factor"),
    ],
)
def test_code_and_factor_of_dataset_164_agree_or_are_doubtful(
    tmp_path: Path, code: int, length: float, metres: float, said: str
) -> None:
    found, notes = read(tmp_path, units(code, length, 1.0), POINTS)
    assert found.geometry is not None
    assert found.geometry.metres == pytest.approx(metres, rel=1e-5)
    assert ("doubtful" in notes) is bool(said)
    assert said in notes


def named(text: str, sensor: str, force: str = "NONE") -> str:
    """A function whose ends have names of components in place of NONE."""
    first, second = f" {'NONE':10}", f" {sensor:10}"
    rows = text.split("\n")
    head, _, tail = rows[7].partition(first)
    rows[7] = head + second + tail.replace(first, f" {force:10}", 1)
    return "\n".join(rows)


def test_components_are_named_beside_the_number_of_a_point(tmp_path: Path) -> None:
    found, notes = read(
        tmp_path,
        named(even_58(VALUES, (12, 3, 1, -3), unit="m/s^2", below="N"), "wing"),
        named(even_58(VALUES, (13, 3, 1, -3), unit="m/s^2", below="N"), "tail", "wing"),
        dataset(1858, "0 0 1 0 0 0"),
    )
    assert found.frfs is not None
    assert found.frfs.nodes.tolist() == [12, 13]
    assert found.frfs.reference_signs.tolist() == [-1.0, -1.0]
    assert notes == ""


def test_one_number_in_two_components_is_doubtful(tmp_path: Path) -> None:
    found, notes = read(
        tmp_path,
        named(even_58(VALUES, (12, 3, 1, 3), unit="m/s^2", below="N"), "wing"),
        named(even_58(VALUES, (12, 3, 1, 3), unit="m/s^2", below="N"), "tail"),
    )
    assert found.frfs is not None
    assert found.frfs.nodes.tolist() == [12]
    assert "doubtful: " in notes
    assert "whose point in tail over no name has the number of one in wing over no name" in notes


@pytest.mark.parametrize(
    ("name", "ends", "node", "component", "sign"),
    [
        ("wing:12", (0, 3, 1, 3), 12, 3, 1.0),
        ("wing:12:-Y", (0, 0, 1, 3), 12, 2, -1.0),
        ("12Z", (0, 0, 1, 3), 12, 3, 1.0),
        ("wing:12", (7, -1, 1, 3), 7, 1, -1.0),
    ],
)
def test_a_point_without_a_number_is_the_one_that_its_name_tells(
    tmp_path: Path,
    name: str,
    ends: tuple[int, int, int, int],
    node: int,
    component: int,
    sign: float,
) -> None:
    found, _ = read(tmp_path, named(even_58(VALUES, ends, unit="m/s^2", below="N"), name))
    assert found.frfs is not None
    assert found.frfs.nodes.tolist() == [node]
    assert (found.frfs.components[0], found.frfs.signs[0]) == (component, sign)


@pytest.mark.parametrize("ends", [(1, 3, 0, 0), (1, 3, 2, 0), (1, 0, 2, 3)])
def test_ends_without_direction_are_told_with_their_line(
    tmp_path: Path, ends: tuple[int, int, int, int]
) -> None:
    good = even_58(VALUES, (1, 3, 2, 3), unit="m/s^2", below="N")
    found, notes = read(tmp_path, good, even_58(VALUES, ends, unit="m/s^2", below="N"))
    assert found.frfs is not None
    assert found.frfs.nodes.tolist() == [1]
    assert "without node or direction of its " in notes


@pytest.mark.parametrize(
    ("unit", "below", "quantity", "factor"),
    [
        ("g", "lbf", 12, 9.80665 / 4.4482216152605),
        ("Gs/N", "NONE", 12, 9.80665),
        ("g's", "lbs", 12, 9.80665 / 4.4482216152605),
        ("(m/s\N{SUPERSCRIPT TWO})/N", "NONE", 12, 1.0),
        ("\N{MICRO SIGN}m/N", "NONE", 8, 1e-6),
        ("\N{GREEK SMALL LETTER MU}m/s", "N", 11, 1e-6),
        ("nm/s", "mN?", 11, 1e-9),
        ("m/s", "V", 11, 1.0),
    ],
)
def test_labels_of_other_systems_are_converted_or_doubtful(
    tmp_path: Path, unit: str, below: str, quantity: int, factor: float
) -> None:
    text = even_58(VALUES, (1, 3, 2, 3), quantities=(quantity, 13), unit=unit, below=below)
    found, notes = read(tmp_path, text.encode("utf-8"))
    assert found.frfs is not None
    np.testing.assert_allclose(found.frfs.values[:, 0], np.array(VALUES) * factor, rtol=1e-5)
    assert ("doubtful" in notes) is (below in ("V", "mN?"))


@pytest.mark.parametrize(("order", "mark"), [(1, "<"), (2, ">")])
@pytest.mark.parametrize("before", [b"", b"\n", b"\r\n"])
@pytest.mark.parametrize("form", ["     2", "     0", "      "])
def test_binary_values_of_either_order_with_or_without_a_line_end_before_the_mark(
    tmp_path: Path, order: int, mark: str, before: bytes, form: str
) -> None:
    values = np.array(VALUES, f"{mark}c8")
    text = binary_58(values, (1, 3, 2, 3), (5, 8, 1, 0.0, 1.0), order=order, before_mark=before)
    text = text.replace(b"     2          11", form.encode() + b"          11", 1)
    found, _ = read(tmp_path, text)
    assert found.frfs is not None
    np.testing.assert_array_equal(found.frfs.values[:, 0], np.array(VALUES))


def test_binary_values_whose_order_nobody_tells_are_passed_over(tmp_path: Path) -> None:
    text = binary_58(np.array(VALUES, "<c8"), (1, 3, 2, 3), (5, 8, 1, 0.0, 1.0), order=0)
    _, notes = read(tmp_path, POINTS, text)
    assert "does not state the order of its bytes (1 or 2, it has 0)" in notes


def test_labels_of_points_that_are_not_numbers_are_told_with_their_line(tmp_path: Path) -> None:
    text = POINTS.replace("         2", "        2F", 1)
    _, notes = read(tmp_path, text, mode_55(1, 10.0, SHAPE))
    assert "doubtful: " in notes
    assert "line 4 is not made of numbers" in notes
