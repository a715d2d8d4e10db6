"""`modetune localise`: what it finds on the scripted chain and on solids, and what it costs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.core.errors import CampaignError
from modetune.core.mesh import Mesh
from modetune.core.modes import mode_set
from modetune.core.storage.campaign_record import read_record
from modetune.core.surface import Surface
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.cli.command import command_of
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.job import Job
from modetune.flows.report.form_verdict import record_verdict, verdict_summary
from modetune.flows.report.matplotlib_charts import save, save_all
from modetune.flows.studies.catalogue import find_study
from modetune.flows.studies.localise.error_maps import OTHER_MASS, OTHER_STIFFNESS
from modetune.flows.studies.localise.figures import localisation_figures, on_surface, surface_figure
from modetune.flows.studies.localise.localisation import (
    ExaminedState,
    Localisation,
    examined_state,
    localise,
    one_model,
)
from modetune.flows.studies.study import ModelState
from modetune.flows.updating.mode_source import campaign_analysis
from modetune.flows.updating.update import update_campaign
from tests.command_line import run_command

SIX_MASS = Path(__file__).resolve().parents[3] / "configs" / "six_mass"
ALL = dict.fromkeys([f"k{number}" for number in range(1, 8)], "spring_stiffness")
THREE = dict.fromkeys(["k1", "k4", "k6"], "spring_stiffness")

needs_mystran = pytest.mark.skipif(
    shutil.which("mystran") is None, reason="MYSTRAN is not here (tools/mystran.sh)"
)
needs_ccx = pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX (ccx) is not here")


@pytest.fixture
def app() -> typer.Typer:
    app = typer.Typer()
    app.callback()(lambda: None)
    app.command()(command_of(find_study("localise")))
    return app


def test_the_wrong_spring_is_named_with_its_error_and_the_runs_it_took(bench: Any) -> None:
    campaign = bench.campaign({"k5": 1.3}, shapes=True, parameters=ALL)
    found = localise(campaign)
    assert found.maps is not None
    errors = found.maps.errors
    first = int(errors.ranking[0])
    assert found.maps.groups[first] == "k5"
    # A test without noise at all masses: its forces are those of the spring alone, pulled towards
    # none by the deviation of 2 % that the campaign gives its shapes.
    assert errors.force_shares[first] == pytest.approx(1.0, abs=0.03)
    assert errors.changes[first] == pytest.approx(0.3, abs=0.03)
    assert int(np.argmax(errors.error_shares)) == first
    assert found.singles[0].members == (4,)
    assert found.singles[0].removed > 0.95
    # One modal run, the model's matrices and two of springs that share no mass; nothing twice.
    assert (bench.runs("modal"), bench.runs("matrices")) == (1, 3)
    assert (found.runs.modal, found.runs.sensitivity) == (1, 3)
    again = localise(campaign)
    assert bench.runs() == 4
    assert (again.runs.modal, again.runs.sensitivity) == (0, 0)


def test_the_strain_of_the_error_lies_at_the_ends_of_the_wrong_spring(bench: Any) -> None:
    # Spring 5 holds masses 4 and 5; springs 1 and 7 hold walls, which are not nodes.
    found = localise(bench.campaign({"k5": 1.3}, shapes=True, parameters=ALL))
    assert found.maps is not None
    worst = found.maps.mesh_nodes[np.argsort(-found.maps.strains)[:2]]
    assert set(worst.tolist()) == {4, 5}


def test_an_error_outside_all_parameters_is_found_in_what_no_parameter_scales(bench: Any) -> None:
    found = localise(bench.campaign({"k5": 1.5}, shapes=True, parameters=THREE))
    assert found.maps is not None
    assert found.maps.groups == ("k1", "k4", "k6", OTHER_STIFFNESS, OTHER_MASS)
    assert found.maps.errors.error_shares[3] == max(found.maps.errors.error_shares)


def test_without_shapes_parameters_are_ranked_and_the_reason_is_told(bench: Any) -> None:
    found = localise(bench.campaign({"k5": 1.3}, parameters=ALL))
    assert found.maps is None
    assert "measured shapes" in found.why_no_maps
    assert found.singles[0].removed > 0.5
    assert bench.runs("matrices") == 0  # strain energies of the one modal run are enough


def test_a_spring_that_no_parameter_has_is_forecast_and_judged_as_model_form_error(
    bench: Any, watcher: Any, tmp_path: Path
) -> None:
    campaign = bench.campaign({"k5": 1.5}, shapes=True, parameters=THREE)
    forecast = localise(campaign)
    assert forecast.form.suspected
    assert "are expected to explain" in forecast.sentence
    record = update_campaign(campaign, tmp_path / "run", watcher).record
    verdict = record_verdict(record)
    assert verdict is not None
    assert verdict.form.suspected
    assert "No parameter values within the bounds explain the test" in verdict.sentence
    # With the record the statement is the record's own; without it, the sensitivity is that of
    # the end, not of a step before, so the numbers differ a little.
    state = examined_state(campaign, None, None, tmp_path / "run")
    assert localise(campaign, state).form.statistic == verdict.form.statistic
    at_end = localise(campaign, ExaminedState(record.updated))
    assert at_end.form.suspected
    assert verdict.form.statistic == pytest.approx(at_end.form.statistic, rel=0.25)


def test_a_well_posed_twin_is_not_suspected_before_or_after(
    bench: Any, watcher: Any, tmp_path: Path
) -> None:
    campaign = bench.campaign({"k1": 1.2, "k4": 0.8, "k6": 1.1}, shapes=True)
    assert not localise(campaign).form.suspected
    record = update_campaign(campaign, tmp_path / "run", watcher).record
    verdict = record_verdict(record)
    assert verdict is not None
    assert not verdict.form.suspected
    told = verdict_summary(read_record(tmp_path / "run" / "campaign.h5"))
    assert isinstance(told, dict)
    assert told["suspected"] is False


def test_the_newest_run_is_examined_unless_another_state_is_named(
    bench: Any, watcher: Any, tmp_path: Path
) -> None:
    campaign, run = bench.campaign({"k1": 1.2, "k4": 0.8}, shapes=True), tmp_path / "run"
    before = examined_state(campaign, None, None, run)
    assert before.theta is None
    assert "forecast" in before.remarks[0]
    record = update_campaign(campaign, run, watcher).record
    ways: list[tuple[Path | None, ModelState | None]]
    ways = [(None, None), (None, "updated"), (run, None), (run / "campaign.h5", None)]
    for path, named in ways:
        state = examined_state(campaign, path, named, tmp_path / "other" if path else run)
        assert state.theta == pytest.approx(record.updated)
        assert state.text == f"the end of the update in {path or run}"
    assert examined_state(campaign, None, "initial", run).theta is None
    with pytest.raises(CampaignError, match="there is no update in"):
        examined_state(campaign, None, "updated", tmp_path / "other")
    with pytest.raises(CampaignError, match="--state initial the start"):
        examined_state(campaign, run, "initial", run)
    other = bench.campaign({"k2": 1.2}, shapes=True)
    with pytest.raises(CampaignError, match="has the parameters k1, k4"):
        examined_state(other, run / "campaign.h5", None, run)
    start = examined_state(other, None, None, run)
    assert start.theta is None
    assert "has the parameters k1, k4" in start.remarks[0]


def test_a_configuration_that_is_not_there_is_refused(bench: Any) -> None:
    with pytest.raises(CampaignError, match="the campaign has none"):
        one_model(bench.campaign({"k1": 1.2}), "full tanks")


def test_a_solver_that_refuses_its_input_ends_the_command(bench: Any) -> None:
    from modetune.core.errors import SolverRejected

    bench.script({1: "rejected"})
    with pytest.raises(SolverRejected):
        localise(bench.campaign({"k1": 1.2}, shapes=True))


def test_figures_are_written_for_what_was_found(bench: Any, tmp_path: Path) -> None:
    campaign = bench.campaign({"k5": 1.3}, shapes=True, parameters=ALL)
    found = localise(campaign)
    mesh, surface = campaign.case.solver.deck.mesh(), campaign.case.surface
    paths = save_all(localisation_figures("chain $x", found, mesh, surface), tmp_path / "figures")
    assert [path.name for path in paths] == ["removals.png", "groups.png", "map.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in paths)


@pytest.mark.parametrize("triangles", [np.array([[0, 1, 2]]), np.zeros((0, 3), dtype=np.int64)])
def test_a_flat_surface_and_bare_points_are_drawn(triangles: Any, tmp_path: Path) -> None:
    places = np.array([[0.0, 0.0, 5.0], [1.0, 0.0, 5.0], [0.0, 1.0, 5.0]])
    surface = Surface(np.arange(1, 4), places, triangles, np.zeros((0, 2), dtype=np.int64))
    path = save(surface_figure("flat", surface, np.array([0.0, 0.5, 1.0])), tmp_path / "map.png")
    assert path.read_bytes().startswith(b"\x89PNG")


def test_the_strain_at_a_thinned_surface_is_the_mean_square_of_what_it_stands_for() -> None:
    # Nodes at 0, 1 and 10; the surface keeps 0 and 10, so 0 stands for two: (9 + 1) / 2 = 5.
    places = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    mesh = Mesh(np.arange(1, 4), places, ())
    none = np.zeros((0, 2), dtype=np.int64)
    surface = Surface(np.array([1, 3]), places[[0, 2]], np.zeros((0, 3), dtype=np.int64), none)
    found = on_surface(np.array([3.0, 1.0, 2.0]), mesh, surface)
    assert found == pytest.approx([np.sqrt(5.0), 2.0])


def test_the_command_tells_machines_and_people(
    app: typer.Typer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("campaign.yaml", "six_mass.yaml", "measured.csv"):
        shutil.copyfile(SIX_MASS / name, tmp_path / name)
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    campaign = str(tmp_path / "campaign.yaml")
    folder = tmp_path / "figures"
    result = CliRunner().invoke(
        app, ["localise", campaign, "--no-prefect", "--json", "--figures", str(folder)]
    )
    assert result.exit_code == 0, result.output
    told = json.loads(result.stdout)
    assert told["status"] == "done"
    assert {item["name"] for item in told["maps"]["groups"]} >= {"k1", "k2", "k3", "k4"}
    assert len(told["pairs"]) == 6  # of four parameters
    assert told["maps"]["strains"] == []  # a model of matrices has no mesh
    drawn = [Path(path).name for path in told["written"]]
    assert drawn == ["removals.png", "groups.png", "proposals.png"]
    shown = CliRunner().invoke(app, ["localise", campaign, "--no-prefect"])
    assert shown.exit_code == 0, shown.output
    assert "Where the model is wrong" in shown.stdout
    assert "cached" in shown.stdout


#: A cantilever of solids in three materials, 300 x 20 x 10 mm, two elements across its width.
NX, NY, NZ = 15, 2, 1
CAMPAIGN = """name: bar
model: {deck: bar.inp, solver: calculix, units: mm-t-s}
test: {modes: measured.csv}
parameters:
  - {name: E_root, quantity: youngs_modulus, material: ROOT, bounds: [0.5, 1.5]}
  - {name: E_middle, quantity: youngs_modulus, material: MIDDLE, bounds: [0.5, 1.5]}
  - {name: E_tip, quantity: youngs_modulus, material: TIP, bounds: [0.5, 1.5]}
residuals: {shape_weight: 1.0, shape_deviation: 0.02}
"""


def node(i: int, j: int, k: int) -> int:
    return 1 + i + (NX + 1) * (j + (NY + 1) * k)


def bar_deck(shells: bool) -> str:
    """Of solids, or an angle of shells 2 mm thick along the lower and the front faces."""
    lines = ["*NODE, NSET=ALL"]
    for k in range(NZ + 1):
        for j in range(NY + 1):
            if j == 0 or k == 0 or not shells:
                lines += [
                    f"{node(i, j, k)}, {20.0 * i}, {10.0 * j}, {10.0 * k}" for i in range(NX + 1)
                ]
    square = ((0, 0), (1, 0), (1, 1), (0, 1))
    for place, name in enumerate(("ROOT", "MIDDLE", "TIP")):
        lines.append(f"*ELEMENT, TYPE={'S4' if shells else 'C3D8I'}, ELSET={name}")
        for i in range(5 * place, 5 * place + 5):
            kept = [[node(i + a, j + b, c) for c in (0, 1) for a, b in square] for j in range(NY)]
            if shells:
                kept = [corners[:4] for corners in kept]
                kept.append([node(i + a, 0, c) for a, c in square])
            for number, corners in enumerate(kept):
                lines.append(", ".join(map(str, [1 + i + NX * number, *corners])))
    for name in ("ROOT", "MIDDLE", "TIP"):
        kind = "SHELL" if shells else "SOLID"
        lines += [f"*MATERIAL, NAME={name}", "*ELASTIC", "70000., 0.3", "*DENSITY", "2.7e-9"]
        lines += [f"*{kind} SECTION, ELSET={name}, MATERIAL={name}", *(["2."] if shells else [])]
    lines.append("*BOUNDARY")
    held = [(j, k) for j in range(NY + 1) for k in range(NZ + 1) if j == 0 or k == 0 or not shells]
    lines += [f"{node(0, j, k)}, 1, {6 if shells else 3}" for j, k in held]
    return "\n".join(lines) + "\n"


def beam_deck() -> str:
    """The same length in bars along the edge that is node(i, 0, 0) and, joined to it, another."""
    lines = ["SOL 103", "CEND", "METHOD = 1", "SPC = 1", "BEGIN BULK", "EIGRL,1,,,10"]
    grids = [(node(i, j, 0), 20.0 * i, 10.0 * j) for j in (0, NY) for i in range(NX + 1)]
    lines += [f"GRID,{number},,{x},{y},0." for number, x, y in grids]
    for i in range(NX):
        for j in (0, NY):
            number = 1 + i + NX * j
            ends = f"{node(i, j, 0)},{node(i + 1, j, 0)}"
            lines.append(f"CBAR,{number},{1 + i // 5},{ends},0.,0.,1.")
        ends = f"{node(i + 1, 0, 0)},{node(i + 1, NY, 0)}"
        lines.append(f"CBAR,{100 + i},{1 + i // 5},{ends},0.,0.,1.")
    for number in (1, 2, 3):
        lines.append(f"PBAR,{number},{number},40.,500.,200.,400.")
        lines.append(f"MAT1,{number},70000.,,0.3,2.7-9")
    lines.append(f"SPC1,1,123456,{node(0, 0, 0)},{node(0, NY, 0)}")
    return "\n".join([*lines, "ENDDATA", ""])


@needs_ccx
@pytest.mark.parametrize(
    ("wrong", "shells"),
    [
        ("E_root", False),
        ("E_middle", False),
        ("E_tip", False),
        ("E_root", True),
        ("E_middle", True),
    ],
)
def test_the_wrong_third_of_a_bar_of_solids_or_shells_ranks_first_by_calculix(
    wrong: str, shells: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    (tmp_path / "bar.inp").write_text(bar_deck(shells))
    (tmp_path / "bar.yaml").write_text(CAMPAIGN)
    the_wrong_third_ranks_first(tmp_path, wrong)


@needs_mystran
def test_the_wrong_third_of_a_beam_ranks_first_by_mystran(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    (tmp_path / "bar.bdf").write_text(beam_deck())
    told = CAMPAIGN.replace("deck: bar.inp, solver: calculix", "deck: bar.bdf, solver: mystran")
    for number, name in enumerate(("ROOT", "MIDDLE", "TIP"), 1):
        told = told.replace(f"material: {name}", f"material: {number}")
    (tmp_path / "bar.yaml").write_text(told)
    the_wrong_third_ranks_first(tmp_path, "E_middle")


def localised_bar(tmp_path: Path, values: dict[str, float]) -> Localisation:
    """What a test of the bar with these moduli, with 1 % of noise on shapes, says of the bar."""
    sensors = [node(i, j, 0) for i in range(3, NX + 1, 2) for j in (0, NY)]
    blank = mode_set(
        np.arange(1.0, 5.0),
        np.ones((2 * len(sensors), 4)),
        sensors * 2,
        [2] * len(sensors) + [3] * len(sensors),
    )
    write_modes_csv(tmp_path / "measured.csv", range(1, 5), blank)
    campaign = load_campaign(tmp_path / "bar.yaml")
    job = Job(values, campaign_analysis(campaign))
    result = job_engine(campaign).solve(job).result(ModalResult)
    seen = campaign.case.sensors.observe(result.elastic).select(range(4))
    rms = np.sqrt(np.mean(seen.mode_shapes**2, axis=0))
    noise = 0.01 * rms * np.random.default_rng(5).standard_normal(seen.mode_shapes.shape)
    measured = mode_set(seen.frequencies_hz, seen.mode_shapes + noise, seen.nodes, seen.components)
    write_modes_csv(tmp_path / "measured.csv", range(1, 5), measured)
    return localise(load_campaign(tmp_path / "bar.yaml"))


def the_wrong_third_ranks_first(tmp_path: Path, wrong: str) -> None:
    found = localised_bar(tmp_path, {wrong: 0.8})
    assert found.maps is not None
    errors, names = found.maps.errors, found.maps.groups
    assert names[int(errors.ranking[0])] == wrong
    assert names[int(np.argmax(errors.error_shares))] == wrong
    assert found.parameters[found.singles[0].members[0]] == wrong
    assert not found.form.suspected
    # The strain of the error is largest somewhere in the wrong third.
    worst = int(found.maps.mesh_nodes[int(np.argmax(found.maps.strains))])
    third = ("E_root", "E_middle", "E_tip").index(wrong)
    assert 5 * third <= (worst - 1) % (NX + 1) <= 5 * third + 5


@needs_ccx
@pytest.mark.parametrize("shells", [False, True])
@pytest.mark.parametrize("mounted", [True, False])
def test_soft_mounts_that_no_parameter_has_are_a_group_by_calculix(
    mounted: bool, shells: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    # 10 g on 0.1 N/mm: far less than 1e-6 of the bar's largest stiffness.
    box = f"""*NODE
900, 320., 0., 50.
*ELEMENT, TYPE=MASS, ELSET=BOX
900, 900
*MASS, ELSET=BOX
1e-5
*ELEMENT, TYPE=SPRING2, ELSET=MOUNT
901, {node(NX, 0, 0)}, 900
*SPRING, ELSET=MOUNT
3, 3
0.1
*BOUNDARY
900, 1, 2
"""
    (tmp_path / "bar.inp").write_text(bar_deck(shells) + (box if mounted else ""))
    (tmp_path / "bar.yaml").write_text(CAMPAIGN)
    found = localised_bar(tmp_path, {})
    assert found.maps is not None
    assert (OTHER_STIFFNESS in found.maps.groups) == mounted


@needs_mystran
def test_soft_mounts_that_no_parameter_has_are_a_group_by_mystran(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    box = "GRID,900,,320.,0.,50.,,12456\nCONM2,901,900,,1.-5\n"
    box += f"CELAS2,902,.1,900,3,{node(NX, 0, 0)},3\n"
    (tmp_path / "bar.bdf").write_text(beam_deck().replace("ENDDATA", f"{box}ENDDATA"))
    told = CAMPAIGN.replace("deck: bar.inp, solver: calculix", "deck: bar.bdf, solver: mystran")
    for number, name in enumerate(("ROOT", "MIDDLE", "TIP"), 1):
        told = told.replace(f"material: {name}", f"material: {number}")
    (tmp_path / "bar.yaml").write_text(told)
    found = localised_bar(tmp_path, {})
    assert found.maps is not None
    assert OTHER_STIFFNESS in found.maps.groups


def frame_deck(mounted: bool) -> str:
    """A portal frame of bars on bolts (springs), with a device on its top and a post without mass.

    The device is on a mount, or on a rigid link in its place. Nothing pulls at the end of the post,
    so its bar is strained by rounding alone.
    """
    lines = ["SOL 103", "CEND", "METHOD = 1", "SPC = 1", "BEGIN BULK", "EIGRL,1,,,14"]
    for first, x, y, dx, dy in ((1, 0, 0, 0, 1), (11, 500, 0, 0, 1), (21, 0, 500, 1, 0)):
        for i in range(6):
            lines.append(f"GRID,{first + i},,{x + 100 * dx * i}.,{y + 100 * dy * i}.,0.")
            if i:
                bar, ends = first + i - 1, f"{first + i - 1},{first + i}"
                lines.append(f"CBAR,{bar},{1 if dy else 2},{ends},0.,0.,1.")
    springs = [(a, b, c, "1.+6" if c < 4 else "1.+9") for a, b in ((6, 21), (16, 26)) for c in DOFS]
    lines += ["GRID,50,,200.,560.,0.", "CONM2,60,50,,4.-4,,,,,+", "+,1.,,1.,,,1."]
    lines.append(f"RBE2,70,23,123456,{51 if mounted else 50}")
    if mounted:
        lines.append("GRID,51,,200.,560.,0.")
        springs += [(51, 50, c, "900." if c < 4 else "2.+7") for c in DOFS]
    for number, (a, b, c, k) in enumerate(springs, start=101):
        lines.append(f"CELAS2,{number},{k},{a},{c},{b},{c}")
    lines += ["GRID,80,,500.,600.,0.", "CBAR,80,3,26,80,0.,0.,1.", "MAT1,3,70000.,,0.3,0."]
    lines += [f"PBAR,{p},{p},200.,4000.,3000.,6000." for p in (1, 2, 3)]
    moduli = (73500.0, 66500.0) if mounted else (70000.0, 70000.0)
    lines += [f"MAT1,{p},{e},,0.3,2.7-9" for p, e in enumerate(moduli, start=1)]
    return "\n".join([*lines, "SPC1,1,123456,1,11", "ENDDATA", ""])


DOFS = range(1, 7)
FRAME = """name: frame
model: {deck: frame.bdf, solver: mystran, units: mm-t-s}
test: {modes: measured.csv}
parameters:
  - {name: E_columns, quantity: youngs_modulus, material: 1, bounds: [0.5, 1.5]}
  - {name: E_top, quantity: youngs_modulus, material: 2, bounds: [0.5, 1.5]}
  - {name: E_post, quantity: youngs_modulus, material: 3, bounds: [0.5, 1.5]}
residuals: {shape_weight: 0.1, frequency_deviation: 0.002, shape_deviation: 0.02}
"""


@pytest.fixture
def frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The campaign of the frame with the rigid link, and a test of the frame with the mount."""
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    rng = np.random.default_rng(3)
    sensors = [(node, c) for node in (3, 5, 13, 15, 22, 24, 25) for c in (1, 2, 3)]
    nodes, components = zip(*sensors, strict=True)
    file, measured = tmp_path / "frame.yaml", tmp_path / "measured.csv"
    file.write_text(FRAME)
    (tmp_path / "frame.bdf").write_text(frame_deck(mounted=True))
    blank = rng.standard_normal((len(sensors), 6))
    write_modes_csv(measured, range(1, 7), mode_set(np.arange(1.0, 7.0), blank, nodes, components))
    truth = load_campaign(file)
    result = job_engine(truth).solve(Job({}, campaign_analysis(truth))).result(ModalResult)
    seen = truth.case.sensors.observe(result.elastic).select(range(6))
    rms = np.sqrt(np.mean(seen.mode_shapes**2, axis=0))
    shapes = seen.mode_shapes + 0.01 * rms * rng.standard_normal(seen.mode_shapes.shape)
    found = seen.frequencies_hz * (1.0 + 0.001 * rng.standard_normal(6))
    write_modes_csv(measured, range(1, 7), mode_set(found, shapes, seen.nodes, seen.components))
    (tmp_path / "frame.bdf").write_text(frame_deck(mounted=False))
    return file


@needs_mystran
def test_a_bar_that_no_mode_strains_gets_no_change_and_all_shares_are_shares(frame: Path) -> None:
    # Without a limit the change of E_post was some 10^13 %: rounding divided by rounding.
    found = localise(load_campaign(frame))
    assert found.maps is not None
    errors, post = found.maps.errors, found.maps.groups.index("E_post")
    assert np.isnan(errors.changes[post])
    assert errors.force_shares[post] == 0.0
    assert post not in errors.pair
    for shares in (errors.force_shares, errors.error_shares, [errors.pair_share]):
        assert np.all((np.asarray(shares) >= 0.0) & (np.asarray(shares) <= 1.0))
    assert np.all(np.abs([errors.strain, errors.kinetic]) <= 1.0)
    changes = errors.changes[[found.maps.groups.index(name) for name in ("E_columns", "E_top")]]
    assert np.all((np.abs(changes) <= 0.5) | np.isnan(changes))
    # The refinement confirms what the condition lets expect: 10^-16 times 10^8, or better.
    assert found.maps.conditions.max() < 1e10
    assert found.maps.roundings.max() < 1e-8


@needs_mystran
def test_the_command_states_the_numbers_of_the_update_it_examines(frame: Path) -> None:
    folder, home = frame.parent, {"MODETUNE_HOME": str(frame.parent / "home")}
    before = run_command(folder, "localise", "frame.yaml", "--no-prefect", **home)
    assert before.returncode == 0, before.stderr
    assert "examined: the campaign's start" in before.stdout
    update = run_command(folder, "update", "frame.yaml", "--no-prefect", "--json", **home)
    verdict = json.loads(update.stdout)["model_form"]
    assert verdict["suspected"]
    after = run_command(folder, "localise", "frame.yaml", "--no-prefect", "--json", **home)
    told = json.loads(after.stdout)
    assert told["examined"] == "the end of the update in runs/frame"
    assert told["updated"] is True
    for key in ("chi_square", "degrees_of_freedom", "times_noise", "p_value", "suspected", "left"):
        assert told["model_form"][key] == verdict[key]
    start = run_command(
        folder, "localise", "frame.yaml", "--no-prefect", "--state", "initial", "--json", **home
    )
    assert json.loads(start.stdout)["updated"] is False
    post = next(item for item in told["maps"]["groups"] if item["name"] == "E_post")
    assert post["change"] is None
