"""The structures of a fleet: the newest run of each, their order, and who is out of the family."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from modetune.core.brief import brief
from modetune.core.errors import CampaignError, StoreDamaged
from modetune.core.modes import Floats
from modetune.core.monitoring.past_runs import FOLDER, PastRun, newest_run
from modetune.core.updating.verdict import TrustVerdict
from modetune.flows.report.report_file import PAGE
from modetune.flows.studies.fleet.campaign_updates import UpdateEnd
from modetune.flows.studies.history.named_runs import run_folder
from modetune.flows.studies.history.trends import largest_error

#: Members of a design that are compared: with fewer the scatter of the family is not known.
FAMILY = 5
#: Deviations of the family beyond which a parameter is out of it: one in a million by normal
#: scatter, so that a thousand structures of ten parameters have none by chance.
OUT = 5.0
#: Median absolute deviation of a normal distribution, in standard deviations.
MAD = 0.6745


@dataclass(frozen=True, slots=True, repr=False)
class WatchedStructure:
    """A structure of a fleet.

    file: its campaign, where that is named. run: its newest run, None where there is none; n_runs:
    how many it has. problem: why there is no run, or what was left out. odd: parameters out of the
    family, a sentence each. failure: why its update just now gave no result; exit_code: of that
    update.
    """

    name: str
    folder: Path
    run: PastRun | None
    n_runs: int
    problem: str
    file: Path | None = None
    odd: tuple[str, ...] = ()
    failure: str = ""
    exit_code: int = 0

    __repr__ = brief

    @property
    def rank(self) -> tuple[int, float, str]:
        """The place in the list, the worst first."""
        run = self.run
        if run is None or self.failure:
            return 1, 0.0, self.name
        doubts = (
            run.verdict is TrustVerdict.NOT_TRUSTED,
            run.status != "converged",
            bool(self.odd),
            run.state == "unknown",
            run.verdict is not TrustVerdict.TRUSTED,
        )
        error = largest_error(run)
        first = doubts.index(True) if any(doubts) else len(doubts)
        place = 0 if run.state == "changed" else 2 + first
        return place, -error if np.isfinite(error) else 0.0, self.name

    @property
    def report(self) -> Path | None:
        """The report of the newest run."""
        page = self.folder / PAGE
        return page if page.is_file() else None


@dataclass(frozen=True, slots=True)
class Member:
    """A member of a fleet: its name, run folder and campaign, or why these are unknown."""

    name: str
    folder: Path
    file: Path | None = None
    problem: str = ""


def members_of(
    words: Sequence[Path], runs: Path, settings: Sequence[str] = ()
) -> tuple[Member, ...]:
    """Return the members that words name.

    A word is a campaign file, a run folder, a folder of run folders, or a pattern of these. runs:
    the folder of the campaigns' run folders. Raises CampaignError.
    """
    found: dict[Path, Member] = {}
    for member in (member for word in words for member in _members(word, runs, settings)):
        known = found.get(member.folder)
        if known is None or known.file is None:
            found[member.folder] = member
        elif member.file not in (None, known.file):
            assert member.file is not None
            problem = f"{known.file} has the same `name`, and so the same run folder"
            found[member.file] = replace(member, folder=member.file, problem=problem)
    if not found:
        named = ", ".join(map(str, words))
        raise CampaignError(
            f"{named}: no campaign and no run folder with a history; each `modetune update` adds a "
            "run to one"
        )
    return tuple(found.values())


def fleet_of(
    members: Sequence[Member], ends: Mapping[Path, UpdateEnd]
) -> tuple[WatchedStructure, ...]:
    """Return the structures of members, the worst first.

    ends: how updates of their campaigns ended just now, by the campaign's file.
    """
    found = [_structure(member) for member in members]
    for place, item in enumerate(found):
        end = None if item.file is None else ends.get(item.file)
        if end is not None:
            found[place] = replace(item, failure=end.failure, exit_code=end.exit_code)
    return tuple(sorted(_with_family(found), key=lambda item: item.rank))


def _members(word: Path, runs: Path, settings: Sequence[str]) -> Iterator[Member]:
    places = [word] if word.exists() else sorted(_fitting(word))
    if not places:
        raise CampaignError(f"{word} is not there, and nothing fits it as a pattern")
    for place in places:
        if place.is_file():
            try:
                folder = run_folder(place, runs, settings)[0].resolve()
            except CampaignError as error:
                yield Member(str(place.relative_to(place.parent.parent)), place, place, str(error))
            else:
                yield Member(folder.name, folder, place.resolve())
        elif (place / FOLDER).is_dir():
            yield Member(place.name, place.resolve())
        else:
            for item in sorted(place.glob(f"*/{FOLDER}")):
                yield Member(item.parent.name, item.parent.resolve())


def _fitting(pattern: Path) -> Iterator[Path]:
    start = Path(pattern.anchor)
    return start.glob(str(pattern.relative_to(start)))


def _structure(member: Member) -> WatchedStructure:
    name, folder, file = member.name, member.folder, member.file
    if member.problem:
        return WatchedStructure(name, folder, None, 0, member.problem, file, exit_code=2)
    try:
        run, n_runs, problem = newest_run(folder)
    except (CampaignError, StoreDamaged) as error:
        return WatchedStructure(name, folder, None, 0, str(error), file)
    if run is None and not problem:
        problem = "no run yet"
    return WatchedStructure(name if run is None else run.name, folder, run, n_runs, problem, file)


def _with_family(structures: Sequence[WatchedStructure]) -> Iterator[WatchedStructure]:
    """Yield the structures with what is out of the family, of those with the same parameters."""
    families: dict[tuple[str, ...], list[PastRun]] = {}
    for item in structures:
        if item.run is not None:
            families.setdefault(item.run.names, []).append(item.run)
    limits = {
        names: _limits(runs) for names, runs in families.items() if len(runs) >= FAMILY and names
    }
    for item in structures:
        if item.run is None or item.run.names not in limits:
            yield item
            continue
        middle, spread = limits[item.run.names]
        away = item.run.values / item.run.references - middle
        errors = np.nan_to_num(item.run.repeatability / np.abs(item.run.references))
        far = np.abs(away) > OUT * np.hypot(spread, errors)
        yield replace(
            item,
            odd=tuple(
                f"{item.run.names[place]} {100.0 * away[place]:+.1f} % from the family's median"
                for place in np.flatnonzero(far).tolist()
            ),
        )


def _limits(runs: Sequence[PastRun]) -> tuple[Floats, Floats]:
    """Return median and robust deviation of each parameter, relative to the decks."""
    values = np.array([run.values / run.references for run in runs])
    middle = np.nanmedian(values, axis=0)
    return middle, np.nanmedian(np.abs(values - middle), axis=0) / MAD
