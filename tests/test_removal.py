"""A capability can be removed: its files, and one line in the table that names it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from modetune.flows.studies.catalogue import STUDIES
from tests.test_structure import PARTS, ROOT, copy_of_sources

#: Of a study, a response type and a format of test files: the files, the table, and the start of
#: the line there.
CAPABILITIES = {
    "localise": (["flows/studies/localise"], "flows/studies/catalogue.py", '"localise": ('),
    "static": (
        ["flows/responses/static.py", "core/updating/responses/static.py"],
        "flows/responses/residuals.py",
        '"static:',
    ),
    "mat": (["adapters/test_files/mat.py"], "adapters/test_files/measurements.py", '"mat": '),
}


@pytest.fixture(scope="module")
def rest(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the sources without these capabilities."""
    folder = tmp_path_factory.mktemp("rest")
    copy_of_sources(folder)
    for files, table, start in CAPABILITIES.values():
        for path in (folder / name for name in files):
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
        lines = (folder / table).read_text(encoding="utf-8").splitlines(keepends=True)
        (line,) = [line for line in lines if line.strip().startswith(start)]
        lines.remove(line)
        (folder / table).write_text("".join(lines), encoding="utf-8")
    return folder


def succeeds(rest: Path, *arguments: str) -> str:
    """The standard output of Python with the modules of the copy."""
    ended = subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        check=False,
        cwd=rest,
        env={**os.environ, "PYTHONPATH": str(rest / "src"), "COLUMNS": "100"},
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    return ended.stdout


def test_help_shows_the_other_commands(rest: Path) -> None:
    text = "".join(succeeds(rest, "-m", "modetune", *group, "--help") for group in ([], ["model"]))
    shown = {words[1] for line in text.splitlines() if len(words := line.split()) > 2}
    assert set(STUDIES) - {"localise"} <= shown
    assert "localise" not in shown


def test_the_schema_lacks_the_response_type(rest: Path) -> None:
    schema = json.loads(succeeds(rest, "-m", "modetune", "files", "schema"))
    text = json.dumps(schema)
    assert "StaticSection" not in text
    assert "FrfSection" in text


def test_an_update_runs(rest: Path) -> None:
    campaign = rest / "configs" / "six_mass" / "campaign.yaml"
    command = ("update", str(campaign), "--runs", str(rest / "runs"), "--no-prefect", "--json")
    store = f"store={rest / 'store'}"
    ended = json.loads(succeeds(rest, "-m", "modetune", *command, "--set", store))
    assert ended["status"] == "converged"


@pytest.mark.timeout(900)  # every module is parsed several times
def test_the_structure_holds(rest: Path) -> None:
    tests = rest / "tests"
    tests.mkdir()
    for name in ("__init__.py", "test_structure.py"):
        shutil.copy(ROOT / "tests" / name, tests / name)
    text = succeeds(rest, "-m", "pytest", "-q", "-n0", "-k", "not wheel", str(tests))
    assert " passed" in text
    # The modules that it read are those of the copy.
    where = "from tests.test_structure import MODULES; print(len(MODULES))"
    n_modules = sum(1 for part in PARTS for _ in (rest / part).rglob("*.py"))
    assert int(succeeds(rest, "-c", where)) == n_modules
