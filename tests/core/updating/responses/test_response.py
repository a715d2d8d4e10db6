"""The stacked residual of several kinds and cases, and errors that are not independent."""

from __future__ import annotations

import numpy as np
import pytest

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats
from modetune.core.updating.responses.response import (
    Residual,
    block_parts,
    residual_of,
    stacked,
    stacked_rows,
)

NOISE = np.random.default_rng(4)


def part(kind: str, n: int, scaled: bool = False, each: int = 1) -> Residual:
    names = [f"{kind} {number}" for number in range(n)]
    values, ones = NOISE.normal(size=n * each), np.ones(n * each)
    return residual_of(kind, names, np.full(n, each), values, ones, ones, scaled=scaled)


def covariance(n: int) -> Floats:
    root = NOISE.normal(size=(n, n))
    return np.asarray(root @ root.T + 0.1 * np.eye(n))


def test_kinds_stand_together_and_cases_in_turn() -> None:
    one = [part("frequencies", 2), part("shapes", 2, scaled=True, each=5), part("mass", 1)]
    other = [part("frequencies", 3), part("mass", 2)]
    whole = stacked([one, other])
    assert [block.kind for block in whole.blocks] == [
        "frequencies",
        "frequencies",
        "shapes",
        "mass",
        "mass",
    ]
    assert whole.rows("frequencies") == slice(0, 5)
    assert whole.rows("shapes") == slice(5, 15)
    assert whole.rows("mass") == slice(15, 18)
    assert not whole.has("mac")
    # Of each of the two shapes scaling takes one entry.
    assert whole.n_independent == 5 + 10 - 2 + 3
    assert whole.labels[5] == "shapes 0"
    assert (whole.owners(scaled=True) >= 0).sum() == 10
    rows = stacked_rows([stacked([one]), stacked([other])])
    for own, place in zip((one, other), rows, strict=True):
        np.testing.assert_array_equal(whole.values[place], stacked([own]).values)
    assert [item.blocks[0].names for item in block_parts(whole)] == [
        block.names for block in whole.blocks
    ]


def test_a_full_covariance_weighs_as_its_inverse_does() -> None:
    cov, values, slopes = covariance(5), NOISE.normal(size=5), NOISE.normal(size=(5, 2))
    own = residual_of("repeated", list("abcde"), None, values, np.ones(5), cov)
    whole = stacked([[part("frequencies", 3), own]])
    alone = float(values @ np.linalg.solve(cov, values))
    frequencies = whole.values[:3]
    assert whole.misfit == pytest.approx(alone + frequencies @ frequencies)
    rows = own.independent(slopes)
    normal = rows.T @ (own.weights[:, None] * rows)
    np.testing.assert_allclose(normal, slopes.T @ np.linalg.solve(cov, slopes), rtol=1e-9)
    np.testing.assert_allclose(own.of_items(own.independent(values)), values, rtol=1e-9)
    # Values and derivatives stay those of the items.
    np.testing.assert_array_equal(own.values, values)


def test_an_entry_that_is_left_out_tells_nothing_of_the_others() -> None:
    cov, values = covariance(4), NOISE.normal(size=4)
    own = residual_of("repeated", list("abcd"), None, values, np.array([1.0, 0.0, 1.0, 1.0]), cov)
    kept = [0, 2, 3]
    least = values[kept] @ np.linalg.solve(cov[np.ix_(kept, kept)], values[kept])
    assert own.misfit == pytest.approx(least)


def test_a_covariance_that_is_none_is_refused() -> None:
    wrong = np.array([[1.0, 2.0], [2.0, 1.0]])
    with pytest.raises(CampaignError, match="not positive definite"):
        residual_of("repeated", ["a", "b"], None, np.zeros(2), np.ones(2), wrong)
