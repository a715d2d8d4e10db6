"""The journal of a long benchmark: its finished pieces, so that an interrupted one goes on.

The first line has the plan and the seed, each further line a piece with its result, and the last
one says that all are done. A journal of the same plan that has no such line goes on; after it, or
with another plan, the next one begins, with another seed.
"""

from __future__ import annotations

import fcntl
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

#: Where journals are, unless named.
FOLDER = Path("runs") / "nightly"


class Journal:
    """Results by the names of pieces. seed: of all pieces, 1 in the first journal."""

    def __init__(self, path: Path, plan: Mapping[str, Any], seed: int | None = None) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("a+")  # held, so that no two benchmarks share it
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._file.close()
            raise SystemExit(f"another benchmark is writing {path}") from None
        self.results: dict[str, Any] = {}
        head, entries = _read(path)
        goes_on = (
            head.get("plan") == json.loads(json.dumps(plan))
            and seed in (None, head["seed"])
            and not any(entry.get("done") for entry in entries)
        )
        last = head.get("seed", 0)
        self.seed: int = last if goes_on else last + 1 if seed is None else seed
        self._file.truncate(0)  # what was cut off goes
        for entry in [{"plan": plan, "seed": self.seed}, *(entries if goes_on else [])]:
            self._append(entry)
        if goes_on:
            self.results = {entry["piece"]: entry["result"] for entry in entries}

    def add(self, piece: str, result: Any) -> None:
        """Note a finished piece."""
        self.results[piece] = result
        self._append({"piece": piece, "result": result})

    def end(self) -> None:
        """Note that all pieces are done."""
        self._append({"done": True})

    def close(self) -> None:
        """Let another benchmark have the journal."""
        self._file.close()

    def _append(self, entry: Mapping[str, Any]) -> None:
        self._file.write(f"{json.dumps(entry)}\n")
        self._file.flush()


def _read(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the first line and all other whole lines; nothing where there is no journal."""
    found = []
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            found.append(json.loads(line))
        except ValueError:  # cut off when it was written
            break
    return (found[0], found[1:]) if found else ({}, [])
