"""Runs of a history by the words of a command: a campaign, a run folder, a file, a date."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from modetune.adapters.yaml_file import read_yaml
from modetune.core.errors import CampaignError
from modetune.core.monitoring.past_runs import (
    FOLDER,
    PAST_RUN,
    History,
    PastRun,
    past_run,
    read_history,
)
from modetune.core.storage.campaign_record import CAMPAIGN, is_record, read_record
from modetune.flows.campaign.campaign import campaign_form
from modetune.flows.campaign.schema import ModelFile, MonitoringSection
from modetune.flows.updating.run_history import kept_folder

#: A date, with as much of the time as is needed: 2026-11-27, 2026-11-27T21:05.
DATE = re.compile(r"\d{4}-\d\d-\d\d(T\d\d([:-]\d\d([:-]\d\dZ?)?)?)?")


@dataclass(frozen=True, slots=True)
class NamedRun:
    """A past run, and the folder with its record, report and deck; None where that is gone."""

    run: PastRun
    folder: Path | None


@dataclass(frozen=True, slots=True)
class Named:
    """What the words of the command name: a whole history, or two runs of one or two.

    monitoring: of the campaign; None where a run folder is named.
    """

    history: History
    folder: Path
    monitoring: MonitoringSection | None = None
    two: tuple[NamedRun, NamedRun] | None = None


def named(words: Sequence[Path], runs: Path, settings: Sequence[str]) -> Named:
    """Return what words name.

    One word is a campaign or a run folder. Dates after it are two of its runs; one date is compared
    with the newest. Two words without dates are two runs: files of a history, records, or folders.
    runs: the folder of run folders. Raises CampaignError, StoreDamaged.
    """
    first, *others = words
    # Words arrive as absolute paths, since most are files and folders.
    dates = [word.name for word in others if DATE.fullmatch(word.name) and not word.exists()]
    if others and len(dates) < len(others):
        if len(words) != 2 or dates:
            raise CampaignError(
                "modetune history takes a campaign or run folder, alone or with one or two dates, "
                "or two runs (files or folders)"
            )
        two = (_run_of(first, runs, settings), _run_of(others[0], runs, settings))
        return Named(History(), Path(), two=two)
    folder, monitoring = run_folder(first, runs, settings)
    history = read_history(folder)
    if not history.runs:
        reasons = [f"left out: {problem}" for problem in history.problems]
        raise CampaignError(
            [
                f"{folder / FOLDER} holds no past runs yet; each `modetune update` adds one",
                *reasons,
            ]
        )
    if not dates:
        return Named(history, folder, monitoring)
    if len(dates) > 2:
        raise CampaignError(f"two dates can be compared, and {len(dates)} are given")
    found = [_dated(history, folder, date) for date in dates]
    if len(found) == 1:
        found.append(_placed(folder, history.runs[-1]))
    return Named(history, folder, monitoring, (found[0], found[1]))


def run_folder(
    place: Path, runs: Path, settings: Sequence[str] = ()
) -> tuple[Path, MonitoringSection | None]:
    """Return the run folder of a campaign's file with its monitoring, or a run folder itself.

    Raises CampaignError.
    """
    if place.is_dir():
        return place, None
    if not place.is_file():
        raise CampaignError(f"{place} is not there; name a campaign file or a run folder")
    form = campaign_form(read_yaml(place, "a campaign"), list(settings), ModelFile)
    return runs / form.name, form.monitoring


def _run_of(place: Path, runs: Path, settings: Sequence[str]) -> NamedRun:
    """Return the run of a file of a history, a record, a kept folder, or a history's newest."""
    if place.is_file() and place.suffix not in (".yaml", ".yml"):
        if not is_record(place):
            run = PAST_RUN.read(place)
            return _placed(place.parent.parent, run)
        place = place.parent
    if (place / FOLDER).is_dir() or place.is_file():
        folder, _ = run_folder(place, runs, settings)
        history = read_history(folder)
        if history.runs:
            return _placed(folder, history.runs[-1])
    if place.is_dir() and (place / CAMPAIGN.file).is_file():
        return NamedRun(past_run(read_record(place), History()), place)
    raise CampaignError(
        f"{place} is no run; name a file of a history, a record, a run folder or a campaign"
    )


def _dated(history: History, folder: Path, date: str) -> NamedRun:
    """Return the last run of a date. Raises CampaignError where there is none."""
    wanted = date[:10] + date[10:].replace("-", ":")
    fitting = [run for run in history.runs if run.at.startswith(wanted)]
    if not fitting:
        known = sorted({run.at[:10] for run in history.runs})
        raise CampaignError(
            f"there is no run of {date} (UTC) in {folder / FOLDER}; it has runs from {known[0]} to "
            f"{known[-1]}"
        )
    return _placed(folder, fitting[-1])


def _placed(folder: Path, run: PastRun) -> NamedRun:
    return NamedRun(run, kept_folder(folder, run))
