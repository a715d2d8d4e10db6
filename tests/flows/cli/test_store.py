"""`modetune store`, as a user meets it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from modetune.core.errors import CampaignError
from modetune.core.storage.store import Store
from modetune.flows.cli.store import age_s, shown_age, shown_size, size_bytes
from modetune.flows.jobs.store_files import in_use
from modetune.flows.updating.update import update_campaign
from tests.command_line import run_command as run


@pytest.fixture
def folder(bench: Any, watcher: Any) -> Path:
    """A place whose store has the results of a campaign."""
    update_campaign(bench.campaign({"k1": 1.2, "k2": 0.8}), bench.folder / "run", watcher)
    return Path(bench.folder)


def told(folder: Path, *arguments: str) -> Any:
    ended = run(folder, "store", *arguments, "--store", "store", "--json")
    assert ended.returncode == 0, ended.stderr
    return json.loads(ended.stdout)


def test_results_are_listed_and_summed(folder: Path) -> None:
    results = told(folder, "list")["results"]
    store = Store(folder / "store")
    assert {item["key"] for item in results} == {
        path.name.partition(".")[0] for path in store.entries()
    }
    first = results[-1]
    assert (first["solver"], first["model"]) == ("scripted", "chain")
    assert first["size_bytes"] == store.path(first["key"]).stat().st_size
    assert [
        item["key"] for item in told(folder, "list", "--by", "oldest", "--limit", "1")["results"]
    ] == [first["key"]]
    sizes = [item["size_bytes"] for item in told(folder, "list", "--by", "largest")["results"]]
    assert sizes == sorted(sizes, reverse=True)
    summed = told(folder, "size")
    solved = [item for item in summed["holds"] if item["solver"]]
    assert sum(item["files"] for item in solved) == len(results)
    assert sum(item["size_bytes"] for item in solved) == sum(sizes)
    shown = run(folder, "store", "size", "--store", "store").stdout
    assert "chain" in shown
    assert shown.endswith(f"store holds {shown_size(summed['size_bytes'])}\n")


def test_a_damaged_result_is_told_by_check_with_code_5(folder: Path) -> None:
    count = len(told(folder, "list")["results"])
    assert told(folder, "check") == {"store": "store", "whole": count, "damaged": []}
    path = next(Store(folder / "store").entries())
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    ended = run(folder, "store", "check", "--store", "store")
    assert ended.returncode == 5
    assert f"{count - 1} whole, 1 damaged" in ended.stdout
    assert str(Path("store/damaged") / path.name) in ended.stdout


def test_pruning_tells_first_and_removes_then(folder: Path) -> None:
    count = len(told(folder, "list")["results"])
    planned = told(folder, "prune", "--older", "0s", "--dry-run")
    assert sum(item["what"] == "result" for item in planned["removed"]) == count
    assert len(told(folder, "list")["results"]) == count
    assert told(folder, "prune", "--older", "1h")["size_bytes"] == 0
    assert len(told(folder, "list")["results"]) == count
    told(folder, "prune", "--older", "0s")
    assert told(folder, "list")["results"] == []
    assert run(folder, "store", "prune", "--store", "store").stdout == "nothing to remove\n"


def test_one_result_is_forgotten_by_the_start_of_its_key(folder: Path) -> None:
    results = told(folder, "list")["results"]
    key = results[0]["key"]
    (gone,) = told(folder, "forget", key[:12])["removed"]
    assert gone["key"] == key
    assert {item["key"] for item in told(folder, "list")["results"]} == {
        item["key"] for item in results[1:]
    }
    again = run(folder, "store", "forget", key[:12], "--store", "store")
    assert again.returncode == 2
    assert "there is no job" in again.stderr


def test_results_stay_for_a_campaign_that_runs_and_that_is_told(folder: Path) -> None:
    count = len(told(folder, "list")["results"])
    with in_use(Store(folder / "store")):
        ended = run(folder, "store", "prune", "--older", "0s", "--store", "store")
        assert ended.stderr == "kept results, because 1 running campaign(s) may need them\n"
    assert len(told(folder, "list")["results"]) == count
    shown = run(folder, "store", "list", "--store", "store").stdout
    assert "written ago" in shown
    assert " kB" in shown


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["list", "--store", "none"], "none does not exist"),
        (["prune", "--older", "30"], "'30' is not an age: expected a number and one of s, min"),
        (["prune", "--larger", "10 elephants"], "is not a size"),
        (["forget", "xyz"], "is not a key"),
    ],
)
def test_a_wrong_use_is_one_sentence(folder: Path, arguments: list[str], said: str) -> None:
    place = [] if "--store" in arguments else ["--store", "store"]
    ended = run(folder, "store", *arguments, *place)
    assert ended.returncode == 2
    assert said in ended.stderr


def test_ages_and_sizes_have_units() -> None:
    assert [age_s(text) for text in ("90min", "12h", "30d", "1.5w", "0s")] == [
        5400.0, 43200.0, 2592000.0, 907200.0, 0.0,
    ]  # fmt: skip
    assert [size_bytes(text) for text in ("10MB", "500 kb", "1GB", "7B")] == [
        10**7, 500_000, 10**9, 7,
    ]  # fmt: skip
    assert [shown_size(size) for size in (0, 999, 186_400, 10**9)] == [
        "0 B", "999 B", "186.4 kB", "1 GB",
    ]  # fmt: skip
    ages = (0.4, 59, 3600, 200_000, 86400 * 60)
    assert [shown_age(age) for age in ages] == ["0 s", "59 s", "1 h", "2.31 d", "8.57 w"]
    with pytest.raises(CampaignError, match="as 10MB"):
        size_bytes("ten")
