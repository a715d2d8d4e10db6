"""Algebra of small matrices, of which many follow each other."""

from __future__ import annotations

from contextlib import AbstractContextManager
from functools import cache

from threadpoolctl import ThreadpoolController


def one_thread() -> AbstractContextManager[object]:
    """Small matrices on one thread, where more would wait for each other; MKL keeps its own."""
    limited: AbstractContextManager[object] = _small_matrices().limit(limits=1)
    return limited


@cache
def _small_matrices() -> ThreadpoolController:
    """Who computes with them; to look for it among all libraries takes longer than a few sets."""
    return ThreadpoolController().select(internal_api="openblas")
