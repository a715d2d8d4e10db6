"""Functions of universal files: text and binary, even and uneven, single and double precision."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.test_files.universal.blocks import read_blocks
from modetune.adapters.test_files.universal.file import read_universal
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import MeasuredFrfs
from tests.adapters.test_files.universal_text import (
    binary_58,
    dataset,
    e13,
    even_58,
    head_58,
    nodes_15,
    save,
    units_164,
)

VALUES = [1.5 + 2j, -3.25 + 0.5j, 0.125 - 7j, 1e-9 + 1e9j, 2 + 0j]
ENDS = (7, -3, 12, 2)


def read(path: Path) -> tuple[MeasuredFrfs, str]:
    measurement = read_universal([path])[0]
    assert measurement.frfs is not None
    return measurement.frfs, "\n".join(measurement.notes)


def test_a_response_function_has_its_ends_directions_and_frequencies(tmp_path: Path) -> None:
    frfs, notes = read(
        save(tmp_path / "t.unv", units_164(1.0), even_58(VALUES, ENDS, start=2.0, step=0.5))
    )
    assert frfs.kind == "accelerance"
    assert frfs.frequencies_hz.tolist() == [2.0, 2.5, 3.0, 3.5, 4.0]
    assert frfs.values[:, 0].tolist() == VALUES
    ends = (frfs.nodes, frfs.components, frfs.signs)
    assert [array.tolist() for array in ends] == [[7], [3], [-1.0]]
    force = (frfs.reference_nodes, frfs.reference_components, frfs.reference_signs)
    assert [array.tolist() for array in force] == [[12], [2], [1.0]]
    assert frfs.coherences.size == 0
    assert notes == ""


@pytest.mark.parametrize(("numerator", "kind"), [(8, "receptance"), (11, "mobility")])
def test_the_numerator_says_what_was_measured(tmp_path: Path, numerator: int, kind: str) -> None:
    path = save(tmp_path / "t.unv", even_58(VALUES, ENDS, quantities=(numerator, 13)))
    assert read(path)[0].kind == kind


def test_the_unit_says_it_where_the_numerator_does_not(tmp_path: Path) -> None:
    path = save(tmp_path / "t.unv", even_58(VALUES, ENDS, quantities=(1, 13), unit="m/s²"))
    assert read(path)[0].kind == "accelerance"
    path = save(tmp_path / "t.unv", even_58(VALUES, ENDS, quantities=(1, 13), unit="g/N"))
    assert read(path)[0].kind == "accelerance"


def test_uneven_double_precision_in_text_is_read(tmp_path: Path) -> None:
    abscissae, rows = [1.0, 2.5, 7.0, 7.5, 9.0], []
    for x, y in zip(abscissae, VALUES, strict=True):
        rows.append(f"{x:13.5E}{y.real:20.12E}{y.imag:20.12E}".replace("E", "D"))
    text = dataset(58, *head_58(4, ENDS, (6, 5, 0, 0.0, 0.0)), *rows)
    frfs, _ = read(save(tmp_path / "t.unv", text))
    assert frfs.frequencies_hz.tolist() == abscissae
    assert frfs.values[:, 0].tolist() == VALUES


def test_uneven_single_precision_in_text_is_read(tmp_path: Path) -> None:
    flat = [
        part for x, y in zip((1.0, 2.5, 7.0), VALUES, strict=False) for part in (x, y.real, y.imag)
    ]
    rows = [e13(flat[:6]), e13(flat[6:]) + " " * 41]  # blanks fill the row up
    text = dataset(58, *head_58(4, ENDS, (5, 3, 0, 0.0, 0.0)), *rows)
    frfs, _ = read(save(tmp_path / "t.unv", text))
    assert frfs.frequencies_hz.tolist() == [1.0, 2.5, 7.0]
    assert frfs.values[:, 0].tolist() == VALUES[:3]


@pytest.mark.parametrize("order", [1, 2], ids=["little", "big"])
@pytest.mark.parametrize("kind", [5, 6], ids=["single", "double"])
@pytest.mark.parametrize("before_mark", [b"", b"\n", b"\r\n"], ids=["at once", "LF", "CRLF"])
def test_even_binary_values_are_read(
    tmp_path: Path, order: int, kind: int, before_mark: bytes
) -> None:
    letter = "<" if order == 1 else ">"
    values = np.array(VALUES, dtype=f"{letter}c{8 if kind == 5 else 16}")
    data = binary_58(values, ENDS, (kind, 5, 1, 0.0, 2.0), order=order, before_mark=before_mark)
    frfs, _ = read(save(tmp_path / "t.unv", data, even_58(VALUES, (1, 1, 1, 1), step=2.0)))
    np.testing.assert_allclose(frfs.values[:, 0], VALUES, rtol=1e-6 if kind == 5 else 0)
    assert frfs.nodes.tolist() == [7, 1]  # what follows is found


@pytest.mark.parametrize("width", ["<f4", "<f8"], ids=["single abscissae", "double abscissae"])
def test_uneven_binary_values_are_read_by_the_format_and_by_pyuff(
    tmp_path: Path, width: str
) -> None:
    # by the format abscissae are single precision; pyuff writes them double
    mixed = np.zeros(5, dtype=[("x", width), ("y", "<c16")])
    mixed["x"], mixed["y"] = [1.0, 2.5, 7.0, 7.5, 9.0], VALUES
    path = save(tmp_path / "t.unv", binary_58(mixed, ENDS, (6, 5, 0, 0.0, 0.0)))
    frfs, _ = read(path)
    assert frfs.frequencies_hz.tolist() == [1.0, 2.5, 7.0, 7.5, 9.0]
    assert frfs.values[:, 0].tolist() == VALUES


def test_binary_values_that_look_like_marks_are_values(tmp_path: Path) -> None:
    raw = np.array([1.0, *np.frombuffer(b"\n    -1\n    -1\n ", dtype="<f8"), 2.0], dtype="<f8")
    path = save(
        tmp_path / "t.unv",
        binary_58(raw, ENDS, (6, 2, 1, 0.0, 1.0)),
        nodes_15((1, 0, 0, (1, 2, 3))),
    )
    blocks = read_blocks(path)
    assert [block.name for block in blocks] == ["58b", "15"]
    assert blocks[0].binary == raw.tobytes()
    # pyuff would cut the dataset at them: the file is refused rather than read wrongly
    with pytest.raises(CampaignError, match="export the file again with text values"):
        read_universal([path])


def test_a_wrong_count_of_bytes_is_put_right_by_number_and_type(tmp_path: Path) -> None:
    # pyuff claims 8 bytes for each complex value of double precision
    data = binary_58(np.array(VALUES), ENDS, (6, 5, 1, 0.0, 2.0), claimed=40)
    assert read(save(tmp_path / "t.unv", data))[0].values[:, 0].tolist() == VALUES


def test_numbers_that_are_not_ieee_are_passed_over(tmp_path: Path) -> None:
    data = binary_58(np.array(VALUES), ENDS, (6, 5, 1, 0.0, 2.0))
    vax = data.replace(b"    1     2  ", b"    1     1  ", 1)
    path = save(tmp_path / "t.unv", vax, even_58(VALUES, ENDS))
    assert "line 2 (dataset 58b) holds binary numbers that are not those of IEEE" in read(path)[1]


def test_coherences_go_with_their_functions(tmp_path: Path) -> None:
    coherence = [1.0, 0.9, 0.8, 0.7, 0.6]
    path = save(
        tmp_path / "t.unv",
        even_58(coherence, ENDS, kind=6, quantities=(0, 0)),
        even_58(VALUES, ENDS),
    )
    frfs, _ = read(path)
    assert frfs.coherences[:, 0].tolist() == coherence


def test_coherences_that_some_functions_lack_are_left_out(tmp_path: Path) -> None:
    path = save(
        tmp_path / "t.unv",
        even_58([1.0, 0.9, 0.8, 0.7, 0.6], ENDS, kind=6, quantities=(0, 0)),
        even_58(VALUES, ENDS),
        even_58(VALUES, (8, 1, 12, 2)),
    )
    frfs, notes = read(path)
    assert frfs.coherences.size == 0
    assert "1 of 2 response functions have no coherence at their frequencies: line" in notes


def test_other_functions_are_counted_and_named(tmp_path: Path) -> None:
    path = save(
        tmp_path / "t.unv",
        even_58([1.0, 2.0], (1, 1, 0, 0), kind=1),
        even_58([1.0, 2.0], (1, 1, 0, 0), kind=2),
        even_58([1.0, 2.0], (2, 1, 0, 0), kind=2),
        even_58(VALUES, ENDS),
    )
    notes = read(path)[1]
    assert "1 x time history: listed, not used" in notes
    assert "2 x auto spectrum: listed, not used" in notes


def test_functions_over_other_frequencies_are_passed_over_and_told(tmp_path: Path) -> None:
    path = save(
        tmp_path / "t.unv",
        even_58(VALUES, (1, 1, 1, 1), step=0.5),
        even_58(VALUES, (2, 1, 1, 1)),
        even_58(VALUES, (3, 1, 1, 1)),
        even_58(VALUES, (4, 1, 1, 1), quantities=(8, 13)),
    )
    frfs, notes = read(path)
    assert frfs.nodes.tolist() == [2, 3]
    assert "2 response functions have other frequencies or another quantity" in notes


def test_functions_with_the_same_fault_are_named_once(tmp_path: Path) -> None:
    bad = even_58(VALUES, (0, 0, 1, 1))
    path = save(tmp_path / "t.unv", even_58(VALUES, ENDS), bad, bad, bad)
    notes = read(path)[1]
    assert notes.count("without node or direction of its sensor") == 1
    assert re.search(r"passed over \(and 2 more: lines \d+, \d+\)", notes)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (even_58(VALUES, (0, 0, 1, 1)), "without node or direction of its sensor"),
        (even_58(VALUES, (1, 1, 0, 1)), "without node or direction of its force"),
        (even_58([1.0, 2.0], (1, 1, 1, 1)), "with real values only"),
        (even_58(VALUES, (1, 1, 1, 1), step=0.0), "whose frequencies do not ascend"),
        (even_58(VALUES, (1, 1, 1, 1), quantities=(2, 13)), "of no known quantity"),
        (even_58([*VALUES, complex("nan")], (1, 1, 1, 1)), "that are not finite"),
        (even_58(VALUES, ENDS), "that was given before"),
        (
            dataset(58, *head_58(4, ENDS, (5, 9, 1, 0.0, 1.0)), e13([1.0, 2.0])),
            "announces 9 values and has 1",
        ),
    ],
)
def test_a_function_that_cannot_be_used_is_named_with_its_line(
    tmp_path: Path, text: str, reason: str
) -> None:
    path = save(tmp_path / "t.unv", even_58(VALUES, ENDS), text)
    frfs, notes = read(path)
    assert frfs.values.shape == (5, 1)
    assert f"{path}, line 18 (dataset 58)" in notes
    assert reason in notes


#: Inches a metre and pounds a newton: dataset 164 of unit code 7.
INCHES, POUNDS = 1.0 / 0.0254, 1.0 / 4.4482216152605


@pytest.mark.parametrize(
    ("quantities", "ends", "factor"),
    [
        ((12, 13), (7, 3, 12, 2), 0.0254 / 4.4482216152605),  # (in/s^2)/lbf: 1 / 175.127
        ((8, 13), (7, 3, 12, 2), 0.0254 / 4.4482216152605),
        ((12, 13), (7, 5, 12, 2), 1.0 / 4.4482216152605),  # a rotation has no length
        ((12, 13), (7, 3, 12, -5), 1.0 / 4.4482216152605),  # over a moment, in lbf
        ((12, 13), (7, 5, 12, 5), 1.0 / 4.4482216152605 / 0.0254),
    ],
)
def test_functions_in_inches_and_pounds_are_converted_to_si(
    tmp_path: Path, quantities: tuple[int, int], ends: tuple[int, int, int, int], factor: float
) -> None:
    function = even_58(VALUES, ends, quantities=quantities)
    frfs, notes = read(save(tmp_path / "t.unv", units_164(INCHES, POUNDS), function))
    np.testing.assert_allclose(frfs.values[:, 0], np.array(VALUES) * factor, rtol=1e-12)
    said = f"dataset 164: 1 response functions are converted to SI, times {factor:.6g}"
    assert said in notes
    assert "doubtful" not in notes


def test_functions_without_any_unit_are_taken_as_si_and_doubtful(tmp_path: Path) -> None:
    path = save(tmp_path / "t.unv", even_58(VALUES, ENDS), even_58(VALUES, (8, 1, 12, 2)))
    frfs, notes = read(path)
    assert frfs.values[:, 0].tolist() == VALUES
    assert f"doubtful: {path}: 2 response functions are taken as SI" in notes


def test_a_factor_of_forces_that_can_be_none_leaves_si_and_the_unit_of_length(
    tmp_path: Path,
) -> None:
    path = save(
        tmp_path / "t.unv",
        units_164(1000.0, 0.0),
        nodes_15((7, 0, 0, (1, 2, 3))),
        even_58(VALUES, ENDS),
    )
    measurement = read_universal([path])[0]
    assert measurement.frfs is not None
    assert measurement.geometry is not None
    assert measurement.frfs.values[:, 0].tolist() == VALUES
    assert measurement.geometry.metres == pytest.approx(0.001)
    assert any("taken as SI" in note for note in measurement.notes)


@pytest.mark.parametrize(
    ("quantities", "unit", "below", "factor"),
    [
        ((12, 13), "g", "N", 9.80665),
        ((12, 13), "g/N", "NONE", 9.80665),
        ((12, 13), "g", "lbf", 9.80665 / 4.4482216152605),
        ((12, 13), "(in/s^2)/lbf", "", 0.0254 / 4.4482216152605),
        ((12, 13), "mm/s²", "N", 1e-3),
        ((11, 13), "in/s", "lbf", 0.0254 / 4.4482216152605),
        ((8, 13), "mm", "kN", 1e-6),
        ((12, 13), "m/s^2", "N", 1.0),
        ((1, 13), "g/N", "NONE", 9.80665),
    ],
)
def test_the_labels_of_its_axes_say_what_a_function_is_in(
    tmp_path: Path, quantities: tuple[int, int], unit: str, below: str, factor: float
) -> None:
    text = even_58(VALUES, ENDS, quantities=quantities, unit=unit, below=below)
    frfs, notes = read(save(tmp_path / "t.unv", text))
    np.testing.assert_allclose(frfs.values[:, 0], np.array(VALUES) * factor, rtol=1e-12)
    assert "doubtful" not in notes
    assert ("are converted to SI" in notes) == (factor != 1.0)


def test_g_goes_with_the_force_of_dataset_164(tmp_path: Path) -> None:
    text = even_58(VALUES, ENDS, unit="g")
    frfs, notes = read(save(tmp_path / "t.unv", units_164(INCHES, POUNDS), text))
    factor = 9.80665 / 4.4482216152605
    np.testing.assert_allclose(frfs.values[:, 0], np.array(VALUES) * factor, rtol=1e-12)
    assert "doubtful" not in notes


def test_labels_that_contradict_dataset_164_are_taken_and_doubtful(tmp_path: Path) -> None:
    text = even_58(VALUES, ENDS, unit="m/s^2", below="N")
    frfs, notes = read(save(tmp_path / "t.unv", units_164(INCHES, POUNDS), text))
    assert frfs.values[:, 0].tolist() == VALUES
    assert "doubtful: " in notes
    assert "contradict dataset 164" in notes


def test_half_a_label_without_dataset_164_is_doubtful(tmp_path: Path) -> None:
    frfs, notes = read(save(tmp_path / "t.unv", even_58(VALUES, ENDS, unit="g")))
    np.testing.assert_allclose(frfs.values[:, 0], np.array(VALUES) * 9.80665, rtol=1e-12)
    assert "doubtful: " in notes
    assert "the force of 1 functions is taken as SI" in notes


@pytest.mark.parametrize(
    ("quantities", "below", "what"),
    [
        ((12, 8), "NONE", "over a displacement"),
        ((12, 11), "NONE", "over a velocity"),
        ((12, 12), "NONE", "over an acceleration"),
        ((12, 15), "NONE", "over a quantity of kind 15"),
        ((12, 0), "g", "over g"),
    ],
)
def test_a_transmissibility_is_no_response_function(
    tmp_path: Path, quantities: tuple[int, int], below: str, what: str
) -> None:
    path = save(
        tmp_path / "t.unv",
        even_58(VALUES, ENDS),
        even_58(VALUES, (8, 1, 12, 2), quantities=quantities, below=below),
    )
    frfs, notes = read(path)
    assert frfs.nodes.tolist() == [7]
    assert f"a response function {what}, not over a force (a transmissibility)" in notes


def test_a_coherence_that_is_not_finite_is_passed_over(tmp_path: Path) -> None:
    coherence = even_58([1.0, 0.9, float("nan"), 0.7, 0.6], ENDS, kind=6, quantities=(0, 0))
    path = save(tmp_path / "t.unv", coherence, even_58(VALUES, ENDS))
    frfs, notes = read(path)
    assert frfs.coherences.size == 0
    assert f"doubtful: {path}, line 2 (dataset 58): a coherence with values that are not" in notes


def test_the_line_of_a_broken_row_is_told(tmp_path: Path) -> None:
    broken = even_58(VALUES, (8, 1, 12, 2)).replace("-3.25000E+00", "-3.2*000E+00")
    path = save(tmp_path / "t.unv", even_58(VALUES, ENDS), broken)
    _, notes = read(path)
    # the second dataset's number stands in line 18, its values from 12 lines below on
    assert f"doubtful: {path}, line 18 (dataset 58) " in notes
    assert "(line 30 is not made of numbers); passed over" in notes
