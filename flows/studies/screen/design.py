"""Designs: the parameter values at which the model is solved to separate effects.

All values are relative to the deck's, within the parameters' bounds. Points that mean something
only together share a block: a trajectory of Morris's, the rows that Saltelli's scheme makes of one
base sample. Where one of them fails, the block is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, Integers
from modetune.core.planning.latin_hypercube import latin_hypercube
from modetune.flows.studies.screen.request import ScreeningMethod

#: Without a number of points: trajectories, base samples, and points a parameter.
TRAJECTORIES, BASE_SAMPLES, POINTS_EACH = 10, 64, 10
#: Levels of a parameter where none are asked for.
LEVELS: dict[ScreeningMethod, int] = {"morris": 4, "factorial": 2}
#: More points than this are a slip of the hand.
MOST_POINTS = 100_000


@dataclass(frozen=True, slots=True)
class Design:
    """The points of a screening.

    points: (n_points, n_parameters); blocks: (n_points,), number of the block that each is of;
    lower, upper: (n_parameters,), bounds; levels: of each parameter, 0 where it has none.
    """

    method: ScreeningMethod
    points: Floats
    blocks: Integers
    lower: Floats
    upper: Floats
    levels: int

    @property
    def problem(self) -> dict[str, object]:
        """What SALib calls the problem."""
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
    """The design of a method with at most so many points (about ten a parameter without).

    Sobol requires a power of two as base sample, Morris whole trajectories and an even number of
    levels: both take the most that fits into `points`. A factorial has levels ** n_parameters
    points, whatever was asked. Raises CampaignError where too few are allowed.
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
    if method == "factorial":
        return _factorial(empty, points)
    if method == "morris":
        return _morris(empty, points, rng)
    return _sobol(empty, points, rng)


def _levels(method: ScreeningMethod, levels: int | None) -> int:
    usual = LEVELS.get(method, 0)
    if levels is None:
        return usual
    if not usual:
        raise CampaignError(f"--levels is of morris and factorial, {method} has none")
    if not 2 <= levels <= 100 or (method == "morris" and levels % 2):
        wanted = "an even number from 2" if method == "morris" else "2 or more"
        raise CampaignError(f"--levels {levels}: {method} takes {wanted}, at most 100")
    return levels


def _enough(method: str, given: int, least: int) -> None:
    if given < least:
        raise CampaignError(f"--points {given}: {method} of so many parameters needs {least}")
    if given > MOST_POINTS:
        raise CampaignError(f"--points {given}: at most {MOST_POINTS} are taken")


def _placed(empty: Design, points: Floats, blocks: Integers) -> Design:
    return Design(empty.method, points, blocks, empty.lower, empty.upper, empty.levels)


def _factorial(empty: Design, points: int | None) -> Design:
    count = empty.lower.size
    n = empty.levels**count
    if n > (MOST_POINTS if points is None else points):
        raise CampaignError(
            f"a full factorial of {count} parameters at {empty.levels} levels has {n} points; "
            "take fewer parameters or levels, or another method (morris), or allow so many with "
            f"--points (at most {MOST_POINTS})"
        )
    steps = np.array(list(product(np.linspace(0.0, 1.0, empty.levels), repeat=count)))
    return _placed(empty, empty.lower + steps * (empty.upper - empty.lower), np.arange(n))


def _morris(empty: Design, points: int | None, rng: np.random.Generator) -> Design:
    """Trajectories from a random point of the grid, along each parameter once, in random order, by
    half of the levels up or down (Morris 1991)."""
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
    seed = int(rng.integers(1, 2**31))  # SALib takes zero for none
    made = sample(empty.problem, n, calc_second_order=False, seed=seed)
    return _placed(empty, np.asarray(made, np.float64), np.repeat(np.arange(n), each))
