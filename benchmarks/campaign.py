"""Ways of updating a model with CalculiX, side by side on the same problem.

    a  one finite difference after another with least squares, as published scripts do
    b  SciPy's least_squares around the solver
    c  the thesis's Case II: modetune with finite differences in each iteration
    d  the thesis's Case I: the same, skipped where e2 allows, with Broyden's update
    e  modetune as it comes

All start at the deck's values and end when every frequency is within the target; the truth is
known (problem.py). Each runs in a process of its own with a fresh store; a and b give CalculiX one
thread or all cores, whichever is quicker. Errors are those of one more plain run at the values each
ended with. Modes of the same models by CalculiX and from its matrices follow (eigen.py).

    python -m benchmarks.campaign [--case garteur] [--sizes coarse medium fine:be] [--repeats 1]

A size may name the ways that run at it; the last line of the output is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import get_args

from benchmarks.comparison import Round, SizeResult, growths, summary, table
from benchmarks.cost import calculix
from benchmarks.eigen import Solution, measure
from benchmarks.eigen import table as eigen_table
from benchmarks.plain import PlainModel, cores, quickest
from benchmarks.problem import CASES, TARGET, Problem, set_up, write_problem
from benchmarks.ways import (
    LETTERS,
    WAYS,
    ServerUse,
    prefect_server,
    run_way,
)

from modetune.core.errors import ModetuneError

#: What ends within half an hour on two cores.
DEFAULT_SIZES = {
    "garteur": ("coarse", "medium", "fine:be"),
    "launcher": ("coarse:acde", "medium:e"),
}


@dataclass(frozen=True, slots=True)
class Wanted:
    """A size and the letters of the ways that run at it."""

    size: str
    letters: str


def wanted(text: str, case: str) -> Wanted:
    """`medium` or `fine:de`. Raises ValueError where there is no such size or way."""
    size, colon, letters = text.partition(":")
    if size not in CASES[case][0]:
        raise ValueError(f"{case} has the sizes {', '.join(CASES[case][0])}, not {size!r}")
    letters = letters if colon else LETTERS
    if not letters or set(letters) - set(LETTERS):
        raise ValueError(f"{text!r}: ways are letters of {LETTERS}")
    return Wanted(size, "".join(sorted(set(letters))))


def prepare(case: str, size: str, target: float, folder: Path) -> Problem:
    """A problem with its test, by runs of the twin that do not count."""
    problem, twin = quickest(set_up(case, size, target, folder))
    problem = replace(problem, measured=twin.select(range(problem.n_modes)))
    write_problem(problem)
    return problem


def rounds(
    problem: Problem, letters: str, repeats: int, server: ServerUse
) -> Iterator[tuple[int, Round]]:
    """Round after round: a plain run, then every way; with the model's equations."""
    model = PlainModel(problem)
    for number in range(repeats):
        _, plain = model.modes(problem.parameter_set.initial)
        trials = {}
        for way in WAYS:
            if way.letter in letters:
                folder = problem.folder / f"{way.letter}-{number}"
                trial = run_way(way, problem, model, folder, server)
                trials[way.letter] = trial
                sys.stderr.write(f"{problem.size} {way.letter}: {trial.cost.wall_s:.1f} s\n")
        yield plain.n_equations, Round(plain.wall_s, trials)


def compare(
    case: str, size: Wanted, target: float, repeats: int, server: ServerUse, folder: Path
) -> tuple[Problem, SizeResult]:
    """A problem and all rounds of it. Raises SystemExit where a way fails."""
    with prefect_server(server, folder / "home"):
        problem = prepare(case, size.size, target, folder / size.size)
        told = list(rounds(problem, size.letters, repeats, server))
    return problem, SizeResult(
        problem.size,
        told[0][0],
        len(problem.parameters),
        problem.n_modes,
        problem.threads,
        tuple(each for _, each in told),
    )


def parse(arguments: list[str] | None) -> tuple[argparse.Namespace, list[Wanted]]:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--case", choices=sorted(CASES), default="garteur")
    parser.add_argument("--sizes", nargs="+", help="Sizes, as `medium` or `fine:de`.")
    parser.add_argument("--repeats", type=int, default=1, help="Rounds of all ways.")
    parser.add_argument("--target", type=float, default=TARGET, help="Largest frequency error.")
    parser.add_argument(
        "--server",
        choices=get_args(ServerUse),
        default="running",
        help="Prefect's server: up, started by each campaign, none.",
    )
    parser.add_argument("--no-eigen", action="store_true", help="Without single modal solutions.")
    chosen = parser.parse_args(arguments)
    if chosen.repeats < 1 or not 0.0 < chosen.target < 0.1:
        parser.error("--repeats must be 1 or more, --target between 0 and 0.1")
    try:
        sizes = [wanted(text, chosen.case) for text in chosen.sizes or DEFAULT_SIZES[chosen.case]]
    except ValueError as error:
        parser.error(str(error))
    return chosen, sizes


def main(arguments: list[str] | None = None) -> None:
    """Run the comparison, print a table for each size, and all of it as JSON."""
    chosen, sizes = parse(arguments)
    calculix()
    results: list[SizeResult] = []
    solutions: list[Solution] = []
    with tempfile.TemporaryDirectory(prefix="modetune-bench-") as name:
        for size in sizes:
            problem, result = compare(
                chosen.case, size, chosen.target, chosen.repeats, chosen.server, Path(name)
            )
            results.append(result)
            sys.stdout.write(f"{chosen.case} {table(results[-1])}\n\n")
            sys.stdout.flush()
            if not chosen.no_eigen:
                solutions.append(measure(problem))
    shown = [
        f"{letter} {exponent:.2f}"
        for letter, exponent in growths(results).items()
        if exponent is not None
    ]
    if solutions:
        sys.stdout.write(f"{eigen_table(solutions)}\n")
    if shown:
        sys.stdout.write(f"growth, p of wall ~ equations^p: {', '.join(shown)}\n")
    told = {
        "case": chosen.case,
        "target": chosen.target,
        "repeats": chosen.repeats,
        "server": chosen.server,
        "cores": cores(),
        **summary(results),
        "eigen": [asdict(solution) for solution in solutions],
    }
    sys.stdout.write(json.dumps(told) + "\n")


if __name__ == "__main__":
    try:
        main()
    except ModetuneError as error:
        sys.exit(str(error))
