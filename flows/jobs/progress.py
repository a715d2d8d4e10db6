"""What a person sees while jobs run: how many of those asked for are done, which run, time left.

On a terminal a line that moves; in a pipe or a log plain lines, the first at once and then one now
and then.
"""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.text import Text

from modetune.core.errors import ModetuneError
from modetune.flows.jobs.watching import Derivation, Ended, shown_to

#: Seconds between two lines where the output is not a terminal.
EVERY_S = 15.0
#: Jobs that are named of those that run.
NAMED = 3
#: In a run folder: the same for who looks from elsewhere; seconds between two of its states.
PROGRESS_FILE, KEPT_S = "progress.json", 0.2


class JobProgress:
    """Counts jobs and shows them; other threads may tell it."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self._live = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=20),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._live.add_task("", total=None)
        self._guard = threading.Lock()
        self._doing, self._ahead = "", ""
        self._asked = self._done = self._stored = self._failed = 0
        self._solved_s: list[float] = []
        self._running: dict[int, str] = {}
        self._places = count()
        self._told_s: float | None = None
        self._due: threading.Timer | None = None
        self._file: Path | None = None
        self._kept_s = 0.0

    @contextmanager
    def shown(self) -> Iterator[JobProgress]:
        """Show it while what is in here runs; engines that are made in here tell it of jobs."""
        with self._live, shown_to(self):
            try:
                yield self
            finally:
                with self._guard:
                    self._told_s = math.inf  # nothing is told any more
                if self._due is not None:
                    self._due.cancel()
                if self._file is not None:
                    self._file.unlink(missing_ok=True)

    def keep(self, folder: Path) -> None:
        """Tell it in a file of a run folder too, for as long as it is shown."""
        self._file = folder / PROGRESS_FILE

    def working(self, text: str) -> None:
        """What is being done now."""
        with self._guard:
            self._doing = text
            self._show(self._told_s is None)

    def ahead(self, text: str) -> None:
        """What is still to come of the whole, as it was forecast."""
        with self._guard:
            self._ahead = text
            self._show(False)

    def asked(self, pieces: int) -> None:
        """So many jobs are asked for; each begins when there is room."""
        with self._guard:
            self._asked = max(self._asked, self._done) + pieces
            self._show(False)

    def began(self, iteration: str, name: str) -> Callable[[Ended], None]:
        with self._guard:
            place = next(self._places)
            self._running[place] = name
            self._show(False)

        def ended(done: Ended) -> None:
            failed = isinstance(done, ModetuneError)
            with self._guard:
                self._running.pop(place, None)
                # What follows from other results by itself is no job.
                jobs = (
                    ()
                    if isinstance(done, ModetuneError)
                    else [item for item in done if not isinstance(item, Derivation)]
                )
                self._done += bool(failed or jobs)
                self._failed += failed
                self._stored += bool(jobs) and all(item.reused for item in jobs)
                self._solved_s += [item.wall_s for item in jobs if not item.reused]
                self._show(False)

        return ended

    def skipped(
        self, iteration: str, names: Sequence[str], reason: str, state: str = "Skipped"
    ) -> None:
        return

    def line(self) -> str:
        """What is being done, jobs done of jobs asked, the running ones, and the time left."""
        asked = max(self._asked, self._done)
        parts = [self._doing or "starting"]
        if asked:
            counts = ((self._stored, "from the store"), (self._failed, "failed"))
            of_these = ", ".join(f"{number} {what}" for number, what in counts if number)
            done = f"{self._done} of {asked} job{'' if asked == 1 else 's'} done"
            parts.append(f"{done} ({of_these})" if of_these else done)
        if self._running:
            names = list(dict.fromkeys(self._running.values()))
            more = f" and {len(names) - NAMED} others" if len(names) > NAMED else ""
            parts.append(f"running: {', '.join(names[:NAMED])}{more}")
        waiting = asked - self._done
        if self._solved_s and waiting:
            mean = sum(self._solved_s) / len(self._solved_s)
            parts.append(f"about {mean * waiting / max(len(self._running), 1):.0f} s left of these")
        return "; ".join([*parts, *([self._ahead] if self._ahead else [])])

    def _show(self, now: bool) -> None:
        total = max(self._asked, self._done) or None
        self._live.update(
            self._task, description=self.line(), total=total, completed=self._done if total else 0
        )
        if self._file is not None and time.monotonic() - self._kept_s > KEPT_S:
            self._kept_s = time.monotonic()
            told = {"text": self.line(), "done": self._done, "asked": total or 0}
            with suppress(OSError):  # no folder yet, or a full disk: none of the campaign's trouble
                part = self._file.with_suffix(".part")
                part.write_text(json.dumps(told), encoding="utf-8")
                part.replace(self._file)
        if self.console.is_terminal:
            return
        left_s = math.inf if self._told_s is None else self._told_s + EVERY_S - time.monotonic()
        if now or left_s <= 0.0:
            self._told_s = time.monotonic()
            self.console.print(Text(self.line()), soft_wrap=True)
        elif self._due is None and left_s < math.inf:  # what runs for long is told once it is due
            self._due = threading.Timer(left_s, self._tell_due)
            self._due.daemon = True
            self._due.start()

    def _tell_due(self) -> None:
        with self._guard:
            self._due = None
            self._show(False)
