"""The default step: how many evaluations known answers take, and what ends updating before them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigh

import modetune
from modetune.core.modes import Floats
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.flows.campaign.schema import E1Section, SensitivitySection, UpdateSection
from modetune.flows.updating.update import update_campaign

EXACT = {"frequency": 1e-8, "mac": 0.9}


def storeys(
    folder: Path,
    truth: Floats,
    n_modes: int,
    bounds: tuple[float, float] = (0.4, 2.5),
    shape_weight: float = 1.0,
    differences: bool = False,
    **update: Any,
) -> CampaignRecord:
    """An update of equal storeys towards true springs, from one start, else at default settings.

    differences: sensitivities are those of modal runs, one after the other.
    """
    more: dict[str, Any] = {"sensitivity": {"method": "finite_difference"}} if differences else {}
    n = truth.size
    parts = {}
    for place in range(n):
        ends = np.zeros(n)
        ends[place] = 1.0
        if place:
            ends[place - 1] = -1.0
        parts[f"k{place + 1}"] = {"stiffness": 1000.0 * np.outer(ends, ends)}
    own = [part["stiffness"] for part in parts.values()]
    eigenvalues, shapes = eigh(np.tensordot(truth, np.array(own), 1), np.eye(n))
    campaign = modetune.load(
        {
            "name": "storeys",
            "model": {
                "solver": "matrices",
                "units": "m-kg-s",
                "stiffness": sum(own),
                "mass": np.eye(n),
                "parts": parts,
            },
            "test": {
                "frequencies_hz": np.sqrt(eigenvalues[:n_modes]) / (2.0 * np.pi),
                "mode_shapes": shapes[:, :n_modes],
                "dofs": [f"{place + 1}.x" for place in range(n)],
            },
            "parameters": [
                {"name": name, "quantity": "matrix_factor", "part": name, "bounds": list(bounds)}
                for name in parts
            ],
            "residuals": {"shape_weight": shape_weight},
            "update": {"e1": EXACT, "starts": 1, **update},
            "run": {"parallel": 1},
            **more,
            "report": {"page": False},
            "store": str(folder / "store"),
        },
        folder=folder / "campaign",
    )
    return modetune.update(campaign, folder / "runs").record


@pytest.mark.parametrize("spread", [(0.75, 1.3), (0.5, 2.0)])
def test_eighteen_springs_take_at_most_eight_steps(
    tmp_path: Path, spread: tuple[float, float]
) -> None:
    truth = np.random.default_rng(1).uniform(*spread, 18)
    record = storeys(tmp_path, truth, 4)
    assert record.status == "converged"
    assert record.iterations[-1].number <= 8
    np.testing.assert_allclose(record.updated, truth, rtol=1e-6)


def test_a_step_limit_is_no_limit_where_bounds_allow_eleven_times(tmp_path: Path) -> None:
    truth = np.array([9.5, 8.0, 10.9])
    record = storeys(tmp_path, truth, 3, bounds=(0.1, 11.0))
    assert record.status == "converged"
    assert record.iterations[-1].number <= 12
    np.testing.assert_allclose(record.updated, truth, rtol=1e-6)


def test_more_springs_than_frequencies_end_near_the_start(tmp_path: Path) -> None:
    truth = np.random.default_rng(1).uniform(0.75, 1.3, 18)
    record = storeys(tmp_path, truth, 4, shape_weight=0.0)
    assert record.status == "converged"
    # The truth fits too; what is found is no further from the deck than it.
    assert np.linalg.norm(record.updated - 1.0) < np.linalg.norm(truth - 1.0)
    assert record.trust is not None
    assert record.trust.verdict != "trusted"


def test_used_up_iterations_name_what_the_limit_held_back(tmp_path: Path) -> None:
    truth = np.array([1.0, 6.0, 1.0])
    short: dict[str, Any] = {
        "step": "weighted_least_squares",
        "step_limit": 0.05,
        "max_iterations": 3,
    }
    record = storeys(tmp_path, truth, 3, bounds=(0.1, 11.0), **short)
    assert record.status == "max_iterations"
    assert "`step_limit` (0.05) limited" in record.reason
    assert "k2 in 3" in record.reason


def test_used_up_iterations_say_where_no_limit_was_the_reason(tmp_path: Path) -> None:
    truth = np.random.default_rng(1).uniform(0.9, 1.1, 6)
    record = storeys(tmp_path, truth, 4, max_iterations=1)
    assert record.status == "max_iterations"
    assert "`step_limit` (0.2) limited none of 1 steps" in record.reason


@pytest.mark.parametrize("fault", ["short", "nan"])
def test_a_failed_trial_is_made_shorter(bench: Any, watcher: Any, fault: str) -> None:
    truth = {"k1": 1.2, "k2": 0.8, "k3": 1.1, "k4": 0.9}
    update = UpdateSection(e1=E1Section(frequency=1e-8, mac=0.0), e2=0.0)
    whole = update_campaign(bench.campaign(truth, update=update), bench.folder / "a", watcher)
    (bench.folder / "store").rename(bench.folder / "before")
    bench.script({bench.runs() + 2: fault})
    failed = update_campaign(bench.campaign(truth, update=update), bench.folder / "b", watcher)
    assert whole.record.status == failed.record.status == "converged"
    np.testing.assert_allclose(failed.record.updated, list(truth.values()), rtol=1e-6)
    shorter = failed.record.iterations[1]
    assert np.abs(shorter.step).max() < 0.6 * np.abs(whole.record.iterations[1].step).max()


def test_e2_spares_sensitivities_of_the_default_step(bench: Any, watcher: Any) -> None:
    truth = {"k1": 1.2, "k2": 0.8, "k3": 1.1, "k4": 0.9}
    differences = SensitivitySection(method="finite_difference", step=0.001)
    skipped = []
    for e2 in (0.0, 0.2):
        update = UpdateSection(e1=E1Section(frequency=1e-5, mac=0.0), e2=e2)
        campaign = bench.campaign(truth, sensitivity=differences, update=update)
        record = update_campaign(campaign, bench.folder / f"e2-{e2}", watcher).record
        assert record.status == "converged"
        np.testing.assert_allclose(record.updated, list(truth.values()), rtol=1e-3)
        skipped.append(sum(item.sensitivity_skipped for item in record.iterations))
    assert skipped[0] == 0 < skipped[1]


@pytest.mark.parametrize("seed", [51, 52])
def test_a_corrected_step_that_a_narrow_valley_makes_worse_is_gone_on_from(
    tmp_path: Path, seed: int
) -> None:
    # Two modes of six storeys: springs that they hardly tell take long steps.
    truth = np.random.default_rng(seed).uniform(0.5, 2.0, 6)
    always, skipping = (
        storeys(
            tmp_path / str(e2),
            truth,
            2,
            differences=True,
            e1={"frequency": 1e-5, "mac": 0.9},
            e2=e2,
        )
        for e2 in (0.0, 0.2)
    )
    assert always.status == skipping.status == "converged"
    # e1 is 1e-5; a hundred times less are they sure of what two modes hardly tell.
    np.testing.assert_allclose(skipping.updated, always.updated, rtol=1e-3)
    assert skipping.runs.sensitivity < always.runs.sensitivity
    said = [item.decision for item in skipping.iterations]
    place = said.index("worse: corrected, and continued from")
    worse, after = skipping.iterations[place : place + 2]
    before = [item for item in skipping.iterations[:place] if item.accepted][-1]
    assert (worse.accepted, after.accepted) == (False, True)
    assert after.residual.misfit < before.residual.misfit < worse.residual.misfit
    # The step of the record is the whole way from the set that was kept.
    np.testing.assert_allclose(after.step, after.parameters - before.parameters, atol=1e-12)
