"""Decks with several subcases or steps: what commands take, propose and report."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from modetune.core.errors import CampaignError
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.campaign.schema import OpenFile
from modetune.flows.studies.init.draft import init_campaign
from tests.adapters.calculix import test_steps as steps
from tests.adapters.nastran import test_subcases as subcases
from tests.adapters.solved import needs_ccx, needs_mystran
from tests.command_line import run_command


def written(folder: Path, name: str, text: str) -> Path:
    (folder / name).write_text(text)
    return folder / name


@pytest.fixture
def nastran(tmp_path: Path) -> Path:
    return written(tmp_path, "model.bdf", subcases.CASES + subcases.BEAM)


@pytest.fixture
def calculix(tmp_path: Path) -> Path:
    return written(tmp_path, "beam.inp", steps.BEAM + steps.FREE + steps.TENSION + steps.LOADED)


def frequencies(folder: Path, *arguments: str) -> tuple[list[float], str]:
    said = run_command(folder, "modes", *arguments, "--json")
    assert said.returncode == 0, said.stderr
    found: list[float] = json.loads(said.stdout)["frequencies_hz"]
    return found, said.stderr


@needs_mystran
def test_modes_takes_a_subcase_of_a_deck_and_of_a_campaign(nastran: Path) -> None:
    folder = nastran.parent
    alone = f"SOL 103\nCEND\n{subcases.ALONE[2]}BEGIN BULK\n{subcases.BEAM}"
    written(folder, "alone.bdf", alone)
    written(
        folder,
        "campaign.yaml",
        "name: beam\nmodel: {deck: model.bdf, solver: mystran, units: m-kg-s, subcase: 2}\n",
    )
    of_deck, _ = frequencies(folder, "model.bdf", "--subcase", "2", "--solver", "mystran")
    of_campaign, _ = frequencies(folder, "campaign.yaml")
    expected, _ = frequencies(folder, "alone.bdf", "--solver", "mystran")
    assert of_deck[: len(of_campaign)] == expected[: len(of_campaign)] == of_campaign
    other, _ = frequencies(folder, "campaign.yaml", "--subcase", "1")
    assert other[0] != expected[0]


@needs_ccx
def test_modes_and_check_take_a_step_and_report_the_default(calculix: Path) -> None:
    folder = calculix.parent
    last, said = frequencies(folder, "beam.inp", "--units", "mm-t-s")
    assert "the modes are those of step 3, the last with *FREQUENCY" in " ".join(said.split())
    first, said = frequencies(folder, "beam.inp", "--units", "mm-t-s", "--step", "1")
    assert "the modes are those of" not in said
    assert last[0] > 1.5 * first[0]
    checked = run_command(folder, "check", "beam.inp", "--units", "mm-t-s")
    assert "the modes are those of step 3" in " ".join((checked.stdout + checked.stderr).split())


def test_init_proposes_a_subcase_and_lists_the_others(nastran: Path) -> None:
    draft = init_campaign(nastran, settings=["model.solver=nastran"])
    text = (nastran.parent / "campaign.yaml").read_text()
    assert "\n  subcase: 2\n" in text
    said = " ".join(line.strip("# ") for line in text.splitlines())
    assert "PLEASE CHECK: subcase 2 (HINGED, METHOD = 7, SPC = 2) of several" in said
    assert "others: 1 (CLAMPED, SPC = 1), 40 (TIED, MPC = 5)." in said
    assert [item.number for item in draft.cases] == [1, 2, 40]
    load_campaign(draft.path, [], OpenFile)
    written(nastran.parent, "model.bdf", subcases.TWO + subcases.BEAM)  # which modes is open
    init_campaign(nastran, settings=["model.solver=nastran"], force=True)
    assert "\n  subcase: 1\n" in draft.path.read_text()
    written(nastran.parent, "model.bdf", subcases.CASES + subcases.BEAM)
    init_campaign(nastran, settings=["model.solver=nastran", "model.subcase=40"], force=True)
    assert "\n  subcase: 40\n" in (nastran.parent / "campaign.yaml").read_text()


def test_init_proposes_the_last_step_and_lists_the_others(calculix: Path) -> None:
    said = run_command(calculix.parent, "init", "beam.inp", "--units", "mm-t-s", "--json")
    assert said.returncode == 0, said.stderr
    found = json.loads(said.stdout)
    assert (found["subcase"], found["step"]) == (None, 3)
    assert [item["number"] for item in found["cases"]] == [1, 3]
    assert "\n  step: 3\n" in (calculix.parent / "campaign.yaml").read_text()
    shown = run_command(calculix.parent, "init", "beam.inp", "--step", "1", "--force")
    assert "step     1 (line" in shown.stdout
    assert "\n  step: 1\n" in (calculix.parent / "campaign.yaml").read_text()


@pytest.mark.parametrize(
    ("deck", "solver", "key", "said"),
    [
        ("model.bdf", "calculix", "step: 1", "is a Nastran deck: `model.subcase` chooses among"),
        ("beam.inp", "calculix", "subcase: 1", "is a CalculiX deck: `model.step` chooses among"),
        ("model.bdf", "nastran", "step: 1", "`step` is for CalculiX decks"),
        ("frame.yaml", "matrices", "subcase: 1", "`subcase` is for Nastran decks"),
        ("model.bdf", "nastran", "subcase: 0", "greater than or equal to 1"),
        ("model.bdf", "nastran", "subcase: 3", "has no subcase 3; it has 1 (CLAMPED"),
    ],
)
def test_a_choice_that_a_deck_does_not_have_is_refused(
    deck: str, solver: str, key: str, said: str, nastran: Path, calculix: Path
) -> None:
    path = written(
        nastran.parent,
        "campaign.yaml",
        f"name: beam\nmodel:\n  deck: {deck}\n  solver: {solver}\n  units: m-kg-s\n  {key}\n",
    )
    with pytest.raises(CampaignError) as caught:
        load_campaign(path, [], OpenFile)
    assert said in str(caught.value)
    assert "campaign.yaml, line" in str(caught.value)
