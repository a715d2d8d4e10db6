"""Preloaded structures: no parameter is linear, and derivatives are differences of modal runs."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.core.errors import CampaignError
from modetune.core.parameters import Quantity
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.updating.evaluator import evaluator_of
from modetune.flows.updating.mode_source import campaign_analysis, model_modes
from tests.adapters.ccx_decks import bar
from tests.adapters.solved import needs_ccx
from tests.flows.updating.test_stored_matrices import Case, update, written

pytestmark = needs_ccx

END = range(37, 41)  # the four nodes of a bar of nine bricks that are not held
LINES = "".join(f"{node}, 2, 3\n" for node in END)
STRETCHED = "*BOUNDARY\n" + "".join(f"{node}, 1, 1, 0.9\n" for node in END)
PULLED = "*CLOAD\n" + "".join(f"{node}, 1, 14000.\n" for node in END)


def preloaded(load: str, step: str = "*STEP, PERTURBATION") -> str:
    """A bar of 90 mm, guided at its end, under a static load before its modes are asked for."""
    return (
        f"{bar('C3D8I', bricks=9)}*BOUNDARY\n{LINES}*STEP, NLGEOM\n*STATIC\n{load}*END STEP\n"
        f"{step}\n*FREQUENCY\n4\n*END STEP\n"
    )


def case(load: str, step: str = "*STEP, PERTURBATION") -> Case:
    modulus: tuple[tuple[str, Quantity, str], ...] = (("E", "youngs_modulus", "material: A"),)
    return Case(preloaded(load, step), modulus, (1.2,), tuple(range(5, 37)), n_modes=4)


@pytest.mark.parametrize(
    ("load", "least", "most"),
    # Stretched by 1 % the stress and with it all of the stiffness is proportional to E. Pulled by a
    # force the stress is not: E moves the bending stiffness alone.
    [(STRETCHED, 0.499, 0.501), (PULLED, 0.1, 0.4)],
    ids=["stretched", "pulled"],
)
def test_derivatives_of_a_preloaded_bar_are_those_of_its_own_runs(
    tmp_path: Path, load: str, least: float, most: float
) -> None:
    file = written(case(load), tmp_path / "bar")
    campaign = load_campaign(file, [f"store={tmp_path / 'store'}"])
    engine = job_engine(campaign)
    evaluator = evaluator_of(campaign, engine)
    evaluation, matrix = evaluator.evaluate(0, campaign.start, None, False)
    assert matrix is not None
    assert matrix.methods == ("finite_difference",)
    part = evaluation.parts[0]
    found = evaluator.derivatives(part.point, campaign_analysis(campaign)).eigenvalues[:, 0]
    moved = [model_modes(campaign, {"E": value}).elastic.eigenvalues for value in (0.999, 1.001)]
    expected = (moved[1] - moved[0]) / 0.002
    assert found == pytest.approx(expected[part.pairing.computed], rel=5e-3)
    share = 0.5 * found[0] / part.modal.elastic.eigenvalues[part.pairing.computed[0]]
    assert least < share < most


def test_a_stretched_bar_is_updated_to_the_truth_and_the_reason_is_told(
    tmp_path: Path, watcher: Any, caplog: pytest.LogCaptureFixture
) -> None:
    file = written(case(STRETCHED), tmp_path / "bar")
    with caplog.at_level(logging.WARNING):
        record = update(file, tmp_path, watcher)
    assert record.updated == pytest.approx([1.2], rel=1e-5)
    (said,) = [item for item in caplog.messages if "linear" in item]
    assert "part.inp, line 68" in said
    assert "a step before that of the frequencies: the stiffness depends on the state" in said
    assert "reduced elements" not in caplog.text


def test_energies_and_stored_matrices_of_a_preloaded_model_are_refused_with_the_reason(
    tmp_path: Path,
) -> None:
    file = written(case(STRETCHED), tmp_path / "bar")
    for setting in ("sensitivity.method=strain_energy", "model.eigensolver=pardiso"):
        with pytest.raises(CampaignError, match=r"part\.inp, line 68: a step before that"):
            load_campaign(file, [setting])


def test_a_step_that_takes_no_preload_leaves_energies_whole(tmp_path: Path) -> None:
    file = written(case(STRETCHED, "*STEP"), tmp_path / "bar")
    campaign = load_campaign(file, [f"store={tmp_path / 'store'}"])
    assert campaign.case.solver.deck.preload() == ""
    result = model_modes(campaign, {"E": 1.0})
    assert result.energy_balance == pytest.approx(np.ones(result.modes.n_modes), abs=1e-5)
