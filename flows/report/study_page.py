"""The page of a study: what it says, its tables and its charts, in one file as a report is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

from modetune.core.errors import CampaignError
from modetune.flows.report.chart import Chart
from modetune.flows.report.page import written_page
from modetune.flows.report.tables import Table


class ToldStudy(Protocol):
    """What a study came to."""

    @property
    def lines(self) -> Sequence[str]: ...
    @property
    def doubts(self) -> Sequence[str]: ...
    @property
    def tables(self) -> Sequence[Table]: ...


def check_page(path: Path | None) -> None:
    """Refuse a page of another kind of file before the work is done. Raises CampaignError."""
    if path is not None and (path.suffix.lower() not in (".html", ".htm") or path.is_dir()):
        raise CampaignError(f"--page {path}: a page is a file that ends in .html")


def write_study(
    path: Path, title: tuple[str, str], found: ToldStudy, charts: Mapping[str, object]
) -> Path:
    """Write a study's page, of its charts those that are no pictures. Raises StorageUnavailable."""
    kind, name = title
    return written_page(
        path,
        "study.html",
        f"{name} - modetune {kind}",
        {name: chart for name, chart in charts.items() if isinstance(chart, Chart)},
        kind=kind,
        name=name,
        study=found,
        lines=[line for line in found.lines if line not in found.doubts],
    )
