"""Jobs on warm Dask workers: all of a small design are run, counted, and not run again."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from benchmarks import scale_out

pytest.importorskip("distributed", reason="Dask is not installed (the extra `cluster`)")


def test_designs_run_on_warm_workers_and_an_interrupted_benchmark_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(scale_out, "FOLDER", tmp_path)
    monkeypatch.setattr(scale_out, "EACH", 6)
    words = ["--most", "2", "--sleep", "0.2", "--points", "10"]
    scale_out.main(words)
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    # The first model, three differences, and the points: of sobol, five times a power of two.
    jobs = {"2 lhs": 14, "2 sobol": 1 + 3 + 40, "1 lhs": 1 + 3 + 6}
    assert {piece: each["jobs"] for piece, each in found.items()} == jobs
    # A journal without its last line and last piece: only that piece is measured again.
    journal = tmp_path / "scale-out.jsonl"
    journal.write_text("".join(journal.read_text().splitlines(keepends=True)[:-2]))
    scale_out.main(words)
    again = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert again["2 lhs"] == found["2 lhs"]
    assert again["1 lhs"] != found["1 lhs"]


def test_the_cost_of_a_job_is_what_rounds_of_sleep_leave() -> None:
    row = scale_out.line(4, "lhs", {"jobs": 40.0, "wall_s": 22.0, "again_s": 1.0}, 2.0)
    assert row == "| 4 | lhs | 40 | 22.0 | 0.909 | 50 | 1.0 |"
