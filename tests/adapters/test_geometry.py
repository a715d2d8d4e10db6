"""Meshes as decks give them: places, shapes of elements in VTK's order, output frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.calculix.mesh import cell_kind
from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.nastran.solver import nastran_solver
from modetune.adapters.paraview import unstructured_grid
from modetune.adapters.solver import Solver
from modetune.adapters.translation.solver import translated_solver
from modetune.configs.garteur.aircraft import COARSE, aircraft, calculix_deck
from modetune.configs.garteur.shell import nastran_deck
from modetune.core.errors import ModelError
from modetune.core.mesh import NODES, CellKind, Mesh
from modetune.core.modes import Floats

#: Corners of solids of known volume, in the order that ccx, Nastran and VTK share.
BOX = np.array(
    [[0, 0, 0], [2, 0, 0], [2, 3, 0], [0, 3, 0], [0, 0, 5], [2, 0, 5], [2, 3, 5], [0, 3, 5]], float
)
WEDGE = BOX[[0, 1, 3, 4, 5, 7]]
TETRA = BOX[[0, 1, 3, 4]]
PYRAMID = BOX[[0, 1, 2, 3, 4]]
#: Edges whose middles are VTK's midside nodes, in its order (vtkQuadratic*.h).
VTK_EDGES: dict[CellKind, list[tuple[int, int]]] = {
    "line3": [(0, 1)],
    "triangle6": [(0, 1), (1, 2), (2, 0)],
    "quad8": [(0, 1), (1, 2), (2, 3), (3, 0)],
    "tetra10": [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)],
    "pyramid13": [(0, 1), (1, 2), (2, 3), (3, 0), (0, 4), (1, 4), (2, 4), (3, 4)],
    "wedge15": [(0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3), (0, 3), (1, 4), (2, 5)],
    "hexahedron20": [
        (0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6),
        (3, 7),
    ],
}  # fmt: skip
#: The same in decks. ccx manual 6.2: C3D20 and C3D15 as VTK. Nastran's Quick Reference Guide:
#: the midside nodes between the faces come before those of the second face.
NASTRAN_EDGES: dict[CellKind, list[tuple[int, int]]] = {
    **VTK_EDGES,
    "wedge15": [(0, 1), (1, 2), (2, 0), (0, 3), (1, 4), (2, 5), (3, 4), (4, 5), (5, 3)],
    "hexahedron20": [
        (0, 1), (1, 2), (2, 3), (3, 0), (0, 4), (1, 5), (2, 6), (3, 7), (4, 5), (5, 6), (6, 7),
        (7, 4),
    ],
}  # fmt: skip
CORNER_PLACES: dict[CellKind, Floats] = {
    "line3": BOX[:2],
    "triangle6": BOX[:3],
    "quad8": BOX[:4],
    "tetra10": TETRA,
    "pyramid13": PYRAMID,
    "wedge15": WEDGE,
    "hexahedron20": BOX,
}
#: Base times height, its half, a third and a sixth; areas of the base; the length.
SIZES: dict[CellKind, tuple[str, float]] = {
    "line3": ("Length", 2.0), "triangle6": ("Area", 3.0), "quad8": ("Area", 6.0),
    "tetra10": ("Volume", 5.0), "pyramid13": ("Volume", 10.0), "wedge15": ("Volume", 15.0),
    "hexahedron20": ("Volume", 30.0),
}  # fmt: skip
CALCULIX_NAMES: dict[CellKind, str] = {
    "line3": "B32R", "triangle6": "S6", "quad8": "S8R", "tetra10": "C3D10", "wedge15": "C3D15",
    "hexahedron20": "C3D20R",
}  # fmt: skip
NASTRAN_NAMES: dict[CellKind, str] = {
    "triangle6": "CTRIA6", "quad8": "CQUAD8", "tetra10": "CTETRA", "pyramid13": "CPYRAM",
    "wedge15": "CPENTA", "hexahedron20": "CHEXA",
}  # fmt: skip
MATERIAL = "MAT1,1,7.+4,,.3,2.7-9\nPSHELL,1,1,1.\nPSOLID,2,1\n"


def places(kind: CellKind, edges: list[tuple[int, int]]) -> Floats:
    """Corners and midside nodes of one element."""
    corners = CORNER_PLACES[kind]
    return np.vstack([corners, [(corners[a] + corners[b]) / 2.0 for a, b in edges]])


def calculix(folder: Path, text: str) -> Solver:
    path = folder / "model.inp"
    path.write_text(text)
    return calculix_solver(path, ())


def nastran(folder: Path, bulk: str) -> Solver:
    path = folder / "model.bdf"
    path.write_text(f"SOL 103\nCEND\nMETHOD=1\nBEGIN BULK\nEIGRL,1,,,10\n{bulk}ENDDATA\n")
    return nastran_solver(path, ())


def total(mesh: Mesh, size: str) -> float:
    """Sum of the cells' sizes by VTK; none may be below zero."""
    sizes = unstructured_grid(mesh).compute_cell_sizes()[size]
    assert (sizes >= 0.0).all()
    return float(sizes.sum())


def check_element(mesh: Mesh, kind: CellKind) -> None:
    (cells,) = mesh.cells
    assert (cells.kind, cells.nodes.shape) == (kind, (1, NODES[kind]))
    found = mesh.coordinates[mesh.rows(cells.nodes[0])]
    np.testing.assert_allclose(found, places(kind, VTK_EDGES[kind]))
    size, expected = SIZES[kind]
    assert total(mesh, size) == pytest.approx(expected)


@pytest.mark.parametrize("kind", CALCULIX_NAMES)
def test_calculix_elements_have_vtks_order_and_size(kind: CellKind, tmp_path: Path) -> None:
    found = places(kind, VTK_EDGES[kind])
    numbers = [7 * row + 3 for row in range(len(found))]
    listed = [numbers[0], numbers[2], numbers[1]] if kind == "line3" else numbers
    lines = ["*NODE", *(f"{n}, {x}, {y}, {z}" for n, (x, y, z) in zip(numbers, found, strict=True))]
    lines += [f"*ELEMENT, TYPE={CALCULIX_NAMES[kind]}, ELSET=E"]
    lines += ["9, " + ", ".join(map(str, listed[:10])) + ","] + (
        [", ".join(map(str, listed[10:]))] if len(listed) > 10 else []
    )
    check_element(calculix(tmp_path, "\n".join(lines) + "\n").deck.mesh(), kind)


@pytest.mark.parametrize("kind", NASTRAN_NAMES)
def test_nastran_elements_have_vtks_order_and_size(kind: CellKind, tmp_path: Path) -> None:
    found = places(kind, NASTRAN_EDGES[kind])
    cards = [f"GRID,{n},,{x},{y},{z}" for n, (x, y, z) in enumerate(found, 1)]
    fields = [1 if kind in ("triangle6", "quad8") else 2, *range(1, len(found) + 1)]
    card = f"{NASTRAN_NAMES[kind]},9"
    rows = [fields[:7], *(fields[i : i + 8] for i in range(7, len(fields), 8))]
    cards += [
        "\n".join(
            f"{card if i == 0 else ''}," + ",".join(map(str, row)) for i, row in enumerate(rows)
        )
    ]
    check_element(nastran(tmp_path, "\n".join(cards) + "\n" + MATERIAL).deck.mesh(), kind)


def test_an_element_without_some_midside_nodes_is_drawn_by_its_corners(tmp_path: Path) -> None:
    bulk = "".join(f"GRID,{n},,{x},{y},{z}\n" for n, (x, y, z) in enumerate(BOX[:4], 1))
    mesh = nastran(
        tmp_path, bulk + "GRID,5,,1.,0.,0.\nCQUAD8,9,1,1,2,3,4,5\n" + MATERIAL
    ).deck.mesh()
    (cells,) = mesh.cells
    assert cells.kind == "quad"
    assert cells.nodes.tolist() == [[1, 2, 3, 4]]


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("C3D8I", "hexahedron"), ("C3D4", "tetra"), ("C3D6", "wedge"), ("S4R", "quad"),
        ("US3", "triangle"), ("M3D3", "triangle"), ("CPE4", "quad"), ("CAX8R", "quad8"),
        ("B31", "line"), ("T3D2", "line"), ("T3D3", "line3"), ("SPRINGA", "line"),
        ("SPRING1", "vertex"), ("MASS", "vertex"), ("D", None), ("F3D8", None), ("U1", None),
    ],
)  # fmt: skip
def test_each_type_of_element_has_its_shape(name: str, kind: CellKind | None) -> None:
    assert cell_kind(name) == kind


def test_the_solid_aircraft_has_its_volume(tmp_path: Path) -> None:
    mesh = calculix(tmp_path, calculix_deck(COARSE)).deck.mesh()
    # The dimensions of the parts, in the generator's docstring.
    parts = 1500 * 50 * 150 + 2000 * 100 * 10 + 300 * 100 * 10 + 400 * 100 * 10 + 2 * 400 * 100 * 10
    assert total(mesh, "Volume") == pytest.approx(float(parts))
    assert mesh.nodes.size == len(aircraft(COARSE).nodes)


def test_the_shell_aircraft_has_the_same_mesh_for_nastran_and_in_translation(
    tmp_path: Path,
) -> None:
    path = tmp_path / "shell.bdf"
    path.write_text(nastran_deck())
    native, translated = nastran_solver(path, ()), translated_solver(path, ())
    assert native.deck.mesh().nodes.tolist() == translated.deck.mesh().nodes.tolist()
    assert translated.deck.summary.node_ids <= set(native.deck.mesh().nodes.tolist())
    assert total(native.deck.mesh(), "Area") > 0.0
    assert {cells.kind for cells in native.deck.mesh().cells} >= {"quad"}


def test_places_are_in_basic_coordinates_and_output_frames_are_told(tmp_path: Path) -> None:
    # A cylindrical system about z through (10, 0, 0): r = 2 at 90 degrees is (10, 2, 0), where
    # its axes are y, -x, z.
    cards = (
        "CORD2C,5,,10.,0.,0.,10.,0.,1.\n,11.,0.,0.\n"
        "GRID,1,5,2.,90.,0.,5\nGRID,2,,0.,0.,0.\nCONROD,1,1,2,1,1.\nCONM2,7,1,,3.\n"
        "RBE2,9,1,123456,2\nCELAS2,11,5.,2,1\n"
    )
    mesh = nastran(tmp_path, cards + MATERIAL).deck.mesh()
    np.testing.assert_allclose(mesh.coordinates, [[10.0, 2.0, 0.0], [0.0, 0.0, 0.0]], atol=1e-12)
    np.testing.assert_allclose(
        mesh.frames[1], [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], atol=1e-12
    )
    assert list(mesh.frames) == [1]
    kinds = {cells.kind: cells.elements.tolist() for cells in mesh.cells}
    # The grounded spring and the mass are points; the rigid element is not part of the structure.
    assert kinds == {"line": [1], "vertex": [11, 7]}


def test_a_mesh_is_read_when_asked_for_and_once(tmp_path: Path) -> None:
    solver = calculix(tmp_path, calculix_deck(COARSE))
    assert "_mesh" not in vars(solver.deck)
    assert solver.deck.mesh() is solver.deck.mesh()


def test_a_coordinate_that_is_no_number_is_named_with_its_line(tmp_path: Path) -> None:
    text = "*NODE\n1, 0., 0., 0.\n2, 1.5d0, x, 0.\n*ELEMENT, TYPE=T3D2, ELSET=E\n1, 1, 2\n"
    with pytest.raises(ModelError, match=r"model\.inp, line 3.*coordinates expected.*1\.5d0, x"):
        calculix(tmp_path, text).deck.mesh()


def test_numbers_are_read_as_ccx_reads_them(tmp_path: Path) -> None:
    # Fortran's exponents, blank coordinates as zero, and a node that is there twice at one place.
    nodes = "*NODE\n1, 15., 0, -20.\n1, 1.5D1, , -2.+1\n2\n2, 0.\n"
    text = f"{nodes}*ELEMENT, TYPE=T3D2, ELSET=E\n1, 1, 2\n"
    mesh = calculix(tmp_path, text).deck.mesh()
    np.testing.assert_array_equal(mesh.coordinates, [[15.0, 0.0, -20.0], [0.0, 0.0, 0.0]])


def test_rows_refuse_a_node_that_is_not_there(tmp_path: Path) -> None:
    mesh = Mesh(np.array([1, 5]), np.zeros((2, 3)), ())
    assert mesh.rows(np.array([[5, 1]])).tolist() == [[1, 0]]
    with pytest.raises(ModelError, match="a node is asked for that is not in the mesh"):
        mesh.rows(np.array([4]))
