"""The table of speeds: medians, rows that fail, what is printed, and one row for real."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from benchmarks.__main__ import main
from benchmarks.rows import ROWS
from benchmarks.table import Figure, Measured, Row, markdown, measure, told

from tests.adapters.solved import needs_ccx


def row(name: str, aim: float, at_least: bool, of: Callable[[float], float]) -> Row[float]:
    """A row whose rounds are numbers."""
    return Row(name, f"what {name} is", aim, at_least, lambda each: Figure(of(each), {"s": each}))


def test_a_figure_is_the_median_of_its_rounds() -> None:
    (three,) = measure([row("half", 1.0, True, lambda each: each / 2)], [1.0, 9.0, 4.0])
    assert three.value == 2.0
    assert three.figure == Figure(2.0, {"s": 4.0})
    (two,) = measure([row("half", 1.0, True, lambda each: each / 2)], [1.0, 9.0])
    assert two.value == 2.5  # the mean of 0.5 and 4.5
    assert two.figure == Figure(0.5, {"s": 1.0})


@pytest.mark.parametrize(
    ("at_least", "value", "reached"),
    [(True, 2.0, True), (True, 1.9, False), (False, 2.0, True), (False, 2.1, False)],
)
def test_an_aim_is_reached_from_its_side(at_least: bool, value: float, reached: bool) -> None:
    (found,) = measure([row("same", 2.0, at_least, lambda each: each)], [value])
    assert found.reached is reached
    assert ("**" in markdown([found])) is not reached


def test_a_row_that_fails_is_told_and_the_others_go_on(
    capsys: pytest.CaptureFixture[str],
) -> None:
    tried: list[float] = []

    def fails(each: float) -> float:
        tried.append(each)
        raise SystemExit("modetune update failed with code 4:\nno licence | none")

    first, second = measure(
        [row("broken", 1.0, True, fails), row("same", 1.0, True, lambda each: each)], [3.0, 5.0]
    )
    assert tried == [3.0]  # it is not tried again
    assert (first.value, first.figure, first.reached) == (None, None, None)
    assert second.value == 4.0
    lines = markdown([first, second]).splitlines()
    assert lines[2].startswith("| `broken` | what broken is | failed | at least 1 | no licence / ")
    assert all(line.count("|") == 6 for line in lines)
    shown = json.loads(json.dumps(told([first, second])))
    assert [item["value"] for item in shown] == [None, 4.0]
    assert shown[0]["error"].endswith("no licence | none")
    assert shown[1]["rounds"][0] == {"value": 3.0, "made_of": {"s": 3.0}}
    assert "round 1, broken: modetune update failed" in capsys.readouterr().err


def test_a_row_without_rounds_has_no_figure() -> None:
    empty = Measured(row("same", 1.0, True, float))
    assert empty.value is None
    assert empty.reached is None


def test_rows_have_names_of_their_own() -> None:
    assert len({each.name for each in ROWS}) == len(ROWS)


def test_an_unknown_row_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["--rows", "peer-huge"])
    assert ended.value.code == 2
    assert "peer-coarse" in capsys.readouterr().err


@needs_ccx
def test_a_row_is_measured_on_the_smallest_models(
    capfd: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)  # where its journal is
    arguments = ["--quick", "--rows", "whole-fine", "--rounds", "1", "--server", "none"]
    main([*arguments, "--profile"])
    output = capfd.readouterr().out.splitlines()
    (row,), seconds = (json.loads(output[-1])[name] for name in ("rows", "seconds"))
    (figure,) = row["rounds"]
    made_of = figure["made_of"]
    assert row["error"] == ""
    assert figure["value"] == made_of["whole s"] / made_of["plain run s"] > 1.0
    assert made_of["modal runs"] + made_of["matrix jobs"] >= 2  # the deck's values, and the end
    # Looks cover the process from its start to its end, but for the last and what it waited for.
    (spent,) = seconds.values()
    assert 0.5 * made_of["whole s"] < sum(spent.values()) <= 1.05 * made_of["whole s"]
    assert spent["solver's jobs"] > 0.0
    assert output[0].startswith("| row |")
