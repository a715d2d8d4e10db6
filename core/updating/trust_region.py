"""Trust-region steps: Levenberg-Marquardt in the bounds, as far as the linear model is believed.

A step d from the set t minimises

    |z - S d|^2_W + a |d|^2_Wt        with  lower <= t + d <= upper  and  |d_i| <= radius

and what it really gains is held against what the linear model promised (More 1978): where the
promise is kept the radius doubles and the damping a falls, where it is broken the radius halves
and a grows. The damping is

    a = a_0 * doubt * min(1, |z|^2_W / n)

with a_0 the campaign's `regularisation` and n residuals. The last factor is the misfit over what
measurement deviations explain. Where a set exists that the test fits exactly, it falls as the
square of the residual, so the end is reached quadratically even if S is singular there (Fan and
Yuan 2005); where noise or the model leave more, it is 1, and directions of which the test tells
less than `LEAST_DOUBT` of what is known beforehand stay where they are. Where there are more
parameters than responses the steps are those of least |d|_Wt.

A parameter whose bounds differ by `FACTORS` and more is stepped in its logarithm: the same change
of it means the same factor wherever it stands.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from modetune.core.modes import Floats
from modetune.core.updating.estimation import Factor, Step, StepProblem, parameter_step

#: Upper over lower bound from which a parameter may change by factors: an order of magnitude.
FACTORS = 10.0
#: Shares of the promised decrease below which the region shrinks, and above which it grows
#: (More 1978).
BROKEN, KEPT = 0.25, 0.75
#: Steps of which this share of the radius was used are held back by it.
HELD = 0.99
#: The damping's own factor falls to this: a hundredth of what is known beforehand.
LEAST_DOUBT = 1e-2


@dataclass(frozen=True, slots=True)
class Scale:
    """Where a set stands and how its parameters are counted.

    theta: (n_parameters,), relative values; logarithmic: (n_parameters,), whether a parameter is
    stepped in its logarithm.
    """

    theta: Floats
    logarithmic: NDArray[np.bool_]

    @property
    def slopes(self) -> Floats:
        """Derivative of the values by what is stepped, (n_parameters,)."""
        return np.where(self.logarithmic, self.theta, 1.0)

    def changes(self, steps: Floats) -> Floats:
        """Changes of the values by steps, (n_parameters,)."""
        powers = np.expm1(np.where(self.logarithmic, steps, 0.0))
        return np.where(self.logarithmic, self.theta * powers, steps)

    def steps(self, changes: Floats) -> Floats:
        """Steps that make these changes of the values, (n_parameters,)."""
        ratios = np.where(self.logarithmic, changes / self.theta, 0.0)
        return np.where(self.logarithmic, np.log1p(ratios), changes)


def by_factors(lower: Floats, upper: Floats) -> NDArray[np.bool_]:
    """Which parameters may change by factors. lower, upper: (n_parameters,), bounds above zero."""
    return np.asarray(upper >= FACTORS * lower)


@dataclass(frozen=True, slots=True)
class TrustRegion:
    """How far the next step may go and how boldly.

    radius: largest step of a parameter; doubt: factor on the damping.
    """

    radius: float
    doubt: float = 1.0

    @property
    def boldest(self) -> bool:
        """Whether the damping is as low as it gets."""
        return self.doubt <= LEAST_DOUBT

    def after(self, length: float, kept: float) -> TrustRegion:
        """The region after a step; length: its largest entry, kept: share of its promise."""
        if kept < BROKEN:
            return self.shrunk(length)
        if kept < KEPT:
            return self
        grows = length >= HELD * self.radius
        radius = 2.0 * self.radius if grows else self.radius
        return TrustRegion(radius, max(0.1 * self.doubt, LEAST_DOUBT))

    def shrunk(self, length: float) -> TrustRegion:
        """The region after a step of this length that led nowhere."""
        return TrustRegion(0.5 * min(length, self.radius), 4.0 * self.doubt)

    def emboldened(self) -> TrustRegion:
        """The region with the least damping."""
        return replace(self, doubt=min(self.doubt, LEAST_DOUBT))


def trust_region_step(
    problem: StepProblem, scale: Scale, region: TrustRegion, regularisation: Factor
) -> Step:
    """The step in a trust region. problem: its box is that of the bounds and the radius, in values.

    regularisation: the damping beforehand, or "l_curve". Source: More 1978; Fan and Yuan 2005.
    """
    used = problem.weights > 0.0
    misfit = float(problem.residual @ (problem.weights * problem.residual))
    share = region.doubt * min(1.0, misfit / max(int(used.sum()), 1))
    scaled = replace(
        problem,
        sensitivity=problem.sensitivity * scale.slopes,
        lower=scale.steps(problem.lower),
        upper=scale.steps(problem.upper),
    )
    step = parameter_step(scaled, "regularised", regularisation, share)
    change = np.clip(scale.changes(step.change), problem.lower, problem.upper)
    return replace(step, change=change)
