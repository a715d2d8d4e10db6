"""Two mode sets side by side: tables against closed forms, sides of every kind, the command."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import typer
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from modetune.adapters.solver import Capabilities
from modetune.adapters.test_files.geometry_csv import write_geometry_csv
from modetune.adapters.test_files.hdf5 import write_test_hdf5
from modetune.adapters.test_files.measurements import read_measurement
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.adapters.test_files.universal.file import write_universal
from modetune.core.errors import CampaignError, ModesError, ModetuneError
from modetune.core.measurement.measurement import Measurement, TestGeometry
from modetune.core.modes import MeasuredModes, ModeSet, dof_name, mode_set
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.flows.cli.command import command_of
from modetune.flows.report.matplotlib_charts import matplotlib_figure, save_all
from modetune.flows.studies.catalogue import find_study
from modetune.flows.studies.correlate.correlation import Side, correlate
from modetune.flows.studies.correlate.figures import correlation_charts, heat_chart
from modetune.flows.studies.correlate.sides import correlate_sources, source
from modetune.flows.updating.update import update_campaign
from tests.flows.conftest import ScriptedProgram, recased

SIX_MASS = Path(__file__).resolve().parents[3] / "configs" / "six_mass"
NODES = np.arange(1, 5)
#: Four shapes at right angles, columns of a Hadamard matrix: MAC 1 with themselves, else 0.
SHAPES = np.array([[1, 1, 1, 1], [1, -1, 1, -1], [1, 1, -1, -1], [1, -1, -1, 1]], dtype=float)


def modes(frequencies: Any, shapes: Any, nodes: Any = NODES) -> ModeSet:
    return mode_set(frequencies, shapes, nodes, np.full(len(nodes), 3))


def side(found: ModeSet, label: str = "a") -> Side:
    return Side(label, "test", tuple(range(1, found.n_modes + 1)), found)


FIRST = side(modes([10.0, 20.0, 30.0], SHAPES[:, :3]))


# tables


def test_a_side_agrees_with_itself_to_the_last_digit() -> None:
    found = correlate(FIRST, FIRST)
    assert found.mac == pytest.approx(np.eye(3), abs=1e-12)
    assert found.comac == pytest.approx(np.ones(4))
    assert found.ecomac == pytest.approx(np.zeros(4), abs=1e-12)
    assert [(pair.difference, pair.scale) for pair in found.pairs] == [(0.0, 1.0)] * 3
    assert (found.alone_first, found.only_first, found.only_second) == ((), (), ())


def test_order_scale_and_sign_are_undone_by_pairing() -> None:
    other = side(modes([31.5, 20.0, 9.0], SHAPES[:, [2, 1, 0]] * [2.0, -4.0, 0.5]))
    found = correlate(FIRST, other)
    assert [(pair.first, pair.second) for pair in found.pairs] == [(0, 2), (1, 1), (2, 0)]
    # By hand: 9 / 10 - 1, 20 / 20 - 1, 31.5 / 30 - 1; scales as multiplied.
    assert [pair.difference for pair in found.pairs] == pytest.approx([-0.1, 0.0, 0.05])
    assert [pair.scale for pair in found.pairs] == pytest.approx([0.5, -4.0, 2.0])
    assert found.comac == pytest.approx(np.ones(4))


@pytest.mark.parametrize("swap", [False, True])
def test_a_mode_that_nothing_answers_stays_alone(swap: bool) -> None:
    fewer = side(modes([10.0, 22.0], SHAPES[:, [0, 3]]), "b")  # 22 Hz is at right angles to all
    found = correlate(fewer, FIRST) if swap else correlate(FIRST, fewer)
    assert len(found.pairs) == 1
    alone = (found.alone_first, found.alone_second)
    assert alone == (((2,), (2, 3)) if swap else ((2, 3), (2,)))


def test_degrees_of_freedom_of_one_side_only_are_named_and_left_out() -> None:
    other = side(modes([10.0, 20.0], SHAPES[1:, :2], NODES[1:]))
    found = correlate(FIRST, other)
    assert [dof_name(dof) for dof in found.dofs] == ["2.z", "3.z", "4.z"]
    assert [dof_name(dof) for dof in found.only_first] == ["1.z"]
    assert found.only_second == ()
    assert found.auto_first == pytest.approx(np.eye(3), abs=1e-12)  # at its own four sensors
    # By hand: three rows of orthogonal columns, (a . b)^2 / 9 = 1 / 9.
    assert found.auto_second[0, 1] == pytest.approx(1.0 / 9.0)


def test_a_sensor_upside_down_is_the_worst_though_comac_is_blind_to_it() -> None:
    random = np.random.default_rng(5)
    shapes = random.uniform(-1.0, 1.0, (12, 4))
    turned = shapes.copy()
    turned[7] *= -1.0
    nodes = np.arange(1, 13)
    found = correlate(
        side(modes([1.0, 2, 3, 4], shapes, nodes)), side(modes([1.0, 2, 3, 4], turned, nodes))
    )
    assert int(found.ecomac.argmax()) == 7
    assert found.comac[7] > 0.9
    assert (8, 3) in [dof for dof, _, _ in found.worst(2)]
    assert len(found.worst(100)) == 12


def test_a_phase_of_complex_shapes_counts_for_nothing() -> None:
    turned = side(modes([10.0, 20.0, 30.0], SHAPES[:, :3] * np.exp(0.7j)))
    found = correlate(FIRST, turned)
    assert found.mac == pytest.approx(np.eye(3), abs=1e-12)
    assert found.comac == pytest.approx(np.ones(4))
    # The best real part of e^0.7i.
    assert found.pairs[0].scale == pytest.approx(np.cos(0.7))


def test_without_shapes_on_one_side_the_order_of_frequency_decides() -> None:
    bare = side(mode_set([21.0, 9.0]))
    found = correlate(bare, FIRST)
    assert [(pair.first, pair.second) for pair in found.pairs] == [(0, 1), (1, 0)]
    assert np.isnan(found.pairs[0].mac)
    assert (found.mac.size, found.comac.size, found.worst(5)) == (0, 0, [])


def test_a_shape_that_rests_at_the_common_sensors_has_no_partner() -> None:
    shapes = SHAPES[:, :3].copy()
    shapes[:2, 1] = 0.0
    shapes[2:, 1] = 0.0
    found = correlate(FIRST, side(modes([10.0, 20.0, 30.0], shapes)))
    assert found.alone_second == (2,)


def test_sides_without_a_common_sensor_are_refused_with_both_named() -> None:
    other = side(modes([10.0], SHAPES[:, :1], NODES + 100), "b")
    with pytest.raises(CampaignError, match=r"a and b have no common .* 1\.z, .* 101\.z"):
        correlate(FIRST, other)


# the six-mass system of the thesis


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MODETUNE_STORE", str(tmp_path / "store"))
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    return tmp_path


def test_a_campaign_alone_is_its_model_beside_its_test(places: Path) -> None:
    found = correlate_sources(source(SIX_MASS / "campaign.yaml"), None)
    assert (found.first.kind, found.second.kind) == ("test", "model")
    assert [found.first.numbers[pair.first] for pair in found.pairs] == [2, 3, 4]
    assert [found.second.numbers[pair.second] for pair in found.pairs] == [2, 3, 4]
    # Thesis Table 11's initial springs, solved by LAPACK from the matrices of chapter 3.
    expected = six_mass_hz({"k1": 1100.0, "k2": 1000.0, "k3": 1250.0, "k4": 5000.0})
    assert found.second.modes.frequencies_hz == pytest.approx(expected, rel=1e-9)


def six_mass_hz(changes: dict[str, float]) -> Any:
    """Frequencies of the thesis's six masses (Table 1, experimental values), springs changed."""
    m = [1.8, 2.4, 1.6, 1.2, 1.1, 0.9]
    k = {"k1": 1500.0, "k2": 1600.0, "k3": 1400.0, "k4": 6500.0, "k5": 1300.0, "k6": 1500.0,
         "k7": 1300.0, "k8": 400.0, "k9": 2200.0, "k10": 3800.0} | changes  # fmt: skip
    ends = {"k1": (2, 4), "k2": (4, 5), "k3": (1, 3), "k4": (1, 2), "k5": (4, 6), "k6": (0, 2),
            "k7": (5, 6), "k8": (0, 6), "k9": (0, 4), "k10": (0, 3)}  # fmt: skip
    stiffness = np.zeros((7, 7))
    for name, (a, b) in ends.items():
        stiffness[np.ix_([a, b], [a, b])] += k[name] * np.array([[1, -1], [-1, 1]])
    root = np.sqrt(m)
    return np.sqrt(np.linalg.eigvalsh(stiffness[1:, 1:] / np.outer(root, root))) / 2 / np.pi


def test_values_of_at_reach_the_true_springs(places: Path) -> None:
    # Thesis Table 11: the true springs over the initial ones.
    truth = ["k1=1.3636363636363635", "k2=1.6", "k3=1.12", "k4=1.3"]
    found = correlate_sources(
        source(SIX_MASS / "campaign.yaml", truth), source(SIX_MASS / "all_measured.csv")
    )
    assert found.first.kind == "test"  # a test stands first
    assert [pair.difference for pair in found.pairs] == pytest.approx([0.0] * 6, abs=1e-8)
    assert np.diag(found.mac) == pytest.approx(np.ones(6))
    assert found.comac == pytest.approx(np.ones(6), abs=1e-9)
    assert found.auto_first[0, 1] == pytest.approx(found.auto_second[0, 1], rel=1e-6)


@pytest.mark.parametrize("method", ["guyan", "serep"])
def test_true_modes_are_orthogonal_in_the_mass_matrix(places: Path, method: Any) -> None:
    truth = ["k1=1.3636363636363635", "k2=1.6", "k3=1.12", "k4=1.3"]
    found = correlate_sources(
        source(SIX_MASS / "campaign.yaml", truth),
        source(SIX_MASS / "all_measured.csv"),
        method=method,
    ).orthogonality
    assert found is not None
    assert len(found.dofs) == 6
    # Six masters of six unknowns leave nothing to reduce: M itself, and a unit matrix.
    assert np.abs(found.cross) == pytest.approx(np.eye(6), abs=1e-6)
    assert np.abs(found.first) == pytest.approx(np.eye(6), abs=1e-6)


def test_serep_at_few_sensors_keeps_the_modes_orthogonal_and_guyan_does_not(places: Path) -> None:
    guyan, serep = (
        correlate_sources(source(SIX_MASS / "campaign.yaml"), None, method=method).orthogonality
        for method in ("guyan", "serep")
    )
    assert guyan is not None
    assert serep is not None
    # As many modes as masters: SEREP is exact for the lowest three, Guyan (thesis A) is not.
    assert np.abs(serep.second[:3, :3]) == pytest.approx(np.eye(3), abs=1e-6)
    assert np.abs(np.abs(guyan.second[:3, :3]) - np.eye(3)).max() > 0.01


def test_two_models_are_compared_at_the_sensors_of_their_test(places: Path) -> None:
    first = source(SIX_MASS / "campaign.yaml")
    second = source(SIX_MASS / "campaign.yaml", ["k1=1.3"])
    found = correlate_sources(first, second)
    assert (found.first.label, found.second.label) == ("six-mass (initial)", "six-mass k1=1.3")
    assert len(found.dofs) == 3
    expected = six_mass_hz({"k1": 1430.0, "k2": 1000.0, "k3": 1250.0, "k4": 5000.0})
    assert found.second.modes.frequencies_hz == pytest.approx(expected, rel=1e-9)


def without_shapes(folder: Path) -> Path:
    """The six-mass campaign with a test of frequencies alone."""
    (folder / "bare.csv").write_text("mode,1,2\nfrequency_hz,4.0,5.2\n")
    text = (SIX_MASS / "campaign.yaml").read_text()
    text = text.replace("deck: ", f"deck: {SIX_MASS}/").replace("measured.csv", "bare.csv")
    (folder / "bare.yaml").write_text(text.replace("shape_weight: 1.0", "shape_weight: 0.0"))
    return folder / "bare.yaml"


def test_two_models_without_sensors_are_compared_at_common_nodes(places: Path) -> None:
    bare = without_shapes(places)
    found = correlate_sources(source(bare), source(bare, ["k1=1.001"]))
    assert len(found.dofs) == 6
    assert np.diag(found.mac) == pytest.approx(np.ones(6), abs=1e-3)


def test_a_test_without_shapes_is_compared_by_frequency(places: Path) -> None:
    found = correlate_sources(source(without_shapes(places)), None)
    assert [(pair.first, pair.second) for pair in found.pairs] == [(0, 0), (1, 1)]
    assert found.mac.size == 0


def test_two_tests_are_compared_without_a_solver(places: Path) -> None:
    found = correlate_sources(
        source(SIX_MASS / "measured.csv"), source(SIX_MASS / "all_measured.csv")
    )
    assert [found.second.numbers[pair.second] for pair in found.pairs] == [2, 3, 4]
    assert [dof_name(dof) for dof in found.only_second] == ["4.x", "5.x", "6.x"]
    assert not (places / "store").exists()


def hoop(frames: Any, places: Any) -> Any:
    """A ring of eight points as a test saw it: the same motion, along its own directions."""
    motion = np.random.default_rng(11).normal(size=(8, 3, 3))
    nodes = np.arange(1, 9)
    shapes = np.einsum("nij,njm->nim", frames, motion).reshape(24, 3)
    seen = mode_set([10.0, 20.0, 30.0], shapes, np.repeat(nodes, 3), np.tile([1, 2, 3], 8))
    none = np.zeros((0, 2), np.int64), np.zeros((0, 3), np.int64)
    points = TestGeometry(nodes, places, frames, *none)
    return Measurement(MeasuredModes((1, 2, 3), seen), points)


@pytest.mark.parametrize("kind", ["universal", "csv", "no points"])
def test_tests_whose_sensors_look_along_other_axes_agree(tmp_path: Path, kind: str) -> None:
    angles = np.arange(8) * np.pi / 4.0 + 0.2
    places = np.stack([np.cos(angles), np.sin(angles), 0.1 * np.arange(8.0)], axis=1)
    turned = Rotation.from_euler("zx", np.stack([angles, 0.3 * angles], axis=1)).as_matrix()
    globally = hoop(np.tile(np.eye(3), (8, 1, 1)), places)
    other = hoop(turned, places)
    second = tmp_path / "turned.uff"
    if kind == "csv":
        assert other.modes is not None
        write_modes_csv(tmp_path / "modes.csv", other.modes.numbers, other.modes.modes)
        write_geometry_csv(tmp_path / "points.csv", other.geometry)
        second = Path(f"{tmp_path / 'modes.csv'},{tmp_path / 'points.csv'}")
    else:
        write_universal(second, other)
    first = tmp_path / "global.h5"
    write_test_hdf5(first, replace(globally, geometry=None) if kind == "no points" else globally)
    found = correlate_sources(source(first), source(second))
    # Universal files hold six digits of shapes and five of directions.
    np.testing.assert_allclose(np.diag(found.mac), 1.0, atol=1e-8)
    assert len(found.dofs) == 24
    assert (found.only_first, found.only_second) == ((), ())
    said = " ".join(found.notes)
    assert "look along different directions" in said
    assert ("has no sensor directions" in said) == (kind == "no points")
    ended = command(str(first), str(second))
    assert "look along different directions" in ended.stdout
    assert json.loads(command(str(first), str(second), "--json").stdout)["notes"] == list(
        found.notes
    )


# records, and what is refused


@pytest.fixture
def run_folder(bench: Any, watcher: Any) -> Path:
    campaign = bench.campaign({"k1": 1.2, "k2": 0.8}, shapes=True)
    return Path(update_campaign(campaign, bench.folder / "run", watcher).folder)


def test_a_record_alone_is_its_model_beside_its_test(run_folder: Path) -> None:
    updated = correlate_sources(source(run_folder), None)
    assert updated.second.label == "chain updated"
    assert max(abs(pair.difference) for pair in updated.pairs) < 1e-7  # it converged to 1e-8
    initial = correlate_sources(source(run_folder / "campaign.h5"), None, "initial")
    assert max(abs(pair.difference) for pair in initial.pairs) > 0.01


def test_a_record_beside_a_test_file_stands_second(run_folder: Path, tmp_path: Path) -> None:
    test = correlate_sources(source(run_folder), None).first
    write_modes_csv(tmp_path / "test.csv", test.numbers, test.modes)
    found = correlate_sources(source(run_folder), source(tmp_path / "test.csv"))
    assert (found.first.kind, found.second.kind) == ("test", "record")
    assert np.diag(found.mac) == pytest.approx(np.ones(5), abs=1e-6)


def test_a_campaign_beside_a_record_is_run_and_seen_by_its_sensors(
    run_folder: Path, bench: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    campaign = bench.campaign({"k1": 1.2, "k2": 0.8}, shapes=True)
    monkeypatch.setattr("modetune.flows.campaign.sketch.load_campaign", lambda *_: campaign)
    (tmp_path / "chain.yaml").write_text("name: chain")
    before = bench.runs()
    found = correlate_sources(source(tmp_path / "chain.yaml"), source(run_folder), "initial")
    assert bench.runs() == before  # the first model of the record, cached
    assert [pair.difference for pair in found.pairs] == pytest.approx([0.0] * 6, abs=1e-12)


def test_sources_that_cannot_be_compared_are_refused_in_a_sentence(
    tmp_path: Path, run_folder: Path, places: Path
) -> None:
    with pytest.raises(CampaignError, match="is not there; expected a campaign file"):
        source(tmp_path / "none.csv")
    with pytest.raises(CampaignError, match="is not a campaign file, so it has no values"):
        source(SIX_MASS / "measured.csv", ["k1=2"])
    with pytest.raises(CampaignError, match="is a test; name what it is to be compared with"):
        correlate_sources(source(SIX_MASS / "measured.csv"), None)
    with pytest.raises(CampaignError, match="needs a mass matrix: name a campaign"):
        correlate_sources(source(run_folder), None, method="guyan")
    with h5py.File(tmp_path / "odd.h5", "w") as file:
        file.create_group("iterations")
    with pytest.raises(CampaignError, match="is not a record of a campaign"):
        correlate_sources(source(tmp_path / "odd.h5"), None)
    write_test_hdf5(tmp_path / "cut.h5", read_measurement([SIX_MASS / "measured.csv"]))
    (tmp_path / "cut.h5").write_bytes((tmp_path / "cut.h5").read_bytes()[:1500])
    with pytest.raises(CampaignError, match="damaged or cut short"):
        correlate_sources(source(tmp_path / "cut.h5"), source(SIX_MASS / "measured.csv"))
    (tmp_path / "text.csv").write_text("no test\n")
    with pytest.raises(CampaignError, match=r"text\.csv"):
        correlate_sources(source(tmp_path / "text.csv"), source(SIX_MASS / "measured.csv"))


def test_a_solver_without_matrices_gives_no_orthogonality(
    bench: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Plain(ScriptedProgram):
        @property
        def capabilities(self) -> Capabilities:
            return replace(super().capabilities, matrices=False)

    campaign = bench.campaign({"k1": 1.2}, shapes=True)
    campaign = recased(campaign, solver=replace(bench.solver(), program=Plain(bench.folder)))
    monkeypatch.setattr("modetune.flows.studies.correlate.sides.load_campaign", lambda *_: campaign)
    (tmp_path / "chain.yaml").write_text("name: chain")
    with pytest.raises(CampaignError, match="which scripted does not give for chain"):
        correlate_sources(source(tmp_path / "chain.yaml"), None, method="guyan")


def sensors_turned(bench: Any, direction: list[float]) -> Any:
    """The chain's campaign, its third sensor looking along this direction."""
    campaign = bench.campaign({"k1": 1.2}, modes=(1, 2, 3, 4, 5), shapes=True)
    sensors = campaign.case.sensors
    directions = sensors.directions.copy()
    directions[2] = direction
    turned = replace(sensors, directions=directions)
    return recased(campaign, mapping=replace(campaign.case.mapping, sensors=turned))


@pytest.mark.parametrize("method", ["guyan", "serep"])
def test_a_sensor_that_looks_backwards_keeps_modes_orthogonal(
    bench: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, method: Any
) -> None:
    campaign = sensors_turned(bench, [-1.0, 0.0, 0.0])
    monkeypatch.setattr("modetune.flows.studies.correlate.sides.load_campaign", lambda *_: campaign)
    (tmp_path / "chain.yaml").write_text("name: chain")
    found = correlate_sources(source(tmp_path / "chain.yaml"), None, method=method).orthogonality
    assert found is not None
    assert np.abs(found.second) == pytest.approx(np.eye(6), abs=1e-9)  # of the model's own modes


def test_two_sensors_of_one_motion_are_told(
    bench: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    straight = sensors_turned(bench, [1.0, 0.0, 0.0])
    (tmp_path / "chain.yaml").write_text("name: chain")
    nodes = straight.case.sensors.model_nodes.copy()
    nodes[2] = 2
    sensors = replace(straight.case.sensors, model_nodes=nodes)
    mapping = replace(straight.case.mapping, sensors=sensors)
    twice = replace(straight, cases=(replace(straight.case, mapping=mapping),))
    monkeypatch.setattr("modetune.flows.studies.correlate.sides.load_campaign", lambda *_: twice)
    with pytest.raises(ModesError, match="two sensors in one direction at one node"):
        correlate_sources(source(tmp_path / "chain.yaml"), None, method="guyan")


# the command, its files and figures


def command(*arguments: str) -> Any:
    app = typer.Typer()
    app.command()(command_of(find_study("correlate")))
    return CliRunner().invoke(app, list(arguments))


def test_the_command_tells_tables_and_writes_files(places: Path) -> None:
    out, figures = places / "pairs.csv", places / "figures"
    ended = command(
        str(SIX_MASS / "campaign.yaml"),
        str(SIX_MASS / "all_measured.csv"),
        "--out",
        str(out),
        "--figures",
        str(figures),
    )
    assert ended.exit_code == 0
    assert "first all_measured.csv, second six-mass" in ended.stdout
    assert "6 common degrees of freedom" in ended.stdout
    with out.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["first"] for row in rows] == ["1", "2", "3", "4", "5", "6"]
    assert float(rows[1]["difference"]) == pytest.approx(-0.0862, abs=1e-4)  # 4.791 / 5.243 - 1
    with (places / "pairs_sensors.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == 6
    names = {path.name for path in figures.iterdir()}
    assert names == {
        "mac.png",
        "auto_mac_first.png",
        "auto_mac_second.png",
        "frequencies.png",
        "comac.png",
    }
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in figures.iterdir())


def test_the_command_tells_one_object(places: Path) -> None:
    ended = command(str(SIX_MASS / "campaign.yaml"), "--json", "--orthogonality", "guyan")
    told = json.loads(ended.stdout)
    assert told["common"] == 3
    assert told["second"]["without_pair"] == [1, 5, 6]
    assert np.shape(told["mac"]) == (3, 6)
    assert np.shape(told["orthogonality"]["cross"]) == (3, 6)
    assert [sensor["sensor"] for sensor in told["sensors"]] == ["1.x", "2.x", "3.x"]
    assert set(told["worst"]) == {"1.x", "2.x", "3.x"}


def test_no_number_is_told_where_there_is_none(places: Path) -> None:
    told = json.loads(command(str(without_shapes(places)), "--json").stdout)
    assert (told["pairs"][0]["mac"], told["mac"], told["orthogonality"]) == (None, [], None)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--state", "last"], "expected one of updated, initial"),
        (["--orthogonality", "irs"], "expected one of guyan, serep"),
        (["--second-at", "k1=2"], "of a second campaign, and none is named"),
        (["--at", "k99=2"], "expected NAME=VALUE with NAME of k1"),
    ],
)
def test_mistaken_options_are_a_sentence(places: Path, options: list[str], said: str) -> None:
    ended = command(str(SIX_MASS / "campaign.yaml"), *options)
    assert isinstance(ended.exception, ModetuneError)
    assert said in str(ended.exception)


def test_large_matrices_are_drawn_without_numbers_and_without_shapes_little_is(
    tmp_path: Path,
) -> None:
    many = side(
        modes(
            np.arange(1.0, 31.0),
            np.random.default_rng(1).standard_normal((40, 30)),
            np.arange(1, 41),
        )
    )
    found = correlate(many, many)
    assert len(matplotlib_figure(heat_chart("t", found.mac, many, many)).axes[0].texts) == 0
    bare = side(mode_set([1.0, 2.0]))
    assert [
        path.name for path in save_all(correlation_charts(correlate(bare, bare)), tmp_path)
    ] == ["frequencies.png"]


def test_records_hold_all_elastic_modes(run_folder: Path) -> None:
    from modetune.core.storage.campaign_record import read_record

    record: CampaignRecord = read_record(run_folder / "campaign.h5")
    found = correlate_sources(source(run_folder), None)
    assert found.second.modes.n_modes == record.best.computed.n_modes == 6
