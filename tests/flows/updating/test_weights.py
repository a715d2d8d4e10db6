"""Updates with weights of single modes, on the scripted chain."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

from modetune.core.updating.responses.mac import Mac
from modetune.flows.campaign.schema import E1Section, UpdateSection
from modetune.flows.report.mode_tables import mode_table
from modetune.flows.updating.update import update_campaign

TRUTH = {"k1": 1.2, "k4": 0.85}
MODES = (1, 2, 3, 4)


def spoiled(bench: Any, weights: list[float], **update: Any) -> Any:
    """The chain with a third frequency that is 10 % wrong."""
    campaign = bench.campaign(
        TRUTH,
        MODES,
        update=UpdateSection(e1=E1Section(frequency=1e-5, mac=0.0), step_limit=0.5, **update),
    )
    case = campaign.case
    hz = case.test.modes.frequencies_hz * np.array([1.0, 1.0, 1.1, 1.0])
    test = replace(case.test, modes=replace(case.test.modes, frequencies_hz=hz))
    weighting = replace(case.weighting, frequency_weights=np.array(weights))
    return replace(campaign, cases=(replace(case, test=test, weighting=weighting),))


@pytest.mark.parametrize(
    "step", ["pseudo_inverse", "weighted_least_squares", "minimum_norm", "regularised"]
)
@pytest.mark.parametrize("between", [0.0, 0.2])
def test_a_frequency_without_weight_is_out_of_the_step_and_of_e1(
    bench: Any, watcher: Any, step: str, between: float
) -> None:
    campaign = spoiled(bench, [1.0, 1.0, 0.0, 1.0], step=step, e2=between)
    record = update_campaign(campaign, bench.folder / "runs", watcher).record
    assert record.status == "converged"
    np.testing.assert_allclose(record.updated, list(TRUTH.values()), rtol=1e-3)
    assert record.best.worst_error < 1e-5 < 0.05 < abs(record.best.frequency_errors[2])
    table = mode_table(record)
    assert "frequency_weight" in [column.name for column in table.columns]
    assert not table.outside


def test_the_answer_is_the_least_weighted_misfit(bench: Any, watcher: Any) -> None:
    weights = np.array([1.0, 2.0, 3.0, 1.0])
    campaign = spoiled(bench, weights.tolist(), step="weighted_least_squares", e2=0.0)
    measured = campaign.test.modes.eigenvalues

    def roots(theta: np.ndarray[Any, Any]) -> Any:
        values = dict(zip(TRUTH, theta.tolist(), strict=True))
        computed = bench.measured(values, MODES, shapes=False).eigenvalues
        return np.sqrt(weights) * (measured - computed) / measured

    least = least_squares(roots, [1.0, 1.0], bounds=(0.3, 3.0), xtol=1e-12, ftol=1e-12)
    record = update_campaign(campaign, bench.folder / "runs", watcher).record
    assert record.best.residual.misfit == pytest.approx(
        2.0 * least.cost / 0.004**2, rel=1e-3
    )  # stationary
    np.testing.assert_allclose(record.updated, least.x, rtol=0.02)


@pytest.mark.parametrize("quantity", ["root", "one_minus_mac"])
def test_mac_alone_finds_the_springs_that_turn_the_shapes(
    bench: Any, watcher: Any, quantity: Any
) -> None:
    campaign = bench.campaign(
        TRUTH,
        MODES,
        shapes=True,
        update=UpdateSection(
            step="weighted_least_squares", e1=E1Section(frequency=1e-3, mac=0.99999), e2=0.0
        ),
    )
    case = campaign.case
    none = np.zeros(len(MODES))
    weighting = replace(case.weighting, frequency_weights=none, shape_weights=none)
    mac = Mac(dict.fromkeys(MODES, 1.0), {}, quantity, 0.99999)
    # Frequencies have no weight, but e1 asks the MAC alone of them then.
    campaign = replace(campaign, cases=(replace(case, weighting=weighting, compared=(mac,)),))
    record = update_campaign(campaign, bench.folder / "runs", watcher).record
    assert record.status == "converged"
    best = record.best.residual
    assert [block.kind for block in best.blocks] == ["frequencies", "mac"]
    assert best.n_independent == len(MODES)
    # Both springs to the root of what e1 lets a MAC lack, by slopes of about one.
    np.testing.assert_allclose(record.updated, list(TRUTH.values()), rtol=2e-2)
