"""Load cases of decks: displacements by stored matrices are those of a solver's own static run."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.solver import MatrixAnalysis, Solver
from modetune.adapters.translation.solver import translated_solver
from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from modetune.core.updating.parameter_matrices import parameter_matrices
from modetune.core.updating.results import MatrixResult
from modetune.core.updating.static import Reading, StaticModel
from tests.adapters.ccx_decks import bar, plate
from tests.adapters.mystran_decks import frame
from tests.adapters.test_solver_contract import run

ccx = pytest.mark.skipif(shutil.which("ccx") is None, reason="ccx is not installed")
mystran = pytest.mark.skipif(
    shutil.which("mystran") is None and "MODETUNE_MYSTRAN" not in os.environ,
    reason="MYSTRAN is not installed",
)

STEPS = """*STEP
*FREQUENCY
4
*END STEP
*STEP
*STATIC
*CLOAD
{0},3,-20.
*CLOAD
TIP,2,3.
{0},3,-5.
*END STEP
*STEP
*STATIC
*CLOAD
{1},3,12.
*END STEP
*STEP
*STATIC
*CLOAD, OP=NEW
{1},1,40.
*END STEP
"""
TIED = "*EQUATION\n3\n16,3,1., 15,3,-0.5,\n12,3,-0.5\n"
DECKS = {
    "solids": bar("C3D8I") + "*NSET, NSET=TIP\n13, 14\n" + STEPS.format(13, 14),
    "solids with an equation": bar("C3D8I") + TIED + "*NSET, NSET=TIP\n13\n" + STEPS.format(16, 14),
    "shells": plate("S8R") + "*NSET, NSET=TIP\n29\n" + STEPS.format(29, 25),
    "linear shells": plate("S4") + "*NSET, NSET=TIP\n12\n" + STEPS.format(12, 10),
}


def displacements(solver: Solver, folder: Path, case: int, dofs: list[tuple[int, int]]) -> Floats:
    """By the stored matrices, at these degrees of freedom."""
    found = run(solver, {}, MatrixAnalysis(), folder)
    assert isinstance(found, MatrixResult)
    one = np.array([1.0])
    readings = [Reading("u", 0, np.array([n]), np.array([c]), one, 0.0, 1, 1) for n, c in dofs]
    load = solver.deck.load_case(case)
    model = StaticModel.of(found, solver.deck.observation, [load], readings)
    return model.values(parameter_matrices(found, np.zeros(0), (), ()), np.zeros(0))[0]


@ccx
@pytest.mark.parametrize("name", DECKS)
def test_displacements_are_those_of_ccx_itself(name: str, tmp_path: Path) -> None:
    path = tmp_path / "model.inp"
    text = DECKS[name]
    path.write_text(text)
    solver = calculix_solver(path, ())
    watched = sorted(solver.deck.load_case(1).nodes.tolist())
    own = tmp_path / "own"
    own.mkdir()
    asked = f"*NSET, NSET=SEEN\n{', '.join(map(str, dict.fromkeys(watched)))}\n"
    head, steps = text.split("*STEP", 1)
    steps = "*STEP" + steps.replace("*END STEP", "*NODE PRINT, NSET=SEEN, GLOBAL=YES\nU\n*END STEP")
    (own / "own.inp").write_text(head + asked + steps)
    subprocess.run(["ccx", "own"], cwd=own, check=True, capture_output=True)
    tables = (own / "own.dat").read_text().split("displacements (vx,vy,vz)")[-3:]
    for case, table in enumerate(tables, start=1):
        rows = [line.split() for line in table.splitlines()[1:]]
        printed = {int(row[0]): list(map(float, row[1:])) for row in rows if len(row) == 4}
        dofs = [(node, c) for node in printed for c in (1, 2, 3)]
        wanted = np.concatenate(list(printed.values()))
        found = displacements(solver, tmp_path, case, dofs)
        # ccx prints seven digits. At a corner of a quadratic shell it spreads a force over the
        # three expanded nodes as (-1/2, 2, -1/2), which strains the thickness otherwise.
        allowed = 5e-4 if name == "shells" else 2e-6
        np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=allowed * np.abs(wanted).max())


LOADS = """LOAD,7,2.,.5,8,-1.5,9
FORCE,8,6,1,100.,.3,1.,-.5
MOMENT,9,10,2,5.,1.,0.,2.
FORCE,9,16,,-40.,0.,0.,1.
"""


@mystran
def test_displacements_are_those_of_mystran_itself(tmp_path: Path) -> None:
    from pyNastran.op2.op2 import OP2

    text = frame().replace("ENDDATA", LOADS + "ENDDATA")
    path = tmp_path / "model.bdf"
    path.write_text(text)
    solver = mystran_solver(path, ())
    own = tmp_path / "own"
    own.mkdir()
    job = tmp_path / "job"
    job.mkdir()
    solver.render({}, MatrixAnalysis()).write(job)
    (written,) = [file for file in job.iterdir() if "BEGIN BULK" in file.read_text()]
    cards = written.read_text().split("BEGIN BULK", 1)[1]
    loads = "".join(f"{line}\n" for line in LOADS.splitlines())
    asked = "SOL 101\nCEND\nLOAD = 7\nDISP(PLOT) = ALL\nBEGIN BULK\nPARAM,POST,-1\n"
    (own / "own.bdf").write_text(asked + cards.replace("ENDDATA", loads + "ENDDATA"))
    program = os.environ.get("MODETUNE_MYSTRAN", "mystran")
    subprocess.run([program, "own.bdf"], cwd=own, check=True, capture_output=True)
    op2 = OP2(debug=None)
    op2.read_op2(str(own / "own.OP2"))
    (table,) = op2.displacements.values()
    nodes = table.node_gridtype[:, 0].tolist()
    wanted = {
        (node, c): float(table.data[0, row, c - 1])
        for row, node in enumerate(nodes)
        for c in range(1, 7)
    }
    dofs = [(node, c) for node in (5, 6, 10, 11, 16, 17) for c in range(1, 7)]
    expected = np.array([wanted[dof] for dof in dofs])
    found = displacements(solver, tmp_path, 7, dofs)
    # Single precision in the OP2: 6e-8 of the largest, and the condition of the mounts.
    largest = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5 * largest)


@ccx
def test_a_translated_deck_deflects_as_mystran_has_it(tmp_path: Path) -> None:
    """A cantilever of a bar: w = F L^3 / 3 E I, in the tip's own axes."""
    grids = "".join(f"GRID,{k + 1},,{0.1 * k},0.,0.{',4' if k == 10 else ''}\n" for k in range(11))
    bars = "".join(f"CBAR,{k},1,{k},{k + 1},0.,0.,1.\n" for k in range(1, 11))
    text = (
        "SOL 103\nCEND\nMETHOD=1\nSPC=1\nBEGIN BULK\nEIGRL,1,,,4\n"
        "CORD2R,4,,0.,0.,0.,0.,-1.,0.\n,1.,0.,0.\n"  # its z is basic -y, its y basic z
        f"{grids}{bars}PBARL,1,1,,BAR\n,.02,.03\nMAT1,1,2.+11,,.3,7800.\n"
        "SPC1,1,123456,1\nFORCE,3,11,,50.,0.,0.,-1.\nENDDATA\n"
    )
    path = tmp_path / "model.bdf"
    path.write_text(text)
    solver = translated_solver(path, ())
    load = solver.deck.load_case(3)
    assert load.components.tolist() == [2]
    found = displacements(solver, tmp_path, 3, [(11, 2)])
    assert load.values[0] * found[0] > 0.0
    second = 0.03 * 0.02**3 / 12, 0.02 * 0.03**3 / 12
    closed = [50.0 * 1.0**3 / (3 * 2e11 * i) for i in second]
    # Shear adds 3 EI / (L^2 k A G): below 0.3 % here.
    assert min(abs(abs(found[0]) / item - 1.0) for item in closed) < 0.01


REFUSED = {
    "*CLOAD\n13,3,1.\n*DLOAD\nEALL,P1,2.\n": r"line \d+: \*DLOAD",
    "*CLOAD\n13,3,1.\n*BOUNDARY\n14,1,3\n": r"line \d+: \*BOUNDARY",
    "*CLOAD\n99,3,1.\n": r"line \d+: \*CLOAD needs a node",
    "*CLOAD\n13,3,\n": r"line \d+: '' is not a number",
    "*CLOAD, AMPLITUDE=A\n13,3,1.\n": r"line \d+: \*CLOAD with AMPLITUDE",
    "": r"no \*CLOAD",
}


@pytest.mark.parametrize("loads", REFUSED)
def test_other_loads_are_refused_with_their_line(loads: str, tmp_path: Path) -> None:
    path = tmp_path / "model.inp"
    path.write_text(bar("C3D8I") + f"*STEP\n*STATIC\n{loads}*END STEP\n*STEP\n*FREQUENCY\n4\n")
    deck = calculix_solver(path, ()).deck
    with pytest.raises(ModelError, match=REFUSED[loads]):
        deck.load_case(1)
    with pytest.raises(ModelError, match=r"no load case 2; it has 1 \*STATIC step.*line \d+"):
        deck.load_case(2)


def test_nastran_loads_that_are_not_there_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.bdf"
    path.write_text(frame().replace("ENDDATA", LOADS + "GRAV,5,,9.81,0.,0.,-1.\nENDDATA"))
    deck = mystran_solver(path, ()).deck
    with pytest.raises(ModelError, match=r"no load set 4; it has 7, 8, 9"):
        deck.load_case(4)
    with pytest.raises(ModelError, match=r"line \d+: GRAV of load set 5"):
        deck.load_case(5)
    path.write_text(frame().replace("ENDDATA", "FORCE,8,777,,1.,0.,0.,1.\nENDDATA"))
    with pytest.raises(ModelError, match=re.escape("FORCE names a grid point")):
        mystran_solver(path, ()).deck.load_case(8)
