"""Modes are compared with a reference one to one; what is no reference is left out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from benchmarks.references import difference, needed, reference

from modetune.core.modes import Floats, ModeSet, mode_set

#: Shapes of a string's modes at nine points, (9, 4): orthogonal columns.
POINTS = np.arange(1, 10) / 10.0
SHAPES = np.sin(np.pi * POINTS[:, None] * np.arange(1, 5)[None])
ROW = "  {0:6d}  {0:6d}   {1:.6E}   {2:.6E}   {3:.6E}   1.000000E+00   {1:.6E}\n"


def modes(frequencies_hz: list[float], shapes: Floats | None = None) -> ModeSet:
    shapes = np.zeros((0, len(frequencies_hz))) if shapes is None else shapes
    nodes = np.arange(1, shapes.shape[0] + 1)
    return mode_set(np.array(frequencies_hz), shapes, nodes, np.full(nodes.size, 3))


def test_a_mode_is_not_compared_with_the_nearest_frequency() -> None:
    """A third mode at +9.3 % stays so, though the fourth of the model is 0.2 % from the third."""
    wanted, found = modes([10.0, 20.0, 30.0]), modes([10.0, 20.0, 32.79, 30.06])
    assert difference(found, wanted).worst == pytest.approx(0.093)
    assert not difference(found, wanted).right


def test_exchanged_modes_are_found_by_their_shapes() -> None:
    wanted = modes([10.0, 20.0, 30.0], SHAPES[:, :3])
    found = modes([10.01, 20.02, 28.0, 30.03], SHAPES[:, [0, 2, 1, 3]])
    assert difference(found, wanted).worst == pytest.approx(28.0 / 20.0 - 1.0)
    same = modes([9.95, 20.02, 30.03, 41.0], SHAPES)
    assert difference(same, wanted).worst == pytest.approx(-0.005)
    assert difference(same, wanted).right


def test_any_basis_of_a_repeated_mode_is_right() -> None:
    wanted = modes([10.0, 20.0, 20.0], SHAPES[:, :3])
    turned = SHAPES.copy()
    turned[:, 1:3] = SHAPES[:, 1:3] @ np.array([[0.6, -0.8], [0.8, 0.6]])
    assert difference(modes([10.0, 20.01, 20.02, 50.0], turned), wanted).right


def test_a_missing_mode_is_wrong() -> None:
    wanted = modes([10.0, 20.0, 30.0], SHAPES[:, :3])
    assert "1 modes are missing" in str(difference(modes([10.0, 20.0]), wanted))
    other = modes([10.0, 20.0, 30.0], SHAPES[:, [0, 1, 3]])
    assert "the shape of the one at 30 Hz" in str(difference(other, wanted))


def test_rigid_modes_are_counted() -> None:
    wanted = modes([2e-5, 3e-5, 10.0, 20.0])
    assert difference(modes([0.0, 0.0, 10.0, 20.0]), wanted).right
    assert "1 rigid modes in place of 2" in str(difference(modes([0.0, 10.0, 20.0]), wanted))
    # A lower bound of the eigenvalue method leaves rigid modes out of the reference.
    assert difference(modes([0.0, 0.0, 10.0, 20.0]), modes([10.0, 20.0])).right
    assert needed(wanted) == 4


def write(folder: Path, sol: str = "103", bulk: str = "", program: str = "MSC Nastran") -> Path:
    """A deck of one grid, with a print file of two modes next to it."""
    path = folder / "model.bdf"
    text = f"SOL {sol}\nCEND\nBEGIN BULK\nGRID,1,,0.,0.,0.\n{bulk}ENDDATA\n"
    path.write_text(text)
    rows = [
        ROW.format(mode, value, np.sqrt(value), np.sqrt(value) / (2.0 * np.pi))
        for mode, value in ((1, 400.0), (2, 900.0))
    ]
    heading = "                        R E A L   E I G E N V A L U E S\n"
    page = (
        f"1    A PAGE                         JANUARY   1, 2020  {program}  3/11/18   PAGE     1\n"
    )
    (folder / "model.f06").write_text(page + heading + "".join(rows) + page)
    return path


def test_the_print_file_next_to_a_deck_is_its_reference(tmp_path: Path) -> None:
    found = reference(write(tmp_path))
    assert found is not None
    assert found.source == "model.f06"
    np.testing.assert_allclose(found.modes.frequencies_hz, np.array([20.0, 30.0]) / (2.0 * np.pi))


@pytest.mark.parametrize(
    ("sol", "bulk", "program"),
    [
        ("105", "", "MSC Nastran"),  # eigenvalues of buckling
        ("103", "ASET,1,123\n", "MSC Nastran"),  # of a reduced model
        ("103", "", "MYSTRAN"),  # a solver of the survey itself
    ],
)
def test_other_eigenvalues_are_no_reference(
    sol: str, bulk: str, program: str, tmp_path: Path
) -> None:
    assert reference(write(tmp_path, sol, bulk, program)) is None


def test_a_table_above_the_deck_is_its_reference(tmp_path: Path) -> None:
    folder = tmp_path / "corpus" / "beams"
    folder.mkdir(parents=True)
    path = write(folder)
    (folder / "model.f06").unlink()
    table = "deck,source,mode,frequency_hz\nbeams/model.bdf,a run,1,12.5\n"
    (tmp_path / "corpus_references.csv").write_text(table + "beams/model.bdf,a run,2,13\n")
    found = reference(path)
    assert found is not None
    np.testing.assert_array_equal(found.modes.frequencies_hz, [12.5, 13.0])
