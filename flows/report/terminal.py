"""The terminal for tables and lines; a separate file, because the others import NumPy."""

from __future__ import annotations

from rich.console import Console

#: Width of the output in characters if it is not a terminal.
UNBOUND = 200


def terminal(stderr: bool = False) -> Console:
    """Return a console for the terminal, or for a file or pipe with enough width for tables."""
    made = Console(stderr=stderr)
    return made if made.is_terminal else Console(stderr=stderr, width=UNBOUND)
