"""Memory of large matrices, which goes back to the system as soon as it is freed."""

from __future__ import annotations

import ctypes
from contextlib import suppress

#: Elements of a model from which memory is worth the system's time: pages are made anew for each
#: array, which took 4 to 8 s of the 47 that a campaign on 270,000 equations takes.
LARGE = 100_000
#: Arrays of so many bytes have pages of their own; the C library's parameters of that name, and
#: what it may keep of smaller ones (mallopt(3)).
OWN_PAGES, M_MMAP_THRESHOLD, KEPT, M_TRIM_THRESHOLD = 1 << 22, -3, 1 << 24, -1


def return_freed_memory() -> None:
    """Give arrays from 4 MB on pages of their own, which freed memory of glibc otherwise has from
    32 MB on: of 136,539 equations it kept 4.3 kB each, a third of what was in memory.

    Nothing where the C library is another one.
    """
    with suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        library.mallopt(M_MMAP_THRESHOLD, OWN_PAGES)
        library.mallopt(M_TRIM_THRESHOLD, KEPT)
