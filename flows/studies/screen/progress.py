"""What a person sees while a screening runs: what is being done, and how many points are."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskID, TextColumn, TimeElapsedColumn

#: Where the output is not a terminal, so many lines in all tell of the points.
LINES = 10


class ConsoleScreening:
    """Progress on a terminal, or a few lines in a log."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self._live = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            BarColumn(),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task: TaskID | None = None

    @contextlib.contextmanager
    def shown(self) -> Iterator[ConsoleScreening]:
        """Show the display while a screening runs."""
        with self._live:
            yield self

    def working(self, text: str) -> None:
        if self._task is not None:
            self._live.remove_task(self._task)
        self._task = self._live.add_task(text, total=None)

    def points(self, done: int, total: int, ran: int, failed: int) -> None:
        text = f"point {done} of {total}: {ran} solved, {done - ran - failed} in the store"
        text += f", {failed} failed" if failed else ""
        if self._task is not None:
            self._live.update(self._task, description=text, completed=done, total=total)
        if not self.console.is_terminal and (done == total or done % -(-total // LINES) == 0):
            self.console.print(text, soft_wrap=True)
