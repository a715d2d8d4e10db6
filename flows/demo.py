"""The cases of the reference thesis that `modetune demo` runs, and what the thesis got."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modetune import configs
from modetune.core.record import CampaignRecord

CONFIGS = Path(next(iter(configs.__path__)))

#: Thesis Table 21: frequency errors after updating, in per cent, after 3 iterations.
THESIS_ERRORS = (1.6, 0.4, 3.6, 5.9, 1.0, 0.2)


@dataclass(frozen=True, slots=True)
class Case:
    """A campaign and the files it needs beside it."""

    campaign: str
    files: tuple[Path, ...]


CASES = {
    "garteur": Case(
        "thesis.yaml",
        tuple(CONFIGS / "garteur" / name for name in ("thesis.yaml", "thesis_measured.csv")),
    )
}


def compare_with_thesis(record: CampaignRecord) -> str:
    """One paragraph: the errors reached beside the thesis's."""
    reached = 100.0 * np.abs(record.best.frequency_errors)
    ours = ", ".join(f"{error:.1f}" for error in reached)
    theirs = ", ".join(f"{error:.1f}" for error in THESIS_ERRORS)
    return (
        f"frequency errors {ours} %, mean {reached.mean():.2f} %\n"
        f"thesis (Table 21) {theirs} %, mean {np.mean(THESIS_ERRORS):.2f} % after 3 iterations"
    )
