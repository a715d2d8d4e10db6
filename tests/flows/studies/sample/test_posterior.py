"""Whole samplings of the scripted chain, whose runs are counted and whose posterior is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.core.errors import CampaignError, SolverRejected
from modetune.core.modes import Floats
from modetune.core.updating.weighting import Weighting, even_weighting
from modetune.flows.report.matplotlib_charts import save_all
from modetune.flows.studies.sample import posterior
from modetune.flows.studies.sample.figures import posterior_figures
from modetune.flows.studies.sample.posterior import sample_campaign, sampling_start
from modetune.flows.studies.sample.record import POSTERIOR, PosteriorRecord
from modetune.flows.studies.sample.request import SamplingRequest
from modetune.flows.studies.sample.summary import findings, summary
from modetune.flows.updating.update import update_campaign
from tests.core.storage.test_sealed_file import refused_when_damaged

TRUTH = {"k1": 1.2, "k3": 0.8}
MODES = (1, 2, 3)
#: Frequencies known within 3 % make a posterior wide enough to be no normal distribution.
COARSE = even_weighting(3, 0, 0.03, 0.05, 1.0, 0.0)


def sampled(campaign: Any, watcher: Any, **asked: Any) -> PosteriorRecord:
    request = SamplingRequest(**{"points": 16, "steps": 1000, "checks": 4, **asked})
    return sample_campaign(campaign, request, watcher.working)


_KEPT: list[PosteriorRecord] = []


@pytest.fixture
def record(bench: Any, watcher: Any) -> PosteriorRecord:
    """A sampling of the chain with its exact test, made once for all tests that only look at it."""
    if not _KEPT:
        _KEPT.append(sampled(bench.campaign(TRUTH, MODES), watcher))
    return _KEPT[0]


def red(record: PosteriorRecord) -> list[str]:
    return [finding.text for finding in findings(record) if finding.red]


def weighed(campaign: Any, weighting: Weighting) -> Any:
    return replace(campaign, cases=(replace(campaign.case, weighting=weighting),))


def on_grid(bench: Any, campaign: Any) -> tuple[Floats, Floats, Floats]:
    """Mean (2,), deviation (2,) and correlation of the posterior by summing it over a grid."""
    names, measured = campaign.parameters.names, campaign.test.modes.eigenvalues
    lower, upper = campaign.parameters.lower, campaign.parameters.upper
    axes = [np.linspace(*ends, 121) for ends in zip(lower, upper, strict=True)]
    points = np.stack([axis.ravel() for axis in np.meshgrid(*axes)], axis=1)
    computed = np.array(
        [
            bench.measured(dict(zip(names, point, strict=True)), MODES, shapes=False).eigenvalues
            for point in points
        ]
    )
    z = (measured - computed) / measured / (2.0 * campaign.weighting.frequency_deviations)
    pull = (points - campaign.parameters.initial) / campaign.parameters.standard_deviations
    density = np.exp(-0.5 * ((z**2).sum(axis=1) + (pull**2).sum(axis=1)))
    density /= density.sum()
    mean = density @ points
    covariance = ((points - mean).T * density) @ (points - mean)
    deviation = np.sqrt(np.diag(covariance))
    return mean, deviation, covariance[0, 1] / deviation.prod()


def test_the_posterior_of_the_chain_is_that_of_a_grid(bench: Any, watcher: Any) -> None:
    campaign = weighed(bench.campaign(TRUTH, MODES), COARSE)
    record = sampled(campaign, watcher)
    mean, deviation, correlation = on_grid(bench, campaign)
    size = record.effective_sizes
    # Four Monte Carlo errors, of a mean sigma / sqrt(n), of a deviation sigma / sqrt(2 n).
    assert np.all(np.abs(record.mean - mean) < 4.0 * deviation / np.sqrt(size))
    assert np.all(np.abs(record.deviation / deviation - 1.0) < 4.0 / np.sqrt(2.0 * size))
    assert record.correlation[0, 1] == pytest.approx(correlation, abs=4.0 / np.sqrt(size.min()))
    assert red(record) == []
    assert record.check_errors.max() < 0.3


def test_every_solver_run_is_counted_and_none_is_made_twice(bench: Any, watcher: Any) -> None:
    campaign = bench.campaign(TRUTH, MODES)
    first = sampled(campaign, watcher)
    # The start, 16 points, those near the posterior, and the checks; the centre is the start.
    assert bench.runs() == first.runs.modal == first.near.size + len(first.check_keys)
    assert first.begun == 17
    assert first.near.size > first.begun
    again = sampled(campaign, watcher)
    assert bench.runs() == first.runs.modal
    assert again.runs.modal == 0
    np.testing.assert_array_equal(again.samples, first.samples)
    assert again.training_keys == first.training_keys


def test_with_an_exact_test_the_deviation_is_the_linear_standard_error(
    record: PosteriorRecord,
) -> None:
    size = record.effective_sizes
    # Frequencies known within 0.2 %: over so small a range the chain is linear within 2 %.
    off = np.abs(record.deviation / record.linear_deviation - 1.0)
    assert np.all(off < 0.02 + 4.0 / np.sqrt(2.0 * size))
    np.testing.assert_allclose(record.most_likely, list(TRUTH.values()), atol=0.01)
    assert [finding.text for finding in findings(record)] == []


def test_shapes_narrow_the_posterior(bench: Any, watcher: Any, record: PosteriorRecord) -> None:
    shaped = sampled(bench.campaign(TRUTH, MODES, shapes=True), watcher)
    assert set(shaped.training.names) == {
        f"{kind} of mode {mode}" for kind in ("frequency", "shape") for mode in MODES
    }
    assert np.all(shaped.deviation < record.deviation)
    # The test is the chain itself without noise, so the truth is inside by far.
    assert np.all(np.abs(shaped.most_likely - list(TRUTH.values())) < shaped.deviation)


def test_two_answers_to_one_test_are_told(
    bench: Any, watcher: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(posterior, "LONGER", 2)  # chains through both are long
    # Two frequencies and two springs: exchanging stiffness between the chain's ends fits again.
    campaign = bench.campaign({"k1": 1.6, "k7": 0.7}, (1, 2))
    loose = tuple(replace(item, standard_deviation=3.0) for item in campaign.parameters.parameters)
    campaign = replace(campaign, parameters=replace(campaign.parameters, parameters=loose))
    record = sampled(campaign, watcher, points=25)
    assert record.peaks.shape[0] >= 2
    for peak in record.peaks:
        values = dict(zip(("k1", "k7"), peak.tolist(), strict=True))
        found = bench.measured(values, (1, 2), shapes=False).frequencies_hz
        np.testing.assert_allclose(found, campaign.test.modes.frequencies_hz, rtol=0.004)
    said = "separate regions of parameter values explain the test"
    assert any(said in text for text in red(record))


def test_a_surrogate_that_stays_too_poor_is_refused_with_the_response_named(
    bench: Any, watcher: Any
) -> None:
    exact = even_weighting(3, 0, 1e-9, 0.05, 1.0, 0.0)  # no surrogate of so few runs is as exact
    campaign = weighed(bench.campaign(TRUTH, MODES), exact)
    with pytest.raises(CampaignError, match=r"solver runs the surrogate .*raise --points"):
        sampled(campaign, watcher, points=8)


def test_checks_that_the_surrogate_fails_are_red(record: PosteriorRecord) -> None:
    spoiled = replace(record, check_errors=np.array([0.1, 2.5, 0.2]))
    (text,) = red(spoiled)
    assert "frequency of mode 2 by 2.5 standard deviations of the test" in text
    assert summary(spoiled)["status"] == "doubtful"


def test_chains_that_are_too_short_are_red(record: PosteriorRecord) -> None:
    short = replace(record, enough=False, steps=100, burned=50)
    assert any("the chains are too short: 50 steps" in text for text in red(short))


def test_without_checks_that_is_said(bench: Any, watcher: Any) -> None:
    record = sampled(bench.campaign(TRUTH, MODES), watcher, checks=0)
    assert [finding.text for finding in findings(record)] == [
        "no point of the posterior was checked by the solver"
    ]


def test_a_parameter_at_its_bound_and_one_the_test_does_not_see_are_told(
    bench: Any, watcher: Any
) -> None:
    campaign = weighed(bench.campaign({"k1": 1.6, "k4": 1.0}, MODES, bounds=(0.6, 1.4)), COARSE)
    said = " ".join(finding.text for finding in findings(sampled(campaign, watcher)))
    assert "the posterior of k1 is cut at its bound 1.4" in said
    assert "the test gives almost no information on k4" in said  # the stiff spring in the middle


def test_failed_runs_are_left_out_and_told(bench: Any, watcher: Any) -> None:
    bench.script({3: "rejected", 7: "rejected"})
    record = sampled(bench.campaign(TRUTH, MODES), watcher)
    assert len(record.failures) == 2
    assert record.begun == 17 - 2
    assert red(record) == []


def test_where_every_run_fails_the_solver_says_why(bench: Any, watcher: Any) -> None:
    bench.script(dict.fromkeys(range(1, 40), "rejected"))
    with pytest.raises(SolverRejected, match="the scripted solver refused its input"):
        sampled(bench.campaign(TRUTH, MODES), watcher)


def test_sampling_from_the_end_of_an_update_learns_around_it(bench: Any, watcher: Any) -> None:
    campaign = bench.campaign(TRUTH, MODES)
    folder = bench.folder / "run"
    assert sampling_start(campaign, None, None, folder)[0] is None  # no update yet
    update_campaign(campaign, folder, watcher)
    update, sentence = sampling_start(campaign, None, None, folder)
    assert "around the end of the update" in sentence
    assert sampling_start(campaign, None, "initial", folder)[0] is None
    request = SamplingRequest(points=16, steps=1000, checks=4)
    record = sample_campaign(campaign, request, watcher.working, update)
    # three prior deviations of 0.3 each around the truth, which the update finds, in the bounds
    np.testing.assert_allclose(record.lower, [0.3, 0.3], atol=1e-6)
    np.testing.assert_allclose(record.upper, [2.1, 1.7], atol=1e-6)
    assert red(record) == []
    other = bench.campaign({"k1": 1.2, "k2": 1.0}, MODES)
    with pytest.raises(CampaignError, match="is of k1, k3 and lacks k2"):
        sample_campaign(other, request, watcher.working, update)
    none, sentence = sampling_start(other, None, None, folder)
    assert none is None
    assert "is of k1, k3" in sentence


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"points": 3}, "--points 3: expected 5 to"),
        ({"steps": 10}, "--steps 10: expected 100 to"),
        ({"checks": -1}, "--checks -1: expected 0 to"),
        ({"walkers": 5}, "--walkers 5: expected an even number"),
    ],
)
def test_what_cannot_be_had_is_refused_before_any_run(
    bench: Any, watcher: Any, asked: dict[str, int], said: str
) -> None:
    with pytest.raises(CampaignError, match=said):
        sampled(bench.campaign(TRUTH, MODES), watcher, **asked)
    assert bench.runs() == 0


def test_the_record_reads_as_it_was_written_and_is_drawn(
    record: PosteriorRecord, tmp_path: Path
) -> None:
    POSTERIOR.write(tmp_path / "posterior.h5", record)
    read = POSTERIOR.read(tmp_path / "posterior.h5")
    assert summary(read) == summary(record)
    for name in ("samples", "log_densities", "near", "check_points", "peaks"):
        np.testing.assert_array_equal(getattr(read, name), getattr(record, name))
    assert read.training.names == record.training.names
    for path in save_all(posterior_figures(read), tmp_path / "figures"):
        assert path.read_bytes().startswith(b"\x89PNG")


def test_every_damage_to_the_record_is_refused_before_hdf5_sees_it(
    record: PosteriorRecord, tmp_path: Path
) -> None:
    POSTERIOR.write(tmp_path / "posterior.h5", record)
    refused_when_damaged(tmp_path / "posterior.h5", POSTERIOR.read)


def test_a_file_that_is_no_record_is_named(tmp_path: Path) -> None:
    (tmp_path / "posterior.h5").write_text("nothing")
    with pytest.raises(CampaignError, match=r"posterior\.h5 is not a record of a sampling"):
        POSTERIOR.read(tmp_path / "posterior.h5")
