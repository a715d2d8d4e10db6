"""Journals of long benchmarks: interrupted, cut off, whole, shared."""

from __future__ import annotations

from pathlib import Path

import pytest
from benchmarks.journal import Journal

PLAN = {"kills": {"go": 3}}


def test_an_interrupted_journal_goes_on_and_a_whole_one_gives_the_next_its_seed(
    tmp_path: Path,
) -> None:
    path = tmp_path / "runs" / "kills.jsonl"
    first = Journal(path, PLAN)
    first.add("go 0", {"blows": 2})
    first.close()
    with path.open("a") as file:
        file.write('{"piece": "go 1", "resu')  # killed while it was written
    again = Journal(path, PLAN)
    assert (again.seed, again.results) == (1, {"go 0": {"blows": 2}})
    again.add("go 1", {"blows": 1})
    again.end()
    again.close()
    following = Journal(path, PLAN)
    assert (following.seed, following.results) == (2, {})
    following.add("go 0", {})
    following.close()
    other = Journal(path, {"kills": {}})
    assert (other.seed, other.results) == (3, {})
    other.close()


def test_two_benchmarks_do_not_share_a_journal(tmp_path: Path) -> None:
    held = Journal(tmp_path / "j.jsonl", PLAN, seed=5)
    held.add("go 0", 1)
    with pytest.raises(SystemExit, match="another benchmark"):
        Journal(tmp_path / "j.jsonl", PLAN)
    held.close()
    again = Journal(tmp_path / "j.jsonl", PLAN, seed=5)
    assert again.results == {"go 0": 1}
    again.close()
