"""The estimate of the parameters' scatter behind that of repeated tests.

The mean of the tests has a posterior, learned as `modetune sample` learns it. Each of its peaks is
an answer; around it mean and covariance of the parameters are matched to those of the tests
(`core/updating/parameter_scatter`), by perturbation and by sampling what was
learned: a reduced model where there is one, else the surrogate. No set more is solved but a few
that check it.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from modetune import __version__
from modetune.core.errors import CampaignError
from modetune.core.measurement.repeated_tests import scatter_of
from modetune.core.modes import Floats
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.updating.parameter_scatter import (
    EXACT,
    Beforehand,
    Model,
    ParameterScatter,
    TestScatter,
    draw_scatter,
    lack_of_fit,
    match_scatter,
    noise_outside,
    normal_draws,
)
from modetune.core.updating.responses.damping import DampingRatios
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.studies.sample.posterior import PosteriorModel, learned_posterior
from modetune.flows.studies.sample.request import SamplingRequest
from modetune.flows.studies.sample.surrogate import fit_surrogate
from modetune.flows.studies.scatter.measured_values import (
    MeasuredValues,
    names_of,
    used_hz,
    values_by_test,
    values_of,
)
from modetune.flows.studies.scatter.record import ScatterAnswer, ScatterRecord
from modetune.flows.studies.scatter.request import ScatterRequest

logger = logging.getLogger(__name__)

#: Sets by which the model is sampled; draws of means and covariances; full solutions that check.
DRAWS, SWEEPS, CHECKS = 128, 2000, 2
#: Differences for slopes, in widths of what the posterior of the mean leaves of a parameter.
REACH = 0.5
#: Draws that are kept to look at; least relative deviation of one test that is learned by.
KEPT, LEAST = 500, 1e-4


def scatter_campaign(
    campaign: Campaign,
    request: ScatterRequest,
    working: Callable[[str], None],
    earlier: CampaignRecord | None = None,
) -> ScatterRecord:
    """The scatter of a campaign's parameters behind that of its repeated tests.

    earlier: an updated campaign to start from; working: is called with what is being computed;
    each job. Raises CampaignError (the test was not repeated; too many parameters for its
    values), SolverError, ModesError, StoreError.
    """
    started, names = time.monotonic(), campaign.parameters.names
    free = _free(campaign, request)
    sampling = SamplingRequest(points=request.points, seed=request.seed)
    wide = _of_one_test(campaign)
    with learned_posterior(wide, sampling, working, earlier) as known:
        values = values_of(known.campaign, known.solver.residual)
        if known.reduced is None:
            known = _nearer(known, np.random.default_rng(request.seed))
        tests = _tests(known, values, request.measurement_deviation)
        columns = np.array([names.index(name) for name in free], dtype=np.int64)
        parameters = known.campaign.parameters
        before = Beforehand(parameters.initial, parameters.standard_deviations, columns)
        answers = []
        for place in range(known.learned.peaks.n_peaks):
            working(f"scatter around answer {place + 1} of {known.learned.peaks.n_peaks}")
            answers.append(_answer(known, place, tests, before, request, values))
        answers = _within_limits(known, answers)
        evaluator, shares = known.solver.evaluator, _shares(answers, tests, before)
        return ScatterRecord(
            name=campaign.name,
            seed=request.seed,
            solver=campaign.solver_name,
            solver_version=known.version,
            modetune_version=__version__,
            campaign_text=campaign.text,
            wall_s=time.monotonic() - started,
            names=names,
            free=free,
            measured=values.names,
            means=values.means,
            sizes=values.sizes,
            tests=tests.values,
            covariance=tests.covariance,
            worth=tests.n,
            noise_told=_noise_told(request, len(values.names), len(free)),
            notes=campaign.case.measurement.notes,
            answers=tuple(
                replace(answers[place][0], share=float(shares[place]))
                for place in np.argsort(-shares).tolist()
            ),
            runs=evaluator.runs,
            reduced_model=evaluator.range_use,
        )


def _free(campaign: Campaign, request: ScatterRequest) -> tuple[str, ...]:
    """The parameters that differ from test to test. Raises CampaignError, as `scatter_campaign`."""
    names = campaign.parameters.names
    problems = request.problems(names)
    if campaign.case.measurement.repeats is None:
        problems.append(
            f"{campaign.file}: the test was not repeated: name a table with a row a test as "
            "`test.modes`, or more files of the same test as `test.repeats`"
        )
    if problems:
        raise CampaignError(problems)
    free, n_values = tuple(name for name in names if name in request.of), len(names_of(campaign))
    free = free or names
    if len(free) > n_values:
        raise CampaignError(
            f"{n_values} measured values cannot determine the scatter of {len(free)} parameters: "
            f"name up to {n_values} of them with --of (the others are the same in all tests)"
        )
    return free


def _of_one_test(campaign: Campaign) -> Campaign:
    """The campaign with each frequency known as by one test, and independent of the others.

    So the posterior is as wide as what is to be learned; the mean of many tests has hills so narrow
    that a search misses some.
    """
    case = campaign.case
    repeats = case.measurement.repeats
    assert repeats is not None
    rows = [repeats.numbers.index(number) for number in case.test.numbers]
    found = scatter_of(used_hz(repeats)[:, rows])
    _check_number(found.covariance, len(repeats.places))
    weighting = replace(
        case.weighting,
        frequency_deviations=np.maximum(found.deviations / found.mean, LEAST),
        frequency_correlation=np.zeros((0, 0)),
    )
    compared = tuple(
        replace(item, covariance=np.zeros((0, 0))) if isinstance(item, DampingRatios) else item
        for item in case.compared
    )
    return replace(campaign, cases=(replace(case, weighting=weighting, compared=compared),))


def _check_number(covariance: Floats, n_tests: int) -> None:
    """Raise CampaignError where so few tests leave the covariance of their values singular."""
    n_values = len(covariance)
    if n_tests <= n_values:
        raise CampaignError(
            f"{n_tests} tests of {n_values} values do not determine how these vary together: "
            f"repeat the test until there are {n_values + 1} or more, or choose fewer modes with "
            "`test.use`"
        )


def _nearer(known: PosteriorModel, rng: np.random.Generator) -> PosteriorModel:
    """What is known with more sets around each peak, for the surrogate to be exact there."""
    learned, parameters = known.learned, known.campaign.parameters
    training, count = learned.training, 2 * len(parameters) + 2
    for point, covariance in zip(learned.peaks.points, learned.peaks.covariances, strict=True):
        sets = rng.multivariate_normal(point, covariance, count)
        sets = np.clip(sets, parameters.lower, parameters.upper)
        training = training.plus(known.solver.solve("sets around an answer", sets, count)[0])
    posterior = learned.posterior
    surrogate = fit_surrogate(training, posterior.lower, posterior.upper)
    return replace(known, learned=replace(learned, training=training, surrogate=surrogate))


def _noise_told(request: ScatterRequest, n_modes: int, n_free: int) -> bool:
    return request.measurement_deviation is not None or n_modes == n_free


def _tests(known: PosteriorModel, values: MeasuredValues, deviation: float | None) -> TestScatter:
    """What the tests measured, less the means and over the sizes."""
    repeats = known.campaign.case.measurement.repeats
    assert repeats is not None
    measured = (values_by_test(repeats, values.names) - values.means) / values.sizes
    measured = measured[np.isfinite(measured).any(axis=1)]
    found = scatter_of(measured)
    _check_number(found.covariance, len(measured))
    noise = (deviation or 0.0) ** 2 * np.eye(len(values.names))
    kept = np.where(found.used, measured, np.nan)
    return TestScatter(kept, found.mean, found.covariance, noise, repeats.worth * len(measured))


def _model(known: PosteriorModel, values: MeasuredValues) -> Model:
    """Return the learned model of the measured values (n, m)."""
    surrogate = known.reduced or known.learned.surrogate
    return lambda sets: values.of(surrogate.residuals(sets))


def _answer(
    known: PosteriorModel,
    place: int,
    tests: TestScatter,
    before: Beforehand,
    request: ScatterRequest,
    values: MeasuredValues,
) -> tuple[ScatterAnswer, ParameterScatter]:
    peaks, model, m = known.learned.peaks, _model(known, values), len(values.names)
    start, width = peaks.points[place], np.sqrt(np.diag(peaks.covariances[place]))
    reach = REACH * width
    told = _noise_told(request, m, before.free.size)
    linear = match_scatter(tests, model, reach, before, start)
    if not told:
        tests = replace(tests, noise=noise_outside(tests, linear, before.free) * np.eye(m))
        linear = match_scatter(tests, model, reach, before, start)
    draws = normal_draws(DRAWS, before.free.size, request.seed)
    found = match_scatter(tests, model, reach, before, linear.mean, draws)
    rng = np.random.default_rng([request.seed, place])
    sets = np.tile(found.mean, (CHECKS, 1))
    spread = rng.multivariate_normal(np.zeros(before.free.size), found.covariance, CHECKS - 1)
    sets[1:, before.free] += spread
    missed = _missed(known, sets, values)
    found = _corrected(found, tests, before, missed[0])
    means, covariances, noise = draw_scatter(tests, found, before, rng, SWEEPS, told)
    deviations = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    ends = [0.025, 0.975]
    n_told = before.free.size * (before.free.size + 1) // 2 + (not told)
    every = max(1, len(means) // KEPT)
    answer = ScatterAnswer(
        share=np.nan,
        mean=found.mean,
        covariance=found.covariance,
        linear_covariance=linear.covariance,
        mean_interval=np.quantile(means, ends, axis=0),
        deviation_interval=np.quantile(deviations, ends, axis=0),
        noise_interval=np.sqrt(np.quantile(noise, ends)),
        draws=means[::every],
        deviation_draws=deviations[::every],
        predicted=found.predicted,
        predicted_covariance=found.predicted_covariance + tests.noise,
        noise=float(np.sqrt(tests.noise[0, 0])),
        lack=lack_of_fit(tests, found, n_told),
        cut=found.cut,
        rounds=found.rounds,
        off=float(np.max(np.abs(missed) / np.sqrt(np.diag(tests.covariance)))),
    )
    return answer, found


def _within_limits(
    known: PosteriorModel, answers: list[tuple[ScatterAnswer, ParameterScatter]]
) -> list[tuple[ScatterAnswer, ParameterScatter]]:
    """Answers whose mean keeps the limits of responses. Raises CampaignError where none does."""
    posterior, found = known.learned.posterior, []
    for answer in answers:
        if posterior.limits is None or posterior.limits.hold(answer[0].mean[None])[0]:
            found.append(answer)
            continue
        values = zip(known.campaign.parameters.names, answer[0].mean.tolist(), strict=True)
        text = ", ".join(f"{name} {value:.4g}" for name, value in values)
        logger.warning(
            "the solution %s is left out, because it violates a limit (%s)",
            text,
            ", ".join(posterior.limits.names),
        )
    if not found:
        raise CampaignError(
            "every solution violates the limits of `residuals`; the warnings above list them"
        )
    return found


def _shares(
    answers: list[tuple[ScatterAnswer, ParameterScatter]], tests: TestScatter, before: Beforehand
) -> Floats:
    """Shares (n_answers,) of the posterior of the mean, by Laplace."""
    weights = []
    tiny = EXACT * np.diag(np.diag(tests.covariance))
    for answer, found in answers:
        inverse = np.linalg.inv(answer.predicted_covariance + tiny)
        off, pull = tests.mean - found.predicted, (found.mean - before.mean) / before.deviation
        precision = tests.n * found.slopes.T @ inverse @ found.slopes
        precision = precision + np.diag(before.deviation**-2)
        squares = tests.n * off @ inverse @ off + pull @ pull
        weights.append(-0.5 * (squares + np.linalg.slogdet(precision)[1]))
    shares = np.exp(np.array(weights) - max(weights))
    return np.asarray(shares / shares.sum())


def _missed(known: PosteriorModel, sets: Floats, values: MeasuredValues) -> Floats:
    """What full solutions have more than what was learned, (n, m)."""
    parameters = known.campaign.parameters
    inside = np.clip(sets, parameters.lower, parameters.upper)
    solved, keys = known.solver.solve("checks", inside)
    if len(keys) < len(sets):
        raise CampaignError("a set of an answer cannot be solved; narrow the parameters' bounds")
    truth = solved.values
    return values.of(truth) - values.of(truth - known.learned.missed(solved))


def _corrected(
    found: ParameterScatter, tests: TestScatter, before: Beforehand, missed: Floats
) -> ParameterScatter:
    """The mean after one more step, from a full solution there."""
    weights = tests.n * np.linalg.inv(tests.covariance)
    prior = np.diag(before.deviation**-2)
    predicted = found.predicted + missed
    pull = found.slopes.T @ weights @ (tests.mean - predicted)
    pull = pull + prior @ (before.mean - found.mean)
    step = np.linalg.solve(found.slopes.T @ weights @ found.slopes + prior, pull)
    return replace(found, mean=found.mean + step, predicted=predicted + found.slopes @ step)
