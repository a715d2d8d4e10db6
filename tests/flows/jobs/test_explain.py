"""Stored results explained, and dry runs that run nothing."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import CampaignError, NotStored, SolverRejected
from modetune.core.storage.keys import canonical_json, content_key
from modetune.core.storage.store import Store
from modetune.flows.campaign.schema import SensitivitySection
from modetune.flows.cli.explain import explain
from modetune.flows.cli.update import show_dry_run
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.job import Job
from modetune.flows.jobs.lookup import explain_job, key_start
from modetune.flows.updating.dry_run import dry_run, explain_unrun
from modetune.flows.updating.update import update_campaign
from tests.core.storage.test_store import holdings

TRUTH = {"k1": 1.2, "k2": 0.8}
MODAL = ModalAnalysis(6, (1, 2, 3, 4, 5, 6))


def solved(bench: Any, values: dict[str, float], analysis: Any = MODAL) -> str:
    """The key of a job that the store has from now on."""
    return str(job_engine(bench.campaign(TRUTH)).solve(Job(values, analysis)).key)


def test_a_note_does_not_change_the_key(bench: Any) -> None:
    campaign = bench.campaign(TRUTH)
    key = solved(bench, {"k1": 1.1})
    asked = campaign.case.solver.render({"k1": 1.1}, MODAL).content
    assert key == content_key(canonical_json(asked))
    holding = campaign.store.holding(key)
    assert holding is not None
    assert '"k1", 1.1' in holding.note


def test_a_result_is_told_in_the_campaigns_words(bench: Any) -> None:
    key = solved(bench, {"k1": 1.1, "k2": 0.9})
    found = explain_job(bench.campaign(TRUTH).store, key[:8])
    assert found is not None
    assert (found.key, found.state) == (key, "stored")
    assert found.job is not None
    assert found.job.note is not None
    assert found.job.note.values == (("k1", 1.1), ("k2", 0.9))
    assert (found.job.note.model, found.job.note.n_modes) == ("chain", 6)


def test_a_failed_job_is_told_with_its_values_and_its_log(bench: Any) -> None:
    solved(bench, {"k1": 1.0})
    bench.script({2: "rejected"})
    engine = job_engine(bench.campaign(TRUTH))
    job = Job({"k1": 1.3}, MODAL)
    with pytest.raises(SolverRejected):
        engine.solve(job)
    folder = engine.store.folder / "jobs" / f"{engine.key(job)}.failed"
    found = explain_job(engine.store, key_start(str(folder)))
    assert found is not None
    assert found.state == "failed"
    assert "REJECTED" in found.log


def test_a_start_that_fits_several_keys_is_refused_with_them(bench: Any) -> None:
    store = Store(bench.folder / "store")
    for key in ("abcd1" + "0" * 59, "abcd2" + "0" * 59):
        (store.folder / "jobs" / f"{key}.failed").mkdir(parents=True)
    with pytest.raises(
        CampaignError, match=r"2 keys start with abcd \(abcd10000000, abcd20000000\)"
    ):
        explain_job(store, "abcd")


@pytest.mark.parametrize("given", ["xyz", "abc", "../../etc/passwd", "ab*"])
def test_what_is_no_key_is_refused(given: str) -> None:
    with pytest.raises(CampaignError, match="is not a key"):
        key_start(given)


def test_an_entry_that_cannot_be_read_is_passed_over(bench: Any) -> None:
    good, bad = solved(bench, {"k1": 1.1}), solved(bench, {"k1": 1.2})
    store = bench.campaign(TRUTH).store
    store.path(bad).write_bytes(b"no HDF5")
    assert [holding.key for holding in holdings(store)] == [good]
    found = explain_job(store, bad)
    assert found is not None
    assert found.state == "damaged"


def test_a_dry_run_of_a_new_campaign_tells_the_first_jobs_and_runs_none(bench: Any) -> None:
    differences_of = SensitivitySection(method="finite_difference")
    campaign = bench.campaign(TRUTH, sensitivity=differences_of)
    found = dry_run(campaign, bench.folder / "run")
    assert bench.runs() == 0
    assert [item.name for item in found.jobs] == ["modal", "sensitivity k1", "sensitivity k2"]
    assert found.runs == found.jobs
    assert not campaign.store.folder.exists()


def test_a_dry_run_after_the_campaign_says_that_nothing_would_be_run(
    bench: Any, watcher: Any
) -> None:
    campaign = bench.campaign(TRUTH)
    record = update_campaign(campaign, bench.folder / "run", watcher).record
    count = bench.runs()
    found = dry_run(campaign, bench.folder / "run")
    assert bench.runs() == count
    assert found.jobs == ()
    assert found.ended is not None
    np.testing.assert_array_equal(found.ended.updated, record.updated)


def test_a_dry_run_follows_the_store_to_where_its_answers_end(bench: Any, watcher: Any) -> None:
    settings = SensitivitySection(method="finite_difference")
    campaign = bench.campaign(TRUTH, sensitivity=settings)
    record = update_campaign(campaign, bench.folder / "run", watcher).record
    gone = record.iterations[2].modal_key
    campaign.store.path(gone).unlink()
    count = bench.runs()
    found = dry_run(campaign, bench.folder / "run")
    assert bench.runs() == count
    assert len(found.iterations) == 2
    (missing,) = found.runs
    assert (missing.key, missing.name, missing.iteration) == (gone, "modal", "iteration 2")


def test_a_dry_run_takes_no_damaged_entry_for_a_hit(bench: Any, watcher: Any) -> None:
    campaign = bench.campaign(TRUTH)
    record = update_campaign(campaign, bench.folder / "run", watcher).record
    path: Path = campaign.store.path(record.iterations[1].modal_key)
    path.write_bytes(path.read_bytes()[:-100])
    count = bench.runs()
    found = dry_run(campaign, bench.folder / "run")
    assert bench.runs() == count
    assert [item.key for item in found.runs] == [record.iterations[1].modal_key]


def test_a_job_that_is_still_to_be_run_is_told_by_its_campaign(bench: Any) -> None:
    campaign = bench.campaign(TRUTH)
    solved(bench, {"k1": 1.0, "k2": 1.1})
    (item,) = dry_run(campaign, bench.folder / "run").runs
    assert explain_job(campaign.store, item.key[:10]) is None
    found = explain_unrun(campaign, item.key[:10])
    assert found is not None
    assert found.state == "not run"
    assert found.job is not None
    assert found.job.note is not None
    assert found.job.note.values == (("k1", 1.0), ("k2", 1.0))


def test_an_engine_that_may_not_run_says_what_it_lacks(bench: Any) -> None:
    engine = replace(job_engine(bench.campaign(TRUTH)), may_run=False)
    with pytest.raises(NotStored, match="the store has no result"):
        engine.solve(Job({"k1": 1.1}, MODAL))
    assert bench.runs() == 0


def test_the_command_tells_a_job_in_lines_and_as_an_object(
    bench: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    key = solved(bench, {"k1": 1.1})
    solved(bench, {"k1": 1.2})
    store = bench.campaign(TRUTH).store.folder
    explain(key[:6], store)
    said = capsys.readouterr().out
    assert said.startswith(f"job      {key}\nstate    stored\n")
    assert "modal analysis of chain, 6 modes, shapes at 6 nodes" in said
    assert "at       k1 1.1" in said
    explain(key, store, as_json=True)
    told = json.loads(capsys.readouterr().out)
    assert (told["status"], told["job"]["values"]) == ("stored", {"k1": 1.1})


def test_the_command_refuses_what_nothing_is_known_of(bench: Any) -> None:
    store = bench.folder / "store"
    with pytest.raises(CampaignError, match="does not exist"):
        explain("abcd", store)
    store.mkdir()
    with pytest.raises(CampaignError, match=r"there is no job abcd\.\.\."):
        explain("abcd", store)


def test_a_dry_run_is_told_in_lines_and_as_an_object(
    bench: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    campaign = bench.campaign(TRUTH)
    monkeypatch.setattr("modetune.flows.campaign.campaign.load_campaign", lambda *_: campaign)
    parameters = {"campaign_file": "c.yaml", "runs": bench.folder}
    show_dry_run(parameters, as_json=False)
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("run   ")
    assert said[0].endswith("iteration 0 / modal")
    assert said[1].startswith("1 job of 1 in this iteration would run")
    show_dry_run(parameters, as_json=True)
    told = json.loads(capsys.readouterr().out)
    assert (told["status"], told["runs"], told["jobs"][0]["stored"]) == ("would run", 1, False)
    assert bench.runs() == 0
