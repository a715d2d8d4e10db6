"""Sets that are solved for: modes mistaken for each other, and what is kept of many sets."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.jobs.campaign_engine import solving_engine
from modetune.flows.studies.sample.points import PointSolver
from modetune.flows.updating import evaluation
from modetune.flows.updating.evaluation import Evaluation
from modetune.flows.updating.evaluator import evaluator_of
from modetune.flows.updating.mode_source import Demand
from tests.flows.studies.sample.test_by_reduced import (
    DEVIATION,
    TRUTH,
    frequencies,
    row_of_masses,
)

N_MODES = 3


@contextmanager
def row_solver(folder: Path) -> Iterator[PointSolver]:
    """Of the row of masses, which has solved nothing yet."""
    campaign = load_campaign(row_of_masses(folder, N_MODES), [])
    campaign = campaign.alone(campaign.case)
    with solving_engine(campaign) as engine:
        yield PointSolver(campaign, evaluator_of(campaign, engine, Demand(1, 10)))


def mistaken(evaluation: Evaluation) -> Evaluation:
    """The same set with its two highest pairs exchanged."""
    (part,) = evaluation.parts
    computed = part.pairing.computed[[0, 2, 1]]
    return replace(
        evaluation, parts=(replace(part, pairing=replace(part.pairing, computed=computed)),)
    )


def test_sets_that_were_tracked_from_mistaken_ones_are_tracked_again(tmp_path: Path) -> None:
    truth = np.array(TRUTH)
    near = truth + 0.02 * np.array([[-2.0, 0.0], [-1.0, 0.5], [1.0, 0.5], [2.0, 0.0]])
    with row_solver(tmp_path) as solver:
        solver.solve("start", np.ones((1, 2)))
        # Two known sets fit badly, and the one that is nearer to some of the points is mistaken.
        solver.solve("known", truth + np.array([[0.3, 0.0], [-0.3, 0.0]]))
        solver.known[2] = mistaken(solver.known[2])
        wrong = solver.evaluator.tracked(solver.known[1], solver.known[2:])
        assert wrong.pairing.computed.tolist() == [0, 2, 1]
        found = solver.solve("near", near, around=3, grows=False)[0]
    measured, computed = (frequencies(sets)[:, :N_MODES] ** 2 for sets in (truth[None], near))
    expected = (measured - computed) / measured / (2.0 * DEVIATION)
    # The test's file has 12 digits of a frequency, in hundredths of which residuals are.
    np.testing.assert_allclose(found.values, expected, atol=1e-8)


def test_of_many_sets_those_that_fit_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evaluation, "MOST_KNOWN", 5)
    monkeypatch.setattr("modetune.flows.studies.sample.points.MOST_KNOWN", 5)
    some = np.array(TRUTH) + np.linspace(-0.6, 0.6, 13)[:, None] * np.array([1.0, 0.2])
    with row_solver(tmp_path) as solver:
        solver.solve("start", np.ones((1, 2)))
        found, keys = solver.solve("known", some)
        kept = [item.theta[0] for item in solver.known[1:]]
    assert len(keys) == len(some)
    best = np.argsort((found.values**2).sum(axis=1))[:4]
    assert sorted(kept) == sorted(some[best, 0])
