"""Punched eigenvectors: NASTRAN-95's of the GARTEUR model, and small files written here."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.nastran.f06 import read_f06
from modetune.adapters.nastran.op2 import read_op2
from modetune.adapters.nastran.punch import read_eigenvectors
from modetune.core.errors import SolverCrashed

HEAD = "$TITLE   =\n$EIGENVECTOR\n$REAL OUTPUT\n$SUBCASE ID = {}\n$EIGENVALUE ={}  MODE = {}\n"


def card(text: str, count: int) -> str:
    return f"{text:72s}{count:8d}\n"


def mode(number: int, eigenvalue: str, subcase: int = 1) -> str:
    cards = [
        "         1       G      1.000000E+00      2.000000E+00     -3.000000E+00",
        "-CONT-                  4.000000E+00      0.000000E+00      6.000000E+00",
        "         5       S      7.000000E+00      0.000000E+00      0.000000E+00",
        "-CONT-                  0.000000E+00      0.000000E+00      0.000000E+00",
    ]
    body = "".join(card(text, 10**7 + count) for count, text in enumerate(cards))
    return HEAD.format(subcase, eigenvalue, number) + body


def write(folder: Path, text: str) -> Path:
    path = folder / "job.pch"
    path.write_text(text)
    return path


def test_grid_and_scalar_points_are_read_without_the_card_count(tmp_path: Path) -> None:
    text = mode(1, " -0.1E-05") + mode(2, "  0.4000000E+03") + mode(1, " 0.9E+01", subcase=2)
    modes = read_eigenvectors(write(tmp_path, text))
    assert modes.mode_numbers.tolist() == [1, 2]
    np.testing.assert_array_equal(modes.eigenvalues, [-1e-6, 400.0])
    assert modes.nodes.tolist() == [1] * 6 + [5]
    assert modes.components.tolist() == [1, 2, 3, 4, 5, 6, 1]
    np.testing.assert_array_equal(modes.mode_shapes[:, 1], [1.0, 2.0, -3.0, 4.0, 0.0, 6.0, 7.0])


def test_displacements_in_the_same_file_are_left_out(tmp_path: Path) -> None:
    other = mode(1, " 0.1E+01").replace("$EIGENVECTOR", "$DISPLACEMENTS")
    modes = read_eigenvectors(write(tmp_path, other + mode(1, " 0.4E+03")))
    np.testing.assert_array_equal(modes.eigenvalues, [400.0])


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("", "no .EIGENVECTOR"),
        (mode(1, " 0.1E+01").replace("REAL OUTPUT", "REAL-IMAGINARY OUTPUT"), "complex"),
        (mode(1, " 0.1E+01") + mode(2, " 0.2E+01").rsplit("         5", 1)[0], "different points"),
        (mode(1, " 0.1E+01").replace("4.000000E+00", "4.0?0000E+00"), "a card of mode 1"),
        (mode(1, " 0.1E+01").replace("      6.000000E+00", " " * 18), "has 5 components"),
        (mode(1, " 0.1E+01").replace("-CONT-", "-COXT-"), "a card of mode 1"),
        (mode(1, " 0.1E+01") + mode(1, " 0.2E+01"), "mode 1 follows"),
    ],
)
def test_what_is_not_whole_is_refused(tmp_path: Path, text: str, found: str) -> None:
    with pytest.raises(SolverCrashed, match=found):
        read_eigenvectors(write(tmp_path, text))


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SolverCrashed, match="none"):
        read_eigenvectors(tmp_path / "none.pch")


def test_a_byte_changed_anywhere_is_refused_or_read(tmp_path: Path) -> None:
    generator = np.random.default_rng(5)
    text = mode(1, "  0.1E+01") + mode(2, "  0.4E+03")
    for _ in range(200):
        data = bytearray(text.encode())
        data[generator.integers(len(data))] ^= int(generator.integers(1, 256))
        path = tmp_path / "flipped.pch"
        path.write_bytes(data)
        try:
            modes = read_eigenvectors(path)
        except SolverCrashed:
            continue
        assert modes.mode_shapes.shape[0] == modes.nodes.size


def test_shapes_of_nastran_95_and_mystran_are_the_same_modes(shared_data: Path) -> None:
    folder = shared_data / "garteur"
    punched = read_eigenvectors(folder / "supaero" / "nastran_dynamic_ref.pnh")
    printed = read_f06(folder / "supaero" / "nastran_dynamic_ref.out")
    other = read_op2(folder / "mystran" / "gart.OP2")
    # Cards and print have the same seven digits.
    np.testing.assert_allclose(punched.eigenvalues, printed.eigenvalues, rtol=1e-6)
    np.testing.assert_array_equal(punched.nodes, other.nodes)
    np.testing.assert_array_equal(punched.components, other.components)
    # Rotations have another unit and would weigh by it.
    translations = punched.components <= 3
    first, second = punched.mode_shapes[translations], other.mode_shapes[translations]
    # Elastic modes 7 to 20; 10 and 11 (46.015 and 46.081 Hz) are one subspace.
    for column in (6, 7, 8, 11, 12, 13, 14, 15, 16, 17, 18, 19):
        product = (first[:, column] @ second[:, column]) ** 2
        mac = product / (first[:, column] @ first[:, column])
        assert mac / (second[:, column] @ second[:, column]) > 0.99
    bases = [np.linalg.qr(shapes[:, 9:11])[0] for shapes in (first, second)]
    cosines = np.linalg.svd(bases[0].T @ bases[1], compute_uv=False)
    assert cosines.min() ** 2 > 0.99
