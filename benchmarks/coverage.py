"""Updates of many twins with known truth, and counts of their verdicts.

    python -m benchmarks.coverage [--twins 200] [--exact 500] [--structures six_mass chain_18]
                                  [--fault correlated|mixed|gains]

Noisy twins: parameters, frequencies and shapes are drawn with the deviations that the campaign
states; everything else has its default. A line per structure shows the share of printed 95 %
intervals (the value plus and minus 1.96 standard errors) that contain the truth: the lowest and
highest of any parameter, and the mean. Then it shows the shares of updates that ended at the start,
that suspect a model-form error (no structure has one), and that withhold standard errors. Last are
two figures of the p-values of the test for a model-form error: the Kolmogorov distance from a
uniform distribution, and the share below 0.01.

A fault is noise of the test that the campaign does not state: frequencies whose errors correlate by
0.9, shapes that each hold 5 % of their neighbours' (of the rms), or sensors whose gains are off by
3 %. The share of trusted answers and, of their parameters, those more than three standard errors
off end each line.

Exact twins: the shares of twins that reached the truth, that ended elsewhere but were called
trusted, and that were suspected of a model-form error. Some structures have repeated modes.

Every model is matrices, solved in this process without a store: a twin takes a few hundredths of a
second. The aircraft is the coarse one of configs/garteur, reduced to the unknowns of its sensors
(SEREP, O'Callahan 1989), which takes CalculiX a few seconds.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.zoo.families import FAMILIES
from benchmarks.zoo.matrix_models import spring
from benchmarks.zoo.structure import Generator, Structure
from scipy import linalg, stats

import modetune
from modetune.configs.cases import write_case
from modetune.configs.measuring import noisy, signed
from modetune.configs.six_mass import system
from modetune.core.algebra.eigen import ModeSolver
from modetune.core.correlation.pairing import LostMode
from modetune.core.modes import COMPONENTS, REPEATED, Floats, MeasuredModes, ModeSet, close_sets
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.updating.job_results import ModalResult
from modetune.core.updating.observation import observe
from modetune.core.updating.reduced_basis import reduce, unreduced
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.execution import Execution
from modetune.flows.report.form_verdict import record_verdict
from modetune.flows.updating.evaluation import compare
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.forecast import Unwatched
from modetune.flows.updating.matrices import MatrixSource
from modetune.flows.updating.mode_source import CaseState, campaign_analysis
from modetune.flows.updating.reduced_model import ReducedModes
from modetune.flows.updating.update import Updating

#: Half width, in standard errors, of an interval that contains the truth in 95 of 100 cases.
INTERVAL = 1.96
#: Standard deviation of the true values of twins, relative to the deck: half the default deviation.
SCATTER = 0.1
#: Correlation of frequencies, share of neighbours' shapes, and error of gains, of each fault.
CORRELATION, MIXED, GAIN = 0.9, 0.05, 0.03
FAULTS = ("correlated", "mixed", "gains")
#: An answer is wrong beyond this many standard errors.
FAR = 3.0
#: An exact twin reached the truth if its parameters are within this of it.
FOUND = 1e-3


def storeys(n: int) -> dict[str, Any]:
    """A frame from the ground up, alike in all storeys, the spring of each a part."""
    parts = {f"k{place + 1}": {"stiffness": spring(n, place - 1, place, 1e3)} for place in range(n)}
    stiffness = sum((part["stiffness"] for part in parts.values()), np.zeros((n, n)))
    return {"stiffness": stiffness, "mass": np.eye(n), "parts": parts}


def structure(family: str, model: dict[str, Any], sought: Sequence[str], n_modes: int) -> Structure:
    parameters = [{"name": name, "quantity": "matrix_factor", "part": name} for name in sought]
    nodes = range(1, len(model["mass"]) + 1)
    return Structure(family, model, tuple(parameters), tuple(nodes), n_modes, "matrices")


def six_mass(rng: Generator) -> Structure:
    """The six masses of configs/six_mass, three of its springs."""
    order = ["ground", *system.MASSES]
    parts = {}
    for name, (k, _) in system.SPRINGS.items():
        first, second = (order.index(end) - 1 for end in system.BETWEEN[name])
        parts[name] = {"stiffness": spring(6, first, second, k)}
    stiffness = sum((part["stiffness"] for part in parts.values()), np.zeros((6, 6)))
    mass = np.diag([value for value, _ in system.MASSES.values()])
    model = {"stiffness": stiffness, "mass": mass, "parts": parts}
    return structure("six_mass", model, ["k1", "k4", "k9"], 6)


def chain_18(rng: Generator) -> Structure:
    """A frame of 18 storeys, all of its springs."""
    model = storeys(18)
    return structure("chain_18", model, list(model["parts"]), 4)


def aircraft(rng: Generator) -> Structure:
    """The coarse aircraft, free: its five moduli."""
    with tempfile.TemporaryDirectory(prefix="coverage-") as name:
        folder = Path(name)
        write_case("garteur", folder)
        campaign = load_campaign(folder / "twin.yaml", [f"store={folder / 'store'}"])
        engine = job_engine(campaign)
        source = MatrixSource(engine, campaign.parameters, 0.01)
        every = range(len(campaign.parameters))
        for job in source.jobs(campaign.start, every):
            engine.solve(job)
        affine = source.matrices(campaign.start, every)
    here, solver = affine.at(campaign.start), ModeSolver()
    solved = solver.solve(here.upper_stiffness, here.upper_mass, 24, -1e3)
    observer = observe(here, here.nodes, here.components).matrix
    reduced, basis = reduce(
        affine,
        campaign.start,
        solved.eigenvalues,
        solved.shapes,
        solver.inverse,
        np.arange(6, 14),
        6,
        observer,
    )
    _, pivots = linalg.qr(basis.T, mode="r", pivoting=True)
    rows = np.sort(pivots[: basis.shape[1]])
    back = np.linalg.inv(basis[rows])

    def seen(matrix: Floats) -> Floats:
        turned = back.T @ matrix @ back
        return np.asarray(0.5 * (turned + turned.T))

    stiffness, mass = (seen(matrix) for matrix in reduced.at(campaign.start))
    names = campaign.parameters.names
    parts = {names[part.column]: {"stiffness": seen(part.values[0])} for part in reduced.stiffness}
    dofs = [
        f"{node}.{COMPONENTS[axis - 1]}"
        for node, axis in zip(here.nodes[rows], here.components[rows], strict=True)
    ]
    model = {"stiffness": stiffness, "mass": mass, "parts": parts, "dofs": dofs}
    return structure("aircraft", model, list(parts), 8)


#: Structures of noisy twins, and whether shapes are compared in addition to frequencies.
NOISY: dict[str, tuple[Callable[[Generator], Structure], bool]] = {
    "six_mass": (six_mass, False),
    "chain_18": (chain_18, True),
    "aircraft": (aircraft, False),
}
#: Eigenvalues below this share of the largest one are rounding.
ROUNDING = 1e-7
#: Other starts, which updates of matrix models try, take ten times as long as one.
ALONE: dict[str, Any] = {"starts": 1}
#: Structures of exact twins, each with a different structure.
EXACT = ("chain", "mechanism", "polar_masses", "assembly")


@dataclass(frozen=True, slots=True)
class Twin:
    """How the update of a twin ended; held, far: (n_parameters,), whether the interval has the
    truth, and whether the truth is more than three standard errors away; withheld: whether no
    interval is printed."""

    held: tuple[bool, ...]
    far: tuple[bool, ...]
    withheld: bool
    p_value: float
    found: bool
    trusted: bool
    accused: bool
    iterations: int


class Model:
    """A structure ready for its twins: a campaign of it, and its matrices for all values."""

    def __init__(self, made: Structure, shapes: bool, settings: dict[str, Any], folder: Path):
        dofs = _dofs(made)
        loaded = modetune.load(
            {
                "name": made.family,
                "model": made.deck,
                "test": {
                    "frequencies_hz": np.arange(1.0, made.n_modes + 1.0),
                    "mode_shapes": np.ones((len(dofs), made.n_modes)),
                    "dofs": dofs,
                },
                "parameters": list(made.parameters),
                "residuals": {"shape_weight": 1.0} if shapes else {},
                "update": settings,
                "report": {"page": False},
                "run": {"parallel": 1, "threads": 1},
                "store": str(folder / "store"),
            },
            folder=folder,
        )
        self.campaign, self.engine = loaded, job_engine(loaded)
        source = MatrixSource(self.engine, loaded.parameters, 0.01)
        affine = source.matrices(loaded.start, range(len(loaded.parameters)))
        nodes = np.repeat(np.array(sorted(loaded.case.nodes), dtype=np.int64), 3)
        self.nodes, self.components = nodes, np.tile(np.arange(1, 4), nodes.size // 3)
        here = affine.base
        observer = observe(here, self.nodes, self.components).matrix
        largest = np.abs(here.upper_stiffness.diagonal()).max() / here.upper_mass.diagonal().min()
        self.reduced = unreduced(affine, -1e-6 * float(largest), observer)
        self.n_modes = min(loaded.case.n_modes, here.nodes.size)
        eigenvalues, _ = self.reduced.combinations(loaded.start, self.n_modes)
        self.n_rigid = int(np.sum(eigenvalues < ROUNDING * eigenvalues[-1]))
        self.dofs = np.flatnonzero(observer @ np.ones(here.nodes.size))

    def modal(self, theta: Floats) -> ModalResult:
        eigenvalues, shapes = self.reduced.modes(theta, self.n_modes)
        energies = 0.5 * eigenvalues
        return ModalResult.of_shapes(
            eigenvalues, shapes, self.nodes, self.components, energies, self.n_rigid
        )

    def measured(self, truth: Floats, rng: Generator) -> ModeSet:
        """What an exact test of the true structure gives, modes of one frequency at any angle."""
        found = self.modal(truth).elastic.rows(self.dofs)
        found = found.select(range(len(self.campaign.test.numbers)))
        shapes = found.mode_shapes.copy()
        for members in close_sets(found.frequencies_hz, 0.5 * REPEATED):
            if members.size > 1:
                turn = stats.ortho_group.rvs(members.size, random_state=rng)
                shapes[:, members] = shapes[:, members] @ turn
        return replace(found, mode_shapes=shapes)

    def update(self, test: ModeSet) -> CampaignRecord:
        """The record of an update with this test."""
        loaded = self.campaign
        measured = MeasuredModes(loaded.test.numbers, test)
        case = replace(loaded.case, test=measured)
        own = replace(loaded, cases=(case,))
        name = case.solver.program.name
        modal = self.modal(own.start)
        around = compare(case, own.start, "", modal, None, name)
        state = CaseState(
            case,
            own,
            np.arange(len(own.parameters)),
            self.engine,
            ReducedModes(self.reduced, around, around.key, name=name),
            campaign_analysis(own),
        )
        evaluator = Evaluator(own, [state], Execution(self.engine))
        return Updating(own, evaluator, Unwatched(), lambda record: None).run()


def _dofs(made: Structure) -> list[str]:
    assert isinstance(made.deck, dict)
    return made.deck.get("dofs") or [f"{n + 1}.x" for n in range(len(made.deck["mass"]))]


def faulty(test: ModeSet, fault: str, frequency_deviation: float, rng: Generator) -> ModeSet:
    """Return a test with noise that its campaign does not state."""
    if fault == "correlated":  # the frequencies' own noise is added later, smaller by as much
        shared = np.sqrt(CORRELATION / (1.0 - CORRELATION)) * frequency_deviation
        return replace(test, frequencies_hz=test.frequencies_hz * (1.0 + shared * rng.normal()))
    shapes = test.mode_shapes
    if fault == "mixed":
        rms = np.sqrt(np.mean(shapes**2, axis=0))
        unit, shares = shapes / rms, MIXED * rng.standard_normal((2, test.n_modes))
        before, after = np.roll(unit, 1, axis=1), np.roll(unit, -1, axis=1)
        before[:, 0], after[:, -1] = 0.0, 0.0
        return replace(test, mode_shapes=rms * (unit + shares[0] * before + shares[1] * after))
    gains = 1.0 + GAIN * rng.standard_normal((test.n_dof, 1))
    return replace(test, mode_shapes=gains * shapes)


def update_twin(model: Model, seed: int, noise: bool, fault: str = "") -> Twin:
    """One twin of a structure, updated from the deck's values."""
    campaign, rng = model.campaign, np.random.default_rng([seed, int(noise)])
    n, weighting = len(campaign.parameters), campaign.weighting
    truth = np.clip(1.0 + SCATTER * rng.standard_normal(n), 0.7, 1.4)
    test = model.measured(truth, rng)
    if noise:
        frequency = float(weighting.frequency_deviations[0])
        if fault == "correlated":
            frequency *= np.sqrt(1.0 - CORRELATION)
        if fault:
            test = faulty(test, fault, frequency, rng)
        test = noisy(test, frequency, weighting.shape_deviations[0], seed)
    record = model.update(signed(test))
    verdict, apart = record_verdict(record), np.abs(record.updated - truth)
    return Twin(
        held=tuple((apart <= INTERVAL * record.standard_errors).tolist()),
        far=tuple((apart > FAR * record.standard_errors).tolist()),
        withheld=record.trust is not None and record.trust.withheld,
        p_value=np.nan if verdict is None else verdict.form.p_value,
        found=bool((apart <= FOUND).all()),
        trusted=record.trust is not None and record.trust.verdict == "trusted",
        accused=verdict is not None and verdict.form.suspected,
        iterations=record.iterations[-1].number,
    )


def noisy_twins(
    name: str, n: int, seed: int, settings: dict[str, Any], fault: str = ""
) -> list[Twin]:
    made, shapes = NOISY[name]
    with tempfile.TemporaryDirectory(prefix="coverage-") as folder:
        model = Model(made(np.random.default_rng(seed)), shapes, settings, Path(folder))
        twins = []
        for place in range(n):
            try:
                twins.append(update_twin(model, seed + place, True, fault))
            except LostMode as error:  # refused: no computed mode resembles a measured one
                sys.stderr.write(f"{name}, twin {seed + place}, is refused: {error}\n")
        return twins


def exact_twins(
    family: str, n: int, seed: int, settings: dict[str, Any], fault: str = ""
) -> list[Twin]:
    twins = []
    for place in range(n):
        rng = np.random.default_rng([seed + place, *family.encode()])
        with tempfile.TemporaryDirectory(prefix="coverage-") as folder:
            model = Model(FAMILIES[family](rng), True, settings, Path(folder))
            twins.append(update_twin(model, seed + place, noise=False))
    return twins


def coverage_line(name: str, twins: Sequence[Twin]) -> str:
    held = 100.0 * np.mean([twin.held for twin in twins if not twin.withheld], axis=0)
    known = [twin.p_value for twin in twins if np.isfinite(twin.p_value)]
    distance = stats.kstest(known, "uniform").statistic if known else np.nan
    trusted = [twin for twin in twins if twin.trusted]
    far = _share([far for twin in trusted for far in twin.far]) if trusted else np.nan
    return (
        f"{name:14}{len(twins):6d}{held.min():9.1f}{held.max():8.1f}{held.mean():8.1f}"
        f"{_share([twin.iterations == 0 for twin in twins]):14.1f}"
        f"{_share([twin.accused for twin in twins]):10.1f}"
        f"{_share([twin.withheld for twin in twins]):11.1f}{distance:10.3f}"
        f"{_share([p < 0.01 for p in known]) if known else np.nan:11.1f}"
        f"{np.mean([twin.iterations for twin in twins]):12.1f}"
        f"{_share([twin.trusted for twin in twins]):11.1f}{far:15.2f}"
    )


def exact_line(name: str, twins: Sequence[Twin]) -> str:
    return (
        f"{name:14}{len(twins):6d}{_share([twin.found for twin in twins]):12.1f}"
        f"{_share([twin.trusted and not twin.found for twin in twins]):17.1f}"
        f"{_share([twin.accused for twin in twins]):10.1f}"
        f"{np.mean([twin.iterations for twin in twins]):12.1f}"
    )


def _share(said: Sequence[bool]) -> float:
    return 100.0 * float(np.mean(said))


HEADS = (
    f"{'noisy twins':14}{'':6}{'least %':>9}{'most %':>8}{'mean %':>8}{'ended at 0 %':>14}"
    f"{'accused %':>10}{'withheld %':>11}{'distance':>10}{'p < 0.01 %':>11}{'iterations':>12}"
    f"{'trusted %':>11}{'of them far %':>15}",
    f"{'exact twins':14}{'':6}{'at truth %':>12}{'wrong trusted %':>17}{'accused %':>10}"
    f"{'iterations':>12}",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--twins", type=int, default=200, help="noisy twins of each structure")
    parser.add_argument("--exact", type=int, default=500, help="exact twins in all")
    parser.add_argument("--structures", nargs="*", choices=[*NOISY], default=[*NOISY])
    parser.add_argument("--others", action="store_true", help="try other starts as updates do")
    parser.add_argument("--fault", choices=FAULTS, default="", help="of the test, unstated")
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    logging.disable(logging.WARNING)
    settings = {} if asked.others else ALONE
    for number, (names, line, run, each) in enumerate(
        (
            (asked.structures, coverage_line, noisy_twins, asked.twins),
            (EXACT, exact_line, exact_twins, asked.exact // len(EXACT)),
        )
    ):
        if each:
            sys.stdout.write(f"{HEADS[number]}\n")
            for name in names:
                sys.stdout.write(
                    f"{line(name, run(name, each, asked.seed, settings, asked.fault))}\n"
                )
                sys.stdout.flush()


if __name__ == "__main__":
    main()
