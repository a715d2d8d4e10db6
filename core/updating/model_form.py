"""Test for model-form error: can parameter values within their bounds explain the residual?

With S the sensitivity, z the residual and V the measurement variances, the best that parameters
within their bounds can do, in the linear model, is

    chi^2 = min (z - S d)^T V^-1 (z - S d),    lower <= d <= upper.

Where the model has the truth among its parameter values, chi^2 is what measurement noise leaves:
of chi-square distribution with n - n_shapes - r degrees of freedom, r the rank of the columns of S
whose parameters are not on a bound (Shapiro 1988 for the bounds). A shape counts one less
than its sensors, because it is compared after scaling.
If noise exceeds chi^2 with a probability p below the level, there is an error that no parameter
can correct: in the model's form, in the test, or in the deviations that the campaign states.

The linear model is good to first order only. A change by the share d_j bends an effect of
stiffness or mass by about the same share, and a sensitivity that was computed where parameters
stood m_j away is off by about the share m_j, so the entry i of the residual may be off by

    sum_j |S_ij d_j| (|d_j| / 2 + |m_j|),

whose square is added to its variance. Shapes of close modes turn within their space at a rate that
itself changes fast, so half of a shape's turn |S d| is added likewise, spread over its entries.
After updating d is small, these terms vanish, and the result is a verdict. Before updating it is
a cautious forecast: an error that it reports is real, but it may miss errors.

The remaining residual of each entry is given in its standard deviations, z_left / sqrt(V (1 - h)),
with h the leverage of that entry in the fit (Belsley, Kuh and Welsch 1980).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, Integers
from modetune.core.updating.parameter_steps import (
    RANK_TOLERANCE,
    LinearForm,
    StepProblem,
    parameter_step,
)

#: Share of correct models that are wrongly suspected.
LEVEL = 0.01
#: Multiple of noise above which a forecast suspects an error beyond those of its linear model.
FORECAST = 1.5
#: Times noise below which the stated deviations are too large, where noise seldom leaves so little.
OVERSTATED = 0.7


@dataclass(frozen=True, slots=True)
class ModelForm:
    """What the best admissible parameter values leave of a residual.

    statistic: chi^2; dof: its degrees of freedom, 0 or less where nothing is left to judge by;
    p_value: probability that noise alone leaves more, NaN without degrees of freedom; least: the
    smallest `times_noise` at which an error is suspected.
    change: (n_parameters,), d; at_bound: (n_parameters,), which end on a bound.
    left: (n_residuals,), z - S d; standardised: (n_residuals,), of deviation one if noise alone.
    """

    statistic: float
    dof: int
    p_value: float
    level: float
    change: Floats
    at_bound: NDArray[np.bool_]
    left: Floats
    standardised: Floats
    least: float = 0.0

    @property
    def suspected(self) -> bool:
        """Whether `p_value` is below `level` and the misfit reaches `least` times noise."""
        return self.p_value < self.level and self.times_noise >= self.least

    @property
    def overstated(self) -> bool:
        """Whether far less is left than the stated deviations lead to expect."""
        return self.p_value > 1.0 - self.level and self.times_noise < OVERSTATED

    @property
    def times_noise(self) -> float:
        """The remaining misfit over what noise explains; NaN without degrees of freedom."""
        return float(np.sqrt(self.statistic / self.dof)) if self.dof > 0 else float("nan")


def model_form(
    sensitivity: Floats,
    residual: Floats,
    variances: Floats,
    lower: Floats,
    upper: Floats,
    shapes: Integers | None = None,
    moved: Floats | None = None,
    level: float = LEVEL,
    least: float = 0.0,
    prior: Floats | None = None,
    offset: Floats | None = None,
) -> ModelForm:
    """Judge the best admissible fit by measurement noise. Raises CampaignError.

    sensitivity: (n_residuals, n_parameters); residual, variances: (n_residuals,), the entries that
    take part; lower, upper: (n_parameters,), bounds of the change; shapes: (n_residuals,),
    which shape an entry is of, from 0, or -1 for frequencies, as all are if left out; moved:
    (n_parameters,), how far parameters went since the sensitivity was computed, nowhere if left
    out; least: see ModelForm. prior: (n_parameters, n_parameters), weights that hold parameters to
    their initial values, from which they differ by offset (n_parameters,), if more are fitted than
    a test determines (fields): the weights hold the fit too, and it takes fewer degrees of freedom.
    """
    if variances.shape != residual.shape or not (variances > 0.0).all():
        raise CampaignError("each entry of the residual needs a variance above zero")
    owner = np.full(residual.size, -1) if shapes is None else shapes
    n_shapes = np.unique(owner[owner >= 0]).size
    held = prior, np.zeros_like(lower) if offset is None else offset
    change, _ = _fit(sensitivity, residual, variances, lower, upper, *held)
    doubt = 0.5 * np.abs(change) + (0.0 if moved is None else np.abs(moved))
    variances = variances + _nonlinearity(sensitivity, change, doubt, owner)
    change, left = _fit(sensitivity, residual, variances, lower, upper, *held)
    reach = 1e-9 * np.maximum(1.0, np.abs(change))
    at_bound = (change <= lower + reach) | (change >= upper - reach)
    weighted = sensitivity[:, ~at_bound] / np.sqrt(variances)[:, None]
    directions, singular, _ = np.linalg.svd(weighted, full_matrices=False)
    told = singular > RANK_TOLERANCE * singular.max(initial=0.0)
    fitted = float(told.sum())
    if prior is not None:
        information = weighted.T @ weighted
        known = prior[np.ix_(~at_bound, ~at_bound)]
        fitted = float(np.trace(np.linalg.solve(information + known, information)))
    statistic = float(np.sum(left**2 / variances))
    dof = residual.size - n_shapes - round(fitted)
    directions = directions[:, told] if prior is None else directions[:, :0]
    leverage = np.sum(directions**2, axis=1)
    # An entry that the fit follows completely has only rounding left.
    loose = np.sqrt(np.maximum(1.0 - leverage, 0.0))
    own = left / np.sqrt(variances)
    return ModelForm(
        statistic=statistic,
        dof=dof,
        p_value=float(scipy.special.chdtrc(dof, statistic)) if dof > 0 else float("nan"),
        level=level,
        change=change,
        at_bound=at_bound,
        left=left,
        standardised=np.where(loose > 1e-6, own / np.maximum(loose, 1e-6), 0.0),
        least=least,
    )


def _nonlinearity(sensitivity: Floats, change: Floats, doubt: Floats, owner: Integers) -> Floats:
    """Return the variance of each entry from the error of the linear model, (n_residuals,)."""
    bent = (np.abs(sensitivity * change) @ doubt) ** 2
    moves = (sensitivity @ change) ** 2
    for shape in np.unique(owner[owner >= 0]).tolist():
        own = owner == shape
        bent[own] += 0.25 * moves[own].mean()
    return np.asarray(bent)


def _fit(
    sensitivity: Floats,
    residual: Floats,
    variances: Floats,
    lower: Floats,
    upper: Floats,
    prior: Floats | None,
    offset: Floats,
) -> tuple[Floats, Floats]:
    known = np.ones(lower.size) if prior is None else prior
    problem = StepProblem(sensitivity, residual, 1.0 / variances, known, offset, lower, upper)
    form: LinearForm = "weighted_least_squares" if prior is None else "pulled_to_initial"
    step = parameter_step(problem, form)
    return step.change, step.predicted


def shares_left(found: ModelForm, labels: tuple[str, ...]) -> list[tuple[str, float]]:
    """Return the share of the remaining misfit by label, the largest first.

    labels: (n_residuals,), what each entry is of.
    """
    squares = found.standardised**2
    total = float(squares.sum()) or 1.0
    sums: dict[str, float] = {}
    for label, square in zip(labels, squares.tolist(), strict=True):
        sums[label] = sums.get(label, 0.0) + square / total
    return sorted(sums.items(), key=lambda item: -item[1])


def model_form_sentence(
    found: ModelForm, labels: tuple[str, ...], names: tuple[str, ...], updated: bool
) -> str:
    """Return the finding in one or two sentences.

    labels: of the residual's entries; names: of the parameters; updated: a verdict on the updated
    model, not a forecast.
    """
    if found.dof <= 0:
        return (
            "Model-form error cannot be seen: there are as many free parameters as independent "
            "measured values, so any test can be matched."
        )
    numbers = f"chi-square {found.statistic:.3g} with {found.dof} degrees of freedom"
    leaves = "is" if updated else "would be"
    if found.overstated:
        return (
            f"What is left of the residual {leaves} only {found.times_noise:.2g} times what the "
            f"stated measurement deviations lead to expect ({numbers}): they are too large for "
            "this test, and standard errors that follow from them are too large too."
        )
    if found.p_value < found.level and not found.suspected:
        return (
            f"What is left of the residual {leaves} {found.times_noise:.2g} times measurement "
            f"noise ({numbers}): too little beyond it for a forecast to suspect anything."
        )
    if not found.suspected:
        return f"What is left of the residual {leaves} within measurement noise ({numbers})."
    # Doubles end near 1e-308, where a probability is rounded to nothing.
    chance = f"p {found.p_value:.1e}" if found.p_value >= 1e-300 else "p < 1e-300"
    explain = "explain" if updated else "are expected to explain"
    most = [label for label, share in shares_left(found, labels) if share >= 0.2][:3]
    where = f", most of it in {', '.join(most)}" if most else ""
    held = [name for name, on in zip(names, found.at_bound.tolist(), strict=True) if on]
    bounds = f" {', '.join(held)} would go beyond a bound." if held else ""
    return (
        f"No parameter values within the bounds {explain} the test: the remaining residual is "
        f"{found.times_noise:.2g} times what the stated measurement deviations explain "
        f"({numbers}, {chance}){where}.{bounds} There is a modelling error that none "
        "of these parameters represents. Check boundary conditions, joints and the stated "
        "measurement deviations."
    )
