"""Where tables and lines for people go."""

from __future__ import annotations

from rich.console import Console

#: Columns where the output is not a terminal: tables take what they need of it.
UNBOUND = 200


def terminal(stderr: bool = False) -> Console:
    """The terminal, or a file or pipe in which no table is squeezed."""
    made = Console(stderr=stderr)
    return made if made.is_terminal else Console(stderr=stderr, width=UNBOUND)
