"""The rows of the table of speeds: one function per row, on problems with known truth.

Runs that several rows need (a plain modal run, a way of updating) are made once a round.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from shutil import copytree
from typing import Any

from benchmarks.cost import Cost, run_counted
from benchmarks.eigen import measure as modal_solution
from benchmarks.overhead import ONE_TASK, overheads_ms
from benchmarks.plain import PlainModel
from benchmarks.problem import CASES, TARGET, Problem
from benchmarks.table import Figure, Row
from benchmarks.ways import (
    BY_SOLVER,
    WAYS,
    ServerUse,
    Trial,
    campaign,
    modetune,
    prepare,
    run_way,
    told,
)

from modetune.configs.launcher import launcher
from modetune.core.storage.campaign_record import read_record

#: A case of problem.py at a size of it.
Place = tuple[str, str]
#: What a command printed as JSON.
Answer = Mapping[str, Any]


@dataclass(slots=True)
class Bench:
    """Where the benchmark runs, and the problems that all rounds share.

    quick: the smallest sizes in place of all; large: the largest where a row has one. profile: ways
    by modetune note where their time goes. seconds: what they noted, by problem, way and round.
    within: the environment in which Prefect itself uses the server, empty without one.
    """

    folder: Path
    server: ServerUse = "running"
    quick: bool = False
    large: bool = False
    profile: bool = False
    problems: dict[tuple[Place, float], Problem] = field(default_factory=dict)
    seconds: dict[str, dict[str, float]] = field(default_factory=dict)
    within: Mapping[str, str] = field(default_factory=dict)

    def place(self, case: str, size: str, large: str = "") -> Place:
        """The case and the size that it is measured at."""
        if self.quick:
            return case, CASES[case][0][0]
        return case, large if large and self.large else size

    def problem(self, place: Place, target: float = TARGET) -> Problem:
        """Made once, with its test."""
        if (place, target) not in self.problems:
            # A row's own target is its subject and always holds; --quick replaces the usual one.
            asked = 1e-2 if self.quick and target == TARGET else target
            folder = self.folder / f"{'-'.join(place)}-{target:g}"
            self.problems[place, target] = prepare(*place, asked, folder)
        return self.problems[place, target]


@dataclass(slots=True)
class Round:
    """One round of all rows, with what was run in it."""

    bench: Bench
    number: int
    plain: dict[Place, float] = field(default_factory=dict)
    trials: dict[tuple[Place, str, float], Trial] = field(default_factory=dict)
    flow_s: float | None = None

    def folder(self, name: str) -> Path:
        """A new one for a command."""
        folder = self.bench.folder / f"{name}-{self.number}"
        folder.mkdir(parents=True)
        return folder

    def plain_s(self, place: Place) -> float:
        """Wall time of one plain modal run."""
        if place not in self.plain:
            problem = self.bench.problem(place)
            _, cost = PlainModel(problem).modes(problem.parameter_set.initial)
            self.plain[place] = cost.wall_s
        return self.plain[place]

    def bare_flow_s(self) -> float:
        """Wall time of a process with a bare Prefect flow of one task; 0 without a server."""
        if self.flow_s is None:
            command, within = [sys.executable, "-c", ONE_TASK], self.bench.within
            self.flow_s = 0.0
            if within:
                self.flow_s = run_counted(command, self.folder("flow"), within).cost.wall_s
        return self.flow_s

    def trial(self, place: Place, letter: str, target: float = TARGET) -> Trial:
        """A way of updating. Raises SystemExit where it does not meet the target."""
        if (place, letter, target) not in self.trials:
            problem, bench = self.bench.problem(place, target), self.bench
            name = f"{problem.folder.name}-{letter}-{self.number}"
            found = run_way(
                WAYS[letter],
                problem,
                PlainModel(problem),
                bench.folder / name,
                bench.server,
                profile=bench.profile,
            )
            if found.seconds:
                bench.seconds[name] = dict(found.seconds)
            self.trials[place, letter, target] = found
        found = self.trials[place, letter, target]
        if not found.converged:
            sys.exit(f"{WAYS[letter].name} did not meet the target on {' '.join(place)}")
        return found

    def command(self, place: Place, command: str, options: Sequence[str], label: str = "") -> Cost:
        """Run a command of modetune on a problem's campaign, with its own store.

        label: distinguishes the commands of a round.
        """
        folder = self.folder(f"{'-'.join(place)}-{command}{label}")
        return self.words([command, *campaign(self.bench.problem(place), folder), *options], folder)

    def words(self, words: Sequence[str], folder: Path) -> Cost:
        """Run a command of modetune. Raises SystemExit if it fails."""
        return self.answer(words, folder)[0]

    def answer(self, words: Sequence[str], folder: Path) -> tuple[Cost, Answer]:
        """Run a command of modetune: what it cost and printed. Raises SystemExit if it fails."""
        ended = modetune(words, folder, self.bench.folder / "home", self.bench.server)
        return ended.cost, told(ended, f"modetune {words[0]}")


def peer(case: str, size: str, each: Round) -> Figure:
    """Return the ratio of the best peer to modetune's defaults, to the first point on target.

    A bare Prefect flow, which peers do not have, is subtracted from modetune's time.
    """
    place, flow_s = each.bench.place(case, size), each.bare_flow_s()
    ours, dakota = each.trial(place, "e").cost, each.trial(place, "f").cost
    made_of = {
        "modetune s": ours.wall_s,
        "modal runs": ours.modal_runs,
        "matrix jobs": ours.matrix_runs,
        "a bare flow s": flow_s,
        "Dakota s": dakota.wall_s,
        "its runs": dakota.modal_runs,
    }
    best_s = dakota.wall_s
    if size != "fine":  # it takes more runs everywhere, and there a quarter of an hour
        scipy = each.trial(place, "b").cost
        made_of |= {"SciPy s": scipy.wall_s, "SciPy's runs": scipy.modal_runs}
        best_s = min(best_s, scipy.wall_s)
    return Figure(best_s / (ours.wall_s - flow_s), made_of)


def bare_flow(each: Round) -> Figure:
    """Return the time of a process with a bare Prefect flow of one task."""
    return Figure(each.bare_flow_s(), {})


def whole(case: str, size: str, large: str, each: Round) -> Figure:
    """Return the ratio of a campaign with default settings to one plain modal run."""
    place = each.bench.place(case, size, large)
    plain_s, cost = each.plain_s(place), each.trial(place, "e").cost
    return over_plain(cost, plain_s)


def over_plain(cost: Cost, plain_s: float) -> Figure:
    return Figure(
        cost.wall_s / plain_s,
        {
            "whole s": cost.wall_s,
            "plain run s": plain_s,
            "modal runs": cost.modal_runs,
            "matrix jobs": cost.matrix_runs,
        },
    )


def study(size: str, command: str, options: Sequence[str], each: Round) -> Figure:
    """A study over one plain modal run."""
    place = each.bench.place("garteur", size)
    return over_plain(each.command(place, command, options), each.plain_s(place))


def starts(each: Round) -> Figure:
    """Updating from eight starts over updating from one."""
    place = each.bench.place("garteur", "fine")
    one = each.trial(place, "e").cost.wall_s
    eight = each.command(place, "update", ["--starts", "8"]).wall_s
    return Figure(eight / one, {"8 starts s": eight, "one s": one})


def later_solution(each: Round) -> Figure:
    """CalculiX's modal job over the same modes from matrices at other values."""
    found = modal_solution(each.bench.problem(each.bench.place("garteur", "fine", "large")))
    return Figure(
        found.native_s / found.later_s,
        {
            "equations": found.n_equations,
            "native s": found.native_s,
            "first s": found.first_s,
            "later s": found.later_s,
        },
    )


def beyond_solver(each: Round) -> Figure:
    """Return the time of an iteration with the solver's own modes, without CalculiX's."""
    place = each.bench.place("garteur", "coarse")
    folder = each.folder(f"{'-'.join(place)}-beyond")
    by_solver = [word for text in BY_SOLVER for word in ("--set", text)]
    words = ["update", *campaign(each.bench.problem(place), folder), *by_solver]
    cost = each.words(words, folder)
    (file,) = folder.glob("runs/*/campaign.h5")
    iterations = read_record(file).iterations
    spent_s = sum(iteration.wall_s for iteration in iterations)
    return Figure(
        (spent_s - cost.solver_s) / len(iterations),
        {"iterations": len(iterations), "together s": spent_s, "CalculiX s": cost.solver_s},
    )


def memory(each: Round) -> Figure:
    """Peak memory of a screening of ten times the points over that of the other."""
    place = each.bench.place("garteur", "coarse")
    many, few = (
        each.command(place, "screen", ["--method", "morris", "--points", str(count)], str(count))
        for count in (5000, 500)
    )
    return Figure(
        many.peak_bytes / few.peak_bytes,
        {
            "5,000 points GB": many.peak_bytes / 1e9,
            "s": many.wall_s,
            "500 points GB": few.peak_bytes / 1e9,
            "their s": few.wall_s,
        },
    )


def cached_demo(each: Round) -> Figure:
    """Return the time of a repeated demo with all results cached."""
    folder = each.folder("demo")
    words = ["demo", "six-mass" if each.bench.quick else "garteur"]
    first, again = (each.words(words, folder) for _ in range(2))
    return Figure(again.wall_s, {"first s": first.wall_s, "runs again": again.modal_runs})


def job_overhead(each: Round) -> Figure:
    """Return the time that Prefect adds to a job on threads."""
    found = overheads_ms(100 if each.bench.quick else 1000, each.folder("overhead"))
    return Figure(found["engine, tasks"] - found["engine, threads"], found)


def skipped(each: Round) -> Figure:
    """Return the share of wall time that e2 saves if sensitivities take runs."""
    place = each.bench.place("launcher", "medium")
    # Ten moduli against three modes: only at a small target do both end at the same ones.
    always, skips = (each.trial(place, letter, 1e-5) for letter in "cd")
    return saved((always.cost, always.answer), (skips.cost, skips.answer))


def thesis_cases(each: Round) -> Figure:
    """Return the share of wall time that Case I of the thesis's launcher saves of Case II."""
    folder = each.folder("thesis")
    copytree(Path(launcher.__file__).parent, folder, dirs_exist_ok=True)
    launcher.write_decks(folder)
    always, skips = (
        each.answer(["update", f"{name}.yaml", "--set", f"store={name}"], folder)
        for name in ("case_2", "case_1")
    )
    return saved(always, skips)


def saved(always: tuple[Cost, Answer], skips: tuple[Cost, Answer]) -> Figure:
    """Return what skipping saves of the wall time in percent, with how far apart both end."""
    (cost, end), (less, other) = always, skips
    frequencies = [
        abs(one["updated_hz"] / two["updated_hz"] - 1.0)
        for one, two in zip(end["modes"], other["modes"], strict=True)
    ]
    pairs = list(zip(end["parameters"], other["parameters"], strict=True))
    apart = [abs(one["updated"] - two["updated"]) for one, two in pairs]
    errors = [one["standard_error"] for one, _ in pairs]
    made_of = {
        "always s": cost.wall_s,
        "its runs": cost.modal_runs,
        "with e2 s": less.wall_s,
        "modal runs": less.modal_runs,
        "frequencies apart %": 100.0 * max(frequencies),
        "parameters apart %": 100.0 * max(apart),
    }
    if None not in errors:  # withheld
        made_of["in standard errors"] = max(
            gap / error for gap, error in zip(apart, errors, strict=True)
        )
    return Figure(100.0 * (1.0 - less.wall_s / cost.wall_s), made_of)


MORRIS = ["--method", "morris", "--points", "500"]
POSTERIOR = ["--walkers", "32", "--steps", "625"]
ROWS: tuple[Row[Round], ...] = (
    *(
        Row(
            f"peer-{name}",
            f"the best peer over modetune with default settings, {case} {size}",
            aim,
            True,
            partial(peer, case, size),
        )
        for name, case, size, aim in (
            ("coarse", "garteur", "coarse", 2.0),
            ("medium", "garteur", "medium", 4.0),
            ("fine", "garteur", "fine", 5.0),
            ("launcher", "launcher", "coarse", 1.5),
            ("plate", "plate", "medium", 1.5),
            ("bracket", "bracket", "medium", 1.5),
        )
    ),
    Row("flow", "a process with a bare Prefect flow of one task", 2.0, False, bare_flow, "s"),
    Row(
        "whole-fine",
        "campaign over one plain run, aircraft fine",
        1.9,
        False,
        partial(whole, "garteur", "fine", ""),
    ),
    Row(
        "launcher",
        "campaign over one plain run, launcher",
        2.0,
        False,
        partial(whole, "launcher", "medium", "large"),
    ),
    Row("later", "CalculiX's modal run over a later solution from matrices", 10.0, True,
        later_solution),
    *(
        Row(
            f"morris-{size}",
            f"500 Morris points over one plain run, aircraft {size}",
            aim,
            False,
            partial(study, size, "screen", MORRIS),
        )
        for size, aim in (("coarse", 6.0), ("fine", 3.0))
    ),
    Row(
        "posterior-fine",
        "20,000 posterior samples over one plain run, aircraft fine",
        4.0,
        False,
        partial(study, "fine", "sample", POSTERIOR),
    ),
    Row("starts-fine", "8 starts over one start, aircraft fine", 1.2, False, starts),
    Row("beyond", "an iteration less CalculiX, aircraft coarse", 0.2, False, beyond_solver, "s"),
    Row("memory", "peak memory of 5,000 Morris points over 500", 1.2, False, memory),
    Row("demo", "cached rerun of the demo, whole process", 2.5, False, cached_demo, "s"),
    Row("job", "Prefect's share of a job on threads", 15.0, False, job_overhead, "ms"),
    Row("e2", "wall saved by e2, launcher, 10 moduli", 40.0, True, skipped, "%"),
    Row("cases", "wall saved by Case I of the thesis's launcher", 25.0, True, thesis_cases, "%"),
)  # fmt: skip
