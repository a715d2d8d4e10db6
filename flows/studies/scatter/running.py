"""Running a scatter study: the Python API behind `modetune scatter`.

The mean of the tests has a posterior, learned as `modetune sample` learns it. Each of its peaks is
an answer; around it mean and covariance of the parameters are matched to those of the tests
(`core/updating/parameter_scatter`), by perturbation and by sampling what was
learned: a reduced model where there is one, else the surrogate. No set more is solved but a few
that check it.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from modetune import __version__
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import RepeatedTests
from modetune.core.measurement.scatter import scatter_of
from modetune.core.modes import Floats
from modetune.core.near_names import suggestion
from modetune.core.storage.record import CampaignRecord
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
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.watching import JobWatcher
from modetune.flows.studies.sample.running import Known, SamplingRequest, learned_posterior
from modetune.flows.studies.sample.surrogate import fit_surrogate
from modetune.flows.studies.scatter.record import ScatterAnswer, ScatterRecord
from modetune.flows.updating.small_matrices import one_thread

#: Sets by which the model is sampled; draws of means and covariances; full solutions that check.
DRAWS, SWEEPS, CHECKS = 128, 2000, 2
#: Differences for slopes, in widths of what the posterior of the mean leaves of a parameter.
REACH = 0.5
#: Draws that are kept to look at; least relative deviation of one test that is learned by.
KEPT, LEAST = 500, 1e-4


@dataclass(frozen=True, slots=True)
class ScatterRequest:
    """What is asked for.

    of: names of the parameters that differ from test to test, all where empty; deviation: of a
    frequency by the measurement alone, relative, None where the tests shall tell it; points, seed:
    as of a sampling.
    """

    of: tuple[str, ...] = ()
    deviation: float | None = None
    points: int | None = None
    seed: int = 1

    def problems(self, names: tuple[str, ...]) -> list[str]:
        """What is unavailable, a sentence each."""
        found = [
            f"--of {name}: the campaign has no such parameter{suggestion(name, names)}"
            for name in self.of
            if name not in names
        ]
        if self.deviation is not None and not 0.0 <= self.deviation < 1.0:
            found.append(
                f"--measurement-deviation {self.deviation:g}: expected 0 or more and less than 1, "
                "relative to the frequency"
            )
        return found


def scatter_campaign(
    campaign: Campaign,
    request: ScatterRequest,
    working: Callable[[str], None],
    earlier: CampaignRecord | None = None,
    watcher: JobWatcher | None = None,
) -> ScatterRecord:
    """The scatter of a campaign's parameters behind that of its repeated tests.

    earlier: an updated campaign to start from; working: is told what is being computed; watcher: of
    each job. Raises CampaignError (the test was not repeated; the tests cannot tell so many
    parameters), SolverError, ModesError, StoreError.
    """
    started, names = time.monotonic(), campaign.parameters.names
    problems = request.problems(names)
    if campaign.case.measurement.repeats is None:
        problems.append(
            f"{campaign.file}: the test was not repeated: name a table with a row a test as "
            "`test.modes`, or more files of the same test as `test.repeats`"
        )
    if problems:
        raise CampaignError(problems)
    free = tuple(name for name in names if name in request.of) or names
    sampling = SamplingRequest(points=request.points, seed=request.seed)
    n_modes = int(campaign.case.weighting.frequencies_used.sum())
    if len(free) > n_modes:
        raise CampaignError(
            f"{n_modes} frequencies do not tell how {len(free)} parameters differ from test to "
            f"test: name at most {n_modes} of them with --of (others are the same in all)"
        )
    wide = _of_one_test(campaign)
    with learned_posterior(wide, sampling, working, earlier, watcher) as known:
        modes = _modes(known)
        if known.reduced is None:
            known = _nearer(known, np.random.default_rng(request.seed))
        means, tests = _tests(known, modes, request.deviation)
        columns = np.array([names.index(name) for name in free], dtype=np.int64)
        parameters = known.campaign.parameters
        before = Beforehand(parameters.initial, parameters.standard_deviations, columns)
        answers = []
        for place in range(known.learned.peaks.n_peaks):
            working(f"scatter around answer {place + 1} of {known.learned.peaks.n_peaks}")
            with one_thread():
                answers.append(_answer(known, place, tests, before, request, len(modes)))
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
            modes=modes,
            means_hz=means,
            tests=tests.values,
            covariance=tests.covariance,
            worth=tests.n,
            noise_told=_noise_told(request, len(modes), len(free)),
            notes=campaign.case.measurement.notes,
            answers=tuple(
                replace(answers[place][0], share=float(shares[place]))
                for place in np.argsort(-shares).tolist()
            ),
            runs=evaluator.runs,
            reduced_model=evaluator.range_use,
        )


def _of_one_test(campaign: Campaign) -> Campaign:
    """The campaign with each frequency known as by one test, and independent of the others.

    So the posterior is as wide as what is to be learned; the mean of many tests has hills so narrow
    that a search misses some.
    """
    case = campaign.case
    repeats = case.measurement.repeats
    assert repeats is not None
    rows = [repeats.numbers.index(number) for number in case.test.numbers]
    found = scatter_of(_used_hz(repeats)[:, rows])
    weighting = replace(
        case.weighting,
        frequency_deviations=np.maximum(found.deviations / found.mean, LEAST),
        frequency_correlation=np.zeros((0, 0)),
    )
    return replace(campaign, cases=(replace(case, weighting=weighting),))


def _used_hz(repeats: RepeatedTests) -> Floats:
    """Frequencies (n_tests, n_modes), NaN where missing or left out."""
    hz = repeats.frequencies_hz
    return hz if repeats.used is None else np.where(repeats.used, hz, np.nan)


def _nearer(known: Known, rng: np.random.Generator) -> Known:
    """What is known with more sets around each peak, for the surrogate to be exact there."""
    learned, parameters = known.learned, known.campaign.parameters
    training, count = learned.training, 2 * len(parameters) + 2
    for point, covariance in zip(learned.peaks.points, learned.peaks.covariances, strict=True):
        sets = rng.multivariate_normal(point, covariance, count)
        sets = np.clip(sets, parameters.lower, parameters.upper)
        training = training.plus(known.solver.solve("sets around an answer", sets, count).training)
    posterior = learned.posterior
    surrogate = fit_surrogate(training, posterior.lower, posterior.upper)
    return replace(known, learned=replace(learned, training=training, surrogate=surrogate))


def _noise_told(request: ScatterRequest, n_modes: int, n_free: int) -> bool:
    return request.deviation is not None or n_modes == n_free


def _modes(known: Known) -> tuple[int, ...]:
    """Numbers of the modes whose frequencies are compared. Raises CampaignError."""
    there = known.learned.training.names
    numbers = known.campaign.case.test.numbers
    found = tuple(number for number in numbers if f"frequency of mode {number}" in there)
    if not found:
        raise CampaignError("no frequency is compared, so nothing tells how tests scatter")
    return found


def _tests(
    known: Known, modes: tuple[int, ...], deviation: float | None
) -> tuple[Floats, TestScatter]:
    """Means (n_modes,) in Hz that tests are relative to, and what the tests measured."""
    case = known.campaign.case
    repeats = case.measurement.repeats
    assert repeats is not None
    columns = [repeats.numbers.index(number) for number in modes]
    means = case.test.modes.frequencies_hz[[case.test.numbers.index(n) for n in modes]]
    values = _used_hz(repeats)[:, columns] / means - 1.0
    values = values[np.isfinite(values).any(axis=1)]
    found = scatter_of(values)
    noise = (deviation or 0.0) ** 2 * np.eye(len(modes))
    kept = np.where(found.used, values, np.nan)
    worth = repeats.worth * len(values)
    return means, TestScatter(kept, found.mean, found.covariance, noise, worth)


def _model(known: Known, n_modes: int) -> Model:
    """Frequencies (n, n_modes) at sets, relative to the measured means, by what was learned."""
    surrogate, root = known.reduced or known.learned.surrogate, _root_of(known)

    def frequencies(sets: Floats) -> Floats:
        return _relative(surrogate.residuals(sets)[:, :n_modes], root)

    return frequencies


def _relative(standardised: Floats, root: Floats) -> Floats:
    """Frequencies over the measured ones, less 1: the residual is of eigenvalues."""
    return np.asarray(np.sqrt(np.maximum(1.0 - standardised @ root.T, 0.0)) - 1.0)


def _answer(
    known: Known,
    place: int,
    tests: TestScatter,
    before: Beforehand,
    request: ScatterRequest,
    n_modes: int,
) -> tuple[ScatterAnswer, ParameterScatter]:
    peaks, model = known.learned.peaks, _model(known, n_modes)
    start, width = peaks.points[place], np.sqrt(np.diag(peaks.covariances[place]))
    reach = REACH * width
    told = _noise_told(request, n_modes, before.free.size)
    linear = match_scatter(tests, model, reach, before, start)
    if not told:
        tests = replace(tests, noise=noise_outside(tests, linear, before.free) * np.eye(n_modes))
        linear = match_scatter(tests, model, reach, before, start)
    draws = normal_draws(DRAWS, before.free.size, request.seed)
    found = match_scatter(tests, model, reach, before, linear.mean, draws)
    rng = np.random.default_rng([request.seed, place])
    sets = np.tile(found.mean, (CHECKS, 1))
    spread = rng.multivariate_normal(np.zeros(before.free.size), found.covariance, CHECKS - 1)
    sets[1:, before.free] += spread
    missed = _missed(known, sets, n_modes)
    found = _corrected(found, tests, before, missed[0])
    drawn = draw_scatter(tests, found, before, rng, SWEEPS, told)
    deviations = np.sqrt(np.diagonal(drawn.covariances, axis1=1, axis2=2))
    ends = [0.025, 0.975]
    n_told = before.free.size * (before.free.size + 1) // 2 + (not told)
    every = max(1, len(drawn.means) // KEPT)
    answer = ScatterAnswer(
        share=np.nan,
        mean=found.mean,
        covariance=found.covariance,
        linear_covariance=linear.covariance,
        mean_interval=np.quantile(drawn.means, ends, axis=0),
        deviation_interval=np.quantile(deviations, ends, axis=0),
        noise_interval=np.sqrt(np.quantile(drawn.noise, ends)),
        draws=drawn.means[::every],
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


def _missed(known: Known, sets: Floats, n_modes: int) -> Floats:
    """What full solutions have more than what was learned, (n, n_modes), relative frequencies."""
    parameters = known.campaign.parameters
    inside = np.clip(sets, parameters.lower, parameters.upper)
    solved = known.solver.solve("checks", inside)
    if len(solved.keys) < len(sets):
        raise CampaignError("a set of an answer cannot be solved; narrow the parameters' bounds")
    missed = known.learned.missed(solved.training)[:, :n_modes]
    return np.asarray(-0.5 * missed @ _root_of(known).T)


def _root_of(known: Known) -> Floats:
    """What standardised residuals of frequencies are multiplied by."""
    case = known.campaign.case
    own = case.weighting.modes([case.test.numbers.index(number) for number in _modes(known)])
    covariance = 4.0 * own.frequency_covariance
    return np.linalg.cholesky(covariance if covariance.ndim == 2 else np.diag(covariance))


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
