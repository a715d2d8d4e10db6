"""Campaigns on Nastran decks: the GARTEUR shells through CalculiX, MYSTRAN, and side by side."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from subprocess import CompletedProcess
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from modetune.configs.cases import write_case
from modetune.core.errors import CampaignError
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.studies.check.model import size_findings
from modetune.flows.studies.twin.solver_modes import run_twin
from modetune.flows.updating.mode_source import model_modes
from modetune.flows.updating.record import summary
from modetune.flows.updating.update import update_campaign
from tests.command_line import run_command

MYSTRAN = shutil.which(os.environ.get("MODETUNE_MYSTRAN", "mystran"))
needs_mystran = pytest.mark.skipif(MYSTRAN is None, reason="MYSTRAN is not here (tools/mystran.sh)")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("shell")
    write_case("garteur", folder)
    return folder


@pytest.fixture(scope="module")
def updated(folder: Path) -> CampaignRecord:
    silent: Any = SimpleNamespace(working=lambda text: None, iteration=lambda record: None)
    return update_campaign(load_campaign(folder / "shell.yaml"), folder / "run", silent).record


def test_the_garteur_shells_meet_the_eight_measured_frequencies(updated: CampaignRecord) -> None:
    before, after = (
        np.abs(item.frequency_errors) for item in (updated.iterations[0], updated.best)
    )
    assert before.mean() > 0.04
    # What is asked of this case: mean at most 1.5 %, worst at most 4 %, within 40 % of the deck.
    assert after.mean() <= 0.015
    assert after.max() <= 0.04
    assert len(updated.updated) >= 6
    assert (np.abs(updated.updated - 1.0) < 0.4).all()
    assert updated.parameters.at_bounds(updated.updated) == ()


def test_pairing_says_what_it_did_with_the_two_close_torsions(
    updated: CampaignRecord, folder: Path
) -> None:
    modes: Any = summary(updated, folder)["modes"]
    torsions = [mode for mode in modes if mode["mode"] in (3, 4)]
    assert all("in the space of close elastic modes 3, 4" in mode["pairing"] for mode in torsions)
    assert (updated.best.pairing.judged_mac > 0.9).all()


def test_the_updated_deck_differs_in_the_changed_fields_only(
    updated: CampaignRecord, folder: Path
) -> None:
    before = (folder / "garteur_shell.bdf").read_text().splitlines()
    after = (folder / "run" / "updated" / "garteur_shell.bdf").read_text().splitlines()
    assert len(before) == len(after)
    changed = [(a, b) for a, b in zip(before, after, strict=True) if a != b]
    # E of materials 1, 2 and 6, E1 and G12 of the MAT8, T of two PSHELL, M of a CONM2.
    assert sorted(a.split(",")[0] for a, _ in changed) == (
        ["CONM2", "MAT1", "MAT1", "MAT1", "MAT8", "PSHELL", "PSHELL"]
    )
    for old, new in changed:
        fields = zip(old.split(","), new.split(","), strict=True)
        assert 1 <= sum(a != b for a, b in fields) <= 2


@needs_mystran
def test_a_twin_run_shows_how_far_calculix_stands_from_mystran(folder: Path) -> None:
    twin = run_twin(folder / "shell.yaml", ["mystran", "calculix", "nastran"], [], [])
    assert [item.solver for item in twin.solvers] == ["mystran", "calculix"]
    assert [solver for solver, _ in twin.absent] == ["nastran"]
    mystran, calculix = twin.solvers
    assert mystran.result.n_rigid == calculix.result.n_rigid == 6
    assert calculix.result.mass == pytest.approx(mystran.result.mass, rel=1e-3)
    # MYSTRAN lumps the mass of its shells: torsion and the higher modes come out low.
    assert np.abs(twin.differences(calculix)[:8]).max() < 0.06
    assert (calculix.pairing.judged_mac[:8] > 0.98).all()


@needs_mystran
def test_the_same_campaign_updates_on_mystran(folder: Path) -> None:
    silent: Any = SimpleNamespace(working=lambda text: None, iteration=lambda record: None)
    campaign = load_campaign(folder / "shell.yaml", ["model.solver=mystran"])
    record = update_campaign(campaign, folder / "mystran", silent).record
    assert record.solver == "mystran"
    # Of one material of a laminate MYSTRAN's matrices are no polynomial.
    methods = set(record.iterations[1].sensitivity_methods)
    assert methods == {"finite_difference", "semi_analytic"}
    assert np.abs(record.best.frequency_errors).mean() <= 0.015


def run(folder: Path, *arguments: str) -> CompletedProcess[str]:
    return run_command(folder, *arguments, MODETUNE_NASTRAN="no-such-nastran")


def test_a_twin_of_one_solver_tells_what_is_missing_and_fails(folder: Path) -> None:
    ended = run(folder, "model", "twin", "shell.yaml", "--json")
    assert ended.returncode == 4
    told = json.loads(ended.stdout)
    assert [item["solver"] for item in told["solvers"]] == ["calculix"]
    assert "`no-such-nastran` is not on this machine" in told["absent"]["nastran"]


def test_a_missing_nastran_is_told_with_its_remedy(folder: Path) -> None:
    ended = run(folder, "modes", "shell.yaml", "--set", "model.solver=nastran")
    assert ended.returncode == 4
    assert "\nmodetune: " in f"\n{ended.stderr}"
    assert "MODETUNE_NASTRAN" in ended.stderr
    assert "Traceback" not in ended.stderr


DECK = """\
SOL 103
CEND
BEGIN BULK
GRID,1,,0.,0.,0.
GRID,2,,1.,0.,0.
GRID,3,,1.,1.,0.
GRID,4,,0.,1.,0.
CQUAD4,1,1,1,2,3,4
PSHELL,1,1,.01,1,,1
MAT1,1,7.+10,,.3,2700.
ENDDATA
"""
STRANGE = "RSPLINE,2,,1,2,123456,3\nCGAP,3,3,1,2,1.,0.,0.\nPGAP,3\nENDDATA\n"
CAMPAIGN = """\
name: cards
model: {deck: cards.bdf, units: m-kg-s}
test: {modes: cards.csv}
parameters: [{name: E, quantity: youngs_modulus, material: 1}]
"""


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("material: 1", "material: 7", "material 7"),
        ("material: 1", "elset: SKIN", "a Nastran deck has no element sets"),
        ("youngs_modulus, material: 1", "thickness, elset: SKIN", "name a property or"),
        ("youngs_modulus, material: 1", "spring_stiffness, property: 1", "line 9: PSHELL 1"),
        ("cards.bdf,", "cards.bdf, solver: matrices,", "cards.bdf"),
    ],
)
def test_what_cannot_be_is_refused_before_a_solver_runs(
    tmp_path: Path, old: str, new: str, said: str
) -> None:
    (tmp_path / "cards.bdf").write_text(DECK)
    (tmp_path / "cards.csv").write_text("mode,1\nfrequency_hz,10.\n")
    (tmp_path / "cards.yaml").write_text(CAMPAIGN.replace(old, new))
    with pytest.raises(CampaignError, match=said):
        load_campaign(tmp_path / "cards.yaml")


def test_all_cards_that_cannot_be_translated_are_told_at_once(tmp_path: Path) -> None:
    (tmp_path / "cards.bdf").write_text(DECK.replace("ENDDATA\n", STRANGE))
    (tmp_path / "cards.csv").write_text("mode,1\nfrequency_hz,10.\n")
    (tmp_path / "cards.yaml").write_text(CAMPAIGN)
    with pytest.raises(CampaignError) as refusal:
        load_campaign(tmp_path / "cards.yaml")
    assert all(card in str(refusal.value) for card in ("RSPLINE", "CGAP"))


def test_a_calculix_deck_is_no_nastran_deck(tmp_path: Path) -> None:
    (tmp_path / "cards.bdf").write_text("** a model\n*NODE\n1, 0., 0., 0.\n")
    (tmp_path / "cards.csv").write_text("mode,1\nfrequency_hz,10.\n")
    (tmp_path / "cards.yaml").write_text(
        CAMPAIGN.replace("cards.bdf,", "cards.bdf, solver: nastran,")
    )
    with pytest.raises(CampaignError, match="is not a Nastran deck; `solver: calculix`"):
        load_campaign(tmp_path / "cards.yaml")


SHEET = """\
name: sheet
model: {deck: sheet.bdf, units: m-kg-s}
test: {modes: sheet.csv}
parameters:
  - {name: rho, quantity: density, material: 1}
  - {name: E, quantity: youngs_modulus, material: 1}
"""


def sheet(thickness: str, case: str = "", extra: str = "") -> str:
    """A clamped plate, 1 x 0.6 m, 6 x 4 CQUAD4."""
    grids = [
        f"GRID,{1 + i + 7 * j},,{i / 6:.6f},{0.15 * j:.6f},0." for j in range(5) for i in range(7)
    ]
    quads = [
        f"CQUAD4,{1 + i + 6 * j},1,{n},{n + 1},{n + 8},{n + 7}"
        for j in range(4)
        for i in range(6)
        for n in (1 + i + 7 * j,)
    ]
    clamp = ",".join(str(1 + 7 * j) for j in range(5))
    return "\n".join(
        [
            "SOL 103",
            "CEND",
            "SPC 1",
            *case.splitlines(),
            "BEGIN BULK",
            *grids,
            *quads,
            f"PSHELL,1,1,{thickness},1,,1",
            "MAT1,1,7.+10,,.3,2700.",
            f"SPC1,1,123456,{clamp}",
            *extra.splitlines(),
            "ENDDATA",
            "",
        ]
    )


def sheet_campaign(folder: Path, deck: str) -> Path:
    (folder / "sheet.bdf").write_text(deck)
    (folder / "sheet.csv").write_text("mode,1,2\nfrequency_hz,1.,5.\n")
    (folder / "sheet.yaml").write_text(SHEET)
    return folder / "sheet.yaml"


def test_a_mass_factor_of_the_case_control_counts(tmp_path: Path) -> None:
    modes = []
    for name, case, extra in (
        ("bulk", "", "PARAM,WTMASS,.25"),
        ("case", "PARAM,WTMASS,.25", ""),
        ("none", "", ""),
    ):
        folder = tmp_path / name
        folder.mkdir()
        campaign = load_campaign(sheet_campaign(folder, sheet(".01", case, extra)))
        modes.append(model_modes(campaign, {}))
    assert modes[0].mass == modes[1].mass == pytest.approx(0.25 * modes[2].mass)
    assert modes[1].n_rigid == 0  # `SPC 1` without an equals sign holds it too
    ratio = modes[1].modes.frequencies_hz / modes[2].modes.frequencies_hz
    np.testing.assert_allclose(ratio, 2.0, rtol=1e-5)


def test_selections_that_a_translation_would_lose_are_refused(tmp_path: Path) -> None:
    path = sheet_campaign(tmp_path, sheet(".01", "A2GG = ADDED\nPARAM,CK1,3."))
    with pytest.raises(CampaignError, match=r"(?s)case control A2GG.*case control.*PARAM,CK1,3"):
        load_campaign(path)


def test_a_very_thin_sheet_is_updated_by_its_matrices(tmp_path: Path, caplog: Any) -> None:
    # 1 mm thick at 125 mm of length: the unknowns are the shell's own, not those of two faces.
    silent: Any = SimpleNamespace(working=lambda text: None, iteration=lambda record: None)
    campaign = load_campaign(
        sheet_campaign(tmp_path, sheet(".001")),
        ["update.max_iterations=1", "test.pairs={1: 1, 2: 2}"],
    )
    record = update_campaign(campaign, tmp_path / "run", silent).record
    assert "finite_difference is used in place of" not in caplog.text
    assert "finite_difference" not in set(record.iterations[1].sensitivity_methods)


@needs_mystran
def test_a_twin_pairs_modes_by_more_than_the_tests_few_sensors(tmp_path: Path) -> None:
    path = sheet_campaign(tmp_path, sheet(".008"))
    (tmp_path / "sheet.csv").write_text("mode,1,2\nfrequency_hz,6.,20.\n7.z,1.,1.\n35.z,1.,-1.\n")
    twin = run_twin(path, ["mystran", "calculix"], [], [])
    assert twin.solvers[1].pairing.mac[:4].min() > 0.99


@needs_mystran
def test_masses_that_are_not_those_the_deck_asks_for_are_named_as_the_reason(
    tmp_path: Path,
) -> None:
    for extra, said in (("", ""), ("PARAM,COUPMASS,1", "the deck asks for consistent masses")):
        folder = tmp_path / (extra or "lumped")
        folder.mkdir()
        path = sheet_campaign(folder, sheet(".008", "", extra))
        twin = run_twin(path, ["mystran", "calculix"], [], ["test.pairs={1: 1, 2: 2}"])
        reasons = {item.solver: item.masses for item in twin.solvers}
        assert reasons["calculix"] == ""
        assert reasons["mystran"].startswith(said)
        assert bool(reasons["mystran"]) == bool(said)
        campaign = load_campaign(path, ["model.solver=mystran", "test.pairs={1: 1, 2: 2}"])
        found = [item for item in size_findings(campaign) if "COUPMASS" in item.what]
        assert [(item.level, item.where) for item in found] == (
            [("doubtful", "model.solver")] if said else []
        )


@needs_mystran
def test_a_frame_with_fewer_modes_than_requested_stays_on_its_matrices(
    tmp_path: Path, caplog: Any
) -> None:
    # Two masses without inertia on massless bars: six modes, and as many are needed to pair three.
    lines = [
        "SOL 103\nCEND\nMETHOD = 1\nBEGIN BULK\nEIGRL,1,,,6\nMAT1,1,2.1E11,,.3",
        "PBAR,1,1,1.E-4,2.E-8,1.E-8,2.E-8\nGRID,1,,0.,0.,0.,,123456",
        "GRID,2,,.1,0.,.9\nGRID,3,,.7,.2,1.3\nGRID,4,,-.6,-.3,1.2",
        *(f"CBAR,{i},1,{a},{b},.3,.5,.7" for i, a, b in ((1, 1, 2), (2, 2, 3), (3, 2, 4))),
        "CONM2,5,3,,1.5\nCONM2,6,4,,.8\nENDDATA",
    ]
    (tmp_path / "fork.bdf").write_text("\n".join(lines) + "\n")
    campaign = tmp_path / "campaign.yaml"
    campaign.write_text(
        "name: fork\nmodel: {deck: fork.bdf, solver: mystran, units: m-kg-s}\n"
        "test: {modes: modes.csv}\nparameters:\n"
        "  - {name: E, quantity: youngs_modulus, material: 1, bounds: [0.7, 1.4]}\n"
    )

    def write(frequencies: Any) -> None:
        rows = ("mode,1,2,3", "frequency_hz," + ",".join(f"{hz:.9g}" for hz in frequencies))
        (tmp_path / "modes.csv").write_text("\n".join(rows) + "\n")

    write((1.7, 1.8, 4.4))  # replaced by the model's own
    there = model_modes(load_campaign(campaign), {}).modes.frequencies_hz
    assert there.size == 6
    write(there[:3] * np.sqrt(1.2))
    silent: Any = SimpleNamespace(working=lambda text: None, iteration=lambda record: None)
    record = update_campaign(load_campaign(campaign), tmp_path / "run", silent).record
    assert record.updated == pytest.approx([1.2], rel=1e-3)
    assert "6 unknowns that have mass: all 6 are used" in caplog.text
    assert "modes are the solver's own" not in caplog.text
