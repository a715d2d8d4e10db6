"""Proposals: the changes of a model that explain best what its parameters leave of the test.

1. Reduced models of all cases that contain every change exactly (`core/updating/candidates`).
2. All changes at a few amplitudes, with the linear answer of the campaign's parameters.
3. The best ones with all parameters free, to the least misfit of all measured frequencies and
   shapes.
4. Evidence, corrected for the number of changes: half of the prior is that nothing lacks, the other
   half is divided evenly among kinds, and within a kind among places (`core/updating/evidence`).
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from modetune.core.parameters import Parameter
from modetune.core.updating.evidence import log_evidence, probabilities
from modetune.core.updating.minima import polished
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.studies.init.candidate_parameters import candidates
from modetune.flows.studies.localise.case_model import CaseModel, ChangeMisfit, case_model
from modetune.flows.studies.localise.changes import (
    LoadPlaces,
    ModelChange,
    changes_of,
    places_of,
)
from modetune.flows.updating.evaluation import CaseEvaluation, Evaluation
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.mode_source import CaseState

logger = logging.getLogger(__name__)

#: Amplitudes between the bounds at which every change is tried, more where these are further apart
#: than a decade each; masses and frequencies of an absorber.
AMPLITUDES, OF_ABSORBERS = 6, (2, 5)
#: Amplitudes between these that are tried where the residual seems least.
BETWEEN = 2
#: Changes that are then refined: the best, and the best of each kind. While the best of them leaves
#: more than this ratio of chi-square to freedom, as many more, up to five times.
REFINED, OF_KIND, EXPLAINED, TIMES = 24, 2, 1.5, 5
#: Quantities of groups that are tried, each with a matrix job of its own at most.
GROUPS = 20
#: Quantities that others stand for: a density as a mass, a dimension as a thickness or a modulus.
OTHERS = ("density", "dimension")
#: Quantities with which a program may make other nodes, as of shells that become unequal.
DIMENSIONS = ("thickness", "offset")
#: Two changes with a smaller difference of the misfit cannot be told apart: 3 standard deviations.
ALIKE = 9.0
#: Probability above which a change is proposed.
PROPOSED = 0.9


@dataclass(frozen=True, slots=True)
class Proposal:
    """A change of the model with its evidence.

    amplitudes: (n_amplitudes,), and errors: their relative standard errors, the prior's where
    the test does not determine them. theta: (n_parameters,), the campaign's parameters with it.
    misfit: the chi-square that it leaves. removed: its share of what the parameters alone leave, at
    least 1. log_evidence: relative to no change. probability: of the
    change, of all changes and none. alike: labels of others that cannot be told apart from it.
    """

    change: ModelChange
    amplitudes: Floats
    errors: Floats
    theta: Floats
    misfit: float
    removed: float
    log_evidence: float
    probability: float
    alike: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Proposals:
    """Changes, the most probable first.

    misfit: the chi-square of all measured data that the campaign's parameters leave at their best;
    freedom: its degrees of freedom. scale: by which misfits are divided, above 1 where even the
    best change leaves more than noise. nothing: probability that the model lacks none of the
    changes. n_changes: how many were tried.
    """

    found: tuple[Proposal, ...]
    misfit: float
    freedom: int
    scale: float
    nothing: float
    n_changes: int

    @property
    def proposed(self) -> bool:
        """Whether a change is more probable than none by far."""
        return 1.0 - self.nothing >= PROPOSED


def proposals(
    campaign: Campaign,
    evaluator: Evaluator,
    evaluation: Evaluation,
    tell: Callable[[str], None] = lambda text: None,
) -> Proposals:
    """Look for changes of the model at an evaluated point. Raises ModelError, ModesError."""
    return search_of(campaign, evaluator, evaluation, tell).ranked(tell)


def search_of(
    campaign: Campaign,
    evaluator: Evaluator,
    evaluation: Evaluation,
    tell: Callable[[str], None] = lambda text: None,
) -> ChangeSearch:
    """Return the search at an evaluated point, with its changes and models. Raises as above."""
    groups, places = _groups(evaluator.used), places_of([state.case for state in evaluator.used])
    own = list(zip(evaluator.used, evaluation.parts, strict=True))
    for tried in dict.fromkeys((groups, _of_materials(groups), ())):
        try:
            cases = _models(campaign, evaluator, own, tried, places, tell)
        except ModelError as error:
            if not tried:
                raise
            logger.warning("fewer quantities of groups are tried: %s", error)
        else:
            groups = tried
            break
    found = changes_of(
        [item.case for item in cases],
        places,
        [item.loaded for item in cases],
        [item.released for item in cases],
        [item.n_loads for item in cases],
        cases[0].mass,
        groups,
    )
    return ChangeSearch(campaign, cases, list(found), evaluation.theta)


def _of_materials(groups: Sequence[Parameter]) -> tuple[Parameter, ...]:
    """Return quantities that leave the equations as they are, whatever their value."""
    return tuple(item for item in groups if item.quantity not in DIMENSIONS)


def _models(
    campaign: Campaign,
    evaluator: Evaluator,
    own: Sequence[tuple[CaseState, CaseEvaluation]],
    groups: Sequence[Parameter],
    places: LoadPlaces,
    tell: Callable[[str], None],
) -> list[CaseModel]:
    made = []
    for state, part in own:
        tell(state.case.of("reduced model with loads"))
        made.append(case_model(campaign, evaluator, state, part, groups, places))
    return made


def _groups(states: Sequence[CaseState]) -> tuple[Parameter, ...]:
    """Return quantities of all decks that no parameter of the campaign moves."""
    own = [item for state in states for item in state.campaign.parameters.parameters]
    own += [item for state in states for item in state.campaign.parameters.dependents]
    taken = {(item.quantity, target) for item in own for target in item.targets}
    given = [item.parameter for item in candidates(states[0].case.solver)]
    return tuple(
        replace(item, name=f"proposed {item.name}")
        for item in given
        if item.quantity not in OTHERS
        and not any((item.quantity, target) in taken for target in item.targets)
        and not any(state.case.solver.deck.problems((item,)) for state in states[1:])
    )[:GROUPS]


@dataclass(frozen=True, slots=True)
class Refined:
    """The best point of a change: log parameters and log amplitudes.

    hessian: half of the misfit's. of_modes: the part of the misfit that modes leave.
    """

    place: Floats
    misfit: float
    hessian: Floats
    of_modes: float


class ChangeSearch:
    """The search for the best changes from a state theta (n_parameters,).

    misfit: the chi-square that the parameters alone leave at their best, `place` (logarithms).
    start: where they leave the least misfit of modes.
    """

    def __init__(
        self,
        campaign: Campaign,
        cases: Sequence[CaseModel],
        changes: Sequence[ModelChange],
        theta: Floats,
    ) -> None:
        self.cases, self.parameters, self.changes = cases, campaign.parameters, changes
        without = self.trial(None)
        here = np.clip(np.log(theta), without.lower, without.upper)
        self.start, _ = polished(without.by_modes, here)
        starts = [self.start] if without.by_modes is without else [self.start, here]
        ends = [polished(without, start) for start in starts]
        self.place, self.misfit = min(ends, key=lambda item: item[1])
        found, whole = without.by_modes.slopes(self.start), without.slopes(self.place)
        parts, of_modes = without.parts(self.place), without.by_modes.parts(self.start)
        assert found is not None
        assert whole is not None
        assert parts is not None
        assert of_modes is not None
        self.base, slopes = found
        self.hessian = whole[1].T @ whole[1]
        self.width = without.upper - without.lower
        self.freedom, self._freedom_of_modes = (
            sum(part.residual.n_independent for _, part in own) - self.place.size
            for own in (parts, of_modes)
        )
        # A parameter answers within its bounds, as a standard deviation of a uniform prior.
        prior = np.diag(np.sqrt(12.0) / np.minimum(self.width, 1e3))
        self._answers, self._root = np.linalg.qr(np.vstack([slopes, prior]))

    def trial(self, change: ModelChange | None) -> ChangeMisfit:
        return ChangeMisfit(self.cases, change, self.parameters)

    def free(self, residual: Floats) -> tuple[Floats, Floats]:
        """Return what the parameters leave of a residual by their linear answer, and that."""
        whole = np.concatenate([residual, np.zeros(self.start.size)])
        along = self._answers.T @ whole
        return whole - self._answers @ along, -np.linalg.solve(self._root, along)

    def screened(self, change: ModelChange) -> tuple[float, Floats]:
        """Return about the least misfit with a change, and log amplitudes for it.

        Modes alone give the amplitudes and the parameters' answer; all data judge the result.
        """
        trial, best = self.trial(change), (np.inf, _grid(change)[0])
        tried: list[tuple[float, Floats]] = []
        if change.group < 0 and not change.constrained:  # nothing is changed at zero
            tried.append((0.0, self.free(self.base)[0]))

        def value(at: Floats) -> tuple[float, Floats]:
            found = trial.by_modes.residual(np.concatenate([self.start, at]))
            if found is None or found.size != self.base.size:
                return np.inf, at
            here, answer = self.free(found)
            tried.append((float(np.exp(at[0])), here))
            if trial.by_modes is trial:
                return float(here @ here), at
            own = np.clip(
                self.start + answer, trial.lower[: answer.size], trial.upper[: answer.size]
            )
            return trial.value(np.concatenate([own, at])), at

        for at in _grid(change):
            best = min(best, value(at), key=lambda item: item[0])
        for _ in range(BETWEEN if change.lower.size == 1 else 0):
            amplitude = _between(tried)
            if amplitude is None:
                break
            there = np.log(np.clip([amplitude], change.lower, change.upper))
            best = min(best, value(there), key=lambda item: item[0])
        return best

    def refined(self, change: ModelChange, amplitudes: Floats) -> Refined | None:
        """Return the best point of a change; None where a mode is lost there."""
        trial = self.trial(change)
        place, misfit = trial.least(np.concatenate([self.start, amplitudes]))
        if misfit > self.misfit:  # far from the least one; a small change leaves what there is
            none = _grid(change)[-1 if change.constrained else 0]
            place, misfit = polished(trial, np.concatenate([self.place, none]))
        found = trial.slopes(place)
        if found is None:
            return None
        return Refined(place, misfit, found[1].T @ found[1], trial.by_modes.value(place))

    def ranked(self, tell: Callable[[str], None] = lambda text: None) -> Proposals:
        """Return the changes in the order of their probability."""
        return self._ranked(tell)

    def _ranked(self, tell: Callable[[str], None]) -> Proposals:
        changes, screened = self.changes, []
        for number, change in enumerate(changes):
            if number % 50 == 0:
                tell(f"changes: {number} of {len(changes)}")
            screened.append(self.screened(change))
        order = sorted(range(len(changes)), key=lambda n: screened[n][0])
        refined: dict[int, Refined] = {}
        least, batch, left = self.misfit, _chosen(changes, order), list(order)
        for _ in range(TIMES):
            for n in batch:
                tell(f"refined: {changes[n].label}")
                found = self.refined(changes[n], screened[n][1])
                if found is not None:
                    refined[n] = found
                    least = min(least, found.misfit)
            left = [n for n in left if n not in batch]
            of_modes = min((found.of_modes for found in refined.values()), default=np.inf)
            if of_modes < EXPLAINED * self._freedom_of_modes:
                break
            batch = left[:REFINED]
        scale = max(1.0, least / max(self.freedom - 1, 1))
        none = log_evidence(self.misfit, self.hessian, self.width, scale)
        logs = np.array([-0.5 * item[0] / scale for item in screened])
        for n, found in refined.items():
            width = np.concatenate([self.width, np.log(changes[n].upper / changes[n].lower)])
            logs[n] = log_evidence(found.misfit, found.hessian, width, scale) - none
        volumes = [logs[n] + 0.5 * item.misfit / scale for n, item in refined.items()]
        others = [n for n in range(len(changes)) if n not in refined]
        logs[others] += float(np.median(volumes)) if volumes else 0.0
        # What was not worth refining is not better than what was.
        logs[others] = np.minimum(logs[others], np.median([logs[n] for n in refined] or [0.0]))
        kinds = Counter(change.kind for change in changes)
        prior = np.array([0.5 / len(kinds) / kinds[change.kind] for change in changes])
        chances = probabilities([*logs, 0.0], np.append(prior, 0.5))
        best = tuple(self._proposals(changes, refined, logs, chances, scale, np.log(prior)))
        return Proposals(best, self.misfit, self.freedom, scale, float(chances[-1]), len(changes))

    def _proposals(
        self,
        changes: Sequence[ModelChange],
        refined: dict[int, Refined],
        logs: Floats,
        chances: Floats,
        scale: float,
        prior: Floats,
    ) -> Iterator[Proposal]:
        for n in sorted(refined, key=lambda n: -(logs[n] + prior[n])):
            place, misfit = refined[n].place, refined[n].misfit
            # What the test does not determine has the error of its prior, uniform in logarithms.
            width = np.concatenate([self.width, np.log(changes[n].upper / changes[n].lower)])
            prior_hessian = np.diag(12.0 / np.minimum(width, 1e3) ** 2)
            covariance = np.linalg.inv(refined[n].hessian / scale + prior_hessian)
            own = self.start.size
            yield Proposal(
                change=changes[n],
                amplitudes=np.exp(place[own:]),
                errors=np.sqrt(np.maximum(np.diag(covariance)[own:], 0.0)),
                theta=np.exp(place[:own]),
                misfit=misfit,
                removed=(self.misfit - misfit) / max(self.misfit, 1.0),
                log_evidence=float(logs[n]),
                probability=float(chances[n]),
                alike=tuple(
                    changes[m].label
                    for m in sorted(refined, key=lambda m: refined[m].misfit)
                    if m != n and abs(refined[m].misfit - misfit) < ALIKE * scale
                ),
            )


def _between(tried: Sequence[tuple[float, Floats]]) -> float | None:
    """Return the amplitude between two neighbours where a line between their residuals is shortest.

    tried: amplitudes and residuals. None where none is shorter than those tried.
    """
    ordered = sorted(tried, key=lambda item: item[0])
    least = min((float(own @ own) for _, own in ordered), default=0.0)
    found = None
    for (low, here), (high, there) in pairwise(ordered):
        way = there - here
        share = float(np.clip(-(here @ way) / max(way @ way, 1e-300), 0.0, 1.0))
        value = float(np.sum((here + share * way) ** 2))
        if value < least and 0.0 < share < 1.0:
            least, found = value, low + share * (high - low)
    return found


def _chosen(changes: Sequence[ModelChange], order: Sequence[int]) -> list[int]:
    """Return which changes to refine, in their order: the best, and the best few of each kind."""
    seen, found = Counter[str](), []
    for place, n in enumerate(order):
        seen[changes[n].kind] += 1
        if place < REFINED or seen[changes[n].kind] <= OF_KIND:
            found.append(n)
    return found


def _grid(change: ModelChange) -> list[Floats]:
    """Return log amplitudes (n_amplitudes,) at which a change is tried, ascending."""
    lower, upper = np.log(change.lower), np.log(change.upper)
    if lower.size == 1:
        decades = int(np.ceil((upper[0] - lower[0]) / np.log(10.0)))
        return [np.array([at]) for at in np.linspace(lower[0], upper[0], max(AMPLITUDES, decades))]
    # The second amplitude of an absorber is a stiffness, whose ratio to the mass is the frequency.
    masses = np.linspace(lower[0], upper[0], OF_ABSORBERS[0])
    ratios = np.linspace(lower[1] - lower[0], upper[1] - upper[0], OF_ABSORBERS[1])
    return [np.array([mass, mass + ratio]) for mass in masses for ratio in ratios]
