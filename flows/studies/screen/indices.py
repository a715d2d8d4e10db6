"""Indices: the effect of each parameter on the responses of a design.

* Morris: elementary effects (y(x + d) - y(x)) / d, in units of the whole range. mu is their mean,
  mu* the mean of their absolute values with the half width of its 95 % interval, sigma their
  standard deviation, which is large for nonlinear effects and interactions (Morris 1991;
  Campolongo, Cariboni and Saltelli 2007).
* Sobol: the share of a response's variance due to a parameter alone (first) and including all its
  interactions (total), with half widths of 95 % intervals (Saltelli and others 2010), by SALib.
* Latin hypercube: rank correlation (Spearman), and standardised coefficients of the regression on
  all parameters; their squares add up to the share of the variance that a plane explains.

So that methods can be compared, each also gives `moves`: the change of a response over the
parameter's whole bounds. For a linear response every method gives |slope| (upper - lower); a
variance is converted as that of a uniform distribution, whose range is sqrt(12) standard
deviations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from modetune.core.errors import ModesError
from modetune.core.modes import Floats
from modetune.flows.studies.screen.design import Design
from modetune.flows.studies.screen.request import ScreeningMethod

#: Range of a uniform distribution in standard deviations.
UNIFORM_RANGE = float(np.sqrt(12.0))
#: Half width of the 95 % interval of a normal distribution, in standard deviations.
NORMAL = 1.96
#: Relative variation below which a response is constant up to rounding.
CONSTANT = 1e-12
#: Measures of each method, in the order of `Indices.values`.
MEASURES: dict[ScreeningMethod, tuple[str, ...]] = {
    "local": (),
    "morris": ("mu", "mu_star", "sigma", "mu_star_confidence"),
    "sobol": ("first", "first_confidence", "total", "total_confidence"),
    "lhs": ("rank_correlation", "regression"),
}
#: Minimum number of whole blocks for each method.
LEAST_BLOCKS: dict[ScreeningMethod, int] = {"morris": 2, "sobol": 8, "lhs": 3}


@dataclass(frozen=True, slots=True)
class Indices:
    """The indices of a design.

    measures: names of the method's measures. values: (n_measures, n_responses, n_parameters).
    moves: (n_responses, n_parameters), in the responses' unit. explained: (n_responses,), share of
    the variance that the regression explains (lhs), otherwise NaN. used: number of points used.
    """

    measures: tuple[str, ...]
    values: Floats
    moves: Floats
    explained: Floats
    used: int

    def measure(self, name: str) -> Floats:
        """Return one measure, (n_responses, n_parameters)."""
        return np.asarray(self.values[self.measures.index(name)])


def design_indices(design: Design, responses: Floats, rng: np.random.Generator) -> Indices:
    """Return the indices of a design.

    responses: (n_points, n_responses), a row of NaN for a failed point. Blocks with such a row are
    left out. Raises ModesError if too few remain.
    """
    failed = np.isnan(responses).any(axis=1)
    keep = ~np.isin(design.blocks, design.blocks[failed])
    blocks = np.unique(design.blocks[keep]).size
    least = LEAST_BLOCKS[design.method]
    if design.method == "lhs":
        least = design.points.shape[1] + 2
    if blocks < least:
        raise ModesError(
            f"{int(failed.sum())} of {failed.size} points failed and only {blocks} whole "
            f"{UNITS[design.method]} remain, but {design.method} needs {least}: narrow the bounds, "
            "or examine the failed jobs"
        )
    kept = replace(design, points=design.points[keep], blocks=design.blocks[keep])
    if design.method == "morris":
        return _morris(kept, responses[keep], rng)
    return (_sobol if design.method == "sobol" else _hypercube)(kept, responses[keep], rng)


#: The plural noun for the blocks of each method.
UNITS: dict[ScreeningMethod, str] = {
    "morris": "trajectories",
    "sobol": "base samples",
    "lhs": "points",
}


def varies(responses: Floats) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return which columns vary by more than rounding, (n_responses,)."""
    size = np.abs(responses).max(axis=0, initial=1.0)
    return np.asarray(np.ptp(responses, axis=0) > CONSTANT * size)


def _morris(design: Design, responses: Floats, rng: np.random.Generator) -> Indices:
    m, count = responses.shape[1], design.lower.size
    unit = design.points / (design.upper - design.lower)
    steps = np.diff(unit.reshape(-1, count + 1, count), axis=1)
    moved = np.abs(steps).argmax(axis=2)
    changes = np.diff(responses.reshape(-1, count + 1, m), axis=1)
    effects = np.zeros((len(steps), count, m))
    effects[np.arange(len(steps))[:, None], moved] = changes / steps.sum(axis=2)[:, :, None]
    sizes, n = np.abs(effects), len(effects)
    half = NORMAL * sizes.std(axis=0, ddof=1) / np.sqrt(n)
    found = np.stack([effects.mean(axis=0), sizes.mean(axis=0), effects.std(axis=0, ddof=1), half])
    values = found.swapaxes(1, 2) * varies(responses)[:, None]
    return _indices(design, values, values[1])


def _sobol(design: Design, responses: Floats, rng: np.random.Generator) -> Indices:
    from SALib.analyze.sobol import analyze

    n, count = responses.shape[1], design.lower.size
    values = np.zeros((4, n, count))
    # SALib 1.5.1 passes the names to pandas, which refuses a list from version 3 on.
    problem = {**design.problem, "names": np.arange(count)}
    for place in np.flatnonzero(varies(responses)).tolist():
        found = analyze(
            problem, responses[:, place], calc_second_order=False, seed=int(rng.integers(1, 2**31))
        )
        names = ("S1", "S1_conf", "ST", "ST_conf")
        values[:, place] = [np.asarray(found[name], np.float64) for name in names]
    # The first and last row of each base sample are independent and give the variance.
    each = count + 2
    ends = np.concatenate([responses[::each], responses[each - 1 :: each]])
    spread = np.sqrt(np.maximum(values[2], 0.0) * ends.var(axis=0)[:, None])
    return _indices(design, values, UNIFORM_RANGE * spread)


def _hypercube(design: Design, responses: Floats, rng: np.random.Generator) -> Indices:
    points = _standard(design.points)
    targets = _standard(responses)
    ranks, response_ranks = (
        _standard(scipy.stats.rankdata(columns, axis=0)) for columns in (design.points, responses)
    )
    regression = np.linalg.lstsq(points, targets, rcond=None)[0]
    left = ((targets - points @ regression) ** 2).mean(axis=0)
    alive = varies(responses)
    values = (
        np.stack([(ranks.T @ response_ranks).T / len(points), regression.T]) * alive[None, :, None]
    )
    # The strata have equal widths, so the points have the parameters' own spread.
    slopes = np.abs(values[1]) * responses.std(axis=0)[:, None] / design.points.std(axis=0)
    explained = np.where(alive, 1.0 - left, np.nan)
    return _indices(design, values, slopes * (design.upper - design.lower), explained)


def _standard(columns: Floats) -> Floats:
    """Return columns scaled to mean 0 and standard deviation 1; constant columns are zero."""
    centred = columns - columns.mean(axis=0)
    spread = centred.std(axis=0)
    return np.asarray(centred / np.where(varies(columns), spread, np.inf))


def _indices(
    design: Design,
    values: Floats,
    moves: Floats,
    explained: Floats | None = None,
) -> Indices:
    if explained is None:
        explained = np.full(len(moves), np.nan)
    return Indices(MEASURES[design.method], values, moves, explained, len(design.points))
