"""`modetune fleet`: many structures, updated if asked, the worst first."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modetune.core.errors import CampaignError
from modetune.flows.report.tables import Column, Table, json_object
from modetune.flows.studies.result import StudyResult, near
from modetune.flows.studies.study import FailOnOption, Page, Runs, StudyContext, StudyOptions, study

if TYPE_CHECKING:
    from rich.console import Console

    from modetune.flows.campaign.campaign import Campaign
    from modetune.flows.studies.fleet.campaign_updates import UpdateEnd
    from modetune.flows.studies.fleet.watched_structures import Member, WatchedStructure
    from modetune.flows.updating.forecast import Progress

#: Rows of the table on a terminal; a page has all.
SHOWN = 40
COLUMNS = (
    Column("structure", words=True, name="name"),
    Column("state", words=True, name="state"),
    Column("remark", words=True, name="remark"),
    Column("parameters", words=True, name="verdict"),
    Column("status", words=True, name="status"),
    Column("largest frequency error", "%", ".2f", name="error"),
    Column("newest run (UTC)", words=True, name="at"),
    Column("runs", name="runs"),
)


@dataclass(frozen=True)
class FleetOptions(StudyOptions):
    """Options of a fleet, whose campaigns load only if they are updated."""

    of: Annotated[
        tuple[Path, ...],
        typer.Argument(
            help="Campaign files, run folders, folders of run folders, or patterns of these."
        ),
    ]
    update: Annotated[bool, typer.Option(help="Update the campaigns before they are shown.")] = (
        False
    )
    parallel: Annotated[
        int | None,
        typer.Option(min=1, help="Number of updates at a time; default: the number of cores."),
    ] = None
    fail_on: FailOnOption = None
    page: Page = None
    runs: Runs = Path("runs")

    def open(self, progress: Progress, campaign: Campaign | None) -> StudyContext:
        from modetune.flows.report.page import check_page

        check_page(self.page)
        if not self.of:
            raise CampaignError("name run folders or campaigns: modetune fleet runs")
        if not self.update and (self.parallel or self.fail_on):
            raise CampaignError("--parallel and --fail-on belong to --update")
        return StudyContext("fleet", progress, folder=self.runs)

    @property
    def solves(self) -> bool:
        return self.update


@study(FleetOptions)
def fleet(on: StudyContext, options: FleetOptions) -> StudyResult:
    """Show the newest run of many structures in one table, worst first.

    Reads the histories that `modetune update` writes. With --update it first updates the campaigns
    that are named, several at a time; one that fails stops no other, and the exit code is that of
    the worst structure with one. Structures with the same parameters are compared: the remark names
    those out of the family.
    """
    from modetune.flows.studies.fleet.watched_structures import fleet_of, members_of

    members = members_of(options.of, on.folder, options.settings or ())
    found = fleet_of(members, _updated(on, options, members) if options.update else {})
    sentence = _sentence(found)
    code = next((item.exit_code for item in found if item.exit_code), 0)
    return StudyResult(
        found,
        sentence,
        json_object(
            status="done",
            sentence=sentence,
            exit_code=code,
            structures=[_json(item) for item in found],
        ),
        [_table(found, options.page)],
        [sentence],
        status=sentence,
        exit_code=code,
        shown=partial(_show, found, sentence),
    )


def _updated(
    on: StudyContext, options: FleetOptions, members: Sequence[Member]
) -> dict[Path, UpdateEnd]:
    """Update the campaigns of members. Raises CampaignError where none has one."""
    from modetune.flows.campaign.campaign import cores
    from modetune.flows.studies.fleet.campaign_updates import update_all

    files = [member.file for member in members if member.file and not member.problem]
    if not files:
        raise CampaignError(
            "--update needs campaign files: modetune fleet 'campaigns/*.yaml' --update"
        )
    given = {"fail_on": options.fail_on, "runs": options.runs, "settings": options.settings or []}
    return update_all(on, files, options.parallel or cores(), given)


def _sentence(found: Sequence[WatchedStructure]) -> str:
    states = Counter("without a run" if item.run is None else item.run.state for item in found)
    known = ("changed", "without a run", "unknown", "learning", "steady")
    failed = sum(bool(item.failure) for item in found)
    counts = [f"{states[name]} {name}" for name in known if states[name]]
    counts += [f"{failed} not updated"] * bool(failed)
    far = sum(item.run is not None and item.run.status != "converged" for item in found)
    counts += [f"{far} without e1"] * bool(far)
    return f"{len(found)} structure{'' if len(found) == 1 else 's'}: {', '.join(counts)}"


def _show(found: tuple[WatchedStructure, ...], sentence: str, console: Console) -> None:
    """Print the worst structures."""
    from modetune.flows.report.tables import show

    more = len(found) - SHOWN
    lines = [f"{more} more structures: see --page or --json"] if more > 0 else []
    show([_table(found[:SHOWN], None), *lines, sentence], console)


def _table(found: tuple[WatchedStructure, ...], page: Path | None) -> Table:
    """Return a row a structure; page: from which reports are linked."""
    links = {}
    for place, item in enumerate(found):
        if page is not None and item.report is not None:
            links[place] = Path(os.path.relpath(item.report, page.resolve().parent)).as_posix()
    changed = [
        place
        for place, item in enumerate(found)
        if item.run is None or item.failure or item.run.state == "changed"
    ]
    rows = tuple(_row(item) for item in found)
    outside = frozenset((place, "") for place in changed)
    return Table("Structures, worst first", COLUMNS, rows, outside=outside, links=links)


def _row(item: WatchedStructure) -> tuple[Any, ...]:
    from modetune.flows.studies.history.trends import largest_error

    run = item.run
    if run is None:
        remark = item.failure or item.problem
        return item.name, "no run", remark, "", "", float("nan"), "", item.n_runs
    said = run.drift if run.state in ("changed", "unknown") else ""
    remark = "; ".join(filter(None, (item.failure, said, *item.odd, item.problem)))
    return (
        item.name,
        run.state or "unknown",
        remark,
        run.verdict.brief,
        run.status.replace("_", " "),
        largest_error(run),
        run.at[:16].replace("T", " "),
        item.n_runs,
    )


def _json(item: WatchedStructure) -> dict[str, Any]:
    from modetune.flows.studies.history.study import run_json

    return json_object(
        name=item.name,
        run_dir=near(item.folder),
        runs=item.n_runs,
        problem=item.problem,
        failure=item.failure,
        exit_code=item.exit_code,
        out_of_family=item.odd,
        newest=None if item.run is None else run_json(item.run),
        report=None if item.report is None else near(item.report),
    )
