"""A job's deck is edited once and its key worked out once, whoever asks for them how often."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.adapters.calculix import solver as calculix
from modetune.adapters.calculix.job import job_text
from modetune.adapters.solver import Analysis, MatrixAnalysis, ModalAnalysis, Rendered
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.core.algebra import factor_room, mumps
from modetune.core.algebra.eigen import ModeSolver
from modetune.core.algebra.matrices import upper_triangle
from modetune.core.algebra.pardiso import Pardiso
from modetune.core.errors import SolverRejected
from modetune.core.parameters import Values
from modetune.core.storage.keys import content_key
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.campaign.schema import SensitivitySection
from modetune.flows.jobs import job as jobs
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.job import NOMINAL, Job
from modetune.flows.jobs.limits import JobMemory
from modetune.flows.updating.dry_run import dry_run
from modetune.flows.updating.mode_source import campaign_analysis
from modetune.flows.updating.update import update_campaign
from tests.adapters.ccx_decks import bar
from tests.adapters.solved import needs_ccx
from tests.core.algebra.test_factor_room import block
from tests.flows.conftest import ScriptedProgram

TRUTH = {"k1": 1.2, "k2": 0.8}


@pytest.fixture
def rendered(monkeypatch: pytest.MonkeyPatch) -> Counter[Any]:
    """How often the chain's deck was edited, by job."""
    counts: Counter[Any] = Counter()
    render = ScriptedProgram.render

    def counted(self: ScriptedProgram, deck: Values, analysis: Analysis) -> Rendered:
        counts[Job(deck, analysis).identity] += 1
        return render(self, deck, analysis)

    monkeypatch.setattr(ScriptedProgram, "render", counted)
    return counts


@pytest.fixture
def keyed(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often each job's key was worked out."""
    counts: Counter[str] = Counter()

    def counted(canonical: str) -> str:
        counts[canonical] += 1
        return content_key(canonical)

    monkeypatch.setattr(jobs, "content_key", counted)
    return counts


@pytest.mark.parametrize(
    "method", ["strain_energy", "semi_analytic", "solver", "finite_difference"]
)
def test_a_campaign_renders_and_keys_each_job_once(
    bench: Any, watcher: Any, rendered: Counter[Any], keyed: Counter[str], method: Any
) -> None:
    campaign = bench.campaign(TRUTH, sensitivity=SensitivitySection(method=method))
    run = update_campaign(campaign, bench.folder / "run", watcher, forecast=lambda _: None)
    counts = run.record.runs
    assert counts.modal + counts.sensitivity == bench.runs()
    # The jobs that ran, and the deck at its own values, by whose digest models are told apart.
    assert set(rendered.values()) == set(keyed.values()) == {1}
    assert rendered[NOMINAL.identity] == 1
    assert len(rendered) == len(keyed) == bench.runs() + 1


def test_a_campaign_run_again_renders_each_job_once_to_find_it(
    bench: Any, watcher: Any, rendered: Counter[Any], keyed: Counter[str]
) -> None:
    differences = SensitivitySection(method="finite_difference")
    campaign = bench.campaign(TRUTH, sensitivity=differences)
    update_campaign(campaign, bench.folder / "run", watcher)
    first = rendered.copy()
    rendered.clear()
    keyed.clear()
    again = update_campaign(campaign, bench.folder / "run", watcher, forecast=lambda _: None)
    assert again.record.runs.modal + again.record.runs.sensitivity == 0
    assert rendered == first
    assert set(keyed.values()) == {1}


def test_a_job_whose_key_is_known_is_not_rendered_again(
    bench: Any, rendered: Counter[Any], keyed: Counter[str]
) -> None:
    engine = job_engine(bench.campaign(TRUTH))
    job = Job({"k1": 1.1, "k2": 1.0}, ModalAnalysis(5, (1, 2)))
    key = engine.key(job)
    outcome = engine.solve(job)
    same = Job({"k2": 1.0, "k1": 1.1}, ModalAnalysis(5, (1, 2)))
    assert (outcome.key, engine.key(same), engine.solve(same).reused) == (key, key, True)
    assert outcome.result(ModalResult).modes.n_modes == 5
    assert rendered.total() == keyed.total() == 2  # the job, and its model for the note
    engine.key(Job({"k1": 1.1, "k2": 1.0}, MatrixAnalysis()))
    assert rendered.total() == keyed.total() == 3


def test_a_result_that_was_lost_is_solved_again_under_its_key(
    bench: Any, rendered: Counter[Any], keyed: Counter[str]
) -> None:
    engine = job_engine(bench.campaign(TRUTH))
    outcome = engine.solve(Job({"k1": 1.1}, ModalAnalysis(5, (1,))))
    engine.store.drop(outcome.key)
    assert outcome.result(ModalResult).modes.n_modes == 5
    assert bench.runs() == 2
    assert keyed.total() == 2  # with the model's
    assert rendered[outcome.job.identity] == 2  # to be written again


def test_decks_that_are_too_large_to_wait_in_memory_are_rendered_for_their_run(
    bench: Any, rendered: Counter[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jobs, "KEPT_BYTES", 10)
    engine = job_engine(bench.campaign(TRUTH))
    job = Job({"k1": 1.1}, ModalAnalysis(5, (1,)))
    engine.key(job)
    engine.solve(job)
    engine.solve(job)
    assert rendered[job.identity] == 2


def test_decks_leave_memory_with_their_runs_failed_ones_too(bench: Any) -> None:
    bench.script({2: "rejected"})
    engine = job_engine(bench.campaign(TRUTH))
    engine.solve(Job({"k1": 1.1}, ModalAnalysis(5, (1,))))
    with pytest.raises(SolverRejected):
        engine.solve(Job({"k1": 1.2}, ModalAnalysis(5, (1,))))
    assert (engine.plans._waiting, engine.plans._size) == ({}, 0)


def test_a_dry_run_renders_each_job_once(
    bench: Any, rendered: Counter[Any], keyed: Counter[str]
) -> None:
    campaign = bench.campaign(TRUTH, sensitivity=SensitivitySection(method="finite_difference"))
    found = dry_run(campaign, bench.folder / "run")
    assert len(found.runs) == 3
    assert set(rendered.values()) == set(keyed.values()) == {1}
    assert len(rendered) == 4  # and the deck at its own values


CAMPAIGN = """name: bar
model: {deck: bar.inp, solver: calculix, eigensolver: solver, units: mm-t-s}
test: {modes: bar.csv}
parameters: [{name: E, quantity: youngs_modulus, material: A}]
residuals: {shape_weight: 0.0}
update: {e1: {frequency: 1.0e-5, mac: 0.0}}
sensitivity: {method: finite_difference}
"""


@needs_ccx
def test_a_campaign_by_calculix_edits_the_deck_once_a_job(
    tmp_path: Path, watcher: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    texts: list[str] = []

    def counted(*given: Any) -> str:
        texts.append(job_text(*given))
        return texts[-1]

    monkeypatch.setattr(calculix, "job_text", counted)
    (tmp_path / "bar.inp").write_text(bar("C3D8I", bricks=3))
    (tmp_path / "bar.yaml").write_text(CAMPAIGN)
    # The test: a modulus 10 % higher, by CalculiX.
    (tmp_path / "bar.csv").write_text("mode,1,2\nfrequency_hz,1,2\n")
    nominal = load_campaign(tmp_path / "bar.yaml")
    modal = Job({"E": 1.1}, campaign_analysis(nominal))
    found = job_engine(nominal).solve(modal).result(ModalResult).elastic
    write_modes_csv(tmp_path / "bar.csv", (1, 2), found.select([0, 1]))
    texts.clear()
    run = update_campaign(load_campaign(tmp_path / "bar.yaml"), tmp_path / "run", watcher)
    assert run.record.status == "converged"
    counts = run.record.runs
    assert len(texts) == len(set(texts)) == counts.modal + counts.sensitivity + 1
    first, again = len(texts), load_campaign(tmp_path / "bar.yaml")
    assert update_campaign(again, tmp_path / "run", watcher).record.runs.modal == 0
    assert len(texts) == 2 * first - 1  # only notes of new results need the deck's own values


@pytest.mark.skipif(not mumps.is_available(), reason="MUMPS is not installed here")
def test_what_is_computed_from_results_takes_the_memory_that_the_campaign_names(
    bench: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A solid whose factors do not fit: they go to the store's disk, with the same modes."""
    stiffness, mass = (upper_triangle(a) for a in block())
    expected = ModeSolver().solve(stiffness, mass, 3).eigenvalues
    monkeypatch.setattr(factor_room, "_resident", lambda: 0)
    # The least with which factors on disk can be used is a few percent less than in memory.
    limit = 0.9e-9 * Pardiso(stiffness).memory.peak
    limit += 8e-9 * stiffness.shape[0] * (8 * 3 + 80)
    campaign = bench.campaign(TRUTH)
    engine = job_engine(replace(campaign, run=campaign.run.model_copy(update={"memory_gb": limit})))
    seen: list[Path] = []

    def compute() -> ModalResult:
        solver = ModeSolver()
        found = solver.solve(stiffness, mass, 3)
        seen.extend(engine.store.folder.glob("jobs/factors-*.part"))
        node, energies = np.array([1]), 0.5 * found.eigenvalues
        return ModalResult.of_shapes(found.eigenvalues, found.shapes[:1], node, node, energies, 0)

    found = engine.derived({"modes": 3}, compute, ModalResult)
    assert seen
    np.testing.assert_allclose(found.eigenvalues, expected, rtol=1e-11)


def test_jobs_take_shares_of_the_memory_by_what_their_like_took() -> None:
    memory, modal = JobMemory(), ("calculix", "wing", "modal")
    assert memory.limit(modal, 1000, named=True).taken == memory.limit(modal, 1000, True).slots
    assert memory.limit(modal, 1000, named=False).taken == 1
    memory.add(modal, 500, 1000)
    memory.add(modal, 300, 1000)  # the largest counts
    shares = memory.limit(modal, 1000, named=False)
    assert shares.taken == shares.slots / 2
    assert memory.limit(("calculix", "wing", "matrices"), 1000, named=False).taken == 1


def test_a_job_larger_than_the_memory_runs_alone_and_is_told(
    caplog: pytest.LogCaptureFixture,
) -> None:
    memory, modal = JobMemory(), ("calculix", "wing", "modal")
    for _ in range(2):
        memory.add(modal, 3 * 10**9, 10**9)
    assert memory.limit(modal, 10**9, named=True).taken == memory.limit(modal, 10**9, True).slots
    (said,) = [record.getMessage() for record in caplog.records]
    assert "used 3 GB of memory, more than the available 1 GB" in said
