"""What is said of a case, and whether it holds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from rich.table import Table

from modetune.core.keys import Json


@dataclass(frozen=True, slots=True)
class Claim:
    """Something said of a case, whether it holds here, and by what numbers."""

    text: str
    holds: bool
    evidence: str


class Comparison(Protocol):
    """A case's result beside the thesis's."""

    @property
    def holds(self) -> bool:
        """Whether what is asked of the case holds."""
        ...

    def told(self) -> dict[str, Json]:
        """For machines: what is added to the campaign's summary."""
        ...

    def show(self) -> None:
        """For people, on standard output."""
        ...


def told_claims(found: Sequence[Claim]) -> list[dict[str, Json]]:
    """Claims for machines."""
    return [{"claim": item.text, "holds": item.holds, "evidence": item.evidence} for item in found]


def claim_table(found: Sequence[Claim], who: str = "the thesis says") -> Table:
    """What is said, whether it holds, and by what."""
    table = Table(title="Claims", title_justify="left")
    for heading in (who, "holds", "by"):
        table.add_column(heading)
    for claim in found:
        table.add_row(claim.text, "yes" if claim.holds else "NO", claim.evidence)
    return table
