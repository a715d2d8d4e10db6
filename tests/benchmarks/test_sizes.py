"""The launcher in any size, at the smallest one, with real CalculiX."""

from __future__ import annotations

import json

import pytest
from benchmarks.sizes import N_MODES, main

from tests.adapters.solved import needs_ccx


@needs_ccx
@pytest.mark.parametrize("campaign", [False, pytest.param(True, marks=pytest.mark.nightly)])
def test_modes_and_the_campaign_of_a_size_are_told(
    campaign: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["18000", "--double", "--memory-gb", "8", *["--campaign"] * campaign])
    told, *ended, last = capsys.readouterr().out.splitlines()
    assert told.startswith("18,000 degrees of freedom, 29,931 equations: matrices ")
    assert [line.startswith("  campaign: ") for line in ended] == [True] * campaign
    (found,) = json.loads(last)
    assert len(found["frequencies_hz"]) == N_MODES
    # Within 7e-10 was seen; residuals of 2e-6 allow some 1e-6 and promise their square.
    assert found["difference"] < 1e-7
    assert 0 < found["peak_bytes"] < 8e9
    if campaign:
        assert found["campaign"]["status"] == "converged"
        assert found["campaign"]["matrix_runs"] == 4


@pytest.mark.parametrize("size", ["100", "9000000"])
def test_a_size_that_cannot_be_made_is_told(size: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main([size])
    assert f"18000 to 5900000, not {size}" in capsys.readouterr().err
