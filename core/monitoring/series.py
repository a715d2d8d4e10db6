"""The parameters of one structure over its runs, each with the covariance of its test."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from modetune.core.brief import brief
from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, Integers


@dataclass(frozen=True, slots=True, repr=False)
class Series:
    """Parameters of one structure over its runs, oldest first.

    times: (n_runs,), seconds since 1970; two may be equal, none may be earlier than the one before.
    names: of the parameters. values: (n_runs, n_parameters), relative to the deck; a run whose row
    is not finite has no result. covariances: (n_runs, n_parameters, n_parameters), of
    repeatability, the test's noise alone; a singular one is allowed. environment: (n_runs,
    n_quantities), NaN where unknown. quantities: names of the environment's columns.
    Raises CampaignError that lists everything that does not fit together.
    """

    times: Floats
    names: tuple[str, ...]
    values: Floats
    covariances: Floats
    environment: Floats
    quantities: tuple[str, ...]

    __repr__ = brief

    def __post_init__(self) -> None:
        problems = list(self._problems())
        if problems:
            raise CampaignError(problems)

    def _problems(self) -> Iterator[str]:
        """What does not fit together, a sentence each."""
        n, p, q = self.times.size, len(self.names), len(self.quantities)
        shapes = {
            "times": (self.times, (n,)),
            "values": (self.values, (n, p)),
            "covariances": (self.covariances, (n, p, p)),
            "environment": (self.environment, (n, q)),
        }
        wrong = [
            f"{name} of shape {array.shape} do not fit {n} runs, {p} parameters and {q} "
            f"quantities of the environment, which need {wanted}"
            for name, (array, wanted) in shapes.items()
            if array.shape != wanted
        ]
        if wrong or not p:
            yield from wrong or ["a series needs at least one parameter"]
            return
        for what, names in (("parameters", self.names), ("quantities", self.quantities)):
            if len(set(names)) < len(names):
                yield f"two {what} of the series have one name: {', '.join(names)}"
        if not np.isfinite(self.times).all():
            yield f"run {int(np.argmin(np.isfinite(self.times))) + 1} has no time"
        elif (np.diff(self.times) < 0.0).any():
            place = int(np.argmax(np.diff(self.times) < 0.0)) + 1
            yield f"run {place + 1} is earlier than run {place}: sort the runs by time"
        for place in np.flatnonzero(self.complete):
            covariance = self.covariances[place]
            variances = np.diag(covariance)
            sizes = np.sqrt(np.abs(variances))
            correlation = covariance / np.outer(*2 * (np.where(sizes > 0.0, sizes, 1.0),))
            # Rounding of a product of matrices about 1, with room for their condition.
            slack = 1e-8 * p
            if (np.abs(correlation - correlation.T) > slack).any():
                yield f"the covariance of run {place + 1} is not symmetric"
            elif (variances < 0.0).any() or np.linalg.eigvalsh(correlation)[0] < -slack:
                yield f"the covariance of run {place + 1} has a negative variance"

    def of(self, places: Integers) -> Series:
        """Return the series of some parameters."""
        return replace(
            self,
            names=tuple(self.names[place] for place in places),
            values=self.values[:, places],
            covariances=self.covariances[:, places][:, :, places],
        )

    @property
    def complete(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Which runs have a result: all values and covariances are finite, (n_runs,)."""
        return np.asarray(
            np.isfinite(self.values).all(axis=1) & np.isfinite(self.covariances).all(axis=(1, 2))
        )
