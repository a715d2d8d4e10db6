"""The ways of updating that are compared: each a command in a fresh folder with a fresh store.

a  one after another: finite differences one by one, numpy's least squares (published.py)
b  SciPy's least_squares around the solver (published.py)
c  the thesis's Case II: modetune, finite differences in each iteration
d  the thesis's Case I: the same, skipped where e2 allows, with Broyden's update
e  modetune as it comes
"""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from benchmarks.cost import Cost, Ended, calculix, run_counted
from benchmarks.plain import PlainModel
from benchmarks.problem import Problem

from modetune.core.modes import Floats
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
    """A way of updating: a method of published.py, or settings of `modetune update`."""

    letter: str
    name: str
    method: str = ""
    settings: tuple[str, ...] = ()


WAYS = (
    Way("a", "differences one by one, numpy", method="gauss_newton"),
    Way("b", "SciPy least_squares", method="least_squares"),
    Way("c", "thesis's Case II", settings=(*THESIS, "update.e2=0")),
    Way("d", "thesis's Case I", settings=THESIS),
    Way("e", "modetune as it comes"),
)
LETTERS = "".join(way.letter for way in WAYS)
#: The way that the others are compared with.
REFERENCE = "e"


@dataclass(frozen=True, slots=True)
class Trial:
    """One run of one way.

    parameters: where it ended, relative values. largest_error, mean_error: of the frequencies
    there, by one plain run; least_mac: of the shapes there, None without. largest_distance,
    mean_distance: of the parameters to the truth.
    """

    cost: Cost
    converged: bool
    parameters: tuple[float, ...]
    largest_error: float
    mean_error: float
    least_mac: float | None
    largest_distance: float
    mean_distance: float


@contextmanager
def prefect_server(use: ServerUse, home: Path) -> Iterator[None]:
    """Keeps a server up meanwhile, where campaigns are to find one running."""
    if use != "running":
        yield
        return
    before = dict(os.environ)
    os.environ[HOME_VARIABLE] = str(home)
    os.environ[IDLE_VARIABLE] = "10"  # it does not outlive a benchmark that is killed
    try:
        server = use_server()
    finally:  # campaigns shall find the server by its home, as those of users do
        os.environ.clear()
        os.environ.update(before)
    try:
        if server.wait() != "ready":
            sys.exit(f"Prefect's server does not answer; its log is in {home}")
        yield
    finally:
        server.close()
        stop_server(machine_home(home))


def run_way(
    way: Way, problem: Problem, model: PlainModel, folder: Path, server: ServerUse
) -> Trial:
    """Run a way in a new folder, which is deleted when it went well.

    Raises SystemExit where the command fails.
    """
    folder.mkdir(parents=True)
    if way.method:
        converged, theta, cost = _script(way, problem, folder)
    else:
        converged, theta, cost = _modetune(way, problem, folder, server)
    final = model.agreement(theta)
    errors = np.abs(final.errors)
    distance = problem.distance(theta)
    shutil.rmtree(folder)
    return Trial(
        cost,
        converged,
        tuple(theta.tolist()),
        float(errors.max()),
        float(errors.mean()),
        float(final.macs.min()) if final.macs.size else None,
        float(distance.max()),
        float(distance.mean()),
    )


def _script(way: Way, problem: Problem, folder: Path) -> tuple[bool, Floats, Cost]:
    command = [sys.executable, "-m", "benchmarks.published", way.method, str(problem.folder)]
    root = str(Path(__file__).resolve().parents[1])
    path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
    ended = run_counted(command, folder, {**os.environ, "PYTHONPATH": path}, calculix())
    told = _told(ended, way)
    return told["converged"], np.array(told["parameters"]), ended.cost


def _modetune(
    way: Way, problem: Problem, folder: Path, server: ServerUse
) -> tuple[bool, Floats, Cost]:
    command = [
        sys.executable,
        "-m",
        "modetune",
        "update",
        str(problem.campaign),
        "--json",
        "--runs",
        str(folder / "runs"),
    ]
    for setting in (*way.settings, f"store={folder / 'store'}"):
        command += ["--set", setting]
    if server == "none":
        command.append("--no-prefect")
    home = problem.folder.parent / "home"  # of the server that is kept up
    environment = {**os.environ, HOME_VARIABLE: str(home)}
    environment.pop(STORE_VARIABLE, None)
    try:
        ended = run_counted(command, folder, environment, calculix())
    finally:
        if server == "cold":
            stop_server(machine_home(home))
    told = _told(ended, way)
    theta = np.array([item["updated"] for item in told["parameters"]])
    return told["status"] == "converged", theta, ended.cost


def _told(ended: Ended, way: Way) -> Mapping[str, Any]:
    """The JSON object of a way. Raises SystemExit where it did not come to its end."""
    if ended.return_code not in (0, 3):  # 3: finished, the target not met
        sys.exit(
            f"way {way.letter} ({way.name}) failed with code {ended.return_code}:\n"
            f"{ended.errors[-2000:]}"
        )
    told: Mapping[str, Any] = json.loads(ended.output)
    return told
