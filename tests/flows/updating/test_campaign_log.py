"""The campaign's log says what ran, how each iteration was, and how it ended."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import pytest

from modetune.core.errors import LicenceDenied, SolverCrashed
from tests.flows.updating.test_update import TRUTH, run


def log_of(bench: Any, name: str = "run") -> list[str]:
    lines = (bench.folder / name / "campaign.log").read_text().splitlines()
    return [line.split(" ", 3)[-1] for line in lines if line[:2] == "20"]


def test_runs_and_iterations_and_the_end_are_logged(bench: Any, watcher: Any) -> None:
    level = logging.getLogger("modetune").level
    bench.script({2: "killed"})
    record = run(bench, watcher, bench.campaign(TRUTH, retries=1))
    lines = log_of(bench)
    assert "campaign chain (" in lines[0]
    assert "solver scripted, version 1" in lines[1]
    assert sum("scripted job" in line and "solved in" in line for line in lines) == (
        record.runs.modal + record.runs.sensitivity
    )
    text = (bench.folder / "run" / "campaign.log").read_text()
    assert text.count("retry 1 of 1") == 1  # below the program that was killed
    assert sum(" iteration " in f" {line}" and "lowest MAC" in line for line in lines) == len(
        record.iterations
    )
    assert lines[-1].strip() == f"converged: {record.reason}"
    assert logging.getLogger("modetune").level == level
    assert not any("campaign.log" in str(item) for item in logging.getLogger("modetune").handlers)


def test_a_failure_is_logged_and_a_second_run_goes_on_below(bench: Any, watcher: Any) -> None:
    bench.script(dict.fromkeys(range(1, 10), "short"))
    with pytest.raises(SolverCrashed):
        run(bench, watcher, bench.campaign(TRUTH))
    bench.script({})
    run(bench, watcher, bench.campaign(TRUTH))
    lines = log_of(bench)
    failed = [n for n, line in enumerate(lines) if "ended with SolverCrashed: the scripted" in line]
    assert len(failed) == 1
    assert "campaign chain (" in lines[failed[0] + 1]
    assert "converged: " in lines[-1]


def test_a_log_that_cannot_be_written_is_no_failure(bench: Any, watcher: Any) -> None:
    (bench.folder / "run" / "campaign.log").mkdir(parents=True)
    assert run(bench, watcher, bench.campaign(TRUTH)).status == "converged"


def test_a_message_after_the_end_opens_no_log_again(
    bench: Any, watcher: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A thread that logs while a campaign of the same process ends may hold its handler still."""
    added: list[logging.Handler] = []
    ours = logging.getLogger("modetune")
    add = ours.addHandler

    def kept(item: logging.Handler) -> None:
        added.append(item)
        add(item)

    monkeypatch.setattr(ours, "addHandler", kept)
    run(bench, watcher, bench.campaign(TRUTH))
    (late,) = [item for item in added if isinstance(item, logging.FileHandler)]
    lines = log_of(bench)
    late.handle(logging.LogRecord("modetune", logging.INFO, "", 0, "late", None, None))
    assert late.stream is None
    assert log_of(bench) == lines


def test_a_campaigns_words_for_a_licence_that_is_not_free_are_waited_for(
    bench: Any, watcher: Any
) -> None:
    bench.script({1: "short", 2: "short"})  # prints `running` and breaks off
    campaign = bench.campaign(TRUTH, retries=0)
    campaign = replace(
        campaign, run=campaign.run.model_copy(update={"licence_messages": ("Running",)})
    )
    record = run(bench, watcher, campaign)
    assert record.status == "converged"
    assert bench.runs() == record.runs.modal + 2
    bench.script(dict.fromkeys(range(1, 100), "short"))
    other = bench.campaign({"k1": 1.1, "k5": 0.9}, retries=0, licence_wait_s=0.05)
    other = replace(other, run=other.run.model_copy(update={"licence_messages": ("RUNNING",)}))
    with pytest.raises(LicenceDenied, match=r"scripted got no licence in .*: running"):
        run(bench, watcher, other, "other")
