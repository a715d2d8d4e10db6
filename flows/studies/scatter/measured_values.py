"""What tests were repeated for: the values that scatter, as a campaign compares them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import RepeatedTests
from modetune.core.modes import Floats, Integers
from modetune.core.updating.responses.response import Residual
from modetune.flows.campaign.campaign import Campaign


@dataclass(frozen=True, slots=True)
class MeasuredValues:
    """Values that tests were repeated for, as a campaign compares them.

    names: of the responses; columns: (m,), of them in a standardised residual; means: (m,), of the
    tests, in their units; sizes: (m,), by which the tests' values are divided: means of
    frequencies; of others what makes the measurement err alike, as the campaign's deviations say.
    deviations, targets: (m,), that residuals are standardised by, and measured from. root:
    (n_modes, n_modes), of the frequencies, which come first.
    """

    names: tuple[str, ...]
    columns: Integers
    means: Floats
    sizes: Floats
    deviations: Floats
    targets: Floats
    root: Floats

    @property
    def n_modes(self) -> int:
        """How many are frequencies."""
        return len(self.root)

    def of(self, standardised: Floats) -> Floats:
        """What the model has (n, m), less the tests' means and over the sizes."""
        own = standardised[:, self.columns]
        eigenvalues = 1.0 - own[:, : self.n_modes] @ self.root.T
        found = self.targets - own * self.deviations
        found[:, : self.n_modes] = (
            np.sqrt(np.maximum(eigenvalues, 0.0)) * self.means[: self.n_modes]
        )
        return np.asarray((found - self.means) / self.sizes)


def names_of(campaign: Campaign) -> list[str]:
    """Responses that the tests were repeated for and the campaign compares. Raises CampaignError
    where a table has more."""
    case, repeats = campaign.case, campaign.case.measurement.repeats
    assert repeats is not None
    used = zip(case.test.numbers, case.weighting.frequencies_used.tolist(), strict=True)
    found = [f"frequency of mode {number}" for number, counts in used if counts]
    if "damping" in campaign.residuals.kinds and np.isfinite(repeats.damping_ratios).any():
        found += [f"damping of mode {number}" for number in case.test.numbers]
    return found + list(() if repeats.others is None else repeats.others.names)


def values_of(campaign: Campaign, residual: Residual) -> MeasuredValues:
    """The values that were repeated, of a campaign with a residual like this. Raises CampaignError
    where one is not compared."""
    case, repeats, there = campaign.case, campaign.case.measurement.repeats, residual
    assert repeats is not None
    labels = [label for label, weight in zip(there.labels, there.weights, strict=True) if weight]
    wanted = [name for name in names_of(campaign) if name in labels or " mode " not in name]
    lost = [name for name in wanted if name not in labels]
    if lost:
        raise CampaignError(
            f"{repeats.places[0]}: the tests have a column `{lost[0]}`, but the campaign compares "
            f"no such response; it compares {', '.join(dict.fromkeys(labels))}: name it under "
            "`residuals`, or leave the column out"
        )
    if not wanted or not wanted[0].startswith("frequency"):
        raise CampaignError(
            "the campaign compares no frequency, so the scatter of the tests is unknown"
        )
    numbers = [int(name.split()[-1]) for name in wanted if name.startswith("frequency")]
    columns = np.array([labels.index(name) for name in wanted], dtype=np.int64)
    used = np.flatnonzero(there.weights > 0.0)[columns]
    deviations, n = np.sqrt(there.noise[used]), len(numbers)
    own = case.weighting.modes([case.test.numbers.index(number) for number in numbers])
    covariance = 4.0 * own.frequency_covariance
    root = np.linalg.cholesky(covariance if covariance.ndim == 2 else np.diag(covariance))
    told = np.concatenate(
        [np.zeros(0)]
        + [b.measured if b.measured.size else np.full(b.size, np.nan) for b in there.blocks]
    )
    means = np.nanmean(values_by_test(repeats, wanted), axis=0)
    means[:n] = [
        case.test.modes.frequencies_hz[case.test.numbers.index(number)] for number in numbers
    ]
    sizes = means.copy()
    sizes[n:] = deviations[n:] / campaign.residuals.of_others("frequency_deviation")
    return MeasuredValues(tuple(wanted), columns, means, sizes, deviations, told[used], root)


def values_by_test(repeats: RepeatedTests, names: Sequence[str]) -> Floats:
    """What each test measured (n_tests, m), NaN where missing or left out."""
    columns = []
    for name in names:
        kind, _, number = name.partition(" of mode ")
        if kind in ("frequency", "damping") and number:
            table = used_hz(repeats) if kind == "frequency" else repeats.damping_ratios
            columns.append(table[:, repeats.numbers.index(int(number))])
        else:
            assert repeats.others is not None
            columns.append(repeats.others.values[:, repeats.others.names.index(name)])
    return np.stack(columns, axis=1)


def used_hz(repeats: RepeatedTests) -> Floats:
    """Frequencies (n_tests, n_modes), NaN where missing or left out."""
    hz = repeats.frequencies_hz
    return hz if repeats.used is None else np.where(repeats.used, hz, np.nan)
