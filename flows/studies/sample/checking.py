"""The surrogate against the solver at points of the posterior, which it has not learned from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modetune.core.modes import Floats
from modetune.flows.studies.sample.points import PointSolver, ReducedFeatures
from modetune.flows.studies.sample.sampling import Chains
from modetune.flows.studies.sample.surrogate import Surrogate, Training, worst_of

#: Sets of the posterior that are solved where nobody says how many; of a reduced model, which was
#: not learned from a few sets, two show that all is well.
CHECKS, FEW = 8, 2


@dataclass(frozen=True, slots=True)
class Checks:
    """Solver runs at points of the posterior, (n_checks, n_parameters), and their jobs.

    errors: (n_responses,), root mean square over the points of what the surrogate misses, in
    standard deviations of the test; NaN where nothing was checked.
    """

    points: Floats
    keys: tuple[str, ...]
    errors: Floats


def check_surrogate(
    solver: PointSolver,
    surrogate: Surrogate | ReducedFeatures,
    chains: Chains,
    count: int | None,
    rng: np.random.Generator,
) -> Checks:
    """Solve so many points drawn from the samples, CHECKS or FEW where not told.

    By the solver, or in full by its matrices where a reduced model stands for the surrogate: the
    solver itself has confirmed that where it is worst. Raises SolverError, StoreError.
    """
    if count is None:
        count = FEW if isinstance(surrogate, ReducedFeatures) else CHECKS
    flat = chains.flat
    drawn = flat[rng.choice(flat.shape[0], count, replace=flat.shape[0] < count)]
    none = Checks(drawn[:0], (), np.full(len(surrogate.names), np.nan))
    if count == 0:
        return none
    solved = solver.solve("checks", drawn)
    if not solved.keys:
        return none
    truth = solved.training
    if isinstance(surrogate, ReducedFeatures):
        return Checks(truth.points, solved.keys, surrogate.missed(truth))
    return Checks(truth.points, solved.keys, missed(surrogate, truth))


def missed(surrogate: Surrogate, truth: Training) -> Floats:
    """Errors of the surrogate at solver runs that it does not know, (n_responses,).

    Of each response the worst feature, root mean square over the runs; what a shape does outside
    the directions that the surrogate knows counts as one more.
    """
    reduction, count = surrogate.reduction, len(surrogate.names)
    features = reduction.features(truth.values)
    errors = worst_of(surrogate.features(truth.points) - features, reduction.responses, count)
    moves = truth.values - reduction.mean
    outside = moves - (moves @ reduction.basis) @ reduction.basis.T
    for response in range(count):
        own = outside[:, truth.responses == response]
        errors[response] = max(errors[response], float(np.sqrt((own**2).sum(axis=1).mean())))
    return errors
