"""Static deflections beside frequencies: what one kind alone cannot tell apart; run by ccx."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.solver import ModalAnalysis
from modetune.core.updating.job_results import ModalResult
from tests.adapters.ccx_decks import MATERIAL, bar
from tests.adapters.test_solver_contract import run
from tests.command_line import run_command

pytestmark = pytest.mark.skipif(shutil.which("ccx") is None, reason="ccx is not installed")

#: Of modulus and density, relative.
TRUTH = 1.12, 0.9
STEPS = """*STEP
*STATIC
*CLOAD
21,3,-60.
22,3,-60.
*NODE PRINT, NSET=SEEN
U
*END STEP
*STEP
*STATIC
*CLOAD, OP=NEW
*DLOAD
V, GRAV, 9810., 0., 0., -1.
5, P2, 0.1
*NODE PRINT, NSET=SEEN
U
*END STEP
*STEP
*FREQUENCY
6
*END STEP
"""
CAMPAIGN = """name: cantilever
model: {deck: bar.inp, solver: calculix, units: mm-t-s}
test: {modes: measured.csv}
parameters:
  - {name: E, quantity: youngs_modulus, material: A, bounds: [0.5, 2.0]}
  - {name: rho, quantity: density, material: A, bounds: [0.5, 2.0]}
residuals:
  shape_weight: 0.0
%s
update: {e1: {frequency: 1.0e-4}, starts: 1}
"""
STATIC = """  static:
    cases:
      - load: 1
        displacements: {21.z: %g, 13.z: %g}
        strains: {"2-6": %.7g}
        deviation: 0.002
        tolerance: 0.001
"""
WEIGHT = """      - load: 2
        displacements: {21.z: %.7g, 13.z: %.7g}
        tolerance: 0.0001
"""


def deck(modulus: float = 1.0, density: float = 1.0) -> str:
    """A clamped bar of five bricks, 50 x 10 x 8."""
    material = (
        f"*MATERIAL, NAME=A\n*ELASTIC\n{70000 * modulus}, 0.3\n*DENSITY\n{2.7e-9 * density}\n"
    )
    held = "*BOUNDARY\n1,1,3\n2,1,3\n3,1,3\n4,1,3\n"
    text = bar("C3D8I", bricks=5, held=held)
    assert MATERIAL in text
    return text.replace(MATERIAL, material) + "*NSET, NSET=SEEN\n2, 6, 13, 21\n" + STEPS


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str, str]:
    """Frequencies and static readings of the truth, by ccx itself: a test file, and sections of a
    case of forces and of one of weight and pressure."""
    folder = tmp_path_factory.mktemp("truth")
    (folder / "own.inp").write_text(deck(*TRUTH))
    subprocess.run(["ccx", "own"], cwd=folder, check=True, capture_output=True)
    printed = (folder / "own.dat").read_text()
    first, second = printed.split("E I G")[0].split("displacements (vx,vy,vz)")[1:3]
    moved, sunk = (
        {
            int(row[0]): [float(word) for word in row[1:]]
            for row in map(str.split, table.splitlines())
            if len(row) == 4 and row[0].isdecimal()
        }
        for table in (first, second)
    )
    rows = [line.split() for line in printed.split("E I G E N V A L U E")[1].splitlines()]
    hz = [row[3] for row in rows if len(row) == 5 and row[0].isdecimal()][:3]
    test = f"mode, {', '.join(str(n + 1) for n in range(3))}\nfrequency_hz, {', '.join(hz)}\n"
    strain = (moved[6][0] - moved[2][0]) / 10.0  # nodes 10 mm apart along x
    weight = WEIGHT % (sunk[21][2], sunk[13][2])
    return test, STATIC % (moved[21][2], moved[13][2], strain), weight


def campaign(folder: Path, test: str, residuals: str) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "bar.inp").write_text(deck())
    (folder / "measured.csv").write_text(test)
    path = folder / "campaign.yaml"
    path.write_text(CAMPAIGN % residuals)
    return path


def test_both_kinds_tell_modulus_and_density(
    tmp_path: Path, measured: tuple[str, str, str]
) -> None:
    path = campaign(tmp_path, *measured[:2])
    ended = run_command(tmp_path, "update", str(path), "--json", "--set", "report.page=false")
    told = json.loads(ended.stdout)
    assert ended.returncode == 0, ended.stderr
    assert told["status"] == "converged"
    # e1 of 1e-4 in frequency and 1e-3 of the deflection bound both to some 1e-3.
    updated = [item["updated"] for item in told["parameters"]]
    assert updated == pytest.approx(TRUTH, rel=2e-3)
    errors = [item["standard_error"] for item in told["parameters"]]
    assert max(errors) < 0.02


def test_its_own_weight_tells_the_density_where_frequencies_do_not_count(
    tmp_path: Path, measured: tuple[str, str, str]
) -> None:
    path = campaign(tmp_path, measured[0], measured[1] + measured[2])
    off = ("--set", "residuals.frequency_weight=0", "--set", "report.page=false")
    ended = run_command(tmp_path, "update", str(path), "--json", *off)
    assert ended.returncode == 0, ended.stderr
    updated = [item["updated"] for item in json.loads(ended.stdout)["parameters"]]
    # e1 of 1e-3 and 1e-4 of the largest deflections.
    assert updated == pytest.approx(TRUTH, rel=1e-3)


def test_loads_that_the_deck_has_not_are_told_with_file_and_line(
    tmp_path: Path, measured: tuple[str, str, str]
) -> None:
    wrong = STATIC.replace("load: 1", "load: 4").replace("13.z", "999.z").replace("2-6", "2-2") % (
        -0.1,
        -0.1,
        1e-5,
    )
    path = campaign(tmp_path, measured[0], wrong)
    ended = run_command(tmp_path, "update", str(path))
    assert ended.returncode == 2
    lines = path.read_text().splitlines()
    for text, word in (
        ("no load case 4; it has 2 *STATIC steps", "load: 4"),
        ("the model has no node 999", "999.z"),
        ("'2-2' is not two nodes", "2-2"),
    ):
        line = 1 + next(n for n, own in enumerate(lines) if word in own)
        found = re.search(rf"campaign\.yaml, line {line}: .*", ended.stderr)
        assert text in " ".join(ended.stderr.split()), ended.stderr
        assert found, (line, ended.stderr)


def nastran_bar(modulus: float, density: float) -> str:
    grids = "".join(f"GRID,{k + 1},,{0.1 * k:.1f},0.,0.\n" for k in range(11))
    bars = "".join(f"CBAR,{k},1,{k},{k + 1},0.,0.,1.\n" for k in range(1, 11))
    return (
        "SOL 103\nCEND\nMETHOD=1\nSPC=1\nBEGIN BULK\nEIGRL,1,,,6\n"
        f"{grids}{bars}PBAR,1,1,6.-4,4.5-8,2.-8,5.-8\nMAT1,1,{modulus:.4f}+11,,.3,{density}\n"
        "SPC1,1,123456,1\nFORCE,3,11,,50.,0.,0.,-1.\nMOMENT,3,11,,4.,0.,1.,0.\nENDDATA\n"
    )


@pytest.mark.skipif(not shutil.which("mystran"), reason="MYSTRAN is not installed")
def test_forces_and_moments_of_a_load_set_on_mystran(tmp_path: Path) -> None:
    """A cantilever without shear: readings are closed forms, frequencies MYSTRAN's own."""
    (tmp_path / "truth.bdf").write_text(nastran_bar(2.2, 7000.0))
    solver = mystran_solver(tmp_path / "truth.bdf", ())
    modal = run(solver, {}, ModalAnalysis(6, (11,)), tmp_path)
    assert isinstance(modal, ModalResult)
    hz = ", ".join(f"{value:.8g}" for value in modal.elastic.frequencies_hz[:3])
    (tmp_path / "measured.csv").write_text(f"mode, 1, 2, 3\nfrequency_hz, {hz}\n")
    (tmp_path / "bar.bdf").write_text(nastran_bar(2.0, 7800.0))
    bending, force, moment = 2.2e11 * 4.5e-8, 50.0, 4.0
    # w = F L^3 / 3 EI + M L^2 / 2 EI downwards, and the rotation about y, with L = 1 m.
    down = force / (3.0 * bending) + moment / (2.0 * bending)
    turn = force / (2.0 * bending) + moment / bending
    section = (
        "  static:\n    cases:\n"
        f"      - {{load: 3, displacements: {{11.z: {-down:.8g}}}, tolerance: 0.001}}\n"
        f"      - {{load: 3, displacements: {{11.ry: {turn:.8g}}}, tolerance: 0.001}}\n"
    )
    text = (CAMPAIGN % section).replace("bar.inp, solver: calculix, units: mm-t-s", "bar.bdf, "
        "solver: mystran, units: m-kg-s").replace("material: A", "material: 1")  # fmt: skip
    (tmp_path / "campaign.yaml").write_text(text)
    ended = run_command(tmp_path, "update", "campaign.yaml", "--json", "--set", "report.page=false")
    assert ended.returncode == 0, ended.stderr
    updated = [item["updated"] for item in json.loads(ended.stdout)["parameters"]]
    assert updated == pytest.approx([1.1, 7000.0 / 7800.0], rel=2e-3)
