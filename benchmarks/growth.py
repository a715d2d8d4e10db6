"""How time and memory of whole commands grow: with grids, parameters, sensors and points.

    grids        a Nastran plate (large_deck.py): `check --no-run` of its campaign; and `update` of
                 the launcher on CalculiX, degrees of freedom at six a node
    parameters   springs of a chain of masses, twice as many frequencies: `check`, `update`
    elements     of the first of a plate's five strips, each with a modulus of its own (a field), on
                 MYSTRAN: `update`
    sensors      of the aircraft, whose shapes are compared: `check --no-run`, `update`
    points       of a screening of the aircraft: `screen --method morris`

    python -m benchmarks.growth [--cases points] [--most 100000]

Each command runs once in a process of its own, without Prefect, with a new store; what makes its
files is not counted. The exponents, of processor time and memory, are those between the two largest
sizes. Finished pieces are kept in runs/nightly/growth.jsonl. The last line of the output is one
JSON object.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from benchmarks.cost import calculix
from benchmarks.journal import FOLDER, Journal
from benchmarks.large_deck import STRIPS, plate
from benchmarks.plain import PlainModel
from benchmarks.problem import BOUNDS, LAUNCHERS, PLATES, Problem, set_up, write_problem
from benchmarks.ways import campaign, modetune, told
from scipy.linalg import eigh_tridiagonal

from modetune.core.errors import ModetuneError

#: Makes the files of a size in a folder; returns the words of the command.
Make = Callable[[int, Path], Sequence[str]]


@dataclass(frozen=True, slots=True)
class Growth:
    """What grows, by which command. sizes: ascending."""

    what: str
    command: str
    sizes: tuple[int, ...]
    make: Make
    solver: str = "calculix"

    @property
    def name(self) -> str:
        return f"{self.what}, {self.command}"


def plate_check(n_grids: int, folder: Path) -> Sequence[str]:
    """The pre-check of a plate's campaign, without a run."""
    (folder / "plate.bdf").write_text(plate(n_grids)[0])
    (folder / "measured.csv").write_text("mode,1,2,3\nfrequency_hz,0.5,3.1,3.4\n")
    lines = ["name: plate", "model: {deck: plate.bdf, solver: mystran, units: mm-t-s}"]
    lines += ["test: {modes: measured.csv}", "parameters:"]
    lines += [
        f"  - {{name: E{n}, quantity: youngs_modulus, material: {n}, bounds: [0.5, 1.5]}}"
        for n in range(1, STRIPS + 1)
    ]
    (folder / "campaign.yaml").write_text("\n".join([*lines, "store: store", ""]))
    return ["check", str(folder / "campaign.yaml"), "--no-run"]


def launcher_update(n_freedoms: int, folder: Path) -> Sequence[str]:
    """The update of the launcher's ten moduli."""
    size = str(n_freedoms)
    LAUNCHERS[size] = n_freedoms
    return updated(set_up("launcher", size, 1e-3, folder / "model"), folder)


def aircraft(folder: Path, n_sensors: int = 0) -> Problem:
    """The aircraft at so many sensors, three a node; the fine mesh has 85,000."""
    found = set_up("garteur", "fine" if n_sensors > 1000 else "coarse", 1e-3, folder / "model")
    nodes = sorted(PlainModel(found).solver.deck.summary.node_ids)
    places = np.linspace(0, len(nodes) - 1, math.ceil(n_sensors / 3)).astype(int)
    return replace(found, sensors=tuple(nodes[place] for place in np.unique(places)))


def tested(problem: Problem) -> Problem:
    """A problem with the modes of its hidden twin as its test, written to its folder."""
    modes, _ = PlainModel(problem).modes(np.array(problem.truth))
    found = replace(problem, measured=modes.select(range(problem.n_modes)))
    write_problem(found)
    return found


def updated(problem: Problem, folder: Path) -> Sequence[str]:
    return ["update", *campaign(tested(problem), folder)]


def field_update(n_elements: int, folder: Path) -> Sequence[str]:
    """The update of a field over the elements of a plate's first strip, and of the other four."""
    size = str(n_elements)
    PLATES[size] = STRIPS * n_elements
    problem = tested(set_up("plate", size, 1e-3, folder / "model"))
    whole = f"material: 1, bounds: [{BOUNDS[0]}, {BOUNDS[1]}]"
    text = problem.campaign.read_text()
    assert whole in text
    problem.campaign.write_text(text.replace(whole, f"{whole}, field: {{zones: elements}}"))
    return ["update", *campaign(problem, folder)]


def sensors_check(n_sensors: int, folder: Path) -> Sequence[str]:
    """The pre-check of the aircraft with shapes, without a run."""
    return ["check", str(tested(aircraft(folder, n_sensors)).campaign), "--no-run"]


def sensors_update(n_sensors: int, folder: Path) -> Sequence[str]:
    """The update of the aircraft to frequencies and shapes."""
    return updated(aircraft(folder, n_sensors), folder)


def screening(n_points: int, folder: Path) -> Sequence[str]:
    """A screening of the aircraft."""
    words = campaign(tested(aircraft(folder)), folder)
    return ["screen", *words, "--method", "morris", "--points", str(n_points)]


def chain(n_parameters: int, folder: Path) -> Path:
    """A chain of twice as many masses held at one end, every second of whose springs is unknown.

    Returns its campaign. Its test has the frequencies of all modes with other springs.
    """
    n = 2 * n_parameters
    rng = np.random.default_rng(3)
    deck = 1000.0 * rng.uniform(0.5, 2.0, n)
    truth = deck * np.where(np.arange(n) % 2, rng.uniform(0.9, 1.1, n), 1.0)
    diagonal, beside = truth + np.append(truth[1:], 0.0), -truth[1:]
    hz = np.sqrt(eigh_tridiagonal(diagonal, beside, eigvals_only=True)) / (2.0 * np.pi)
    lines = ["masses:", *(f"  m{k}: 1.0" for k in range(1, n + 1)), "springs:"]
    names = ["ground", *(f"m{k}" for k in range(1, n + 1))]
    lines += [
        f"  k{k}: {{between: [{names[k]}, {names[k + 1]}], stiffness: {deck[k]:.12g}}}"
        for k in range(n)
    ]
    (folder / "chain.yaml").write_text("\n".join([*lines, ""]))
    head = ["mode", *map(str, range(1, n + 1))]
    rows = [",".join(head), ",".join(["frequency_hz", *(f"{value:.12g}" for value in hz)])]
    (folder / "measured.csv").write_text("\n".join([*rows, ""]))
    lines = ["name: chain", "model: {deck: chain.yaml, solver: matrices, units: m-kg-s}"]
    lines += ["test: {modes: measured.csv}", "residuals: {shape_weight: 0.0}", "parameters:"]
    lines += [
        f"  - {{name: k{k}, quantity: spring_stiffness, elset: k{k}, bounds: [0.5, 2.0]}}"
        for k in range(1, n, 2)
    ]
    place = folder / "campaign.yaml"
    place.write_text("\n".join([*lines, "update: {starts: 1}", "store: store", ""]))
    return place


def chain_check(n_parameters: int, folder: Path) -> Sequence[str]:
    """The pre-check of a chain."""
    return ["check", str(chain(n_parameters, folder))]


def chain_update(n_parameters: int, folder: Path) -> Sequence[str]:
    """The update of a chain."""
    return ["update", str(chain(n_parameters, folder)), "--runs", str(folder / "runs")]


CASES = (
    Growth("grids", "check", (1_000, 10_000, 100_000, 1_000_000), plate_check),
    Growth("freedoms", "update", (20_000, 100_000, 400_000), launcher_update),
    Growth("parameters", "check", (5, 50, 500), chain_check),
    Growth("parameters", "update", (5, 50, 200, 500), chain_update),
    Growth("elements", "update", (100, 500, 2_000), field_update, solver="mystran"),
    Growth("sensors", "check", (10, 100, 1_000, 10_000, 80_000), sensors_check),
    Growth("sensors", "update", (10, 100, 1_000, 10_000, 80_000), sensors_update),
    Growth("points", "screen", (100, 1_000, 10_000, 100_000), screening),
)


def measure(case: Growth, size: int) -> dict[str, float]:
    """Seconds and bytes of a command at a size. Raises SystemExit where it fails."""
    with tempfile.TemporaryDirectory(prefix="modetune-growth-") as name:
        folder = Path(name)
        words = case.make(size, folder)
        ended = modetune(words, folder, folder / "home", "none", solver=case.solver)
    told(ended, f"modetune {words[0]} of {size} {case.what}")
    cost = ended.cost
    return {
        "size": size,
        "wall_s": cost.wall_s,
        "cpu_s": cost.cpu_s,
        "solver_s": cost.solver_s,
        "peak_bytes": cost.peak_bytes,
    }


def exponent(found: Sequence[dict[str, float]], key: str) -> float:
    """p of size^p between the two largest sizes."""
    (small, before), (large, after) = ((each["size"], each[key]) for each in found[-2:])
    return math.log(after / before) / math.log(large / small)


def lines(case: Growth, found: Sequence[dict[str, float]]) -> Iterator[str]:
    """A case as rows of Markdown."""
    for each in found:
        yield (
            f"| {case.name} | {each['size']:,.0f} | {each['wall_s']:.1f} | {each['cpu_s']:.1f} | "
            f"{each['solver_s']:.1f} | {each['peak_bytes'] / 1e9:.2f} | |"
        )
    if len(found) > 1:
        told = ", ".join(
            f"{name} {exponent(found, key):.2f}"
            for name, key in (("CPU", "cpu_s"), ("memory", "peak_bytes"))
        )
        yield f"| {case.name} | | | | | | {told} |"


def main(arguments: list[str] | None = None) -> None:
    """Measure the requested cases."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    names = sorted({case.what for case in CASES})
    parser.add_argument("--cases", nargs="+", choices=names, default=names)
    parser.add_argument("--most", type=int, default=10**9, help="the largest size")
    chosen = parser.parse_args(arguments)
    calculix()
    plan = {"cases": sorted(chosen.cases), "most": chosen.most}
    heads = "command", "size", "s", "CPU s", "solver s", "GB", "exponents"
    sys.stdout.write(f"| {' | '.join(heads)} |\n|{' --- |' * len(heads)}\n")
    results: dict[str, list[dict[str, float]]] = {}
    with closing(Journal(FOLDER / "growth.jsonl", plan)) as journal:
        for case in (case for case in CASES if case.what in chosen.cases):
            found = results[case.name] = []
            for size in (size for size in case.sizes if size <= chosen.most):
                piece = f"{case.name} {size}"
                if piece not in journal.results:
                    journal.add(piece, measure(case, size))
                found.append(journal.results[piece])
            sys.stdout.write("\n".join(lines(case, found)) + "\n")
            sys.stdout.flush()
        journal.end()
    sys.stdout.write(json.dumps(results) + "\n")


if __name__ == "__main__":
    try:
        main()
    except ModetuneError as error:
        sys.exit(str(error))
