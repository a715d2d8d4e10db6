"""The benchmark's arithmetic: medians, ratios of pairs, growth, and what is printed."""

from __future__ import annotations

import json

import pytest
from benchmarks.campaign import parse, wanted
from benchmarks.comparison import (
    Round,
    SizeResult,
    growth,
    growths,
    peak_bytes,
    summary,
    table,
    wall_s,
)
from benchmarks.cost import Cost
from benchmarks.ways import LETTERS, WAYS, Trial


def trial(wall: float, peak: int = 10**9) -> Trial:
    cost = Cost(wall, 2.0 * wall, peak, modal_runs=7, matrix_runs=1)
    return Trial(cost, True, (1.1, 0.9), 2e-5, 1e-5, None, 0.02, 0.01)


def result(size: str, n_equations: int, *rounds: dict[str, float]) -> SizeResult:
    """Rounds of wall times; the plain run is called `plain`."""
    return SizeResult(
        size,
        n_equations,
        2,
        3,
        1,
        tuple(
            Round(walls["plain"], {k: trial(v) for k, v in walls.items() if k != "plain"})
            for walls in rounds
        ),
    )


THREE = result(
    "coarse",
    1000,
    {"plain": 1.0, "a": 10.0, "e": 2.0},
    {"plain": 2.0, "a": 90.0, "e": 10.0},
    {"plain": 1.0, "a": 8.0, "e": 4.0},
)


def test_a_ratio_is_the_median_of_the_rounds_own_ratios() -> None:
    assert THREE.wall_s("a") == 10.0
    # 5, 9 and 2 to e; 10, 45 and 8 to the plain run. The ratio of medians would be 2.5.
    assert THREE.to_reference("a", wall_s) == 5.0
    assert THREE.to_plain("a") == 10.0
    assert THREE.to_reference("e", wall_s) == 1.0
    assert THREE.to_reference("a", peak_bytes) == 1.0


def test_there_is_no_ratio_without_the_reference() -> None:
    alone = result("coarse", 1000, {"plain": 1.0, "a": 10.0})
    assert alone.to_reference("a", wall_s) is None
    assert alone.to_plain("a") == 10.0


def test_growth_is_the_exponent_of_a_power() -> None:
    sizes = [1e3, 1e4, 3e5]
    # Closed form: 2 n^1.5 has the exponent 1.5; rounding alone is left.
    assert growth(sizes, [2.0 * n**1.5 for n in sizes]) == pytest.approx(1.5, abs=1e-12)
    assert growth([1e3], [1.0]) is None
    assert growth([1e3, 1e3], [1.0, 2.0]) is None


def test_growths_are_of_the_sizes_at_which_a_way_was_run() -> None:
    results = [
        result("coarse", 100, {"plain": 1.0, "a": 10.0, "e": 2.0}),
        result("medium", 10_000, {"plain": 10.0, "a": 1000.0, "e": 2.0}),
        result("fine", 1_000_000, {"plain": 100.0, "e": 2.0}),
    ]
    found = growths(results)
    assert found["a"] == pytest.approx(1.0, abs=1e-12)  # 100 times the time for 100 times the size
    assert found["e"] == pytest.approx(0.0, abs=1e-12)
    assert found["plain"] == pytest.approx(0.5, abs=1e-12)
    assert set(found) == {"a", "e", "plain"}


def test_the_summary_is_json_with_every_trial() -> None:
    told = json.loads(json.dumps(summary([THREE])))
    (size,) = told["sizes"]
    assert (size["size"], size["equations"], size["parameters"]) == ("coarse", 1000, 2)
    assert size["plain_s"] == [1.0, 2.0, 1.0]
    assert set(size["ways"]) == {"a", "e"}
    way = size["ways"]["a"]
    assert way["wall_to_reference"] == 5.0
    assert [each["cost"]["wall_s"] for each in way["trials"]] == [10.0, 90.0, 8.0]
    assert way["trials"][0]["cost"]["modal_runs"] == 7
    assert told["growth"] == {"a": None, "e": None, "plain": None}


def test_the_table_has_a_line_a_way_and_says_what_did_not_converge() -> None:
    lines = table(THREE).splitlines()
    assert len(lines) == 4
    assert "1,000 equations" in lines[0]
    assert [line[0] for line in lines[2:]] == ["a", "e"]
    assert all(line.endswith("yes") for line in lines[2:])


def test_sizes_may_name_their_ways() -> None:
    assert wanted("fine:ed", "garteur").letters == "de"
    assert wanted("coarse", "garteur").letters == LETTERS == "".join(w.letter for w in WAYS)
    for wrong in ("huge", "fine:", "fine:x"):
        with pytest.raises(ValueError, match=r"sizes|letters"):
            wanted(wrong, "garteur")


def test_wrong_options_are_told_in_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["--repeats", "0"], ["--target", "2"], ["--sizes", "huge"]):
        with pytest.raises(SystemExit) as ended:
            parse(arguments)
        assert ended.value.code == 2
    assert "Traceback" not in capsys.readouterr().err
