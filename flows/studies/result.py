"""How a study ends: what it found, in a sentence, as JSON, as tables, charts and files."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from modetune.core.storage.keys import Json
from modetune.flows.report.tables import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.console import Console

    from modetune.flows.report.chart import Chart


@dataclass(frozen=True)
class StudyResult:
    """The result of a study.

    found: the result object, which Python gets. sentence: the result in one sentence. summary: the
    JSON object. lines: sentences below the tables. written: files of the study, then page and
    figures; None where the JSON object lists no files. charts: by the names of their files.
    doubts: why the result is unreliable, sentences that may also be among the lines. status: one
    or two words for lists of runs; "completed", or "unreliable" with doubts, where empty.
    exit_code: of the command. remark: the last line for people. json_file: where the command also
    writes the JSON object. outputs: write the files that an option names, once the result is
    there. failure: why one of these, of the figures or the page could not be written, which a
    command reports after the result. shown: prints the result on a terminal where tables and lines
    are not the whole of it.
    """

    found: object
    sentence: str
    summary: Mapping[str, Json]
    tables: Sequence[Table] = ()
    lines: Sequence[str] = ()
    written: Sequence[Path] | None = ()
    charts: Mapping[str, Chart | Figure | None] = field(default_factory=dict)
    doubts: Sequence[str] = ()
    status: str = ""
    exit_code: int = 0
    remark: str = ""
    json_file: Path | None = None
    shown: Callable[[Console], None] | None = None
    outputs: Sequence[Callable[[], Sequence[Path]]] = ()
    failure: Exception | None = None

    @property
    def state(self) -> str:
        """The status, filled in where the study gives none."""
        return self.status or ("unreliable" if self.doubts else "completed")

    def to_json(self) -> dict[str, Json]:
        """The JSON object, with the files where it lists them."""
        if self.written is None:
            return dict(self.summary)
        return {**self.summary, "written": [str(near(path)) for path in self.written]}

    def drawn(self, title: tuple[str, str], page: Path | None, figures: Path | None) -> StudyResult:
        """Write the outputs, figures into a folder and the page, and add them to the written files.

        title: the study's name and the campaign's. A file that cannot be written takes nothing
        from the result: the first such error is its `failure`.
        """
        charts = {name: chart for name, chart in self.charts.items() if chart is not None}

        def save_figures(folder: Path) -> Sequence[Path]:
            from modetune.flows.report.matplotlib_charts import save_all

            return save_all(charts, folder)

        def save_page(file: Path) -> Sequence[Path]:
            from modetune.flows.report.page import write_study

            return [write_study(file, title, self.tables, self.lines, self.doubts, charts)]

        outputs = list(self.outputs)
        outputs += [partial(save_figures, figures)] if figures is not None else []
        outputs += [partial(save_page, page)] if page is not None else []
        files: list[Path] = []
        failure = self.failure
        for output in outputs:
            try:
                files += output()
            except Exception as error:  # raised again once the result is printed
                failure = failure or error
        if not outputs:
            return self
        written = [*(self.written or ()), *files] if files else self.written
        return replace(self, written=written, failure=failure)


def near(path: Path) -> Path:
    """A path as people type it: relative where it is below the working folder."""
    folder = Path.cwd()
    return path.relative_to(folder) if path.is_relative_to(folder) else path
