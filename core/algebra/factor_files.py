"""Where the factors of one matrix are kept on disk."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, slots=True, weakref_slot=True, eq=False)
class FactorFiles:
    """A folder for the files of one matrix alone, and what takes it away."""

    folder: Path
    remove: Callable[[], None]
