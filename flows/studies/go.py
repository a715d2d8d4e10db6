"""`modetune go`: from a deck and a test to an updated model and its report, in one command."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modetune.core.errors import CampaignError
from modetune.flows.report.tables import json_object
from modetune.flows.studies.result import StudyResult, near
from modetune.flows.studies.study import (
    FailOnOption,
    Runs,
    SolverChoice,
    StepChoice,
    StudyContext,
    StudyOptions,
    SubcaseChoice,
    UnitsChoice,
    study,
    with_model,
)

if TYPE_CHECKING:
    from rich.console import Console

    from modetune.flows.campaign.campaign import Campaign
    from modetune.flows.studies.check.pre_check import PreCheckReport
    from modetune.flows.studies.init.draft import Draft
    from modetune.flows.updating.forecast import Progress


@dataclass(frozen=True)
class GoOptions(StudyOptions):
    """Options of the whole way."""

    deck: Annotated[Path, typer.Argument(help="The deck: CalculiX, Nastran or matrices.")]
    test: Annotated[
        tuple[Path, ...],
        typer.Argument(help="Files of its test: modes, response functions or a recording."),
    ] = ()
    out: Annotated[
        Path | None,
        typer.Option(
            help="Campaign file; one that exists is used as it is. Default: campaign.yaml next to "
            "the deck."
        ),
    ] = None
    solver: SolverChoice = None
    units: UnitsChoice = None
    subcase: SubcaseChoice = None
    step: StepChoice = None
    force: Annotated[
        bool, typer.Option("--force", help="Draft the campaign again over an existing file.")
    ] = False
    fail_on: FailOnOption = None
    runs: Runs = Path("runs")

    @property
    def campaign_file(self) -> Path:
        """Return the campaign file."""
        return self.out or self.deck.with_name("campaign.yaml")

    def open(self, progress: Progress, campaign: Campaign | None) -> StudyContext:
        if not self.test and (self.force or not self.campaign_file.exists()):
            raise CampaignError("name the test too: modetune go deck.inp lab.unv")
        return StudyContext(self.deck.stem, progress)


@study(GoOptions)
def go(on: StudyContext, options: GoOptions) -> StudyResult:
    """Go from a deck and a test to an updated model, with every guess listed.

    Identifies modes where the test has none, drafts the campaign, checks it, updates the model and
    writes the report. Stops with exit code 2 and the key to set where going on would be wrong:
    unknown units, a test that fits the model in several ways, or a pre-check that finds something
    wrong. The same command then continues with the campaign file. Otherwise it ends as update does.
    """
    from modetune.flows.updating.forecast import Unwatched

    assert on.run_study is not None
    draft = _drafted(on, options)
    guesses = [] if draft is None else _guesses(draft)
    if draft is not None and draft.sketch.units is None:
        made = (draft.path, draft.test.identified if draft.test else None)
        for path in filter(None, made):  # the placeholder of units must not be taken as set
            path.unlink()
        reason = f"the units of {near(options.deck)} are unknown ({draft.sketch.by_units})"
        return _stopped(guesses, reason, "repeat the command with --units")
    given = {"campaign_file": options.campaign_file, "settings": options.settings or []}
    on.working("checking model and test")
    checked = on.run_study("check", given, Unwatched())
    report: Any = checked.found
    if report.exit_code:
        again = f"correct {near(options.campaign_file)}, and repeat the command: it continues there"
        return _stopped(guesses, _refusal(report), again, report)
    whole = {**given, "runs": options.runs, "fail_on": options.fail_on}
    end = on.run_study("update", whole, on.progress)
    return StudyResult(
        end.found,
        end.sentence,
        json_object(
            status=end.state,
            campaign=near(options.campaign_file),
            guesses=guesses,
            findings=_doubts(report),
            exit_code=end.exit_code,
        )
        | {"update": end.to_json()},
        [*checked.tables, *end.tables],
        guesses,
        written=None,
        doubts=end.doubts,
        status=end.state,
        exit_code=end.exit_code,
        shown=partial(_show, options, guesses, report, end),
    )


def _drafted(on: StudyContext, options: GoOptions) -> Draft | None:
    """Return the draft of the campaign; None where its file exists already."""
    from modetune.flows.studies.init.draft import init_campaign

    if options.campaign_file.exists() and not options.force:
        return None
    on.working(f"drafting {near(options.campaign_file)}")
    settings = with_model(
        options.settings, options.solver, options.units, options.subcase, options.step
    )
    return init_campaign(options.deck, options.test, settings, options.campaign_file, options.force)


def _guesses(draft: Draft) -> list[str]:
    """Return what the draft took for granted, a sentence each with the key that changes it."""
    sketch, test = draft.sketch, draft.test
    found = [f"`model.solver`: {sketch.name}, which {sketch.by_solver}"] * bool(sketch.by_solver)
    if sketch.units is not None and sketch.by_units:
        found.append(f"`model.units`: {sketch.units}; {sketch.by_units}")
    for item in draft.cases:
        if item.number == getattr(sketch.model, item.key):
            found.append(f"`model.{item.key}`: {item}, one of {len(draft.cases)}")
    if test is not None:
        found += _test_guesses(draft)
    if draft.design.parameters:
        found.append(f"`parameters`: the deck's {len(draft.names)} design variables")
    else:
        found.append(
            f"`parameters`: {len(draft.names)} of {len(draft.candidates)} candidates are free, "
            "the others are comments in the file"
        )
    found.append(
        "`residuals`: deviations of a good modal test, 0.2 % of frequencies, 5 % of shapes"
    )
    return found


def _test_guesses(draft: Draft) -> list[str]:
    import numpy as np

    test = draft.test
    assert test is not None
    found = []
    if test.identified is not None:
        found.append(
            f"`test.use`: all modes that were identified into {near(test.identified)}; look at "
            "them with `modetune identify --figures`"
        )
    found.append(f"`test.sensors`: {test.about}")
    geometry = test.measurement.geometry
    if geometry is not None and test.mapping.alignment and not np.isfinite(geometry.metres):
        found.append("`test.length`: the files do not state their unit; it was found by the fit")
    return found


def _refusal(report: PreCheckReport) -> str:
    if report.failure is not None:
        return str(report.failure)
    wrong = [item.text for item in report.findings if item.level == "wrong"]
    return f"the pre-check found {len(wrong)} wrong: {wrong[0]}"


def _doubts(report: PreCheckReport) -> list[dict[str, Any]]:
    return [
        json_object(item, "level subject text") for item in report.findings if item.level != "good"
    ]


def _stopped(
    guesses: list[str], reason: str, again: str, report: PreCheckReport | None = None
) -> StudyResult:
    """Return the end where going on would be wrong; again: how to continue."""
    code = 2 if report is None else report.exit_code
    findings = [] if report is None else _doubts(report)
    return StudyResult(
        CampaignError([reason, again]),
        f"stopped: {reason}",
        json_object(
            status="stopped",
            reason=reason,
            remedy=again,
            guesses=guesses,
            findings=findings,
            exit_code=code,
            update=None,
        ),
        written=None,
        lines=[*guesses, *(str(item["text"]) for item in findings), f"stopped: {reason}", again],
        doubts=[reason],
        status="stopped",
        exit_code=code,
    )


def _show(
    options: GoOptions,
    guesses: list[str],
    report: PreCheckReport,
    end: StudyResult,
    console: Console,
) -> None:
    """Print the guesses, the findings that are not good, and the update."""
    from modetune.flows.report.tables import show

    lines = [f"guess      {text}" for text in guesses]
    lines += [f"{item['level']:10} {item['text']}" for item in _doubts(report)]
    show([f"campaign   {near(options.campaign_file)}", *lines, ""], console)
    assert end.shown is not None
    end.shown(console)
