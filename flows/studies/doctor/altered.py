"""Programs whose jobs go wrong on purpose, to see that this is recognised."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from modetune.adapters.solver import Analysis, Capabilities, Command, Edited, Program, Rendered
from modetune.core.updating.results import Result


@dataclass(frozen=True)
class Altered:
    """A program of which some jobs are spoilt.

    broken: a part of the input files and what stands in its place; where it is empty the largest
    file is cut in half. refusal: what is said in place of the program, as if it had no licence.
    """

    program: Program
    broken: tuple[str, str] | None = None
    refusal: str = ""

    @property
    def name(self) -> str:
        return self.program.name

    @property
    def capabilities(self) -> Capabilities:
        return self.program.capabilities

    def version(self) -> str:
        return self.program.version()

    def render(self, deck: Edited, analysis: Analysis) -> Rendered:
        """The program's job under another key, spoilt as it is written."""
        job = self.program.render(deck, analysis)

        def write(folder: Path) -> None:
            job.write(folder)
            if self.broken is not None:
                _spoil(folder, self.broken)

        spoilt = [list(self.broken or ()), self.refusal]
        return Rendered({"spoilt": spoilt, "job": job.content}, write, job.size)

    def command(self, threads: int) -> Command:
        if not self.refusal:
            return self.program.command(threads)
        says = "import sys; print(sys.argv[1]); sys.exit(1)"
        return Command((sys.executable, "-I", "-S", "-c", says, self.refusal))

    def read(self, deck: Edited, analysis: Analysis, folder: Path, return_code: int) -> Result:
        return self.program.read(deck, analysis, folder, return_code)


def _spoil(folder: Path, broken: tuple[str, str]) -> None:
    old, new = (part.encode() for part in broken)
    files = sorted(folder.iterdir(), key=lambda path: path.stat().st_size)
    if not old:
        data = files[-1].read_bytes()
        files[-1].write_bytes(data[: len(data) // 2])
        return
    for path in files:
        path.write_bytes(path.read_bytes().replace(old, new))
