"""What a page shows as printed is what the program prints.

    python tools/printed.py docs/bracket.md [--write]

A block that begins with `$ ` holds commands, run one after the other in one new folder a page, and
lines of what they print, in order; `...` replaces any lines, or the end of a line.
Words must be the same, numbers within two units of their last digit or half a percent. With --write
the lines that differ are replaced by the likest ones that were printed.
"""

from __future__ import annotations

import difflib
import os
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

BLOCK = re.compile(r"^```\n(\$ .*?)^```$", re.DOTALL | re.MULTILINE)
NUMBER = re.compile(r"[-+±]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
#: Allowed difference of numbers: units of their last digit, or a share of themselves.
UNITS, SHARE = 2, 0.005
#: Wide enough for every table.
ENVIRONMENT = {"MODETUNE_NO_PREFECT": "1", "COLUMNS": "200"}
#: Runs `modetune ARGUMENTS` in a folder, with variables over those of the environment.
Modetune = Callable[..., subprocess.CompletedProcess[str]]


@dataclass(frozen=True, slots=True)
class Difference:
    """A line of a page, and the printed line that is likest to it."""

    command: str
    shown: str
    printed: str

    def __str__(self) -> str:
        return f"$ {self.command}\n  shown:   {self.shown}\n  printed: {self.printed}"


def blocks(page: Path) -> list[str]:
    """The blocks of a page that hold commands."""
    return BLOCK.findall(page.read_text())


def modetune(folder: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run `modetune ARGUMENTS` as a program."""
    return _program(folder, "-m", "modetune", *arguments, **environment)


def differences(blocks: Iterable[str], run: Modetune = modetune) -> Iterator[Difference]:
    """Run the blocks of a page; every shown line that was not printed, after the one before it."""
    with tempfile.TemporaryDirectory(prefix="modetune-page-") as name:
        folder = Path(name)
        for block in blocks:
            command, printed = "", list[str]()
            for line in block.splitlines():
                if line.startswith("$ "):
                    command = line[2:]
                    folder, printed = _run(command, folder, run)
                elif line.strip() not in ("", "..."):
                    at = next((k for k, other in enumerate(printed) if alike(line, other)), None)
                    if at is None:
                        yield Difference(command, line, _likest(line, printed))
                    else:
                        printed = printed[at + 1 :]


def alike(shown: str, printed: str) -> bool:
    """Whether two lines have the same words, and numbers as near as UNITS and SHARE allow."""
    if shown.endswith(" ..."):
        words = shown.split()[:-1]
        shown, printed = " ".join(words), " ".join(printed.split()[: len(words)])
    if " ".join(NUMBER.sub("#", shown).split()) != " ".join(NUMBER.sub("#", printed).split()):
        return False
    return all(
        abs(_value(a) - _value(b)) <= max(UNITS * _last_digit(a), SHARE * abs(_value(a)))
        for a, b in zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True)
    )


def _value(number: str) -> float:
    return float(number.lstrip("±"))


def _last_digit(number: str) -> float:
    mantissa, _, exponent = number.lstrip("±+-").partition("e")
    _, _, decimals = mantissa.partition(".")
    return float(10.0 ** (int(exponent or 0) - len(decimals)))


def _run(command: str, folder: Path, run: Modetune) -> tuple[Path, list[str]]:
    """Where the next command runs, and what this one printed."""
    words = shlex.split(command)
    if words[0] == "mkdir":
        (folder / words[1]).mkdir()
        return folder, []
    if words[0] == "cd":
        return folder / words[1], []
    start = run if words[0] == "modetune" else _program
    done = start(folder, *words[1:], **ENVIRONMENT)
    if done.returncode not in (0, 3):
        raise RuntimeError(f"$ {command}: exit {done.returncode}\n{done.stderr}")
    return folder, [*done.stderr.splitlines(), *done.stdout.splitlines()]


def _program(folder: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run `python ARGUMENTS`."""
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        check=False,
    )


def _likest(line: str, printed: list[str]) -> str:
    found = difflib.get_close_matches(line, printed, 1, cutoff=0.3)
    return found[0].rstrip() if found else ""


def main(page: Path, write: bool) -> int:
    """Print differences, or correct the page; 1 if any remains."""
    found = list(differences(blocks(page)))
    if write:
        text = page.read_text()
        for item in found:
            if item.printed:
                text = text.replace(item.shown, item.printed, 1)
        page.write_text(text)
    for item in found:
        print(item)  # noqa: T201
    return int(any(not (write and item.printed) for item in found))


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), "--write" in sys.argv[2:]))
