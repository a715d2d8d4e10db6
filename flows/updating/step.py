"""Steps of a campaign: from an evaluation and its sensitivity to the next point, and their gain.

The default step has a trust region, which grows if steps gain what they predict; `step_limit` is
its first radius. The other step types are at most `step_limit` long. If there are reduced models,
the step goes to the end of updating on them, within the same region.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from modetune.core.modes import Floats, Integers
from modetune.core.updating.identifiability import remaining_step
from modetune.core.updating.parameter_steps import (
    HELD,
    KEPT,
    Factor,
    Scale,
    Step,
    StepProblem,
    TrustRegion,
    breach,
    by_factors,
    parameter_step,
    step_within,
    trust_region_step,
)
from modetune.core.updating.responses.response import Residual
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.updating.evaluation import Evaluation, Matrix

#: Number of steps that search for a regularisation factor. It is then fixed; otherwise steps could
#: alternate between the solutions of two factors.
SETTLED = 4
#: Number of limited parameters that a sentence names.
NAMED = 4
#: Returns a better step than this one, within lower and upper values, or None.
Refined = Callable[[Evaluation, Step, tuple[Floats, Floats]], Step | None]


def used_weights(campaign: Campaign, found: Residual) -> Floats:
    """Return the weights of a residual in a campaign's step, (n_residuals,), as precisions.

    pseudo_inverse and minimum_norm have no weights: all used residuals count equally.
    """
    if campaign.update.step not in ("pseudo_inverse", "minimum_norm"):
        return found.weights
    used = found.weights > 0.0
    return np.asarray(used / np.mean(found.variances[used]))


def objective(campaign: Campaign, theta: Floats, found: Residual, regularisation: float) -> float:
    """Return the objective of updating at a point, comparable between distant points.

    theta: (n_parameters,); found: the residual there; regularisation: as in `prior_weights`.
    """
    weights, values = found.potential, found.independent(found.values)
    if campaign.update.step in ("pseudo_inverse", "minimum_norm"):
        used = found.weights > 0.0
        weights = used / np.mean(found.noise[used])
    prior, offset = prior_weights(campaign, theta, regularisation), _offset(campaign, theta)
    pull = 0.0 if prior is None else float(offset @ _times(prior, offset))
    return float(values @ (weights * values)) + pull


def objective_slopes(
    campaign: Campaign, theta: Floats, found: Residual, slopes: Floats, regularisation: float
) -> tuple[Floats, Floats]:
    """Return the gradient (n_parameters,) of `objective` and its Gauss-Newton matrix.

    slopes: (n_residuals, n_parameters), the sensitivity by items.
    """
    weights, rows = used_weights(campaign, found), found.independent(slopes)
    gradient = -2.0 * rows.T @ (weights * found.independent(found.values))
    curvature = 2.0 * rows.T @ (weights[:, None] * rows)
    prior = prior_weights(campaign, theta, regularisation)
    if prior is not None:
        gradient = gradient + 2.0 * _times(prior, _offset(campaign, theta))
        curvature = curvature + 2.0 * (np.diag(prior) if prior.ndim == 1 else prior)
    return gradient, curvature


def _offset(campaign: Campaign, theta: Floats) -> Floats:
    return np.asarray(theta - campaign.parameters.initial)


def _times(prior: Floats, offset: Floats) -> Floats:
    return np.asarray(prior * offset if prior.ndim == 1 else prior @ offset)


def prior_weights(campaign: Campaign, theta: Floats, regularisation: float) -> Floats | None:
    """Return the weights of the initial values in the objective, or None.

    They are (n_parameters,), or (n_parameters, n_parameters) with fields. regularisation: of the
    last step, NaN if there was none.
    """
    if campaign.update.step != "pulled_to_initial":
        return None
    factor = regularisation if np.isfinite(regularisation) else 1.0
    return np.asarray(factor * campaign.precision(theta))


def step_problem(campaign: Campaign, theta: Floats, found: Residual, rows: Floats) -> StepProblem:
    """Return the problem of a step from a point, within the parameters' bounds.

    theta: (n_parameters,). found: the residual there. rows: its sensitivity by items.
    """
    parameters = campaign.parameters
    return StepProblem(
        sensitivity=found.independent(rows),
        residual=found.independent(found.values),
        weights=found.weights,
        parameter_weights=campaign.precision(theta),
        offset=theta - parameters.initial,
        lower=np.minimum(parameters.lower - theta, 0.0),
        upper=np.maximum(parameters.upper - theta, 0.0),
        noise=float(found.weights @ found.noise),
    )


def way_to_least_misfit(
    campaign: Campaign, theta: Floats, found: Residual, slopes: Floats, regularisation: float
) -> tuple[Floats, Floats, Integers]:
    """Return the linear distance from a point to a campaign's minimum misfit, (n_parameters,).

    Also return the changes that bounds and limits prevent there, (n_held, n_parameters), and the
    rows of these limits. theta: (n_parameters,). found, slopes: residual and sensitivity there.
    regularisation: of the last step.
    """
    problem = step_problem(campaign, theta, found, slopes)
    problem = replace(problem, weights=used_weights(campaign, found))
    pulled = campaign.update.step == "pulled_to_initial"
    factor = regularisation if np.isfinite(regularisation) else 1.0
    box = problem.lower, problem.upper

    def solve(asked: StepProblem) -> Step:
        if pulled:
            return parameter_step(asked, "pulled_to_initial", factor)
        given = asked.sensitivity, asked.residual, asked.weights
        change = remaining_step(*given, campaign.parameters.standard_deviations, *box)
        return Step(change, given[1] - given[0] @ change, 0.0, 0, np.nan)

    step, active = step_within(solve, problem, found.values, slopes, found.limits)
    way, prior = step.change, prior_weights(campaign, theta, regularisation)
    left = problem.residual - problem.sensitivity @ way
    pushed = problem.sensitivity.T @ (problem.weights * left)
    if prior is not None:
        known = np.diag(prior) if prior.ndim == 1 else prior
        pushed -= known @ (problem.offset + way)
    on = (pushed < 0.0) & np.isclose(way, problem.lower, atol=1e-9)
    on |= (pushed > 0.0) & np.isclose(way, problem.upper, atol=1e-9)
    return way, np.vstack([slopes[active], np.eye(theta.size)[on]]), active


class Stepping:
    """The steps of a loop, and the parameters whose change was limited by the step length.

    refined: returns a better step than a linear one, to a point within lower and upper values, or
    None. lower, upper: (n_parameters,), limits of all steps.
    """

    def __init__(self, campaign: Campaign, refined: Refined, lower: Floats, upper: Floats) -> None:
        self.campaign = campaign
        self.refined = refined
        self.lower, self.upper = lower, upper
        self.adapts = campaign.update.step == "trust_region"
        # Use the campaign's bounds: those of a region around a point are always close.
        wide = by_factors(campaign.parameters.lower, campaign.parameters.upper)
        self.logarithmic = wide & self.adapts
        self.held: Counter[str] = Counter()
        self.taken = 0
        self._factors: list[float] = []

    @property
    def first(self) -> TrustRegion:
        """Return the region of the first step."""
        return TrustRegion(self.campaign.update.step_limit)

    def step(self, current: Evaluation, matrix: Matrix, region: TrustRegion) -> Step:
        """Return the step from a point with its sensitivity."""
        parameters, settings = self.campaign.parameters, self.campaign.update
        low, high = box = self._box(current, region.radius)
        room = np.ones(len(parameters))
        room[list(matrix.missing)] = 0.0  # the effect of these is unknown
        found = current.residual
        problem = replace(
            step_problem(self.campaign, current.theta, found, matrix.values),
            lower=room * np.minimum(low - current.theta, 0.0),
            upper=room * np.maximum(high - current.theta, 0.0),
        )

        def solve(asked: StepProblem) -> Step:
            if settings.step != "trust_region":
                return parameter_step(asked, settings.step, self._regularisation)
            return trust_region_step(asked, self._scale(current), region, settings.regularisation)

        step, _ = step_within(solve, problem, found.values, matrix.values, found.limits)
        self._factors.append(step.regularisation)
        own = step.predicted[: found.values.size]
        step = replace(step, predicted=found.of_items(own))
        return self.refined(current, step, box) or step

    @property
    def _regularisation(self) -> Factor:
        """Return the next step's factor, or the way to find it."""
        settings = self.campaign.update
        settled = settings.step == "pulled_to_initial" and len(self._factors) >= SETTLED
        return self._factors[-1] if settled else settings.regularisation

    def to_least_misfit(self, current: Evaluation, matrix: Matrix) -> Step:
        """Return the step to the minimum misfit, as far as the test determines it, from nearby."""
        if self.campaign.update.step == "pulled_to_initial":
            return self.step(current, matrix, TrustRegion(np.inf))
        way, _, _ = way_to_least_misfit(
            self.campaign, current.theta, current.residual, matrix.values, 0.0
        )
        change = np.clip(way, self.lower - current.theta, self.upper - current.theta)
        predicted = current.residual.values - matrix.values @ change
        if breach(predicted, current.residual.limits).any():
            change = np.zeros_like(change)  # a limit would be violated on the way
            predicted = current.residual.values
        step = Step(change, predicted, 0.0, rank=0, condition=np.nan)
        return self.refined(current, step, (self.lower, self.upper)) or step

    def halved(self, current: Evaluation, matrix: Matrix, step: Step) -> Step:
        """Return a step of half the length."""
        change = 0.5 * step.change
        predicted = current.residual.values - matrix.values @ change
        return replace(step, change=change, predicted=predicted)

    def shorter(
        self, current: Evaluation, matrix: Matrix, step: Step, region: TrustRegion
    ) -> tuple[Step, TrustRegion]:
        """Return a step of at most half the length, and its region."""
        length = self.length(current, step)
        if self.adapts:
            region = region.shrunk(length)
            return self.step(current, matrix, region), region
        box = self._box(current, 0.5 * length)
        refined = self.refined(current, step, box)
        if refined is not None:
            return refined, region
        return self.halved(current, matrix, step), region

    def region_after(
        self, current: Evaluation, matrix: Matrix, step: Step, region: TrustRegion, kept: float
    ) -> TrustRegion:
        """Return the region of the step after an accepted one; kept: achieved share of its gain."""
        self._count(current, step, region)
        if not self.adapts or (matrix.age > 0 and kept < KEPT):
            return region  # a wrong prediction by an old matrix says nothing about the model
        return region.after(self.length(current, step), kept)

    def length(self, current: Evaluation, step: Step) -> float:
        """Return the largest entry of a step in the parameters' scale (linear or logarithmic)."""
        return float(np.max(np.abs(self._scale(current).steps(step.change))))

    def objective(
        self, current: Evaluation, residual: Floats, step: Step, share: float = 0.0
    ) -> float:
        """Return the objective of this step type for a residual at a fraction `share` of the step.

        The weights are those of the current point, since weights of shapes grow as shapes come
        closer; pseudo_inverse and minimum_norm have none. The pull to initial values is included.
        """
        settings, parameters = self.campaign.update, self.campaign.parameters
        weights = current.residual.weights
        if settings.step in ("pseudo_inverse", "minimum_norm"):
            weights = (weights > 0.0).astype(np.float64)
        pull = 0.0
        if settings.step == "pulled_to_initial":
            theta = current.theta + share * step.change
            offset, known = theta - parameters.initial, self.campaign.precision(current.theta)
            pulled = known * offset if known.ndim == 1 else known @ offset
            pull = step.regularisation * float(offset @ pulled)
        residual = current.residual.independent(residual)
        return float(residual @ (weights * residual)) + pull

    def better(self, current: Evaluation, there: Evaluation, step: Step) -> bool:
        """Return whether a step lowers the objective within the limits, or nears them by half."""
        if self.nears_limits(current, there):
            return True
        return not _breach(there).any() and self.gain(current, there, step) > 0.0

    def nears_limits(self, current: Evaluation, there: Evaluation) -> bool:
        """Return whether every violation of a limit is at most half as large after the step."""
        before = _breach(current)
        return bool(before.any() and (_breach(there) <= 0.5 * before).all())

    def gain(self, current: Evaluation, there: Evaluation, step: Step) -> float:
        """Return the decrease of the objective from the current point to the end of a step."""
        before = self.objective(current, current.residual.values, step)
        return before - self.objective(current, there.residual.values, step, 1.0)

    @property
    def held_back(self) -> str:
        """Return a sentence about how often the step limit was active; empty without steps."""
        if not self.taken:
            return ""
        limit = f"`step_limit` ({self.campaign.update.step_limit:g})"
        if not self.held:
            return f"{limit} limited none of {self.taken} steps"
        names = ", ".join(f"{name} in {n}" for name, n in self.held.most_common(NAMED))
        more = f" and {len(self.held) - NAMED} others" if len(self.held) > NAMED else ""
        return f"{limit} limited {names}{more} of {self.taken} steps"

    def _count(self, current: Evaluation, step: Step, region: TrustRegion) -> None:
        """Count the parameters that a longer step would have changed more."""
        self.taken += 1
        steps = np.abs(self._scale(current).steps(step.change))
        for place in np.flatnonzero(steps >= HELD * region.radius).tolist():
            self.held[self.campaign.parameters.names[place]] += 1

    def _scale(self, current: Evaluation) -> Scale:
        return Scale(current.theta, self.logarithmic)

    def _box(self, current: Evaluation, radius: float) -> tuple[Floats, Floats]:
        """Return lower and upper values of the end of a step of at most this length."""
        scale, reach = self._scale(current), np.full(current.theta.size, radius)
        return (
            np.maximum(self.lower, current.theta + scale.changes(-reach)),
            np.minimum(self.upper, current.theta + scale.changes(reach)),
        )


def _breach(evaluation: Evaluation) -> Floats:
    """Return by how much each value exceeds its limits, (n_residuals,)."""
    return breach(evaluation.residual.values, evaluation.residual.limits)
