"""Parameter steps: from a residual and its sensitivity to the change of the parameters.

With S the sensitivity, z the residual (measured minus computed), W the weights of the
measurements and W_t those of the parameters, the thesis's forms are

    pseudo_inverse          S+ z                                                 (3.17), (34), (35)
    weighted_least_squares  min |z - S d|^2_W                                    (40)-(42)
    minimum_norm            min |d|^2_Wt with S d = z                            (43)-(45)
    regularised             min |z - S d|^2_W + a |d|^2_Wt                       (46)-(49)
    pulled_to_initial       min |z - S d|^2_W + a |t + d - t_0|^2_Wt             (50)-(53)

Each is a linear least-squares problem A d = b with stacked rows, solved by orthogonal
factorisation (normal equations would square the condition number). Bounds and the step limit
make a box for d; where the free solution leaves it, the same least-squares problem is solved in
the box, never merely clipped.

W_t is diagonal, or for parameters that hold together (`core/updating/fields`) a full matrix.

The L-curve plots log |d|_Wt over log |z - S d|_W as a varies; its corner balances fit and size
and is taken as a where the campaign asks for it (Hansen 1992). The discrepancy principle takes the
a at which |z - S d|^2_W is what the measurements' deviations explain (Morozov 1966). Of the form
that is pulled to t_0 both are asked of t + d - t_0 and z + S (t - t_0), whatever the step's start.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy
from scipy.linalg import null_space, solve_triangular

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats

LinearForm = Literal[
    "pseudo_inverse", "weighted_least_squares", "minimum_norm", "regularised", "pulled_to_initial"
]
#: The forms above, and `core/updating/trust_region`.
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

    Who stands on a bound is guessed from where the others leave it, until nobody wants to leave
    (primal-dual active sets: Hintermueller, Ito and Kunisch 2002): with that x is the answer.
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
) -> Floats:
    """Covariance of the parameters that measurement variances leave, (n, n), linear.

    variances: (n_residuals,), of the residuals; weights: (n_residuals,), by which the step
    weighed them; prior_weights: (n_parameters,), reciprocal variances beforehand, or (n_parameters,
    n_parameters), where the step was held by them; strength: times so much stronger than what is
    known beforehand, so that they draw real changes to the initial values; held: (n_held,
    n_parameters), changes d that bounds and limits hold, held d = 0, so that they have no variance.
    A parameter that nothing determines has an infinite one. With A = S^T W S + P it is
    A^-1 (S^T W V W S + strength P) A^-1, which is the familiar (S^T V^-1 S)^-1 where the weights
    are the reciprocal variances and nothing holds; in a basis of what is not held the same.
    Source: error propagation through thesis (41), (52).
    """
    weighted = weights[:, None] * sensitivity
    information = sensitivity.T @ weighted
    noise = weighted.T @ (variances[:, None] * weighted)
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
