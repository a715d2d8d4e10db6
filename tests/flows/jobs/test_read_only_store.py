"""A store that can only be read: what it has is used, and what it lacks is named."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.command_line import run_command

SIX_MASS = Path(__file__).resolve().parents[3] / "configs" / "six_mass"
#: Root reads and writes everything, except without these capabilities.
POWERS = "-dac_override,-dac_read_search"
AS_OTHERS = ("setpriv", f"--bounding-set={POWERS}", f"--inh-caps={POWERS}")
Command = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def command(tmp_path: Path) -> Iterator[Command]:
    """Runs modetune on a campaign whose update is in a store without permission to write."""
    if os.getuid() == 0 and shutil.which("setpriv") is None:
        pytest.skip("root may write everything, and setpriv is not here")
    for file in SIX_MASS.glob("*"):
        if file.suffix in (".yaml", ".csv"):
            shutil.copyfile(file, tmp_path / file.name)
    done = run_command(tmp_path, "update", "campaign.yaml", "--set", "store=store")
    assert done.returncode == 0, done.stderr
    shutil.rmtree(tmp_path / "runs")
    folders = [tmp_path / "store", *(tmp_path / "store").rglob("*")]
    folders = [path for path in folders if path.is_dir()]
    for folder in folders:
        folder.chmod(0o555)

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        start = AS_OTHERS if os.getuid() == 0 else ()
        return subprocess.run(
            [*start, sys.executable, "-m", "modetune", *words, "--set", "store=store"],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )

    yield run
    for folder in folders:
        folder.chmod(0o755)


def test_a_read_only_store_with_every_result_is_used(command: Command) -> None:
    done = command("update", "campaign.yaml")
    assert done.returncode == 0, done.stderr
    assert "store can only be read: its results are used" in done.stderr
    assert "solver runs: 0 modal, 0 sensitivity" in done.stdout
    more = command("update", "campaign.yaml", "--set", "sensitivity.method=finite_difference")
    assert more.returncode == 5, more.stderr
    assert "the store store lacks the result" in more.stderr
    assert "Permission denied" in more.stderr
