"""What an update leaves: record, folder, updated deck and page, with frames and figures of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from modetune.core.errors import ModesError
from modetune.core.storage.record import CampaignRecord
from modetune.core.storage.record_file import read_record
from modetune.flows.report.comparison import mac_table
from modetune.flows.report.drawing import PAGE
from modetune.flows.report.mode_tables import ModeRow, mode_labels, mode_rows
from modetune.flows.report.parameter_tables import ParameterRow, parameter_rows
from modetune.flows.report.tables import frame
from modetune.flows.updating.forecast import Forecast
from modetune.flows.updating.recording import summary

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


@dataclass(frozen=True, slots=True, repr=False)
class CampaignRun:
    """A campaign's end: its record, its folder, the updated deck and the report's page there.

    forecast: what it was expected to cost, where that was asked for. page: None where there is
    none.
    """

    record: CampaignRecord
    folder: Path
    updated_deck: Path
    forecast: Forecast | None = None
    page: Path | None = None

    @property
    def converged(self) -> bool:
        """Whether e1 is met."""
        return self.record.status == "converged"

    @property
    def parameters(self) -> pd.DataFrame:
        """A row a parameter: initial and updated value, relative to the deck, standard error."""
        return frame(parameter_rows(self.record), ParameterRow).set_index("name")

    @property
    def modes(self) -> pd.DataFrame:
        """A row a mode: frequencies in Hz and MAC before and after, errors as shares."""
        return frame(mode_rows(self.record), ModeRow).set_index("mode")

    @property
    def mac(self) -> pd.DataFrame:
        """MAC of the test's modes (rows) and the updated model's elastic modes (columns)."""
        import pandas as pd

        record, last = self.record, self.record.best
        table = mac_table(record, last).T
        rows = mode_labels(record)
        return pd.DataFrame(table, rows[: len(table)], range(1, table.shape[1] + 1))

    @property
    def summary(self) -> dict[str, Any]:
        """What `modetune update --json` prints."""
        return dict(summary(self.record, self.folder))

    def plot_modes(self) -> Figure:
        """Frequencies of test and model, before and after."""
        return self._figure("frequencies")

    def plot_mac(self) -> Figure:
        """MAC of test and model, before and after. Raises ModesError without measured shapes."""
        return self._figure("mac_map")

    def plot_comac(self) -> Figure:
        """COMAC of each sensor. Raises ModesError without measured shapes."""
        return self._figure("comac")

    def plot_parameters(self) -> Figure:
        """Each parameter over the iterations, relative to the deck."""
        return self._figure("parameters")

    def plot_sensitivities(self) -> Figure:
        """The sensitivities that were computed. Raises ModesError where none were."""
        return self._figure("sensitivities")

    def plot_convergence(self) -> Figure:
        """Residual and slope (e2) over the iterations."""
        return self._figure("convergence")

    def __repr__(self) -> str:
        return "\n".join(self._lines())

    def _repr_html_(self) -> str:
        head = "<br>".join(self._lines()[:2])
        return f"<p>{head}</p>{self.modes.to_html()}{self.parameters.to_html()}"

    def _lines(self) -> list[str]:
        record = self.record
        first, last = (
            np.abs(item.frequency_errors) for item in (record.iterations[0], record.best)
        )
        return [
            f"{record.name}: {record.status}: {record.reason}",
            f"frequency errors: mean {first.mean():.2%} -> {last.mean():.2%}, worst "
            f"{first.max():.2%} -> {last.max():.2%}; iterations: {record.iterations[-1].number}",
            "parameters: "
            + ", ".join(
                f"{name} {value:.4g}"
                for name, value in zip(
                    record.parameters.names, record.parameters.shown(record.updated), strict=True
                )
            ),
            f"in {self.folder}",
        ]

    def _figure(self, name: str) -> Figure:
        from modetune.flows.report.charts import campaign_charts
        from modetune.flows.report.matplotlib_charts import matplotlib_figure

        for known, chart in campaign_charts(self.record):
            if known == name:
                return matplotlib_figure(chart)
        raise ModesError(f"{self.record.name}: there is nothing to show as {name}")


def read_run(path: Path) -> CampaignRun:
    """An update from its run folder or its campaign.h5. Raises StoreError, StoreDamaged."""
    file = path / "campaign.h5" if path.is_dir() else path
    record, folder = read_record(file), file.parent
    names = [item.split("  ", 1)[-1] for item in record.deck_digest.split("; ") if item]
    deck, page = folder.joinpath("updated", *names[:1]), folder / PAGE
    return CampaignRun(record, folder, deck, None, page if page.is_file() else None)
