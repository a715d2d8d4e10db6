"""Distinct minima of whole campaigns: symmetric parts, saddles, valleys, starts that are far.

The structures are those of `benchmarks/zoo/several_minima`; NumPy finds their modes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.zoo.several_minima import (
    far_frame,
    mirrored_beam,
    sectors,
    series_springs,
    soil_building,
)
from benchmarks.zoo.structure import Structure
from scipy.linalg import eigh

import modetune
from modetune.core.modes import Floats
from modetune.core.updating.minima import RISE
from modetune.core.updating.trust import StartSpread, Trust
from modetune.flows.updating import starts as starts_module
from modetune.flows.updating import step as step_module
from modetune.flows.updating.record import CampaignRun

#: Polishing and the loop's own end agree with the truth of an exact test to this.
EXACT = 2e-3


@dataclass
class Bench:
    """Updates structures from exact frequencies, and shapes where the family compares them."""

    folder: Path
    page: bool = False

    def run(self, structure: Structure, truth: dict[str, float], **update: Any) -> CampaignRun:
        assert isinstance(structure.deck, dict)
        model = {name: structure.deck[name] for name in ("stiffness", "mass", "parts")}
        hz, shapes = modes(structure, truth)
        test: dict[str, Any] = {"frequencies_hz": hz}
        residuals = {"shape_weight": 1.0}
        if structure.with_shapes:
            test["mode_shapes"] = shapes
            test["dofs"] = [f"{node}.x" for node in structure.sensors]
        parameters = [{**item, "bounds": [0.4, 2.5]} for item in structure.parameters]
        campaign = modetune.load(
            {
                "name": "several",
                "model": model,
                "test": test,
                "parameters": parameters,
                **({"residuals": residuals} if structure.with_shapes else {}),
                "update": update,
                "report": {"page": self.page},
                "run": {"parallel": 1},
                "store": str(self.folder / "store"),
            },
            folder=self.folder / "campaign",
        )
        return modetune.update(campaign, self.folder / "runs")


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Bench:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    return Bench(tmp_path)


def modes(structure: Structure, truth: dict[str, float]) -> tuple[Floats, Floats]:
    """Frequencies (n_modes,), Hz, and shapes (n, n_modes), by NumPy."""
    assert isinstance(structure.deck, dict)
    stiffness = np.array(structure.deck["stiffness"])
    for name, value in truth.items():
        stiffness = stiffness + (value - 1.0) * structure.deck["parts"][name]["stiffness"]
    eigenvalues, shapes = eigh(stiffness, structure.deck["mass"])
    n = structure.n_modes
    return np.sqrt(eigenvalues[:n]) / (2.0 * np.pi), shapes[:, :n]


def trust_of(run: CampaignRun) -> tuple[Trust, StartSpread]:
    trust = run.record.trust
    assert trust is not None
    assert trust.spread is not None
    return trust, trust.spread


def minima(spread: StartSpread) -> list[Floats]:
    """The answer and the minima that fit as well."""
    return [spread.updated[spread.lowest(number)] for number in (0, *spread.rivals)]


def drawn(family: Callable[[Any], Structure], seed: int) -> Structure:
    made = family(np.random.default_rng([seed, *family.__name__.encode()]))
    assert made.truth is not None or family is series_springs
    return made


@pytest.mark.parametrize("seed", [1, 3])
def test_all_six_permutations_of_three_pairs_of_blades_are_counted(bench: Bench, seed: int) -> None:
    structure = drawn(sectors, seed)
    assert structure.truth is not None
    run = bench.run(structure, structure.truth)
    trust, spread = trust_of(run)
    values = list(structure.truth.values())
    assert len(spread.rivals) == len(spread.exchanged) == 5
    found = {tuple(np.round(place, 2)) for place in minima(spread)}
    assert len(found) == 6
    for place in minima(spread):
        np.testing.assert_allclose(np.sort(place), np.sort(values), rtol=EXACT)
    assert trust.verdict == "not to be trusted"
    sentences = run.summary["trust"]["sentences"]
    assert sum("5 more minima, exchanges of the values of" in said for said in sentences) == 1


@pytest.mark.parametrize("seed", [1, 3])
def test_a_symmetric_start_leaves_its_ridge_and_the_mirrored_answer_is_listed(
    bench: Bench, seed: int
) -> None:
    structure = drawn(mirrored_beam, seed)
    assert structure.truth is not None
    run = bench.run(structure, structure.truth)
    trust, spread = trust_of(run)
    truth = np.array(list(structure.truth.values()))
    # The loop itself cannot leave left = right.
    own = spread.updated[0]
    assert own[0] == pytest.approx(own[1], abs=1e-6)
    assert spread.minima[0] == -1
    assert spread.misfits[0] > 16.0
    found = sorted(minima(spread), key=lambda place: float(place[0]))
    np.testing.assert_allclose(found, sorted([truth, truth[::-1]], key=lambda t: t[0]), rtol=EXACT)
    assert run.record.status == "converged"
    assert trust.verdict == "not to be trusted"


@pytest.mark.parametrize(
    ("family", "update"), [(sectors, {}), (mirrored_beam, {}), (far_frame, {"max_iterations": 2})]
)
def test_a_repeated_update_searches_nothing_and_draws_nothing(
    bench: Bench,
    family: Callable[[Any], Structure],
    update: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    structure, bench.page = drawn(family, 2), True
    assert structure.truth is not None
    first = bench.run(structure, structure.truth, **update)
    assert first.page is not None
    drawn_at = first.page.stat().st_mtime_ns
    monkeypatch.delattr(starts_module.Search, "end")
    again = bench.run(structure, structure.truth, **update)
    assert again.page == first.page
    assert again.page.stat().st_mtime_ns == drawn_at
    one, other = trust_of(first)[1], trust_of(again)[1]
    for name in ("starts", "updated", "misfits", "minima", "extent"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert (one.outcomes, one.rivals, one.chosen) == (other.outcomes, other.rivals, other.chosen)
    # Another test is another search.
    other_truth = {name: 1.02 * value for name, value in structure.truth.items()}
    with pytest.raises(AttributeError, match="end"):
        bench.run(structure, other_truth, **update)


def test_a_truth_and_its_mirror_image_have_one_verdict_and_list_each_other(bench: Bench) -> None:
    structure = drawn(mirrored_beam, 1)
    names = [item["name"] for item in structure.parameters]
    listed = []
    for place, values in enumerate([(0.7, 1.05), (1.05, 0.7)]):
        own = Bench(bench.folder / str(place))
        trust, spread = trust_of(own.run(structure, dict(zip(names, values, strict=True))))
        listed.append(sorted(tuple(np.round(item, 2).tolist()) for item in minima(spread)))
        assert trust.verdict == "not to be trusted"
    assert listed[0] == listed[1] == [(0.7, 1.05), (1.05, 0.7)]


@pytest.mark.parametrize("seed", [1, 2])
def test_a_building_on_soil_springs_is_found_from_far_away(bench: Bench, seed: int) -> None:
    structure = drawn(soil_building, seed)
    assert structure.truth is not None
    run = bench.run(structure, structure.truth)
    trust, spread = trust_of(run)
    np.testing.assert_allclose(run.record.updated, list(structure.truth.values()), rtol=EXACT)
    assert run.record.status == "converged"
    assert spread.rivals == ()
    assert trust.verdict == "trusted"


def test_iterations_that_are_used_up_do_not_end_the_search(bench: Bench) -> None:
    structure = drawn(far_frame, 2)
    assert structure.truth is not None
    run = bench.run(structure, structure.truth, max_iterations=2)
    np.testing.assert_allclose(run.record.updated, list(structure.truth.values()), rtol=EXACT)
    assert run.record.status == "converged"
    assert "the best of 12 starts" in run.record.reason
    alone = Bench(bench.folder / "alone").run(
        structure, structure.truth, max_iterations=2, starts=1
    )
    assert alone.record.status == "max_iterations"
    assert alone.record.trust is not None
    assert alone.record.trust.untested


def test_springs_in_series_are_a_valley_with_its_extent(bench: Bench) -> None:
    structure = drawn(series_springs, 1)
    truth = {"near": 0.9, "far": 1.2, "top": 0.8}
    run = bench.run(structure, truth)
    _, spread = trust_of(run)
    assert spread.rivals == ()
    assert set(spread.valley) == {"near", "far"}
    (near, far, top) = spread.extent.T
    # Starts of 64 strata in 0.4 to 2.5 reach most of it; the truth is inside.
    assert near[0] < 0.9 < near[1]
    assert far[0] < 1.2 < far[1]
    np.testing.assert_allclose(top, 0.8, rtol=EXACT)
    sentences = run.summary["trust"]["sentences"]
    assert any(said.startswith("Along a valley the misfit") for said in sentences)
    assert set(run.summary["trust"]["starts"]["valley"]) == {"near", "far"}
    # NumPy confirms both ends of the valley: their frequencies are within the noise.
    hz, _ = modes(structure, truth)
    for end in (np.argmin(spread.updated[:, 0]), np.argmax(spread.updated[:, 0])):
        there, _ = modes(structure, dict(zip(truth, spread.updated[end], strict=True)))
        assert np.sum(((there / hz - 1.0) / 0.002) ** 2) < RISE


@pytest.mark.parametrize("family", [soil_building, far_frame, sectors, mirrored_beam])
def test_no_evaluated_point_fits_better_than_the_reported_minimum(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, family: Callable[[Any], Structure]
) -> None:
    lowest = [np.inf]
    own = step_module.objective

    def objective(*given: Any) -> float:
        found = own(*given)
        lowest[0] = min(lowest[0], found)
        return found

    monkeypatch.setattr(starts_module, "objective", objective)
    structure = drawn(family, 5)
    assert structure.truth is not None
    record = bench.run(structure, structure.truth).record
    assert np.isfinite(lowest[0])
    assert record.best.residual.misfit <= lowest[0] + RISE
