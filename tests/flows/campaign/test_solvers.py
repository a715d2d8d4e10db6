"""Solvers that other packages bring by an entry point, in packages of a few lines."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from modetune.core.errors import CampaignError
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.campaign.solvers import GROUP, registered_solvers
from modetune.flows.updating.mode_source import model_modes

ROOT = Path(__file__).resolve().parents[3]


def install(folder: Path, package: str, code: str, points: dict[str, str]) -> None:
    """A package as an installer leaves it: its module, and metadata with its entry points."""
    (folder / f"{package}.py").write_text(code)
    meta = folder / f"{package}-1.4.dist-info"
    meta.mkdir()
    (meta / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.4\n")
    rows = "\n".join(f"{name} = {value}" for name, value in points.items())
    (meta / "entry_points.txt").write_text(f"[{GROUP}]\n{rows}\n")


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder of installed packages: one with the documentation's rod solver, one broken."""
    packages = tmp_path / "site"
    packages.mkdir()
    examples = ROOT / "docs" / "examples"
    code = (examples / "rod_solver.py").read_text()
    code = code.replace('Path(__file__).with_name("rod.py")', f"Path({str(examples / 'rod.py')!r})")
    install(packages, "rodpackage", code, {"rods": "rodpackage:rod_solver"})
    broken = {"rusty": "rusted:solver", "blunt": "rodpackage:no_such", "plain": "rodpackage:FIELDS"}
    install(packages, "rusted", "import no_such_library\n", broken)
    monkeypatch.syspath_prepend(str(packages))
    for name in ("rodpackage", "rusted"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return packages


def campaign(folder: Path, solver: str) -> Path:
    (folder / "bar.rod").write_text("material M 210000. 7.85e-9\nrod M 500. 40 100.\n")
    (folder / "measured.csv").write_text("mode,1,2\nfrequency_hz,2586.,7758.\n")
    (folder / "campaign.yaml").write_text(
        f"name: rod\nmodel: {{deck: bar.rod, solver: {solver}, units: mm-t-s}}\n"
        "test: {modes: measured.csv}\n"
        "parameters: [{name: E, quantity: youngs_modulus, material: M}]\n"
        "run: {licences: {" + solver + ": 1}}\n"
    )
    return folder / "campaign.yaml"


def test_a_campaign_runs_on_a_solver_that_a_package_brings(site: Path, tmp_path: Path) -> None:
    assert {"rods", "rusty", "blunt", "plain"} <= set(registered_solvers())
    loaded = load_campaign(campaign(tmp_path, "rods"))
    assert "rusted" not in sys.modules  # a broken package harms nobody who does not ask for it
    result = model_modes(loaded, {})
    # (2 j - 1) c / 4 L with c = sqrt(E / rho); 40 linear elements are about 1e-4 j^2 stiff.
    assert result.modes.frequencies_hz[0] == pytest.approx(
        (210_000.0 / 7.85e-9) ** 0.5 / 2000.0, rel=1e-3
    )


@pytest.mark.parametrize(
    ("solver", "said"),
    [
        (
            "rusty",
            "`rusted:solver` of package rusted 1.4, which cannot be imported: ModuleNot",
        ),
        ("blunt", "`rodpackage:no_such` of package rusted 1.4, which cannot be imported: Attri"),
        ("plain", "which gives a dict and must give a Solver"),
        ("abaqus", "the solver abaqus is not known here (there are calculix, nastran, mystran"),
    ],
)
def test_an_entry_that_fails_is_told_in_one_paragraph(
    site: Path, tmp_path: Path, solver: str, said: str
) -> None:
    with pytest.raises(CampaignError) as caught:
        load_campaign(campaign(tmp_path, solver))
    assert said in str(caught.value)
    assert "campaign.yaml, line 2" in str(caught.value)
    assert len(caught.value.problems) == 1
