"""What solvers left as a test: frequencies and shapes are those of the solvers, by every file."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import h5py
import numpy as np
import pytest

from modetune.adapters.nastran.dialect import MYSTRAN
from modetune.adapters.test_files.measurements import read_computed, read_measurement
from modetune.core.correlation.correlation import mac
from modetune.core.errors import CampaignError
from modetune.core.modes import MeasuredModes
from tests.adapters.solved import needs_ccx, needs_mystran
from tests.adapters.test_files.result_decks import bracket, ladder


def modes_in(path: Path) -> MeasuredModes:
    found = read_measurement([path]).modes
    assert found is not None
    return found


@needs_mystran
def test_a_free_ladder_is_read_from_print_file_and_op2_alike(tmp_path: Path) -> None:
    (tmp_path / "ladder.dat").write_text(ladder())
    program = os.environ.get(MYSTRAN.variable, MYSTRAN.program)
    subprocess.run([program, "ladder.dat"], cwd=tmp_path, check=True, capture_output=True)
    (tmp_path / "ladder.OP2").rename(tmp_path / "lab.unv")  # whatever it is called
    op2, f06 = modes_in(tmp_path / "lab.unv"), modes_in(tmp_path / "ladder.F06")
    assert op2.numbers == f06.numbers == (7, 8, 9, 10, 11, 12)
    # Seven printed digits of an eigenvalue are 5e-7 of it at most, half of that of a frequency.
    np.testing.assert_allclose(op2.modes.frequencies_hz, f06.modes.frequencies_hz, rtol=5e-7)
    np.testing.assert_allclose(np.diag(mac(op2.modes.mode_shapes, f06.modes.mode_shapes)), 1.0)
    assert set(op2.modes.components.tolist()) == {1, 2, 3}
    assert read_computed(tmp_path / "ladder.F06").n_modes == 12  # a model keeps its rigid modes
    notes = read_measurement([tmp_path / "ladder.F06"]).notes
    assert "modes 1, 2, 3, 4, 5, 6 are taken for rigid" in notes[0]
    assert "30 rotations are left out" in notes[1]


@needs_ccx
def test_a_bracket_is_read_from_frd_with_its_places(tmp_path: Path) -> None:
    (tmp_path / "b.inp").write_text(bracket())
    subprocess.run(["ccx", "b"], cwd=tmp_path, check=True, capture_output=True)
    measured = modes_in(tmp_path / "b.frd")
    table = (tmp_path / "b.dat").read_text().split("P A R T I C I P A T I O N")[0]
    rows = [line.split() for line in table.splitlines()]
    cycles = [float(row[3]) for row in rows if len(row) == 5 and row[0].isdigit()]
    np.testing.assert_allclose(measured.modes.frequencies_hz, cycles, rtol=5e-6)  # six digits
    geometry = read_measurement([tmp_path / "b.frd"]).geometry
    assert geometry is not None
    assert geometry.nodes.tolist() == list(range(5, 41))  # nodes 1 to 4 are clamped
    place = geometry.coordinates[geometry.nodes.tolist().index(21)]
    np.testing.assert_allclose(place, [0.0, 0.0, 50.0], atol=1e-9)
    with pytest.raises(CampaignError, match=r"print file of CalculiX.*name the .frd"):
        read_measurement([tmp_path / "b.dat"])


def nastran_hdf5(path: Path, cp: int = 0) -> Path:
    """A clamped rod's two modes as MSC Nastran writes them, of two subcases; rounded by no one."""
    shapes = np.zeros(
        8, dtype=[("ID", "i8"), *((name, "f8") for name in ("X", "Y", "Z", "RX", "RY", "RZ")),
                  ("DOMAIN_ID", "i8")],
    )  # fmt: skip
    shapes["ID"], shapes["DOMAIN_ID"] = np.tile([1, 2], 4), np.repeat([2, 3, 4, 5], 2)
    shapes["X"] = [0.0, 1.0, 0.0, 0.0, 9.0, 9.0, 9.0, 9.0]
    shapes["Y"] = [0.0, 0.0, 0.0, 2.0, 0.0, 0.0, 0.0, 0.0]
    domains = np.zeros(
        5, dtype=[("ID", "i8"), ("SUBCASE", "i8"), ("STEP", "i8"), ("ANALYSIS", "i8"),
                  ("TIME_FREQ_EIGR", "f8"), ("EIGI", "f8"), ("MODE", "i8")],
    )  # fmt: skip
    domains["ID"], domains["SUBCASE"] = [1, 2, 3, 4, 5], [0, 1, 1, 2, 2]
    domains["MODE"], domains["TIME_FREQ_EIGR"] = [0, 1, 2, 1, 2], [0.0, 100.0, 400.0, 1.0, 4.0]
    grids = np.zeros(2, dtype=[("ID", "i8"), ("CP", "i8"), ("X", "f8", (3,)), ("CD", "i8")])
    grids["ID"], grids["CP"], grids["X"] = [1, 2], cp, [[0.0, 0.0, 0.0], [1.0, 0.5, 0.0]]
    with h5py.File(path, "w") as file:
        file["/NASTRAN/RESULT/NODAL/EIGENVECTOR"] = shapes
        file["/NASTRAN/RESULT/DOMAINS"] = domains
        file["/NASTRAN/INPUT/NODE/GRID"] = grids
    return path


def test_modes_in_hdf5_of_nastran_are_the_first_subcases(tmp_path: Path) -> None:
    path = nastran_hdf5(tmp_path / "rod.h5")
    measured = modes_in(path)
    np.testing.assert_allclose(measured.modes.frequencies_hz, [10.0 / 2 / np.pi, 20.0 / 2 / np.pi])
    assert measured.modes.nodes.tolist() == [2, 2]
    assert measured.modes.components.tolist() == [1, 2]
    assert measured.modes.mode_shapes.tolist() == [[1.0, 0.0], [0.0, 2.0]]
    geometry = read_measurement([path]).geometry
    assert geometry is not None
    assert geometry.coordinates.tolist() == [[1.0, 0.5, 0.0]]
    # Places in a system of their own are not taken for global ones.
    assert read_measurement([nastran_hdf5(tmp_path / "other.h5", cp=3)]).geometry is None


def test_another_hdf5_is_told_by_what_it_lacks(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["signal"] = np.zeros(4)
    with pytest.raises(CampaignError, match=r"a.h5.*no modes.*no dataset or group '/NASTRAN"):
        read_measurement([tmp_path / "a.h5"])


def punch() -> str:
    """A rod's two modes at two nodes, with rotations, as Nastran punches them."""
    heads = ["$TITLE   = ROD", "$SUBTITLE=", "$LABEL   =", "$EIGENVECTOR", "$REAL OUTPUT",
             "$SUBCASE ID =           1"]  # fmt: skip
    for mode, eigenvalue in ((1, 100.0), (2, 400.0)):
        heads += [f"$EIGENVALUE = {eigenvalue:14.7E}  MODE = {mode:5}"]
        for node in (1, 2):
            values = "".join(f"{value:18.6E}" for value in (mode * node, 0.0, -0.5))
            heads += [f"{node:10}       G{values}", "-CONT-" + " " * 12 + 3 * f"{0.0:18.6E}"]
    lines = [f"{line:72}{number:8}" for number, line in enumerate(heads, start=1)]
    return "\r\n".join(lines) + "\r\n"


def test_a_punch_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "rod.txt"
    path.write_text(punch())
    measured = modes_in(path)
    np.testing.assert_allclose(measured.modes.frequencies_hz, [10.0 / 2 / np.pi, 20.0 / 2 / np.pi])
    assert measured.modes.mode_shapes.tolist() == [[1, 2], [-0.5, -0.5], [2, 4], [-0.5, -0.5]]


def test_a_run_that_failed_says_so(tmp_path: Path) -> None:
    path = tmp_path / "bad.f06"
    path.write_text(
        "1   N A S T R A N    E X E C U T I V E    C O N T R O L    E C H O\n"
        " *** USER FATAL MESSAGE 316 (IFPDRV)\n     ILLEGAL DATA ON BULK DATA ENTRY CBAR\n\n"
    )
    with pytest.raises(CampaignError, match=r"the run failed: .*FATAL MESSAGE 316"):
        read_measurement([path])


@pytest.mark.parametrize("name", ["gart.OP2", "gart.F06"])
def test_a_public_shell_model_is_read(shared_data: Path, tmp_path: Path, name: str) -> None:
    copy = tmp_path / "test.csv"
    shutil.copy(shared_data / "garteur" / "mystran" / name, copy)
    measured = modes_in(copy)
    # MYSTRAN's own table of the same run: mode 7 is the first elastic one.
    assert measured.numbers[0] == 7
    assert measured.modes.frequencies_hz[:2] == pytest.approx([6.356234, 17.12092], rel=1e-6)
    assert measured.modes.n_dof == 966  # 322 grid points
