"""Where PARDISO keeps the factors of one matrix on disk."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

#: MKL reads its limit of memory as an int.
LARGEST_MB = 2**31 - 1


@dataclass(slots=True, weakref_slot=True, eq=False)
class FactorFiles:
    """Where the factors of one matrix are kept on disk.

    folder: for this matrix alone: PARDISO gives the same names to the files of all; remove: takes
    it away; memory_mb: what PARDISO may hold beside, of which it makes buffers.
    """

    folder: Path
    remove: Callable[[], None]
    memory_mb: int = LARGEST_MB

    @contextmanager
    def told(self) -> Iterator[None]:
        """PARDISO reads of its files in the environment, anew with each call."""
        told = {
            "MKL_PARDISO_OOC_PATH": str(self.folder),
            "MKL_PARDISO_OOC_MAX_CORE_SIZE": str(min(self.memory_mb, LARGEST_MB)),
        }
        before = {name: os.environ.get(name) for name in told}
        os.environ.update(told)
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value
