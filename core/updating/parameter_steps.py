"""Parameter steps: from a residual and its sensitivity to the change of the parameters.

With S the sensitivity, z the residual (measured minus computed), W the weights of the
measurements and W_t those of the parameters, the linear forms of the thesis are

    pseudo_inverse          S+ z                                                 (3.17), (34), (35)
    weighted_least_squares  min |z - S d|^2_W                                    (40)-(42)
    minimum_norm            min |d|^2_Wt with S d = z                            (43)-(45)
    regularised             min |z - S d|^2_W + a |d|^2_Wt                       (46)-(49)
    pulled_to_initial       min |z - S d|^2_W + a |t + d - t_0|^2_Wt             (50)-(53)

Each is a linear least-squares problem A d = b with stacked rows, solved by orthogonal
factorisation (normal equations would square the condition number). Bounds and the step limit
make a box for d; where the free solution leaves it, the same least-squares problem is solved in
the box, never merely clipped. W_t is diagonal, or a full matrix for parameters of a field
(`core/updating/parameter_fields`).

**Regularisation.** The L-curve plots log |d|_Wt over log |z - S d|_W as a varies; its corner
balances fit and size and gives a where the campaign requests it (Hansen 1992). The discrepancy
principle takes the a at which |z - S d|^2_W is what the measurements' deviations explain (Morozov
1966). For the form that is pulled to t_0 both apply to t + d - t_0 and z + S (t - t_0), whatever
the step's start.

**Trust region** (Levenberg-Marquardt within the bounds). A step d from the point t minimises

    |z - S d|^2_W + a |d|^2_Wt        with  lower <= t + d <= upper  and  |d_i| <= radius

and its actual gain is compared with what the linear model predicts (More 1978): where the
prediction is achieved the radius doubles and the damping a falls, where it fails the radius halves
and a grows. The damping is

    a = a_0 * doubt * min(1, |z|^2_W / n)

with a_0 the campaign's `regularisation` and n residuals. The last factor is the misfit over what
measurement deviations explain. Where a point exists that the test fits exactly, it falls as the
square of the residual, so convergence at the end is quadratic even if S is singular there (Fan and
Yuan 2005); where noise or the model leave more, it is 1, and directions about which the test
contains less than `LEAST_DOUBT` of the prior information do not move. Where there are more
parameters than responses the steps are those of least |d|_Wt. A parameter whose bounds differ by
`FACTORS` and more is stepped in its logarithm: the same change means the same factor at any value.

**Limits of responses.** A residual's value z may have limits, l <= z <= u (those of the computed
side, mirrored). The step is that of the problem in which every limit that its linear prediction
would break becomes an equation,

    sqrt(w) (z - S d) = sqrt(w) b,

b a little inside the limit and w so large that the equation dominates all others. Each limit that
the new step would break takes one more round. A limit that is broken already draws the step back in
the same way. Source: Nocedal and Wright 2006, 16.5 (active sets) and 17.1 (penalties).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy.linalg import null_space, solve_triangular

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, Integers

LinearForm = Literal[
    "pseudo_inverse", "weighted_least_squares", "minimum_norm", "regularised", "pulled_to_initial"
]
#: The forms above, and `core/updating/parameter_steps`.
StepForm = Literal["trust_region", LinearForm]
#: A factor of regularisation, or how it is found: the corner of the L-curve, what noise explains.
Found = Literal["l_curve", "discrepancy"]
Factor = float | Found

#: Singular values below this share of the largest count as zero.
RANK_TOLERANCE = 1e-10
#: Part in an undetermined change above which a parameter is undetermined too: where that change is
#: as large as the deck's value, all others stay known to a thousandth of theirs.
LOOSE = 1e-3
#: Deviations are taken to be right within a factor of ten: a fit beyond that is one of noise, or in
#: a test without noise one of what the linear model leaves out.
BELIEVED = 0.1
#: Upper over lower bound from which a parameter may change by factors: an order of magnitude.
FACTORS = 10.0
#: Shares of the promised decrease below which the region shrinks, and above which it grows
#: (More 1978).
BROKEN, KEPT = 0.25, 0.75
#: Steps of which this share of the radius was used are held back by it.
HELD = 0.99
#: The damping's own factor falls to this: a hundredth of what is known beforehand.
LEAST_DOUBT = 1e-2
#: Share of the other equations in one that represents a limit: rounding and conditioning of the
#: least-squares problem keep their digits.
OTHERS = 1e-10
#: How far inside a limit a step ends, as a share of the change that it asks of the value: fields of
#: a deck may have six digits alone.
INSIDE = 1e-4
#: Number of rounds for curved steps, in addition to those in which a limit is met.
BENDS = 4


@dataclass(frozen=True, slots=True)
class StepProblem:
    """All that a step depends on.

    sensitivity: (n_residuals, n_parameters); residual, weights: (n_residuals,);
    parameter_weights: (n_parameters,), reciprocals of the parameters' variances, or (n_parameters,
    n_parameters), the inverse of their covariance;
    offset: (n_parameters,), theta - theta_0; lower, upper: (n_parameters,), box of the step;
    noise: |z|^2_W that measurement deviations explain.
    """

    sensitivity: Floats
    residual: Floats
    weights: Floats
    parameter_weights: Floats
    offset: Floats
    lower: Floats
    upper: Floats
    noise: float = float("nan")

    def __post_init__(self) -> None:
        n_residuals, n_parameters = self.sensitivity.shape
        if any(vector.shape != (n_residuals,) for vector in (self.residual, self.weights)):
            raise CampaignError(f"residual and weights must have {n_residuals} entries")
        vectors = (self.offset, self.lower, self.upper)
        full = self.parameter_weights.shape in ((n_parameters,), 2 * (n_parameters,))
        if not full or any(vector.shape != (n_parameters,) for vector in vectors):
            raise CampaignError(f"parameter weights and bounds must have {n_parameters} entries")
        if not (np.isfinite(self.sensitivity).all() and np.isfinite(self.residual).all()):
            raise CampaignError("sensitivity and residual must be finite")
        if (self.lower > self.upper).any():
            raise CampaignError("a lower bound of the step is above its upper bound")


@dataclass(frozen=True, slots=True)
class Step:
    """A parameter change and what the linear model promises of it.

    change: (n_parameters,); predicted: (n_residuals,), residual that would be left;
    regularisation: the factor used; rank and condition of the weighted sensitivity.
    """

    change: Floats
    predicted: Floats
    regularisation: float
    rank: int
    condition: float


def parameter_step(
    problem: StepProblem, form: LinearForm, regularisation: Factor = 1.0, share: float = 1.0
) -> Step:
    """The step of one of the five forms, within its box.

    regularisation: the factor a of the last two forms, or how it is found; share: of it, that is
    used.
    Source: thesis (34)-(53).
    """
    root_w = np.sqrt(problem.weights)
    weighted = root_w[:, None] * problem.sensitivity
    singular = np.linalg.svd(weighted, compute_uv=False)
    rank = int(np.sum(singular > RANK_TOLERANCE * singular[0])) if singular.size else 0
    factor = 0.0
    if form in ("regularised", "pulled_to_initial"):
        factor = share * _factor(problem, form, regularisation)
    change = _solve(problem, form, factor)
    smallest = singular[-1] if singular.size == problem.sensitivity.shape[1] else 0.0
    return Step(
        change=change,
        predicted=problem.residual - problem.sensitivity @ change,
        regularisation=factor,
        rank=rank,
        condition=float(singular[0] / smallest) if smallest > 0.0 else float("inf"),
    )


def from_initial(problem: StepProblem) -> StepProblem:
    """The problem of the whole change from the initial values, linear, without its box."""
    free = np.full(problem.offset.size, np.inf)
    return replace(
        problem,
        residual=problem.residual + problem.sensitivity @ problem.offset,
        offset=np.zeros_like(problem.offset),
        lower=-free,
        upper=free,
    )


def _factor(problem: StepProblem, form: LinearForm, asked: Factor) -> float:
    if asked not in ("l_curve", "discrepancy"):
        return float(asked)
    curve = l_curve(from_initial(problem) if form == "pulled_to_initial" else problem)
    return curve.corner if asked == "l_curve" else curve.leaving(problem.noise)


def weights_root(weights: Floats) -> Floats:
    """R (n, n) with R^T R the weights, which are (n,) or (n, n)."""
    if weights.ndim == 1:
        return np.diag(np.sqrt(weights))
    return np.asarray(np.linalg.cholesky(weights).T)


def _solve(problem: StepProblem, form: LinearForm, factor: float) -> Floats:
    known = problem.parameter_weights
    root_t = np.sqrt(known if known.ndim == 1 else np.diag(known))
    used = problem.weights > 0.0
    plain, plain_target = problem.sensitivity[used], problem.residual[used]
    if form == "pseudo_inverse":
        return _in_box(problem, plain, plain_target, np.ones_like(root_t))
    root_w = np.sqrt(problem.weights)
    rows, target = root_w[:, None] * problem.sensitivity, root_w * problem.residual
    if form == "weighted_least_squares":
        return _in_box(problem, rows, target, np.ones_like(root_t))
    if form == "minimum_norm":
        return _in_box(problem, plain, plain_target, root_t)
    pull = -problem.offset if form == "pulled_to_initial" else np.zeros_like(root_t)
    penalty = np.sqrt(factor) * weights_root(known)
    stacked = np.vstack([rows, penalty])
    return _in_box(problem, stacked, np.concatenate([target, penalty @ pull]), root_t)


def _in_box(problem: StepProblem, rows: Floats, target: Floats, scale: Floats) -> Floats:
    """Least squares of least norm |scale * d|, in the box of the step.

    Where rows do not determine d, the box problem gets a vanishing penalty on the norm, because
    the bounded method by itself picks any of the solutions.
    """
    free = np.linalg.lstsq(rows / scale, target, rcond=RANK_TOLERANCE)[0] / scale
    if (free >= problem.lower).all() and (free <= problem.upper).all():
        return np.asarray(free)
    tiny = 1e-7 * np.linalg.norm(rows, 2) / scale.max()
    rows = np.vstack([rows, np.diag(tiny * scale)])
    target = np.concatenate([target, np.zeros(scale.size)])
    return least_squares_in(problem.lower, problem.upper, rows, target)


def least_squares_in(lower: Floats, upper: Floats, rows: Floats, target: Floats) -> Floats:
    """The x (n,) within bounds for which |rows x - target| is least.

    The set of parameters on a bound is guessed and corrected until none leaves its bound
    (primal-dual active sets: Hintermueller, Ito and Kunisch 2002); then x is the solution.
    Guesses that do not settle are left to SciPy's bounded-variable method, which takes a tenth of
    a second to import.
    """
    x = np.zeros(lower.size)
    low, high = np.zeros((2, lower.size), dtype=np.bool_)
    for _ in range(2 * lower.size + 2):
        held = low | high
        x[held] = np.where(low, lower, upper)[held]
        left = target - rows[:, held] @ x[held]
        x[~held] = np.linalg.lstsq(rows[:, ~held], left, rcond=None)[0]
        slope = rows.T @ (rows @ x - target)
        lower_now = np.where(held, low & (slope >= 0.0), x < lower)
        upper_now = np.where(held, high & (slope <= 0.0), x > upper)
        if (lower_now == low).all() and (upper_now == high).all():
            return x
        low, high = lower_now, upper_now
    x, open_ = lower.copy(), lower < upper  # the bounded method requires room in each variable
    left, bounds = target - rows[:, ~open_] @ x[~open_], (lower[open_], upper[open_])
    x[open_] = scipy.optimize.lsq_linear(rows[:, open_], left, bounds, method="bvls").x
    return np.clip(x, lower, upper)


@dataclass(frozen=True, slots=True)
class LCurve:
    """Fit against size over a range of regularisation factors.

    factors, misfits, sizes: (n,), |z - S d|_W and |d|_Wt; corner: the factor where the curve
    turns from falling to level most sharply. Factors and misfits ascend.
    """

    factors: Floats
    misfits: Floats
    sizes: Floats
    corner: float

    def leaving(self, noise: float) -> float:
        """The factor at which |z - S d|^2_W is this; the corner where no factor leaves so little,
        the largest where all do."""
        if not self.misfits[0] ** 2 < noise:
            return self.corner
        squares = np.maximum.accumulate(self.misfits**2)
        return float(np.exp(np.interp(noise, squares, np.log(self.factors))))


def l_curve(problem: StepProblem, n_factors: int = 121) -> LCurve:
    """The L-curve of the free (unbounded) regularised problem. Source: Hansen 1992.

    Its corner is sought where no more is left than noise explains, and no less than `BELIEVED` of
    the deviations would leave, if there are such factors.
    """
    known, root_w = problem.parameter_weights, np.sqrt(problem.weights)
    rows = root_w[:, None] * problem.sensitivity
    if known.ndim == 1:
        rows = rows / np.sqrt(known)
    else:  # to standard form (Hansen 1998, 2.3)
        rows = solve_triangular(weights_root(known), rows.T, trans="T").T
    u, s, _ = np.linalg.svd(rows, full_matrices=False)
    target = root_w * problem.residual
    beta = u.T @ target
    outside = float(target @ target - beta @ beta)
    s = np.maximum(s, s[0] * RANK_TOLERANCE)
    # Below 10^-12 of the largest information only rounding would be regularised.
    lowest = max(float(s[-1]) ** 2 * 1e-2, float(s[0]) ** 2 * 1e-12)
    factors = np.geomspace(lowest, s[0] ** 2 * 1e2, n_factors)
    damping = factors[:, None] / (s**2 + factors[:, None])
    misfits = np.sqrt(np.sum((damping * beta) ** 2, axis=1) + max(outside, 0.0))
    sizes = np.sqrt(np.sum(((1.0 - damping) * beta / s) ** 2, axis=1))
    x, y, t = np.log(misfits + 1e-300), np.log(sizes + 1e-300), np.log(factors)
    dx, dy = np.gradient(x, t), np.gradient(y, t)
    curvature = (dx * np.gradient(dy, t) - dy * np.gradient(dx, t)) / (
        (dx**2 + dy**2) ** 1.5 + 1e-300
    )
    # The ends of a gradient are one-sided and give false curvature. A curve may have corners where
    # most of the test is not yet explained: they are none of noise against fit.
    inside = np.arange(2, n_factors - 2)
    for least in (BELIEVED**2 * problem.noise, 0.0):
        left = misfits[inside] ** 2
        explained = inside[(left >= least) & (left <= problem.noise)]
        if explained.size:
            inside = explained
            break
    corner = factors[inside[int(np.argmax(curvature[inside]))]]
    return LCurve(factors, misfits, sizes, float(corner))


def parameter_covariance(
    sensitivity: Floats,
    variances: Floats,
    weights: Floats,
    prior_weights: Floats | None = None,
    held: Floats | None = None,
    strength: float = 1.0,
    errors: Floats | None = None,
) -> Floats:
    """Covariance of the parameters that measurement variances leave, (n, n), linear.

    variances: (n_residuals,), of the residuals; weights: (n_residuals,), by which the step
    weighed them; prior_weights: (n_parameters,), reciprocal variances beforehand, or (n_parameters,
    n_parameters), where the step was held by them; strength: times so much stronger than what is
    known beforehand, so that they draw real changes to the initial values; held: (n_held,
    n_parameters), changes d that bounds and limits hold, held d = 0, so that they have no variance;
    errors: (n_residuals, n_errors), Q of a further covariance Q Q^T of the residuals.
    A parameter that nothing determines has an infinite one. With A = S^T W S + P it is
    A^-1 (S^T W V W S + strength P) A^-1, which is the familiar (S^T V^-1 S)^-1 where the weights
    are the reciprocal variances and nothing holds; in a basis of what is not held the same.
    Source: error propagation through thesis (41), (52).
    """
    weighted = weights[:, None] * sensitivity
    information = sensitivity.T @ weighted
    noise = weighted.T @ (variances[:, None] * weighted)
    if errors is not None:
        moved = weighted.T @ errors
        noise = noise + moved @ moved.T
    if prior_weights is not None:
        known = np.diag(prior_weights) if prior_weights.ndim == 1 else prior_weights
        information, noise = information + known, noise + strength * known
    if held is not None and held.size:
        free = null_space(held / np.linalg.norm(held, axis=1)[:, None])
        information, noise = free.T @ information @ free, free.T @ noise @ free
    else:
        free = np.eye(sensitivity.shape[1])
    values, vectors = np.linalg.eigh(information)
    null = values <= RANK_TOLERANCE * max(float(values.max(initial=0.0)), 0.0)
    inverse = (vectors[:, ~null] / values[~null]) @ vectors[:, ~null].T
    covariance = free @ (inverse @ noise @ inverse) @ free.T
    loose = np.any(np.abs(free @ vectors[:, null]) > LOOSE, axis=1)
    covariance[loose, loose] = np.inf
    return np.asarray(covariance)


@dataclass(frozen=True, slots=True)
class Scale:
    """A parameter set, and the scale of its parameters in a step.

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


def step_within(
    solve: Callable[[StepProblem], Step],
    problem: StepProblem,
    values: Floats,
    sensitivity: Floats,
    limits: Floats,
) -> tuple[Step, Integers]:
    """The step of a problem that keeps its linear prediction within limits, and the rows whose
    limits hold it.

    values: (n_residuals,), sensitivity: (n_residuals, n_parameters), of the items, where the
    problem's own rows may be mixed; limits: (n_residuals, 2).
    """
    step = solve(problem)
    held = np.flatnonzero(np.isfinite(limits).any(axis=1) & sensitivity.any(axis=1))
    ends: dict[int, float] = {}
    for _ in range(held.size + BENDS):
        there = values - sensitivity @ step.change
        broken = [row for row in held.tolist() if breach(there[[row]], limits[[row]])[0] > 0.0]
        if not broken:
            break
        for row in broken:
            low, high = limits[row].tolist()
            room = min(INSIDE * abs(there[row] - values[row]), 0.5 * (high - low))
            wanted = float(np.clip(there[row], low + room, high - room))
            # Steps of logarithms bend away from what their equation says.
            ends[row] = ends.get(row, there[row]) + wanted - there[row]
        step = solve(_with_equations(problem, values, sensitivity, ends))
    return step, np.array(sorted(ends), dtype=np.int64)


def breach(values: Floats, limits: Floats) -> Floats:
    """How far values (n,) are outside of their limits (n, 2), 0 within."""
    return np.asarray(np.maximum(0.0, np.maximum(limits[:, 0] - values, values - limits[:, 1])))


def _with_equations(
    problem: StepProblem, values: Floats, sensitivity: Floats, ends: dict[int, float]
) -> StepProblem:
    rows = list(ends)
    slopes = sensitivity[rows]
    scale = np.linalg.norm(slopes, axis=1)
    root = np.sqrt(problem.weights)[:, None] * problem.sensitivity
    others = np.vstack([root, weights_root(problem.parameter_weights)])
    weight = float(np.sum(others**2)) / OTHERS
    return replace(
        problem,
        sensitivity=np.vstack([problem.sensitivity, slopes / scale[:, None]]),
        residual=np.append(problem.residual, (values[rows] - list(ends.values())) / scale),
        weights=np.append(problem.weights, np.full(scale.size, weight)),
    )
