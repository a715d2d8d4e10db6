"""`solver: command` on programs that are here: a shaft of discs in Python, ccx, MYSTRAN.

The last two have adapters of their own, which the same deck on the command line must equal.
"""

from __future__ import annotations

import os
import shutil
import sys
import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.command.settings import CommandSettings, NumberRule
from modetune.adapters.command.solver import command_solver
from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.process import run_process
from modetune.adapters.solver import ModalAnalysis, Solver
from modetune.core.errors import (
    ModelError,
    NoResult,
    SolverCrashed,
    SolverMissing,
    SolverRejected,
)
from modetune.core.parameters import Parameter, Quantity, ValueKind, counted_from
from modetune.core.storage.keys import canonical_json
from modetune.core.updating.job_results import ModalResult
from tests.shaft_line import DECK, shaft_frequencies, write_shaft

SHAFT = CommandSettings(
    "shaft",
    ("{python}", "{folder}/../shaft.py", "{deck}"),
    ("{python}", "-c", "print('shaft solver, version 2.5.1 of May')"),
    "nodes.csv",
    results="twist.csv",
    components=(4,),
    most_modes=6,
    success=("^END OF SHAFT",),
    fatal=(r"\bE-\d{4}\b",),
)
MYSTRAN = shutil.which(os.environ.get("MODETUNE_MYSTRAN", "mystran"))


def number(name: str, quantity: Quantity = "number") -> Parameter:
    return Parameter(name, quantity, "placeholder", (name,), 0.1, 10.0, 0.2)


PARAMETERS = tuple(map(number, ("k_engine", "k_shaft", "propeller")))


def solved(
    solver: Solver, values: Mapping[str, float], analysis: ModalAnalysis, job: Path
) -> ModalResult:
    job.mkdir()
    solver.render(values, analysis).write(job)
    finished = run_process(solver.program.command(1), job, 120.0, threading.Event())
    result = solver.read(values, analysis, job, finished.return_code)
    assert isinstance(result, ModalResult)
    return result


def shaft(folder: Path, deck: str = DECK, **changes: Any) -> Solver:
    return command_solver(write_shaft(folder, deck), PARAMETERS, replace(SHAFT, **changes))


def test_the_modes_are_those_of_the_program_at_the_values(tmp_path: Path) -> None:
    solver = shaft(tmp_path)
    assert solver.program.version() == "2.5.1"
    values = {"k_engine": 1.3, "propeller": 0.8}
    result = solved(solver, values, ModalAnalysis(4, (2, 6)), tmp_path / "job")
    expected = shaft_frequencies(**values)[:4]
    # The deck holds ten digits of stiffnesses and four decimals of the propeller.
    np.testing.assert_allclose(result.modes.frequencies_hz, expected, rtol=1e-6)
    assert result.modes.nodes.tolist() == [2, 6]
    assert result.modes.components.tolist() == [4, 4]
    assert result.n_rigid == 0
    assert np.isnan(result.mass)


def test_a_deck_with_fewer_modes_than_asked_for_says_so(tmp_path: Path) -> None:
    analysis = ModalAnalysis(9, (1,))
    result = solved(shaft(tmp_path), {}, analysis, tmp_path / "job")
    assert result.modes.n_modes == 6  # most_modes
    with pytest.raises(SolverRejected, match=r"holds 6 modes where 9 were asked for; write \{n_m"):
        solved(shaft(tmp_path, most_modes=0), {}, analysis, tmp_path / "more")


def test_the_written_value_is_what_the_deck_holds(tmp_path: Path) -> None:
    deck = shaft(tmp_path).deck
    assert deck.deck_value(PARAMETERS[2]) == 150.0
    assert deck.written(PARAMETERS[2], 1.0 / 7.0) == 21.4286 / 150.0
    assert deck.written(PARAMETERS[2], 1.0000001) == 1.0  # below the four decimals


def test_an_updated_template_runs_to_the_same_modes_and_so_does_the_filled_deck(
    tmp_path: Path,
) -> None:
    solver = shaft(tmp_path)
    values = {"k_shaft": 1.7, "propeller": 0.6}
    updated = solver.deck.write_updated(values, tmp_path / "updated")
    job = solved(solver, values, ModalAnalysis(4, (1,)), tmp_path / "job")
    again = solved(
        shaft(tmp_path, updated.read_text()), {}, ModalAnalysis(4, (1,)), tmp_path / "again"
    )
    np.testing.assert_array_equal(again.eigenvalues, job.eigenvalues)
    filled = (tmp_path / "updated" / "filled" / "shaft.txt").read_text()
    assert filled == (tmp_path / "job" / "shaft.txt").read_text().replace("modes 4", "modes 10")


def test_keys_hold_deck_command_versions_and_reader_and_nothing_else(tmp_path: Path) -> None:
    def key(folder: str = "a", deck: str = DECK, n_modes: int = 4, **changes: Any) -> str:
        (tmp_path / folder).mkdir(exist_ok=True)
        solver = shaft(tmp_path / folder, deck, **changes)
        return canonical_json(solver.render({}, ModalAnalysis(n_modes, (1,))).content)

    (tmp_path / "own.py").write_text("def modes(folder):\n    return [], [], [], []\n")
    reader = f"{tmp_path}/own.py:modes"
    known = key(reader=reader)
    assert key("b", reader=reader) == known  # another folder
    assert key("b", reader=reader, success=(), logs=("*.log",)) == known  # judging gives no numbers
    others = [
        key(reader=reader, deck=DECK.replace("240.", "241.")),
        key(reader=reader, run=("{python}", "shaft.py", "{deck}")),
        key(reader=reader, version="2.5.2"),
        key(reader=reader, n_modes=5),
        key(reader=reader, normalisation="max"),
        key(),
    ]
    (tmp_path / "own.py").write_text("def modes(folder):\n    return [], [], [], []  # other\n")
    others.append(key(reader=reader))
    assert len({known, *others}) == 8


# The program


def test_a_changed_script_module_or_variable_makes_another_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script, module = tmp_path / "solve.py", tmp_path / "rules" / "steel.py"
    module.parent.mkdir()
    script.write_text("import rules.steel\n")
    module.write_text("E = 1\n")
    monkeypatch.delenv("SHAFT_RULES", raising=False)

    def key() -> str:
        run = ("{python}", str(script), "{deck}")
        solver = shaft(tmp_path, run=run, depends=("rules",), environment=("SHAFT_RULES",))
        return canonical_json(solver.render({}, ModalAnalysis(2, (1,))).content)

    keys = [key(), key()]
    script.write_text("import rules.steel  # corrected\n")
    keys.append(key())
    module.write_text("E = 2\n")
    keys.append(key())
    monkeypatch.setenv("SHAFT_RULES", "DNV")
    keys.append(key())
    (module.parent / "__pycache__").mkdir()
    (module.parent / "__pycache__" / "steel.pyc").write_bytes(b"1")
    keys.append(key())
    assert [keys.index(each) for each in keys] == [0, 0, 2, 3, 4, 4]
    assert "DNV" not in keys[-1]


def test_a_file_of_depends_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"`depends` under `model\.command` names lost\.py"):
        shaft(tmp_path, depends=("lost.py",))


def test_a_run_is_judged_by_its_words_and_code(tmp_path: Path) -> None:
    analysis = ModalAnalysis(4, (1,))
    refused = DECK.replace("shaft line", "refuse this")
    with pytest.raises(SolverRejected, match=r"(?s)shaft refused .*solver.log.*E-1001 unknown"):
        solved(shaft(tmp_path, refused), {}, analysis, tmp_path / "refused")
    with pytest.raises(SolverCrashed, match=r"with code 0 and without `HAPPY END`"):
        solved(shaft(tmp_path, success=("HAPPY END",)), {}, analysis, tmp_path / "unhappy")
    coded = shaft(tmp_path, exit_codes=(8,))  # as a program that ends so after a good run
    with pytest.raises(SolverCrashed, match="with code 0"):
        solved(coded, {}, analysis, tmp_path / "code")
    coded.read({}, analysis, tmp_path / "code", 8)
    silent = DECK.replace("shaft line", "silent")
    with pytest.raises(
        NoResult, match=r"left no twist\.csv in .*there is: shaft\.txt, solver\.log"
    ):
        solved(shaft(tmp_path, silent), {}, analysis, tmp_path / "silent")


def test_nodes_and_motions_that_results_lack_are_named(tmp_path: Path) -> None:
    with pytest.raises(SolverRejected, match=r"no shape at 1\.x, 1\.y .*`components`"):
        solved(shaft(tmp_path, components=(1, 2, 4)), {}, ModalAnalysis(4, (1,)), tmp_path / "job")
    write_shaft(tmp_path)
    (tmp_path / "seven.csv").write_text((tmp_path / "nodes.csv").read_text() + "7,20,0,0\n")
    solver = shaft(tmp_path, nodes="seven.csv")
    assert 7 in solver.deck.summary.node_ids
    with pytest.raises(SolverRejected, match=r"no shape at 7\.rx \(1 of 2 .* 6 are there\)"):
        solved(solver, {}, ModalAnalysis(4, (1, 7)), tmp_path / "seven")


def test_a_damaged_table_is_told_with_its_line(tmp_path: Path) -> None:
    solver, analysis = shaft(tmp_path), ModalAnalysis(4, (1,))
    solved(solver, {}, analysis, tmp_path / "job")
    table = tmp_path / "job" / "twist.csv"
    table.write_text(table.read_text().replace("3.rx", "3.twist"))
    with pytest.raises(NoResult, match=r"twist\.csv, line 5: row `3\.twist`"):
        solver.read({}, analysis, tmp_path / "job", 0)


def test_a_program_that_is_not_there_or_tells_no_version(tmp_path: Path) -> None:
    missing = shaft(tmp_path, version=("no-such-solver", "-v"))
    with pytest.raises(SolverMissing, match="there is no such program"):
        missing.program.version()
    dumb = shaft(tmp_path, version=("{python}", "-c", "import sys; sys.exit('who?')"))
    with pytest.raises(SolverMissing, match=r"ended with code 1 and told no version of shaft.*who"):
        dumb.program.version()
    assert shaft(tmp_path, version="R14x").program.version() == "R14x"


def test_arguments_hold_cores_folder_and_names(tmp_path: Path) -> None:
    solver = shaft(tmp_path, run=("p", "{job}.out", "cpus={cores}", "-d", "{folder}", "{deck}"))
    command = solver.program.command(3).started_in(tmp_path)
    assert command.arguments == ("p", "shaft.out", "cpus=3", "-d", str(tmp_path), "shaft.txt")
    assert dict(command.environment) == {"OMP_NUM_THREADS": "3"}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"run": ("{python}", "{inptu}")}, r"has \{inptu\} in a command line; there are \{deck\}"),
        ({"fatal": ("(",)}, r"`\(` under `model.command` is not a pattern"),
        ({"nodes": "no.csv"}, r"no\.csv cannot be read.*`nodes` under `model\.command`"),
        ({"nodes": "shaft.txt"}, r"shaft\.txt"),
        ({"inputs": ("mesh.inc",)}, r"mesh\.inc cannot be read"),
        ({"reader": "modes"}, r"`reader` under `model.command` is `file\.py:function`"),
        ({"reader": "no_such_package.x:modes"}, "cannot be imported: ModuleNotFoundError"),
        ({"reader": "bad.py:modes"}, r"bad\.py, line 2: .*cannot be imported: SyntaxError"),
        ({"reader": "raises.py:modes"}, r"raises\.py, line 3: .*imported: ZeroDivisionError"),
        ({"reader": "good.py:mode"}, "names mode, which is not a function there; there are: modes"),
        ({"reader": "sys:exit"}, "must stand in a file of Python"),
    ],
)
def test_what_cannot_be_is_told_before_anything_runs(
    tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    (tmp_path / "bad.py").write_text("def modes(folder):\n    return [\n")
    (tmp_path / "raises.py").write_text("a = 1\nb = 0\nc = a / b\n")
    (tmp_path / "good.py").write_text("def modes(folder):\n    return [], [], [], []\n")
    with pytest.raises(ModelError, match=said):
        shaft(tmp_path, **changes)
    assert not (tmp_path / "runs.log").exists()


def test_parameters_and_placeholders_must_meet(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    deck = shaft(tmp_path).deck
    said = deck.problems((*PARAMETERS, number("k_gear")))
    assert len(said) == 1
    assert "shaft.txt: k_gear does not occur; write a placeholder" in said[0]
    assert "(there are: k_engine, k_shaft, propeller)" in said[0]
    assert deck.problems(PARAMETERS) == []
    with caplog.at_level("WARNING"):
        command_solver(write_shaft(tmp_path), PARAMETERS[:2], SHAFT)
    assert "line 3: propeller is no parameter of the campaign, and keeps its value 150" in (
        caplog.text
    )


def test_a_number_that_is_zero_is_found_by_values_of_its_own(tmp_path: Path) -> None:
    """The governor's spring is missing in the deck: no factor finds it, its own number does."""
    text = DECK.replace("k_engine=4.0E+6", "k_engine=0.0")
    factor, k = number("k_engine"), 2.5e6
    deck = command_solver(write_shaft(tmp_path, text), (factor,), SHAFT).deck
    (said,) = deck.problems((factor,))
    assert said == (
        f"parameter k_engine: {tmp_path / 'shaft.txt'}, line 2: number is zero, which no factor "
        "changes; give the parameter `values: absolute` or `additive`, with bounds and a deviation"
    )
    kinds: tuple[ValueKind, ...] = ("absolute", "additive")
    for kind in kinds:
        origin, scale = counted_from(kind, 0.0, 0.0, 1e6)
        own = replace(factor, values=kind, origin=origin, scale=scale, lower=1.0, upper=2.0)
        solver = command_solver(write_shaft(tmp_path, text), (own,), SHAFT)
        assert solver.deck.problems((own,)) == []
        value = own.counted(k)
        found = solved(solver, {"k_engine": value}, ModalAnalysis(5, (1,)), tmp_path / kind)
        expected = shaft_frequencies(k_engine=k / 4.0e6)[:5]
        np.testing.assert_allclose(found.modes.frequencies_hz, expected, rtol=1e-8)
        assert solver.deck.written(own, value) == pytest.approx(value)
        updated = solver.deck.write_updated({"k_engine": value}, tmp_path / f"{kind}_updated")
        assert "{k_engine=2.500000000E+06:.9E}" in updated.read_text()


# A reader of the user's

#: A free bar of ten rods, as a program of a few lines that leaves a NumPy file.
BAR = """import numpy as np, sys
E, RHO, L, N = {E=7.0E10}, 2700.0, 1.0, 40
k, m = E * N / L, RHO * L / N
K, M = np.zeros((N + 1, N + 1)), np.zeros((N + 1, N + 1))
for i in range(N):
    K[i : i + 2, i : i + 2] += k * np.array([[1.0, -1.0], [-1.0, 1.0]])
    M[i : i + 2, i : i + 2] += m / 6.0 * np.array([[2.0, 1.0], [1.0, 2.0]])
C = np.linalg.inv(np.linalg.cholesky(M))
values, vectors = np.linalg.eigh(C @ K @ C.T)
np.savez("bar.npz", values=values[:{n_modes}], shapes=(C.T @ vectors)[:, :{n_modes}])
"""
READER = """import numpy as np

def modes(folder):
    with np.load(folder / "bar.npz") as file:
        hertz = np.sqrt(np.maximum(file["values"], 0.0)) / (2.0 * np.pi)
        nodes = np.arange(1, len(file["shapes"]) + 1)
        return hertz, file["shapes"], nodes, np.ones_like(nodes)
"""


def free_bar(folder: Path, reader: str = READER) -> Solver:
    (folder / "bar.txt").write_text(BAR)
    (folder / "read_bar.py").write_text(reader)
    places = (f"{node},{0.025 * (node - 1)},0,0" for node in range(1, 42))
    (folder / "nodes.csv").write_text("node,x,y,z\n" + "\n".join(places) + "\n")
    settings = CommandSettings(
        "bar", ("{python}", "{deck}"), "1", "nodes.csv", reader="read_bar.py:modes", components=(1,)
    )
    return command_solver(folder / "bar.txt", (number("E", "youngs_modulus"),), settings)


def test_a_reader_of_the_user_s_gives_the_modes_of_a_free_bar(tmp_path: Path) -> None:
    analysis = ModalAnalysis(4, (1, 41))
    result = solved(free_bar(tmp_path), {"E": 1.21}, analysis, tmp_path / "job")
    # j c / 2 L with c = sqrt(E / rho), the first one rigid; 40 elements are j^2 2.6e-4 too stiff.
    exact = np.arange(1, 4) * 1.1 * (7.0e10 / 2700.0) ** 0.5 / 2.0
    np.testing.assert_allclose(result.modes.frequencies_hz[1:], exact, rtol=3e-3)
    # Both ends of a free bar move by sqrt(2 / m) in each elastic mode.
    np.testing.assert_allclose(
        np.abs(result.modes.mode_shapes[:, 1:]), (2 / 2700) ** 0.5, rtol=1e-2
    )


@pytest.mark.parametrize(
    ("reader", "said"),
    [
        (
            "def modes(folder):\n    return open(folder / 'none')\n",
            r"read_bar\.py, line 2: .*File",
        ),
        ("def modes(folder):\n    return 1\n", "it must give .frequencies_hz, mode_shapes"),
        ("def modes(folder):\n    return [1.0], [[1.0]], [1, 2], [1, 1]\n", "does not fit"),
    ],
)
def test_a_reader_that_fails_is_named_with_its_line(tmp_path: Path, reader: str, said: str) -> None:
    with pytest.raises(SolverRejected, match=said):
        solved(free_bar(tmp_path, reader), {}, ModalAnalysis(2, (1,)), tmp_path / "job")


# Programs that have adapters too


def fork(folder: Path) -> Path:
    """A tuning fork cut from sheet, 3 mm thick: two tines and a stem of S4, held at its foot."""
    cells = [(i, j) for j in range(14) for i in range(5) if i in (0, 4) or j in (4, 5)]
    cells = [(i, j) for i, j in cells if j >= 4] + [(2, j) for j in range(4)]
    corners = {(i + a, j + b) for i, j in cells for a in (0, 1) for b in (0, 1)}
    numbers = {corner: n for n, corner in enumerate(sorted(corners, key=lambda c: c[::-1]), 1)}
    lines = ["*NODE, NSET=NALL"]
    lines += [f"{n}, {4.0 * i}, {7.0 * j}, 0." for (i, j), n in numbers.items()]
    for name, part in (("STEM", [c for c in cells if c[1] < 6]), ("TINES", cells)):
        lines.append(f"*ELEMENT, TYPE=S4, ELSET={name}")
        for n, (i, j) in enumerate(cells, 1):
            if ((i, j) in part) == (name == "STEM") or (name == "TINES" and j >= 6):
                if (j < 6) != (name == "STEM"):
                    continue
                around = ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))
                lines.append(f"{n}, " + ", ".join(str(numbers[corner]) for corner in around))
    for name in ("STEM", "TINES"):
        lines += [f"*MATERIAL, NAME={name}", "*ELASTIC", "210000., 0.3", "*DENSITY", "7.85E-9"]
        lines += [f"*SHELL SECTION, ELSET={name}, MATERIAL={name}", "3."]
    held = [n for (_, j), n in numbers.items() if j == 0]
    lines += ["*BOUNDARY", *(f"{n}, 1, 6" for n in held)]
    path = folder / "fork.inp"
    path.write_text("\n".join(lines) + "\n")
    nodes = (f"{n},{4.0 * i},{7.0 * j},0." for (i, j), n in numbers.items())
    (folder / "nodes.csv").write_text("node,x,y,z\n" + "\n".join(nodes) + "\n")
    return path


def same_modes(one: ModalResult, other: ModalResult, rtol: float) -> None:
    np.testing.assert_allclose(one.eigenvalues, other.eigenvalues, rtol=rtol)
    left, right = (
        result.modes.mode_shapes[np.isin(result.modes.components, (1, 2, 3))]
        for result in (one, other)
    )
    signs = np.sign(np.sum(left * right, axis=0))
    np.testing.assert_allclose(left * signs, right, atol=2e-5 * np.abs(right).max())


def test_ccx_on_the_command_line_is_the_adapter_for_ccx(tmp_path: Path) -> None:
    deck = fork(tmp_path)
    analysis = ModalAnalysis(6, (1, 20, 40))
    parameter = Parameter("E", "youngs_modulus", "material", ("TINES",), 0.5, 2.0, 0.1)
    known = calculix_solver(deck, (parameter,))
    expected = solved(known, {"E": 1.3}, analysis, tmp_path / "known")
    asked = "*STEP\n*FREQUENCY\n{n_modes}\n*NODE FILE, OUTPUT=2D\nU\n*END STEP\n"
    deck.write_text(deck.read_text() + asked)
    settings = CommandSettings(
        "ccx",
        ("ccx", "-i", "{job}"),
        ("ccx", "-v"),
        "nodes.csv",
        results="fork.frd",
        edits=(NumberRule("E", pattern=r"NAME=TINES\n\*ELASTIC\n([^,]+),", form=".8E"),),
        success=("Job finished",),
        fatal=(r"\*ERROR",),
    )
    solver = command_solver(deck, (parameter,), settings)
    assert solver.program.version() == known.program.version()
    result = solved(solver, {"E": 1.3}, analysis, tmp_path / "job")
    same_modes(result, expected, 2e-6)  # both are printed with seven digits or fewer


def mast(folder: Path) -> Path:
    """A guyed mast of three legs with bracing, of bars in fields of eight columns."""
    lines, nodes = [], ["node,x,y,z"]
    for level in range(5):
        for leg in range(3):
            angle, n = 2.0 * np.pi * leg / 3.0, 3 * level + leg + 1
            x, y, z = 0.4 * np.cos(angle), 0.4 * np.sin(angle), 1.0 * level
            lines.append(f"GRID    {n:8d}{'':8}{x:8.4f}{y:8.4f}{z:8.4f}")
            nodes.append(f"{n},{x:.4f},{y:.4f},{z:.4f}")
    bars: list[tuple[int, int, int]] = []
    for level in range(4):
        for leg in range(3):
            n, beside = 3 * level + leg + 1, 3 * level + (leg + 1) % 3 + 1
            bars += [(1, n, n + 3), (2, n, beside + 3), (2, n + 3, beside + 3)]
    for number_, (section, first, last) in enumerate(bars, 1):
        lines.append(
            f"CBAR    {number_:8d}{section:8d}{first:8d}{last:8d}{0.1:8.1f}{0.2:8.1f}{1.0:8.1f}"
        )
    for section, (area, inertia) in enumerate(((3.0e-4, 2.0e-8), (1.0e-4, 3.0e-9)), 1):
        material = section
        lines.append(
            f"PBAR    {section:8d}{material:8d}{area:8.2E}{inertia:8.2E}{inertia:8.2E}"
            f"{2 * inertia:8.2E}"
        )
        lines.append(f"MAT1    {section:8d}{'70.0E9':>8}{'':8}{'0.33':>8}{'2700.':>8}")
    lines.append(f"SPC1    {1:8d}{123456:8d}{1:8d}{2:8d}{3:8d}")
    head = ["SOL 103", "CEND", "METHOD = 7", "SPC = 1", "BEGIN BULK"]
    path = folder / "mast.bdf"
    path.write_text("\n".join([*head, *lines, "ENDDATA"]) + "\n")
    (folder / "nodes.csv").write_text("\n".join(nodes) + "\n")
    return path


@pytest.mark.skipif(MYSTRAN is None, reason="MYSTRAN is not here (tools/mystran.sh)")
@pytest.mark.parametrize(("results", "rtol"), [("mast.OP2", 1e-6), ("mast.F06", 1e-6)])
def test_mystran_on_the_command_line_is_the_adapter_for_mystran(
    tmp_path: Path, results: str, rtol: float
) -> None:
    deck = mast(tmp_path)
    analysis = ModalAnalysis(5, (4, 9, 15))
    parameter = Parameter("E", "youngs_modulus", "material", ("2",), 0.1, 10.0, 0.1)
    known = mystran_solver(deck, (parameter,))
    expected = solved(known, {"E": 0.7}, analysis, tmp_path / "known")
    text = deck.read_text().replace("METHOD = 7", "METHOD = 7\nDISPLACEMENT(PRINT,PLOT) = ALL")
    text = text.replace("BEGIN BULK", "BEGIN BULK\nPARAM,POST,-1\nEIGRL,7,,,{n_modes},,,,MASS")
    deck.write_text(text)
    line = 1 + next(n for n, row in enumerate(text.splitlines()) if row.startswith("MAT1") and
                    row.split()[1] == "2")  # fmt: skip
    settings = CommandSettings(
        "mystran",
        (str(MYSTRAN), "{deck}"),
        "as installed",
        "nodes.csv",
        results=results,
        components=(1, 2, 3, 4, 5, 6),
        edits=(NumberRule("E", line=line, columns=(17, 24), form="8.2E"),),
    )
    solver = command_solver(deck, (parameter,), settings)
    result = solved(solver, {"E": 0.7}, analysis, tmp_path / "job")
    same_modes(result, expected, rtol)
    assert result.modes.normalisation == "mass"


def test_python_is_the_one_that_runs_modetune(tmp_path: Path) -> None:
    assert shaft(tmp_path).program.command(1).arguments[0] == sys.executable
