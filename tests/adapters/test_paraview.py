"""Files for ParaView: read back by VTK, and alike whichever way they were made."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from modetune.adapters.calculix.frd import convert_frd, count_frd
from modetune.adapters.calculix.solver import CalculixProgram, calculix_solver
from modetune.adapters.paraview import (
    mode_grids,
    unstructured_grid,
    write_series,
)
from modetune.adapters.process import run_process
from modetune.adapters.solver import ModalAnalysis, Solver
from modetune.core.errors import NoResult, StorageUnavailable
from modetune.core.mesh import Cells, Mesh, global_shapes
from modetune.core.modes import mode_set
from modetune.core.updating.job_results import ModalResult
from tests.adapters.solved import needs_ccx

MATERIAL = "*MATERIAL, NAME=M\n*ELASTIC\n70000., .3\n*DENSITY\n2.7e-9\n"
#: A strip of shells on a beam, and a solid on it: a free structure with repeated zero frequencies.
SHELLS = (
    "*NODE\n"
    + "".join(f"{10 * i + j}, {20.0 * i}, {20.0 * j}, 0.\n" for i in range(1, 8) for j in (1, 2))
    + "*ELEMENT, TYPE=S4, ELSET=PLATE\n"
    + "".join(
        f"{i}, {10 * i + 1}, {10 * i + 11}, {10 * i + 12}, {10 * i + 2}\n" for i in range(1, 7)
    )
    + f"{MATERIAL}*SHELL SECTION, ELSET=PLATE, MATERIAL=M\n2.\n"
)
WEDGES = (
    "*NODE\n"
    + "".join(
        f"{3 * i + j + 1}, {x}, {y}, {50.0 * i}\n"
        for i in range(31)
        for j, (x, y) in enumerate(((0.0, 0.0), (20.0, 0.0), (0.0, 30.0)))
    )
    + "*ELEMENT, TYPE=C3D6, ELSET=E\n"
    + "".join(f"{i + 1}, {', '.join(str(3 * i + j) for j in range(1, 7))}\n" for i in range(30))
    + f"{MATERIAL}*SOLID SECTION, ELSET=E, MATERIAL=M\n"
)
#: A cantilever of beams with midside nodes, and the strip with a node whose results are turned.
BEAMS = (
    "*NODE\n"
    + "".join(f"{i + 1}, {10.0 * i}, 0., 0.\n" for i in range(21))
    + "*ELEMENT, TYPE=B32, ELSET=E\n"
    + "".join(f"{i + 1}, {2 * i + 1}, {2 * i + 2}, {2 * i + 3}\n" for i in range(10))
    + f"{MATERIAL}*BEAM SECTION, ELSET=E, MATERIAL=M, SECTION=RECT\n3., 2.\n0., 1., 0.\n"
    + "*BOUNDARY\n1, 1, 6\n"
)
TURNED = f"{SHELLS}*NSET, NSET=N\n11\n*TRANSFORM, NSET=N, TYPE=R\n0., 1., 0., -1., 0., 0.\n"


def solved(folder: Path, text: str, n_modes: int) -> tuple[Solver, Path, ModalResult]:
    """A deck run by ccx with shapes everywhere: the solver, the job's .frd, and the result."""
    (folder / "model.inp").write_text(text)
    plain = calculix_solver(folder / "model.inp", ())
    solver = replace(plain, program=CalculixProgram("ccx", with_frd=True))
    analysis = ModalAnalysis(n_modes, tuple(sorted(solver.deck.summary.node_ids)))
    job = folder / "job"
    job.mkdir()
    solver.render({}, analysis).write(job)
    ended = run_process(solver.program.command(1), job, 120.0, threading.Event())
    result = solver.read({}, analysis, job, ended.return_code)
    assert isinstance(result, ModalResult)
    return solver, job / "job.frd", result


def work(folder: Path) -> Path:
    place = folder / "work"
    place.mkdir()
    return place


@needs_ccx
@pytest.mark.parametrize(
    ("text", "n_modes"),
    [(SHELLS, 9), (WEDGES, 8), (BEAMS, 5), (TURNED, 9)],
    ids=["shells", "wedges", "beams", "turned"],
)
def test_both_ways_give_the_same_points_cells_and_shapes(
    text: str, n_modes: int, tmp_path: Path
) -> None:
    solver, frd, result = solved(tmp_path, text, n_modes)
    mesh = solver.deck.mesh()
    shapes = result.modes.mode_shapes.T.reshape(n_modes, -1, 3)  # of the .dat file, seven digits
    converted = convert_frd(frd, n_modes, work(tmp_path))
    count = 0
    for theirs, ours, shape in zip(converted, mode_grids(mesh, result.modes), shapes, strict=True):
        count += 1
        assert sorted(theirs.array_names) == sorted(ours.array_names)
        np.testing.assert_array_equal(theirs["node"], mesh.nodes)
        np.testing.assert_array_equal(theirs["element"], ours["element"])
        np.testing.assert_allclose(theirs.points, ours.points, rtol=1e-5)
        np.testing.assert_allclose(ours["mode_shape"], shape)
        # The .frd file has six digits.
        np.testing.assert_allclose(
            theirs["mode_shape"], shape, rtol=2e-5, atol=1e-6 * np.abs(shape).max()
        )
    assert count == n_modes  # six of one frequency, zero, among them


@needs_ccx
def test_the_file_for_pictures_changes_no_result(tmp_path: Path) -> None:
    for name in ("plain", "pictures"):
        (tmp_path / name).mkdir()
    solver, _, result = solved(tmp_path / "pictures", SHELLS, 9)
    plain = calculix_solver(tmp_path / "pictures" / "model.inp", ())
    analysis = ModalAnalysis(9, tuple(sorted(plain.deck.summary.node_ids)))
    plain.render({}, analysis).write(tmp_path / "plain")
    ended = run_process(plain.program.command(1), tmp_path / "plain", 120.0, threading.Event())
    again = plain.read({}, analysis, tmp_path / "plain", ended.return_code)
    assert isinstance(again, ModalResult)
    np.testing.assert_array_equal(again.modes.mode_shapes, result.modes.mode_shapes)
    assert (
        plain.render({}, analysis).content != solver.render({}, analysis).content
    )  # a job of its own


@needs_ccx
@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda text: text[: len(text) // 2], "ends before its closing line"),
        (lambda text: text.replace(" 9999\n", ""), "ends before its closing line"),
        (lambda text: "", "ends before its closing line"),
        (lambda text: drop(text, "100CL", 9), "mode 1 has shapes at 13 of 14 nodes"),
        (lambda text: text.replace(" -1        11", " -1        xx"), "cannot be read"),
        (lambda text: drop(text, "    2C", 1), "mode 1 has shapes at 14 of 13 nodes"),
        (lambda text: drop(text, "    3C", 2), "ccx2paraview could not convert"),
        (lambda text: text.replace("E", "?"), "ccx2paraview could not convert"),
    ],
)
def test_a_damaged_file_is_named_with_a_remedy(damage: object, said: str, tmp_path: Path) -> None:
    _, frd, _ = solved(tmp_path, SHELLS, 8)
    assert callable(damage)
    frd.write_text(damage(frd.read_text()))
    with pytest.raises(NoResult, match=said) as error:
        list(convert_frd(frd, 8, work(tmp_path)))
    assert str(frd) in str(error.value)
    assert "remove its folder" in str(error.value)


def drop(text: str, heading: str, after: int) -> str:
    """Without the line that stands so many lines behind the first one that has a heading."""
    lines = text.splitlines(keepends=True)
    first = next(place for place, line in enumerate(lines) if heading in line)
    return "".join(lines[: first + after] + lines[first + after + 1 :])


@needs_ccx
def test_fewer_modes_than_were_computed_are_told(tmp_path: Path) -> None:
    _, frd, _ = solved(tmp_path, SHELLS, 8)
    with pytest.raises(NoResult, match="holds 8 modes, 9 were computed"):
        list(convert_frd(frd, 9, work(tmp_path)))
    with pytest.raises(NoResult, match=r"no\.frd cannot be read"):
        count_frd(tmp_path / "no.frd")


def bar() -> Mesh:
    """Two links; the middle node has axes turned by 90 degrees about z: x' = y, y' = -x."""
    return Mesh(
        np.array([3, 5, 9]),
        np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]),
        (Cells("line", np.array([1, 2]), np.array([[3, 5], [5, 9]])),),
        {5: np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])},
    )


def test_shapes_are_turned_to_global_axes_and_zero_where_there_is_no_result() -> None:
    modes = mode_set(
        [1.0, 2.0],
        [[1.0, 10.0], [2.0, 20.0], [7.0, 70.0], [3.0, 30.0]],
        nodes=[5, 5, 5, 3],
        components=[1, 2, 4, 3],
    )
    shapes = global_shapes(bar(), modes)
    # 1 along y and 2 along -x; the rotation is left out; node 9 has no result.
    expected = [[0.0, 0.0, 3.0], [-2.0, 1.0, 0.0], [0.0, 0.0, 0.0]]
    np.testing.assert_allclose(shapes[0], expected)
    np.testing.assert_allclose(shapes[1], 10.0 * np.array(expected))


def test_a_series_is_read_back_by_vtk_as_it_was_written(tmp_path: Path) -> None:
    modes = mode_set([0.0, 0.0, 7.5], np.eye(3), nodes=[3, 3, 9], components=[1, 2, 3])
    file = write_series(tmp_path / "out", "initial", mode_grids(bar(), modes), modes.frequencies_hz)
    import pyvista  # a second and a half

    reader = pyvista.PVDReader(file)
    # Frequencies repeat; the number of the mode is the time.
    assert reader.time_values == [1.0, 2.0, 3.0]
    for mode, time in enumerate(reader.time_values):
        reader.set_active_time_value(time)
        grid = reader.read()[0]
        assert isinstance(grid, pyvista.UnstructuredGrid)
        assert grid.n_points == 3
        assert grid.n_cells == 2
        assert grid.celltypes.tolist() == [3, 3]  # VTK_LINE
        np.testing.assert_array_equal(grid["node"], [3, 5, 9])
        np.testing.assert_array_equal(grid["element"], [1, 2])
        np.testing.assert_allclose(grid["mode_shape"], global_shapes(bar(), modes)[mode])
        assert grid.field_data["mode"][0] == mode + 1
        assert grid.field_data["frequency_hz"][0] == modes.frequencies_hz[mode]
        assert grid.field_data["TimeValue"][0] == time
    names = [item.get("name") for item in ElementTree.parse(file).iter("DataSet")]
    assert names == ["mode 1: 0 Hz", "mode 2: 0 Hz", "mode 3: 7.5 Hz"]


def test_a_series_written_again_leaves_nothing_of_the_one_before(tmp_path: Path) -> None:
    for count in (12, 2):
        modes = mode_set(np.arange(count) + 1.0, np.ones((1, count)), nodes=[3], components=[1])
        write_series(tmp_path, "updated", mode_grids(bar(), modes), modes.frequencies_hz)
    assert sorted(path.name for path in (tmp_path / "updated").iterdir()) == [
        "mode_1.vtu",
        "mode_2.vtu",
    ]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["updated", "updated.pvd"]


@pytest.mark.parametrize("name", ["updated", "updated.part"])
def test_a_folder_with_other_files_is_never_replaced(tmp_path: Path, name: str) -> None:
    modes = mode_set([1.0], np.ones((1, 1)), nodes=[3], components=[1])
    write_series(tmp_path, "updated", mode_grids(bar(), modes), modes.frequencies_hz)
    (tmp_path / name).mkdir(exist_ok=True)
    kept = tmp_path / name / "thesis.tex"
    kept.write_text("ten years' work")
    with pytest.raises(StorageUnavailable, match=r"holds thesis\.tex, .*so it is not replaced"):
        write_series(tmp_path, "updated", mode_grids(bar(), modes), modes.frequencies_hz)
    assert kept.read_text() == "ten years' work"


def test_a_series_that_breaks_off_leaves_the_one_before(tmp_path: Path) -> None:
    modes = mode_set([1.0, 2.0], np.ones((1, 2)), nodes=[3], components=[1])
    file = write_series(tmp_path, "updated", mode_grids(bar(), modes), modes.frequencies_hz)
    before = file.read_text()

    def breaks() -> object:
        yield next(mode_grids(bar(), modes))
        raise NoResult("broke off")

    with pytest.raises(NoResult, match="broke off"):
        write_series(tmp_path, "updated", breaks(), modes.frequencies_hz)  # type: ignore[arg-type]
    assert file.read_text() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["updated", "updated.pvd"]
    assert len(list((tmp_path / "updated").iterdir())) == 2


def test_a_place_that_cannot_be_written_is_told(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    modes = mode_set([1.0], np.ones((1, 1)), nodes=[3], components=[1])
    with pytest.raises(StorageUnavailable, match="file is a file, and a folder is needed there"):
        write_series(tmp_path / "file", "initial", mode_grids(bar(), modes), modes.frequencies_hz)


def test_a_mesh_without_cells_is_no_error() -> None:
    grid = unstructured_grid(Mesh(np.array([1]), np.zeros((1, 3)), ()))
    assert (grid.n_points, grid.n_cells) == (1, 0)
