"""What commands import: nothing heavy that they do not use, which is what makes them quick."""

from __future__ import annotations

import functools
import json
import subprocess
import sys
from pathlib import Path

import pytest

SIX_MASS = Path(__file__).resolve().parents[3] / "configs" / "six_mass"
#: Packages that take a tenth of a second or more.
HEAVY = ("prefect", "matplotlib", "pyNastran", "polars", "pypardiso", "h5py", "scipy.optimize",
         "scipy.stats", "scipy.sparse", "numpy", "pydantic", "yaml", "dask",
         "rich.markdown")  # fmt: skip
#: A command that the others do not use.
OTHER = "modetune.flows.studies.screen.study"
TELL = f"import json, sys; print(json.dumps([n for n in {(*HEAVY, OTHER)!r} if n in sys.modules]))"


@functools.cache
def imported_by(code: str) -> set[str]:
    """Heavy packages that are there after a piece of code has run in a fresh Python."""
    told = subprocess.run(
        [sys.executable, "-c", f"{code}\n{TELL}"], capture_output=True, text=True, check=True
    )
    return set(json.loads(told.stdout.splitlines()[-1]))


def test_help_and_mistakes_of_use_import_no_numbers() -> None:
    assert imported_by("from modetune.flows.cli.main import app") == {OTHER}


def test_a_command_imports_no_other() -> None:
    code = "from modetune.flows.cli.main import command_line; command_line({!r})"
    assert imported_by(code.format("demo")) == set()
    for wrong in ("dem", "--help", ""):  # which of them is meant, or all of them
        assert imported_by(code.format(wrong)) == {OTHER}


def test_the_server_is_found_without_importing_prefect() -> None:
    assert "prefect" not in imported_by("import modetune.flows.jobs.prefect_server")


@pytest.mark.parametrize(
    "unused", ["prefect", "matplotlib", "pyNastran", "polars", "dask", "scipy.stats"]
)
def test_checking_a_campaign_imports_what_it_uses(unused: str) -> None:
    code = (
        "from pathlib import Path; from modetune.flows.campaign.campaign import load_campaign; "
        f"load_campaign(Path({str(SIX_MASS / 'campaign.yaml')!r}))"
    )
    assert unused not in imported_by(code)


def test_pythons_commands_import_no_statistics_before_one_needs_them() -> None:
    imported = imported_by("import modetune; modetune.update")
    assert imported.isdisjoint({"prefect", "matplotlib", "polars", "dask", "scipy.stats"})
