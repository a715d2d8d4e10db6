"""Ways of updating a model with CalculiX, each a command in a fresh folder with a fresh store.

    a  one finite difference after another with least squares, as published scripts do
    b  SciPy's least_squares around the solver
    c  the thesis's Case II: modetune with finite differences in each iteration
    d  the thesis's Case I: the same, skipped where e2 allows, with Broyden's update
    e  modetune with default settings
    f  Dakota's NL2SOL with a script around the solver, differences side by side

All start at the deck's values and end when every frequency is within the target; the truth is
known (problem.py). a and b (published.py) give a lone run one thread or all cores, whichever is
quicker; runs side by side have one, as all of f (dakota.py). Errors are those of one more plain run
at the values each ended with.

    python -m benchmarks.ways [--case garteur] [--sizes coarse medium fine:bef] [--target 1e-4]

A size may name the ways that run at it; the last line of the output is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from benchmarks import dakota
from benchmarks.cost import Cost, Ended, calculix, counting, run_counted
from benchmarks.plain import JobCost, PlainModel, cores, quickest
from benchmarks.problem import CASES, TARGET, Problem, set_up, write_problem
from benchmarks.time_spent import profiled

from modetune.core.errors import ModetuneError
from modetune.flows.campaign.schema import STORE_VARIABLE
from modetune.flows.jobs.prefect_server import (
    HOME_VARIABLE,
    IDLE_VARIABLE,
    machine_home,
    stop_server,
    use_server,
)

#: Prefect's server: already up as on a machine that is in use, started and ended with each
#: campaign, or not used at all.
ServerUse = Literal["running", "cold", "none"]

#: modetune's other way of finding modes is not the thesis's.
BY_SOLVER = ("model.eigensolver=solver",)
THESIS = ("sensitivity.method=finite_difference", "sensitivity.between=broyden", *BY_SOLVER)


@dataclass(frozen=True, slots=True)
class Way:
    """A way of updating: a method of published.py, Dakota, or settings of `modetune update`."""

    letter: str
    name: str
    method: str = ""
    settings: tuple[str, ...] = ()


WAYS = {
    way.letter: way
    for way in (
        Way("a", "differences one by one, numpy", method="gauss_newton"),
        Way("b", "SciPy least_squares, in parallel", method="least_squares"),
        Way("c", "thesis's Case II", settings=(*THESIS, "update.e2=0")),
        Way("d", "thesis's Case I", settings=THESIS),
        Way("e", "modetune, default settings"),
        Way("f", "Dakota NL2SOL", method="nl2sol"),
    )
}
LETTERS = "".join(WAYS)
#: The way that the others are compared with.
REFERENCE = "e"


@dataclass(frozen=True, slots=True)
class Trial:
    """One run of one way.

    parameters: where it ended, relative values. largest_error, mean_error: of the frequencies
    there, by one plain run; least_mac: of the shapes there, None without. largest_distance,
    mean_distance: of the parameters to the truth. seconds: where modetune's wall went, by what was
    done; empty unless requested. answer: what `modetune update --json` printed.
    """

    cost: Cost
    converged: bool
    parameters: tuple[float, ...]
    largest_error: float
    mean_error: float
    least_mac: float | None
    largest_distance: float
    mean_distance: float
    seconds: Mapping[str, float] = field(default_factory=dict)
    answer: Mapping[str, Any] = field(default_factory=dict)


def prepare(case: str, size: str, target: float, folder: Path) -> Problem:
    """A problem with its test, by runs of the twin that do not count."""
    problem, twin = quickest(set_up(case, size, target, folder))
    problem = replace(problem, measured=twin.select(range(problem.n_modes)))
    write_problem(problem)
    return problem


@contextmanager
def prefect_server(use: ServerUse, home: Path) -> Iterator[Mapping[str, str]]:
    """Keep a server running during the context, if campaigns should find one.

    Yields the environment in which Prefect itself uses it.
    """
    if use != "running":
        yield {}
        return
    before = dict(os.environ)
    os.environ[HOME_VARIABLE] = str(home)
    os.environ[IDLE_VARIABLE] = "10"  # it does not outlive a benchmark that is killed
    try:
        server = use_server()
        within = importing()
    finally:  # campaigns shall find the server by its home, as those of users do
        os.environ.clear()
        os.environ.update(before)
    try:
        if server.wait() != "ready":
            sys.exit(f"Prefect's server does not answer; its log is in {home}")
        yield within
    finally:
        server.close()
        stop_server(machine_home(home))


def run_way(
    way: Way,
    problem: Problem,
    model: PlainModel,
    folder: Path,
    server: ServerUse,
    profile: bool = False,
) -> Trial:
    """Run a way in a new folder, which is deleted when it went well.

    Raises SystemExit where the command fails.
    """
    folder.mkdir(parents=True)
    found: Mapping[str, Any] = {}
    if way.method == "nl2sol":
        counter = counting(folder, problem.solver)
        command = dakota.write_study(problem, folder, str(counter))
        ended = run_counted(command, folder, dict(os.environ), problem.solver)
        converged, theta = dakota.result(problem, folder)
        if ended.return_code and not converged:
            sys.exit(f"{way.name} failed:\n{ended.output[-1000:]}\n{ended.errors[-1000:]}")
    elif way.method:
        command = [sys.executable, "-m", "benchmarks.published", way.method, str(problem.folder)]
        ended = run_counted(command, folder, importing(), problem.solver)
        found = told(ended, way.name)
        converged, theta = found["converged"], np.array(found["parameters"])
    else:
        words = [word for text in way.settings for word in ("--set", text)]
        home = problem.folder.parent / "home"  # of the server that is kept up
        words = ["update", *campaign(problem, folder), *words]
        ended = modetune(words, folder, home, server, profile, problem.solver)
        found = told(ended, way.name)
        converged = found["status"] == "converged"
        theta = np.array([item["updated"] for item in found["parameters"]])
    final = model.agreement(theta)
    errors = np.abs(final.errors)
    distance = problem.distance(theta)
    seconds = profiled(folder) if profile and not way.method else {}
    shutil.rmtree(folder)
    return Trial(
        ended.cost,
        converged,
        tuple(theta.tolist()),
        float(errors.max()),
        float(errors.mean()),
        float(final.macs.min()) if final.macs.size else None,
        float(distance.max()),
        float(distance.mean()),
        seconds,
        found,
    )


def importing() -> dict[str, str]:
    """The environment, in which Python finds this folder, and modetune keeps no store."""
    root = str(Path(__file__).resolve().parents[1])
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    found = {**os.environ, "PYTHONPATH": path}
    found.pop(STORE_VARIABLE, None)
    found.pop("PYTHONDONTWRITEBYTECODE", None)  # what is installed has its byte code
    return found


def campaign(problem: Problem, folder: Path) -> list[str]:
    """Return the arguments with which a command runs a problem's campaign in its own folder."""
    runs, store = folder / "runs", folder / "store"
    return [str(problem.campaign), "--runs", str(runs), "--set", f"store={store}"]


def modetune(
    words: Sequence[str],
    folder: Path,
    home: Path,
    server: ServerUse,
    profile: bool = False,
    solver: str = "calculix",
) -> Ended:
    """Run a command of modetune in a folder.

    home: of the server. profile: it notes in the folder where its time goes (time_spent.py).
    """
    program = [sys.executable, "-m", "benchmarks.time_spent" if profile else "modetune"]
    without = ["--no-prefect"] if server == "none" and words[0] != "demo" else []
    environment = {**importing(), HOME_VARIABLE: str(home)}
    try:
        return run_counted([*program, *words, "--json", *without], folder, environment, solver)
    finally:
        if server == "cold":
            stop_server(machine_home(home))


def told(ended: Ended, name: str) -> Mapping[str, Any]:
    """The JSON object of a command, its last line. Raises SystemExit where it has failed."""
    if ended.return_code not in (0, 3):  # 3: finished, the target not met
        sys.exit(f"{name} failed with code {ended.return_code}:\n{ended.errors[-2000:]}")
    found: Mapping[str, Any] = json.loads(ended.output.splitlines()[-1])
    return found


def table(problem: Problem, plain: JobCost, trials: Mapping[str, Trial]) -> str:
    """The ways of one size, a line each."""
    reference = trials.get(REFERENCE)
    lines = [
        f"{problem.case} {problem.size}: {plain.n_equations:,} equations, "
        f"{len(problem.parameters)} parameters, {problem.n_modes} modes; "
        f"a plain modal run {plain.wall_s:.2f} s, threads {problem.threads}",
        f"{'':33}{'wall s':>8}{'/ e':>7}{'/plain':>7}{'modal':>6}{'matr.':>6}{'CPU s':>8}"
        f"{'GB':>6}{'largest':>9}{'mean':>9}{'distance':>9}  met",
    ]
    for letter, trial in trials.items():
        cost = trial.cost
        ratio = f"{cost.wall_s / reference.cost.wall_s:.2f}" if reference else "-"
        lines.append(
            f"{letter}  {WAYS[letter].name:30}{cost.wall_s:8.1f}"
            f"{ratio:>7}{cost.wall_s / plain.wall_s:7.1f}"
            f"{cost.modal_runs:6}{cost.matrix_runs:6}{cost.cpu_s:8.1f}{cost.peak_bytes / 1e9:6.2f}"
            f"{trial.largest_error:9.1e}{trial.mean_error:9.1e}{trial.mean_distance:9.3f}"
            f"  {'yes' if trial.converged else 'NO'}"
        )
    return "\n".join(lines)


def wanted(text: str, case: str) -> tuple[str, str]:
    """Size and letters of `medium` or `fine:de`. Raises ValueError where there is none such."""
    size, colon, letters = text.partition(":")
    if size not in CASES[case][0]:
        raise ValueError(f"{case} has the sizes {', '.join(CASES[case][0])}, not {size!r}")
    letters = letters if colon else LETTERS
    if not letters or set(letters) - set(LETTERS):
        raise ValueError(f"{text!r}: ways are letters of {LETTERS}")
    return size, "".join(sorted(set(letters)))


def main(arguments: list[str] | None = None) -> None:
    """Run the ways, print a table for each size, and all of it as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--case", choices=sorted(CASES), default="garteur")
    parser.add_argument("--sizes", nargs="+", default=["coarse"], help="as `medium` or `fine:de`")
    parser.add_argument("--target", type=float, default=TARGET, help="Largest frequency error.")
    parser.add_argument("--server", choices=get_args(ServerUse), default="running")
    chosen = parser.parse_args(arguments)
    if not 0.0 < chosen.target < 0.1:
        parser.error("--target must be between 0 and 0.1")
    try:
        sizes = [wanted(text, chosen.case) for text in chosen.sizes]
    except ValueError as error:
        parser.error(str(error))
    calculix()
    results: list[dict[str, object]] = []
    with tempfile.TemporaryDirectory(prefix="modetune-bench-") as name:
        folder = Path(name)
        with prefect_server(chosen.server, folder / "home"):
            for size, letters in sizes:
                problem = prepare(chosen.case, size, chosen.target, folder / size)
                model, trials = PlainModel(problem), {}
                _, plain = model.modes(problem.parameter_set.initial)
                for letter in letters:
                    place = problem.folder / letter
                    trials[letter] = run_way(WAYS[letter], problem, model, place, chosen.server)
                sys.stdout.write(f"{table(problem, plain, trials)}\n\n")
                sys.stdout.flush()
                ways = {each: asdict(replace(trial, answer={})) for each, trial in trials.items()}
                results.append({"size": size, "plain": asdict(plain), "ways": ways})
    sys.stdout.write(json.dumps({"case": chosen.case, "cores": cores(), "sizes": results}) + "\n")


if __name__ == "__main__":
    try:
        main()
    except ModetuneError as error:
        sys.exit(str(error))
