"""The command line's help, its groups, and the spellings of version 0.1."""

from __future__ import annotations

import errno
import json
import re
import signal
import sys
import time
import weakref
from pathlib import Path

import pytest
import typer

from modetune.flows.cli import main as main_module
from modetune.flows.cli.main import (
    GROUPS,
    OLD_SPELLINGS,
    again_if_dropped,
    app,
    command_line,
)
from tests.command_line import run_command


def test_the_help_fits_a_screen_with_the_normal_day_first(tmp_path: Path) -> None:
    lines = run_command(tmp_path, "--help", COLUMNS="100").stdout.splitlines()
    assert len(lines) <= 45
    assert max(map(len, lines)) <= 100
    first = next(place for place, line in enumerate(lines) if "A normal day" in line)
    assert [line.split()[1] for line in lines[first + 1 : first + 7]] == [
        "go", "init", "identify", "sensors", "check", "update",
    ]  # fmt: skip


@pytest.mark.parametrize("group", GROUPS)
def test_the_help_of_a_group_has_a_line_for_each_command(group: str, tmp_path: Path) -> None:
    shown = run_command(tmp_path, group, "--help", COLUMNS="100")
    assert shown.returncode == 0
    lines = shown.stdout.splitlines()
    first = next(place for place, line in enumerate(lines) if "Commands" in line)
    commands = typer.main.get_command(app).commands[group].commands  # type: ignore[attr-defined]
    assert [line.split()[1] for line in lines[first + 1 : -2]] == list(commands)


@pytest.mark.parametrize(("old", "new"), OLD_SPELLINGS.items())
def test_an_old_spelling_is_the_new_command_with_a_line_of_warning(
    old: str, new: str, tmp_path: Path
) -> None:
    by_old = run_command(tmp_path, *old.split(), "--help")
    by_new = run_command(tmp_path, *new.split(), "--help")
    assert (by_new.returncode, by_new.stderr) == (0, "")
    assert by_old.stdout == by_new.stdout
    assert f"Usage: modetune {new} " in by_new.stdout
    assert by_old.stderr.startswith(f"modetune: `modetune {old}` is now `modetune {new}`;")
    assert by_old.stderr.count("\n") == 1


def test_the_warning_leaves_the_json_object_alone(tmp_path: Path) -> None:
    (tmp_path / "modes.csv").write_text("mode,1\nfrequency_hz,10\n1.x,1\n")
    ended = run_command(tmp_path, "inspect", "modes.csv", "--json")
    assert ended.returncode == 0
    assert json.loads(ended.stdout)["modes"][0]["frequency_hz"] == 10.0
    assert "`modetune files inspect`" in ended.stderr


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        RuntimeError("can't start new thread"),  # what Python says of a stack without room
    ],
)
def test_too_little_memory_is_told_in_a_sentence(
    error: Exception, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def exhausted(*words: str) -> typer.Typer:
        raise error

    monkeypatch.setattr(main_module, "command_line", exhausted)
    ended = run_command(tmp_path, "check", "campaign.yaml")
    assert ended.returncode == 4
    assert "ulimit -v" in ended.stderr


def test_a_long_value_is_shortened_in_messages(tmp_path: Path) -> None:
    (tmp_path / "long.yaml").write_text(f"name: {'k' * 20_000}\n")
    done = run_command(tmp_path, "check", "long.yaml", "--json")
    assert done.returncode == 2
    assert "(20002 characters)" in json.loads(done.stdout)["reason"]
    assert len(done.stderr) < 2000


def test_of_many_problems_the_first_are_shown(tmp_path: Path) -> None:
    count = 3000
    rows = [",".join(["mode", *["1"] * count]), ",".join(["frequency_hz", *["x"] * count])]
    (tmp_path / "wide.csv").write_text("\n".join(rows) + "\n")
    done = run_command(tmp_path, "files", "inspect", "wide.csv")
    assert done.returncode == 2
    lines = done.stderr.splitlines()
    assert len(lines) == 51
    assert re.fullmatch(r"and \d{4} more lines like these", lines[-1])
    # A header that repeats a mode names all of them in one line.
    assert max(map(len, lines)) < 6000


def test_a_named_command_comes_alone() -> None:
    named = typer.main.get_command(command_line("store", "explain"))
    assert list(named.commands["store"].commands) == ["explain"]  # type: ignore[attr-defined]


class Thing:
    """Something that can be watched."""


def test_ctrl_c_inside_a_callback_of_python_is_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(_: object) -> None:
        raise KeyboardInterrupt

    def work() -> None:
        things.clear()
        for _ in range(1000):  # ten seconds
            time.sleep(0.01)

    monkeypatch.setattr(sys, "unraisablehook", again_if_dropped(sys.unraisablehook))
    things = [Thing()]
    watched = weakref.ref(things[0], interrupted)
    # A shell starts programs in the background with the signal ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            work()
    finally:
        signal.signal(signal.SIGINT, before)
    assert watched() is None
