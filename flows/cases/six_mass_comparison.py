"""The six-mass case beside the thesis: tables, claims and figures of all its methods."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.table import Table
from rich.text import Text

from modetune.configs.six_mass import system
from modetune.core.keys import Json
from modetune.core.modes import Floats
from modetune.core.record import CampaignRecord
from modetune.flows.cases.claims import Claim, claim_table, told_claims
from modetune.flows.cases.six_mass import (
    Outcome,
    claims,
    direct_outcomes,
    eigensensitivity_outcome,
    figures_of,
    history_figure,
)
from modetune.flows.report.figures import save
from modetune.flows.running import CampaignRun
from modetune.flows.terminal import terminal


@dataclass(frozen=True, slots=True)
class SixMassComparison:
    """All of chapter 3: outcomes of the methods, the claims, and the figures written."""

    outcomes: tuple[Outcome, ...]
    claims: tuple[Claim, ...]
    record: CampaignRecord
    figures: tuple[Path, ...]

    @property
    def holds(self) -> bool:
        return all(claim.holds for claim in self.claims)

    def told(self) -> dict[str, Json]:
        return {
            "claims": told_claims(self.claims),
            "methods": [
                {
                    "name": item.name,
                    "mac_before": np.diag(item.mac_before).tolist(),
                    "mac_after": np.diag(item.mac_after).tolist(),
                    "frequency_errors": item.frequency_errors.tolist(),
                    "receptance_errors_db": item.receptance_errors.tolist(),
                }
                for item in self.outcomes
            ],
            "figures": [str(path) for path in self.figures],
        }

    def show(self) -> None:
        console = terminal()
        for table in (mac_table(self.outcomes), frequency_table(self.outcomes),
                      spring_table(self.record)):  # fmt: skip
            console.print(table)
        console.print(claim_table(self.claims))
        console.print(Text(f"figures      {self.figures[0].parent}"), soft_wrap=True)


def compare_six_mass(run: CampaignRun, folder: Path) -> SixMassComparison:
    """Run the direct methods beside a finished campaign, judge all, and write the figures."""
    direct = direct_outcomes(folder)
    iem = eigensensitivity_outcome(folder, run.updated_deck)
    figures = {name: figure for item in (*direct, iem) for name, figure in figures_of(item).items()}
    truth = [system.SPRINGS[name][system.EXPERIMENTAL] for name in system.UPDATED]
    figures["parameters.png"] = history_figure(run.record, truth)
    written = tuple(save(figure, folder / "figures" / name) for name, figure in figures.items())
    found = claims(direct, iem, run.record)
    return SixMassComparison((*direct, iem), tuple(found), run.record, written)


def mac_table(outcomes: tuple[Outcome, ...]) -> Table:
    """Diagonals of the MAC matrices, ours beside the thesis's."""
    table = Table(title="MAC, mode by mode", title_justify="left")
    for heading in ("method", "", *(str(mode) for mode in range(1, 7))):
        table.add_column(heading, justify="left" if len(heading) != 1 else "right")
    for item in outcomes:
        table.add_row(item.name, "before", *_shares(np.diag(item.mac_before)))
        table.add_row("", "thesis", *_shares(np.array(item.thesis_before)), style="dim")
        table.add_row("", "after", *_shares(np.diag(item.mac_after)))
        table.add_row("", "thesis", *_shares(np.array(item.thesis_after)), style="dim")
        table.add_section()
    return table


def frequency_table(outcomes: tuple[Outcome, ...]) -> Table:
    """Frequencies of test and models; the thesis gives its own in figures only."""
    table = Table(title="Frequencies, Hz (the thesis has figures only)", title_justify="left")
    for heading in ("model", *(str(mode) for mode in range(1, 7))):
        table.add_column(heading, justify="left" if len(heading) != 1 else "right")
    first, last = outcomes[0], outcomes[-1]
    rows = [("experimental", first.test), ("analytical", first.before)]
    rows += [(item.name, item.after) for item in outcomes[:-1]]
    rows += [("k1 to k4 erroneous", last.before), (last.name, last.after)]
    for name, state in rows:
        table.add_row(name, *(f"{value:.3f}" for value in state.frequencies_hz))
    return table


def spring_table(record: CampaignRecord) -> Table:
    """The springs of Table 11 before and after."""
    table = Table(title="Springs, N/m (Table 11)", title_justify="left")
    for heading in ("spring", "erroneous", "updated", "experimental", "error before %",
                    "error after %"):  # fmt: skip
        table.add_column(heading, justify="right")
    for place, name in enumerate(record.parameters.names):
        truth = system.SPRINGS[name][system.EXPERIMENTAL]
        start = record.deck_values[place]
        updated = start * record.updated[place]
        table.add_row(
            name, f"{start:.0f}", f"{updated:.2f}", f"{truth:.0f}",
            f"{100 * (start / truth - 1):+.1f}", f"{100 * (updated / truth - 1):+.4f}",
        )  # fmt: skip
    return table


def _shares(values: Floats) -> list[str]:
    return [f"{value:.2f}" if np.isfinite(value) else "-" for value in values]
