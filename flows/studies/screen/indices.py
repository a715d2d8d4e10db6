"""Indices: what a design's responses say of each parameter.

* Morris: elementary effects (y(x + d) - y(x)) / d in units of the whole range; mu their mean, mu*
  the mean of their sizes with the half width of its 95 % interval, sigma their spread, which is
  large where a parameter acts in curves or together with others (Morris 1991; Campolongo, Cariboni
  and Saltelli 2007).
* Sobol: the share of a response's variance that goes with a parameter alone (first) and with it
  and all its interactions (total), with half widths of 95 % intervals (Saltelli and others 2010).
  By SALib.
* Latin hypercube: rank correlation (Spearman), and coefficients of the regression on all
  parameters, each in units of its standard deviation; their squares add up to the share of the
  variance that a plane explains.
* Full factorial: main effect, the mean at the highest level less that at the lowest; interaction
  of two parameters, half the difference of one's effect at the other's highest and lowest level;
  and their shares of the sum of squares (Box, Hunter and Hunter 2005).

So that methods can be compared, each also gives `moves`: by how much the parameter moves a
response over the whole of its bounds. For a linear response all of them give |slope| (upper -
lower); a variance is that of a uniform spread, whose range is sqrt(12) standard deviations.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy

from modetune.core.errors import ModesError
from modetune.core.modes import Floats
from modetune.flows.studies.screen.design import Design
from modetune.flows.studies.screen.request import ScreeningMethod

#: Range of a uniform spread over its standard deviation.
UNIFORM_RANGE = float(np.sqrt(12.0))
#: Half width of an interval that holds 95 % of normal values, in standard deviations.
NORMAL = 1.96
#: A response that varies less than this, relative to its size, is constant except for rounding.
CONSTANT = 1e-12
#: Measures of each method, in the order of `Indices.values`.
MEASURES: dict[ScreeningMethod, tuple[str, ...]] = {
    "local": (),
    "morris": ("mu", "mu_star", "sigma", "mu_star_confidence"),
    "sobol": ("first", "first_confidence", "total", "total_confidence"),
    "lhs": ("rank_correlation", "regression"),
    "factorial": ("main_effect", "main_share"),
}
#: How many whole blocks each method needs to say anything.
LEAST_BLOCKS: dict[ScreeningMethod, int] = {"morris": 2, "sobol": 8, "lhs": 3, "factorial": 2}


@dataclass(frozen=True, slots=True)
class Indices:
    """What the responses say.

    measures: names of the method's measures; values: (n_measures, n_responses, n_parameters).
    moves: (n_responses, n_parameters), in the responses' unit. explained: (n_responses,), share
    of the variance that the measures explain (lhs, factorial), NaN for others.
    interactions: (n_responses, n_parameters, n_parameters) of a factorial, symmetric, and
    interaction_shares likewise; without rows for others. used: how many points are behind it all.
    """

    measures: tuple[str, ...]
    values: Floats
    moves: Floats
    explained: Floats
    interactions: Floats
    interaction_shares: Floats
    used: int

    def measure(self, name: str) -> Floats:
        """One measure, (n_responses, n_parameters)."""
        return np.asarray(self.values[self.measures.index(name)])


def design_indices(design: Design, responses: Floats, rng: np.random.Generator) -> Indices:
    """The indices of a method from its responses.

    responses: (n_points, n_responses), a row of NaN where a point failed. Blocks with such a row
    are left out; in a factorial, main effects and interactions of two, fitted to the other points,
    stand in for it. Raises ModesError where too little is left.
    """
    failed = np.isnan(responses).any(axis=1)
    keep = ~np.isin(design.blocks, design.blocks[failed])
    blocks = np.unique(design.blocks[keep]).size
    least = LEAST_BLOCKS[design.method]
    if design.method == "lhs":
        least = design.points.shape[1] + 2
    if blocks < least:
        raise ModesError(
            f"{int(failed.sum())} of {failed.size} points failed and {blocks} whole "
            f"{UNITS[design.method]} are left, {design.method} needs {least}; narrow the bounds, "
            "or look at the failed jobs"
        )
    if design.method == "factorial":
        return _factorial(design, responses, ~failed)
    kept = replace(design, points=design.points[keep], blocks=design.blocks[keep])
    if design.method == "morris":
        return _morris(kept, responses[keep], rng)
    return (_sobol if design.method == "sobol" else _hypercube)(kept, responses[keep], rng)


#: What a block is called, where a sentence speaks of several.
UNITS: dict[ScreeningMethod, str] = {
    "morris": "trajectories",
    "sobol": "base samples",
    "lhs": "points",
    "factorial": "points",
}


def varies(responses: Floats) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which columns of responses vary by more than rounding, (n_responses,)."""
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
    # SALib 1.5.1 hands the names to pandas, which from version 3 takes no list.
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
    ranks, told = (
        _standard(scipy.stats.rankdata(columns, axis=0)) for columns in (design.points, responses)
    )
    regression = np.linalg.lstsq(points, targets, rcond=None)[0]
    left = ((targets - points @ regression) ** 2).mean(axis=0)
    alive = varies(responses)
    values = np.stack([(ranks.T @ told).T / len(points), regression.T]) * alive[None, :, None]
    # Steps of the hypercube are even, so bounds give the parameters' own spread.
    slopes = np.abs(values[1]) * responses.std(axis=0)[:, None] / design.points.std(axis=0)
    explained = np.where(alive, 1.0 - left, np.nan)
    return _indices(design, values, slopes * (design.upper - design.lower), explained)


def _standard(columns: Floats) -> Floats:
    """Columns of mean 0 and standard deviation 1; constant ones are zero."""
    centred = columns - columns.mean(axis=0)
    spread = centred.std(axis=0)
    return np.asarray(centred / np.where(varies(columns), spread, np.inf))


def _factorial(
    design: Design, responses: Floats, good: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> Indices:
    count, levels = design.lower.size, design.levels
    filled = responses if good.all() else _filled(design, responses, good)
    cube = filled.reshape(*(levels,) * count, -1)
    mean, n = filled.mean(axis=0), filled.shape[1]
    total = ((filled - mean) ** 2).mean(axis=0)
    scale = np.where(varies(filled), total, np.inf)
    values, moves = np.zeros((2, n, count)), np.zeros((n, count))
    interactions, shares = np.zeros((2, n, count, count))
    mains = []
    for i in range(count):
        means = cube.mean(axis=tuple(axis for axis in range(count) if axis != i)) - mean
        mains.append(means)
        values[:, :, i] = means[-1] - means[0], (means**2).mean(axis=0) / scale
        moves[:, i] = np.ptp(means, axis=0)
    for i in range(count):
        for j in range(i + 1, count):
            cells = cube.mean(axis=tuple(axis for axis in range(count) if axis not in (i, j)))
            apart = cells - mean - mains[i][:, None] - mains[j][None, :]
            corners = cells[-1, -1] + cells[0, 0] - cells[-1, 0] - cells[0, -1]
            interactions[:, i, j] = interactions[:, j, i] = 0.5 * corners
            share = (apart**2).mean(axis=(0, 1)) / scale
            shares[:, i, j] = shares[:, j, i] = share
    explained = values[1].sum(axis=1) + np.triu(shares, 1).sum(axis=(1, 2))
    explained = np.where(varies(filled), explained, np.nan)
    found = _indices(design, values, moves, explained, int(good.sum()))
    return replace(found, interactions=interactions, interaction_shares=shares)


def _filled(
    design: Design, responses: Floats, good: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> Floats:
    """Responses with what main effects and interactions of two say in place of failed points."""
    count, levels = design.lower.size, design.levels
    at = np.indices((levels,) * count).reshape(count, -1).T  # level of each parameter, a point
    mains = [(at[:, [i]] == np.arange(1, levels)).astype(np.float64) for i in range(count)]
    pairs = [
        (mains[i][:, :, None] * mains[j][:, None, :]).reshape(len(at), -1)
        for i in range(count)
        for j in range(i + 1, count)
    ]
    columns = np.hstack([np.ones((len(at), 1)), *mains, *pairs])
    solution, _, rank, _ = np.linalg.lstsq(columns[good], responses[good], rcond=None)
    if rank < columns.shape[1]:
        raise ModesError(
            f"{int((~good).sum())} of {good.size} points failed; the others do not tell all main "
            "effects and interactions; narrow the bounds, or use another method"
        )
    return np.where(good[:, None], responses, columns @ solution)


def _indices(
    design: Design,
    values: Floats,
    moves: Floats,
    explained: Floats | None = None,
    used: int | None = None,
) -> Indices:
    n, count = moves.shape
    none = np.zeros((0, count, count))
    return Indices(
        MEASURES[design.method],
        values,
        moves,
        np.full(n, np.nan) if explained is None else explained,
        none,
        none,
        len(design.points) if used is None else used,
    )
