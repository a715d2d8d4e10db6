"""Methods around a solver on problems in closed form, and ways of updating with real CalculiX."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from benchmarks.cost import run_counted
from benchmarks.eigen import measure
from benchmarks.problem import (
    GARTEUR_TRUTH,
    Agreement,
    Problem,
    agreement,
    read_problem,
    set_up,
    write_problem,
)
from benchmarks.published import METHODS
from benchmarks.ways import LETTERS, main, wanted

from modetune.core.modes import Floats, mode_set
from modetune.core.parameters import Parameter
from tests.adapters.solved import needs_ccx

TRUTH = (1.2, 0.8)
#: Springs in one line between two walls, two masses: stiffnesses 1, 1 and 1.
MIDDLE = 1.0


def spring_modes(theta: Floats) -> tuple[Floats, Floats]:
    """Frequencies (2,) and shapes (2, 2) of two unit masses, outer springs theta."""
    left, right = theta
    stiffness = np.array([[left + MIDDLE, -MIDDLE], [-MIDDLE, right + MIDDLE]])
    eigenvalues, shapes = np.linalg.eigh(stiffness)
    return np.sqrt(eigenvalues) / (2.0 * np.pi), shapes


def compared(theta: Floats) -> Agreement:
    return agreement(mode_set(spring_modes(np.array(TRUTH))[0]), mode_set(spring_modes(theta)[0]))


def spring_problem(folder: Path) -> Problem:
    parameters = tuple(
        Parameter(name, "spring_stiffness", "elset", (name,), 0.5, 2.0, 0.2, initial)
        for name, initial in (("LEFT", 1.1), ("RIGHT", 0.9))
    )
    return Problem(
        "springs",
        "one",
        folder,
        parameters,
        TRUTH,
        2,
        0,
        (),
        1e-6,
        mode_set(spring_modes(np.array(TRUTH))[0]),
    )


@pytest.mark.parametrize("method", METHODS)
def test_a_published_method_finds_the_truth_and_stops_there(method: str, tmp_path: Path) -> None:
    problem, calls = spring_problem(tmp_path), []

    def compare(theta: Floats) -> Agreement:
        calls.append(theta.copy())
        return compared(theta)

    updated = METHODS[method](problem, compare, compare)
    theta = np.array(updated.parameters)
    assert updated.converged
    assert compared(theta).holds(problem.target)
    # A frequency error of 1e-6 is one of some 1e-5 in these springs.
    assert theta == pytest.approx(TRUTH, abs=1e-4)
    assert any(np.array_equal(each, theta) for each in calls)
    if method == "gauss_newton":
        np.testing.assert_array_equal(calls[-1], theta)  # nothing is run after the target is met
        assert len(calls) % 3 == 1  # three a Jacobian and its point, and the last point


@pytest.mark.parametrize("method", METHODS)
def test_a_published_method_gives_up_on_a_target_out_of_reach(method: str, tmp_path: Path) -> None:
    problem = spring_problem(tmp_path)

    def never(theta: Floats) -> Agreement:
        found = compared(theta)
        return Agreement(found.errors + 0.5, found.macs, found.residual)

    assert not METHODS[method](problem, never, never).converged


def test_shapes_are_compared_whatever_their_scale_sign_and_order() -> None:
    hz, shapes = spring_modes(np.array(TRUTH))
    nodes, components = [1, 2], [1, 1]
    test = mode_set(hz, shapes, nodes, components)
    same = mode_set(hz[::-1], -3.0 * shapes[:, ::-1], nodes, components)
    found = agreement(test, same)
    assert found.holds(1e-12)
    np.testing.assert_allclose(found.residual, 0.0, atol=1e-9)  # rounding over deviations of 0.01
    other_hz, other_shapes = spring_modes(np.array([1.5, 0.6]))
    other = agreement(test, mode_set(other_hz, other_shapes, nodes, components))
    assert not other.holds(1e-3)
    # The squared length of each shape's residual is 1 - MAC, over the squared deviation.
    squared = np.sum(other.residual[2:].reshape(2, 2) ** 2, axis=0)
    np.testing.assert_allclose(squared * 0.05**2 / (0.1 * 2), 1.0 - other.macs, rtol=1e-12)


def test_a_problem_comes_back_from_its_folder(tmp_path: Path) -> None:
    empty = set_up("garteur", "tiny", 1e-3, tmp_path / "tiny")
    hz = np.arange(5.0, 13.0)
    problem = Problem(
        empty.case,
        empty.size,
        empty.folder,
        empty.parameters,
        empty.truth,
        8,
        6,
        (),
        1e-3,
        mode_set(hz),
    )
    write_problem(problem)
    again = read_problem(problem.folder)
    np.testing.assert_array_equal(again.measured.frequencies_hz, hz)
    assert again.parameters == problem.parameters
    assert again.truth == tuple(GARTEUR_TRUTH.values())


def test_a_commands_whole_tree_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MODETUNE_CCX", "true")
    # 200 MB in a child of a child; Python itself has some 10.
    inner = "import time; held = bytearray(b'x') * 200_000_000; time.sleep(0.5)"
    outer = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {inner!r}])"
    ended = run_counted([sys.executable, "-c", outer], tmp_path, {})
    assert ended.return_code == 0
    assert 2e8 < ended.cost.peak_bytes < 4e8
    assert ended.cost.modal_runs == ended.cost.matrix_runs == 0


def test_runs_are_counted_by_what_their_decks_ask_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for variable in ("MODETUNE_CCX", "MODETUNE_MYSTRAN"):
        monkeypatch.setenv(variable, "true")
    (tmp_path / "one.inp").write_text("*STEP\n*FREQUENCY\n5\n*END STEP\n")
    (tmp_path / "two.inp").write_text("*STEP\n*FREQUENCY, SOLVER=MATRIXSTORAGE\n5\n*END STEP\n")
    script = (
        '"$MODETUNE_CCX" -i one; "$MODETUNE_CCX" -i two; "$MODETUNE_CCX" -i one; "$MODETUNE_CCX" -v'
    )
    ended = run_counted(["/bin/sh", "-c", script], tmp_path, {"PATH": "/usr/bin:/bin"})
    assert (ended.cost.modal_runs, ended.cost.matrix_runs) == (2, 1)
    (tmp_path / "one.bdf").write_text("SOL 103\nCEND\nBEGIN BULK\nENDDATA\n")
    (tmp_path / "two.bdf").write_text("CHKPNT\nSOL 103\nCEND\nBEGIN BULK\nENDDATA\n")
    script = '"$MODETUNE_MYSTRAN" one.bdf; "$MODETUNE_MYSTRAN" two.bdf'
    command = ["/bin/sh", "-c", script]
    ended = run_counted(command, tmp_path, {"PATH": "/usr/bin:/bin"}, "mystran")
    assert (ended.cost.modal_runs, ended.cost.matrix_runs) == (1, 1)


@needs_ccx
def test_a_solution_from_matrices_is_calculixs(tmp_path: Path) -> None:
    solution = measure(set_up("garteur", "tiny", 1e-3, tmp_path / "tiny"))
    assert solution.n_equations == 5364  # 3 * 804 nodes + 9 * 328 elements
    # CalculiX prints seven digits, and its Lanczos leaves some 1e-6 of the eigenvalues.
    assert solution.difference < 1e-5
    assert solution.own_bytes > solution.native_bytes > 0  # libraries beside a small model
    assert solution.efficiency is not None


@needs_ccx
@pytest.mark.timeout(900)  # some fifty runs, which take long where all cores are busy
@pytest.mark.parametrize("letters", ["ae", pytest.param("abcdef", marks=pytest.mark.nightly)])
def test_ways_update_the_smallest_aircraft(letters: str, capfd: pytest.CaptureFixture[str]) -> None:
    if "f" in letters:
        pytest.importorskip("dakota.environment", reason="Dakota is not installed")
    main(["--sizes", f"tiny:{letters}", "--target", "1e-2", "--server", "none"])
    told = json.loads(capfd.readouterr().out.splitlines()[-1])
    (size,) = told["sizes"]
    ways = size["ways"]
    assert list(ways) == list(letters)
    assert size["plain"]["n_equations"] == 5364  # 3 * 804 nodes + 9 * 328 elements
    for way in ways.values():
        assert way["converged"]
        # The plain run's frequencies have seven digits.
        assert way["largest_error"] <= 1e-2 + 1e-6
        assert way["cost"]["peak_bytes"] > 5e7
    runs = {letter: way["cost"]["modal_runs"] for letter, way in ways.items()}
    assert runs["a"] % 6 == 1  # six for each Jacobian and its point, and the last point
    others = min(runs[letter] for letter in letters if letter != "e")
    assert others >= 7  # one Jacobian and its end
    # Young's moduli need no run of their own: strain energies, or matrices taken once.
    assert runs["e"] + ways["e"]["cost"]["matrix_runs"] < others


def test_sizes_may_name_their_ways() -> None:
    assert wanted("fine:ed", "garteur") == ("fine", "de")
    assert wanted("coarse", "garteur") == ("coarse", LETTERS)
    for wrong in ("huge", "fine:", "fine:x"):
        with pytest.raises(ValueError, match=r"sizes|letters"):
            wanted(wrong, "garteur")


def test_wrong_options_are_told_in_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["--target", "2"], ["--sizes", "huge"], ["--sizes", "fine:x"]):
        with pytest.raises(SystemExit) as ended:
            main(arguments)
        assert ended.value.code == 2
    assert "Traceback" not in capsys.readouterr().err
