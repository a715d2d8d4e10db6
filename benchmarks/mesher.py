"""gmsh for a while, its handling of signals undone."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def gmsh_model() -> Iterator[Any]:
    """The module `gmsh`, its model empty.

    gmsh gives SIGPIPE back to the system, whose way is to end a process that writes to whom
    nobody listens any more; Python ignores it and raises BrokenPipeError.
    """
    import gmsh

    gmsh.initialize(interruptible=False)
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        yield gmsh
    finally:
        gmsh.finalize()
