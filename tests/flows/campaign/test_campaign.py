"""Campaign files: what is refused, with file and line, all problems at once, before any solver."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.core.errors import CampaignError
from modetune.core.modes import mode_set
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.campaign.test import tracking_nodes

GOOD = """\
name: small
model:
  deck: bar.inp
  solver: calculix
  units: mm-t-s
test: {modes: measured.csv}
parameters:
  - {name: E_bar, quantity: youngs_modulus, material: ALU, bounds: [0.7, 1.3]}
"""
DECK = """\
*NODE
1, 0, 0, 0
2, 10, 0, 0
3, 10, 10, 0
4, 0, 10, 0
5, 0, 0, 10
6, 10, 0, 10
7, 10, 10, 10
8, 0, 10, 10
*ELEMENT, TYPE=C3D8I, ELSET=BAR
1, 1, 2, 3, 4, 5, 6, 7, 8
*MATERIAL, NAME=ALU
*ELASTIC
71000., .3
*DENSITY
2.81e-9
*MATERIAL, NAME=SPARE
*ELASTIC
71000., .3
*SOLID SECTION, ELSET=BAR, MATERIAL=ALU
"""
TEST = "mode,1,2\nfrequency_hz,10,20\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "campaign.yaml").write_text(GOOD)
    (tmp_path / "bar.inp").write_text(DECK)
    (tmp_path / "measured.csv").write_text(TEST)
    return tmp_path


def problems(folder: Path, text: str = GOOD, settings: list[str] | None = None) -> str:
    (folder / "campaign.yaml").write_text(text)
    with pytest.raises(CampaignError) as caught:
        load_campaign(folder / "campaign.yaml", settings)
    return str(caught.value)


def test_a_good_campaign_is_read(folder: Path) -> None:
    campaign = load_campaign(folder / "campaign.yaml")
    assert campaign.parameters.names == ("E_bar",)
    assert campaign.case.solver.deck.deck_value(campaign.parameters.parameters[0]) == 71000.0
    assert campaign.store.folder == folder / ".modetune" / "store"


def test_the_store_can_be_named(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MODETUNE_STORE", "/somewhere/store")
    assert load_campaign(folder / "campaign.yaml").store.folder == Path("/somewhere/store")
    named = load_campaign(folder / "campaign.yaml", ["store=mine"])
    assert named.store.folder == folder / "mine"


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        ("deck:", "dekc:", "model.dekc: unknown key `dekc`; did you mean deck?"),
        (
            "quantity:",
            "quantitty:",
            "parameters.0.quantitty: unknown key `quantitty`; did you mean",
        ),
        (
            "youngs_modulus",
            "Youngs-Modulus",
            "unknown value `Youngs-Modulus`; did you mean youngs_",
        ),
        ("calculix", "calculics", "did you mean calculix?"),
    ],
)
def test_a_name_that_is_not_known_is_told_with_the_nearest(
    folder: Path, right: str, wrong: str, said: str
) -> None:
    assert right in GOOD
    found = problems(folder, GOOD.replace(right, wrong))
    assert said in found
    assert "at least 1 item" not in found  # what follows from it is not told again


def test_all_problems_come_at_once_each_with_its_line(folder: Path) -> None:
    text = GOOD.replace("deck:", "dekc:").replace("[0.7, 1.3]", "[1.3, 0.7]") + "colour: red\n"
    said = problems(folder, text)
    assert "campaign.yaml, line 3" in said
    assert "unknown key `dekc`" in said
    assert "campaign.yaml, line 8" in said
    assert "the lower (1.3) must be below the upper (0.7)" in said
    assert "campaign.yaml, line 9: colour: unknown key `colour`" in said


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("units: mm-t-s", "units: furlongs", "line 5: model.units"),
        ("material: ALU", "material: STEEL", "line 8: parameter E_bar: the deck has no material"),
        ("material: ALU", "material: SPARE", "no element uses material SPARE"),
        ("material: ALU", "part: BAR", "youngs_modulus needs `material`"),
        ("quantity: youngs_modulus", "quantity: colour", "line 8: parameters.0.quantity"),
        ("bounds: [0.7, 1.3]", "bounds: [0.7, .nan]", "line 8: parameters.0.bounds.1"),
        ("bounds: [0.7, 1.3]", "bounds: [1.1, 1.3]", "initial value 1 is outside the bounds"),
        ("deck: bar.inp", "deck: none.inp", "none.inp cannot be read"),
        ("modes: measured.csv", "modes: none.csv", "none.csv cannot be read"),
        ("modes: measured.csv", "modes: measured.csv, use: [1, 7]", "mode 7 is asked for"),
        ("name: small", "name: ../small", "line 1: name"),
        ("name: small", "name: small\nrun: {licences: {nastrn: 2}}", "has the unknown name nastrn"),
        ("name: small", "name: small\nname: twice", "line 2: the key `name` occurs twice"),
        ("name: small", "name: !!python/object:os.system x", "not readable as YAML"),
        ("test:", "test: [", "not readable as YAML"),
    ],
)  # fmt: skip
def test_a_bad_value_is_told_with_its_place(
    folder: Path, old: str, new: str, expected: str
) -> None:
    assert expected in problems(folder, GOOD.replace(old, new))


def test_two_parameters_of_one_name_are_refused(folder: Path) -> None:
    assert "same name" in problems(folder, GOOD + GOOD.splitlines()[-1] + "\n")


def test_two_parameters_on_one_number_are_refused(folder: Path) -> None:
    second = "  - {name: E_again, quantity: youngs_modulus, material: ALU}\n"
    assert "both E_bar and E_again change this number" in problems(folder, GOOD + second)


def test_a_sensor_outside_the_model_is_named(folder: Path) -> None:
    (folder / "measured.csv").write_text(TEST + "8.x,1,2\n77.z,1,2\n")
    said = problems(folder)
    assert "sensor 77: the model has no results at a node 77" in said
    assert "campaign.yaml, line 6" in said


def test_a_component_that_the_solver_does_not_give_is_named(folder: Path) -> None:
    (folder / "measured.csv").write_text(TEST + "8.x,1,2\n8.rz,1,2\n")
    assert "sensor 8.rz: the model's results have no rz" in problems(folder)


def test_nan_in_the_test_names_file_and_line(folder: Path) -> None:
    (folder / "measured.csv").write_text("mode,1,2\nfrequency_hz,10,nan\n")
    assert "measured.csv, line 2" in problems(folder)


def test_shapes_cannot_be_compared_where_none_were_measured(folder: Path) -> None:
    text = GOOD + "residuals: {shape_weight: 1.0}\n"
    assert "line 9: shapes are to be compared" in problems(folder, text)


def test_strain_energies_are_refused_for_what_they_cannot_do(folder: Path) -> None:
    text = GOOD.replace("youngs_modulus", "density") + "sensitivity: {method: strain_energy}\n"
    assert "not proportional to E_bar (density)" in problems(folder, text)
    (folder / "measured.csv").write_text(TEST + "8.x,1,2\n")
    text = GOOD + "residuals: {shape_weight: 1.0}\nsensitivity: {method: strain_energy}\n"
    assert "do not give shape sensitivities" in problems(folder, text)


def test_settings_override_the_file_and_are_checked_like_it(folder: Path) -> None:
    campaign = load_campaign(
        folder / "campaign.yaml",
        ["update.e2=0", "parameters=[{name: k, quantity: density, material: ALU}]"],
    )
    assert campaign.update.e2 == 0.0
    assert campaign.parameters.names == ("k",)
    assert "update.e3" in problems(folder, settings=["update.e3=1"])
    assert "KEY.KEY=VALUE" in problems(folder, settings=["update.e2"])
    assert "KEY.KEY=VALUE" in problems(folder, settings=["name.x=1"])


def test_e2_is_less_where_old_matrices_are_kept_as_they_are(folder: Path) -> None:
    def e2(*settings: str) -> float:
        return load_campaign(folder / "campaign.yaml", list(settings)).update.e2

    assert e2() == 0.2
    assert e2("sensitivity.between=keep") == e2("sensitivity.between=keep", "update.step_limit=1")
    assert e2("sensitivity.between=keep") == 0.002
    assert e2("sensitivity.between=keep", "update.e2=0.2") == 0.2


@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00", b"- a list\n", b"just text"])
def test_what_is_no_campaign_is_told(folder: Path, content: bytes) -> None:
    (folder / "campaign.yaml").write_bytes(content)
    with pytest.raises(CampaignError, match=r"campaign\.yaml"):
        load_campaign(folder / "campaign.yaml")


def test_decks_are_given_not_made(folder: Path) -> None:
    said = problems(folder, GOOD.replace("deck: bar.inp", "generator: {case: garteur}"))
    assert "unknown key `generator`" in said


@pytest.mark.parametrize("n", [7, 200, 8_000, 8_181, 108_000])
def test_tracking_nodes_lie_on_no_line_of_a_regular_mesh(n: int) -> None:
    found = np.array(tracking_nodes(frozenset(range(1, n + 1))))
    assert found.size == min(n, 200)
    # Whatever the number of nodes in a row, all tenths of a row have some.
    for row in (20, 40, 54, 81, 100) if n > 200 else ():
        assert np.unique((found - 1) % row * 10 // row).size == 10


def test_tracking_nodes_are_spread_where_the_test_has_no_sensors(folder: Path) -> None:
    assert load_campaign(folder / "campaign.yaml").case.nodes == (1, 2, 3, 4, 5, 6, 7, 8)
    modes = mode_set([10.0, 20.0], np.ones((2, 2)), [3, 7], [1, 3])
    write_modes_csv(folder / "measured.csv", [1, 2], modes)
    assert load_campaign(folder / "campaign.yaml").case.nodes == (3, 7)
