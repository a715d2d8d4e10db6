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


def test_the_extras_bring_what_is_asked_for() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    asked = project["optional-dependencies"]
    module_of = {"vtkmodules": "pyvista", "pyoma2": "pyOMA_2", "prefect_dask": "prefect-dask"}
    for module, extra in EXTRAS.items():
        package = module_of.get(module, module)
        assert any(one.startswith(package) for one in asked[extra]), module
        assert not any(one.startswith(package) for one in project["dependencies"])
