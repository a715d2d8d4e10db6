"""Dakota as a peer: its own program, which starts a script for each point (`dakota_driver.py`).

NL2SOL (Dennis, Gay and Welsch 1981) with forward differences, as many points at a time as there are
cores, one thread each. Dakota's own settings for convergence are put below what the target needs;
the first point on target ends it. Its best settings were found once (docs/benchmarks.md).
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
from benchmarks.plain import PlainModel, cores
from benchmarks.problem import (
    FREQUENCY_DEVIATION,
    LEAST_MAC,
    SHAPE_DEVIATION,
    SHAPE_WEIGHT,
    Problem,
)

from modetune.core.modes import Floats

#: Relative step of its differences.
STEP = 0.01
MAX_ITERATIONS = 20
DRIVER = Path(__file__).with_name("dakota_driver.py")
#: Change of a value that shows where it is in a deck.
MARK = 1.0625
NUMBER = re.compile(r"[-+.\dEe]+")
#: Characters of a Nastran field.
FIELD = 8
#: The file of a folder with the first point on target, and what each solver's job leaves.
MET = "met.json"
RESULTS = {"calculix": "job.dat", "mystran": "job.F06"}
STUDY = """\
environment
  output_file 'dakota.out'
method
  nl2sol
    convergence_tolerance 1e-12
    x_conv_tol 1e-10
    initial_trust_radius 1000
    max_iterations {iterations}
    max_function_evaluations 100000
  output silent
variables
  continuous_design {n_parameters}
    descriptors {names}
    initial_point {initial}
    lower_bounds {lower}
    upper_bounds {upper}
interface
  analysis_drivers '{driver}'
  fork
  asynchronous evaluation_concurrency {parallel}
  deactivate restart_file
responses
  calibration_terms {n_residuals}
  numerical_gradients
    method_source dakota
    interval_type forward
    fd_step_size {step}
  no_hessians
"""


def write_study(problem: Problem, folder: Path, solver: str, step: float = STEP) -> list[str]:
    """Write Dakota's input, the deck's template and what the driver needs; return the command.

    folder: where the command runs. solver: the solver's program.
    """
    model, parameters = PlainModel(problem), problem.parameter_set
    (deck,) = _deck(model, parameters.initial, folder).items()
    template, values = deck[1], dict[str, tuple[float, int, int]]()
    most = 0 if problem.solver == "calculix" else FIELD
    for place, name in enumerate(parameters.names):
        marked = parameters.initial.copy()
        marked[place] *= MARK
        text = _deck(model, marked, folder)[deck[0]]
        template, value, width = _with_name(template, deck[1], text, name)
        values[name] = value / parameters.initial[place], most, width
    (folder / "template").write_text(template)
    measured, program_of = problem.measured, model.solver.program
    spec = {
        "solver": problem.solver,
        "template": str(folder / "template"),
        "deck": deck[0],
        "results": RESULTS[problem.solver],
        "command": [solver, *program_of.command(1).arguments[1:]],
        "values": values,
        "n_rigid": problem.n_rigid,
        "hz": measured.frequencies_hz.tolist(),
        "nodes": list(problem.sensors),
        "shapes": measured.mode_shapes.real.T.tolist() if problem.sensors else [],
        "target": problem.target,
        "least_mac": LEAST_MAC,
        "frequency_deviation": FREQUENCY_DEVIATION,
        "shape_deviation": SHAPE_DEVIATION,
        "shape_weight": SHAPE_WEIGHT,
        "met": str(folder / MET),
    }
    (folder / "spec.json").write_text(json.dumps(spec))
    bare = () if problem.sensors else ("-I", "-S")  # shapes take numpy
    driver = shlex.join([sys.executable, *bare, str(DRIVER), str(folder / "spec.json")])
    study = STUDY.format(
        iterations=MAX_ITERATIONS,
        n_parameters=len(parameters.names),
        names=" ".join(f"'{name}'" for name in parameters.names),
        initial=_row(parameters.initial),
        lower=_row(parameters.lower),
        upper=_row(parameters.upper),
        driver=driver,
        parallel=cores(),
        n_residuals=problem.agreement(measured).residual.size,
        step=step,
    )
    (folder / "study.in").write_text(study)
    return [program(), "-i", "study.in"]


def result(problem: Problem, folder: Path) -> tuple[bool, Floats]:
    """Whether Dakota met the target in its folder, and where it ended; else the start."""
    met = folder / MET
    if not met.exists():
        return False, problem.parameter_set.initial
    values = json.loads(met.read_text())
    return True, np.array([values[name] for name in problem.parameter_set.names])


def program() -> str:
    """Full path of Dakota. Raises SystemExit where it is not installed."""
    own = str(Path(sys.executable).parent)  # before others
    path = os.pathsep.join([own, os.environ.get("PATH", "")])
    found = shutil.which("dakota", path=path)
    if found is None:
        sys.exit("Dakota is not installed: pip install 'modetune[bench]'")
    return found


def _deck(model: PlainModel, theta: Floats, folder: Path) -> dict[str, str]:
    """The files of a job, by name."""
    place = folder / "rendered"
    place.mkdir()
    model.render(theta).write(place)
    found = {path.name: path.read_text() for path in place.iterdir()}
    shutil.rmtree(place)
    return found


def _with_name(template: str, before: str, after: str, name: str) -> tuple[str, float, int]:
    """A template with @NAME@ for the numbers that differ between two decks, and what they were.

    The value comes with the width of its field, 0 where fields are free.
    """
    lines, found, width = template.split("\n"), set[float](), 0
    for place, (one, other) in enumerate(zip(before.split("\n"), after.split("\n"), strict=True)):
        changed = one != other and _changed(one, other)
        if not changed:
            continue
        found.add(float(changed[0]))
        if "," in one:
            lines[place] = lines[place].replace(changed[0], f"@{name}@", 1)
        else:
            width, start = FIELD, changed.start() // FIELD * FIELD
            lines[place] = f"{one[:start]}@{name}@{one[start + FIELD :]}"
    (value,) = found
    return "\n".join(lines), value, width


def _changed(one: str, other: str) -> re.Match[str] | None:
    """The number of a line that the other has MARK times; names of jobs differ too."""
    for before, after in zip(NUMBER.finditer(one), NUMBER.finditer(other), strict=False):
        with suppress(ValueError, ZeroDivisionError):
            if abs(float(after[0]) / float(before[0]) / MARK - 1.0) < 1e-4:
                return before
    return None


def _row(values: Floats) -> str:
    return " ".join(repr(float(value)) for value in values)
