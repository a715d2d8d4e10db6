"""Updating problems whose truth is known: a model, the modes of its hidden twin, and a target.

The twin is the same deck with other Young's moduli, run once by CalculiX; its modes, without
noise, are the test. Every way of updating reads the same folder and starts at the deck's values.

    model.inp       the deck                     measured.csv    the twin's modes
    campaign.yaml   the campaign of modetune     problem.json    the same for other ways

Frequencies alone are compared in their order. With shapes, modes are paired by MAC, and each unit
shape u_c is compared with the test's, brought to its scale: (u_m . u_c) u_m - u_c. The residual is
divided by the deviations of the campaign, so that its square is what modetune minimises too.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from benchmarks.large_deck import plate

from modetune.adapters.test_files.modes_csv import read_modes_csv, write_modes_csv
from modetune.configs.bracket import bracket
from modetune.configs.garteur import aircraft
from modetune.configs.launcher import launcher
from modetune.core.correlation.pairing import pair_by_shape
from modetune.core.modes import Floats, Integers, ModeSet, mode_set
from modetune.core.parameters import Parameter, ParameterSet

#: Default deviations and weights of campaigns.
FREQUENCY_DEVIATION = 0.002
SHAPE_DEVIATION = 0.05
SHAPE_WEIGHT = 0.1
#: Lowest MAC of a model that agrees.
LEAST_MAC = 0.9
#: Default largest relative frequency error of a model that agrees.
TARGET = 1e-4
#: Elastic modes of the aircraft that are compared.
GARTEUR_MODES = 8
#: Bounds of the moduli, and their deviation beforehand, relative to the deck's values.
BOUNDS = (0.6, 1.5)
DEVIATION = 0.2
#: The aircraft's hidden moduli. Unlike those of configs/garteur/twin.py they keep the fin's mode
#: away from the two drum modes, so that frequencies alone identify the modes at all points.
GARTEUR_TRUTH = {"FUSELAGE": 1.15, "WING": 0.90, "FIN": 0.85, "TAILPLANE": 0.90, "DRUMS": 1.25}
#: Between the meshes of the campaigns: 7,979 nodes and 5,108 elements.
MEDIUM = aircraft.AircraftMesh(size=18.0, layers=2, fuselage_height=18.75)
#: For tests of the benchmark: 804 nodes and 328 elements.
TINY = aircraft.AircraftMesh(size=50.0, layers=1, fuselage_height=75.0)
#: 145,488 nodes and 119,000 elements.
LARGE = aircraft.AircraftMesh(size=5.0, layers=5, fuselage_height=7.5)
AIRCRAFT = {
    "tiny": TINY,
    "coarse": aircraft.COARSE,
    "medium": MEDIUM,
    "fine": aircraft.FINE,
    "large": LARGE,
}
#: Degrees of freedom of the launcher, six a node as Nastran counts them, and its modes.
LAUNCHERS = {"coarse": 20_000, "medium": 100_000, "fine": 400_000, "large": 1_000_000}
LAUNCHER_MODES = 3
#: The launcher's hidden moduli: of the same mesh, so that a target however small can be met.
LAUNCHER_TRUTH = {
    "BASE": 0.90, "ARMS": 0.78, "GUSSETS": 1.15, "FITTING": 0.80, "RAIL_BOTTOM": 0.85,
    "RAIL_WEB": 0.92, "RAIL_TOP": 1.08, "RIBS": 0.80, "DUCT": 0.90, "GUIDES": 1.10,
}  # fmt: skip

CAMPAIGN = """\
name: {name}
model: {{deck: {deck}, solver: {solver}, units: mm-t-s}}
test: {{modes: measured.csv}}
parameters:
{parameters}
residuals:
  frequency_weight: 1.0
  shape_weight: {shape_weight}
  frequency_deviation: {frequency_deviation}
  shape_deviation: {shape_deviation}
update: {{e1: {{frequency: {target:g}, mac: {mac}}}}}
store: store
"""


@dataclass(frozen=True, slots=True)
class Agreement:
    """errors: (n_modes,), relative frequency errors of the measured modes. macs: (n_modes,), empty
    without shapes. residual: (n_residuals,), over its deviations."""

    errors: Floats
    macs: Floats
    residual: Floats

    def holds(self, target: float) -> bool:
        """Whether every frequency is within the target, and every shape is the test's."""
        return bool(np.abs(self.errors).max() <= target and (self.macs >= LEAST_MAC).all())


def agreement(measured: ModeSet, computed: ModeSet) -> Agreement:
    """Compare the measured modes with computed elastic ones at the same degrees of freedom.

    computed: at least as many, in ascending order, rows as those of the measured shapes.
    """
    if measured.n_dof == 0:
        errors = computed.frequencies_hz[: measured.n_modes] / measured.frequencies_hz - 1.0
        return Agreement(errors, np.zeros(0), errors / FREQUENCY_DEVIATION)
    pairing = pair_by_shape(measured, computed, lost_mac=0.0)
    paired = computed.select(pairing.computed[np.argsort(pairing.measured)])
    errors = paired.frequencies_hz / measured.frequencies_hz - 1.0
    tests, models = (
        modes.mode_shapes.real / np.linalg.norm(modes.mode_shapes, axis=0)
        for modes in (measured, paired)
    )
    cosines = np.sum(tests * models, axis=0)
    entry = SHAPE_DEVIATION / np.sqrt(SHAPE_WEIGHT * measured.n_dof)
    # The sign of a computed shape means nothing; the difference is taken in the test's.
    shapes = np.sign(cosines) * (cosines * tests - models) / entry
    residual = np.concatenate([errors / FREQUENCY_DEVIATION, shapes.ravel()])
    return Agreement(errors, cosines**2, residual)


@dataclass(frozen=True, slots=True)
class Model:
    """The model of a case and a size, in mm-t-s.

    write_deck: writes it to a path. truth: material to hidden modulus, relative to the deck's.
    n_modes: elastic modes compared; n_rigid: rigid-body modes below them. sensors: nodes at which
    shapes are compared; without them only frequencies are. bounds: of the moduli.
    """

    write_deck: Callable[[Path], object]
    truth: dict[str, float]
    n_modes: int
    n_rigid: int
    sensors: tuple[int, ...] = ()
    solver: str = "calculix"
    bounds: tuple[float, float] = BOUNDS


@dataclass(frozen=True, slots=True)
class Problem:
    """A problem in its folder.

    truth: hidden values in the order of the parameters. n_modes, n_rigid, sensors: as in Model.
    target: largest relative frequency error that ends updating. measured: the twin's modes, none
    until it has run. threads: of a run of CalculiX that has the machine to itself.
    """

    case: str
    size: str
    folder: Path
    parameters: tuple[Parameter, ...]
    truth: tuple[float, ...]
    n_modes: int
    n_rigid: int
    sensors: tuple[int, ...]
    target: float
    measured: ModeSet
    threads: int = 1
    solver: str = "calculix"

    @property
    def deck(self) -> Path:
        return self.folder / ("model.inp" if self.solver == "calculix" else "model.bdf")

    @property
    def campaign(self) -> Path:
        return self.folder / "campaign.yaml"

    @property
    def parameter_set(self) -> ParameterSet:
        """The parameters with their bounds as arrays."""
        return ParameterSet(self.parameters)

    def agreement(self, computed: ModeSet) -> Agreement:
        """How the model's elastic modes agree with the test."""
        return agreement(self.measured, computed)

    def distance(self, theta: Floats) -> Floats:
        """How far each parameter is from the hidden truth, (n_parameters,)."""
        return np.asarray(np.abs(theta - np.array(self.truth)))


def garteur(size: str) -> Model:
    """The aircraft of configs/garteur, free-free."""
    mesh = AIRCRAFT[size]

    def write(path: Path) -> None:
        path.write_text(aircraft.calculix_deck(mesh))

    return Model(write, GARTEUR_TRUTH, GARTEUR_MODES, 6)


#: Grid points of the plate for MYSTRAN, of five strips (large_deck.py).
PLATES = {"tiny": 300, "medium": 6_000, "large": 100_000}
PLATE_TRUTH = {"1": 1.20, "2": 0.85, "3": 1.10, "4": 0.80, "5": 1.25}


def plate_of(size: str) -> Model:
    """A clamped plate of five strips, a Nastran deck that MYSTRAN runs."""

    def write(path: Path) -> None:
        path.write_text(plate(PLATES[size])[0])

    return Model(write, PLATE_TRUTH, 6, 0, solver="mystran")


#: Edge of the bracket's tetrahedra, mm.
BRACKETS = {"tiny": 30.0, "medium": 7.0}
BRACKET_TRUTH = {
    "BASE_NEAR": 1.5, "BASE_FAR": 0.6, "WALL_LOW": 0.65, "WALL_HIGH": 1.4, "RIB_LOW": 1.6,
    "RIB_HIGH": 0.7,
}  # fmt: skip


def bracket_of(size: str) -> Model:
    """The bracket of configs/bracket in six halves of its parts, free, far from its truth."""
    made = bracket.mesh(BRACKETS[size])
    middles = {name: made.coordinates[rows - 1].mean(axis=1) for name, rows in made.parts.items()}
    cuts = {"BASE": (0, "NEAR", "FAR"), "WALL": (2, "LOW", "HIGH"), "RIB": (2, "LOW", "HIGH")}
    parts: dict[str, Integers] = {}
    for name, (axis, below, above) in cuts.items():
        low = middles[name][:, axis] < np.median(middles[name][:, axis])
        parts |= {f"{name}_{below}": made.parts[name][low]}
        parts |= {f"{name}_{above}": made.parts[name][~low]}
    halves = bracket.TetrahedralMesh(made.coordinates, parts)
    corners = np.unique(np.concatenate([rows[:, :4].ravel() for rows in parts.values()]))
    places = np.linspace(0, corners.size - 1, 16).astype(int)

    def write(path: Path) -> None:
        path.write_text(bracket.calculix_deck(halves))

    sensors = tuple(corners[places].tolist())
    return Model(write, BRACKET_TRUTH, 8, 6, sensors, bounds=(0.3, 2.5))


def launcher_of(size: str) -> Model:
    """The bare launcher of configs/launcher, bolted down, with shapes at its sensors."""
    mesh = launcher.mesh_of(LAUNCHERS[size])

    def write(path: Path) -> None:
        with path.open("wb") as file:
            launcher.write_deck(file, mesh, unit=False)

    sensors = tuple(range(1, len(launcher.SENSORS) + 1))
    return Model(write, LAUNCHER_TRUTH, LAUNCHER_MODES, 0, sensors)


#: Case to its sizes and what makes its model.
CASES: dict[str, tuple[tuple[str, ...], Callable[[str], Model]]] = {
    "garteur": (tuple(AIRCRAFT), garteur),
    "launcher": (tuple(LAUNCHERS), launcher_of),
    "plate": (tuple(PLATES), plate_of),
    "bracket": (tuple(BRACKETS), bracket_of),
}


def set_up(case: str, size: str, target: float, folder: Path) -> Problem:
    """Write the deck of a problem; its test is still to come."""
    model = CASES[case][1](size)
    folder.mkdir(parents=True)
    parameters = tuple(
        Parameter(f"E_{name}", "youngs_modulus", "material", (name,), *model.bounds, DEVIATION)
        for name in model.truth
    )
    problem = Problem(
        case,
        size,
        folder,
        parameters,
        tuple(model.truth.values()),
        model.n_modes,
        model.n_rigid,
        model.sensors,
        target,
        mode_set([]),
        solver=model.solver,
    )
    model.write_deck(problem.deck)
    return problem


def write_problem(problem: Problem) -> None:
    """Write test, campaign and problem.json next to the deck."""
    numbers = range(1, problem.n_modes + 1)
    write_modes_csv(problem.folder / "measured.csv", numbers, problem.measured, ["a twin's modes"])
    parameters = "\n".join(
        f"  - {{name: {item.name}, quantity: youngs_modulus, material: {item.targets[0]}, "
        f"bounds: [{item.lower}, {item.upper}]}}"
        for item in problem.parameters
    )
    problem.campaign.write_text(
        CAMPAIGN.format(
            name=f"{problem.case}-{problem.size}",
            deck=problem.deck.name,
            solver=problem.solver,
            parameters=parameters,
            target=problem.target,
            mac=LEAST_MAC,
            shape_weight=SHAPE_WEIGHT if problem.sensors else 0.0,
            frequency_deviation=FREQUENCY_DEVIATION,
            shape_deviation=SHAPE_DEVIATION,
        )
    )
    told = asdict(problem)
    for known in ("folder", "measured"):
        told.pop(known)
    (problem.folder / "problem.json").write_text(json.dumps(told))


def read_problem(folder: Path) -> Problem:
    """The problem that `write_problem` left in a folder."""
    told = json.loads((folder / "problem.json").read_text())
    told["parameters"] = tuple(
        Parameter(**{**item, "targets": tuple(item["targets"])}) for item in told["parameters"]
    )
    told["truth"], told["sensors"] = tuple(told["truth"]), tuple(told["sensors"])
    return Problem(folder=folder, measured=read_modes_csv(folder / "measured.csv").modes, **told)
