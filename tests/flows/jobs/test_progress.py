"""What is shown while jobs run: counts, names and time left; plain lines where no terminal is."""

from __future__ import annotations

import io
import re
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from modetune.core.errors import SolverCrashed
from modetune.flows.jobs import progress as module
from modetune.flows.jobs.progress import Derivation, JobProgress, current_display
from tests.command_line import run_command

SIX_MASS = Path(__file__).resolve().parents[3] / "configs" / "six_mass"


def in_a_pipe() -> tuple[JobProgress, io.StringIO]:
    out = io.StringIO()
    return JobProgress(Console(file=out, width=200)), out


def solved(seconds: float, stored: bool = False) -> object:
    class Outcome:
        key, reused, wall_s = "a", stored, seconds

    return Outcome()


def test_jobs_done_of_jobs_asked_with_their_names_and_the_time_left() -> None:
    progress, _ = in_a_pipe()
    progress.working("iteration 1: sensitivities")
    with progress.shown():
        watcher = current_display()
        assert watcher is not None
        watcher.submitted(4)
        ends = [watcher.began("iteration 1", name) for name in ("E_wing", "E_fin")]
        ends[0]([solved(12.0)])  # type: ignore[list-item]
    # Three wait or run, one at a time, of 12 s each: 36 s.
    assert progress.line() == (
        "iteration 1: sensitivities; 1 of 4 jobs done; running: E_fin; about 36 s left for these"
    )
    ends[1](SolverCrashed("it broke"))
    assert "2 of 4 jobs done (1 failed)" in progress.line()
    watcher.began("iteration 1", "E_tail")([solved(0.0, stored=True)])  # type: ignore[list-item]
    assert "3 of 4 jobs done (1 cached, 1 failed)" in progress.line()


def test_what_follows_by_itself_is_no_job() -> None:
    progress, _ = in_a_pipe()
    progress.began("iteration 1", "modal")([Derivation("key", False, 0.1)])
    progress.began("iteration 1", "pairing")([])
    assert "job" not in progress.line()


def test_a_pipe_gets_plain_lines_and_the_first_one_at_once() -> None:
    progress, out = in_a_pipe()
    with progress.shown():
        progress.working("reading campaign.yaml")
        for _ in range(50):
            progress.began("iteration 1", "modal")([solved(0.0)])  # type: ignore[list-item]
        assert out.getvalue() == "reading campaign.yaml\n"


def test_nothing_is_told_where_nobody_looks() -> None:
    assert current_display() is None


@pytest.mark.parametrize(
    "command",
    "check modes correlate update screen validate sample init identify localise pretest report "
    "sensors".split(),
)
def test_words_come_before_the_heavy_imports(command: str, tmp_path: Path) -> None:
    """The first words of each command are said while numpy is not imported yet."""
    script = (
        "import sys\n"
        "from modetune.flows.jobs import progress\n"
        "def told(self, text):\n"
        "    print(text, 'numpy' in sys.modules)\n"
        "    raise SystemExit(0)\n"
        "progress.JobProgress.working = told\n"
        "from modetune.flows.cli.main import main\n"
        "main()\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, command, "campaign.yaml"],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert re.fullmatch(r"(reading|comparing) campaign\.yaml False\n", done.stdout), done


def test_a_terminal_gets_a_bar_and_a_file_no_control_characters(tmp_path: Path) -> None:
    for path in (*SIX_MASS.glob("*.yaml"), *SIX_MASS.glob("*.csv")):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    piped = run_command(tmp_path, "modes", "campaign.yaml", "--json")
    assert piped.returncode == 0, piped.stderr
    assert "\x1b" not in piped.stdout + piped.stderr
    assert piped.stderr.startswith("reading campaign.yaml\n")
    assert piped.stdout.startswith("{")  # and nothing else
    screen = io.StringIO()
    progress = JobProgress(Console(file=screen, force_terminal=True, width=120))
    with progress.shown():
        progress.working("modes of six_mass")
        progress.submitted(2)
    said = screen.getvalue()  # its last picture at least is of the end
    assert "0 of 2 jobs done" in said
    assert "\x1b" in said


def test_what_begins_between_two_lines_and_runs_for_long_is_told_once_a_line_is_due(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "EVERY_S", 0.05)
    out = io.StringIO()
    with JobProgress(Console(file=out)).shown() as shown:
        shown.working("iteration 5")
        shown.began("iteration 5", "modes of assembled matrices, counted")
        due = shown._due
        assert due is not None
        assert "counted" not in out.getvalue()
        due.join()
        assert "running: modes of assembled matrices, counted" in out.getvalue()
