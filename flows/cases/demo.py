"""The cases that `modetune demo` runs, and what each is compared with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.text import Text

from modetune import configs
from modetune.configs.six_mass import system
from modetune.core.keys import Json
from modetune.core.record import CampaignRecord
from modetune.flows.cases.claims import Comparison
from modetune.flows.cases.fixture import compare_fixture
from modetune.flows.cases.lab import compare_lab, prepare_lab
from modetune.flows.cases.six_mass_comparison import compare_six_mass
from modetune.flows.running import CampaignRun
from modetune.flows.terminal import terminal

CONFIGS = Path(next(iter(configs.__path__)))

#: Thesis Table 21: frequency errors after updating, in per cent, after 3 iterations.
THESIS_ERRORS = (1.6, 0.4, 3.6, 5.9, 1.0, 0.2)


@dataclass(frozen=True, slots=True)
class Case:
    """A campaign, the files it needs beside it, and what its run is compared with.

    prepare: makes in the folder what is not copied there.
    """

    campaign: str
    files: tuple[Path, ...]
    with_prefect: bool
    compare: Callable[[CampaignRun, Path], Comparison]
    prepare: Callable[[Path], None] | None = None


@dataclass(frozen=True, slots=True)
class GarteurComparison:
    """Frequency errors reached beside the thesis's."""

    record: CampaignRecord
    holds: bool = True

    def told(self) -> dict[str, Json]:
        return {}

    def show(self) -> None:
        terminal().print(Text(compare_with_thesis(self.record)), soft_wrap=True)


def compare_with_thesis(record: CampaignRecord) -> str:
    """One paragraph: the errors reached beside the thesis's."""
    reached = 100.0 * np.abs(record.best.frequency_errors)
    ours = ", ".join(f"{error:.1f}" for error in reached)
    theirs = ", ".join(f"{error:.1f}" for error in THESIS_ERRORS)
    return (
        f"frequency errors {ours} %, mean {reached.mean():.2f} %\n"
        f"thesis (Table 21) {theirs} %, mean {np.mean(THESIS_ERRORS):.2f} % after 3 iterations"
    )


CASES = {
    "garteur": Case(
        "thesis.yaml",
        tuple(CONFIGS / "garteur" / name for name in ("thesis.yaml", "thesis_measured.csv")),
        True,
        lambda run, folder: GarteurComparison(run.record),
    ),
    "six-mass": Case(
        "campaign.yaml",
        tuple(
            CONFIGS / "six_mass" / name
            for name in ("campaign.yaml", "measured.csv", "all_measured.csv", *system.MODELS)
        ),
        False,  # seconds of work: over before a server is up
        compare_six_mass,
    ),
    "fixture": Case(
        "fixture.yaml",
        tuple(CONFIGS / "fixture" / name for name in ("fixture.yaml", "measured.csv")),
        False,
        compare_fixture,
    ),
    "lab": Case(
        "lab.yaml",
        (CONFIGS / "garteur" / "lab.yaml",),
        False,
        lambda run, folder: compare_lab(run.record),
        prepare_lab,
    ),
}
