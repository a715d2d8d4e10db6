"""Damping of decks: closed forms, other assemblies, and ccx's own steady-state dynamics."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import sparse

from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.nastran.solver import mystran_solver
from modetune.core.algebra.damped_modes import DampedSystem
from modetune.core.algebra.eigen import solve_modes
from modetune.core.parameters import Parameter
from tests.adapters.damped_decks import damped_system, ratios, roots
from tests.adapters.solved import needs_ccx, needs_mystran

#: Two bricks of other materials on each other, one with a loss factor, and a slanting dashpot.
STOOL = """*NODE, NSET=ALL
1,0,0,0
2,1,0,0
3,1,1,0
4,0,1,0
5,0,0,1
6,1,0,1
7,1,1,1
8,0,1,1
9,0,0,2
10,1,0,2
11,1,1,2
12,0,1,2
20,3,0,3
*ELEMENT, TYPE=C3D8I, ELSET=LEGS
1,1,2,3,4,5,6,7,8
*ELEMENT, TYPE=C3D8I, ELSET=SEAT
2,5,6,7,8,9,10,11,12
*ELEMENT, TYPE=DASHPOTA, ELSET=STRUT
3,10,20
*NSET, NSET=CORNER
10
*MATERIAL, NAME=RUBBER
*ELASTIC
1e4,0.3
*DENSITY
1.
*DAMPING, STRUCTURAL=0.03
*MATERIAL, NAME=WOOD
*ELASTIC
1e4,0.3
*DENSITY
1.2
*SOLID SECTION, ELSET=LEGS, MATERIAL=RUBBER
*SOLID SECTION, ELSET=SEAT, MATERIAL=WOOD
*DASHPOT, ELSET=STRUT

0.5
*BOUNDARY
1,1,3
2,1,3
3,1,3
4,1,3
20,1,3
*STEP
*FREQUENCY
6
*END STEP
"""
SWEEP = """*STEP
*STEADY STATE DYNAMICS
3.3,3.4,2,1.
*CLOAD
10,1,1.
*NODE FILE, NSET=CORNER
PU
*END STEP
"""


@needs_ccx
def test_loss_factor_and_dashpot_answer_as_ccx_does_in_steady_state(tmp_path: Path) -> None:
    (tmp_path / "stool.inp").write_text(STOOL)
    solver = calculix_solver(tmp_path / "stool.inp", ())
    system, base = damped_system(solver, tmp_path)
    sweep = STOOL.replace("*FREQUENCY", "*FREQUENCY, STORAGE=YES") + SWEEP
    (tmp_path / "sweep.inp").write_text(sweep)
    ran = subprocess.run(["ccx", "-i", "sweep"], cwd=tmp_path, capture_output=True, check=True)
    assert b"Job finished" in ran.stdout
    # ccx superposes the modes of its frequency step, so the same six are taken here.
    _, shapes = solve_modes(system.stiffness, system.mass, 6, shift=-1.0)
    seen = solver.deck.observation(base, np.array([10] * 3), np.array([1, 2, 3])).matrix
    force = shapes.T @ seen.T @ np.array([1.0, 0.0, 0.0])
    stiffness = shapes.T @ (system.complex_stiffness @ shapes)
    viscous = shapes.T @ (system.viscous @ shapes)
    blocks = (tmp_path / "sweep.frd").read_text().split("  100CL")[1:]
    swept = [block for block in blocks if "PDISP" in block]
    assert len(swept) == 3
    for block in swept:
        w = 2.0 * np.pi * float(block.split()[1])
        answer = seen @ shapes @ np.linalg.solve(stiffness + 1j * w * viscous - w**2 * np.eye(6),
                                                 force)  # fmt: skip
        row = next(line for line in block.splitlines() if line.startswith(" -1        10"))
        printed = np.array([float(word) for word in re.findall(r"[ -]\d\.\d{5}E[+-]\d\d", row)])
        theirs = printed[:3] * np.exp(1j * np.deg2rad(printed[3:]))
        # Six printed digits of magnitude and of degrees: 5e-6 of a turn's radians.
        np.testing.assert_allclose(answer, theirs, rtol=2e-5)


CANTILEVER = """BEGIN BULK
EIGRL,1,,,6
GRID,1,,0.,0.,0.,,123456
GRID,2,,0.3,0.1,0.
GRID,3,,0.6,0.2,0.
GRID,4,,0.9,0.3,0.
CBAR,1,1,1,2,0.,0.,1.
CBAR,2,1,2,3,0.,0.,1.
CBAR,3,1,3,4,0.,0.,1.
PBAR,1,1,1.-4,1.-9,2.-9,2.-9
MAT1,1,7.+10,,0.3,2700.{ge}
ENDDATA
"""


@needs_mystran
@pytest.mark.parametrize(
    ("ge", "more"),
    [(",,,0.08", ""), ("", "PARAM,G,0.08\n"), (",,,0.05", "PARAM,G,0.03\n")],
)
def test_every_mode_of_one_lossy_material_has_half_its_loss_factor(
    ge: str, more: str, tmp_path: Path
) -> None:
    deck = tmp_path / "arm.bdf"
    deck.write_text(CANTILEVER.format(ge=ge).replace("ENDDATA", f"{more}ENDDATA"))
    system, _ = damped_system(mystran_solver(deck, ()), tmp_path)
    # s^2 = -w^2 (1 + i g); K has 14 digits, and H is a difference of two of it.
    np.testing.assert_allclose(ratios(roots(system, 6)), np.sin(np.arctan(0.08) / 2.0), rtol=1e-9)


#: A box on a bush in slanting axes that acts beside it, and on scalar and line dampers.
BOX = """BEGIN BULK
EIGRL,1,,,6
CORD2R,5,,0.,0.,0.,0.3,-0.4,0.8
,1.,0.2,0.1
GRID,1,,0.,0.,0.
GRID,2,,0.,0.,-0.4,,123456
GRID,3,,0.5,0.7,0.2,,123456
CONM2,9,1,,3.,,,,
,0.04,,0.05,,,0.07
CBUSH,21,2,1,2,,,,5
,0.25
PBUSH,2,K,3000.,4000.,5000.,60.,70.,80.
,,B,2.,3.,4.,0.05,0.06,0.07
{ge}CDAMP2,31,1.5,1,2
CDAMP1,32,7,1,5,2,5
PDAMP,6,99.,7,0.02
CVISC,33,8,1,3
PVISC,8,2.5,0.03
CELAS2,34,900.,1,1,,,0.1
ENDDATA
"""


@needs_mystran
def test_a_box_on_all_kinds_of_dampers_is_the_one_assembled_by_hand(tmp_path: Path) -> None:
    deck = tmp_path / "box.bdf"
    deck.write_text(BOX.format(ge=",,GE,0.02,,0.04\n"))
    system, _ = damped_system(mystran_solver(deck, ()), tmp_path)
    z = np.array([0.3, -0.4, 0.8])
    z = z / np.linalg.norm(z)
    x = np.array([1.0, 0.2, 0.1])
    x = x - (x @ z) * z
    x = x / np.linalg.norm(x)
    axes = np.array([x, np.cross(z, x), z])
    arm = np.array([0.0, 0.0, -0.1])  # a quarter of the way to the grounded end
    rows = [np.concatenate([a, np.cross(arm, a)]) for a in axes]
    rows += [np.concatenate([np.zeros(3), a]) for a in axes]

    def sum_of(values: Any, *more: Any) -> Any:
        pairs = [*zip(values, rows, strict=True), *more]
        return sum(value * np.outer(row, row) for value, row in pairs)

    unit = np.eye(6)
    line = np.array([0.5, 0.7, 0.2])
    line = line / np.linalg.norm(line)
    springs = np.array([3000.0, 4000.0, 5000.0, 60.0, 70.0, 80.0])
    k = sum_of(springs, (900.0, unit[0]))
    c = sum_of(
        [2.0, 3.0, 4.0, 0.05, 0.06, 0.07], (1.5, unit[1]), (0.02, unit[4]),
        (2.5, np.concatenate([line, np.zeros(3)])), (0.03, np.concatenate([np.zeros(3), line])),
    )  # fmt: skip
    h = sum_of(springs * [0.02, 0.0, 0.04, 0.0, 0.0, 0.0], (90.0, unit[0]))
    m = np.diag([3.0, 3.0, 3.0, 0.04, 0.05, 0.07])
    wanted = DampedSystem(*(sparse.csr_array(item) for item in (k, m, c, h)))
    # 16 columns of a card hold ten digits of what MYSTRAN gets.
    np.testing.assert_allclose(roots(system, 6), roots(wanted, 6), rtol=1e-8)


@needs_mystran
def test_ge1_alone_is_of_all_directions_of_a_bush(tmp_path: Path) -> None:
    deck = tmp_path / "box.bdf"
    bush = BOX.format(ge=",,GE,0.06\n").replace(",0.1\nEND", ",0.06\nEND")
    kept = [line for line in bush.splitlines(True) if not re.match("CDAMP|CVISC|,,B", line)]
    deck.write_text("".join(kept))
    system, _ = damped_system(mystran_solver(deck, ()), tmp_path)
    np.testing.assert_allclose(ratios(roots(system, 6)), np.sin(np.arctan(0.06) / 2), rtol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (
            "*DAMPING, STRUCTURAL=0.03",
            "*DAMPING, ALPHA=3., BETA=1e-4",
            "line 28: ALPHA of *DAMPING",
        ),
        ("*DAMPING, STRUCTURAL=0.03", "*DAMPING, STRUCTURAL=O.03", "line 28: STRUCTURAL"),
        ("*DASHPOT, ELSET=STRUT\n\n0.5", "*DASHPOT, ELSET=STRUT\n0.5", "requires a blank line"),
        ("20,3,0,3", "20,1,0,2", "the nodes of dashpot 3 coincide"),
    ],
)
def test_what_a_calculix_deck_has_wrong_is_told_with_its_line(
    old: str, new: str, said: str, tmp_path: Path
) -> None:
    (tmp_path / "stool.inp").write_text(STOOL.replace(old, new))
    assert said in calculix_solver(tmp_path / "stool.inp", ()).deck.undamped()


def test_an_updated_deck_differs_in_the_dampers_numbers_alone(tmp_path: Path) -> None:
    (tmp_path / "stool.inp").write_text(STOOL)
    given = (
        Parameter("g", "structural_damping", "material", ("RUBBER",), 0.1, 9.0, 0.2),
        Parameter("c", "viscous_damping", "elset", ("STRUT",), 0.1, 9.0, 0.2),
    )
    deck = calculix_solver(tmp_path / "stool.inp", given).deck
    written = deck.write_updated({"g": 2.0, "c": 3.0}, tmp_path / "new").read_text()
    changed = STOOL.replace("STRUCTURAL=0.03", "STRUCTURAL=0.06").replace("\n0.5\n", "\n1.5\n")
    assert written == changed
    assert deck.edited({"g": 2.0, "c": 3.0}).texts() == deck.edited({}).texts()
