"""Where a design speaks against the linear choice, and where it has too few points to rank."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.solver import Analysis, ModalAnalysis, Solver
from modetune.core.errors import ModesError
from modetune.core.parameters import Values
from modetune.core.updating.job_results import ModalResult, Result
from modetune.flows.studies.screen import summary as screen_summary
from modetune.flows.studies.screen.record import Screening
from modetune.flows.studies.screen.request import ScreeningRequest
from modetune.flows.studies.screen.screening import screen_campaign
from modetune.flows.studies.screen.summary import lines, notes, summary, tables
from modetune.flows.updating.forecast import Unwatched
from tests.flows.conftest import Bench, ChainDeck, ScriptedProgram, recased


def screened(bench: Bench, request: ScreeningRequest) -> Screening:
    campaign = bench.campaign({"k1": 1.3, "k3": 0.9}, modes=(1, 2))
    return screen_campaign(campaign, request, Unwatched().working)


def with_measure(found: Screening, **measures: float) -> Screening:
    """The screening with some measures of the second mode and the first parameter made up."""
    assert found.indices is not None
    values = found.indices.values.copy()
    for name, value in measures.items():
        values[found.indices.measures.index(name), 1, 0] = value
    return replace(found, indices=replace(found.indices, values=values))


def test_what_a_plane_does_not_explain_is_told(bench: Bench) -> None:
    found = screened(bench, ScreeningRequest("lhs", points=8))
    assert notes(found) == []  # springs of a chain act nearly straight
    assert found.indices is not None
    bent = replace(found, indices=replace(found.indices, explained=np.array([0.9, 0.15])))
    assert notes(bent) == [
        "mode 2: a linear model explains 15 % of its variance, so the choice, made by a linear "
        "model, may not hold over the whole bounds"
    ]
    assert summary(bent)["notes"] == notes(bent)
    assert f"note: {notes(bent)[0]}" in lines(bent)


def test_effects_that_depend_on_the_place_are_told(bench: Bench) -> None:
    # By 48 points sigma is 0.9 of mu* where k3 acts least, by 12 on either side: not by this seed.
    found = screened(bench, ScreeningRequest("morris", points=12, seed=2))
    assert notes(found) == []
    (note,) = notes(with_measure(found, mu_star=0.2, sigma=0.3))
    assert note.startswith("mode 2: sigma exceeds mu* of k1, so the choice, made by a linear model")
    assert notes(with_measure(found, mu_star=1e-9, sigma=2e-9)) == []  # it has no say


def test_wide_intervals_of_sobol_indices_ask_for_more_points(bench: Bench) -> None:
    found = screened(bench, ScreeningRequest("sobol", points=32))  # 8 base samples of 4 points
    assert found.indices is not None
    values = found.indices.values.copy()
    values[found.indices.measures.index("total_confidence")] = 0.05
    narrow = replace(found, indices=replace(found.indices, values=values))
    settled = with_measure(with_measure(narrow, first=1.0), total_confidence=0.1)
    assert not [note for note in notes(settled) if "too wide" in note]
    # Twice too wide takes four times the points.
    assert notes(with_measure(narrow, total_confidence=0.2))[-1] == (
        "total indices have intervals of up to +-0.2, too wide for a ranking: use --points 128"
    )


def test_variance_that_no_parameter_alone_explains_is_told(bench: Bench) -> None:
    found = screened(bench, ScreeningRequest("sobol", points=32))
    assert found.indices is not None
    other = float(found.indices.measure("first")[1, 1])
    told_of = notes(with_measure(found, first=0.3 - other))
    assert any(
        "mode 2: the parameters without interactions explain 30 % of" in note for note in told_of
    )


def test_more_than_the_candidates_cannot_be_chosen_and_that_is_told(bench: Bench) -> None:
    found = screened(bench, ScreeningRequest("local", choose=5))
    assert notes(found) == ["--choose 5: only 2 proposed, because there are 2 candidates"]
    assert notes(screened(bench, ScreeningRequest("local", choose=2))) == []


class SmallProgram(ScriptedProgram):
    """Has one mode and no more where the first spring is stiff, and calls itself `matrices`."""

    def read(self, deck: Values, analysis: Analysis, folder: Path, return_code: int) -> Result:
        result = super().read(deck, analysis, folder, return_code)
        assert isinstance(result, ModalResult)
        assert isinstance(analysis, ModalAnalysis)
        if deck["k1"] < 1.65:  # the middle of the bounds: two of the four strata are stiff
            return result
        return ModalResult(
            result.eigenvalues[:1],
            result.modes.select(np.array([0])),
            result.groups,
            result.strain_energies[:, :1],
            result.total_strain_energy[:1],
            result.mass,
        )


def test_a_model_that_has_no_more_modes_is_not_asked_for_more(
    bench: Bench, caplog: pytest.LogCaptureFixture
) -> None:
    campaign = bench.campaign({"k1": 1.2, "k3": 0.9}, modes=(1, 2))
    small = Solver(ChainDeck(), SmallProgram(bench.folder, name="matrices"))
    with caplog.at_level(logging.INFO), pytest.raises(ModesError, match="2 of 4 points failed"):
        screen_campaign(
            recased(campaign, solver=small), ScreeningRequest("lhs", points=4), Unwatched().working
        )
    assert bench.runs() == 1 + 4  # the deck's values and the points, none of them twice
    assert "widening" not in caplog.text


def test_tables_that_have_not_all_modes_say_so(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = screened(bench, ScreeningRequest("morris", points=12, seed=2))
    n = len(found.modes)
    assert not any("the first" in table.title for table in tables(found))
    monkeypatch.setattr(screen_summary, "SHOWN", n - 1)
    titles = [table.title for table in tables(found) if "the first" in table.title]
    assert len(titles) >= 2
    assert all(title.endswith(f"the first {n - 1} of {n} test modes") for title in titles)
