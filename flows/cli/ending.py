"""How studies end: their page, figures and Prefect's tables; on a terminal, or as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from modetune.core.storage.files import writing
from modetune.core.storage.keys import Json
from modetune.flows.report.tables import Table, show

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.text import Text

    from modetune.flows.report.chart import Chart
    from modetune.flows.updating.prefect import Pages


def tell_end(
    told: Json | Mapping[str, Json], parts: Iterable[Table | Text | str], as_json: bool
) -> None:
    """What a command found: its `--json` object, or tables and sentences for people."""
    if as_json:
        typer.echo(json.dumps(told))
    else:
        show(parts)


@dataclass(frozen=True)
class StudyEnd:
    """What a study came to.

    said: in a sentence; told: its `--json` object; lines: below the tables; charts: by name of
    their files; written: its own files; doubts: why it cannot be relied on, sentences among lines;
    json_file: where the JSON object goes beside standard output; status: on Prefect's pages.
    """

    said: str
    told: Mapping[str, Json]
    tables: Sequence[Table]
    lines: Sequence[str]
    written: Sequence[Path] = ()
    charts: Mapping[str, Chart | Figure | None] = field(default_factory=dict)
    doubts: Sequence[str] = ()
    json_file: Path | None = None
    status: str = ""

    def reported(
        self,
        title: tuple[str, str],
        pages: Pages | None,
        page: Path | None = None,
        figures: Path | None = None,
    ) -> list[Path]:
        """Its figures and its page written, its end told to Prefect's pages; all files of it.

        title: which study, and of what.
        """
        charts = {name: chart for name, chart in self.charts.items() if chart is not None}
        written = list(self.written)
        if figures is not None:
            from modetune.flows.report.matplotlib_charts import save_all

            written += save_all(charts, figures)
        if page is not None:
            from modetune.flows.report.page import write_study

            written.append(write_study(page, title, self, charts))
        if pages is not None:
            status = self.status or ("unreliable" if self.doubts else "completed")
            said = "; ".join(self.doubts) or self.said
            for line in self.lines:
                pages.log(line)
            pages.done(said, self.tables, written, status, good=not self.doubts)
        return written

    def tell(self, written: Sequence[Path], as_json: bool) -> None:
        """To people or as JSON; ends with exit code 3 where it cannot be relied on."""
        if as_json:
            found = {**self.told, "written": [str(path) for path in written]}
            if self.json_file is not None:
                with writing(self.json_file) as part:
                    part.write_text(json.dumps(found, indent=1), encoding="utf-8")
            typer.echo(json.dumps(found))
        else:
            files = (f"written: {path}" for path in written)
            show([*self.tables, *map(self._marked, self.lines), *files])
        if self.doubts:
            raise typer.Exit(3)

    def _marked(self, line: str) -> Text:
        from rich.text import Text

        return Text(line, style="red" if line in self.doubts else "")
