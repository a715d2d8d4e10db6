"""What is said of a case, held against its run: the outcome of a demo."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Claim:
    """Something said of a case, whether it holds here, and by what numbers."""

    claim: str
    holds: bool
    evidence: str


@dataclass(frozen=True, slots=True)
class Beside:
    """Rows of a case's results beside those of its source, as they are shown."""

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
