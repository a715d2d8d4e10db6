"""Series of nights: what is refused, in sentences, and what is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from modetune.core.errors import CampaignError
from modetune.core.monitoring.series import Series


def series(n: int = 4) -> Series:
    return Series(
        86400.0 * np.arange(n),
        ("k_1", "k_2"),
        np.ones((n, 2)),
        np.tile(1e-4 * np.eye(2), (n, 1, 1)),
        np.full((n, 1), np.nan),
        ("temperature",),
    )


def test_unsorted_runs_are_refused_and_equal_times_are_not() -> None:
    good = series()
    replace(good, times=np.array([0.0, 5.0, 5.0, 7.0]))
    with pytest.raises(CampaignError, match="run 3 is earlier than run 2: sort the runs by time"):
        replace(good, times=np.array([0.0, 6.0, 5.0, 7.0]))


def test_shapes_that_do_not_fit_are_all_listed() -> None:
    good = series()
    with pytest.raises(CampaignError) as caught:
        replace(good, values=np.ones((3, 2)), environment=np.ones((4, 2)))
    assert [text.split()[0] for text in caught.value.problems] == ["values", "environment"]


def test_a_singular_covariance_is_allowed_and_a_negative_one_is_not() -> None:
    good = series()
    replace(good, covariances=np.tile(1e-4 * np.ones((2, 2)), (4, 1, 1)))
    bad = good.covariances.copy()
    bad[1] = [[1e-4, 2e-4], [2e-4, 1e-4]]  # eigenvalues 3e-4 and -1e-4
    with pytest.raises(CampaignError, match="covariance of run 2 has a negative variance"):
        replace(good, covariances=bad)


def test_a_run_without_a_result_keeps_its_place() -> None:
    good = series()
    values = good.values.copy()
    values[2, 1] = np.nan
    assert replace(good, values=values).complete.tolist() == [True, True, False, True]


def test_two_parameters_of_one_name_are_refused() -> None:
    with pytest.raises(CampaignError, match="have one name"):
        replace(series(), names=("k", "k"))
