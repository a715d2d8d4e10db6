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
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from modetune.core.updating.job_results import Result
from modetune.core.updating.parameter_matrices import parameter_matrices
from modetune.core.updating.static_model import Reading, StaticModel
from tests.adapters.ccx_decks import MATERIAL, bar, plate
from tests.adapters.mystran_decks import bracket, frame
from tests.adapters.mystran_decks import plate as stepped_plate
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


def displacements(solver: Solver, found: Result, case: int, dofs: list[tuple[int, int]]) -> Floats:
    """By the stored matrices, at these degrees of freedom."""
    assert isinstance(found, MatrixResult)
    one = np.array([1.0])
    readings = [Reading("u", 0, np.array([n]), np.array([c]), one, 0.0, 1, 1) for n, c in dofs]
    load = solver.deck.load_case(case)
    model = StaticModel.of(found, solver.deck.observation, [load], readings, solver.deck.mesh())
    return model.values(parameter_matrices(found, np.zeros(0), (), ()), np.zeros(0))[0]


def own_tables(text: str, watched: list[int], folder: Path) -> list[dict[int, list[float]]]:
    """Displacements of nodes that ccx prints for each of its static steps, in turn."""
    folder.mkdir()
    asked = f"*NSET, NSET=SEEN\n{', '.join(map(str, watched))}\n"
    head, steps = text.split("*STEP", 1)
    steps = "*STEP" + steps.replace("*END STEP", "*NODE PRINT, NSET=SEEN, GLOBAL=YES\nU\n*END STEP")
    (folder / "own.inp").write_text(head + asked + steps)
    subprocess.run(["ccx", "own"], cwd=folder, check=True, capture_output=True)
    found = []
    tables = (folder / "own.dat").read_text().split("displacements (vx,vy,vz)")
    for table in tables[-text.count("*STATIC") :]:
        rows = [line.split() for line in table.splitlines()[1:]]
        found.append({int(row[0]): list(map(float, row[1:])) for row in rows if len(row) == 4})
    return found


@ccx
@pytest.mark.parametrize("name", DECKS)
def test_displacements_are_those_of_ccx_itself(name: str, tmp_path: Path) -> None:
    path = tmp_path / "model.inp"
    text = DECKS[name]
    path.write_text(text)
    solver = calculix_solver(path, ())
    watched = list(dict.fromkeys(sorted(solver.deck.load_case(1).nodes.tolist())))
    matrices = run(solver, {}, MatrixAnalysis(), tmp_path)
    for case, printed in enumerate(own_tables(text, watched, tmp_path / "own"), start=1):
        dofs = [(node, c) for node in printed for c in (1, 2, 3)]
        wanted = np.concatenate(list(printed.values()))
        found = displacements(solver, matrices, case, dofs)
        # ccx prints seven digits. At a corner of a quadratic shell it spreads a force over the
        # three expanded nodes as (-1/2, 2, -1/2), which strains the thickness otherwise.
        allowed = 5e-4 if name == "shells" else 2e-6
        np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=allowed * np.abs(wanted).max())


#: Steps after one of frequencies: body loads, and what presses on a face or a shell.
SPREAD = """*STEP
*FREQUENCY
4
*END STEP
*STEP
*STATIC
*DLOAD
{0}, GRAV, 9810., 1., -2., 3.
*END STEP
*STEP
*STATIC
*DLOAD, OP=NEW
{3}
*END STEP
*STEP
*STATIC
*CLOAD
{2}
*DLOAD, OP=NEW
{1}
*END STEP
*STEP
*STATIC
*DLOAD
{0}, GRAV, 9810., 0., 0., -1.
*END STEP
"""
SPUN = "V, CENTRIF, 2500., 1., 2., 3., 0., 1., 2."
CLAMPED = "*BOUNDARY\n{0},1,6\n5,1,6\n9,1,6\n"
BEAMS = (
    "*NODE\n1, 0., 0., 0.\n2, 10., 0., 0.\n3, 20., 0., 1.\n4, 30., 0., 2.\n5, 40., 0., 3.\n"
    "*ELEMENT, TYPE=B32, ELSET=B\n1, 1, 2, 3\n*ELEMENT, TYPE=B32, ELSET=C\n2, 3, 4, 5\n"
    f"{MATERIAL}*BEAM SECTION, ELSET=B, MATERIAL=A, SECTION=RECT\n2., 3.\n0., 1., 0.\n"
    "*BEAM SECTION, ELSET=C, MATERIAL=A, SECTION=CIRC\n2., 3.\n0., 1., 0.\n"
    "*ELEMENT, TYPE=MASS, ELSET=M\n401, 3\n*MASS, ELSET=M\n1e-6\n*ELSET, ELSET=X\nB, C, M\n"
    "*BOUNDARY\n1, 1, 6\n"
)
SPREAD_DECKS = {
    "bricks": (bar("C3D8I"), "V", "V, P4, 0.3\n1, P2, 2.", (13, 16)),
    "tetrahedra": (bar("C3D4"), "V", "1, P1, 0.3\n18, P4, 2.\n17, P2, 1.\n16, P3, 1.", (13, 16)),
    "quadratic tetrahedra": (bar("C3D10"), "V", "1, P1, .3\n18, P4, 2.\n17, P2, 1.", (13, 16)),
    "shells": (plate("S4", held=CLAMPED), "P", "P, P, 0.02", (4, 7, 12)),
    "quadratic shells": (plate("S8R"), "P", "1, P, 0.02\n2, P, 0.1", (9, 17, 29)),
    "triangles": (plate("S6"), "P", "P, P, 0.02", (9, 17, 35)),
    "laminate": (
        plate("S8R", section="*SHELL SECTION, ELSET=P, COMPOSITE\n.5,,A\n1.5,,A\n"),
        "P",
        "P, P, 0.02",
        (9, 17, 29),
    ),
    "beams with a mass": (BEAMS, "X", "M, CENTRIF, 2500., 0., 0., 0., 0., 0., 1.", (3, 5)),
}
#: Of the largest displacement. Solids agree to the digits that ccx prints. On shells and beams it
#: spreads forces over the thickness otherwise, and presses on a face; of quadratic tetrahedra it
#: integrates rotation by four points.
ALLOWED = {
    "quadratic tetrahedra": (2e-6, 5e-4, 2e-6, 2e-6),
    "shells": (2e-6, 2e-6, 1e-4, 1e-4),
    "quadratic shells": (5e-4,) * 4,
    "triangles": (5e-4,) * 4,
    "laminate": (5e-4,) * 4,
    "beams with a mass": (1e-3,) * 4,
}


@ccx
@pytest.mark.parametrize("name", SPREAD_DECKS)
def test_gravity_rotation_and_pressure_are_those_of_ccx_itself(name: str, tmp_path: Path) -> None:
    head, elements, pressed, seen = SPREAD_DECKS[name]
    more = SPUN if elements == "V" else f"{elements}, GRAV, 9810., 0., 1., 1."
    text = head + SPREAD.format(elements, pressed, f"{seen[-1]}, 3, 1.", more)
    path = tmp_path / "model.inp"
    path.write_text(text)
    solver = calculix_solver(path, ())
    allowed = ALLOWED.get(name, (2e-6,) * 4)
    matrices = run(solver, {}, MatrixAnalysis(), tmp_path)
    for case, printed in enumerate(own_tables(text, list(seen), tmp_path / "own"), start=1):
        dofs = [(node, c) for node in printed for c in (1, 2, 3)]
        wanted = np.concatenate(list(printed.values()))
        found = displacements(solver, matrices, case, dofs)
        atol = allowed[case - 1] * np.abs(wanted).max()
        np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=atol)


LOADS = """LOAD,7,2.,.5,8,-1.5,9
FORCE,8,6,1,100.,.3,1.,-.5
MOMENT,9,10,2,5.,1.,0.,2.
FORCE,9,16,,-40.,0.,0.,1.
"""


HELD = "SPC1,1,123,1,2,3,4,9,10\n"
MYSTRAN_DECKS = {
    "frame": (frame(), LOADS + "GRAV,8,1,9.81,1.,2.,-1.\n", 7, (5, 6, 10, 11, 16, 17)),
    "shells": (stepped_plate(), "GRAV,5,,9.81,0.2,0.,-1.\n", 5, (33, 44, 62, 71, 74)),
    "bricks": (
        bracket().replace("METHOD", "SPC = 1\nMETHOD").replace("ENDDATA", HELD + "ENDDATA"),
        "GRAV,3,,9.81,0.,1.,-1.\nFORCE,3,60,,-4.,0.,1.,1.\n",
        3,
        (28, 44, 60),
    ),
}


def own_displacements(
    solver: Solver, loads: str, number: int, nodes: tuple[int, ...], folder: Path
) -> tuple[list[tuple[int, int]], Floats]:
    """Degrees of freedom and their displacements by MYSTRAN's own static solution."""
    from pyNastran.op2.op2 import OP2

    own, job = folder / "own", folder / "job"
    own.mkdir()
    job.mkdir()
    solver.render({}, MatrixAnalysis()).write(job)
    (written,) = [file for file in job.iterdir() if "BEGIN BULK" in file.read_text()]
    head, cards = written.read_text().split("BEGIN BULK", 1)
    kept = "".join(f"{n} = {found[1]}\n" for n in ("SPC", "MPC")
                   if (found := re.search(rf"^ *{n} *= *(\d+)", head, re.MULTILINE)))  # fmt: skip
    asked = f"SOL 101\nCEND\n{kept}LOAD = {number}\nDISP(PLOT) = ALL\nBEGIN BULK\n"
    text = asked + "PARAM,POST,-1\n" + cards.replace("ENDDATA", loads + "ENDDATA")
    (own / "own.bdf").write_text(text)
    program = os.environ.get("MODETUNE_MYSTRAN", "mystran")
    subprocess.run([program, "own.bdf"], cwd=own, check=True, capture_output=True)
    op2 = OP2(debug=None)
    op2.read_op2(str(own / "own.OP2"))
    (table,) = op2.displacements.values()
    rows = {int(node): row for row, node in enumerate(table.node_gridtype[:, 0])}
    dofs = [(node, c) for node in nodes for c in range(1, 7)]
    return dofs, np.array([float(table.data[0, rows[node], c - 1]) for node, c in dofs])


@mystran
@pytest.mark.parametrize("name", MYSTRAN_DECKS)
def test_displacements_are_those_of_mystran_itself(name: str, tmp_path: Path) -> None:
    text, loads, number, nodes = MYSTRAN_DECKS[name]
    path = tmp_path / "model.bdf"
    path.write_text(text.replace("ENDDATA", loads + "ENDDATA"))
    solver = mystran_solver(path, ())
    dofs, expected = own_displacements(solver, loads, number, nodes, tmp_path)
    matrices = run(solver, {}, MatrixAnalysis(), tmp_path)
    kept = [place for place, dof in enumerate(dofs) if expected[place]]
    found = displacements(solver, matrices, number, [dofs[place] for place in kept])
    # Single precision in the OP2: 6e-8 of the largest, and the condition of the mounts.
    largest = np.abs(expected).max()
    print(np.abs(found - expected[kept]).max() / largest, found[:6], expected[kept][:6])
    np.testing.assert_allclose(found, expected[kept], rtol=1e-5, atol=1e-5 * largest)


def strip(n: int) -> str:
    """A cantilever of 1.0 x 0.2 x 0.01 along x, n x 2 shells; 1, 2, 3 at its root."""
    held, lines = "SPC1,1,123456,1,2,3\n", []
    for i in range(n + 1):
        lines += [f"GRID,{3 * i + j + 1},,{i / n:.6f},{0.1 * j:.6f},0." for j in range(3)]
    for i in range(n):
        for j in range(2):
            a = 3 * i + j + 1
            lines.append(f"CQUAD4,{2 * i + j + 1},1,{a},{a + 3},{a + 4},{a + 1}")
    return (
        "SOL 103\nCEND\nMETHOD=1\nSPC=1\nBEGIN BULK\nEIGRL,1,,,4\n" + "\n".join(lines)
        + f"\nPSHELL,1,1,.01,1,,1\nMAT1,1,2.+11,,0.,7800.\n{held}"
        f"SPC1,1,6,4,THRU,{3 * n + 3}\nENDDATA\n"
    )  # fmt: skip


@mystran
def test_pressure_on_shells_bends_a_strip_as_its_closed_form(tmp_path: Path) -> None:
    """w = p L^4 / 8 D. MYSTRAN adds moments to the forces at corners: 1 % lower with 5 shells along
    it, 0.12 with 10, 0.01 with 20; forces alone are 0.37, 0.21 and 0.10 % above."""
    path = tmp_path / "model.bdf"
    path.write_text(strip(10).replace("ENDDATA", "PLOAD2,5,100.,1,THRU,20\nENDDATA"))
    solver = mystran_solver(path, ())
    found = displacements(solver, run(solver, {}, MatrixAnalysis(), tmp_path), 5, [(32, 3)])
    assert found[0] == pytest.approx(100.0 / 8.0 / (2e11 * 0.01**3 / 12.0), rel=3e-3)


@pytest.mark.parametrize(
    ("card", "total"),
    [
        ("PLOAD2,5,100.,3", (0.0, 0.0, 1.0)),
        ("PLOAD2,5,100.,3,4,5", (0.0, 0.0, 3.0)),
        ("PLOAD4,5,3,100.,,,,THRU,6", (0.0, 0.0, 4.0)),
        ("PLOAD4,5,3,100.,,,,,,\n,0,3.,0.,-4.", (0.6, 0.0, -0.8)),
        ("PLOAD,5,100.,1,2,5,4", (0.0, 0.0, -1.0)),
        ("PLOAD,5,100.,1,4,5", (0.0, 0.0, 0.5)),
        ("LOAD,5,2.,3.,6\nPLOAD2,6,-10.,1", (0.0, 0.0, -0.6)),
    ],
)
def test_the_sum_of_a_pressure_is_pressure_times_area(
    card: str, total: tuple[float, float, float], tmp_path: Path
) -> None:
    path = tmp_path / "model.bdf"
    path.write_text(strip(10).replace("ENDDATA", card + "\nENDDATA"))
    load = mystran_solver(path, ()).deck.load_case(5)
    found = [load.values[load.components == c].sum() for c in (1, 2, 3)]
    np.testing.assert_allclose(found, total, atol=1e-12)  # each shell is 0.1 x 0.1


@pytest.mark.parametrize(
    ("card", "total"),
    [
        ("PLOAD4,5,1,100.,,,,1,4", (0.05, 0.0, 0.0)),  # on x = 0, 0.02 x 0.025
        ("PLOAD4,5,9,100.,,,,26,34", (0.0, 0.0, -0.06)),  # on top, 0.03 x 0.02
        ("PLOAD4,5,9,100.,,,,34,26\n,0,0.,2.,0.", (0.0, 0.06, 0.0)),
    ],
)
def test_pressure_on_a_brick_goes_into_the_face_that_its_corners_name(
    card: str, total: tuple[float, float, float], tmp_path: Path
) -> None:
    path = tmp_path / "model.bdf"
    path.write_text(bracket().replace("ENDDATA", card + "\nENDDATA"))
    load = mystran_solver(path, ()).deck.load_case(5)
    found = [load.values[load.components == c].sum() for c in (1, 2, 3)]
    np.testing.assert_allclose(found, total, atol=1e-15)
    assert np.unique(load.nodes).size == 4


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
    matrices = run(solver, {}, MatrixAnalysis(), tmp_path)
    found = displacements(solver, matrices, 3, [(11, 2)])
    assert load.values[0] * found[0] > 0.0
    second = 0.03 * 0.02**3 / 12, 0.02 * 0.03**3 / 12
    closed = [50.0 * 1.0**3 / (3 * 2e11 * i) for i in second]
    # Shear adds 3 EI / (L^2 k A G): below 0.3 % here.
    assert min(abs(abs(found[0]) / item - 1.0) for item in closed) < 0.01


REFUSED = {
    "*CLOAD\n13,3,1.\n*DLOAD\nEALL,P1,2.\n": r"line \d+: \*DLOAD needs an element or set",
    "*DLOAD\nV,P7,2.\n": r"line \d+: \*DLOAD needs .* P1 to P6 on solids",
    "*DLOAD\nV,P,2.\n": r"line \d+: P on element 1 \(C3D8I\); supported",
    "*DLOAD\nV,P1NU,2.\n": r"line \d+: \*DLOAD needs",
    "*DLOAD\nV,GRAV,9.81,0.,0.,0.\n": r"line \d+: GRAV has no direction",
    "*DLOAD\nV,GRAV,9.81,0.,0.,1.\n2,GRAV,1.,1.,0.,0.\n": r"line \d+: GRAV on element 2 is defined",
    "*DLOAD, AMPLITUDE=A\nV,P1,2.\n": r"line \d+: \*DLOAD with AMPLITUDE",
    "*DSLOAD\nS,P,2.\n": r"line \d+: \*DSLOAD in a step; load cases here are",
    "*CLOAD\n13,3,1.\n*BOUNDARY\n14,1,3,.1\n": r"line \d+: \*BOUNDARY in a step.*enforced",
    "*CLOAD\n99,3,1.\n": r"line \d+: \*CLOAD needs a node",
    "*CLOAD\n13,3,\n": r"line \d+: '' is not a number",
    "*CLOAD, AMPLITUDE=A\n13,3,1.\n": r"line \d+: \*CLOAD with AMPLITUDE",
    "": r"neither \*CLOAD nor \*DLOAD",
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


@pytest.mark.parametrize(
    ("card", "said"),
    [
        ("PLOAD4,5,3,1.,2.,1.,1.", r"line \d+: PLOAD4 that differs from corner to corner"),
        ("PLOAD2,5,1.,99", r"line \d+: PLOAD2 names element 99, which is not there"),
        ("PLOAD1,5,3,FZ,FR,0.,1.,1.,1.", r"line \d+: PLOAD1 of load set 5; load cases here are"),
        ("SPCD,5,33,3,.1", r"line \d+: SPCD of load set 5: enforced displacements are not"),
        ("LOAD,5,1.,1.,5", r"line \d+: LOAD 5 names itself"),
        ("PLOAD,5,1.,1,2,77", r"line \d+: PLOAD names a grid point that is not there: 77"),
        ("GRAV,5,9,9.81,0.,0.,1.", r"line \d+: GRAV names system 9, which is not there"),
    ],
)
def test_nastran_loads_that_are_not_supported_are_told(
    card: str, said: str, tmp_path: Path
) -> None:
    path = tmp_path / "model.bdf"
    path.write_text(strip(10).replace("ENDDATA", card + "\nENDDATA"))
    with pytest.raises(ModelError, match=said):
        mystran_solver(path, ()).deck.load_case(5)


def test_nastran_loads_that_are_not_there_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.bdf"
    path.write_text(frame().replace("ENDDATA", LOADS + "RFORCE,5,,,1.,0.,0.,-1.\nENDDATA"))
    deck = mystran_solver(path, ()).deck
    with pytest.raises(ModelError, match=r"no load set 4; it has 7, 8, 9"):
        deck.load_case(4)
    with pytest.raises(ModelError, match=r"line \d+: RFORCE of load set 5"):
        deck.load_case(5)
    path.write_text(frame().replace("ENDDATA", "FORCE,8,777,,1.,0.,0.,1.\nENDDATA"))
    with pytest.raises(ModelError, match=re.escape("FORCE names a grid point")):
        mystran_solver(path, ()).deck.load_case(8)
