"""The report file of a run folder, whose failure never fails the campaign.

A separate file, because importing the page with its charts and templates takes a moment.
"""

from __future__ import annotations

import logging
from pathlib import Path

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
    TypeError,
    ValueError,
)


def draw_report(record: CampaignRecord, folder: Path) -> Path | None:
    """Write a run folder's report; return None with a warning on failure."""
    from jinja2 import TemplateError

    try:
        from modetune.flows.report.page import write_page

        return write_page(record, folder / PAGE)
    except (*FAILURES, TemplateError) as error:
        logger.warning(
            "the report of %s failed (%s: %s), but record and updated deck are complete; retry "
            "with `modetune report %s`",
            record.name,
            type(error).__name__,
            error,
            folder,
        )
        return None
