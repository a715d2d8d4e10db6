"""Designs: the parameter values at which the model is solved to separate effects.

All values are relative to the deck's, within the parameters' bounds. Points that are useful only
together share a block: a trajectory (Morris), or the rows from one base sample (Saltelli). If one
of them fails, the whole block is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, Integers
from modetune.core.planning.latin_hypercube import latin_hypercube
from modetune.flows.studies.screen.request import ScreeningMethod

#: Defaults: trajectories, base samples, and points per parameter of a hypercube.
TRAJECTORIES, BASE_SAMPLES, POINTS_EACH = 10, 64, 10
#: Default number of levels per parameter.
LEVELS: dict[ScreeningMethod, int] = {"morris": 4}
#: Limit that catches mistyped numbers.
MOST_POINTS = 100_000


@dataclass(frozen=True, slots=True)
class Design:
    """The points of a screening.

    points: (n_points, n_parameters). blocks: (n_points,), the block number of each point. lower,
    upper: (n_parameters,), bounds. levels: per parameter, 0 for methods without levels.
    """

    method: ScreeningMethod
    points: Floats
    blocks: Integers
    lower: Floats
    upper: Floats
    levels: int

    @property
    def problem(self) -> dict[str, object]:
        """The problem definition of SALib."""
        count = self.lower.size
        return {
            "num_vars": count,
            "names": [str(place) for place in range(count)],
            "bounds": np.stack([self.lower, self.upper], axis=1).tolist(),
        }


def make_design(
    method: ScreeningMethod,
    lower: Floats,
    upper: Floats,
    rng: np.random.Generator,
    points: int | None = None,
    levels: int | None = None,
) -> Design:
    """Make the design of a method with up to `points` points (default: about ten per parameter).

    Morris needs whole trajectories and an even number of levels, Sobol a power of two of base
    samples: both use as many as fit into `points`. Raises CampaignError for too few points.
    """
    count = lower.size
    levels = _levels(method, levels)
    empty = Design(method, np.zeros((0, count)), np.zeros(0, np.int64), lower, upper, levels)
    if points is not None and points < 1:
        raise CampaignError(f"--points {points}: expected one or more")
    if method == "local":
        return empty
    if method == "lhs":
        n = POINTS_EACH * count if points is None else points
        _enough(method, n, count + 2)
        unit = latin_hypercube(n, count, rng)
        return _placed(empty, lower + unit * (upper - lower), np.arange(n))
    if method == "morris":
        return _morris(empty, points, rng)
    return _sobol(empty, points, rng)


def _levels(method: ScreeningMethod, levels: int | None) -> int:
    usual = LEVELS.get(method, 0)
    if levels is None:
        return usual
    if not usual:
        raise CampaignError(f"--levels is an option of morris; {method} has no levels")
    if not 2 <= levels <= 100 or levels % 2:
        raise CampaignError(f"--levels {levels}: expected an even number from 2 to 100")
    return levels


def _enough(method: str, given: int, least: int) -> None:
    if given < least:
        raise CampaignError(
            f"--points {given}: {method} needs at least {least} for these parameters"
        )
    if given > MOST_POINTS:
        raise CampaignError(f"--points {given}: the maximum is {MOST_POINTS}")


def _placed(empty: Design, points: Floats, blocks: Integers) -> Design:
    return Design(empty.method, points, blocks, empty.lower, empty.upper, empty.levels)


def _morris(empty: Design, points: int | None, rng: np.random.Generator) -> Design:
    """Make trajectories from random grid points (Morris 1991).

    Each moves along every parameter once, in random order, by half of the levels up or down.
    """
    count, levels = empty.lower.size, empty.levels
    each = count + 1
    n = TRAJECTORIES if points is None else points // each
    _enough("morris", n * each if points is None else points, 2 * each)
    base = rng.integers(0, levels // 2, (n, 1, count))
    turn = rng.permuted(np.tile(np.arange(count), (n, 1, 1)), axis=2)
    moved = turn < np.arange(each)[:, None]
    above = moved == rng.integers(0, 2, (n, 1, count), dtype=np.bool_)
    unit = (base + levels // 2 * above).reshape(-1, count) / (levels - 1)
    made = empty.lower + unit * (empty.upper - empty.lower)
    return _placed(empty, made, np.repeat(np.arange(n), each))


def _sobol(empty: Design, points: int | None, rng: np.random.Generator) -> Design:
    from SALib.sample.sobol import sample

    each = empty.lower.size + 2
    _enough("sobol", points if points is not None else BASE_SAMPLES * each, 8 * each)
    n = BASE_SAMPLES if points is None else 2 ** int(np.log2(points // each))
    seed = int(rng.integers(1, 2**31))  # SALib ignores a seed of 0
    made = sample(empty.problem, n, calc_second_order=False, seed=seed)
    return _placed(empty, np.asarray(made, np.float64), np.repeat(np.arange(n), each))
