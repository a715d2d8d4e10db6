"""The vibration fixture's generator: dimensions, joints, springs, sensors, and its test file."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from modetune.configs.cases import write_case
from modetune.configs.fixture.fixture import (
    GROUPS,
    MASSES,
    MESHES,
    SENSORS,
    SPRINGS,
    Fixture,
    Floats,
    assembled,
    calculix_deck,
    fixture,
)
from modetune.configs.fixture.twin import (
    FREQUENCY_NOISE,
    GROUND,
    MODULI,
    QUARTERS,
    bodies,
    mean_stiffness,
    measured,
    quarters,
    write_twin,
)
from modetune.core.errors import CampaignError, SolverMissing
from modetune.core.modes import mode_set
from modetune.flows.campaign.campaign import load_campaign

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "fixture"
#: mm^3, length x height x width of each part; each extension less its hole.
VOLUMES = {
    "CONCRETE": 600.0 * 100.0 * 550.0,
    "BASE": 500.0 * 40.0 * 300.0,
    "WALL_LEFT": 50.0 * 260.0 * 200.0,
    "WALL_RIGHT": 50.0 * 260.0 * 200.0,
    "BRIDGE": 200.0 * 60.0 * 200.0,
    "RIBS": 2 * 50.0 * 100.0 * 100.0,
    "EXTENSION_LEFT": 25.0 * (200.0 * 200.0 - 50.0 * 100.0),
    "EXTENSION_RIGHT": 25.0 * (200.0 * 200.0 - 50.0 * 100.0),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The campaigns in a folder of their own, with a CalculiX to run them."""
    write_case("fixture", tmp_path)
    return tmp_path


def need_ccx(folder: Path) -> None:
    try:
        load_campaign(folder / "fixture.yaml").solver_version()
    except SolverMissing as error:
        pytest.skip(str(error))


def volumes(model: Fixture) -> dict[str, float]:
    found = {}
    for group, elements in model.elements.items():
        corners = model.nodes[elements - 1]
        edges = [corners[:, i] - corners[:, 0] for i in (1, 3, 4)]
        triple = np.einsum("ij,ij->i", np.cross(edges[0], edges[1]), edges[2])
        assert (triple > 0.0).all()  # right-handed numbering
        found[group] = float(triple.sum())
    return found


def extent(name: str, group: str) -> Floats:
    model = fixture(MESHES[name])
    points = model.nodes[model.elements[group].ravel() - 1]
    return np.asarray(points.max(axis=0) - points.min(axis=0))


@pytest.mark.parametrize("name", MESHES)
def test_volumes_are_those_of_the_dimensions(name: str) -> None:
    assert volumes(fixture(MESHES[name])) == pytest.approx(VOLUMES)


@pytest.mark.parametrize("name", MESHES)
def test_the_concrete_is_as_much_larger_than_the_plate_as_the_thesis_says(name: str) -> None:
    # Chapter 6: 250 mm wider, 100 mm longer, 100 mm thick as an initial assumption.
    larger = extent(name, "CONCRETE") - extent(name, "BASE")
    assert larger[[0, 2]] == pytest.approx([100.0, 250.0])
    assert extent(name, "CONCRETE")[1] == pytest.approx(100.0)


def test_the_true_fixture_is_the_models_on_pads_and_a_thicker_block() -> None:
    found = volumes(assembled(bodies()))
    pads = {f"PAD_{quarter}": 100.0 * 8.0 * 100.0 for quarter in QUARTERS}
    roots = {f"ROOT_{side}": 10.0 * 25.0 * 200.0 for side in ("LEFT", "RIGHT")}
    extensions = {
        f"EXTENSION_{side}": VOLUMES["EXTENSION_LEFT"] - 10.0 * 25.0 * 200.0
        for side in ("LEFT", "RIGHT")
    }
    thicker = {"CONCRETE": 600.0 * 105.0 * 550.0, "BASE": 500.0 * 32.0 * 300.0}
    assert found == pytest.approx(VOLUMES | thicker | extensions | roots | pads)


def test_block_and_fixture_of_the_truth_share_no_node_and_the_sensors_are_first() -> None:
    model = assembled(bodies())
    block = set(model.elements["CONCRETE"].ravel().tolist())
    others = [model.elements[group].ravel() for group in model.elements if group != "CONCRETE"]
    assert not block & set(np.concatenate(others).tolist())
    np.testing.assert_allclose(model.nodes[: len(SENSORS)], SENSORS)


def test_quarters_have_all_springs_and_their_mean_is_told() -> None:
    model = assembled(bodies())
    split, springs = quarters(model)
    for name, factors in GROUND.items():
        own = [split.springs[f"{name}_{quarter}"] for quarter in QUARTERS]
        assert sorted(np.concatenate(own).tolist()) == sorted(model.springs[name].tolist())
        total = sum(
            springs[f"{name}_{quarter}"].stiffness * nodes.size
            for quarter, nodes in zip(QUARTERS, own, strict=True)
        )
        whole = SPRINGS[name].stiffness * model.springs[name].size
        assert mean_stiffness(name) == pytest.approx(total / whole)
        if len(set(factors)) > 1:
            assert min(factors) < mean_stiffness(name) < max(factors)


@pytest.mark.parametrize("name", MESHES)
def test_all_parts_hang_together_and_no_two_nodes_stand_at_one_place(name: str) -> None:
    model = fixture(MESHES[name])
    assert len(np.unique(model.nodes.round(6), axis=0)) == len(model.nodes)
    of = {group: set(model.elements[group].ravel().tolist()) for group in GROUPS}
    assert set().union(*of.values()) == set(range(1, len(model.nodes) + 1))
    for first, second in (
        ("CONCRETE", "BASE"),
        ("BASE", "WALL_LEFT"),
        ("BASE", "WALL_RIGHT"),
        ("BASE", "RIBS"),
        ("WALL_LEFT", "RIBS"),
        ("WALL_LEFT", "BRIDGE"),
        ("WALL_RIGHT", "BRIDGE"),
        ("WALL_LEFT", "EXTENSION_LEFT"),
        ("WALL_RIGHT", "EXTENSION_RIGHT"),
    ):
        # A face of contact has two lines of nodes at least.
        assert len(of[first] & of[second]) >= 4, (first, second)


@pytest.mark.parametrize("name", MESHES)
def test_nodes_1_to_30_are_the_accelerometers_in_every_mesh(name: str) -> None:
    assert len(SENSORS) == len(set(SENSORS)) == 30  # chapter 6: 30 three axis accelerometers
    np.testing.assert_allclose(fixture(MESHES[name]).nodes[:30], SENSORS)


@pytest.mark.parametrize("name", MESHES)
def test_masses_stand_at_accelerometers_in_every_mesh(name: str) -> None:
    lines = calculix_deck(MESHES[name]).splitlines()
    places = [
        line.split(",")[1]
        for above, line in pairwise(lines)
        if above.startswith("*ELEMENT, TYPE=MASS")
    ]
    values = [line for above, line in pairwise(lines) if above.startswith("*MASS")]
    assert [SENSORS[int(place) - 1] for place in places] == list(MASSES)
    assert [float(value) for value in values] == list(MASSES.values())


def test_springs_stand_at_the_same_places_in_both_meshes() -> None:
    coarse, fine = (fixture(MESHES[name]) for name in ("coarse", "fine"))
    for name in SPRINGS:
        places = [
            {tuple(place) for place in model.nodes[model.springs[name] - 1].tolist()}
            for model in (coarse, fine)
        ]
        assert places[0] == places[1]
        assert len(places[0]) == coarse.springs[name].size == fine.springs[name].size
        # Symmetric about both middle planes, so the ground alone turns no mode.
        assert {(-x, y, z) for x, y, z in places[0]} == places[0]
        assert {(x, y, -z) for x, y, z in places[0]} == places[0]


def test_sides_have_the_stiffness_of_the_thesis() -> None:
    # Chapter 6: 0.01 N/mm^3 on the side surfaces; two faces of 550 x 100 and of 600 x 100 mm.
    springs = fixture(MESHES["coarse"]).springs
    for name, area in (("SIDE_X", 2 * 55_000.0), ("SIDE_Z", 2 * 60_000.0)):
        total = SPRINGS[name].stiffness * springs[name].size
        assert total == pytest.approx(0.01 * area, rel=0.01)


def test_stiffnesses_of_table_25_are_true_parameters_of_the_deck(folder: Path) -> None:
    campaign = load_campaign(folder / "fixture.yaml")
    values = [campaign.case.solver.deck.deck_value(item) for item in campaign.parameters.parameters]
    assert values == [5_000.0, 45_000.0, 5_000.0, 205_000.0, 205_000.0]
    updated = campaign.case.solver.deck.write_updated({"K_x": 1.5}, folder / "updated").read_text()
    before = calculix_deck(MESHES["fine"]).splitlines()
    pairs = zip(before, updated.splitlines(), strict=True)
    assert [pair for pair in pairs if pair[0] != pair[1]] == [("5000.0", "7500.0")]


def test_thirteen_candidates_hold_the_proposed_five_at_1_2_3_5_and_13(folder: Path) -> None:
    candidates = load_campaign(folder / "fixture_candidates.yaml").parameters.parameters
    proposed = load_campaign(folder / "fixture.yaml").parameters.parameters
    assert len(candidates) == 13
    assert tuple(candidates[number - 1] for number in (1, 2, 3, 5, 13)) == proposed
    assert {target for item in candidates for target in item.targets} == {*GROUND, *GROUPS}
    for item in candidates:  # what the test was made with can be reached, of springs in the mean
        (target,) = item.targets
        truth = MODULI[target] if target in MODULI else mean_stiffness(target)
        assert item.lower < truth < item.upper


@pytest.mark.parametrize(
    ("setting", "expected"),
    [
        ("model.solver=nastran", "is not a Nastran deck"),
        ("parameters=[{name: K, quantity: spring_stiffness, elset: FOUNDATION}]", "did you mean"),
    ],
)
def test_what_does_not_fit_the_fixture_is_refused(
    folder: Path, setting: str, expected: str
) -> None:
    with pytest.raises(CampaignError) as caught:
        load_campaign(folder / "fixture.yaml", [setting])
    assert expected in str(caught.value)


def test_noise_is_seeded_and_knows_no_sign() -> None:
    shapes = np.random.default_rng(1).standard_normal((90, 2))
    modes = mode_set([100.0, 200.0], shapes, np.repeat(np.arange(1, 31), 3), np.tile([1, 2, 3], 30))
    turned = mode_set([100.0, 200.0], -shapes, modes.nodes, modes.components)
    once, again = measured(modes), measured(turned)
    np.testing.assert_array_equal(once.mode_shapes, again.mode_shapes)
    apart = once.frequencies_hz / modes.frequencies_hz - 1.0
    assert 0.0 < np.abs(apart).max() < 4.0 * FREQUENCY_NOISE


def test_the_test_file_is_what_its_generator_writes(folder: Path, tmp_path: Path) -> None:
    need_ccx(folder)
    made = tmp_path / "made"
    made.mkdir()
    write_twin(made)
    fresh = (made / "measured.csv").read_text().splitlines()
    kept = (CONFIGS / "measured.csv").read_text().splitlines()
    assert len(fresh) == len(kept)
    for new, old in zip(fresh, kept, strict=True):
        if new.startswith(("#", "mode")):
            assert new == old
            continue
        numbers = [np.array(line.split(",")[1:], dtype=float) for line in (new, old)]
        # ccx prints seven digits; another build of it may differ in the last ones.
        np.testing.assert_allclose(numbers[0], numbers[1], rtol=1e-4, atol=1e-3)
