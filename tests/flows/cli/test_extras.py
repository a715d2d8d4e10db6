"""What runs without the packages of the extras, and what says which of them it requires."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from modetune.flows.extras import EXTRAS

ROOT = Path(__file__).resolve().parents[3]
SIX_MASS = ROOT / "configs" / "six_mass"
#: The command line where none of these packages can be imported.
WITHOUT = (
    "import sys; "
    f"sys.modules.update(dict.fromkeys({[*EXTRAS, 'distributed', 'cryptography']!r})); "
    "from modetune.flows.cli.main import main; main()"
)


def run_without(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    shutil.copytree(SIX_MASS, folder, dirs_exist_ok=True)
    command = [sys.executable, "-c", WITHOUT, *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


def test_an_update_requires_no_extra(tmp_path: Path) -> None:
    done = run_without(tmp_path, "update", "campaign.yaml", "--set", "update.starts=1")
    assert done.returncode == 0, done.stderr
    assert "requires" not in done.stderr
    assert (tmp_path / "runs" / "six-mass" / "report.html").is_file()


@pytest.mark.parametrize(
    ("arguments", "package"),
    [
        (("sample", "campaign.yaml", "--no-prefect"), "emcee"),
        (("screen", "campaign.yaml", "--no-prefect", "--method", "sobol"), "SALib"),
    ],
)
def test_a_study_says_which_extra_it_requires(
    tmp_path: Path, arguments: tuple[str, ...], package: str
) -> None:
    done = run_without(tmp_path, *arguments)
    assert done.returncode == 2, done.stderr
    assert f"requires the package {package}" in done.stderr
    assert "pip install 'modetune[studies]'" in done.stderr
    assert "Traceback" not in done.stderr


def test_the_python_api_says_which_extra_it_requires(tmp_path: Path) -> None:
    shutil.copytree(SIX_MASS, tmp_path, dirs_exist_ok=True)
    code = (
        f"import sys; sys.modules.update(dict.fromkeys({[*EXTRAS]!r})); import modetune\n"
        "run = modetune.update('campaign.yaml', settings={'update.starts': 1})\n"
        "print(len(run.parameters))\n"
        "modetune.sample('campaign.yaml', prefect=False)\n"
    )
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.stdout == "4\n"
    last = done.stderr.splitlines()[-1]
    assert last.startswith("modetune.core.errors.ModetuneError: this requires the package emcee")
    assert "pip install 'modetune[studies]'" in last


#: Every function of modetune, on a campaign whose update is there; each prints how it ended.
EVERY_VERB = """
import modetune
calls = {
    "check": lambda: modetune.check("campaign.yaml"),
    "compare": lambda: modetune.compare(["campaign.yaml", "other.yaml"], settings=ONE),
    "confirm": lambda: modetune.confirm("campaign.yaml"),
    "correlate": lambda: modetune.correlate("campaign.yaml"),
    "direct": lambda: modetune.direct("campaign.yaml"),
    "expand": lambda: modetune.expand("campaign.yaml"),
    "fleet": lambda: modetune.fleet("campaign.yaml"),
    "go": lambda: modetune.go("six_mass.yaml", "measured.csv", "gone.yaml", solver="matrices"),
    "history": lambda: modetune.history("campaign.yaml"),
    "identify": lambda: modetune.identify("run.csv", order=8),
    "init": lambda: modetune.init("six_mass.yaml", out="new.yaml", solver="matrices"),
    "load": lambda: modetune.load("campaign.yaml"),
    "localise": lambda: modetune.localise("campaign.yaml"),
    "modes": lambda: modetune.modes("campaign.yaml"),
    "pretest": lambda: modetune.pretest("campaign.yaml"),
    "read_record": lambda: modetune.read_record("runs/six-mass"),
    "read_test": lambda: modetune.read_test("measured.csv"),
    "receive": lambda: modetune.receive("campaign.yaml", "measured.csv", settle=0, settings=ONE),
    "reduce": lambda: modetune.reduce("campaign.yaml", masters="1.x,2.x,3.x"),
    "sample": lambda: modetune.sample("campaign.yaml"),
    "scatter": lambda: modetune.scatter("campaign.yaml"),
    "screen": lambda: modetune.screen("campaign.yaml", method="local"),
    "twin": lambda: modetune.twin("campaign.yaml", solvers="matrices,calculix"),
    "update": lambda: modetune.update("campaign.yaml", settings=ONE),
    "validate": lambda: modetune.validate("campaign.yaml", leave_one_out=True),
}
ONE = {"update.starts": 1}
verbs = [name for name in modetune.__all__ if name[0].islower()]
assert sorted(calls) == sorted(verbs), set(calls) ^ set(verbs)
for name in ("update", *sorted(set(verbs) - {"update"})):
    try:
        calls[name]()
        print(name, "ran")
    except modetune.ModetuneError as error:
        print(name, str(error).replace("\\n", " "))
"""


def test_every_function_runs_without_extras_or_names_one(tmp_path: Path) -> None:
    shutil.copytree(SIX_MASS, tmp_path, dirs_exist_ok=True)
    campaign = (tmp_path / "campaign.yaml").read_text()
    (tmp_path / "other.yaml").write_text(campaign.replace("six-mass", "other"))
    rows = (f"{0.01 * k:.2f},{k * k % 7},{k * k % 5}\n" for k in range(4000))
    (tmp_path / "run.csv").write_text("time [s],1.x [m/s^2],2.x [m/s^2]\n" + "".join(rows))
    code = f"import sys; sys.modules.update(dict.fromkeys({[*EXTRAS]!r}))\n{EVERY_VERB}"
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    ends = dict(line.split(" ", 1) for line in done.stdout.splitlines())
    named = {name: text for name, text in ends.items() if text.startswith("this requires")}
    assert named.keys() == {"identify", "sample", "scatter"}, ends
    assert "modetune[oma]" in named["identify"]
    assert "modetune[studies]" in named["sample"]
    refused = {name: text for name, text in ends.items() if text != "ran" and name not in named}
    # Masses and springs name no units, and are the solver's own.
    assert refused.keys() == {"confirm", "go"}, refused
    assert "nothing left to confirm" in refused["confirm"]
    assert "the units of six_mass.yaml are unknown" in refused["go"]


def test_the_extras_bring_what_is_asked_for() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = project["optional-dependencies"]
    module_of = {"vtkmodules": "pyvista", "pyoma2": "pyOMA_2", "prefect_dask": "prefect-dask"}
    for module, extra in EXTRAS.items():
        package = module_of.get(module, module)
        assert any(one.startswith(package) for one in asked[extra]), module
        assert not any(one.startswith(package) for one in project["dependencies"])
