"""The process of one deployed run: reads which study of which campaign, and runs it.

Started by a worker, which writes to its standard input and is told nothing but an exit code; what
became of the run is the state of its flow run. The command is the one that people type, on the
pages of the run that a server started.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from modetune.core.errors import CampaignRunning, ModetuneError
from modetune.flows.cli.studies import Study, run_study
from modetune.flows.updating.prefect import Pages, shown


class Parameters(BaseModel):
    """What a deployment says of its campaign; nothing of how it is run."""

    model_config = ConfigDict(extra="forbid", strict=True)

    name: str
    campaign_file: str
    settings: list[str]
    runs: str
    study: str = "update"
    options: list[str] = []


class PagesLog(logging.Handler):
    """modetune's own log lines on the page of the flow run."""

    def __init__(self, pages: Pages) -> None:
        super().__init__(logging.INFO)
        self.pages = pages

    def emit(self, record: logging.LogRecord) -> None:
        self.pages.log(record.getMessage(), record.levelno)


def run_deployed(run: str, told: object) -> None:
    """Run a deployed study. run: its flow run; told: its parameters."""
    name = told.get("name", "") if isinstance(told, dict) else ""
    with shown(str(name) or "unknown", run) as pages, _logged(pages):
        try:
            asked = Parameters.model_validate(told)
            study = Study(asked.study, tuple(asked.options))
            arguments = study.arguments(Path(asked.campaign_file), asked.settings, Path(asked.runs))
            run_study(arguments, pages)
            pages.end("COMPLETED", "Completed", "")  # where the study told no end of its own
        except ValidationError as error:
            pages.end("FAILED", "Failed", f"these are not a campaign's parameters: {error}")
        except CampaignRunning as error:
            pages.end("COMPLETED", "Already running", str(error))
        except ModetuneError as error:
            pages.log(str(error), logging.ERROR)
            pages.failed(error)


@contextlib.contextmanager
def _logged(pages: Pages) -> Iterator[None]:
    """Our log goes to the pages, and what is for a terminal nowhere."""
    ours = logging.getLogger("modetune")
    handler, level = PagesLog(pages), ours.level
    ours.addHandler(handler)
    ours.setLevel(logging.INFO)
    try:
        with (
            Path(os.devnull).open("w", encoding="utf-8") as nowhere,
            contextlib.redirect_stdout(nowhere),
            contextlib.redirect_stderr(nowhere),
        ):
            yield
    finally:
        ours.removeHandler(handler)
        ours.setLevel(level)


def main() -> None:
    """Read the run from standard input; SIGTERM and Ctrl-C end it in good order."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    run, told = json.load(sys.stdin)
    logging.getLogger("modetune").propagate = False
    try:
        run_deployed(run, told)
    except KeyboardInterrupt:
        os._exit(0)  # it was told


if __name__ == "__main__":
    main()
