"""A temporary gmsh session, with its signal handling undone."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def gmsh_model() -> Iterator[Any]:
    """Yield the module `gmsh` with an empty model.

    gmsh restores the system's handling of SIGPIPE, which ends a process that writes to a closed
    pipe; Python ignores the signal and raises BrokenPipeError.
    """
    import gmsh

    gmsh.initialize(interruptible=False)
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        yield gmsh
    finally:
        gmsh.finalize()
