"""The campaign's log: one line a solver run, one an iteration, all warnings, and how it ended.

It stands in the run folder, goes on where an earlier run's ended, and starts anew at a size that
nobody reads; the part before that is kept once.
"""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from logging.handlers import RotatingFileHandler
from pathlib import Path

from modetune.core.storage.record import CampaignRecord
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.report.iteration_tables import iteration_row

LOG = "campaign.log"
#: Bytes after which the log starts anew.
LONGEST = 8 << 20

logger = logging.getLogger(__name__)


class _LogFile(RotatingFileHandler):
    """A file whose trouble (a full disk) is none of the campaign's."""

    def handleError(self, record: logging.LogRecord) -> None:
        pass


@contextmanager
def campaign_log(campaign: Campaign, folder: Path) -> Iterator[None]:
    """Write what modetune's loggers say of a campaign into its run folder."""
    ours = logging.getLogger("modetune")
    file = _LogFile(folder / LOG, maxBytes=LONGEST, backupCount=1, encoding="utf-8", delay=True)
    file.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(message)s"))
    terminal = logging.StreamHandler()  # what Python itself does where nobody listens
    terminal.setLevel(logging.WARNING)
    handlers: list[logging.Handler] = [file] if ours.hasHandlers() else [file, terminal]
    level = ours.level
    ours.setLevel(min(logging.INFO, ours.getEffectiveLevel()))
    for handler in handlers:
        ours.addHandler(handler)
    try:
        host = f"{socket.gethostname()}, process {os.getpid()}"
        logger.info("campaign %s (%s) on %s", campaign.name, campaign.file, host)
        names = ", ".join(dict.fromkeys(case.solver.program.name for case in campaign.cases))
        logger.info("solver %s, version %s", names, campaign.solver_version())
        yield
    except BaseException as error:
        said = f"ended with {type(error).__name__}: {error}"
        file.handle(logging.LogRecord(__name__, logging.ERROR, "", 0, said, None, None))
        raise
    finally:
        ours.setLevel(level)
        for handler in handlers:
            ours.removeHandler(handler)
            handler.close()


def log_iterations(record: CampaignRecord, logged: int) -> int:
    """Log the iterations of a record after the first ones that are; how many are then."""
    for item in record.iterations[logged:]:
        row = iteration_row(item)
        logger.info(
            "iteration %d: largest frequency error %.2f %%, least MAC %.3f, %d + %d runs, %d from "
            "the store, %.1f s; %s",
            row.iteration, 100.0 * row.largest_error, row.least_mac, row.modal_runs,
            row.sensitivity_runs, row.reused, row.wall_s, row.decision or "evaluated",
        )  # fmt: skip
    return len(record.iterations)
