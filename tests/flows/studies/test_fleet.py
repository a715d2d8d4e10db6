"""Many structures on one page."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import modetune
from modetune.core.monitoring.past_runs import FOLDER, PastRun, add_past_run
from modetune.core.updating.verdict import TrustVerdict
from tests.command_line import run_command

SIX_MASS = Path(__file__).resolve().parents[3] / "configs" / "six_mass"
#: The largest page of a thousand structures, bytes.
PAGE = 2_000_000


def night(name: str, values: tuple[float, float] = (1.0, 1.0), number: int = 1) -> PastRun:
    """A steady, trusted run of two moduli of 70 GPa."""
    n = len(values)
    return PastRun(
        number=number, name=name, ended_at=1.7e9 + 86_400.0 * number,
        measured_at=float("nan"),
        evidence=f"{abs(hash((name, values, number))):064x}"[:64], test_digest=f"{number:064x}",
        status="converged", reason="e1 is met", verdict=TrustVerdict.TRUSTED, state="steady",
        drift="Steady", changed=(), names=("E_wing", "E_tail"), quantities=("youngs_modulus",) * n,
        units="mm-t-s", values=7e4 * np.array(values), deck_values=np.full(n, 7e4),
        standard_errors=np.full(n, 700.0), repeatability=np.full(n, 350.0),
        covariance=350.0**2 * np.eye(n), modes=("1", "2"), test_hz=np.array([10.0, 20.0]),
        damping_ratios=np.full(2, np.nan), updated_hz=np.array([10.01, 20.0]), macs=np.ones(2),
        elastic_modes=np.array([1, 2]), environment={}, deck_digest="", modal_key="", settings=(),
        solver="matrices", solver_version="1", modetune_version="0", versions=(),
    )  # fmt: skip


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Forty aircraft: one changed, one not trusted, one out of the family, one damaged file."""
    folder, rng = tmp_path_factory.mktemp("fleet"), np.random.default_rng(1)
    for place in range(40):
        name = f"aircraft-{place:02}"
        wing, tail = (1.0 + 0.01 * rng.standard_normal(2)).tolist()
        run = night(name, (wing, 1.3 if place == 7 else tail))
        if place == 11:
            run = replace(run, state="changed", drift="Changed: E_wing -15 %", changed=("E_wing",))
        if place == 23:
            run = replace(run, verdict=TrustVerdict.NOT_TRUSTED)
        add_past_run(folder / "runs" / name, run)
    lost = folder / "runs" / "aircraft-40" / FOLDER
    lost.mkdir(parents=True)
    (lost / "2026-01-01T00-00-00Z-00000000.h5").write_bytes(b"no run")
    (folder / "runs" / "aircraft-11" / "report.html").write_text("<p>report</p>")
    return folder


def test_the_worst_come_first_with_their_reasons(runs: Path) -> None:
    found = modetune.fleet(runs / "runs")
    assert [item.name for item in found[:4]] == [
        "aircraft-11", "aircraft-40", "aircraft-23", "aircraft-07",
    ]  # fmt: skip
    assert len(found) == 41
    assert "is not" in found[1].problem
    assert found[3].odd[0].startswith("E_tail +3")
    assert not any(item.odd for item in found[4:])


def test_the_command_prints_one_table_and_links_reports(runs: Path) -> None:
    ended = run_command(runs, "fleet", "runs", "--page", "pages/fleet.html", "--json")
    assert ended.returncode == 0, ended.stderr
    told = json.loads(ended.stdout)
    assert told["sentence"] == "41 structures: 1 changed, 1 without a run, 39 steady"
    first = told["structures"][0]
    assert (first["name"], first["newest"]["drift"]) == ("aircraft-11", "Changed: E_wing -15 %")
    page = (runs / "pages" / "fleet.html").read_text()
    assert page.index("aircraft-11") < page.index("aircraft-23") < page.index("aircraft-00")
    assert 'href="../runs/aircraft-11/report.html"' in page


def test_a_pattern_names_run_folders(runs: Path) -> None:
    ended = run_command(runs, "fleet", "runs/aircraft-0*", "--json")
    assert len(json.loads(ended.stdout)["structures"]) == 10
    assert run_command(runs, "fleet", "runs/none*").returncode == 2
    assert "no run folder with a history" in run_command(runs, "fleet", "pages").stderr


def test_the_newest_run_counts_though_a_clock_went_back(tmp_path: Path) -> None:
    for number, ended_at in ((1, 1.7e9), (2, 1.6e9)):
        run = night("bridge", (0.8 if number == 2 else 1.0, 1.0), number)
        add_past_run(tmp_path / "bridge", replace(run, ended_at=ended_at))
    (found,) = modetune.fleet(tmp_path / "bridge")
    assert found.run is not None
    assert (found.run.number, found.n_runs) == (2, 2)


def test_a_thousand_structures_make_a_small_page(tmp_path: Path) -> None:
    for place in range(1000):
        add_past_run(tmp_path / f"tower-{place}", night(f"tower-{place}"))
    modetune.fleet(tmp_path, page=tmp_path / "fleet.html")
    assert (tmp_path / "fleet.html").stat().st_size < PAGE


@pytest.fixture
def campaigns(tmp_path: Path) -> Path:
    """Three structures of six masses: sound, with a campaign that is broken, with no deck."""
    for name in ("a", "b", "c"):
        place = tmp_path / "campaigns" / name
        place.mkdir(parents=True)
        for file in ("six_mass.yaml", "measured.csv", "campaign.yaml"):
            text = (SIX_MASS / file).read_text()
            (place / file).write_text(text.replace("name: six-mass", f"name: mast-{name}"))
    (tmp_path / "campaigns" / "b" / "campaign.yaml").write_text("name: [")
    (tmp_path / "campaigns" / "c" / "six_mass.yaml").unlink()
    return tmp_path


def test_campaigns_are_updated_and_one_that_fails_stops_no_other(campaigns: Path) -> None:
    ended = run_command(campaigns, "fleet", "campaigns/*/campaign.yaml", "--update", "--json")
    told = json.loads(ended.stdout)
    assert told["sentence"] == "3 structures: 2 without a run, 1 learning, 1 not updated"
    assert ended.returncode == told["exit_code"] == 2
    found = {item["name"]: item for item in told["structures"]}
    assert list(found) == ["b/campaign.yaml", "mast-c", "mast-a"]
    assert "six_mass.yaml" in found["mast-c"]["failure"]
    assert "not readable as YAML" in found["b/campaign.yaml"]["problem"]
    assert found["mast-a"]["newest"]["verdict"] == "trusted"
    log = (campaigns / "runs" / "mast-a" / "campaign.log").read_text()
    assert "mast-c" not in log


def test_two_campaigns_with_one_run_folder_are_not_mixed(campaigns: Path) -> None:
    other = campaigns / "campaigns" / "b" / "campaign.yaml"
    other.write_text((campaigns / "campaigns" / "a" / "campaign.yaml").read_text())
    ended = run_command(campaigns, "fleet", "campaigns/[ab]/campaign.yaml", "--json")
    told = json.loads(ended.stdout)["structures"]
    assert [item["name"] for item in told] == ["mast-a", "mast-a"]
    assert {"a/campaign.yaml has the same `name`" in item["problem"] for item in told} == {
        True,
        False,
    }


def test_fleet_needs_campaigns_to_update(runs: Path) -> None:
    ended = run_command(runs, "fleet", "runs", "--update")
    assert ended.returncode == 2
    assert "--update needs campaign files" in ended.stderr
    assert run_command(runs, "fleet", "runs", "--parallel", "2").returncode == 2
