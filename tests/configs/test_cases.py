"""Campaigns of configs/, whose decks are written and not kept."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from modetune.configs import cases
from modetune.configs.cases import case_of, write_case, write_own_decks
from tests.command_line import run_command

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def test_a_copy_without_its_deck_names_the_command_that_writes_it(tmp_path: Path) -> None:
    for name in ("mast.yaml", "measured.csv"):
        shutil.copyfile(CONFIGS / "mast" / name, tmp_path / name)
    done = run_command(tmp_path, "check", "mast.yaml", "--no-run")
    assert done.returncode == 2
    assert "mast.inp cannot be read" in done.stderr
    assert "`python -m modetune.configs.cases mast .` writes it" in done.stderr
    write_case("mast", tmp_path)  # what that command does
    assert run_command(tmp_path, "check", "mast.yaml", "--no-run").returncode == 0


def test_a_campaign_of_ones_own_names_no_command(tmp_path: Path) -> None:
    text = (CONFIGS / "mast" / "mast.yaml").read_text()
    (tmp_path / "mast.yaml").write_text(text.replace("mast.inp", "other.inp"))
    assert case_of(tmp_path / "mast.yaml") == ""
    done = run_command(tmp_path, "check", "mast.yaml", "--no-run")
    assert "modetune.configs" not in done.stderr


def test_tests_that_are_not_kept_name_what_makes_them(tmp_path: Path) -> None:
    shutil.copyfile(CONFIGS / "garteur" / "lab.yaml", tmp_path / "lab.yaml")
    done = run_command(tmp_path, "check", "lab.yaml", "--no-run")
    assert "lab.unv: `python -m modetune.configs.garteur.lab .` writes it" in done.stderr
    assert "modes.csv: the first lines of lab.yaml" in done.stderr


def test_a_campaign_in_a_clone_writes_its_decks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clone = tmp_path / "clone"
    shutil.copytree(CONFIGS / "mast", clone / "configs" / "mast")
    monkeypatch.setattr(cases, "__file__", str(clone / "configs" / "cases.py"))
    campaign = clone / "configs" / "mast" / "mast.yaml"
    deck = campaign.with_name("mast.inp")
    deck.unlink(missing_ok=True)
    assert not write_own_decks(campaign)  # a package: no folder of git above it
    assert not deck.exists()
    (clone / ".git").mkdir()
    done = run_command(campaign.parent, "check", "mast.yaml", "--no-run")
    assert done.returncode == 0, done.stderr
    assert "wrote the decks of the example mast" in done.stderr
    assert deck.exists()
