"""Commands about what is stored: `explain`, and what `update --dry-run` and `check --against` say.

Heavy packages are imported where they are needed.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from modetune.core.keys import Json
    from modetune.flows.baseline import Band, BaselineCheck
    from modetune.flows.dry_run import DryRun, PlannedJob
    from modetune.flows.explain import Asked, Nearest
    from modetune.flows.forecast import Forecast
    from modetune.flows.lookup import Explanation

#: Digits of a key that are shown.
SHORT = 12

Against = Annotated[
    Path | None, typer.Option(help="A campaign.h5 whose errors the model must not exceed.")
]
Record = Annotated[
    Path | None,
    typer.Option(help="With --against: compare this campaign.h5's updated model, run nothing."),
]
BaselineState = Annotated[
    str, typer.Option(help="Which model of the baseline: updated, or initial.")
]
FrequencyBand = Annotated[
    float, typer.Option(min=0.0, help="How much larger a relative frequency error may be.")
]
MacBand = Annotated[float, typer.Option(min=0.0, max=1.0, help="How much smaller a MAC may be.")]


def explain(
    job: Annotated[str, typer.Argument(help="Start of a job's key, or a job's folder.")],
    store: Annotated[
        Path, typer.Option(help="Folder of the store, or a campaign file that names it.")
    ] = Path(".modetune/store"),
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """Tell what a job is, what became of it, and in what it differs from the nearest result."""
    from modetune.core.errors import CampaignError
    from modetune.core.store import Store
    from modetune.flows.campaign import load_campaign
    from modetune.flows.lookup import explain_job, explain_unrun, key_start

    start = key_start(job)
    if not store.exists():
        raise CampaignError(f"{store} is not there; name a store or a campaign file with --store")
    campaign = load_campaign(store) if store.is_file() else None
    place = campaign.store if campaign else Store(store)
    found = explain_job(place, start)
    if found is None and campaign is not None:
        found = explain_unrun(campaign, start)
    if found is None:
        raise CampaignError(
            f"nothing is known of a job {start}...: {place.folder} has no result and no job "
            "folder of it" + ("" if campaign else "; a campaign file as --store tells of jobs "
                              "that are still to be run")
        )  # fmt: skip
    if as_json:
        typer.echo(json.dumps(_told(found)))
        return
    for heading, text in _lines(found):
        typer.echo(f"{heading:9}{text}")


def register(app: typer.Typer) -> None:
    """Add this file's commands to the command line."""
    app.command()(explain)


def show_dry_run(campaign_file: Path, settings: list[str], runs: Path, as_json: bool) -> None:
    """Say what an update would run."""
    from modetune.flows.campaign import load_campaign
    from modetune.flows.dry_run import dry_run

    campaign = load_campaign(campaign_file, settings)
    found = dry_run(campaign, runs / campaign.name)
    if as_json:
        typer.echo(json.dumps(_told_dry_run(found)))
        return
    if found.answered:
        typer.echo(
            f"the store answers the {found.answered} jobs of "
            f"{_count(len(found.iterations), 'evaluation')}"
        )
    for item in found.jobs:
        typer.echo(_planned_line(item))
        if not item.stored:
            typer.echo(f"      {_nearest_line(item.nearest)}")
    if found.ended is not None:
        typer.echo(f"nothing would be run; {found.ended.status}: {found.ended.reason}")
    elif not found.jobs:
        typer.echo("modes would be found from the stored matrices, and then one modal job would be "
                   "run at the parameters where that ends")  # fmt: skip
    else:
        typer.echo(f"{_count(len(found.runs), 'job')} would be run, {len(found.jobs)} are asked "
                   "for in this iteration; what follows depends on their results")  # fmt: skip


def show_check(
    campaign_file: Path,
    settings: list[str],
    baseline: Path | None,
    record: Path | None,
    state: str,
    bands: tuple[float, float],
    as_json: bool,
) -> None:
    """Compare a campaign's model with a baseline; ends with exit code 3 outside its band."""
    from modetune.core.errors import CampaignError
    from modetune.flows.baseline import Band, State, check_deck, check_record
    from modetune.flows.campaign import load_campaign

    if baseline is None:
        raise CampaignError("--record wants a baseline to compare with; name one with --against")
    if state not in ("updated", "initial"):
        raise CampaignError(f"--state {state!r}: expected updated or initial")
    model: State = "initial" if state == "initial" else "updated"
    campaign, band = load_campaign(campaign_file, settings), Band(*bands)
    if record is None:
        found = check_deck(campaign, baseline, model, band)
    else:
        found = check_record(campaign, record, baseline, model, band)
    if as_json:
        typer.echo(json.dumps(_told_check(found, state, band)))
    else:
        for line in _check_lines(found):
            typer.echo(line)
    if not found.within:
        raise typer.Exit(3)


def with_forecast(told: dict[str, Json], forecast: Forecast | None) -> dict[str, Json]:
    """A summary and what the campaign was expected to cost before it started."""
    from modetune.flows.forecast import told_forecast

    return {**told, "forecast": told_forecast(forecast) if forecast else None}


def _check_lines(found: BaselineCheck) -> list[str]:
    lines = ["mode      test Hz    error  baseline     MAC  baseline"] if found.modes else []
    for mode in found.modes:
        both = (mode.mac, mode.baseline_mac)
        macs = [f"{value:.3f}" if isfinite(value) else "-" for value in both]
        lines.append(
            f"{mode.number:4d} {mode.test_hz:12.3f} {100 * mode.error:+7.2f}% "
            f"{100 * mode.baseline_error:+8.2f}% {macs[0]:>7} {macs[1]:>9}"
            + ("  left the band" if mode.reasons else "")
        )
    end = "within the band" if found.within else f"worse than the baseline: {found.reason}"
    return [*lines, *found.remarks, end]


def _told_check(found: BaselineCheck, state: str, band: Band) -> dict[str, Json]:
    return {
        "status": "within" if found.within else "worse",
        "reason": found.reason,
        "state": state,
        "frequency_band": band.frequency,
        "mac_band": band.mac,
        "modes": [
            {
                "mode": mode.number,
                "test_hz": mode.test_hz,
                "error": mode.error,
                "baseline_error": mode.baseline_error,
                "mac": mode.mac if isfinite(mode.mac) else None,
                "baseline_mac": mode.baseline_mac if isfinite(mode.baseline_mac) else None,
                "within": not mode.reasons,
            }
            for mode in found.modes
        ],
        "remarks": list(found.remarks),
        "solver_runs": {"modal": found.runs.modal, "reused": found.runs.reused},
    }


def _count(number: int, word: str) -> str:
    return f"{number} {word}{'' if number == 1 else 's'}"


def _planned_line(item: PlannedJob) -> str:
    word = "hit" if item.stored else "run"
    return f"{word}   {item.key[:SHORT]}   {item.iteration} / {item.name}"


def _nearest_line(found: Nearest | None) -> str:
    if found is None:
        return "nothing is stored that it could be compared with"
    return f"nearest {found.key[:SHORT]}: {'; '.join(found.differences)}"


def _lines(found: Explanation) -> list[tuple[str, str]]:
    from modetune.flows.explain import describe

    lines = [("job", found.key), ("state", found.state)]
    lines += describe(found.job) if found.job else [("what", "not known: no note is with it")]
    if found.wall_s is not None:
        lines.append(("took", f"{found.wall_s:.1f} s"))
    if found.written_s is not None:
        lines.append(("when", f"{datetime.fromtimestamp(found.written_s, UTC):%Y-%m-%d %H:%M} UTC"))
    if found.where is not None:
        lines.append(("where", str(found.where)))
    if found.job is not None:
        lines.append(("nearest", _nearest_line(found.nearest).removeprefix("nearest ")))
    return lines + ([("log", found.log)] if found.log else [])


def _told(found: Explanation) -> dict[str, Json]:
    return {
        "status": found.state,
        "key": found.key,
        "where": str(found.where) if found.where else None,
        "written": (
            datetime.fromtimestamp(found.written_s, UTC).isoformat() if found.written_s else None
        ),
        "wall_s": found.wall_s,
        "job": _told_job(found.job) if found.job else None,
        "nearest": _told_nearest(found.nearest),
        "log": found.log,
    }


def _told_job(job: Asked) -> dict[str, Json]:
    note = job.note
    return {
        "solver": job.solver,
        "solver_version": job.solver_version,
        "analysis": job.kind,
        "model": note.model if note else None,
        "n_modes": note.n_modes if note else None,
        "values": dict(note.values) if note else None,
    }


def _told_nearest(found: Nearest | None) -> Json:
    return {"key": found.key, "differences": list(found.differences)} if found else None


def _told_dry_run(found: DryRun) -> dict[str, Json]:
    return {
        "status": "complete" if found.ended else "would run",
        "reason": found.ended.reason if found.ended else "",
        "answered": found.answered,
        "runs": len(found.runs),
        "jobs": [
            {
                "key": item.key,
                "iteration": item.iteration,
                "name": item.name,
                "stored": item.stored,
                "job": _told_job(item.asked) if item.asked else None,
                "nearest": _told_nearest(item.nearest),
            }
            for item in found.jobs
        ],
    }
