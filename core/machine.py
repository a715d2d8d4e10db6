"""The machine: its cores, its memory and its user, on Linux and on systems that lack some calls.

Solvers and servers run on Linux only: what ends them with all that they started is Linux's own
(`adapters/supervisor.py`). Reading tests, identification, and models that are functions of Python
need none of that.
"""

from __future__ import annotations

import getpass
import os
import re
import sys

#: Memory in bytes that is assumed where the system does not say, as on Windows.
ASSUMED_MEMORY = 8 << 30
#: What a user on another system can do.
ELSEWHERE = (
    "modetune runs it on Linux only; on Windows use WSL 2, on macOS a container (Dockerfile), or "
    "give the model as a function of Python (docs/python.md)"
)


def is_linux() -> bool:
    """Return whether this system has what solvers and servers need."""
    return sys.platform == "linux" and hasattr(os, "fork")


def usable_cores() -> int:
    """Return the number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def physical_memory() -> int:
    """Return the memory of the machine in bytes."""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return ASSUMED_MEMORY


def user_label() -> str:
    """Return the user's number, or the user's name in letters that a file name may have."""
    if hasattr(os, "getuid"):
        return str(os.getuid())
    return re.sub(r"[^A-Za-z0-9_.-]", "-", getpass.getuser())
