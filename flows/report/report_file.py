"""The report file of a run folder; a failure to draw it does not fail the campaign."""

from __future__ import annotations

import logging
from pathlib import Path

from jinja2 import TemplateError

from modetune.core.errors import ModetuneError
from modetune.core.storage.campaign_record import CampaignRecord

logger = logging.getLogger(__name__)

#: The page in a run folder.
PAGE = "report.html"
#: Failures of drawing, which do not affect the campaign's result.
FAILURES = (
    ModetuneError,
    OSError,
    ImportError,
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    RuntimeError,
    TemplateError,
    TypeError,
    ValueError,
)


def draw_report(record: CampaignRecord, folder: Path) -> Path | None:
    """Write the run folder's report; None with a warning where that fails."""
    try:
        from modetune.flows.report.page import write_page  # drawing takes a moment to import

        return write_page(record, folder / PAGE)
    except FAILURES as error:
        logger.warning(
            "the report of %s could not be drawn (%s: %s); the record and the updated deck are "
            "not touched by that, `modetune report %s` tries again",
            record.name,
            type(error).__name__,
            error,
            folder,
        )
        return None
