"""Whole screenings with the scripted solver: closed forms, runs counted, failures."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import get_args

import h5py
import numpy as np
import pytest
from rich.console import Console
from scipy import special

from modetune.adapters.solver import Analysis, ModalAnalysis, Solver
from modetune.core.errors import CampaignError, ModesError, SolverError
from modetune.core.modes import Floats
from modetune.core.parameters import Values
from modetune.core.storage.codec import write_value
from modetune.core.storage.sealed_file import sealed
from modetune.core.updating.job_results import ModalResult, Result
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.runner import PoolRunner, Task, TaskRun
from modetune.flows.jobs.tasks import StudyRun, use_run
from modetune.flows.report.matplotlib_charts import save_all
from modetune.flows.studies.screen.figures import screening_charts
from modetune.flows.studies.screen.record import SCREENING, Screening
from modetune.flows.studies.screen.request import ScreeningMethod, ScreeningRequest
from modetune.flows.studies.screen.screening import screen_campaign
from modetune.flows.studies.screen.summary import lines, summary, tables
from modetune.flows.updating.forecast import Unwatched
from tests.core.storage.test_sealed_file import refused_when_damaged
from tests.flows.conftest import Bench, ChainDeck, ScriptedProgram, chain_modes, recased
from tests.flows.studies.screen.conftest import series_hz

ONE = np.ones(1)


class ShortProgram(ScriptedProgram):
    """Gives the last mode in place of all but the first where the first spring is stiff, until
    asked for more."""

    def read(self, deck: Values, analysis: Analysis, folder: Path, return_code: int) -> Result:
        result = super().read(deck, analysis, folder, return_code)
        assert isinstance(result, ModalResult)
        assert isinstance(analysis, ModalAnalysis)
        if deck["k1"] < 1.65 or analysis.n_modes > 2 + 10:  # two measured, ten to spare
            return result
        kept = np.append(0, np.full(analysis.n_modes - 1, result.eigenvalues.size - 1))
        return ModalResult(
            result.eigenvalues[kept],
            result.modes.select(kept),
            result.groups,
            result.strain_energies[:, kept],
            result.total_strain_energy[kept],
            result.mass,
        )


def screened(campaign: Campaign, method: ScreeningMethod, **asked: int) -> Screening:
    return screen_campaign(campaign, ScreeningRequest(method, **asked), Unwatched().working)


def relative(points: Floats) -> Floats:
    """The closed form of the series system, relative to its nominal frequency."""
    return np.asarray(series_hz(*points.T) / series_hz(ONE, ONE, ONE) - 1.0)


def test_local_sensitivities_of_springs_in_series_are_shares_of_their_flexibility(
    series: Campaign,
) -> None:
    found = screened(series, "local")
    # f = sqrt(k / m) / 2 pi with 1 / k = 1 / k1 + 1 / k2: half the share of 1 / k, and -1/2.
    np.testing.assert_allclose(found.local.frequencies, [[0.125, 0.375, -0.5]], rtol=1e-5)
    assert found.indices is None
    assert len(found.responses.failures) == 0
    assert found.runs.modal == 1
    assert found.runs.sensitivity == 6  # central differences


def test_sobol_indices_of_springs_in_series_are_those_of_quadrature(series: Campaign) -> None:
    found = screened(series, "sobol", points=32 * 5)
    assert found.indices is not None
    nodes, weights = special.roots_legendre(12)
    nodes, weights = 1.0 + 0.5 * nodes, 0.5 * weights
    grid = np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), axis=-1).reshape(-1, 3)
    y, w = relative(grid).reshape(12, 12, 12), weights
    mean = np.einsum("ijk,i,j,k", y, w, w, w)
    total = np.einsum("ijk,i,j,k", (y - mean) ** 2, w, w, w)
    alone = [
        np.einsum(f"ijk,{rest}->{own}", y, w, w) - mean
        for own, rest in (("i", "j,k"), ("j", "i,k"), ("k", "i,j"))
    ]
    first = np.array([part**2 @ w for part in alone]) / total
    np.testing.assert_allclose(found.indices.measure("first")[0], first, atol=0.12)
    # Nearly additive: interactions are what first indices leave, so totals are little more.
    assert first.sum() > 0.95
    np.testing.assert_allclose(found.indices.measure("total")[0], first, atol=0.12)


def test_morris_ranks_springs_in_series_as_their_closed_form(series: Campaign) -> None:
    found = screened(series, "morris", points=48)
    assert found.indices is not None
    design = found.design
    effects = np.diff(relative(design.points).reshape(-1, 4), axis=1)
    moved = np.diff(design.points.reshape(-1, 4, 3), axis=1)
    expected = [
        np.abs(effects / moved.sum(axis=2))[moved[:, :, place] != 0.0].mean() for place in range(3)
    ]
    np.testing.assert_allclose(found.indices.measure("mu_star")[0], expected, rtol=1e-9)
    assert [found.names[place] for place in found.choice.ranking] == ["m1", "k2", "k1"]


def test_springs_of_a_chain_share_one_half_in_every_mode(bench: Bench) -> None:
    names = {f"k{place}": 1.0 for place in range(1, 8)}
    found = screened(bench.campaign({**names, "k2": 1.3}), "local")
    # Eigenvalues are homogeneous of degree one in all springs together (Euler).
    np.testing.assert_allclose(found.local.frequencies.sum(axis=1), 0.5, rtol=1e-6)
    assert bench.runs() == 1  # strain energies: no sensitivity job


def test_slopes_of_mac_are_those_of_differences(bench: Bench) -> None:
    truth = {"k1": 1.4, "k3": 0.7, "k5": 1.2}
    found = screened(bench.campaign(truth, modes=(1, 2, 3), shapes=True), "local")
    test = chain_modes(truth)[1]

    def macs(values: dict[str, float]) -> Floats:
        shapes = chain_modes(values)[1]
        cosines = (test * shapes).sum(axis=0) ** 2
        return np.asarray(cosines / ((test**2).sum(axis=0) * (shapes**2).sum(axis=0)))[:3]

    for place, name in enumerate(truth):
        slope = (macs({name: 1.0 + 1e-5}) - macs({name: 1.0 - 1e-5})) / 2e-5
        np.testing.assert_allclose(found.local.mac[:, place], slope, atol=1e-7)


@pytest.mark.parametrize("method", get_args(ScreeningMethod))
def test_the_same_screening_again_starts_no_solver(bench: Bench, method: ScreeningMethod) -> None:
    campaign = bench.campaign({"k1": 1.2, "k3": 0.9}, modes=(1, 2, 3), shapes=True)
    asked = {} if method == "local" else {"points": 32 if method == "sobol" else 9}
    first = screened(campaign, method, **asked)
    ran = bench.runs()
    assert ran == first.runs.modal + first.runs.sensitivity
    again = screened(campaign, method, **asked)
    assert bench.runs() == ran
    assert (again.runs.modal, again.runs.sensitivity) == (0, 0)
    np.testing.assert_array_equal(again.importance, first.importance)
    np.testing.assert_array_equal(again.responses.frequencies_hz, first.responses.frequencies_hz)


class Impatient(PoolRunner):
    """A runner that is interrupted when six of its pieces with jobs have ended."""

    def __init__(self) -> None:
        super().__init__(2)
        self.begun: list[TaskRun] = []

    def submit(self, name: str, task: Task, after: Sequence[TaskRun]) -> TaskRun:
        run = super().submit(name, task, after)
        if task.jobs:
            self.begun.append(run)
        if len(self.begun) == 12:
            for early in self.begun[:6]:
                early.result()
            raise KeyboardInterrupt
        return run

    def wait(self) -> None:
        """Wait until no piece is under way."""
        for task in self.begun:
            task.wait(10.0)


def test_a_stopped_screening_goes_on_where_it_was(bench: Bench) -> None:
    campaign = bench.campaign({"k1": 1.2, "k3": 0.9}, modes=(1, 2, 3))
    request = ScreeningRequest("lhs", points=60)  # so many that a stop cannot come too late
    runner = Impatient()
    with pytest.raises(KeyboardInterrupt), use_run(StudyRun(runner)):
        screen_campaign(campaign, request, Unwatched().working)
    runner.wait()
    kept = sum(1 for _ in campaign.store.folder.glob("??/*.h5"))
    before = bench.runs()
    assert 6 <= kept < 61  # the nominal model and the points that were done
    found = screen_campaign(campaign, request, Unwatched().working)
    assert bench.runs() - before == 61 - kept
    assert found.runs.modal == 61 - kept
    assert not any(found.responses.failures)


def test_a_failed_point_takes_its_trajectory_along_and_is_told(bench: Bench) -> None:
    campaign = bench.campaign({"k1": 1.2, "k3": 0.9}, modes=(1, 2))
    bench.script({5: "rejected"})  # the first run is the nominal model's
    found = screened(campaign, "morris", points=30, levels=50)
    assert found.indices is not None
    assert found.responses.n_failed == 1
    assert found.indices.used == 27
    said = "\n".join(lines(found))
    assert "1 of 30 points failed; 1 of 10 trajectories are left out" in said
    assert "the scripted solver refused its input" in said
    assert np.isnan(found.responses.frequencies_hz).any(axis=1).sum() == 1


def test_a_mode_that_is_lost_at_points_widens_the_range_there(bench: Bench) -> None:
    campaign = bench.campaign({"k1": 1.2, "k3": 0.9}, modes=(1, 2))
    short = Solver(ChainDeck(), ShortProgram(bench.folder))
    found = screen_campaign(
        recased(campaign, solver=short), ScreeningRequest("lhs", points=4), Unwatched().working
    )
    assert found.responses.n_failed == 0
    # The deck's values, four points, and the two stiff ones once more: 1.65 is their middle.
    assert bench.runs() == found.runs.modal == 1 + 4 + 2
    expected = [
        np.sqrt(chain_modes({"k1": a, "k3": b})[0][:2]) / 2 / np.pi
        for a, b in found.design.points.tolist()
    ]
    np.testing.assert_allclose(found.responses.frequencies_hz, expected)


def test_failed_points_of_a_hypercube_are_left_out_and_told(bench: Bench) -> None:
    campaign = bench.campaign({"k1": 1.2, "k3": 0.9}, modes=(1, 2))
    bench.script({3: "rejected"})
    found = screened(campaign, "lhs", points=8)
    assert found.indices is not None
    assert found.indices.used == 7
    assert "1 of 8 points failed; they are left out. First failure: " in "\n".join(lines(found))


def test_a_killed_point_is_tried_again(bench: Bench) -> None:
    campaign = bench.campaign({"k1": 1.2, "k3": 0.9}, modes=(1, 2), retries=1)
    bench.script({4: "killed"})
    found = screened(campaign, "lhs", points=4)
    assert found.responses.n_failed == 0
    assert bench.runs() == 1 + 4 + 1


def test_a_screening_of_which_too_little_is_left_ends_with_one_sentence(bench: Bench) -> None:
    campaign = bench.campaign({"k1": 1.2, "k3": 0.9}, modes=(1, 2))
    bench.script({run: "rejected" for run in range(2, 6)})
    with pytest.raises(ModesError, match=r"4 of 4 points failed .* narrow the bounds"):
        screened(campaign, "lhs", points=4)


def test_a_nominal_model_that_fails_ends_the_screening(bench: Bench) -> None:
    campaign = bench.campaign({"k1": 1.2}, modes=(1, 2))
    bench.script({1: "rejected"})
    with pytest.raises(SolverError, match="refused its input"):
        screened(campaign, "lhs", points=10)
    assert bench.runs() == 1


def test_a_design_that_cannot_be_starts_no_solver(bench: Bench) -> None:
    with pytest.raises(CampaignError, match="at least 6"):
        screened(bench.campaign({"k1": 1.2, "k2": 1.0}), "morris", points=5)
    assert bench.runs() == 0


@pytest.mark.parametrize("method", get_args(ScreeningMethod))
def test_a_screening_is_read_as_it_was_written_shown_and_drawn(
    bench: Bench, method: ScreeningMethod, tmp_path: Path
) -> None:
    campaign = bench.campaign({"k1": 1.3, "k3": 0.9, "k6": 1.1}, modes=(1, 2, 3), shapes=True)
    asked = {} if method == "local" else {"points": 40 if method == "sobol" else 8}
    found = screened(campaign, method, **asked)
    path = tmp_path / "screening.h5"
    SCREENING.write(path, found)
    again = SCREENING.read(path)
    assert summary(again) == summary(found)
    assert again.response_names == found.response_names
    for name in ("points", "blocks", "lower", "upper"):
        np.testing.assert_array_equal(getattr(again.design, name), getattr(found.design, name))
    np.testing.assert_array_equal(again.responses.mac, found.responses.mac)
    np.testing.assert_array_equal(again.local.weighted, found.local.weighted)
    console = Console(file=io.StringIO(), width=160)
    for table in tables(again):
        console.print(table)
    shown = console.file.getvalue()  # type: ignore[attr-defined]
    assert all(name in shown for name in found.names)
    for figure in save_all(screening_charts(again), tmp_path / "figures"):
        assert figure.read_bytes().startswith(b"\x89PNG")


def test_a_record_of_format_6_is_read_unless_it_is_a_factorial(
    bench: Bench, tmp_path: Path
) -> None:
    found = screened(bench.campaign({"k1": 1.3, "k3": 0.9}, modes=(1, 2)), "lhs", points=8)
    path = tmp_path / "screening.h5"

    def stored(method: str) -> None:
        def older(file: h5py.File) -> None:
            write_value(file, found)
            file["indices/interactions"] = np.zeros((0, 0, 0))
            file["design"].attrs["method"] = method

        path.write_bytes(sealed(f"{SCREENING.title}6", older))

    stored("lhs")
    assert summary(SCREENING.read(path)) == summary(found)
    stored("factorial")
    with pytest.raises(CampaignError, match="factorial screenings were removed"):
        SCREENING.read(path)


def test_every_damage_to_the_record_is_refused_before_hdf5_sees_it(
    bench: Bench, tmp_path: Path
) -> None:
    found = screened(bench.campaign({"k1": 1.3, "k3": 0.9}, modes=(1, 2)), "local")
    SCREENING.write(tmp_path / "screening.h5", found)
    refused_when_damaged(tmp_path / "screening.h5", SCREENING.read)


@pytest.mark.parametrize("shapes", [(True, True), (True, False), (False, False)])
def test_two_configurations_of_one_model_say_what_it_says_twice(
    bench: Bench, tmp_path: Path, shapes: tuple[bool, bool]
) -> None:
    full, empty = (
        bench.campaign({"k1": 1.3, "k3": 0.9}, modes=(1, 2), shapes=one).case for one in shapes
    )
    alone = bench.campaign({"k1": 1.3, "k3": 0.9}, modes=(1, 2), shapes=shapes[0])
    cases = (replace(full, name="full"), replace(empty, name="empty"))
    one, both = (screened(item, "lhs", points=12) for item in (alone, replace(alone, cases=cases)))
    assert both.modes == ("mode 1 of full", "mode 2 of full", "mode 1 of empty", "mode 2 of empty")
    np.testing.assert_array_equal(
        both.responses.frequencies_hz, np.tile(one.responses.frequencies_hz, 2)
    )
    np.testing.assert_allclose(
        both.local.frequencies, np.tile(one.local.frequencies, (2, 1)), rtol=1e-12
    )
    if shapes[0]:
        again = one.local.mac if shapes[1] else np.zeros(one.local.mac.shape)
        np.testing.assert_allclose(both.local.mac, np.vstack([one.local.mac, again]), atol=1e-12)
    # Each response counts twice, where the second test has it too.
    if shapes[0] == shapes[1]:
        np.testing.assert_allclose(both.importance, np.sqrt(2.0) * one.importance, rtol=1e-9)
    assert both.choice.ranking == one.choice.ranking
    SCREENING.write(tmp_path / "screening.h5", both)
    read = SCREENING.read(tmp_path / "screening.h5")
    assert read.configurations == ("full", "full", "empty", "empty")
    assert save_all(screening_charts(read), tmp_path / "figures")


def test_a_file_that_is_no_screening_is_told(tmp_path: Path) -> None:
    path = tmp_path / "screening.h5"
    path.write_text("no HDF5")
    with pytest.raises(CampaignError, match="is not a record of a screening"):
        SCREENING.read(path)
