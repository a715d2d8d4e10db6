"""The structures of a fleet: the newest run of each, their order, and who is out of the family."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from modetune.core.brief import brief
from modetune.core.errors import CampaignError, StoreDamaged
from modetune.core.modes import Floats
from modetune.core.monitoring.past_runs import FOLDER, PastRun, newest_run
from modetune.core.updating.verdict import TrustVerdict
from modetune.flows.report.report_file import PAGE
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

    run: its newest run, None where there is none; n_runs: how many it has. problem: why there is no
    run, or what was left out. odd: parameters out of the family, a sentence each.
    """

    name: str
    folder: Path
    run: PastRun | None
    n_runs: int
    problem: str
    odd: tuple[str, ...] = ()

    __repr__ = brief

    @property
    def rank(self) -> tuple[int, float, str]:
        """The place in the list, the worst first."""
        run = self.run
        if run is None:
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


def fleet_of(words: Sequence[Path], runs: Path) -> tuple[WatchedStructure, ...]:
    """Return the structures that words name, the worst first.

    A word is a campaign file, a run folder, a folder of run folders, or a pattern of these. runs:
    the folder of the campaigns' run folders. Raises CampaignError.
    """
    folders = dict.fromkeys(folder for word in words for folder in _folders(word, runs))
    if not folders:
        named = ", ".join(map(str, words))
        raise CampaignError(
            f"{named}: no campaign and no run folder with a history; each `modetune update` adds a "
            "run to one"
        )
    found = [_structure(folder) for folder in folders]
    return tuple(sorted(_with_family(found), key=lambda item: item.rank))


def _folders(word: Path, runs: Path) -> Iterator[Path]:
    """Yield the run folders of a word."""
    places = [word] if word.exists() else sorted(_fitting(word))
    if not places:
        raise CampaignError(f"{word} is not there, and nothing fits it as a pattern")
    for place in places:
        if place.is_file():
            yield run_folder(place, runs)[0].resolve()
        elif (place / FOLDER).is_dir():
            yield place.resolve()
        else:
            yield from sorted(item.parent.resolve() for item in place.glob(f"*/{FOLDER}"))


def _fitting(pattern: Path) -> Iterator[Path]:
    start = Path(pattern.anchor)
    return start.glob(str(pattern.relative_to(start)))


def _structure(folder: Path) -> WatchedStructure:
    try:
        run, n_runs, problem = newest_run(folder)
    except (CampaignError, StoreDamaged) as error:
        return WatchedStructure(folder.name, folder, None, 0, str(error))
    if run is None and not problem:
        problem = "no run yet"
    return WatchedStructure(folder.name if run is None else run.name, folder, run, n_runs, problem)


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
