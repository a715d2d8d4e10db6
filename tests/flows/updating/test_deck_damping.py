"""Damping of decks found through the command line, from tests of LAPACK on all equations."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import linalg

from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.test_files.universal.file import write_universal
from modetune.core.algebra.damped_modes import DampedSystem
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.measurement.measurement import MeasuredFrfs, Measurement
from modetune.core.modes import Floats
from tests.adapters.damped_decks import damped_system, measured, roots
from tests.adapters.solved import needs_ccx, needs_mystran
from tests.command_line import run_command


def sandwich() -> str:
    """A cantilever of two skins on a soft core with a loss factor of its own, held by a dashpot."""
    lines, elements = ["*NODE"], dict[str, list[str]](SKIN=[], CORE=[])

    def node(i: int, j: int, k: int) -> int:
        return 1 + i + 5 * (j + 2 * k)

    for k, z in enumerate((0.0, 0.002, 0.008, 0.01)):
        for j in range(2):
            lines += [f"{node(i, j, k)},{0.05 * i},{0.04 * j},{z}" for i in range(5)]
    lines.append("99,0.2,0.,-0.1")
    for k, name in enumerate(("SKIN", "CORE", "SKIN")):
        for i in range(4):
            low = [node(i, 0, k), node(i + 1, 0, k), node(i + 1, 1, k), node(i, 1, k)]
            corners = ",".join(str(n) for n in [*low, *(n + 10 for n in low)])
            elements[name].append(f"{4 * k + i + 1},{corners}")
    for name, rows in elements.items():
        lines += [f"*ELEMENT, TYPE=C3D8I, ELSET={name}", *rows]
    lines += ["*ELEMENT, TYPE=DASHPOTA, ELSET=STAY", f"50,{node(4, 0, 0)},99"]
    lines += ["*MATERIAL, NAME=ALU", "*ELASTIC", "7e10,0.3", "*DENSITY", "2700."]
    lines += ["*MATERIAL, NAME=GUM", "*ELASTIC", "2e8,0.4", "*DENSITY", "1100."]
    lines += ["*DAMPING, STRUCTURAL=0.2", "*SOLID SECTION, ELSET=SKIN, MATERIAL=ALU"]
    lines += ["*SOLID SECTION, ELSET=CORE, MATERIAL=GUM", "*DASHPOT, ELSET=STAY", "", "8."]
    held = [node(0, j, k) for j in range(2) for k in range(4)]
    lines += ["*BOUNDARY", *(f"{n},1,3" for n in (*held, 99))]
    return "\n".join([*lines, "*STEP", "*FREQUENCY", "6", "*END STEP", ""])


def plate() -> str:
    """A clamped plate of aluminium, part of it with a lossy coating that is a plate of its own."""
    lines = ["BEGIN BULK", "EIGRL,1,,,6"]
    for j in range(4):
        held = "123456" if j == 0 else ""
        lines += [f"GRID,{10 * j + i},,{0.1 * i},{0.12 * j},0.,,{held}" for i in range(4)]
    for j in range(3):
        for i in range(3):
            low = 10 * j + i
            own = 2 if j < 2 and i > 0 else 1
            lines.append(f"CQUAD4,{100 + low},{own},{low},{low + 1},{low + 11},{low + 10}")
    lines += ["PSHELL,1,1,.003,1,,1", "PSHELL,2,2,0.0045,2,,2"]
    lines += ["MAT1,1,7.+10,,0.3,2700.,,,0.002", "MAT1,2,4.+10,,0.33,2200.,,,0.05"]
    text = "\n".join([*lines, "CDAMP2,300,0.5,30,3,33,3", "ENDDATA", ""])
    return text.replace("GRID,0,", "GRID,40,").replace("CQUAD4,100,1,0,", "CQUAD4,100,1,40,")


def mast() -> str:
    """A mast whose first bending mode a tuned mass damper makes two heavily damped ones."""
    lines = ["BEGIN BULK", "EIGRL,1,,,6", "GRID,10,,0.,0.,0.,,123456"]
    lines += [f"GRID,{n},,0.,0.,{n}.,,246" for n in range(1, 9)]
    lines += ["GRID,9,,0.,0.,8.,,23456"]
    lines += [f"CBAR,{n},1,{n - 1 or 10},{n},0.,1.,0." for n in range(1, 9)]
    lines += ["PBAR,1,1,2.-3,4.-6,4.-6,8.-6", "MAT1,1,2.1+11,,0.3,7850.,,,0.01"]
    lines += ["CONM2,20,9,,1.5", "CELAS2,30,220.,8,1,9,1", "CDAMP2,31,4.,8,1,9,1", "ENDDATA", ""]
    return "\n".join(lines)


def machine() -> str:
    """A stiff frame with a heavy body on rubber mounts, bushes that stand slanting."""
    lines = ["BEGIN BULK", "EIGRL,1,,,8", "CORD2R,3,,0.,0.,0.,0.3,0.,1.", ",1.,0.,0."]
    for n, (x, y) in enumerate([(0.0, 0.0), (1.2, 0.0), (1.2, 0.7), (0.0, 0.7)], 1):
        lines += [f"GRID,{n},,{x},{y},0.", f"GRID,{10 + n},,{x},{y},0.,,123456"]
        lines += [f"CBUSH,{20 + n},{7 if n < 3 else 8},{n},{10 + n},,,,3"]
        lines += [f"CBAR,{n},1,{n},{n % 4 + 1},0.,0.,1."]
    lines += ["GRID,5,,0.5,0.3,0.2", "RBE2,40,5,123456,1,2,3,4", "CONM2,41,5,,80.,,,,"]
    lines += [",3.,,7.,,,8.", "PBAR,1,1,1.-3,1.-6,1.-6,2.-6", "MAT1,1,2.1+11,,0.3,7850."]
    lines += ["PBUSH,7,K,2.+5,2.+5,4.+5", ",,GE,0.15", "PBUSH,8,K,2.5+5,2.5+5,5.+5"]
    return "\n".join([*lines, ",,B,60.,60.,90.", "ENDDATA", ""])


CASES: dict[str, tuple[Any, Any, str, dict[str, str], dict[str, float], str, int]] = {
    "sandwich": (
        sandwich, calculix_solver, "inp",
        {"STRUCTURAL=0.2": "STRUCTURAL=0.26", "2e8,0.4": "2.4e8,0.4", "\n8.\n": "\n5.6\n"},
        {"gum": 1.3, "E": 1.2, "stay": 0.7},
        "{name: gum, quantity: structural_damping, material: GUM, bounds: [0.3, 3.0]}\n"
        "{name: E, quantity: youngs_modulus, material: GUM, bounds: [0.5, 2.0]}\n"
        "{name: stay, quantity: viscous_damping, elset: STAY, bounds: [0.3, 3.0]}", 4,
    ),
    "plate": (
        plate, mystran_solver, "bdf",
        {",0.05\n": ",0.062\n", "2,0.0045": "2,0.00495", "300,0.5": "300,0.4"},
        {"ge": 1.24, "t": 1.1, "c": 0.8},
        "{name: ge, quantity: structural_damping, material: 2, bounds: [0.3, 3.0]}\n"
        "{name: t, quantity: thickness, property: 2, bounds: [0.6, 1.5]}\n"
        "{name: c, quantity: viscous_damping, element: 300, bounds: [0.3, 3.0]}", 4,
    ),
    "mast": (
        mast, mystran_solver, "bdf",
        {"31,4.": "31,5.6", "30,220.": "30,242.", ",0.01\n": ",0.012\n"},
        {"b": 1.4, "k": 1.1, "ge": 1.2},
        "{name: b, quantity: viscous_damping, element: 31, bounds: [0.3, 3.0]}\n"
        "{name: k, quantity: spring_stiffness, element: 30, bounds: [0.5, 2.0]}\n"
        "{name: ge, quantity: structural_damping, material: 1, bounds: [0.3, 3.0]}", 3,
    ),
    "machine": (
        machine, mystran_solver, "bdf",
        {"GE,0.15": "GE,0.12", "B,60.,60.,90.": "B,72.,72.,108.",
         "2.5+5,2.5+5,5.+5": "3.+5,3.+5,6.+5"},
        {"ge": 0.8, "b": 1.2, "k": 1.2},
        "{name: ge, quantity: structural_damping, property: 7, bounds: [0.3, 3.0]}\n"
        "{name: b, quantity: viscous_damping, property: 8, bounds: [0.3, 3.0]}\n"
        "{name: k, quantity: spring_stiffness, property: 8, bounds: [0.5, 2.0]}", 6,
    ),
}  # fmt: skip


N_MATRICES = {"sandwich": 2, "plate": 9, "mast": 3, "machine": 2}


EACH = pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=needs_ccx if name == "sandwich" else needs_mystran)
        for name in CASES
    ],
)


def true_system(
    name: str, folder: Path, more: str = ""
) -> tuple[DampedSystem, MatrixResult, Floats]:
    """The truth's matrices and undamped frequencies [Hz]; the deck to update is in the folder.

    more: cards that the truth has instead of its changes.
    """
    written, solver_of, suffix, changes, _, _, n_modes = CASES[name]
    text = written()
    (folder / "true").mkdir()
    (folder / f"{name}.{suffix}").write_text(text)
    end = "*STEP" if suffix == "inp" else "ENDDATA"
    for old, new in ({end: more + end} if more else changes).items():
        assert old in text
        text = text.replace(old, new)
    (folder / "true" / f"deck.{suffix}").write_text(text)
    solver = solver_of(folder / "true" / f"deck.{suffix}", ())
    system, base = damped_system(solver, folder / "true")
    # Masses of few unknowns: 1 / w^2 is what is bounded.
    inverse = linalg.eigh(system.mass.toarray(), system.stiffness.toarray())[0][::-1]
    return system, base, 1.0 / (2.0 * np.pi * np.sqrt(inverse[:n_modes]))


def write_campaign(
    name: str, folder: Path, files: str, residuals: str, e1: float, parameters: str
) -> None:
    suffix = CASES[name][2]
    program = "calculix" if suffix == "inp" else "mystran"
    (folder / "campaign.yaml").write_text(
        f"name: {name}\nmodel: {{deck: {name}.{suffix}, solver: {program}, units: m-kg-s}}\n"
        f"test: {{modes: {files}}}\nparameters:\n"
        + "".join(f"  - {line}\n" for line in parameters.splitlines())
        + f"residuals:\n  {residuals}\nupdate: {{e1: {{frequency: {e1}}}, starts: 1}}\n"
    )


def updated(name: str, folder: Path, files: str, residuals: str, e1: float) -> Any:
    """What updating the deck told."""
    write_campaign(name, folder, files, residuals, e1, CASES[name][5])
    ended = run_command(folder, "update", "campaign.yaml", "--json", "--set", "report.page=false")
    assert ended.returncode == 0, ended.stderr + ended.stdout[:2000]
    return json.loads(ended.stdout)


def values_of(told: Any) -> dict[str, float]:
    return {item["name"]: item["updated"] for item in told["parameters"]}


@EACH
def test_dampers_of_a_deck_are_found_from_ratios(name: str, tmp_path: Path) -> None:
    truth, n_modes = CASES[name][4], CASES[name][6]
    system, _, hz = true_system(name, tmp_path)
    (tmp_path / "measured.csv").write_text(measured(roots(system, n_modes), hz))
    told = updated(
        name, tmp_path, "measured.csv", "damping: {deviation: 0.01, tolerance: 1.0e-4}", 1e-5
    )
    # e1 holds ratios to 1e-4 of themselves, which tell the parameters three to ten times worse.
    assert values_of(told) == pytest.approx(truth, rel=1e-3)
    # The model's own matrices, those at twice a modulus with a loss factor, and others' parts.
    assert told["solver_runs"]["sensitivity"] == N_MATRICES[name]


#: Where response functions are measured, the first one where the force is: node and component.
PLACES = {
    "sandwich": ((35, 3), (33, 3), (40, 3), (34, 2)),
    "plate": ((33, 3), (30, 3), (22, 3)),
    "mast": ((8, 1), (4, 1), (9, 1)),
    "machine": ((5, 1), (5, 2), (5, 3)),
}


@EACH
def test_dampers_of_a_deck_are_found_from_response_functions(name: str, tmp_path: Path) -> None:
    """The functions are those of full complex matrices; modes tell their order alone."""
    truth = CASES[name][4]
    write_functions(name, tmp_path)
    told = updated(
        name, tmp_path, "[measured.csv, lab.unv]", "frf: {deviation: 0.01, frac: 0.99999}", 1e-4
    )
    # A FRAC of 0.99999 lets H err by 0.3 %, of which dampers see a few times that.
    assert values_of(told) == pytest.approx(truth, rel=1e-2)


#: The parameter of each campaign whose truth has a mass more.
KNOWN = {
    "sandwich": "{name: E, quantity: youngs_modulus, material: ALU, bounds: [0.5, 2.0]}",
    "plate": "{name: t, quantity: thickness, property: 2, bounds: [0.6, 1.5]}",
    "mast": "{name: k, quantity: spring_stiffness, element: 30, bounds: [0.5, 2.0]}",
    "machine": "{name: k, quantity: spring_stiffness, property: 8, bounds: [0.5, 2.0]}",
}
#: A mass of the truth that the model lacks: its cards, node and size, kg.
MASSES = {
    "sandwich": ("*ELEMENT, TYPE=MASS, ELSET=MORE\n60, 38\n*MASS, ELSET=MORE\n0.01\n", 38, 0.01),
    "plate": ("CONM2,900,22,,0.1\n", 22, 0.1),
    "mast": ("CONM2,900,4,,9.\n", 4, 9.0),
    "machine": ("CONM2,900,3,,0.4\n", 3, 0.4),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param("mast", marks=needs_mystran),
        pytest.param("machine", marks=needs_mystran),
        pytest.param("sandwich", marks=[needs_ccx, pytest.mark.nightly]),
        pytest.param("plate", marks=[needs_mystran, pytest.mark.nightly]),
    ],
)
def test_a_mass_is_found_from_response_functions_of_a_damped_deck(
    name: str, tmp_path: Path
) -> None:
    """Dampers are as in the deck; the frequencies alone leave several places alike."""
    cards, node, mass = MASSES[name]
    write_functions(name, tmp_path, cards)
    write_campaign(
        name, tmp_path, "[measured.csv, lab.unv]", "frf: {deviation: 0.01}", 1e-4, KNOWN[name]
    )
    ended = run_command(tmp_path, "localise", "campaign.yaml", "--json", "--state", "initial")
    assert ended.returncode == 0, ended.stderr + ended.stdout[:2000]
    best = json.loads(ended.stdout)["proposals"]["changes"][0]
    assert (best["kind"], best["nodes"]) == ("point mass", [node])
    assert best["values"][0] == pytest.approx(mass, rel=4.0 * best["relative_errors"][0])


def write_functions(name: str, folder: Path, more: str = "") -> None:
    """Write measured.csv and lab.unv of the truth, with further cards (then nothing else)."""
    n_modes = CASES[name][6]
    system, base, hz = true_system(name, folder, more)
    (folder / "measured.csv").write_text(measured(roots(system, n_modes), hz))
    names = list(zip(base.nodes.tolist(), base.components.tolist(), strict=True))
    rows, n = [names.index(place) for place in PLACES[name]], len(PLACES[name])
    lines = np.linspace(0.6 * hz[0], 1.15 * hz[-1], 500)
    k, m, c, h = (
        part.toarray()
        for part in (system.stiffness, system.mass, system.viscous, system.structural)
    )
    struck = np.eye(len(names))[rows[0]]
    values = np.array(
        [-(w**2) * np.linalg.solve(k + 1j * (h + w * c) - w**2 * m, struck)[rows]
         for w in 2.0 * np.pi * lines]
    )  # fmt: skip
    (nodes, components), one = np.array(PLACES[name]).T, np.ones(n)
    frfs = MeasuredFrfs(
        "accelerance", lines, values, nodes, components, one,
        np.full(n, nodes[0]), np.full(n, components[0]), one, np.zeros((0, 0)),
    )  # fmt: skip
    write_universal(folder / "lab.unv", Measurement(frfs=frfs))
