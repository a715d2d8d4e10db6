"""Sensor and exciter places from a model: what is chosen, what it costs, what is refused."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from matplotlib.image import imread
from typer.testing import CliRunner

from modetune.adapters.test_files.measurements import read_measurement
from modetune.configs.garteur.aircraft import write_decks
from modetune.core.errors import CampaignError, SolverRejected
from modetune.core.modes import Floats
from modetune.core.planning.sensor_placement import judge
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.campaign.schema import ModelFile
from modetune.flows.cli.command import command_of
from modetune.flows.report.mesh_picture import can_draw
from modetune.flows.studies.catalogue import find_study
from modetune.flows.studies.pretest.plan import run_pretest
from modetune.flows.studies.pretest.request import PretestSettings, parse_modes
from modetune.flows.studies.pretest.study import pretest_summary
from tests.adapters.solved import needs_ccx

TRUTH = {"k1": 1.2, "k3": 0.8}
#: A strip of shells 240 x 40 x 2 mm, clamped at x = 0: 13 by 3 nodes 10 i + j.
DECK = (
    "*NODE\n"
    + "".join(
        f"{10 * i + j}, {20.0 * i}, {20.0 * j - 40.0}, 0.\n" for i in range(13) for j in (1, 2, 3)
    )
    + "*ELEMENT, TYPE=S4, ELSET=PLATE\n"
    + "".join(
        f"{10 * i + j}, {10 * i + j}, {10 * i + 10 + j}, {10 * i + 11 + j}, {10 * i + 1 + j}\n"
        for i in range(12)
        for j in (1, 2)
    )
    + "*MATERIAL, NAME=M\n*ELASTIC\n70000., .3\n*DENSITY\n2.7e-9\n"
    + "*SHELL SECTION, ELSET=PLATE, MATERIAL=M\n2.\n"
)
CLAMPED = "*BOUNDARY\n1, 1, 6\n2, 1, 6\n3, 1, 6\n"
MODEL = "name: strip\nmodel: {deck: strip.inp, solver: calculix, units: mm-t-s}\n"
SPRINGS = """name: chain
model: {deck: chain.yaml, solver: matrices, units: m-kg-s}
"""
CHAIN = """masses: {m1: 1.0, m2: 2.0, m3: 1.0}
springs:
  a: {between: [ground, m1], stiffness: 100.0}
  b: {between: [m1, m2], stiffness: 200.0}
  c: {between: [m2, m3], stiffness: 100.0}
"""


@pytest.fixture
def strip(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A campaign file of the clamped strip, without a test and without parameters."""
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    (tmp_path / "strip.inp").write_text(DECK + CLAMPED)
    (tmp_path / "strip.yaml").write_text(MODEL)
    return tmp_path / "strip.yaml"


def call(*arguments: object) -> Any:
    app = typer.Typer()
    app.callback()(lambda: None)
    app.command()(command_of(find_study("pretest")))
    return CliRunner().invoke(app, ["pretest", *map(str, arguments)])


def stored(folder: Path) -> int:
    """Results in the store beside a campaign: solver runs that were ever good."""
    return len(list((folder / ".modetune" / "store").glob("??/*.h5")))


def chain_shapes(chain_of: Callable[..., Any], values: dict[str, float]) -> tuple[Floats, Floats]:
    """Eigenvalues and mass-normalised shapes of the bench's chain, the first entry positive."""
    stiffness, masses = chain_of(values)
    root = np.sqrt(masses)
    eigenvalues, vectors = np.linalg.eigh(stiffness / np.outer(root, root))
    shapes = vectors / root[:, None]
    return eigenvalues, shapes * np.sign(shapes[0])


# what is chosen


def test_sensors_of_a_chain_are_the_best_of_all_subsets(
    bench: Any, chain_of: Callable[..., Any]
) -> None:
    settings = PretestSettings(modes=(1, 2, 3), sensors=4, distance=0.0)
    found = run_pretest(bench.campaign(TRUTH), settings)
    _, shapes = chain_shapes(chain_of, {})
    rows = shapes[:, None, :3]
    best = max(combinations(range(6), 4), key=lambda s: judge(rows, np.array(s)).determinant)
    assert sorted(item.node for item in found.sensors) == [place + 1 for place in best]
    assert {item.label for item in found.sensors} == {"x"}  # all that the chain's masses do
    assert found.quality.determinant == pytest.approx(judge(rows, np.array(best)).determinant)
    assert found.mode_numbers == (1, 2, 3)
    assert found.n_rigid == 0
    assert found.suspension == ()


@pytest.mark.parametrize("method", ["effective_independence", "auto_mac", "kinetic_energy"])
def test_a_pretest_takes_one_modal_run_and_none_again(bench: Any, method: Any) -> None:
    settings = PretestSettings(modes=(1, 2, 3), sensors=4, method=method)
    first = run_pretest(bench.campaign(TRUTH), settings)
    assert (bench.runs("modal"), bench.runs("matrices")) == (1, 0)
    assert (first.runs.modal, first.runs.reused) == (1, 0)
    again = run_pretest(bench.campaign(TRUTH), settings)
    assert bench.runs() == 1
    assert (again.runs.modal, again.runs.reused) == (0, 1)
    assert [item.node for item in again.sensors] == [item.node for item in first.sensors]


def test_all_modes_are_taken_up_to_the_eighth_and_twice_as_many_sensors(bench: Any) -> None:
    found = run_pretest(bench.campaign(TRUTH), PretestSettings(distance=0.0))
    assert found.mode_numbers == (1, 2, 3, 4, 5, 6)  # the chain has six
    assert len(found.sensors) == 6  # ... and six masses


def test_one_exciter_drives_all_modes_of_the_chain(
    bench: Any, chain_of: Callable[..., Any]
) -> None:
    found = run_pretest(bench.campaign(TRUTH), PretestSettings(modes=(1, 2, 3), exciters=1))
    _, shapes = chain_shapes(chain_of, {})
    shares = np.abs(shapes[:, :3]) / np.abs(shapes[:, :3]).max(axis=0)
    best = int(np.argmax(shares.min(axis=1)))
    assert found.exciters[0].node == best + 1
    assert found.exciters[0].shares == pytest.approx(shares[best])
    assert found.exciters[0].rigid_kg is None


def test_information_is_that_of_differences_of_all_shapes(
    bench: Any, chain_of: Callable[..., Any]
) -> None:
    settings = PretestSettings(modes=(1, 2), sensors=3, method="information", distance=0.0)
    campaign = bench.campaign(TRUTH)
    found = run_pretest(campaign, settings)
    # Central differences of LAPACK's modes; deviations 0.3 of parameters, 0.2 % and 2 % measured.
    lam, phi = (part[..., :2] for part in chain_shapes(chain_of, {}))
    frequencies, turns = [], []
    for name in TRUTH:
        ends = [chain_shapes(chain_of, {name: 1.0 + step}) for step in (1e-5, -1e-5)]
        frequencies.append((ends[0][0] - ends[1][0])[:2] / 2e-5 / lam / 2 * 0.3 / 0.002)
        change = (ends[0][1] - ends[1][1])[:, :2] / 2e-5
        change = change - phi * (phi * change).sum(axis=0) / (phi**2).sum(axis=0)
        turns.append(change / np.sqrt((phi**2).mean(axis=0)) * 0.3 / 0.02)
    slopes, readings = np.stack(frequencies, axis=1), np.stack(turns, axis=2)
    base = np.eye(2) + slopes.T @ slopes
    rows = [item.node - 1 for item in found.sensors]

    def deviations(places: list[int]) -> Floats:
        part = readings[places].reshape(-1, 2)
        return np.asarray(0.3 * np.sqrt(np.diag(np.linalg.inv(base + part.T @ part))))

    for place, item in enumerate(found.knowledge):
        assert item.beforehand == 0.3
        assert item.by_frequencies == pytest.approx(deviations([])[place], rel=1e-5)
        assert item.by_sensors == pytest.approx(deviations(rows)[place], rel=1e-5)
        assert item.by_all == pytest.approx(deviations(list(range(6)))[place], rel=1e-5)
        assert item.by_all <= item.by_sensors <= item.by_frequencies <= item.beforehand
    assert {item.reason for item in found.sensors} <= {"determines k1", "determines k3"}


def test_information_takes_one_matrix_job_for_springs_apart_and_none_again(bench: Any) -> None:
    settings = PretestSettings(modes=(1, 2), sensors=3, method="information")
    first = run_pretest(bench.campaign(TRUTH), settings)
    # The model's own matrices, and one of both springs: stiffness is linear in them.
    assert (bench.runs("modal"), bench.runs("matrices")) == (1, 2)
    assert (first.runs.modal, first.runs.sensitivity) == (1, 2)
    again = run_pretest(bench.campaign(TRUTH), settings)
    assert bench.runs() == 3
    # The store has the matrices that were made of the jobs'.
    assert (again.runs.modal, again.runs.sensitivity, again.runs.reused) == (0, 0, 1)


def test_mass_weighting_makes_independence_the_share_of_kinetic_energy(bench: Any) -> None:
    # All six masses are kept: Phi^T M Phi = 1 for all six modes, each place is indispensable.
    settings = PretestSettings(modes=(1, 2), sensors=6, by_mass=True, distance=0.0)
    found = run_pretest(bench.campaign(TRUTH), settings)
    assert bench.runs("matrices") == 1
    energies = {item.node: item.contribution for item in found.sensors}
    assert sum(energies.values()) == pytest.approx(2.0)  # the trace of the projector


def test_sensors_that_cannot_tell_modes_apart_are_said_with_the_number_that_can(
    bench: Any,
) -> None:
    settings = PretestSettings(modes=(1, 2, 3, 4), sensors=4, method="kinetic_energy", distance=0.0)
    found = run_pretest(bench.campaign(TRUTH), settings)
    assert found.quality.largest > 0.25
    assert found.doubtful
    assert found.needed is not None
    first, second = (found.mode_numbers[place] for place in found.quality.pair)
    (said,) = [note for note in found.notes if "hardly distinguish" in note]
    assert f"these 4 sensors can hardly distinguish modes {first} and {second}" in said
    assert f"{found.needed} sensors by effective independence are enough" in said
    enough = replace(settings, sensors=found.needed, method="effective_independence")
    assert run_pretest(bench.campaign(TRUTH), enough).quality.largest <= 0.25


def test_where_more_sensors_do_not_help_another_way_is_named(bench: Any, tmp_path: Path) -> None:
    (tmp_path / "three.csv").write_text("1\n2\n3\n")
    settings = PretestSettings(modes=(1, 2, 3), sensors=3, candidates=str(tmp_path / "three.csv"))
    found = run_pretest(bench.campaign(TRUTH), settings)
    assert found.doubtful
    assert found.needed is None
    (said,) = [note for note in found.notes if "hardly distinguish" in note]
    assert f"({found.whole.largest:.2f} with all 3 candidates): try --method auto_mac" in said


def test_a_distance_is_kept_and_one_that_nobody_asked_for_gives_way(bench: Any) -> None:
    # Masses are 100 mm apart: at 150 mm no two neighbours, and so three of six at most.
    apart = PretestSettings(modes=(1, 2), sensors=2, distance=150.0)
    nodes = sorted(item.node for item in run_pretest(bench.campaign(TRUTH), apart).sensors)
    assert np.diff(nodes).min() >= 2
    with pytest.raises(CampaignError, match=r"candidates are 150 apart, and 4 sensors"):
        run_pretest(bench.campaign(TRUTH), replace(apart, sensors=4))
    free = run_pretest(bench.campaign(TRUTH), replace(apart, sensors=6, distance=None))
    assert len(free.sensors) == 6  # 5 % of the chain is below its 100 mm


# refusals


def test_fewer_sensors_than_modes_are_refused_before_any_run(bench: Any) -> None:
    settings = PretestSettings(modes=(1, 2, 3), sensors=2)
    with pytest.raises(CampaignError, match="--sensors 2: too few to distinguish 3 modes"):
        run_pretest(bench.campaign(TRUTH), settings)
    assert bench.runs() == 0
    with pytest.raises(CampaignError, match="--sensors 2: too few to distinguish 6 modes"):
        run_pretest(bench.campaign(TRUTH), PretestSettings(sensors=2))


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (PretestSettings(sensors=0), "--sensors 0"),
        (PretestSettings(exciters=-1), "--exciters -1"),
        (PretestSettings(distance=-2.0), "--distance -2"),
        (PretestSettings(distance=math.nan), "--distance nan"),
        (PretestSettings(directions="normal"), "no normal to measure"),
        (PretestSettings(directions="normal", triaxial=True), "leave out --directions"),
        (PretestSettings(candidates="nowhere.csv"), "surface, all, or a file"),
    ],
)
def test_what_cannot_be_is_refused_before_any_run(
    bench: Any, settings: PretestSettings, said: str
) -> None:
    with pytest.raises(CampaignError, match=said):
        run_pretest(bench.campaign(TRUTH), settings)
    assert bench.runs() == 0


def test_modes_and_exciters_that_the_model_lacks_are_refused(bench: Any) -> None:
    with pytest.raises(CampaignError, match="mode 7 is asked for, and the model has 6"):
        run_pretest(bench.campaign(TRUTH), PretestSettings(modes=(1, 7)))
    with pytest.raises(CampaignError, match="--exciters 7: there are 6 candidates"):
        run_pretest(bench.campaign(TRUTH), PretestSettings(modes=(1,), exciters=7))


def test_a_solver_that_refuses_its_input_is_told(bench: Any) -> None:
    bench.script({1: "rejected"})
    with pytest.raises(SolverRejected, match="refused its input"):
        run_pretest(bench.campaign(TRUTH), PretestSettings(modes=(1,)))


def test_numbers_of_modes_are_ranges_and_lists() -> None:
    assert parse_modes("1-3, 7,5-6") == (1, 2, 3, 5, 6, 7)
    assert parse_modes("") == ()
    for text in ("0-3", "3-1", "a", "1,,2", "1.5", "-2"):
        with pytest.raises(CampaignError, match="expected numbers of elastic modes"):
            parse_modes(text)


def test_a_list_of_candidates_is_read_and_its_mistakes_told_with_their_lines(
    bench: Any, tmp_path: Path
) -> None:
    listed = tmp_path / "nodes.csv"
    listed.write_text("# may carry a sensor\nnode,x,y,z\n1,0,0,0\n\n3\n5,1,2,3\n")
    settings = PretestSettings(modes=(1, 2), sensors=2, candidates=str(listed), distance=0.0)
    found = run_pretest(bench.campaign(TRUTH), settings)
    assert found.n_candidates == 3
    assert {item.node for item in found.sensors} < {1, 3, 5}
    listed.write_text("1\n99\nleft\n")
    with pytest.raises(CampaignError) as refused:
        run_pretest(bench.campaign(TRUTH), settings)
    assert refused.value.problems == (
        f"{listed}, line 2: the model has no node 99 with results",
        f"{listed}, line 3: 'left' where a node number must be",
    )
    listed.write_text("# nothing\n")
    with pytest.raises(CampaignError, match="no node number in it"):
        run_pretest(bench.campaign(TRUTH), settings)


def test_information_without_parameters_is_refused(bench: Any) -> None:
    campaign = bench.campaign({}, parameters={})
    nobody = replace(campaign, parameters=type(campaign.parameters)(()))
    with pytest.raises(CampaignError, match="places sensors for `parameters`"):
        run_pretest(nobody, PretestSettings(modes=(1,), method="information"))


# campaign files


def test_a_campaign_file_needs_neither_test_nor_parameters(strip: Path) -> None:
    with pytest.raises(CampaignError, match="the key `test` is missing"):
        load_campaign(strip)
    campaign = load_campaign(strip, [], ModelFile)
    assert len(campaign.parameters) == 0
    assert campaign.test.numbers == ()


def test_modes_by_matrices_are_refused_before_there_is_a_test(strip: Path) -> None:
    with pytest.raises(CampaignError, match=r"line 2: eigensolver pardiso: without a test"):
        load_campaign(strip, ["model.eigensolver=pardiso"], ModelFile)


def test_a_test_that_is_not_there_yet_is_not_read(strip: Path) -> None:
    strip.write_text(MODEL + "test: {modes: later.csv, use: [1, 2]}\n")
    assert load_campaign(strip, [], ModelFile).test.numbers == ()
    strip.write_text(MODEL + "tset: {modes: later.csv}\n")
    with pytest.raises(CampaignError, match=r"line 3.*unknown key `tset`"):
        load_campaign(strip, [], ModelFile)


@needs_ccx
@pytest.mark.skipif(not can_draw(), reason="no OpenGL to draw with (libosmesa6)")
def test_a_strip_is_measured_out_of_its_plane_and_the_file_is_a_test(
    strip: Path, tmp_path: Path
) -> None:
    out, picture = tmp_path / "sensors.csv", tmp_path / "sensors.png"
    arguments = (strip, "--modes", "1-3", "--sensors", 5, "--directions", "normal",
                 "--out", out, "--picture", picture, "--json")  # fmt: skip
    told = json.loads(call(*arguments).stdout)
    runs = told["solver_runs"]
    assert (runs["modal"], runs["sensitivity"], runs["reused"]) == (1, 0, 0)
    assert stored(tmp_path) == 1
    assert told["rigid_modes"] == 0
    assert [abs(way[2]) for item in told["sensors"] for way in item["vectors"]] == [1.0] * 5
    # Beam: 1.875^2 / 2 pi sqrt(E I / rho A L^4) = 28.6 Hz; a plate is stiffer, up to 5 %.
    assert 28.0 < told["frequencies_hz"][0] < 30.5
    places = {tuple(item["place"][:2]) for item in told["sensors"]}
    assert {(240.0, -20.0), (240.0, 20.0)} <= places  # free corners: bending and torsion
    alike = told["quality"]["largest_auto_mac"] > 0.25
    assert told["status"] == ("doubtful" if alike else "good")
    assert alike == any("hardly distinguish" in note for note in told["notes"])

    again = json.loads(call(*arguments).stdout)
    runs = again["solver_runs"]
    assert (runs["modal"], runs["sensitivity"], runs["reused"]) == (0, 0, 1)
    assert again["sensors"] == told["sensors"]
    assert stored(tmp_path) == 1

    geometry = read_measurement([out]).geometry
    assert geometry is not None
    assert geometry.metres == 1e-3
    assert geometry.nodes.tolist() == [item["node"] for item in told["sensors"]]
    # Measured modes with rows of the names told fit the model at distance 0, along the normal.
    rows = [f"{dof}, 1.0" for item in told["sensors"] for dof in item["dofs"]]
    (tmp_path / "measured.csv").write_text("\n".join(["mode, 1", "frequency_hz, 29", *rows]))
    test = "test: {modes: [measured.csv, sensors.csv]}\n"
    parameters = "parameters:\n  - {name: E, quantity: youngs_modulus, material: M}\n"
    strip.write_text(MODEL + test + parameters)
    sensors = load_campaign(strip).case.sensors
    assert sensors.model_nodes.tolist() == [item["node"] for item in told["sensors"]]
    assert sensors.distances == pytest.approx(np.zeros(5), abs=1e-9)
    directions = np.array([item["vectors"][0] for item in told["sensors"]])
    assert sensors.directions == pytest.approx(directions, abs=1e-6)

    pixels = imread(picture)[:, :, :3]
    blue = np.array([0x00, 0x72, 0xB2]) / 255.0
    assert (np.abs(pixels - blue).max(axis=2) < 0.02).sum() > 500  # sensors' arrows
    assert (pixels.min(axis=2) > 0.99).mean() > 0.5  # a white ground


@needs_ccx
def test_the_table_for_people_says_what_and_why(strip: Path) -> None:
    said = call(strip, "--modes", "1-2", "--sensors", 3, "--triaxial", "--exciters", 2)
    assert said.exit_code == 0
    for words in ("3 sensors of", "xyz", "auto-MAC off the diagonal", "1 modal", "Exciters"):
        assert words in said.stdout
    assert "suspension" not in said.stdout  # it is clamped


@needs_ccx
def test_the_coarse_aircraft_is_measured_at_its_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    write_decks(tmp_path)
    file = tmp_path / "aircraft.yaml"
    file.write_text(
        "name: aircraft\nmodel: {deck: garteur_coarse.inp, solver: calculix, units: mm-t-s}\n"
    )
    campaign = load_campaign(file, [], ModelFile)
    found = run_pretest(campaign, PretestSettings(exciters=2))
    assert (found.runs.modal, stored(tmp_path)) == (1, 1)
    assert found.n_rigid == 6
    assert found.quality.largest < 0.25
    places = np.array([item.place for item in found.sensors])
    corners = {(x, y) for x in (400.0, 800.0) for y in (-1000.0, 1000.0)}  # of the wing's drums
    assert corners <= {tuple(place) for place in places[:4, :2].tolist()}
    nodes = np.array([item.node for item in found.sensors])
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    assert apart[nodes[:, None] != nodes[None]].min() >= found.distance
    # It hangs from its fuselage, which is 50 mm wide.
    assert all(abs(point.place[1]) <= 25.0 for point in found.suspension[:2])
    assert np.max([item.shares for item in found.exciters], axis=0).min() > 0.2
    told = pretest_summary(found)
    assert json.loads(json.dumps(told)) == told


# models without places


def test_matrices_have_sensors_without_a_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    (tmp_path / "chain.yaml").write_text(CHAIN)
    (tmp_path / "campaign.yaml").write_text(SPRINGS)
    for option, name in (("--out", "s.csv"), ("--picture", "s.png")):
        refused = call(tmp_path / "campaign.yaml", option, tmp_path / name)
        assert isinstance(refused.exception, CampaignError)
        assert "matrices alone" in str(refused.exception)
    assert stored(tmp_path) == 0  # refused before a run
    said = call(tmp_path / "campaign.yaml", "--modes", "1,2", "--sensors", 2, "--json")
    told = json.loads(said.stdout)
    assert len({dof for item in told["sensors"] for dof in item["dofs"]}) == 2
    assert stored(tmp_path) == 1


@pytest.mark.parametrize(("option", "name"), [("--out", "s.txt"), ("--picture", "s.jpg")])
def test_files_of_another_kind_are_refused_before_any_run(
    strip: Path, option: str, name: str
) -> None:
    refused = call(strip, option, name)
    assert isinstance(refused.exception, CampaignError)
    assert name in str(refused.exception)
    assert stored(strip.parent) == 0
