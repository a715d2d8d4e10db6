"""NumPy's and SciPy's linear algebra on one thread."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


def one_thread() -> AbstractContextManager[object]:
    """Let NumPy and SciPy multiply on one thread; MKL, which factorises, is unaffected.

    More threads wait for each other in products of small matrices, and in those of a few columns
    with many: two took 1.2 to 1.4 times as long as one for 6 columns with 60 of 17,000 to 270,000
    rows on idle cores, and up to ten times as long next to other work. An update of 200 parameters
    took 43 to 52 s instead of 26 to 28 s there.
    """
    limited: AbstractContextManager[object] = _libraries().limit(limits=1)
    return limited


@cache
def _libraries() -> ThreadpoolController:
    """Return the libraries; finding them takes longer than a few small matrices."""
    return ThreadpoolController().select(internal_api="openblas")
