"""A scripted solver: real processes that count themselves, with a mass-spring chain inside.

The chain has six masses between two walls and seven springs; parameters k1.. scale springs, m1..
scale masses. Each run appends a line to `runs.log`; `script.json` says what a run of a given
number does instead of its duty.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import sparse

from modetune.adapters.deck_numbers import Number
from modetune.adapters.process import LOG
from modetune.adapters.solver import (
    AffectedElements,
    Analysis,
    Capabilities,
    Command,
    Deck,
    MatrixAnalysis,
    ModalAnalysis,
    ModelSummary,
    Rendered,
    SensitivityAnalysis,
    Solver,
)
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import LicenceDenied, SolverCrashed, SolverRejected
from modetune.core.measurement.measurement import Measurement
from modetune.core.mesh import Cells, Mesh
from modetune.core.modes import Floats, Integers, MeasuredModes, ModeSet, mode_set
from modetune.core.parameters import Parameter, ParameterSet, Quantity, Values
from modetune.core.storage.campaign_record import IterationRecord
from modetune.core.storage.keys import Json
from modetune.core.storage.store import Store
from modetune.core.surface import display_surface
from modetune.core.updating.criteria import Tolerances
from modetune.core.updating.job_results import ModalResult, Result
from modetune.core.updating.observation import Observation, observe
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.core.updating.weighting import even_weighting
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import Case
from modetune.flows.campaign.mapping import map_sensors
from modetune.flows.campaign.schema import (
    E1Section,
    ReportSection,
    SensitivitySection,
    SensorSection,
    UpdateSection,
)
from modetune.flows.campaign.site import RetriesSection, RunSection
from modetune.flows.jobs import prefect_server
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.server_client import ServerClient
from modetune.flows.responses.residuals import ResidualSection
from modetune.flows.updating.forecast import Progress
from tests.embedded import PROGRAMS

SPRINGS = np.array([1500.0, 1600.0, 1400.0, 6500.0, 1300.0, 1500.0, 1300.0])
MASSES = np.array([1.8, 2.4, 1.6, 1.2, 1.1, 0.9])
#: Each run is a process of its own; what it computes is done here, so that it starts quickly.
PROGRAM = """
import json, os, pathlib, signal, sys, time
job = json.loads(pathlib.Path("job.json").read_text())
log = pathlib.Path(job["log"])
with log.open("a") as lines:
    lines.write(job["kind"] + "\\n")
    lines.flush()
    end = lines.tell()  # of the own line: jobs side by side must not share a number
number = log.read_bytes()[:end].count(b"\\n")
behaviour = json.loads(pathlib.Path(job["script"]).read_text()).get(str(number), "good")
if behaviour == "killed":
    os.kill(os.getpid(), signal.SIGKILL)
if behaviour == "hang":
    time.sleep(600)
said = {"rejected": "REJECTED", "short": "running", "denied": "NO LICENCE"}
print(said.get(behaviour, "END OF JOB"))
if behaviour == "nan":
    pathlib.Path("nan").write_text("")
"""


def recased(campaign: Campaign, **changes: Any) -> Campaign:
    """A campaign of one model with something else in its case, weighted as the first mode was."""
    case, modes = replace(campaign.case, **changes), campaign.case.weighting.modes
    case = replace(
        case,
        weighting=modes([0] * len(case.test.numbers)),
        held_out_deviations=modes(
            [0] * len(case.held_out.numbers) if case.held_out else []
        ).frequency_deviations,
    )
    return replace(campaign, cases=(case,))


def scripted_job(folder: Path) -> int | None:
    """A run whose script has nothing special for it, in this process."""
    job = json.loads((folder / "job.json").read_text())
    if json.loads(Path(job["script"]).read_text()):
        return None
    with Path(job["log"]).open("a") as lines:
        lines.write(f"{job['kind']}\n")
    (folder / LOG).write_text("END OF JOB\n")
    return 0


PROGRAMS["-I", "-S", "-c", PROGRAM] = scripted_job


def chain(values: Values) -> tuple[Floats, Floats]:
    """Stiffness (6, 6) and masses (6,) of the chain with these relative values."""
    k = SPRINGS * [values.get(f"k{i + 1}", 1.0) for i in range(7)]
    m = MASSES * [values.get(f"m{i + 1}", 1.0) for i in range(6)]
    stiffness = np.diag(k[:-1] + k[1:]) - np.diag(k[1:-1], 1) - np.diag(k[1:-1], -1)
    return stiffness, m


def chain_modes(values: Values) -> tuple[Floats, Floats]:
    """Eigenvalues (6,) and mass-normalised shapes (6, 6) by LAPACK."""
    stiffness, m = chain(values)
    root = np.sqrt(m)
    eigenvalues, vectors = np.linalg.eigh(stiffness / np.outer(root, root))
    return eigenvalues, vectors / root[:, None]


def chain_derivatives(values: Values, names: tuple[str, ...]) -> ModeDerivatives:
    """Derivatives of all modes by the sum over all modes, which is exact for the whole basis."""
    eigenvalues, shapes = chain_modes(values)
    slopes, turns = [], []
    for name in names:
        up, down = (chain({**values, name: values.get(name, 1.0) + s}) for s in (0.5, -0.5))
        change = up[0] - down[0], np.diag(up[1] - down[1])
        k, m = (shapes.T @ matrix @ shapes for matrix in change)
        gaps = eigenvalues[None, :] - eigenvalues[:, None] + np.eye(6)
        share = (k - eigenvalues[None, :] * m) / gaps
        np.fill_diagonal(share, -0.5 * np.diag(m))
        slopes.append(np.diag(k) - eigenvalues * np.diag(m))
        turns.append(shapes @ share)
    return ModeDerivatives(np.stack(slopes, axis=1), np.stack(turns, axis=2))


def kind_of(analysis: Analysis) -> str:
    if isinstance(analysis, ModalAnalysis):
        return "modal"
    return "matrices" if isinstance(analysis, MatrixAnalysis) else "derivatives"


@dataclass(frozen=True)
class ChainDeck(Deck):
    """The chain behind the solver seam. added: values that are the deck's own."""

    added: tuple[tuple[str, float], ...] = ()

    @property
    def summary(self) -> ModelSummary:
        nodes, components = frozenset(range(1, 7)), frozenset({1})
        return ModelSummary("chain", nodes, components, 13, solid_shapes=True, matrix_shapes=True)

    def mesh(self) -> Mesh:
        nodes = np.arange(1, 7)
        places = np.stack([100.0 * nodes, np.zeros(6), np.zeros(6)], axis=1)
        links = Cells("line", np.arange(2, 7), np.stack([nodes[:-1], nodes[1:]], axis=1))
        return Mesh(nodes, places, (links,))

    def numbers(self, parameter: Parameter) -> list[Number]:
        name, place = parameter.name, int(parameter.name[1:]) - 1
        value = float((SPRINGS if name.startswith("k") else MASSES)[place])
        return [Number(name, value, name)]

    def edited(self, values: Values) -> Values:
        return {**dict(self.added), **values}

    def is_linear(self, parameter: Parameter) -> bool:
        return True

    def affected_elements(self, parameter: Parameter) -> AffectedElements | None:
        spring, place = parameter.name.startswith("k"), int(parameter.name[1:])
        ends = {place - 1, place} if spring else {place}
        element = place if spring else 7 + place
        nodes = frozenset(ends & set(range(1, 7)))
        return AffectedElements(
            frozenset({element}), nodes, spring, not spring, (1,), proportional=False
        )

    def observation(
        self, matrices: MatrixResult, nodes: Integers, components: Integers
    ) -> Observation:
        return observe(matrices, nodes, components)

    def energy_sets(self, parameter: Parameter) -> tuple[str, ...]:
        return (parameter.name,) if parameter.quantity == "spring_stiffness" else ()

    def write_updated(self, values: Values, folder: Path) -> Path:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "chain.json").write_text(json.dumps(dict(values)))
        return folder / "chain.json"


@dataclass(frozen=True)
class ScriptedProgram:
    """The program that counts its runs; a deck is the chain's values."""

    folder: Path
    energies: bool = True
    name: str = "scripted"

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(
            self.energies, matrices=True, frequency_sensitivities=True, shape_sensitivities=True
        )

    def version(self) -> str:
        return "1"

    def render(self, deck: Values, analysis: Analysis) -> Rendered:
        asked: dict[str, Json] = {"kind": kind_of(analysis), "energies": self.energies}
        if isinstance(analysis, ModalAnalysis):
            asked["modes"] = analysis.n_modes
        if isinstance(analysis, SensitivityAnalysis):
            asked["columns"] = list(analysis.parameters)
        job = {
            "kind": kind_of(analysis),
            "log": str(self.folder / "runs.log"),
            "script": str(self.folder / "script.json"),
        }
        content = {"values": dict(deck), **asked}
        return Rendered.of_texts(content, {"job.json": json.dumps(job).encode()})

    def command(self, threads: int) -> Command:
        return Command((sys.executable, "-I", "-S", "-c", PROGRAM))

    def read(self, deck: Values, analysis: Analysis, folder: Path, return_code: int) -> Result:
        log = (folder / "solver.log").read_text()
        if "REJECTED" in log:
            raise SolverRejected(f"the scripted solver refused its input in {folder}")
        if "NO LICENCE" in log:
            raise LicenceDenied(f"the scripted solver got no licence in {folder}")
        if "END OF JOB" not in log:
            raise SolverCrashed(f"the scripted solver broke off in {folder}")
        if isinstance(analysis, MatrixAnalysis):
            stiffness, m = chain(deck)
            return MatrixResult.of_full(
                sparse.csr_array(stiffness),
                sparse.csr_array(np.diag(m)),
                np.arange(1, 7),
                np.ones(6, dtype=np.int64),
            )
        if isinstance(analysis, SensitivityAnalysis):
            return chain_derivatives(deck, analysis.parameters)
        eigenvalues, shapes = chain_modes(deck)
        n = min(analysis.n_modes, 6)
        if (folder / "nan").exists():
            raise SolverCrashed("the result holds deck that are not finite")
        return ModalResult(
            eigenvalues=eigenvalues[:n],
            modes=mode_set(
                np.sqrt(eigenvalues[:n]) / 2 / np.pi,
                shapes[:, :n],
                np.arange(1, 7),
                np.ones(6),
                normalisation="mass",
            ),
            groups=tuple(name for name, _ in analysis.groups),
            strain_energies=np.array(
                [self._energy(name, deck, shapes[:, :n]) for name, _ in analysis.groups]
            ).reshape(len(analysis.groups), n),
            total_strain_energy=0.5 * eigenvalues[:n],
            mass=float(chain(deck)[1].sum()),
        )

    def _energy(self, name: str, values: Values, shapes: Floats) -> Floats:
        place = int(name[1:]) - 1
        walls = np.vstack([np.zeros(shapes.shape[1]), shapes, np.zeros(shapes.shape[1])])
        stretch = walls[place + 1] - walls[place]
        return np.asarray(0.5 * SPRINGS[place] * values.get(name, 1.0) * stretch**2)


@dataclass
class Watcher(Progress):
    """Keeps what a campaign shows."""

    lines: list[IterationRecord] = field(default_factory=list)

    def iteration(self, record: IterationRecord) -> None:
        self.lines.append(record)


@dataclass(frozen=True)
class Bench:
    """A folder with a scripted solver, its run count, and campaigns and engines on it."""

    folder: Path

    def runs(self, kind: str = "") -> int:
        """How many runs of a kind (modal, matrices) were started."""
        log = self.folder / "runs.log"
        lines = log.read_text().splitlines() if log.exists() else []
        return sum(kind in line for line in lines)

    def script(self, behaviour: dict[int, str]) -> None:
        """What the run of a number does: killed, hang, rejected, short, nan."""
        (self.folder / "script.json").write_text(json.dumps(behaviour))

    def solver(self, energies: bool = True) -> Solver:
        return Solver(ChainDeck(), ScriptedProgram(self.folder, energies))

    def engine(self, campaign: Campaign) -> JobEngine:
        return job_engine(campaign)

    def measured(self, truth: Values, modes: tuple[int, ...], shapes: bool = True) -> ModeSet:
        """What a test of the true chain gives: modes (from 1), shapes at masses 1 to 6."""
        eigenvalues, phi = chain_modes(truth)
        index = np.array(modes) - 1
        frequencies = np.sqrt(eigenvalues[index]) / 2 / np.pi
        if not shapes:
            return mode_set(frequencies)
        return mode_set(frequencies, phi[:, index], np.arange(1, 7), np.ones(6))

    def campaign(
        self,
        truth: Values,
        modes: tuple[int, ...] = (1, 2, 3, 4, 5),
        shapes: bool = False,
        parameters: dict[str, Quantity] | None = None,
        update: UpdateSection | None = None,
        sensitivity: SensitivitySection | None = None,
        energies: bool = True,
        bounds: tuple[float, float] = (0.3, 3.0),
        retries: int = 0,
        licence_pause_s: float = 0.01,
        licence_wait_s: float = 60.0,
    ) -> Campaign:
        """A campaign from the nominal chain to a true one."""
        names = parameters or dict.fromkeys(truth, "spring_stiffness")
        update = update or UpdateSection(
            step="weighted_least_squares",
            e1=E1Section(frequency=1e-8, mac=0.0),
            e2=0.0,
            step_limit=0.5,
        )
        test = MeasuredModes(modes, self.measured(truth, modes, shapes))
        solver = self.solver(energies)
        case = Case(
            solver=solver,
            units="m-kg-s",
            measurement=Measurement(test),
            test=test,
            mapping=map_sensors(test.modes, None, solver.deck.mesh(), SensorSection(), 1.0),
            surface=display_surface(solver.deck.mesh()),
            nodes=(1, 2, 3, 4, 5, 6),
            weighting=even_weighting(
                len(modes), test.modes.n_dof, 0.002, 0.02, 1.0, 1.0 if shapes else 0.0
            ),
            tolerances=Tolerances(update.e1.frequency, update.e1.mac),
        )
        return Campaign(
            name="chain",
            file=self.folder / "chain.yaml",
            text="name: chain",
            parameters=ParameterSet(
                tuple(Parameter(n, q, "part", (n,), *bounds, 0.3) for n, q in names.items())
            ),
            cases=(case,),
            residuals=ResidualSection.model_validate({"shape_deviation": 0.02}),
            tolerances=Tolerances(update.e1.frequency, update.e1.mac),
            update=update,
            sensitivity=sensitivity or SensitivitySection(),
            run=RunSection(
                parallel=2,
                retries=RetriesSection(stopped=retries, timeout=retries, no_result=retries),
                licence_pause_s=licence_pause_s,
                licence_wait_s=licence_wait_s,
            ),
            store=Store(self.folder / "store"),
            report=ReportSection(page=False),
        )


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))  # limits of this test alone
    bench = Bench(tmp_path)
    bench.script({})
    return bench


SERVER_USER = """
from modetune.flows.jobs.prefect_server import use_server
print(use_server().wait())
"""


@pytest.fixture(scope="session")
def server_base() -> Iterator[Path]:
    """What HOME_VARIABLE names for the one shared server of a session, which answers.

    Others may enter the folder, so that the server's own modes must protect what is in it.
    """
    folder = Path(tempfile.mkdtemp(prefix="modetune-"))
    base = folder / "base"
    base.mkdir()
    for path in (folder, base):
        path.chmod(0o755)
    environment = {**os.environ, prefect_server.HOME_VARIABLE: str(base)}
    for name in ("PREFECT_API_URL", "PREFECT_API_AUTH_STRING"):
        environment.pop(name, None)
    # In a process of its own, which may end before its server does.
    said = subprocess.run(
        [sys.executable, "-c", SERVER_USER],
        env=environment,
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )
    assert said.stdout == "ready\n", said.stderr
    yield base
    prefect_server.stop_server(prefect_server.machine_home(base))
    shutil.rmtree(folder)


@pytest.fixture
def watcher() -> Watcher:
    return Watcher()


@pytest.fixture
def chain_of() -> Callable[[Values], tuple[Floats, Floats]]:
    return chain


def api_of(home: Path) -> ServerClient:
    """The shared server of a machine's home, as its owner sees it."""
    address = prefect_server.read_address(home)
    assert address is not None
    return ServerClient(address.url, prefect_server.read_login(home))


#: How Chromium draws in three dimensions where there is no graphics card.
BROWSER = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium without a window, for the tests of a file."""
    program = shutil.which("chromium")
    if program is None:
        pytest.skip("there is no chromium on PATH")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=program, args=BROWSER)
        yield browser
        browser.close()
