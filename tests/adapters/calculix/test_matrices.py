"""Reading ccx's matrix files: recorded ones, written ones, and broken ones."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

from modetune.adapters.calculix.matrices import read_matrices, read_triangle
from modetune.core.errors import SolverCrashed
from modetune.core.modes import Floats

DATA = Path(__file__).parents[1] / "data"
UNREADABLE = "the stored matrices cannot be read"


def write_triangle(path: Path, matrix: Floats) -> None:
    """The upper triangle as ccx writes it: `%d %d %20.13e`, column by column."""
    lines = [
        f"{row + 1} {column + 1} {matrix[row, column]:20.13e}\n"
        for column in range(matrix.shape[1])
        for row in range(column + 1)
        if matrix[row, column] or row == column or (row + column) % 3 == 0  # some zeros stand too
    ]
    path.write_text("".join(lines))


def symmetric_matrix(size: int, seed: int) -> Floats:
    """Random, two thirds zeros, negative entries, exponents of either sign and of three digits."""
    random = np.random.default_rng(seed)
    full = random.standard_normal((size, size)) * 10.0 ** random.integers(-9, 9, (size, size))
    full[random.random((size, size)) < 0.6] = 0.0
    full = np.triu(full, 1)
    full[0, -1] = 1.5e-123
    return np.asarray(full + full.T + np.diag(random.random(size)))


def recorded(folder: Path) -> None:
    for suffix in ("dof", "sti", "mas"):
        shutil.copy(DATA / f"clamped.{suffix}", folder / f"job.{suffix}")


def test_matrices_are_read_with_the_names_of_their_equations() -> None:
    result = read_matrices(DATA, "clamped")
    # Nodes 1 to 4 are clamped; an element's 9 incompatible unknowns follow its 4 free nodes.
    assert result.nodes[:12].tolist() == [5, 5, 5, 6, 6, 6, 7, 7, 7, 8, 8, 8]
    assert result.components[:12].tolist() == [1, 2, 3] * 4
    for matrix in (result.upper_stiffness, result.upper_mass):
        assert matrix.shape == (21, 21)
        assert matrix.has_sorted_indices
        assert matrix.indices.dtype == np.int32
        assert sparse.tril(matrix, k=-1).nnz == 0
        assert (matrix.diagonal() != 0.0).all()
        assert np.count_nonzero(matrix.data) == matrix.nnz  # zeros are left out
    assert np.linalg.eigvalsh(result.stiffness.toarray()).min() > 0.0  # nothing is free to move
    # first lines of clamped.sti and clamped.mas
    first = [float((DATA / f"clamped.{name}").read_text().split()[2]) for name in ("sti", "mas")]
    assert [result.upper_stiffness[0, 0], result.upper_mass[0, 0]] == first


@pytest.mark.parametrize("piece", [60, 61, 97, 1000, 1 << 20])
def test_a_triangle_comes_back_to_the_last_digit_written(tmp_path: Path, piece: int) -> None:
    matrix = symmetric_matrix(40, 3)
    write_triangle(tmp_path / "m.sti", matrix)
    found = read_triangle(tmp_path / "m.sti", 40, piece)  # pieces cut lines and columns anywhere
    printed = np.vectorize(lambda value: float(f"{value:.13e}"))(np.triu(matrix))
    np.testing.assert_array_equal(found.toarray(), printed)
    assert found.nnz == np.count_nonzero(printed)


def test_a_diagonal_of_zero_is_kept(tmp_path: Path) -> None:
    matrix = np.diag([1.0, 0.0, 2.0])
    write_triangle(tmp_path / "m.mas", matrix)
    found = read_triangle(tmp_path / "m.mas", 3)
    assert found.nnz == 3
    assert found.indices.tolist() == [0, 1, 2]
    np.testing.assert_array_equal(found.toarray(), matrix)


@pytest.mark.parametrize("name", ["dof", "sti", "mas"])
@pytest.mark.parametrize("cut", ["nothing", "half a line", "last line", "half", "absent"])
def test_matrices_cut_short_are_no_result(tmp_path: Path, name: str, cut: str) -> None:
    recorded(tmp_path)
    path = tmp_path / f"job.{name}"
    lines = path.read_text().splitlines(keepends=True)
    text = {
        "nothing": "",
        "half a line": "".join(lines)[:-2],
        "last line": "".join(lines[:-1]),
        "half": "".join(lines[: len(lines) // 2]),
        "absent": "",
    }[cut]
    path.write_text(text)
    if cut == "absent":
        path.unlink()
    with pytest.raises(SolverCrashed, match=UNREADABLE):
        read_matrices(tmp_path, "job")


@pytest.mark.parametrize(
    ("pattern", "new"),
    [
        (r"e\+0", "e+x"),  # no number
        (r"\n2 2 [^\n]*", ""),  # a diagonal entry is missing
        (r"\n1 2 ", "\n2 1 "),  # below the diagonal
        (r"\n1 2 ", "\n-1 2 "),
        (r"\n1 2 [^\n]*", "\n1 2"),  # no value
        (r"\n1 2 [^\n]*", "\n1 2 -1.0e+00 -2.0e+00"),  # two
        (r"\n1 2 [^\n]*", "\n"),  # an empty line
        (r"\n(1 2 [^\n]*)", r"\n\1\n\1"),  # a line twice
        (r"\n21 21 ([^\n]*)", r"\n21 21 \1\n1 22 \1"),  # more than the equations named
        (r"\n1 2 ", "\n1 99999999999 "),
    ],
)
def test_garbled_matrices_are_no_result(tmp_path: Path, pattern: str, new: str) -> None:
    recorded(tmp_path)
    path = tmp_path / "job.sti"
    text = path.read_text()
    garbled = re.sub(pattern, new, text, count=1)
    assert garbled != text
    path.write_text(garbled)
    with pytest.raises(SolverCrashed, match=UNREADABLE):
        read_matrices(tmp_path, "job")


def test_a_line_without_end_is_no_result(tmp_path: Path) -> None:
    path = tmp_path / "m.sti"
    path.write_bytes(b"1 1 " + b"1" * 5000)
    with pytest.raises(ValueError, match="ends within a line"):
        read_triangle(path, 1, 100)


def test_names_of_more_equations_than_the_matrices_have_are_no_result(tmp_path: Path) -> None:
    recorded(tmp_path)
    with (tmp_path / "job.dof").open("a") as file:
        file.write("12.1\n")
    with pytest.raises(SolverCrashed, match="ends with entry"):
        read_matrices(tmp_path, "job")
