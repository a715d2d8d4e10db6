"""Several campaigns on one test: how well each model explains it, by its evidence.

Each campaign is updated first, unless its run folder has the update already. Around the end of its
update, moved on to the minimum of the chi-square of all measured data where evaluations are cheap,
the likelihood is a Gaussian in the logarithms of the parameters, and is integrated over the prior:
uniform within the bounds, or the campaign's own where its step is `pulled_to_initial` or it has
fields (`core/updating/evidence`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy

from modetune.core.brief import brief
from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, common_dofs, dof_name, mode_name
from modetune.core.storage.campaign_record import RunCounts
from modetune.core.updating.evidence import gaussian_log_evidence, log_evidence, probabilities
from modetune.core.updating.parameter_steps import StepProblem, parameter_step
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.campaign_engine import solving_engine
from modetune.flows.studies.compare.further_measurements import (
    FurtherMeasurement,
    further_measurements,
)
from modetune.flows.updating.evaluation import Evaluation
from modetune.flows.updating.evaluator import Evaluator, evaluator_of
from modetune.flows.updating.forecast import Progress
from modetune.flows.updating.mode_source import Demand
from modetune.flows.updating.record import read_run
from modetune.flows.updating.starts import data_misfit
from modetune.flows.updating.update import is_same, update_from_starts

#: Probability of the best model and its ln Bayes factor over the next; below these: undecided.
DECIDED, LEAST_FACTOR = 0.95, 1.0
#: Steps to the minimum chi-square, and the gain in chi-square that ends them.
STEPS, GAIN = 8, 0.01
#: Share of right models that are found not to explain the test.
LEVEL = 0.01


@dataclass(frozen=True, slots=True)
class CompetingModel:
    """A campaign's model and how well it explains the test.

    parameters: names; updated: (n_parameters,), at the minimum chi-square. chi_square: of all
    measured data; freedom: degrees of freedom. log_evidence: up to a constant of the test.
    log_bayes_factor: of the best model over this one. verdict: of its update; new: whether that
    ran now.
    """

    name: str
    file: Path
    parameters: tuple[str, ...]
    updated: Floats
    chi_square: float
    freedom: int
    log_evidence: float
    probability: float
    log_bayes_factor: float
    verdict: str
    new: bool
    runs: RunCounts


@dataclass(frozen=True, slots=True)
class Distinction:
    """A measured value that the two best models explain differently: chi-squares of both."""

    of: str
    best: float
    second: float

    @property
    def difference(self) -> float:
        """By how much the better model explains it better; negative if it explains it worse."""
        return self.second - self.best


@dataclass(frozen=True, slots=True, repr=False)
class ModelChoice:
    """Models in the order of their probability, and what tells the two best apart.

    scale: by what chi-squares are divided, as even the best model leaves so much more than noise.
    modes, sensors: what differs, the most first. further: measurements that would decide, the best
    first.
    """

    models: tuple[CompetingModel, ...]
    scale: float
    p_value: float
    modes: tuple[Distinction, ...]
    sensors: tuple[Distinction, ...]
    further: tuple[FurtherMeasurement, ...]

    __repr__ = brief

    @property
    def decided(self) -> bool:
        """Whether one model is as probable as `DECIDED`."""
        best, second = self.models[:2]
        return best.probability >= DECIDED and second.log_bayes_factor >= LEAST_FACTOR

    @property
    def status(self) -> str:
        return "decided" if self.decided else "undecided"

    @property
    def sentence(self) -> str:
        """The result in one sentence."""
        best, second = self.models[:2]
        factor = f"ln Bayes factor {second.log_bayes_factor:.2g} over {second.name}"
        if self.decided:
            return (
                f"{best.name} explains the test best: probability {best.probability:.3g}, {factor}"
            )
        return f"undecided: {best.name} has a probability of {best.probability:.2g} only ({factor})"


@dataclass(frozen=True, slots=True)
class _Fit:
    """A campaign at its minimum chi-square.

    gradient, hessian: halves of the chi-square's derivatives, by the parameters; values: number of
    independent measured values.
    """

    campaign: Campaign
    evaluation: Evaluation
    misfit: float
    gradient: Floats
    hessian: Floats
    values: int
    verdict: str
    new: bool
    runs: RunCounts


def compare_models(campaigns: Sequence[Campaign], runs: Path, progress: Progress) -> ModelChoice:
    """Compare the models of campaigns on their common test.

    runs: the folder of run folders. Raises CampaignError where the campaigns cannot be compared;
    SolverError, ModesError, StoreError.
    """
    check_one_test(campaigns)
    fits = [_fitted(campaign, runs / campaign.name, progress) for campaign in campaigns]
    _check_one_set_of_modes(fits)
    freedoms = [fit.values - len(fit.campaign.parameters) for fit in fits]
    ratios = [
        fit.misfit / freedom for fit, freedom in zip(fits, freedoms, strict=True) if freedom > 0
    ]
    scale = max(1.0, min(ratios, default=1.0))
    logs = np.array([_log_evidence(fit, scale) for fit in fits])
    shares, best = probabilities(logs.tolist()), float(logs.max())
    order = np.argsort(-logs, kind="stable").tolist()
    models = tuple(
        CompetingModel(
            name=fits[n].campaign.name,
            file=Path(fits[n].campaign.file),
            parameters=fits[n].campaign.parameters.names,
            updated=fits[n].evaluation.theta,
            chi_square=fits[n].misfit,
            freedom=freedoms[n],
            log_evidence=float(logs[n]),
            probability=float(shares[n]),
            log_bayes_factor=best - float(logs[n]),
            verdict=fits[n].verdict,
            new=fits[n].new,
            runs=fits[n].runs,
        )
        for n in order
    )
    first, second = (fits[n] for n in order[:2])
    return ModelChoice(
        models,
        scale,
        float(scipy.special.chdtrc(max(freedoms[order[0]], 1), first.misfit)),
        *_distinctions(first, second),
        further_measurements(
            (first.campaign, first.evaluation), (second.campaign, second.evaluation), scale
        ),
    )


def check_one_test(campaigns: Sequence[Campaign]) -> None:
    """Raise CampaignError where campaigns cannot be compared: by what they contain."""
    if len(campaigns) < 2:
        raise CampaignError(
            "a comparison needs two campaigns or more: modetune compare A.yaml B.yaml"
        )
    first = campaigns[0]
    names = [campaign.name for campaign in campaigns]
    for place, other in enumerate(campaigns[1:], start=1):
        if other.name in names[:place]:
            raise CampaignError(
                f"{other.file}: `name` {other.name} is that of another compared campaign, and both "
                "would share a run folder; give each its own"
            )
        if what := _different(first, other):
            raise CampaignError(
                f"{first.file} and {other.file} have different {what}; only models of one test "
                "can be compared"
            )


def _different(one: Campaign, other: Campaign) -> str:
    """Return what differs between the tests of two campaigns; empty if nothing does."""
    if len(one.used) != len(other.used):
        return "numbers of configurations"
    for a, b in zip(one.used, other.used, strict=True):
        if not np.array_equal(a.test.modes.frequencies_hz, b.test.modes.frequencies_hz):
            return "test frequencies (or `test.use`)"
        if not (
            np.array_equal(a.test.modes.nodes, b.test.modes.nodes)
            and np.array_equal(a.test.modes.components, b.test.modes.components)
        ):
            return "sensors"
        if not np.array_equal(a.test.modes.mode_shapes, b.test.modes.mode_shapes):
            return "measured shapes"
        pairs = (
            (a.weighting.frequency_deviations, b.weighting.frequency_deviations),
            (a.weighting.shape_deviations, b.weighting.shape_deviations),
            (a.weighting.sensor_deviations, b.weighting.sensor_deviations),
        )
        if not all(np.array_equal(mine, its) for mine, its in pairs):
            return "measurement deviations under `residuals`"
        if {item.kind for item in a.compared} != {item.kind for item in b.compared}:
            return "responses under `residuals`"
    return ""


def _check_one_set_of_modes(fits: Sequence[_Fit]) -> None:
    """Raise CampaignError where a model has no pair for a mode that another one has."""

    def paired(fit: _Fit) -> set[str]:
        own = zip(fit.campaign.used, fit.evaluation.parts, strict=True)
        return {
            mode_name(case.test.numbers[place], case.name)
            for case, part in own
            for place in part.pairing.measured.tolist()
        }

    every = set.union(*map(paired, fits))
    for fit in fits:
        if lost := sorted(every - paired(fit)):
            raise CampaignError(
                f"{fit.campaign.file}: this model has no pair for {', '.join(lost)}, which another "
                "model has; compare the models on common modes with `--set test.use=...`"
            )


def _fitted(campaign: Campaign, folder: Path, progress: Progress) -> _Fit:
    """Return a campaign at its minimum chi-square; it is updated first, unless it has been."""
    new = not is_same(campaign, folder)
    if new:
        progress.working(f"updating {campaign.name}")
        run = update_from_starts(campaign, folder, progress)
    else:
        run = read_run(folder)
    compared = _with_all_data(campaign)
    with solving_engine(compared) as engine:
        evaluator = evaluator_of(compared, engine, demand=Demand(steps=1))
        progress.working(f"{campaign.name}: sensitivity at the end of its update")
        evaluation, misfit, slopes = _settled(compared, evaluator, run.record.updated)
    found = evaluation.residual
    rows, weights = found.independent(slopes), (found.weights > 0.0) / found.noise
    spent = evaluator.runs.plus(run.record.runs) if new else evaluator.runs
    return _Fit(
        compared,
        evaluation,
        misfit,
        -rows.T @ (weights * found.independent(found.values)),
        rows.T @ (weights[:, None] * rows),
        found.n_independent,
        run.verdict.value,
        new,
        spent,
    )


def _with_all_data(campaign: Campaign) -> Campaign:
    """Return a campaign that compares all frequencies and shapes, each at its deviation."""
    cases = []
    for case in campaign.cases:
        ones = np.ones(len(case.test.numbers))
        shapes = ones if case.test.has_shapes else 0.0 * ones
        weighting = replace(case.weighting, frequency_weights=ones, shape_weights=shapes)
        nodes = case.nodes
        if not case.solver.deck.mesh().nodes.size:  # a model of matrices has no surface to show
            nodes = tuple(sorted({*nodes, *case.solver.deck.summary.node_ids}))
        cases.append(replace(case, weighting=weighting, nodes=nodes))
    return replace(campaign, cases=tuple(cases))


def _settled(
    campaign: Campaign, evaluator: Evaluator, theta: Floats
) -> tuple[Evaluation, float, Floats]:
    """Return the evaluation at the minimum chi-square, that, and the sensitivity there.

    Where evaluations need the solver, it is that at theta.
    """
    own = campaign.parameters

    def at(point: Floats, before: Evaluation | None) -> tuple[Evaluation, float, Floats]:
        found, matrix = evaluator.evaluate("comparison", point, before, alone=False)
        assert matrix is not None
        value = data_misfit(campaign, found.errors, found.pairing, found.residual)
        return found, value, matrix.values

    here = at(theta, None)
    if not evaluator.sets_cost_little or not len(own):
        return here
    for _ in range(STEPS):
        change = _step(campaign, here[0], here[2])
        for share in (1.0, 0.5, 0.25):
            point = np.clip(here[0].theta * np.exp(share * change), own.lower, own.upper)
            there = at(point, here[0])
            if there[1] < here[1]:
                break
        else:
            return here
        gain, here = here[1] - there[1], there
        if gain < GAIN:
            return here
    return here


def _step(campaign: Campaign, evaluation: Evaluation, slopes: Floats) -> Floats:
    """Return the change of the parameters' logarithms to the minimum chi-square, linear."""
    found, theta, own = evaluation.residual, evaluation.theta, campaign.parameters
    used = found.weights > 0.0
    n = theta.size
    problem = StepProblem(
        found.independent(slopes)[used] * theta,
        found.independent(found.values)[used],
        1.0 / found.noise[used],
        np.ones(n),
        np.zeros(n),
        np.minimum(np.log(own.lower / theta), 0.0),
        np.maximum(np.log(own.upper / theta), 0.0),
    )
    return parameter_step(problem, "weighted_least_squares").change


def _log_evidence(fit: _Fit, scale: float) -> float:
    own, theta = fit.campaign.parameters, fit.evaluation.theta
    if fit.campaign.fields or fit.campaign.update.step == "pulled_to_initial":
        precision = fit.campaign.precision(theta)
        precision = np.diag(precision) if precision.ndim == 1 else precision
        offset = theta - own.initial
        return gaussian_log_evidence(fit.misfit, fit.hessian, precision, offset, scale)
    box = np.log(np.column_stack([own.lower, own.upper]) / theta[:, None])
    hessian = theta[:, None] * fit.hessian * theta
    return log_evidence(
        fit.misfit, hessian, box[:, 1] - box[:, 0], scale, theta * fit.gradient, box
    )


def _distinctions(
    best: _Fit, second: _Fit
) -> tuple[tuple[Distinction, ...], tuple[Distinction, ...]]:
    """Return the modes and the sensors that the two explain most differently."""
    found = []
    for parts in (_by_modes, _by_sensors):
        one, other = parts(best), parts(second)
        rows = [Distinction(of, one[of], other[of]) for of in one if of in other]
        found.append(tuple(sorted(rows, key=lambda row: -abs(row.difference))))
    return found[0], found[1]


def _by_modes(fit: _Fit) -> dict[str, float]:
    """Return the chi-square of each frequency and each shape."""
    found = {}
    for case, part in zip(fit.campaign.used, fit.evaluation.parts, strict=True):
        own = case.weighting.modes(part.pairing.measured)
        entries = np.count_nonzero(case.test.modes.mode_shapes[:, part.pairing.measured], axis=0)
        columns = zip(
            part.pairing.measured.tolist(),
            ((part.errors / own.frequency_deviations) ** 2).tolist(),
            (entries * (1.0 - part.pairing.judged_mac) / own.shape_deviations**2).tolist(),
            strict=True,
        )
        for place, frequency, shape in columns:
            name = mode_name(case.test.numbers[place], case.name)
            found[f"frequency of {name}"] = frequency
            if np.isfinite(shape):
                found[f"shape of {name}"] = shape
    return found


def _by_sensors(fit: _Fit) -> dict[str, float]:
    """Return the chi-square of each sensor over all shapes."""
    found: dict[str, float] = {}
    for case, part in zip(fit.campaign.used, fit.evaluation.parts, strict=True):
        if not case.test.has_shapes:
            continue
        rows, columns = common_dofs(case.test.modes, part.seen)
        measured = np.real(case.test.modes.mode_shapes[np.ix_(rows, part.pairing.measured)])
        computed = np.real(part.seen.mode_shapes[np.ix_(columns, part.pairing.computed)])
        scales = np.sum(measured * computed, axis=0) / np.sum(computed**2, axis=0)
        own = case.weighting.modes(part.pairing.measured)
        sizes = own.shape_deviations * np.sqrt(np.mean(measured**2, axis=0))
        sizes = sizes * case.weighting.sensor_deviations[rows][:, None]
        squares = np.sum(((measured - computed * scales) / sizes) ** 2, axis=1)
        nodes, components = case.test.modes.nodes[rows], case.test.modes.components[rows]
        for node, component, square in zip(
            nodes.tolist(), components.tolist(), squares.tolist(), strict=True
        ):
            found[case.of(f"sensor {dof_name((node, component))}")] = square
    return found
