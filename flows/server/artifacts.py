"""What Prefect's pages show of a run besides its tasks: tables, a picture, progress, places.

Sheets are made from records and know no server. A post sends them from a thread of its own, so
that the campaign never waits for it; where the server is gone or slow the rest is left out with
one warning. A key is the campaign's name and the sheet's: one key over runs is a history.
"""

from __future__ import annotations

import base64
import contextvars
import io
import json
import logging
import queue
import re
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from uuid import UUID

import numpy as np

from modetune.core.criteria import Tolerances
from modetune.core.keys import Json
from modetune.core.modes import Floats, common_dofs
from modetune.core.pairing import mac_or_zero
from modetune.core.record import CampaignRecord, IterationRecord
from modetune.flows.updating import Progress

logger = logging.getLogger(__name__)

#: A picture travels inside its sheet; larger ones are drawn again at less resolution.
LARGEST_PICTURE = 200_000
#: Dots per inch that are tried one after another.
RESOLUTIONS = (110, 80, 55, 40)
#: Seconds that the end of a campaign waits for the server to take what is left.
PATIENCE_S = 10.0


@dataclass(frozen=True, slots=True)
class Sheet:
    """One artifact: its kind, key, description in Markdown, and what it shows."""

    kind: Literal["table", "markdown", "progress"]
    key: str
    description: str
    data: str | float


def sheet_key(campaign: str, sheet: str) -> str:
    """A key as Prefect wants it: small letters, digits, dashes."""
    return f"{re.sub(r'[^a-z0-9]+', '-', campaign.lower()).strip('-')}-{sheet}"


def progress_sheets(
    name: str, tolerances: Tolerances, iterations: Sequence[IterationRecord]
) -> list[Sheet]:
    """How near e1 is, and a line an iteration."""
    kept = [item for item in iterations if item.accepted][-1]
    rows: list[Json] = [_iteration_row(item) for item in iterations]
    return [
        Sheet("progress", sheet_key(name, "progress"),
              f"Largest frequency error {100 * kept.worst_error:.2f} %, "
              f"e1 asks for {100 * tolerances.frequency:g} % (100 is e1 met)",
              round(100.0 * _nearness(kept, tolerances), 1)),
        Sheet("table", sheet_key(name, "iterations"), f"Iterations of {name}",
              json.dumps(rows)),
    ]  # fmt: skip


def result_sheets(record: CampaignRecord, folder: Path) -> list[Sheet]:
    """Frequencies, parameters, MAC and places at the end of a run."""
    name = record.name
    modes: list[Json] = [_mode_row(record, pair) for pair in range(len(record.test.numbers))]
    parameters: list[Json] = [_parameter_row(record, n) for n in range(len(record.parameters))]
    sheets = [
        Sheet("table", sheet_key(name, "frequencies"),
              f"Frequencies of {name} before and after", json.dumps(modes)),
        Sheet("table", sheet_key(name, "parameters"),
              f"Parameters of {name}, relative to the deck", json.dumps(parameters)),
        Sheet("markdown", sheet_key(name, "record"), f"Where the run of {name} left its files",
              _places(record, folder)),
    ]  # fmt: skip
    if record.test.has_shapes:
        picture = base64.b64encode(mac_picture(record)).decode()
        sheets.append(
            Sheet("markdown", sheet_key(name, "mac"), f"MAC of {name} before and after",
                  f"![MAC](data:image/png;base64,{picture})")
        )  # fmt: skip
    return sheets


def mac_picture(record: CampaignRecord) -> bytes:
    """MAC of computed with measured modes before and after, as PNG that fits into a sheet."""
    from modetune.flows.report.figures import (
        mac_figure,  # drawing is imported where something is drawn
    )

    first, last = record.iterations[0], record.best
    figure = mac_figure(
        record.name, [("before", mac_table(record, first)), ("after", mac_table(record, last))]
    )
    drawn = b""
    for resolution in RESOLUTIONS:
        file = io.BytesIO()
        figure.savefig(file, format="png", dpi=resolution)
        drawn = file.getvalue()
        if 4 * len(drawn) / 3 < LARGEST_PICTURE:
            break
    return drawn


class ArtifactPost:
    """Progress of a campaign that is also sent to the pages of its flow run."""

    def __init__(self, watcher: Progress, tolerances: Tolerances, name: str, run: UUID) -> None:
        self.watcher = watcher
        self.tolerances = tolerances
        self.name = name
        self.run = run
        self.iterations: list[IterationRecord] = []
        self._sent: dict[str, UUID] = {}
        self._given_up = False
        self._waiting: queue.SimpleQueue[Callable[[], list[Sheet]] | None] = queue.SimpleQueue()
        around = contextvars.copy_context()  # Prefect's settings are found through it
        self._thread = threading.Thread(
            target=around.run, args=(self._post,), name="modetune-artifacts", daemon=True
        )
        self._thread.start()

    def working(self, text: str) -> None:
        self.watcher.working(text)

    def iteration(self, record: IterationRecord) -> None:
        self.watcher.iteration(record)
        self.iterations.append(record)
        so_far = tuple(self.iterations)
        self._waiting.put(lambda: progress_sheets(self.name, self.tolerances, so_far))

    def result(self, record: CampaignRecord, folder: Path) -> None:
        """The campaign has come to its end."""
        self._waiting.put(lambda: result_sheets(record, folder))

    def close(self) -> None:
        """Wait a little until all is sent."""
        self._waiting.put(None)
        self._thread.join(PATIENCE_S)
        if self._thread.is_alive():
            self._given_up = True
            logger.warning(
                "Prefect's server does not answer in time; tables of this run are left out"
            )

    def _post(self) -> None:
        try:
            self._post_all()
        except Exception as error:  # whatever it is, what is shown may not end the campaign
            if not self._given_up:
                logger.warning("Prefect's pages do not show tables of this run: %s", error)

    def _post_all(self) -> None:
        from prefect.client.orchestration import SyncPrefectClient, get_client
        from prefect.client.schemas.actions import ArtifactCreate, ArtifactUpdate

        def put(client: SyncPrefectClient, sheet: Sheet) -> None:
            known = self._sent.get(sheet.key)
            if known is not None:
                client.update_artifact(
                    known, ArtifactUpdate(data=sheet.data, description=sheet.description)
                )
                return
            made = client.create_artifact(
                ArtifactCreate(
                    type=sheet.kind, key=sheet.key, description=sheet.description,
                    data=sheet.data, flow_run_id=self.run,
                )
            )  # fmt: skip
            self._sent[sheet.key] = made.id

        with get_client(sync_client=True) as client:
            while (sheets := self._waiting.get()) is not None:
                for sheet in sheets():
                    put(client, sheet)


def _nearness(record: IterationRecord, tolerances: Tolerances) -> float:
    """1 where e1 is met, else the tolerance over the largest difference that exceeds it."""
    shares = [tolerances.frequency / max(record.worst_error, tolerances.frequency)]
    mac = record.pairing.judged_mac
    if np.isfinite(mac).all() and mac.min() < tolerances.mac:
        shares.append((1.0 - tolerances.mac) / (1.0 - float(mac.min())))
    return min(shares)


def mac_table(record: CampaignRecord, iteration: IterationRecord) -> Floats:
    """MAC (n_computed, n_measured) up to the last computed mode that is paired."""
    last = int(iteration.pairing.computed.max()) + 1
    computed, measured = iteration.computed, record.test.modes
    rows_c, rows_m = common_dofs(computed, measured)
    # Of several configurations a mode rests at all sensors but those of its own.
    return mac_or_zero(computed.mode_shapes[rows_c, :last], measured.mode_shapes[rows_m])


def _iteration_row(item: IterationRecord) -> dict[str, Json]:
    errors, mac = 100.0 * np.abs(item.frequency_errors), item.pairing.mac
    return {
        "iteration": item.number,
        "largest error %": f"{errors.max():.2f}",
        "mean error %": f"{errors.mean():.2f}",
        "least MAC": f"{mac.min():.3f}" if np.isfinite(mac).all() else "-",
        "slope": f"{item.slope:.2g}" if np.isfinite(item.slope) else "-",
        "sensitivity": "skipped (e2)" if item.sensitivity_skipped else "",
        "new solver runs": item.runs.modal + item.runs.sensitivity,
        "kept": "yes" if item.accepted else "no",
        "decision": item.decision,
    }


def _mode_row(record: CampaignRecord, pair: int) -> dict[str, Json]:
    first, last = record.iterations[0], record.best
    number = int(first.pairing.measured[pair])
    before = first.computed.frequencies_hz[first.pairing.computed[pair]]
    after = last.computed.frequencies_hz[last.pairing.computed[pair]]
    return {
        "mode": record.test.numbers[number],
        "test Hz": f"{record.test.modes.frequencies_hz[number]:.3f}",
        "before Hz": f"{before:.3f}",
        "error before %": f"{100 * first.frequency_errors[pair]:+.2f}",
        "after Hz": f"{after:.3f}",
        "error after %": f"{100 * last.frequency_errors[pair]:+.2f}",
        "MAC before": _share(float(first.pairing.mac[pair])),
        "MAC after": _share(float(last.pairing.mac[pair])),
    }


def _parameter_row(record: CampaignRecord, place: int) -> dict[str, Json]:
    item, error = record.parameters.parameters[place], record.standard_errors[place]
    return {
        "parameter": item.name,
        "quantity": item.quantity.replace("_", " "),
        "started at": f"{record.iterations[0].parameters[place]:.4f}",
        "updated": f"{record.updated[place]:.4f}",
        "standard error": f"{error:.4f}" if np.isfinite(error) else "not known",
        "bounds": f"{item.lower:g} .. {item.upper:g}",
        "on a bound": "yes" if item.name in record.parameters.at_bounds(record.updated) else "",
    }


def _places(record: CampaignRecord, folder: Path) -> str:
    place, runs = folder.resolve(), record.runs
    return (
        f"**{record.status.replace('_', ' ')}**: {record.reason}\n\n"
        f"* record `{place / 'campaign.h5'}`\n"
        f"* updated deck in `{place / 'updated'}`\n"
        f"* solver runs: {runs.modal} modal, {runs.sensitivity} sensitivity, {runs.reused} answered"
        f" by the store\n* {record.solver} {record.solver_version}, {record.wall_s:.1f} s\n"
    )


def _share(value: float) -> str:
    return f"{value:.3f}" if np.isfinite(value) else "-"
