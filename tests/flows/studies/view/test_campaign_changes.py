"""Pairs, poles and landmarks as changes of campaign files, on structures of several kinds."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from modetune.adapters.test_files.geometry_csv import write_geometry_csv
from modetune.adapters.test_files.hdf5 import write_test_hdf5
from modetune.adapters.test_files.measurements import read_measurement
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.adapters.test_files.universal.file import write_universal
from modetune.adapters.yaml_file import read_yaml
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import Measurement, TestGeometry
from modetune.core.modes import Floats, MeasuredModes, mode_set
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.studies.view.campaign_changes import Change, Part, configuration_names, part_of
from modetune.flows.studies.view.landmarks import (
    landmarks_change,
    sensors_json,
)
from modetune.flows.studies.view.pairs import pairs_change, pairs_json
from modetune.flows.studies.view.poles import poles_change, poles_json
from tests.flows.studies.test_identify import FREQUENCIES, measured

BAND = (8.0, 140.0)
#: Shells of a quarter of a drum's skin, and beams of a mast with a boom.
SKIN = "SOL 103\nCEND\nBEGIN BULK\n{}ENDDATA\n"
MAST = "*NODE\n{}*ELEMENT, TYPE=B31, ELSET=ALL\n{}*STEP\n*FREQUENCY\n4\n*END STEP\n"


def written(change: Change) -> Part:
    """The campaign file after a change."""
    change.write(change.base)
    return part_of(read_yaml(change.source.path, "a campaign"))


def campaign(folder: Path, text: str) -> Part:
    (folder / "campaign.yaml").write_text(text)
    return part_of(read_yaml(folder / "campaign.yaml", "a campaign"))


def of_functions(folder: Path, modes: str) -> Part:
    """A campaign whose test is known by functions; its deck is never read."""
    write_test_hdf5(folder / "frfs.h5", Measurement(frfs=measured(noise=0.005)))
    return campaign(
        folder,
        "name: bell\nmodel: {deck: bell.inp, units: m-kg-s}\n"
        f"test: {{modes: {modes}}}   # cast 1890\n"
        "parameters: [{name: E, quantity: youngs_modulus, material: BRONZE, bounds: [0.5, 2]}]\n",
    )


def test_functions_alone_get_modes_of_poles_that_are_picked(tmp_path: Path) -> None:
    source = of_functions(tmp_path, "frfs.h5")
    told: Any = poles_json(source, BAND, 40)
    chosen = sorted(track["hz"] for track in told["tracks"] if track["picked"])
    # Two of them 1 % apart; noise of 0.5 % moves a frequency by far less than its half-width.
    assert chosen == pytest.approx(FREQUENCIES, rel=2e-4)
    pick = [hz for hz in chosen if hz < 100.0]
    change = poles_change(source, BAND, 40, pick)
    assert any("with 6 modes" in note for note in change.notes)
    assert not (tmp_path / "campaign-picked.csv").exists()  # it is only shown
    after = written(change)
    assert after.at("test", "modes") == ["campaign-picked.csv", "frfs.h5"]
    assert "# cast 1890" in after.source.text
    found = read_measurement([tmp_path / "campaign-picked.csv"]).modes
    assert found is not None
    assert found.modes.frequencies_hz == pytest.approx(FREQUENCIES[:6], rel=2e-4)
    # A second choice takes the place of the first, in the same file.
    again = written(poles_change(after, BAND, 40, pick[:3]))
    assert again.source.text == after.source.text
    told = poles_json(again, BAND, 40)
    assert sum(track["picked"] for track in told["tracks"]) == 3


def test_points_of_the_file_whose_modes_are_replaced_are_kept(tmp_path: Path) -> None:
    nodes = np.arange(1, 15)
    ring = np.stack([np.cos(nodes), np.sin(nodes), 0.1 * nodes], axis=1)
    geometry = TestGeometry(nodes, ring, np.tile(np.eye(3), (14, 1, 1)),
                            np.zeros((0, 2), int), np.zeros((0, 3), int), 1.0)  # fmt: skip
    old = MeasuredModes((1,), mode_set([20.0], np.ones((14, 1)), nodes, np.full(14, 3)))
    write_universal(tmp_path / "old.unv", Measurement(old, geometry))
    source = of_functions(tmp_path, "[old.unv, frfs.h5], use: [1]")
    change = poles_change(source, BAND, 40, [20.0, 33.0])
    assert "modes are renumbered from 1: check test.use" in change.notes
    after = written(change)
    assert after.at("test", "modes") == ["campaign-picked.unv", "frfs.h5"]
    kept = read_measurement([tmp_path / "campaign-picked.unv"]).geometry
    assert kept is not None
    assert kept.coordinates == pytest.approx(ring, abs=1e-6)  # as many digits as the format has


def test_modes_and_functions_in_one_file_cannot_be_replaced(tmp_path: Path) -> None:
    source = of_functions(tmp_path, "frfs.h5")
    both = read_measurement([tmp_path / "frfs.h5"])
    modes = MeasuredModes((1,), mode_set([20.0], np.ones((1, 1)), [1], [3]))
    write_test_hdf5(tmp_path / "frfs.h5", Measurement(modes, frfs=both.frfs))
    with pytest.raises(CampaignError, match="contains only the functions"):
        poles_change(source, BAND, 40, [20.0])
    with pytest.raises(CampaignError, match="no pole is selected"):
        poles_change(source, BAND, 40, [])


def test_a_test_without_functions_has_no_diagram(tmp_path: Path) -> None:
    (tmp_path / "hz.csv").write_text("mode,1\nfrequency_hz,3.5\n")
    with pytest.raises(CampaignError, match=r"hz\.csv: found no frequency response functions"):
        poles_json(of_functions(tmp_path, "hz.csv"), BAND, 40)


def test_frequencies_alone_are_paired_by_hand_and_the_solver_is_asked_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MODETUNE_STORE", raising=False)
    (tmp_path / "pipe.yaml").write_text(
        "masses: {m1: 2.0, m2: 1.0, m3: 0.5}\nsprings:\n"
        "  k1: {between: [ground, m1], stiffness: 900.0}\n"
        "  k2: {between: [m1, m2], stiffness: 500.0}\n"
        "  k3: {between: [m2, m3], stiffness: 300.0}\n"
    )
    (tmp_path / "hz.csv").write_text("mode,1,2\nfrequency_hz,2.0,4.5\n")
    source = campaign(
        tmp_path,
        "name: pipe\nmodel: {deck: pipe.yaml, solver: matrices, units: m-kg-s}\n"
        "test: {modes: hz.csv}\n"
        "parameters: [{name: k, quantity: spring_stiffness, elset: k1, bounds: [0.5, 2]}]\n",
    )
    loaded = load_campaign(source.source.path)
    assert pairs_json(loaded, False, threading.Event()) == {"unsolved": True}
    told: Any = pairs_json(loaded, True, threading.Event())
    assert told["mac"] is None
    # By LAPACK on the matrices that the file says.
    k = np.array([[1400.0, -500.0, 0.0], [-500.0, 800.0, -300.0], [0.0, -300.0, 300.0]])
    root = np.sqrt([2.0, 1.0, 0.5])
    wanted = np.sqrt(np.linalg.eigvalsh(k / np.outer(root, root))) / (2.0 * np.pi)
    assert told["elastic_hz"] == pytest.approx(wanted, rel=1e-9)
    after = written(pairs_change(source, {1: 1, 2: 3}))
    assert "test: {modes: hz.csv, pairs: {1: 1, 2: 3}}\n" in after.source.text
    told = pairs_json(load_campaign(source.source.path), False, threading.Event())
    assert told["by_hand"] == {"1": 1, "2": 3}
    assert told["paired"] == {"1": 1, "2": 3}


def laid(pose: Any, points: Floats) -> Floats:
    """Points (n, 3) of the test where a pose lays them."""
    turned = points @ np.array(pose["rotation"]).T
    return np.asarray(pose["scale"] * turned + np.array(pose["translation"]))


def skin_deck() -> tuple[str, Floats, str]:
    """A dish of CQUAD4 in a Nastran deck."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(5.0), np.arange(4.0)))
    places = np.stack([x, 1.7 * y, 0.1 * x**2 + 0.2 * y], axis=1)
    lines = [f"GRID,{n},,{a},{b},{c}\n" for n, (a, b, c) in enumerate(places.tolist(), start=1)]
    corners = [row * 5 + column + 1 for row in range(3) for column in range(4)]
    lines += [f"CQUAD4,{n},1,{n},{n + 1},{n + 6},{n + 5}\n" for n in corners]
    lines += ["PSHELL,1,1,0.1,1\n", "MAT1,1,7.+10,,0.3,2700.\n"]
    return SKIN.format("".join(lines)), places, "mystran"


def mast_deck() -> tuple[str, Floats, str]:
    """A mast with a boom, of beams: a model without a surface."""
    up = [(0.0, 0.0, float(z)) for z in range(6)]
    places = np.array([*up, (1.0, 0.0, 5.0), (2.0, 0.5, 5.0), (3.0, 1.5, 4.5)])
    nodes = [f"{n}, {x}, {y}, {z}\n" for n, (x, y, z) in enumerate(places.tolist(), start=1)]
    elements = [f"{n}, {n}, {n + 1}\n" for n in range(1, len(places))]
    return MAST.format("".join(nodes), "".join(elements)), places, "calculix"


@pytest.mark.parametrize("deck", [skin_deck, mast_deck])
def test_landmarks_lie_where_they_were_put_on_shells_and_on_beams(
    tmp_path: Path, deck: Any
) -> None:
    text, places, solver = deck()
    (tmp_path / "model.dat").write_text(text)
    turn = Rotation.from_rotvec([0.4, -2.0, 1.1])
    rows = np.array([0, 3, len(places) - 1, len(places) - 2])
    points = 1000.0 * turn.apply(places[rows]) + [5.0, 6.0, 7.0]  # in mm
    numbers = np.array([11, 12, 13, 14])
    frames, lines = np.tile(np.eye(3), (4, 1, 1)), np.array([[11, 12], [12, 13]])
    geometry = TestGeometry(numbers, points, frames, lines, np.zeros((0, 3), int), 0.001)
    write_geometry_csv(tmp_path / "points.csv", geometry)
    shapes = mode_set([3.0], np.ones((4, 1)), numbers, np.full(4, 1))
    write_modes_csv(tmp_path / "modes.csv", (1,), shapes, ())
    source = campaign(
        tmp_path,
        f"name: it\nmodel: {{deck: model.dat, solver: {solver}, units: m-kg-s}}\n"
        "test:\n  modes: [modes.csv, points.csv]\n"
        "  sensors:   # Bo's sketch\n    align: none\n    tolerance: 0.3   # wide\n"
        "parameters: [{name: E, quantity: youngs_modulus, material: M, bounds: [0.5, 2]}]\n",
    )
    told: Any = sensors_json(source)
    assert told["points"] == [11, 12, 13, 14]
    assert set(told["nodes"]) == set(range(1, len(places) + 1))
    change = landmarks_change(source, {11: 1, 12: 4, 13: len(places)})
    assert "fitted to 3 points" in change.notes[0]
    after = written(change)
    assert after.at("test", "sensors") == {
        "tolerance": 0.3, "match": {11: 1, 12: 4, 13: len(places)}
    }  # fmt: skip
    assert "# Bo's sketch" in after.source.text
    assert "# wide" in after.source.text
    told = sensors_json(after)
    # The fourth point was no landmark; the file of points has 16 digits of lengths up to 5000.
    assert laid(told["pose"], points) == pytest.approx(places[rows], abs=1e-9)


def test_what_is_no_place_is_told(tmp_path: Path) -> None:
    (tmp_path / "model.dat").write_text(mast_deck()[0])
    (tmp_path / "modes.csv").write_text("mode,1\nfrequency_hz,3.0\n2.x,1.0\n3.x,0.5\n")
    source = campaign(
        tmp_path,
        "name: it\nmodel: {deck: model.dat, units: m-kg-s}\ntest: {modes: modes.csv}\n"
        "parameters: [{name: E, quantity: youngs_modulus, material: M, bounds: [0.5, 2]}]\n",
    )
    with pytest.raises(CampaignError, match="has no coordinates"):
        sensors_json(source)
    fit = campaign(tmp_path, source.source.text.replace("csv}", "csv, sensors: {align: fit}}"))
    with pytest.raises(CampaignError, match="has no coordinates"):
        landmarks_change(fit, {11: 1})
    with pytest.raises(CampaignError, match="3 landmarks that are not on one line"):
        landmarks_change(source, {11: 1, 12: 2})


def test_a_file_keeps_its_link_and_permissions_and_is_not_written_over_another_change(
    tmp_path: Path,
) -> None:
    source = of_functions(tmp_path, "hz.csv")
    real = tmp_path / "kept" / "real.yaml"
    real.parent.mkdir()
    source.source.path.rename(real)
    source.source.path.symlink_to(real)
    real.chmod(0o640)
    change = pairs_change(source, {1: 2})
    assert change.to_json()["diff"] != []
    written(change)
    assert source.source.path.is_symlink()
    assert real.stat().st_mode & 0o777 == 0o640
    assert "pairs: {1: 2}" in real.read_text()
    now = part_of(read_yaml(source.source.path, "a campaign"))
    with pytest.raises(CampaignError, match="has changed since"):
        pairs_change(now, {1: 3}).write(change.base)
    with pytest.raises(CampaignError, match=r"test\.pairs"):
        pairs_change(now, {1: 0})


def test_each_configuration_has_pairs_and_a_place_of_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MODETUNE_STORE", raising=False)
    for name, top in (("empty", 0.5), ("full", 2.0)):
        (tmp_path / f"{name}.yaml").write_text(
            f"masses: {{m1: 2.0, m2: {top}}}\nsprings:\n"
            "  k1: {between: [ground, m1], stiffness: 900.0}\n"
            "  k2: {between: [m1, m2], stiffness: 500.0}\n"
        )
    (tmp_path / "hz.csv").write_text("mode,1,2\nfrequency_hz,2.0,4.5\n")
    source = campaign(
        tmp_path,
        "name: silo\nconfigurations:   # weighed by Kim\n"
        "  - name: empty\n    model: {deck: empty.yaml, solver: matrices, units: m-kg-s}\n"
        "    test: {modes: hz.csv}\n"
        "  - name: full\n    model: {deck: full.yaml, solver: matrices, units: m-kg-s}\n"
        "    test: {modes: hz.csv}   # in June\n"
        "parameters: [{name: k, quantity: spring_stiffness, elset: k1, bounds: [0.5, 2]}]\n",
    )
    assert configuration_names(source.source) == ["empty", "full"]
    loaded = load_campaign(source.source.path)
    hz: dict[str, Any] = {
        name: pairs_json(loaded, True, threading.Event(), name)["elastic_hz"]
        for name in ("empty", "full")
    }
    assert hz["full"][0] < hz["empty"][0]  # four times the mass on top
    full = part_of(source.source, "full")
    after = written(pairs_change(full, {1: 2}))
    assert "    test: {modes: hz.csv, pairs: {1: 2}}   # in June\n" in after.source.text
    assert part_of(after.source, "full").at("test", "pairs") == {1: 2}
    assert part_of(after.source, "empty").at("test", "pairs") is None
    again = part_of(after.source, "full")
    assert written(pairs_change(again, {})).source.text == source.source.text
