"""Models of matrices in DMIG and OUTPUT4 files, against the matrices that made them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from struct import pack
from typing import Any

import numpy as np
import pytest
from pyNastran.bdf.bdf import BDF
from pyNastran.op4.op4 import OP4
from scipy import linalg

from modetune.adapters.matrices.deck import read_deck, write_updated
from modetune.core.errors import ModelError
from modetune.core.modes import Floats

MODEL = 'stiffness: "part.pch:KAAX"\nmass: "part.pch:MAAX"\n'
#: Numbers of the files have ten digits or more.
DIGITS = 1e-9


def beam(n_elements: int) -> tuple[Floats, Floats, list[tuple[int, int]]]:
    """A clamped beam in bending: displacement z and rotation y of nodes 10, 20, ..."""
    size = 2 * n_elements + 2
    stiffness, mass = np.zeros((size, size)), np.zeros((size, size))
    bend = np.array([[12, -6, -12, -6], [-6, 4, 6, 2], [-12, 6, 12, 6], [-6, 2, 6, 4]]) * 21.0
    lump = np.array(
        [[156, -22, 54, 13], [-22, 4, -13, -3], [54, -13, 156, 22], [13, -3, 22, 4]]
    ) / 420.0  # fmt: skip
    for element in range(n_elements):
        rows = slice(2 * element, 2 * element + 4)
        stiffness[rows, rows] += bend
        mass[rows, rows] += lump
    names = [(10 * node, component) for node in range(1, n_elements + 1) for component in (3, 5)]
    return stiffness[2:, 2:], mass[2:, 2:], names


def shaft(n_discs: int) -> tuple[Floats, Floats, list[tuple[int, int]]]:
    """A free shaft of discs that turn about x, and two scalar points for fixed-interface modes."""
    stiffness = 9.0 * (2.0 * np.eye(n_discs) - np.eye(n_discs, k=1) - np.eye(n_discs, k=-1))
    stiffness[0, 0] = stiffness[-1, -1] = 9.0
    mass = np.diag(np.arange(1.0, n_discs + 1.0))
    mass[0, -1] = mass[-1, 0] = 0.25
    stiffness, mass = (linalg.block_diag(a, b) for a, b in ((stiffness, np.diag([30.0, 70.0])),
                                                            (mass, np.eye(2))))  # fmt: skip
    mass[0, -1] = mass[-1, 0] = 0.125
    return stiffness, mass, [*((node, 4) for node in range(1, n_discs + 1)), (901, 0), (902, 0)]


def frame() -> tuple[Floats, Floats, list[tuple[int, int]]]:
    """Two bodies with six unknowns each, all coupled, with numbers over six decades."""
    random = np.random.default_rng(3)
    scale = np.diag(10.0 ** np.repeat([1.0, -1.0, 0.5, -2.0], 3))
    half = scale @ random.normal(size=(12, 12))
    mass = linalg.block_diag(*[np.diag([2.0, 2.0, 2.0, 0.3, 0.4, 0.5])] * 2)
    return half @ half.T, mass, [(node, c) for node in (7, 1001) for c in range(1, 7)]


def punched(name: str, matrix: Floats, names: Sequence[tuple[int, int]]) -> str:
    """The text of a symmetric DMIG as Nastran punches it, exponents with a D."""
    text = f"DMIG    {name:<8}       0       6       2       0\n"
    for column, (node, component) in enumerate(names):
        rows = [row for row in range(column, len(names)) if matrix[row, column]]
        if rows:
            text += f"DMIG*   {name:<16}{node:16d}{component:16d}\n"
        for row in rows:
            number = f"{matrix[row, column]:.9E}".replace("E", "D")
            text += f"*       {names[row][0]:16d}{names[row][1]:16d}{number:>16}\n"
    return text


def free_field(name: str, matrix: Floats, names: Sequence[tuple[int, int]], form: int) -> str:
    """The text of a DMIG in free field, all terms given."""
    text = f"DMIG,{name},0,{form},1,0\n"
    for column, (node, component) in enumerate(names):
        for row, (other, axis) in enumerate(names):
            if value := matrix[row, column]:
                number = f"{value:.12g}"
                number = number if "." in number or "e" in number else f"{number}."
                head = f"DMIG*,{name},{node},{component},\n"
                text += f"{head}*,{other},{axis},{number.replace('e', 'E')}\n"
    return text


def binary(name: str, matrix: Floats) -> bytes:
    """A matrix as OUTPUT4's unformatted records: a header, columns, and one more column."""

    def record(*words: bytes) -> bytes:
        data = b"".join(words)
        return pack("<i", len(data)) + data + pack("<i", len(data))

    size = len(matrix)
    text = record(pack("<4i8s", size, size, 6, 2, f"{name:8}".encode()))
    for column, values in enumerate(matrix.T, 1):
        text += record(pack(f"<3i{size}d", column, 1, 2 * size, *values))
    return text + record(pack("<3id", size + 1, 1, 2, 1.0))


STRUCTURES = [beam(4), shaft(5), frame()]


@pytest.mark.parametrize("structure", STRUCTURES)
@pytest.mark.parametrize("style", ["punched", "symmetric", "square"])
def test_a_model_of_dmig_is_its_matrices(structure: Any, style: str, tmp_path: Path) -> None:
    stiffness, mass, names = structure
    points = "$ EXTSEOUT\nBEGIN SUPER=7\nGRID,7,,1.,2.,3.\nSPOINT,901,902\nEXTRN,7,123456\n"
    text = "".join(
        punched(name, matrix, names)
        if style == "punched"
        else free_field(name, matrix, names, 6 if style == "symmetric" else 1)
        for name, matrix in (("KAAX", stiffness), ("MAAX", mass))
    )
    path = tmp_path / "model.yaml"
    path.write_text(MODEL)
    (tmp_path / "part.pch").write_text(points + text + "ENDDATA\n")
    model = read_deck(path).model
    assert [*zip(model.nodes.tolist(), model.components.tolist(), strict=True)] == [
        (node, component or 1) for node, component in names
    ]
    size = np.abs(stiffness).max()
    np.testing.assert_allclose(model.stiffness.toarray(), stiffness, rtol=DIGITS, atol=1e-9 * size)
    np.testing.assert_allclose(model.mass.toarray(), mass, rtol=DIGITS, atol=0.0)


def test_a_component_of_fewer_unknowns_is_a_part_of_the_whole(tmp_path: Path) -> None:
    stiffness, mass, names = beam(4)
    own = np.zeros_like(stiffness)
    own[2:6, 2:6] = stiffness[2:6, 2:6] / 2.0
    (tmp_path / "part.pch").write_text(
        punched("KAAX", stiffness, names) + punched("MAAX", mass, names)
    )
    (tmp_path / "wing.bdf").write_text(punched("KWING", own, names))
    path = tmp_path / "model.yaml"
    path.write_text(MODEL + "parts:\n  wing: {stiffness: wing.bdf}\n")
    scaled = read_deck(path).model.assembled({"wing": 1.3}).stiffness
    expected = stiffness + 0.3 * own
    np.testing.assert_allclose(scaled.toarray(), expected, rtol=DIGITS, atol=1e-9)


@pytest.mark.parametrize("structure", STRUCTURES)
def test_an_updated_component_is_dmig_that_pynastran_reads(structure: Any, tmp_path: Path) -> None:
    stiffness, mass, names = structure
    points = "GRID,7,,1.,2.,3.\nSPOINT,901,902\n"
    text = punched("KAAX", stiffness, names) + punched("MAAX", mass, names)
    (tmp_path / "part.pch").write_text(points + text + "$ the end\nASET1,123456,7\n")
    path = tmp_path / "model.yaml"
    path.write_text(MODEL + 'parts:\n  all: {stiffness: "part.pch:kaax"}\n')
    updated = write_updated(read_deck(path), {"all": 1.21}, tmp_path / "updated")
    written = (updated.parent / "part.pch").read_text()
    assert written.startswith(points)
    assert written.endswith("$ the end\nASET1,123456,7\n")
    bulk = BDF(debug=None)
    bulk.read_bdf(updated.parent / "part.pch", punch=True, xref=False)
    for name, matrix in (("KAAX", 1.21 * stiffness), ("MAAX", mass)):
        values, rows, _ = bulk.dmig[name].get_matrix(is_sparse=False)
        places = [names.index(rows[k]) for k in range(len(rows))]
        expected = matrix[np.ix_(places, places)]
        np.testing.assert_allclose(values, expected, rtol=DIGITS, atol=1e-9 * np.abs(matrix).max())
    again = read_deck(updated).model
    assert again.digest != read_deck(path).model.digest


@pytest.mark.parametrize("kind", ["text", "binary"])
@pytest.mark.parametrize("structure", STRUCTURES)
def test_a_component_in_output4_is_updated_as_output4(
    structure: Any, kind: str, tmp_path: Path
) -> None:
    stiffness, mass, names = structure
    if kind == "binary":
        data = binary("KAAX", stiffness) + binary("MAAX", mass)
        (tmp_path / "part.op4").write_bytes(data)
    else:
        given = {"KAAX": (6, stiffness), "MAAX": (6, mass)}
        OP4(debug=None).write_op4(str(tmp_path / "part.op4"), given, is_binary=False)
    (tmp_path / "dofs.txt").write_text("".join(f"{n}.{c or 1}\n" for n, c in names))
    path = tmp_path / "model.yaml"
    path.write_text(MODEL.replace(".pch", ".op4") + "dofs: dofs.txt\n"
                    'parts:\n  all: {mass: "part.op4:MAAX"}\n')  # fmt: skip
    (tmp_path / "whole.op4").write_bytes((tmp_path / "part.op4").read_bytes())
    text = path.read_text().replace('{mass: "part', '{mass: "whole')
    path.write_text(text)
    updated = write_updated(read_deck(path), {"all": 0.9}, tmp_path / "updated")
    read = OP4(debug=None).read_op4(str(updated.parent / "part.op4"))
    tolerance = 1e-12 * np.abs(stiffness).max()
    np.testing.assert_allclose(read["KAAX"].data, stiffness, rtol=1e-12, atol=tolerance)
    np.testing.assert_allclose(read["MAAX"].data, 0.9 * mass, rtol=1e-12)
    assert read["KAAX"].form == 6


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("pch:KAAX", "pch:KAAY", r"line 1: .*has the DMIG KAAX, MAAX.*did you mean KAAX"),
        ("pch:KAAX", "pch", "line 1: .*name one as part.pch:NAME"),
        ("part.pch:KAAX", "none.pch:K", "line 1: .*none.pch"),
    ],
)
def test_a_dmig_that_is_not_there_is_told_with_its_place(
    old: str, new: str, said: str, tmp_path: Path
) -> None:
    stiffness, mass, names = beam(2)
    (tmp_path / "part.pch").write_text(
        punched("KAAX", stiffness, names) + punched("MAAX", mass, names)
    )
    path = tmp_path / "model.yaml"
    path.write_text(MODEL.replace(old, new))
    with pytest.raises(ModelError, match=said):
        read_deck(path)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("DMIG,KAAX,0,6,3,0\nDMIG,KAAX,1,3,,1,3,1.,2.\n", "KAAX is not real and square"),
        ("DMIG,KAAX,0,9,1,0,,,1\nDMIG,KAAX,1,0,,1,3,1.\n", "KAAX is not real and square"),
        ("DMIG,KAAX,0,6,1,0\nDMIG,KAAX,1,3,,1,3,one\n", "pyNastran does not read its DMIG"),
        ("DMIG,KAAX,0,1,1,0\nDMIG,KAAX,1,3,,1,5,1.\n", "is not symmetric"),
    ],
)
def test_what_is_no_stiffness_is_refused(line: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "part.pch").write_text(
        line + "DMIG,MAAX,0,6,1,0\nDMIG,MAAX,1,3,,1,3,1.\nDMIG,MAAX,1,5,,1,5,1.\n"
    )
    path = tmp_path / "model.yaml"
    path.write_text(MODEL)
    with pytest.raises(ModelError, match=said):
        read_deck(path)


def test_names_that_the_file_of_unknowns_lacks_are_told(tmp_path: Path) -> None:
    stiffness, mass, names = beam(2)
    (tmp_path / "part.pch").write_text(
        punched("KAAX", stiffness, names) + punched("MAAX", mass, names)
    )
    (tmp_path / "dofs.txt").write_text("20.z\n20.ry\n10.ry\n")
    path = tmp_path / "model.yaml"
    path.write_text(MODEL + "dofs: dofs.txt\n")
    with pytest.raises(ModelError, match=r"`dofs` lacks 10\.z"):
        read_deck(path)
    (tmp_path / "dofs.txt").write_text("20.z\n20.ry\n10.ry\n10.z\n")
    order = [2, 3, 1, 0]
    found = read_deck(path).model.stiffness.toarray()
    np.testing.assert_allclose(found, stiffness[np.ix_(order, order)], rtol=DIGITS)
