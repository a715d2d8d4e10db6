"""Functions of universal files: text and binary, even and uneven, single and double precision."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.universal.blocks import read_blocks
from modetune.adapters.universal.read import read_universal
from modetune.core.errors import CampaignError
from modetune.core.measurement import MeasuredFrfs
from tests.adapters.universal_text import (
    binary_58,
    dataset,
    e13,
    even_58,
    head_58,
    nodes_15,
    save,
)

VALUES = [1.5 + 2j, -3.25 + 0.5j, 0.125 - 7j, 1e-9 + 1e9j, 2 + 0j]
ENDS = (7, -3, 12, 2)


def read(path: Path) -> tuple[MeasuredFrfs, str]:
    measurement = read_universal([path]).measurement
    assert measurement.frfs is not None
    return measurement.frfs, "\n".join(measurement.notes)


def test_a_response_function_has_its_ends_directions_and_frequencies(tmp_path: Path) -> None:
    frfs, notes = read(save(tmp_path / "t.unv", even_58(VALUES, ENDS, start=2.0, step=0.5)))
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
    flat = [part for x, y in zip((1.0, 2.5, 7.0), VALUES, strict=False)
            for part in (x, y.real, y.imag)]  # fmt: skip
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
    assert read(path)[0].coherences.size == 0


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
    assert "passed over (and 2 more)" in notes


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
