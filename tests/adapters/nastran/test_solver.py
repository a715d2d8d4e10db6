"""Nastran behind the seam, with a program that behaves as it does towards its caller.

The model is a row of masses and springs along x with a closed form, in mm, t, s; the program is
`fake_nastran.py`, a process of its own that solves the deck it is given.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.adapters.nastran.dialect import (
    MEMORY_VARIABLE,
    MSC,
    MYSTRAN,
    NX,
    VERSION_VARIABLE,
    DialectName,
)
from modetune.adapters.nastran.results import NastranModes, modal_result
from modetune.adapters.nastran.solver import (
    mystran_solver,
    nastran_solver,
)
from modetune.adapters.process import run_process
from modetune.adapters.solver import (
    Analysis,
    MatrixAnalysis,
    ModalAnalysis,
    SensitivityAnalysis,
    Solver,
)
from modetune.core.errors import (
    LicenceDenied,
    ModelError,
    NoResult,
    SolverCrashed,
    SolverExhausted,
    SolverMissing,
    SolverRejected,
    SolverTimeout,
)
from modetune.core.parameters import Parameter, Quantity, TargetKind, Values
from modetune.core.storage.keys import canonical_json
from modetune.core.storage.store import Store
from modetune.core.updating.job_results import ModalResult
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.job import Job, Plans
from modetune.flows.jobs.limits import MachineLimits
from modetune.flows.jobs.policy import Policy
from modetune.flows.jobs.runner import Costs, PoolRunner
from modetune.flows.jobs.tasks import Tasks

STIFFNESS, MASS, MASSES = 1000.0, 2.0e-3, 5
WTMASS = 0.001


def chain_frequencies(masses: int) -> list[float]:
    """A row of equal springs and masses held at one end: it is half of a row held at both."""
    angles = (2 * np.arange(1, masses + 1) - 1) * np.pi / (2 * (2 * masses + 1))
    return list((STIFFNESS / MASS) ** 0.5 / np.pi * np.sin(angles))


FREQUENCIES_HZ = chain_frequencies(MASSES)
NODES = tuple(range(1, MASSES + 2))
SPRINGS = tuple(str(100 + n) for n in range(1, MASSES + 1))
LUMPS = tuple(str(200 + n) for n in range(1, MASSES + 1))


def parameter(
    name: str, quantity: Quantity, *targets: str, by: TargetKind = "element"
) -> Parameter:
    return Parameter(name, quantity, by, targets, 0.5, 2.0, 0.1)


PARAMETERS = (
    parameter("k_root", "spring_stiffness", SPRINGS[0]),
    parameter("k_rest", "spring_stiffness", *SPRINGS[1:]),
    parameter("m", "mass", *LUMPS),
)
GROUPS = (("k_root", ("E101",)), ("k_rest", tuple(f"E{number}" for number in SPRINGS[1:])))
MODAL = ModalAnalysis(3, NODES, GROUPS)


def deck(free: bool = False, masses: int = MASSES) -> str:
    """The chain in all three formats; masses in kg with WTMASS, springs in N/mm."""
    numbers = range(1, masses + 1)
    grids = [f"GRID    {node:8d}        {100.0 * node:8.1f}" for node in (*numbers, masses + 1)]
    springs = [f"CELAS2,{100 + n},{STIFFNESS},{n},1,{n + 1},1" for n in numbers]
    lumps = [f"CONM2*  {200 + n:16d}{n + 1:16d}{0:16d}{MASS / WTMASS:16.4f}\n*" for n in numbers]
    if free:
        lumps.append(f"CONM2,200,1,,{MASS / WTMASS}")
    return "\n".join([
        "SOL 103", "CEND", "TITLE = CHAIN", *([] if free else ["SPC = 1"]), "METHOD = 7",
        "BEGIN BULK", "$ a chain", "EIGRL,7,,,10", f"PARAM,WTMASS,{WTMASS}",
        "SPC1,1,123456,1", "MAT1,9,70000.,,.3", *grids, *springs, *lumps, "ENDDATA", "",
    ])  # fmt: skip


@dataclass(frozen=True)
class Site:
    """A folder with a deck and a program that plays Nastran."""

    folder: Path
    program: Path

    def script(self, *outcomes: str) -> None:
        """What the runs do, one word each; the last word is for all others."""
        (self.program.parent / "outcomes.json").write_text(json.dumps(outcomes))

    @property
    def runs(self) -> list[str]:
        """The arguments of each run so far."""
        log = self.program.parent / "runs.log"
        return log.read_text().splitlines() if log.exists() else []

    def solver(
        self,
        text: str = "",
        dialect: DialectName = "msc",
        parameters: tuple[Parameter, ...] = PARAMETERS,
    ) -> Solver:
        path = self.folder / "chain.bdf"
        path.write_text(text or deck())
        return nastran_solver(path, parameters, dialect)

    def engine(
        self,
        solver: Solver,
        retries: int = 0,
        timeout_s: float = 60.0,
        licence_wait_s: float = 60.0,
    ) -> JobEngine:
        policy = Policy(
            timeout_s=timeout_s,
            stopped=retries,
            timeout=0,
            no_result=retries,
            licence_pause_s=0.01,
            licence_wait_s=licence_wait_s,
        )
        return JobEngine(
            plans=Plans(solver),
            store=Store(self.folder / "store"),
            policy=policy,
            threads=1,
            keep_jobs=False,
            cancelled=threading.Event(),
            counter=MachineLimits(self.folder / "limits"),
            limits=(),
            costs=Costs(),
            tasks=Tasks(PoolRunner(1)),
        )

    def derivatives(
        self, solver: Solver, analysis: SensitivityAnalysis, values: Values
    ) -> ModeDerivatives:
        return self.engine(solver).solve(Job(values, analysis)).result(ModeDerivatives)

    def modal(
        self, solver: Solver, analysis: ModalAnalysis = MODAL, **values: float
    ) -> ModalResult:
        return self.engine(solver).solve(Job(values, analysis)).result(ModalResult)

    def failed(self, key: str) -> Path:
        return self.folder / "store" / "jobs" / f"{key}.failed"


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Site:
    program = tmp_path / "bin" / "nastran"
    program.parent.mkdir()
    source = (Path(__file__).parents[1] / "fake_nastran.py").read_text()
    program.write_text(f"#!{sys.executable}\n{source}")
    program.chmod(0o755)
    monkeypatch.setenv(MSC.variable, str(program))
    monkeypatch.delenv(VERSION_VARIABLE, raising=False)
    monkeypatch.delenv(MEMORY_VARIABLE, raising=False)
    folder = tmp_path / "model"
    folder.mkdir()
    return Site(folder, program)


# results


@pytest.mark.parametrize("dialect", ["msc", "nx"])
def test_frequencies_shapes_energies_and_mass_are_right(site: Site, dialect: DialectName) -> None:
    result = site.modal(site.solver(dialect=dialect))
    # An OP2 file has single precision: seven digits.
    assert result.modes.frequencies_hz == pytest.approx(FREQUENCIES_HZ[:3], rel=1e-6)
    assert result.modes.nodes.tolist() == np.repeat(NODES, 6).tolist()
    assert result.modes.components.tolist() == [1, 2, 3, 4, 5, 6] * len(NODES)
    shapes = np.real(result.modes.mode_shapes)
    np.testing.assert_allclose(MASS * (shapes**2).sum(axis=0), 1.0, rtol=1e-6)
    # sin((2j - 1) i pi / 11) at mass i of mode j, the first mode without a sign change
    expected = np.sin(np.arange(6) * np.pi / 11)
    first = shapes[::6, 0]
    np.testing.assert_allclose(first / first[-1], expected / expected[-1], atol=1e-6)
    np.testing.assert_allclose(result.energy_balance, 1.0, rtol=1e-6)
    np.testing.assert_allclose(
        result.strain_energies.sum(axis=0), result.total_strain_energy, rtol=1e-6
    )
    # The weight generator says 10 (kg); WTMASS makes it the deck's 0.01 t.
    assert result.mass == pytest.approx(MASSES * MASS, rel=1e-6)


def test_shapes_come_at_the_analysis_nodes_in_their_order(site: Site) -> None:
    solver = site.solver()
    everywhere = site.modal(solver)
    some = site.modal(solver, ModalAnalysis(3, (5, 2)))
    assert some.modes.nodes.tolist() == [5] * 6 + [2] * 6
    np.testing.assert_array_equal(
        np.abs(some.modes.mode_shapes[[0, 6]]), np.abs(everywhere.modes.mode_shapes[[24, 6]])
    )
    assert some.groups == ()
    assert np.isnan(some.total_strain_energy).all()  # not asked for


def test_a_free_chain_has_its_rigid_mode(site: Site) -> None:
    result = site.modal(site.solver(deck(free=True)))
    assert result.n_rigid == 1
    # Six equal masses, free: (1 / pi) sqrt(k / m) sin(j pi / 12).
    expected = [(STIFFNESS / MASS) ** 0.5 / np.pi * np.sin(j * np.pi / 12) for j in (1, 2)]
    assert result.elastic.frequencies_hz == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("values", "factor"),
    [({"k_root": 1.44, "k_rest": 1.44}, 1.2), ({"m": 1.21}, 1.0 / 1.1)],
)
def test_parameters_scale_frequencies_as_they_must(
    site: Site, values: dict[str, float], factor: float
) -> None:
    solver = site.solver()
    before, after = site.modal(solver), site.modal(solver, MODAL, **values)
    np.testing.assert_allclose(
        after.modes.frequencies_hz, factor * before.modes.frequencies_hz, rtol=2e-6
    )
    assert after.mass == pytest.approx(values.get("m", 1.0) * before.mass, rel=1e-6)


def test_the_energy_of_one_spring_is_the_slope_of_the_eigenvalues(site: Site) -> None:
    solver = site.solver()
    base = site.modal(solver)
    low, high = (site.modal(solver, k_root=1.0 + step) for step in (-0.01, 0.01))
    slope = (high.eigenvalues - low.eigenvalues) / 0.02
    # d lambda / d theta = 2 U_g; central differences of 1 % leave some 1e-4.
    np.testing.assert_allclose(
        slope, 2.0 * base.elastic_energies("k_root"), rtol=1e-3, atol=1e-4 * slope.max()
    )


def test_updated_decks_run_to_the_same_modes(site: Site) -> None:
    solver, values = site.solver(), {"k_root": 1.2345, "m": 0.87}
    expected = site.modal(solver, MODAL, **values)
    updated = solver.deck.write_updated(values, site.folder / "updated")
    again = site.modal(nastran_solver(updated, PARAMETERS))
    np.testing.assert_array_equal(again.eigenvalues, expected.eigenvalues)
    other = nastran_solver(updated, PARAMETERS)
    assert other.deck.deck_value(PARAMETERS[0]) == pytest.approx(1.2345 * STIFFNESS, rel=1e-6)


def test_sensitivities_are_those_of_the_closed_form_at_any_values(site: Site) -> None:
    # All springs scaled by t: lambda = t lambda_0, so d lambda / d t = lambda / t; masses by t:
    # -lambda / t. The variables of the job are relative to where it stands, so this tests both.
    springs = parameter("k", "spring_stiffness", *SPRINGS)
    solver = site.solver(parameters=(springs, PARAMETERS[2]))
    values = {"k": 1.25, "m": 0.8}
    found = site.derivatives(solver, SensitivityAnalysis(3, ("k", "m")), values)
    assert isinstance(found, ModeDerivatives)
    eigenvalues = (2 * np.pi * np.array(FREQUENCIES_HZ[:3])) ** 2 * 1.25 / 0.8
    np.testing.assert_allclose(found.eigenvalues[:, 0], eigenvalues / 1.25, rtol=1e-6)
    np.testing.assert_allclose(found.eigenvalues[:, 1], -eigenvalues / 0.8, rtol=1e-6)
    assert found.mode_shapes.shape == (0, 3, 2)


def test_shape_sensitivities_come_in_the_rows_of_a_modal_run(site: Site) -> None:
    solver = site.solver()
    nodes = (6, 2, 3)
    found = site.derivatives(solver, SensitivityAnalysis(2, ("m", "k_root"), nodes), {})
    assert isinstance(found, ModeDerivatives)
    assert found.mode_shapes.shape == (18, 2, 2)
    modes = site.modal(solver, ModalAnalysis(2, nodes)).modes
    # Scaling all masses by t scales mass-normalised shapes by t^-1/2: -phi / 2 at 1.
    np.testing.assert_allclose(
        np.abs(found.mode_shapes[:, :, 0]), 0.5 * np.abs(modes.mode_shapes), atol=1e-4
    )
    step = 1e-3
    ends = [
        site.modal(solver, ModalAnalysis(2, nodes), k_root=1.0 + s).modes.mode_shapes
        for s in (step, -step)
    ]
    aligned = [np.real(end * np.sign((end * modes.mode_shapes).sum(axis=0))) for end in ends]
    slopes = (aligned[0] - aligned[1]) / (2.0 * step)
    signs = np.sign(-(found.mode_shapes[:, :, 0] * np.real(modes.mode_shapes)).sum(axis=0))
    # seven digits of shapes up to 20, over twice the step
    np.testing.assert_allclose(found.mode_shapes[:, :, 1] * signs, slopes, atol=5e-3)


# failures, through the engine


def test_a_refused_licence_is_waited_for_and_is_no_failure(site: Site) -> None:
    site.script("denied", "denied", "good")
    solver = site.solver()
    site.engine(solver, retries=0).solve(Job({}, MODAL)).result(ModalResult)
    assert len(site.runs) == 3
    assert not list((site.folder / "store" / "jobs").glob("*.failed"))


def test_a_licence_that_never_comes_is_said_with_the_servers_words(site: Site) -> None:
    site.script("denied")
    waiting = site.engine(site.solver(), licence_wait_s=0.0)
    with pytest.raises(LicenceDenied, match=r"got no licence in .*Licensing: Authentication"):
        waiting.solve(Job({}, MODAL))


@pytest.mark.parametrize("outcome", ["killed", "half", "missing", "short", "few", "other"])
def test_a_run_that_broke_off_is_tried_again(site: Site, outcome: str) -> None:
    site.script(outcome, "good")
    site.engine(site.solver(), retries=1).solve(Job({}, MODAL)).result(ModalResult)
    assert len(site.runs) == 2


@pytest.mark.parametrize(
    ("outcome", "kind", "message"),
    [
        ("killed", SolverCrashed, "was killed by signal 9"),
        ("half", NoResult, r"job\.op2 cannot be read as an OP2 file"),
        ("missing", NoResult, r"job\.op2 cannot be read as an OP2 file: .*No such file"),
        ("short", SolverCrashed, "with code 0 and without its closing line"),
        ("few", NoResult, "left 2 modes of the 3 that were asked for"),
        ("other", NoResult, "shapes at 5 nodes where 6 were asked for: no shape at node 1"),
    ],
)
def test_each_way_of_breaking_off_is_named_and_keeps_its_folder(
    site: Site, outcome: str, kind: type[SolverCrashed], message: str
) -> None:
    site.script(outcome)
    engine = site.engine(site.solver(), retries=1)
    job = Job({}, MODAL)
    with pytest.raises(SolverCrashed, match=message) as caught:
        engine.solve(job)
    assert type(caught.value) is kind
    assert len(site.runs) == 2
    folder = site.failed(engine.key(job))
    assert str(folder) in str(caught.value)
    assert (folder / "job.bdf").read_text().startswith("SOL 103")
    assert (folder / "job.log").is_file()
    assert (outcome == "killed") != (folder / "job.f06").is_file()


def test_a_fatal_message_is_named_with_the_users_line_and_not_tried_again(site: Site) -> None:
    site.script("fatal", "good")
    solver = site.solver()
    engine = site.engine(solver, retries=2)
    line = deck().splitlines().index("MAT1,9,70000.,,.3") + 1
    where = re.escape(f"refused the deck at {site.folder / 'chain.bdf'}, line {line} ")
    with pytest.raises(SolverRejected, match=where) as caught:
        engine.solve(Job({}, MODAL))
    assert "USER FATAL MESSAGE 316" in str(caught.value)
    assert len(site.runs) == 1


def test_a_run_without_memory_is_said_so_and_not_tried_again(site: Site) -> None:
    site.script("memory", "good")
    engine = site.engine(site.solver(), retries=2)
    with pytest.raises(SolverExhausted, match=r"ran out of memory or disk in .*\n.*3008"):
        engine.solve(Job({}, MODAL))
    assert len(site.runs) == 1


def test_a_run_that_hangs_is_killed(site: Site) -> None:
    site.script("hang")
    with pytest.raises(SolverTimeout, match="ran longer than 1 s"):
        site.engine(site.solver(), timeout_s=1.0).solve(Job({}, MODAL))


def test_a_sensitivity_that_is_not_there_is_named(site: Site) -> None:
    site.script("few")
    with pytest.raises(SolverCrashed, match="no sensitivity of the eigenvalue of mode 3"):
        site.derivatives(site.solver(), SensitivityAnalysis(3, ("m",)), {})
    with pytest.raises(
        SolverCrashed, match=r"no sensitivity of component 6 of node 2 in mode 2 \(response 14\)"
    ):
        site.derivatives(site.solver(), SensitivityAnalysis(2, ("m",), (2,)), {})


def test_a_missing_program_is_said_with_its_remedy(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(MSC.variable, "no-such-nastran")
    with pytest.raises(SolverMissing, match=r"`no-such-nastran` is not on this.*MODETUNE_NASTRAN"):
        site.solver().program.version()
    path = site.folder / "held.bdf"
    path.write_text(deck())
    monkeypatch.setenv(MYSTRAN.variable, "no-such-mystran")
    with pytest.raises(SolverMissing, match=r"`no-such-mystran`.*MODETUNE_MYSTRAN"):
        mystran_solver(path, ()).program.version()


# the seam


def test_the_version_is_the_program_file_unless_named(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    digest = hashlib.sha256(site.program.read_bytes()).hexdigest()[:12]
    assert site.solver().program.version() == f"nastran {digest}"
    monkeypatch.setenv(VERSION_VARIABLE, "2021.4")
    assert site.solver().program.version() == "2021.4"


def test_jobs_run_in_their_folder_in_the_foreground_and_share_the_cores(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    site.modal(site.solver())
    assert site.runs[0].split()[:4] == ["job.bdf", "scr=yes", "old=no", "batch=no"]
    monkeypatch.setenv(MEMORY_VARIABLE, "4gb")
    for dialect, keyword in (("msc", "smp=4"), ("nx", "parallel=4")):
        arguments = site.solver(dialect=dialect).program.command(4).arguments  # type: ignore[arg-type]
        assert keyword in arguments
        assert "memory=4gb" in arguments
    assert MYSTRAN.arguments("mystran", 4) == ("mystran", "job.bdf")
    assert not any("=1" in word for word in NX.arguments("nastran", 1))


def test_content_is_blind_to_paths_and_comments_and_sees_numbers(site: Site) -> None:
    texts = {
        "plain": deck(),
        "elsewhere": deck().replace("$ a chain", "$ another\n$ comment"),
        "number": deck().replace("1000.0", "1000.1", 1),
    }
    analyses: dict[str, Analysis] = {
        "modal": MODAL,
        "more": ModalAnalysis(4, NODES, GROUPS),
        "nodes": ModalAnalysis(3, NODES[:1], GROUPS),
        "groups": ModalAnalysis(3, NODES),
        "regrouped": ModalAnalysis(3, NODES, (("all", GROUPS[0][1] + GROUPS[1][1]),)),
        "slopes": SensitivityAnalysis(3, ("k_root",)),
        "other slopes": SensitivityAnalysis(3, ("m",)),
        "shapes": SensitivityAnalysis(3, ("k_root",), (1,)),
    }
    contents: dict[str, dict[str, str]] = {}
    for name, text in texts.items():
        solver = site.solver(text)
        contents[name] = {
            key: canonical_json(solver.render({}, a).content) for key, a in analyses.items()
        }
        edited = canonical_json(solver.render({"m": 1.01}, MODAL).content)
        assert edited != contents[name]["modal"]
        assert str(site.folder) not in edited
    assert contents["plain"] == contents["elsewhere"]
    assert len(set(contents["plain"].values())) == len(analyses)
    for key in analyses:
        assert contents["number"][key] != contents["plain"][key]
    other = site.solver(dialect="nx").render({}, MODAL).content
    assert canonical_json(other) != contents["plain"]["modal"]


def test_capabilities_are_those_of_the_program(site: Site) -> None:
    solver = site.solver()
    has = solver.program.capabilities
    assert (has.strain_energies, has.matrices) == (True, False)
    assert (has.frequency_sensitivities, has.shape_sensitivities) == (True, True)
    mystran = mystran_solver(site.folder / "chain.bdf", PARAMETERS)
    assert (solver.program.name, mystran.program.name) == ("nastran", "mystran")
    assert mystran.program.capabilities == MYSTRAN.capabilities
    has = mystran.program.capabilities
    assert (has.strain_energies, has.frequency_sensitivities) == (False, False)
    assert (has.matrices, has.matrix_modes) == (True, True)
    with pytest.raises(ModelError, match="matrices are not read"):
        solver.render({}, MatrixAnalysis())


def test_problems_name_parameter_file_and_line(site: Site) -> None:
    solver = site.solver()
    twice = parameter("k_two", "spring_stiffness", "101", "102")
    wrong = parameter("k_no", "spring_stiffness", "999")
    assert solver.deck.problems(PARAMETERS) == []
    problems = solver.deck.problems((*PARAMETERS, twice, wrong))
    line = next(i for i, text in enumerate(deck().splitlines(), 1) if text.startswith("CELAS2,101"))
    assert problems[0] == (
        f"{site.folder / 'chain.bdf'}, line {line}: both k_root and k_two change this number"
    )
    assert problems[2].startswith("parameter k_no: the deck has no such element 999")


def test_a_deck_that_means_no_job_is_refused_before_any_run(site: Site) -> None:
    text = deck().replace("METHOD = 7", "METHOD = 7\nSTATSUB = 2")
    with pytest.raises(ModelError, match="line 6: STATSUB asks for modes of a preloaded"):
        site.solver(text)
    path = site.folder / "beam.bdf"
    path.write_text(deck().replace("ENDDATA", "NSM1,3,PSHELL,1.,4\nENDDATA"))
    with pytest.raises(ModelError, match="MYSTRAN has no NSM1"):
        mystran_solver(path, PARAMETERS)


def test_nothing_is_run_twice_for_one_result(site: Site) -> None:
    solver = site.solver()
    first, again = site.modal(solver), site.modal(solver)
    np.testing.assert_array_equal(first.eigenvalues, again.eigenvalues)
    assert len(site.runs) == 1


# results from arrays


def op2_modes(**changes: object) -> NastranModes:
    """One mode of one node with unit mass: eigenvalue 8, two elements with energies 1 and 3."""
    whole = NastranModes(
        eigenvalues=np.array([8.0]),
        mode_numbers=np.array([1]),
        nodes=np.ones(6, dtype=np.int64),
        components=np.arange(1, 7),
        mode_shapes=np.arange(6.0)[:, None],
        generalized_mass=np.array([1.0]),
        elements=np.array([11, 12]),
        strain_energies=np.array([[1.0], [3.0]]),
        total_strain_energy=np.array([4.0]),
        mass=2.0,
    )
    return replace(whole, **changes)  # type: ignore[arg-type]


ONE = ModalAnalysis(1, (1,), (("stiff", ("P1",)),))


def test_modes_of_another_normalisation_are_scaled_to_unit_mass() -> None:
    found = op2_modes(
        mode_shapes=2.0 * np.arange(6.0)[:, None],
        generalized_mass=np.array([4.0]),
        strain_energies=np.array([[4.0], [12.0]]),
        total_strain_energy=np.array([16.0]),
    )
    # Twice the shape has four times the modal mass and four times the energy.
    result = modal_result(found, ONE, [frozenset({12})], 0.5)
    expected = modal_result(op2_modes(), ONE, [frozenset({12})], 0.5)
    np.testing.assert_array_equal(result.modes.mode_shapes, expected.modes.mode_shapes)
    np.testing.assert_array_equal(result.strain_energies, expected.strain_energies)
    assert result.energy_balance == pytest.approx([1.0])  # 2 (1 + 3) / 8
    assert result.mass == 1.0  # 2 by the weight generator, half of it by WTMASS


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"generalized_mass": np.array([0.0])}, "mode 1 with the generalised mass 0"),
        ({"elements": np.array([11, 13])}, "no strain energy of element 12"),
        ({"strain_energies": np.array([[1.0], [np.nan]])}, "no strain energy of element 12"),
        ({"nodes": np.full(6, 2)}, "no shape at node 1"),
        (
            {
                "nodes": np.ones(1, dtype=np.int64),
                "components": np.ones(1, dtype=np.int64),
                "mode_shapes": np.ones((1, 1)),
            },
            "scalar point",
        ),
    ],
)
def test_what_a_result_lacks_is_named(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        modal_result(op2_modes(**changes), ONE, [frozenset({11, 12})], 1.0)


# what real programs left


def finished(folder: Path, solver: Any, op2: Path, f06: Path) -> Path:
    """A folder that looks like that of a job which left these files."""
    job = folder / "job"
    job.mkdir()
    (job / solver.program.dialect.result_file).symlink_to(op2)
    (job / solver.program.dialect.print_file).symlink_to(f06)
    return job


def read_finished(
    folder: Path, solver: Solver, files: tuple[Path, Path], analysis: ModalAnalysis
) -> ModalResult:
    result = solver.read({}, analysis, finished(folder, solver, *files), 0)
    assert isinstance(result, ModalResult)
    return result


def test_a_run_of_mystran_is_read_to_the_aircrafts_modes(shared_data: Path, tmp_path: Path) -> None:
    source = shared_data / "garteur" / "mystran"
    solver = mystran_solver(source / "gart.dat", ())
    nodes = tuple(sorted(solver.deck.summary.node_ids))
    files = source / "gart.OP2", source / "gart.F06"
    result = read_finished(tmp_path, solver, files, ModalAnalysis(20, nodes))
    assert result.n_rigid == 6
    assert result.modes.n_dof == 6 * 322
    # the F06 prints 43.962 and 43.984 Hz for the close pair of torsion modes
    close = [f for f in result.modes.frequencies_hz if 43.9 < f < 44.0]
    assert close == pytest.approx([43.962, 43.984], abs=5e-4)
    # 41.265 kg by the weight generator, in the deck's tonnes by WTMASS 0.001
    assert result.mass == pytest.approx(0.041265, rel=1e-6)
    with pytest.raises(NoResult, match="20 modes of the 21 that were asked for"):
        solver.read({}, ModalAnalysis(21, nodes), tmp_path / "job", 0)


def test_a_run_of_msc_nastran_is_read_with_its_strain_energies(
    shared_data: Path, tmp_path: Path
) -> None:
    source = shared_data / "nastran" / "pn_mode_solid_shell_bar"
    solver: Any = nastran_solver(source / "mode_solid_shell_bar.bdf", ())
    nodes = tuple(sorted(solver.deck.summary.node_ids))
    stem = source / "mode_solid_shell_bar"
    files = stem.with_suffix(".op2"), stem.with_suffix(".f06")
    sets = tuple(f"P{number}" for number in sorted(solver.deck.structure.elements_of))
    analysis = ModalAnalysis(3, nodes, (("all", sets), ("shells", sets[:1])))
    result = read_finished(tmp_path, solver, files, analysis)
    # the table REAL EIGENVALUES of the F06
    assert result.eigenvalues == pytest.approx([2.005177e5, 2.277722e5, 6.246444e5], rel=1e-6)
    # Energies of all elements are half of the eigenvalue; the F06 prints their balance to 1e-4.
    np.testing.assert_allclose(result.energy_balance, 1.0, rtol=1e-4)
    np.testing.assert_allclose(result.strain_energies[0], result.total_strain_energy, rtol=1e-4)


def test_a_run_of_simcenter_nastran_is_read(shared_data: Path, tmp_path: Path) -> None:
    source = shared_data / "nastran" / "yeti_gpwg1"
    solver: Any = nastran_solver(source / "rdop2gpwg_1.dat", (), "nx")
    expected = json.loads((source / "expected.json").read_text())["op2"]["eigenvectors"][0]
    n_modes = len(expected["freq_from_eigenvalue"])
    stem = source / "rdop2gpwg_1"
    files = stem.with_suffix(".op2"), stem.with_suffix(".f06")
    analysis = ModalAnalysis(n_modes, tuple(sorted(solver.deck.summary.node_ids)))
    result = read_finished(tmp_path, solver, files, analysis)
    np.testing.assert_allclose(
        result.elastic.frequencies_hz,
        expected["freq_from_eigenvalue"][result.n_rigid :],
        rtol=1e-5,
    )
    # MASS of the weight generator in the F06, without WTMASS
    assert result.mass == pytest.approx(50.05019 * solver.deck.wtmass, rel=1e-6)


@pytest.mark.parametrize(
    "deck",
    [
        "garteur/supaero/nastran_dynamic_ref.inp",
        "nastran/pn_goland_sol200_dscm2/goland_final_test.bdf",
        "nastran/pn_beam_modes/beam_modes.dat",
        "nastran/yeti_gpwg1/rdop2gpwg_1.dat",
    ],
)
def test_jobs_of_real_decks_are_decks_of_the_same_model(
    shared_data: Path, tmp_path: Path, deck: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(MSC.variable, "true")  # any program: its version is in a job's key
    solver: Any = nastran_solver(shared_data / deck, ())
    analysis = ModalAnalysis(5, tuple(sorted(solver.deck.summary.node_ids)))
    solver.render({}, analysis).write(tmp_path)
    again: Any = nastran_solver(tmp_path / "job.bdf", ())
    assert "SOL 103" in (tmp_path / "job.bdf").read_text().splitlines()
    assert again.deck.summary.node_ids == solver.deck.summary.node_ids
    assert again.deck.summary.n_elements == solver.deck.summary.n_elements
    assert again.deck.wtmass == solver.deck.wtmass
    folder = tmp_path / "again"
    folder.mkdir()
    again.render({}, analysis).write(folder)  # a job's job is the job
    assert (folder / "job.bdf").read_text() == (tmp_path / "job.bdf").read_text()


# MYSTRAN itself, where it is

ALL_SCALED = (
    parameter("k_root", "spring_stiffness", "101"),
    parameter("k_rest", "spring_stiffness", "102-199"),
    parameter("m", "mass", "201-299"),
)
Mystran = Callable[[ModalAnalysis, Values, str], ModalResult]


@pytest.fixture
def mystran(tmp_path: Path) -> Mystran:
    """Runs the chain by MYSTRAN, or skips the test."""
    program = os.environ.get(MYSTRAN.variable, MYSTRAN.program)
    if shutil.which(program) is None:
        pytest.skip(f"no {program} here; {MYSTRAN.variable} names one")

    def run(analysis: ModalAnalysis, values: Values, text: str) -> ModalResult:
        path = tmp_path / "chain.bdf"
        path.write_text(text)
        solver = mystran_solver(path, ALL_SCALED)
        folder = tmp_path / f"job{len(list(tmp_path.iterdir()))}"
        folder.mkdir()
        solver.render(values, analysis).write(folder)
        finished = run_process(solver.program.command(1), folder, 60.0, threading.Event())
        result = solver.read(values, analysis, folder, finished.return_code)
        assert isinstance(result, ModalResult)
        return result

    return run


def test_mystran_gives_the_closed_form_and_follows_the_parameters(mystran: Mystran) -> None:
    # Its Lanczos solver finds at most about half of the modes there are.
    analysis, text = ModalAnalysis(4, (6, 2)), deck(masses=15)
    before = mystran(analysis, {}, text)
    assert before.modes.frequencies_hz == pytest.approx(chain_frequencies(15)[:4], rel=1e-6)
    assert before.modes.nodes.tolist() == [6] * 6 + [2] * 6
    assert before.mass == pytest.approx(15 * MASS, rel=1e-6)
    after = mystran(analysis, {"k_root": 1.44, "k_rest": 1.44, "m": 1.44}, text)
    # all springs and all masses alike change nothing
    np.testing.assert_allclose(after.modes.frequencies_hz, before.modes.frequencies_hz, rtol=2e-6)
    assert after.mass == pytest.approx(1.44 * before.mass, rel=1e-6)


def test_mystran_refuses_what_its_error_file_says(mystran: Mystran) -> None:
    text = deck().replace("BULK\n", "BULK\nSPC1,1,1,777\n")
    with pytest.raises(SolverRejected, match=r"\*ERROR +1822: GRID +777 ON SPC OR SPC1"):
        mystran(ModalAnalysis(2, (1,)), {}, text)
