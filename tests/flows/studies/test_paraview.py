"""Modes of a campaign for ParaView: which states, from what, and how many solver runs it takes."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from modetune.adapters.solver import Solver
from modetune.core.errors import CampaignError, NoResult, StorageUnavailable
from modetune.core.mesh import Mesh, global_shapes
from modetune.core.modes import Floats
from modetune.core.storage.campaign_record import write_record
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.cli.paraview import paraview as paraview_command
from modetune.flows.studies.paraview import (
    states_of,
    write_paraview,
    write_stored,
)
from modetune.flows.studies.run_source import RunSource, open_run
from modetune.flows.updating.update import update_campaign
from tests.adapters.solved import needs_ccx
from tests.flows.conftest import ChainDeck, ScriptedProgram, recased
from tests.flows.report.conftest import plate_record

TRUTH = {"k1": 1.2, "k2": 0.8}
#: A free strip of shells, 240 x 20 x 2 mm.
DECK = (
    "*NODE\n"
    + "".join(f"{10 * i + j}, {20.0 * i}, {20.0 * j}, 0.\n" for i in range(13) for j in (1, 2))
    + "*ELEMENT, TYPE=S4, ELSET=PLATE\n"
    + "".join(
        f"{i + 1}, {10 * i + 1}, {10 * i + 11}, {10 * i + 12}, {10 * i + 2}\n" for i in range(12)
    )
    + "*MATERIAL, NAME=M\n*ELASTIC\n70000., .3\n*DENSITY\n2.7e-9\n"
    + "*SHELL SECTION, ELSET=PLATE, MATERIAL=M\n2.\n"
)
CAMPAIGN = """name: strip
model: {deck: strip.inp, solver: calculix, units: mm-t-s}
test: {modes: measured.csv}
parameters:
  - {name: E, quantity: youngs_modulus, material: M}
update: {step: weighted_least_squares, e1: {frequency: 0.02, mac: 0.0}}
"""


@pytest.fixture
def strip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A campaign's file: the strip's first frequency measured 5 % above its closed form."""
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    (tmp_path / "strip.inp").write_text(DECK)
    # Free beam: 4.73^2 / 2 pi sqrt(E I / rho A L^4) = 181.7 Hz with E 70 GPa, 2 mm and 240 mm.
    (tmp_path / "measured.csv").write_text("mode, 1\nfrequency_hz, 191.0\n")
    (tmp_path / "strip.yaml").write_text(CAMPAIGN)
    return tmp_path / "strip.yaml"


def runs(campaign: Any) -> int:
    """Results in the store of a campaign: solver runs that were ever good."""
    return len(list(campaign.store.folder.glob("??/*.h5")))


def shapes_of(series: Path) -> tuple[list[float], list[Floats]]:
    """Frequencies and shapes of all modes in a .pvd file."""
    import pyvista  # a second and a half

    reader = pyvista.PVDReader(series)
    frequencies, shapes = [], []
    for time in reader.time_values:
        reader.set_active_time_value(time)
        grid = reader.read()[0]
        assert isinstance(grid, pyvista.UnstructuredGrid)
        frequencies.append(float(grid.field_data["frequency_hz"][0]))
        shapes.append(np.asarray(grid["mode_shape"]))
    return frequencies, shapes


@needs_ccx
def test_before_and_after_take_one_run_each_and_none_again(
    strip: Path, watcher: Any, tmp_path: Path
) -> None:
    run = update_campaign(load_campaign(strip), tmp_path / "runs" / "strip", watcher)
    assert run.record.status == "converged"
    source = open_run(strip, [], tmp_path / "runs")
    before = runs(source.campaign)
    written = write_paraview(source.campaign, states_of(source, "both"), tmp_path / "out")
    assert [(item.state, item.ran, item.converted) for item in written] == [
        ("initial", True, True),
        ("updated", True, True),
    ]
    assert runs(source.campaign) - before == 2
    # Good jobs leave no folder, as everywhere.
    assert list((source.campaign.store.folder / "jobs").iterdir()) == []
    again = write_paraview(source.campaign, states_of(source, "both"), tmp_path / "again")
    assert [(item.ran, item.converted) for item in again] == [(False, False)] * 2
    assert runs(source.campaign) - before == 2
    modulus = float(run.record.updated[0])
    initial_hz, _ = shapes_of(written[0].file)
    updated_hz, _ = shapes_of(written[1].file)
    # All frequencies go with the root of the one modulus; the first six are rigid.
    ratio = np.array(updated_hz[6:]) / np.array(initial_hz[6:])
    np.testing.assert_allclose(ratio, modulus**0.5, rtol=1e-6)
    assert abs(updated_hz[6] / 191.0 - 1.0) < 0.02
    for first, second in zip(written, again, strict=True):
        (theirs_hz, theirs), (ours_hz, ours) = shapes_of(first.file), shapes_of(second.file)
        assert theirs_hz == ours_hz
        for one, other in zip(theirs, ours, strict=True):
            np.testing.assert_allclose(one, other, rtol=2e-5, atol=1e-6 * np.abs(other).max())


@needs_ccx
def test_a_damaged_result_file_is_told_and_its_remedy_works(strip: Path, tmp_path: Path) -> None:
    source = open_run(strip, ["run.keep_jobs=true"], tmp_path / "runs")
    states = states_of(source, "initial")
    write_paraview(source.campaign, states, tmp_path / "out")
    (frd,) = source.campaign.store.folder.glob("jobs/*/job.frd")  # kept, as the campaign says
    frd.write_text(frd.read_text()[:-2000])
    with pytest.raises(NoResult, match=r"job\.frd ends before its closing line: remove its folder"):
        write_paraview(source.campaign, states, tmp_path / "out")
    assert len(shapes_of(tmp_path / "out" / "initial.pvd")[0]) == source.campaign.case.n_modes
    shutil.rmtree(frd.parent)
    (item,) = write_paraview(source.campaign, states, tmp_path / "out")
    assert (item.ran, item.converted) == (False, False)


@needs_ccx
def test_the_command_takes_a_run_folder_and_finds_its_campaign(
    strip: Path, watcher: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "runs" / "strip"
    update_campaign(load_campaign(strip), folder, watcher)
    monkeypatch.chdir("/")
    said = invoke(str(folder), "--state", "updated", "--json")
    assert said.exit_code == 0
    (series,) = json.loads(said.output)["series"]
    assert series == {
        "state": "updated", "file": str(folder / "paraview" / "updated.pvd"), "modes": 11,
        "solver_runs": 1, "converter": "ccx2paraview",
    }  # fmt: skip
    strip.write_text(CAMPAIGN + "# changed\n")
    with pytest.raises(CampaignError, match="name the campaign file instead of the folder"):
        open_run(folder, [], tmp_path / "runs")


@needs_ccx
def test_a_campaign_that_was_never_run_has_its_initial_model(strip: Path, tmp_path: Path) -> None:
    said = invoke(str(strip), "--out", str(tmp_path / "out"), "--runs", str(tmp_path / "runs"))
    assert said.exit_code == 0
    assert "initial.pvd  11 modes, one solver run" in said.output
    assert "has not been run, so there is no updated model yet" in said.output
    source = open_run(strip, [], tmp_path / "runs")
    with pytest.raises(CampaignError, match=r"campaign\.h5 is not there.*modetune update"):
        states_of(source, "updated")
    with pytest.raises(
        CampaignError, match="--state 'after': expected one of initial, updated, both"
    ):
        states_of(source, "after")


def test_a_folder_without_a_record_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CampaignError, match=r"campaign\.h5"):
        open_run(tmp_path, [], tmp_path)


def test_other_solvers_are_written_from_mesh_and_result(bench: Any, watcher: Any) -> None:
    campaign = bench.campaign(TRUTH, shapes=True)
    run = update_campaign(campaign, bench.folder / "base", watcher)
    source = RunSource(campaign, run.record, run.folder)
    before = bench.runs()
    written = write_paraview(campaign, states_of(source, "both"), bench.folder / "out")
    # The campaign asked for the same nodes, all of them: the store has both.
    assert bench.runs() == before
    assert [item.ran for item in written] == [False, False]
    _, shapes = shapes_of(written[1].file)
    computed = run.record.best.computed
    expected = global_shapes(campaign.case.solver.deck.mesh(), computed)
    pairs = run.record.best.pairing.computed.tolist()
    assert len(pairs) == 5
    for mode in pairs:  # the chain has no rigid modes that would stand before
        np.testing.assert_allclose(shapes[mode], expected[mode])


def test_another_campaign_than_the_records_is_refused(
    bench: Any, watcher: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    run = update_campaign(bench.campaign(TRUTH), tmp_path / "runs" / "chain", watcher)
    other = bench.campaign({"k3": 1.1})
    monkeypatch.setattr("modetune.flows.studies.run_source.load_campaign", lambda *rest: other)
    with pytest.raises(CampaignError, match=r"has the parameters k1, k2, but .* has k3"):
        open_run(bench.folder / "chain.yaml", [], run.folder.parent)


def test_a_model_without_geometry_is_refused_before_any_run(bench: Any) -> None:
    campaign = bench.campaign(TRUTH)

    class Empty(ChainDeck):
        def mesh(self) -> Mesh:
            return Mesh(np.zeros(0, np.int64), np.zeros((0, 3)), ())

    solver = Solver(Empty(), ScriptedProgram(bench.folder, name="matrices"))
    with pytest.raises(CampaignError, match="solver matrices has no elements"):
        write_paraview(recased(campaign, solver=solver), {"initial": {}}, bench.folder / "out")
    assert bench.runs() == 0


def test_a_place_that_cannot_be_written_is_told_before_any_run(bench: Any) -> None:
    (bench.folder / "file").write_text("")
    with pytest.raises(StorageUnavailable, match="name another place with --out"):
        write_paraview(bench.campaign(TRUTH), {"initial": {}}, bench.folder / "file" / "out")
    assert bench.runs() == 0


def invoke(*arguments: str) -> Any:
    app = typer.Typer()
    app.command()(paraview_command)
    return CliRunner().invoke(app, list(arguments))


def test_stored_shapes_are_written_without_a_run_and_without_the_campaign(
    tmp_path: Path,
) -> None:
    record = plate_record()
    folder = tmp_path / "elsewhere"
    write_record(folder / "campaign.h5", record)
    result = invoke(str(folder), "--stored", "--json")
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)["series"]
    assert [(item["state"], item["modes"], item["solver_runs"]) for item in told] == [
        ("initial", 3, 0),
        ("updated", 3, 0),
    ]
    import pyvista  # a second and a half

    grid = pyvista.read(folder / "paraview" / "updated" / "mode_2.vtu")
    assert grid.field_data["frequency_hz"][0] == pytest.approx(22.022)  # 22 Hz and 0.1 %
    kept = record.best.field.mode_shapes[:, 1].reshape(-1, 3)
    np.testing.assert_allclose(grid.point_data["mode_shape"], kept, atol=1e-12)
    assert record.surface is not None
    np.testing.assert_array_equal(grid.point_data["node"], record.surface.nodes)


def test_stored_shapes_require_a_record_that_has_them(tmp_path: Path) -> None:
    write_record(tmp_path / "campaign.h5", replace(plate_record(), surface=None))
    with pytest.raises(CampaignError, match="keeps no shapes on a surface"):
        write_stored(tmp_path, "both", None)
