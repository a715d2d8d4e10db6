"""Claims about a case, checked against its run: the outcome of a demo."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Claim:
    """A claim about a case, whether it holds, and the numbers for it."""

    claim: str
    holds: bool
    evidence: str


@dataclass(frozen=True, slots=True)
class Beside:
    """Rows that compare a case's results with those of its source."""

    title: str
    headings: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
