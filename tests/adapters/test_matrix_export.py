"""Matrices for other programs, read back by pyNastran and by modetune itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyNastran.bdf.bdf import BDF
from pyNastran.op4.op4 import OP4

from modetune.adapters.matrices.export import FORMS, WrittenMatrices, write_matrices
from modetune.adapters.matrices.matrix_files import write_matrix
from modetune.core.errors import CampaignError, ModelError
from tests.one_matrix import read_matrix


def written(n: int = 7, n_scalar: int = 2) -> WrittenMatrices:
    """Numbers over twenty decades with empty columns; nodes 3, 4, ... and scalar points."""
    random = np.random.default_rng(n)
    half = random.normal(size=(n, n)) * 10.0 ** random.integers(-10, 10, (n, n))
    stiffness: Any = half + half.T
    stiffness[2], stiffness[:, 2] = 0.0, 0.0
    nodes = np.array([3, 3, 4, 5, 5, 90, 91][:n], dtype=np.int64)
    components = np.array([1, 6, 3, 1, 2, 1, 1][:n], dtype=np.int64)
    mass = np.diag(10.0 ** np.arange(-3.0, n - 3.0) / 3.0)
    return WrittenMatrices(stiffness, mass, nodes, components, n_scalar, comments=("a test",))


def test_output4_is_read_back_to_the_last_digit(tmp_path: Path) -> None:
    found = written()
    write_matrices(tmp_path / "r.op4", found)
    read = OP4(debug=None).read_op4(str(tmp_path / "r.op4"))
    assert read["KAAX"].form == 6
    np.testing.assert_array_equal(read["KAAX"].data, found.stiffness)
    np.testing.assert_array_equal(read["MAAX"].data, found.mass)
    np.testing.assert_array_equal(read_matrix(tmp_path, "r.op4:kaax").toarray(), found.stiffness)
    names = (tmp_path / "r_dofs.txt").read_text().split()
    assert names[:3] == ["3.x", "3.rz", "4.z"]


def test_dmig_is_what_pynastran_makes_of_it(tmp_path: Path) -> None:
    found = written()
    write_matrices(tmp_path / "r.bdf", found)
    grids = "\n".join(f"GRID,{node},,0.,0.,0." for node in (3, 4, 5))
    text = (tmp_path / "r.bdf").read_text()
    (tmp_path / "run.bdf").write_text(f"CEND\nBEGIN BULK\n{grids}\n{text}ENDDATA\n")
    model = BDF(debug=None)
    model.read_bdf(tmp_path / "run.bdf", xref=False)
    assert sorted(model.spoints) == [90, 91]
    names = list(zip(found.nodes.tolist(), [1, 6, 3, 1, 2, 0, 0], strict=True))
    for name, matrix in (("KAAX", found.stiffness), ("MAAX", found.mass)):
        values, rows, _ = model.dmig[name].get_matrix(is_sparse=False)
        places = [names.index(rows[k]) for k in range(len(rows))]
        # Fields of 16 characters hold ten digits or more.
        expected = matrix[np.ix_(places, places)]
        np.testing.assert_allclose(values, expected, rtol=1e-9)


def test_a_model_of_matrices_is_written_with_its_names(tmp_path: Path) -> None:
    found = written(5, 0)
    first, *_ = write_matrices(tmp_path / "r.yaml", found)
    text = first.read_text()
    assert text.startswith("# a test\n")
    np.testing.assert_array_equal(
        read_matrix(tmp_path, "r.h5:stiffness").toarray(), found.stiffness
    )
    with np.load(write_matrices(tmp_path / "r.npz", found)[0]) as file:
        np.testing.assert_array_equal(file["mass"], found.mass)


def test_an_output4_matrix_of_a_model_is_updated_where_it_stands(tmp_path: Path) -> None:
    write_matrix(tmp_path, "m.op4:KGG", read_of(tmp_path))
    write_matrix(tmp_path, "m.op4:MGG", 2.0 * read_of(tmp_path))
    ratio = read_matrix(tmp_path, "m.op4:MGG") - 2.0 * read_matrix(tmp_path, "m.op4:KGG")
    assert abs(ratio).max() == 0.0


def read_of(folder: Path) -> Any:
    write_matrices(folder / "r.op4", written())
    return read_matrix(folder, "r.op4:KAAX")


@pytest.mark.parametrize(
    ("reference", "said"),
    [
        ("r.op4:KAAY", "it has the matrices KAAX, MAAX.*did you mean KAAX"),
        ("r.op4", "name one as r.op4:NAME"),
        ("none.op4:K", "none.op4 cannot be read"),
        ("cut.op4:KAAX", "cut.op4:KAAX in .* holds no matrix"),
        ("text.op4:KAAX", "holds no matrix"),
    ],
)
def test_what_is_not_there_is_told(tmp_path: Path, reference: str, said: str) -> None:
    write_matrices(tmp_path / "r.op4", written())
    text = (tmp_path / "r.op4").read_text()
    (tmp_path / "cut.op4").write_text(text[: len(text) // 3])
    (tmp_path / "text.op4").write_text("not OUTPUT4 at all\n" * 3)
    with pytest.raises(ModelError, match=said):
        read_matrix(tmp_path, reference)


def test_other_forms_are_refused_with_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(CampaignError, match=r"\.npz, \.op4, \.bdf") as error:
        write_matrices(tmp_path / "r.inp", written())
    assert "CalculiX reads no matrices" in str(error.value)
    assert len(FORMS) == 7
