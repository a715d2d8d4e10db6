"""Campaigns whose model is a function of Python: modes or matrices at parameter values."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import sparse

import modetune
from modetune.core.modes import Floats
from modetune.core.storage.campaign_record import IterationRecord
from tests.command_line import run_command

START = {"k1": 1000.0, "k2": 1000.0, "k3": 1000.0}
TRUTH = {"k1": 1200.0, "k2": 850.0, "k3": 1000.0}
DOFS = ["1.x", "2.x", "3.x"]
#: e1 of 1e-6 in frequency is 2e-6 in eigenvalues; the springs follow within ten times that.
FINE = {"update.e1.frequency": 1e-6, "report.page": False}


@pytest.fixture(autouse=True)
def _own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MODETUNE_STORE", str(tmp_path / "store"))
    monkeypatch.setenv("MODETUNE_NO_PREFECT", "1")


def matrices(k1: float, k2: float, k3: float) -> tuple[Floats, Floats]:
    """Three unit masses in a row, the first spring to the ground."""
    stiffness = [[k1 + k2, -k2, 0.0], [-k2, k2 + k3, -k3], [0.0, -k3, k3]]
    return np.array(stiffness), np.eye(3)


def modes(theta: Floats) -> tuple[Floats, Floats]:
    eigenvalues, shapes = np.linalg.eigh(matrices(*theta)[0])
    return np.sqrt(eigenvalues) / (2.0 * np.pi), shapes


def measured() -> dict[str, Any]:
    frequencies, shapes = modes(np.array(list(TRUTH.values())))
    return {"frequencies_hz": frequencies, "mode_shapes": shapes, "dofs": DOFS}


def update(model: Callable[..., Any], **given: Any) -> modetune.CampaignRun:
    settings: dict[str, Any] = {"model": model, "test": measured(), "parameters": START}
    return modetune.update(**{**settings, "settings": FINE, **given})


def sparse_matrices(**k: float) -> Any:
    return tuple(sparse.csr_array(item) for item in matrices(**k))


@pytest.mark.parametrize("model", [matrices, modes, sparse_matrices])
def test_a_function_finds_the_truth(model: Callable[..., Any]) -> None:
    run = update(model)
    assert run.converged
    assert run.parameters["updated"].tolist() == pytest.approx([1.2, 0.85, 1.0], abs=2e-5)
    assert run.updated_deck.read_text().startswith(f"function: {model.__name__} (test_function_")


def test_a_function_agrees_with_the_same_model_as_matrices() -> None:
    """The embedded solver computes the same modes in a process of its own."""
    at = {"k1": 1.1, "k2": 0.9, "k3": 1.0}
    parameters = [{"name": name, "value": value} for name, value in START.items()]
    given = {"name": "own", "model": matrices, "test": measured(), "parameters": parameters}
    parts = {
        name: {"stiffness": matrices(**(dict.fromkeys(START, 0.0) | {name: 1000.0}))[0]}
        for name in START
    }
    whole = {"stiffness": matrices(**START)[0], "mass": np.eye(3), "parts": parts}
    factors = [{"name": k, "quantity": "matrix_factor", "part": k} for k in START]
    own = modetune.modes(given, at=at)
    other = modetune.modes(
        {"name": "parts", "model": whole, "test": measured(), "parameters": factors}, at=at
    )
    assert own.eigenvalues == pytest.approx(other.eigenvalues, rel=1e-12)  # rounding of solvers
    assert np.abs(own.modes.mode_shapes) == pytest.approx(
        np.abs(other.modes.mode_shapes), abs=1e-10
    )


def test_rigid_modes_of_matrices_are_counted() -> None:
    def free(k1: float, k2: float) -> tuple[Floats, Floats]:
        return matrices(0.0, k1, k2)

    given = {"name": "free", "model": free, "parameters": {"k1": 900.0, "k2": 1100.0}}
    assert modetune.modes({**given, "test": measured()}).n_rigid == 1


class Counted:
    """A function that counts its calls, and whose result depends on what is around it."""

    def __init__(self) -> None:
        self.calls, self.mass = 0, 1.0

    def __call__(self, k1: float, k2: float, k3: float) -> tuple[Floats, Floats]:
        self.calls += 1
        return matrices(k1, k2, k3)[0], self.mass * np.eye(3)


def test_results_are_used_again_only_with_a_version() -> None:
    model = Counted()
    first = update(model, name="counted")
    calls = model.calls
    assert calls == first.record.runs.modal + first.record.runs.sensitivity
    again = update(model, name="counted")
    assert (model.calls, again.record.runs.reused) == (2 * calls, 0)
    model.mass = 1.1  # nothing of the earlier results may be served
    heavier = update(model, name="counted")
    assert heavier.parameters["updated"].tolist() == pytest.approx([1.32, 0.935, 1.1], abs=3e-5)
    assert not list(Path("store").rglob("*.h5"))

    update(model, name="counted", version="a")
    calls = model.calls
    stored = update(model, name="counted", version="a")
    assert (model.calls, stored.record.runs.modal) == (calls, 0)
    update(model, name="counted", version="b")
    assert model.calls > calls


def test_other_functions_of_the_same_name_and_version_have_results_of_their_own() -> None:
    def model(k1: float, k2: float, k3: float) -> Any:
        return matrices(k1, k2, k3)

    first = update(model, version="1")

    def model(k1: float, k2: float, k3: float) -> Any:  # type: ignore[no-redef]  # as in a notebook
        return matrices(2.0 * k1, k2, k3)

    second = update(model, version="1")
    assert second.record.runs.modal > 0
    updated = [run.parameters["updated"]["k1"] for run in (first, second)]
    assert updated == pytest.approx([1.2, 0.6], abs=2e-5)


def fails(k1: float, k2: float, k3: float) -> Any:
    return matrices(k1, k2, k3)[0][3]


def nothing(**k: float) -> None:
    """Forget the return statement."""


def not_finite(**k: float) -> Any:
    stiffness, mass = matrices(**k)
    return stiffness, mass * np.nan


def too_few_rows(**k: float) -> Any:
    return np.ones(3), np.ones((2, 3))


def too_large(**k: float) -> Any:
    return np.eye(4), np.eye(4)


def not_symmetric(**k: float) -> Any:
    return np.triu(matrices(**k)[0]), np.eye(3)


def complex_shapes(**k: float) -> Any:
    return np.ones(3), np.ones((3, 3)) * 1j


def below_zero(**k: float) -> Any:
    return np.array([-1.0, 2.0, 3.0]), np.eye(3)


@pytest.mark.parametrize(
    ("model", "sentence"),
    [
        (fails, r"test_function_campaign.py, line \d+, in fails: `return matrices\(k1, k2, k3\)"
                r"\[0\]\[3\]` raised IndexError: .* at k1 = 1000.0, k2 = 1000.0, k3 = 1000.0; "
                r"correct the function, or narrow the bounds"),
        (nothing, r"nothing \(test_function_campaign.py, line \d+\) returned at k1 = 1000.0.*it is "
                  r"a NoneType; expected \(frequencies_hz, mode_shapes\) or \(stiffness, mass\)"),
        (not_finite, "its second part has 9 values that are NaN or infinite; expected finite"),
        (too_few_rows, r"\(3,\) and \(2, 3\); expected \(n_modes,\) for frequencies in Hz and "
                       r"\(3, n_modes\) for shapes, a row for each of the 3 `dofs`"),
        (too_large, r"\(4, 4\) and \(4, 4\); expected \(3, 3\) for stiffness and mass"),
        (not_symmetric, "does not fit: the stiffness is not symmetric"),
        (complex_shapes, "its second part has complex128 values; expected real numbers"),
        (below_zero, "a frequency is -1 Hz; expected none below zero"),
    ],
)  # fmt: skip
def test_what_a_function_does_wrong_is_a_sentence(model: Callable[..., Any], sentence: str) -> None:
    with pytest.raises(modetune.ModetuneError, match=sentence) as told:
        update(model)
    assert "Traceback" not in str(told.value)


def test_a_step_to_values_that_a_function_refuses_is_shortened() -> None:
    refused: list[float] = []

    def soft(k1: float, k2: float, k3: float) -> Any:
        if k2 < 840.0:
            refused.append(k2)
            raise ValueError("k2 is too small")
        return matrices(k1, k2, k3)

    start = {"k1": 600.0, "k2": 1300.0, "k3": 1000.0}
    run = update(soft, parameters=start)
    assert refused  # the first steps, which the nonlinearity makes too long
    assert run.converged


def wrong_names(a: float, b: float) -> None:
    raise AssertionError


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (
            {"model": wrong_names},
            "has the arguments a, b, but the parameters are k1, k2, k3: name ",
        ),
        ({"model": 3}, "`function` is a int, not a function"),
        ({"parameters": [{"name": "k1"}]}, "a function needs parameters with a `value`"),
        ({"parameters": {**START, "k4": {"quantity": "number"}}}, "k4 has no value"),
        ({"test": {"frequencies_hz": [1.0]}}, "the test has no sensors that could name the rows"),
        ({"test": {"frequencies_hz": [1.0]}, "dofs": ["1.q"]}, "'1.q' is not a degree of freedom"),
        ({"settings": {"run.engine": "dask"}}, "runs in this process: `run.engine` must be local"),
        ({"settings": {"run.timeout_s": 5}}, "nothing can stop it after `run.timeout_s`"),
        ({"campaign": "x.yaml"}, "update requires either a campaign or model="),
    ],
)
def test_what_does_not_fit_is_refused_before_any_call(
    change: dict[str, Any], sentence: str
) -> None:
    model = Counted()
    with pytest.raises(modetune.ModetuneError, match=sentence):
        update(**{"model": model, **change})
    assert model.calls == 0


def test_the_command_line_says_where_a_function_runs() -> None:
    update(matrices, name="own")
    file = ".modetune/campaigns/own/campaign.yaml"
    for command in (["update", file], ["server", "deploy", file]):
        done = run_command(Path.cwd(), *command)
        assert done.returncode == 2
        assert "function of Python, which only the session that has it can run" in done.stderr
        assert "make it a program (`solver: command`)" in done.stderr


def test_an_expression_ties_values_of_a_function() -> None:
    seen: list[tuple[float, float]] = []

    def tied(k1: float, k2: float, k3: float) -> Any:
        seen.append((k1, k3))
        return matrices(k1, k2, k3)

    parameters = [
        {"name": "k1", "value": 1000.0},
        {"name": "k2", "value": 1000.0, "bounds": [0.7, 1.5]},
        {"name": "k3", "value": 900.0, "expression": "k1"},
    ]
    update(tied, parameters=parameters, settings={"report.page": False})
    assert len(seen) > 3
    assert all(k3 == pytest.approx(0.9 * k1, rel=1e-12) for k1, k3 in seen)


def test_each_iteration_is_given_to_a_callback() -> None:
    seen: list[IterationRecord] = []
    run = update(matrices, on_iteration=seen.append)
    assert [item.number for item in seen] == [item.number for item in run.record.iterations]
    assert seen[-1].parameters == pytest.approx(run.record.updated)
    assert seen[0].worst_error > seen[-1].worst_error


def test_an_error_of_a_callback_ends_the_update_as_it_is() -> None:
    def stop(record: IterationRecord) -> None:
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        update(matrices, on_iteration=stop)


def top_over_bottom(hz: Floats, shapes: Floats) -> Any:
    """Ratio of the first mode's motion at masses 3 and 1, and the product of frequencies."""
    return [shapes[2, 0] / shapes[0, 0], np.prod(hz)]


def responses(**changes: Any) -> list[dict[str, Any]]:
    hz, shapes = modes(np.array(list(TRUTH.values())))
    measured = top_over_bottom(hz, -3.0 * shapes)
    own = {"function": top_over_bottom, "measured": measured, "deviation": [0.01, 0.001]}
    return [{**own, **changes}]


def test_own_responses_determine_what_the_test_leaves_open() -> None:
    """Of two springs from one frequency: the ratio of the shape, known apart, gives the second."""
    hz, shapes = modes(np.array(list(TRUTH.values())))
    test = {"frequencies_hz": hz[:1], "mode_shapes": shapes[:, :1], "dofs": DOFS}
    given: dict[str, Any] = {
        "test": test,
        "parameters": [
            {"name": "k1", "value": 1000.0},
            {"name": "k2", "value": 1000.0},
            {"name": "k3", "value": 1000.0, "expression": "1"},
        ],
        "settings": {**FINE, "residuals.shape_weight": 0, "update.step": "weighted_least_squares"},
    }
    ratio = {"function": lambda f, phi: phi[2, 0] / phi[0, 0], "name": "ratio", "deviation": 1e-4}
    run = update(matrices, **given, responses=[{**ratio, "measured": shapes[2, 0] / shapes[0, 0]}])
    assert run.parameters["updated"].tolist()[:2] == pytest.approx([1.2, 0.85], rel=1e-3)
    (row,) = run.summary["responses"]
    assert (row["kind"], row["item"]) == ("own", "ratio")
    assert row["updated"] == pytest.approx(row["measured"], abs=2e-4)  # two deviations


def test_derivatives_of_own_responses_are_those_of_homogeneous_functions() -> None:
    """Over all springs, at 1: 0 for a ratio of a shape, n / 2 for the product of n frequencies."""
    run = update(modes, responses=responses(), settings={**FINE, "sensitivity.step": 1e-4})
    first, second = run.record.iterations[:2]
    start = first.residual.values[first.residual.rows("own")]
    slopes = second.sensitivity[second.residual.rows("own")]
    value = float(responses()[0]["measured"][1] - start[1])
    # a one-sided difference of 1e-4 errs by half of it times the second derivative, 0.75 of a value
    assert slopes.sum(axis=1) / [1.0, value] == pytest.approx([0.0, 1.5], abs=1e-4)


def test_own_responses_of_a_campaign_file_are_compared() -> None:
    """The function gets the three modes at the three sensors of the file's test."""
    six_mass = Path(__file__).resolve().parents[3] / "configs" / "six_mass" / "campaign.yaml"
    seen: list[tuple[int, ...]] = []

    def first(hz: Floats, shapes: Floats) -> float:
        seen.append((hz.size, *shapes.shape))
        return float(hz[0])

    hz = modetune.load(six_mass).test.modes.frequencies_hz[0]
    own = [{"function": first, "measured": hz, "deviation": 0.01 * hz}]
    run = modetune.update(six_mass, responses=own, settings={"report.page": False})
    assert run.converged
    assert set(seen) == {(3, 3, 3)}
    assert [row["item"] for row in run.summary["responses"]] == ["first"]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"measured": [1.0], "deviation": 0.1}, r"returned \[.*\]; expected 1 finite number, as"),
        ({"measured": [1.0]}, "`deviation` and `weight` have one value each, or as many as"),
        ({"function": lambda hz, shapes: hz[7]}, "` raised IndexError: .* with 3 frequencies "),
        ({"function": lambda hz, shapes: [np.nan, 1.0]}, "expected 2 finite numbers"),
        ({"deviation": 0.0}, "`deviation` above zero"),
        ({"deviations": 0.1}, "each requires `function`, `measured` and `deviation`"),
    ],
)  # fmt: skip
def test_an_own_response_that_fails_is_a_sentence(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(modetune.ModetuneError, match=sentence):
        update(matrices, responses=responses(**changes))
