"""The request of a sampling; imports nothing heavy, because the command line reads it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from typer import Option

SetsOverRange = Annotated[
    int | None,
    Option(help="Number of points over the range; up to as many may follow near the posterior."),
]
SeedOfAll = Annotated[int, Option(help="Seed of all random numbers.")]
#: More of anything than this is a slip of the hand.
MOST = 100_000


@dataclass(frozen=True, slots=True)
class SamplingRequest:
    """The points, the sampler and the checks of a sampling.

    None: the number follows from the number of parameters; that of checks from the source of the
    samples. Without a number of points, twice as many may follow near the posterior.
    """

    points: SetsOverRange = None
    walkers: Annotated[int | None, Option(help="Number of walkers of the sampler.")] = None
    steps: Annotated[int, Option(help="Number of steps per walker; more follow if needed.")] = 2000
    seed: SeedOfAll = 1
    checks: Annotated[
        int | None,
        Option(
            help="Number of posterior points to verify by solving; default: 8, or 2 with a "
            "reduced model."
        ),
    ] = None

    def problems(self, n_parameters: int) -> list[str]:
        """What is unavailable, a sentence each."""
        least = n_parameters + 3
        limits = (
            ("--points", self.points, least), ("--steps", self.steps, 100),
            ("--checks", self.checks, 0), ("--seed", self.seed, 0),
        )  # fmt: skip
        return [
            f"{name} {value}: expected {low} to {MOST}"
            for name, value, low in limits
            if value is not None and not low <= value <= MOST
        ]
