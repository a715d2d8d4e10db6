"""The history of a structure: one small file for each update, never rewritten.

    history/2026-11-27T21-05-11Z-1f0c9a2b.h5     a past run, as `core/storage/sealed_file` writes it
    history/2026-11-27T21-05-11Z-1f0c9a2b/       its record, report and deck, as long as kept

The name has the time (UTC) of the test, or else at which the run ended, and the first digits of its
evidence: the digest of the test, its environment, the deck with its solver, and the parameters that
came out. A run with the same evidence as an earlier one teaches nothing new and leaves no second
file, so an update that is repeated, or that finds no new test, is the same night.

There is no index: the files are read each time, 1,000 of them in about a second. A file is written
under another name, flushed and renamed, so it is whole or absent, and any number of processes may
write to the folder. Runs are ordered by their numbers, which ascend even where a clock goes back.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np

from modetune.core.brief import brief
from modetune.core.errors import CampaignError, StoreDamaged
from modetune.core.modes import Floats, Integers, mode_name
from modetune.core.monitoring.series import Series
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.storage.files import storage_errors
from modetune.core.storage.sealed_file import RecordFile
from modetune.core.updating.verdict import TrustVerdict

#: The folder of past runs in a campaign's run folder.
FOLDER = "history"
#: Digits of the evidence in a file's name.
SHORT = 8
#: Files among which the newest run is looked for, as a clock may have gone back.
NEWEST = 3
#: Significant digits of parameters in the evidence: an answer that is computed again on other
#: threads differs by rounding, which the condition of the last step enlarges.
DIGITS = 6


@dataclass(frozen=True, slots=True, repr=False)
class PastRun:
    """A finished update in the history of its structure.

    number: from 1, in the order of the runs. ended_at, measured_at: of the update and of its test,
    seconds since 1970, the latter NaN if unknown. evidence: digest of what
    it found, and from what. test_digest: of the measured data. state, drift: of the structure, a
    word and a sentence, as found at the end of this run; changed: parameters that changed. names,
    quantities: of the parameters; units: the deck's; values, deck_values, standard_errors,
    repeatability: (n_parameters,), in the deck's units; covariance: (n_parameters, n_parameters),
    of repeatability, NaN without a sensitivity. modes: labels of the test's; test_hz,
    damping_ratios, updated_hz, macs: (n_modes,), NaN where unknown; elastic_modes: (n_modes,), the
    model's, from 1, or 0 without a partner.
    environment: what was measured with the test. deck_digest: SHA-256 and name of the deck's file;
    modal_key: of the first job.
    """

    number: int
    name: str
    ended_at: float
    measured_at: float
    evidence: str
    test_digest: str
    status: str
    reason: str
    verdict: TrustVerdict
    state: str
    drift: str
    changed: tuple[str, ...]
    names: tuple[str, ...]
    quantities: tuple[str, ...]
    units: str
    values: Floats
    deck_values: Floats
    standard_errors: Floats
    repeatability: Floats
    covariance: Floats
    modes: tuple[str, ...]
    test_hz: Floats
    damping_ratios: Floats
    updated_hz: Floats
    macs: Floats
    elastic_modes: Integers
    environment: Mapping[str, float]
    deck_digest: str
    modal_key: str
    settings: tuple[str, ...]
    solver: str
    solver_version: str
    modetune_version: str
    versions: tuple[str, ...]

    __repr__ = brief

    @property
    def time(self) -> float:
        """When its test was measured, or else when it ended, seconds since 1970."""
        return self.ended_at if math.isnan(self.measured_at) else self.measured_at

    @property
    def at(self) -> str:
        """The same in UTC: 2026-11-27T21:05:11Z."""
        return utc(self.time)

    @property
    def stem(self) -> str:
        """The name of its file and of its folder."""
        return f"{self.at.replace(':', '-')}-{self.evidence[:SHORT]}"

    @property
    def references(self) -> Floats:
        """What values are relative to: the deck's, or one unit where that is zero."""
        return np.where(self.deck_values != 0.0, self.deck_values, 1.0)

    @property
    def pairs(self) -> dict[str, int]:
        """The model's mode, from 1, of each paired test mode, by its label."""
        both = zip(self.modes, self.elastic_modes.tolist(), strict=True)
        return {label: mode for label, mode in both if mode}


def _with_time(file: h5py.File) -> None:
    """Change the content of format 1 into that of 2, which may know when the test was."""
    file.attrs["measured_at"] = np.nan


PAST_RUN = RecordFile(
    PastRun,
    "history",
    f"{FOLDER}/*.h5",
    2,
    {1: _with_time},
    remedy="move it out of the folder of the history",
)


@dataclass(frozen=True, slots=True, repr=False)
class History:
    """The past runs of a structure, oldest first.

    problems: a sentence for each file that is left out.
    """

    runs: tuple[PastRun, ...] = ()
    problems: tuple[str, ...] = field(default=())

    __repr__ = brief

    def with_same_evidence(self, run: PastRun) -> PastRun | None:
        """Return the run with the same evidence; None where there is none."""
        return next((item for item in self.runs if item.evidence == run.evidence), None)

    def until(self, run: PastRun) -> History:
        """Return the history up to a run, which may be new."""
        return replace(self, runs=(*(item for item in self.runs if item.number < run.number), run))

    def nights(self) -> tuple[PastRun, ...]:
        """Return the last run of each test that has the parameters of the newest run.

        In the order of their tests where the time of each is known, else in that of the runs.
        Measured data that are used twice have the same noise, so a test counts once.
        """
        if not self.runs:
            return ()
        names = self.runs[-1].names
        last = {run.test_digest: run for run in self.runs if run.names == names}
        return in_time(last.values())

    def series(self) -> Series:
        """Return the parameters of all nights, relative to the newest deck.

        Raises CampaignError without a run.
        """
        nights = self.nights()
        if not nights:
            raise CampaignError("there is no run in the history yet")
        quantities = tuple(sorted({name for run in nights for name in run.environment}))
        scale = 1.0 / nights[-1].references
        return Series(
            # A clock that goes back must not change the order.
            times=np.maximum.accumulate([run.time for run in nights]),
            names=nights[-1].names,
            values=np.array([run.values * scale for run in nights]),
            covariances=np.array([run.covariance * np.outer(scale, scale) for run in nights]),
            environment=np.array(
                [[run.environment.get(name, np.nan) for name in quantities] for run in nights]
            ).reshape(len(nights), len(quantities)),
            quantities=quantities,
        )


def in_time(runs: Iterable[PastRun]) -> tuple[PastRun, ...]:
    """Return runs in the order of their tests if all times are known, else in their own order."""
    found = sorted(runs, key=_order)
    if any(math.isnan(run.measured_at) for run in found):
        return tuple(found)
    return tuple(sorted(found, key=lambda run: run.measured_at))


def utc(seconds: float) -> str:
    """Return a time in UTC as a text, to the second."""
    when = datetime.fromtimestamp(math.floor(seconds), UTC)
    return when.strftime("%Y-%m-%dT%H:%M:%SZ")


def read_history(folder: Path) -> History:
    """Return the history in a run folder, without files that are damaged or foreign."""
    found: dict[str, PastRun] = {}
    problems: list[str] = []
    try:
        files = sorted(file for file in (folder / FOLDER).iterdir() if file.suffix == ".h5")
    except FileNotFoundError:
        return History()
    except OSError as error:
        return History((), (f"{folder / FOLDER} cannot be read: {error.strerror}",))
    for file in files:
        try:
            run = PAST_RUN.read(file)
        except (CampaignError, StoreDamaged) as error:
            problems.append(str(error))
        else:
            found.setdefault(run.evidence, run)  # of two writers at once
    return History(tuple(sorted(found.values(), key=_order)), tuple(problems))


def newest_run(folder: Path) -> tuple[PastRun | None, int, str]:
    """Return the newest run of a run folder, the number of its files, and what could not be read.

    Reads a few files, the newest by their names. Raises CampaignError, StoreDamaged for the newest
    file where none can be read.
    """
    files = sorted((folder / FOLDER).glob("*.h5"), reverse=True)
    found: list[PastRun] = []
    problem: CampaignError | StoreDamaged | None = None
    for file in files[:NEWEST]:
        try:
            found.append(PAST_RUN.read(file))
        except (CampaignError, StoreDamaged) as error:
            problem = problem or error
    if problem is not None and not found:
        raise problem
    newest = max(found, key=_order, default=None)
    return newest, len(files), "" if problem is None else f"left out: {problem}"


def add_past_run(folder: Path, run: PastRun) -> Path:
    """Write a run into the history of a run folder. Raises StorageUnavailable."""
    file = folder / FOLDER / f"{run.stem}.h5"
    with storage_errors(file):
        if not file.exists():
            PAST_RUN.write(file, run)
    return file


def past_run(record: CampaignRecord, history: History) -> PastRun:
    """Return the finished run of a record, the next one in a history."""
    n = len(record.parameters)
    decks = record.deck_values[:n]
    pairs = zip(record.parameters.parameters, decks.tolist(), record.updated.tolist(), strict=True)
    values = np.array([item.number(deck, value) for item, deck, value in pairs])
    slopes = np.array(
        [
            item.scale * (deck if item.values == "relative" else 1.0)
            for item, deck in zip(record.parameters.parameters, decks.tolist(), strict=True)
        ]
    )
    unknown = np.full((n, n), np.nan)
    covariance = record.covariance if record.covariance.size else unknown
    test, digest = record.test.modes, digest_test(record)
    modes = _mode_labels(record)
    updated_hz, macs, elastic_modes = _partners(record)
    return PastRun(
        number=max((run.number for run in history.runs), default=0) + 1,
        name=record.name,
        ended_at=record.ended_at,
        measured_at=record.measured_at,
        evidence=_evidence_of(record, digest, values),
        test_digest=digest,
        status=record.status,
        reason=record.reason,
        verdict=record.verdict,
        state=record.state,
        drift=record.drift,
        changed=record.changed,
        names=record.parameters.names,
        quantities=tuple(item.quantity for item in record.parameters.parameters),
        units=record.units,
        values=values,
        deck_values=decks,
        standard_errors=np.abs(slopes) * record.standard_errors[:n],
        repeatability=np.abs(slopes) * record.repeatability[:n],
        covariance=np.asarray(covariance * np.outer(slopes, slopes), dtype=np.float64),
        modes=modes,
        test_hz=test.frequencies_hz,
        damping_ratios=test.damping_ratios
        if test.damping_ratios.size
        else np.full(len(modes), np.nan),
        updated_hz=updated_hz,
        macs=macs,
        elastic_modes=elastic_modes,
        environment=dict(record.environment),
        deck_digest=record.deck_digest,
        modal_key=record.iterations[0].modal_key,
        settings=record.settings,
        solver=record.solver,
        solver_version=record.solver_version,
        modetune_version=record.modetune_version,
        versions=record.versions,
    )


def _mode_labels(record: CampaignRecord) -> tuple[str, ...]:
    label = record.configurations or ("",) * len(record.test.numbers)
    return tuple(
        mode_name(number, of).removeprefix("mode ")
        for number, of in zip(record.test.numbers, label, strict=True)
    )


def _partners(record: CampaignRecord) -> tuple[Floats, Floats, Integers]:
    """Return frequency, MAC and number of the partner of each test mode, (n_modes,) each."""
    best, n = record.best.pairing, len(record.test.numbers)
    updated_hz, macs = np.full((2, n), np.nan)
    elastic_modes = np.zeros(n, dtype=np.int64)
    updated_hz[best.measured] = record.best.computed.frequencies_hz[best.computed]
    macs[best.measured] = best.judged_mac
    elastic_modes[best.measured] = best.computed + 1
    return updated_hz, macs, elastic_modes


def _evidence_of(record: CampaignRecord, test_digest: str, values: Floats) -> str:
    """Return the digest of what a run found, and from what; values: of the parameters."""
    return _digest(
        [
            test_digest,
            record.iterations[0].modal_key,
            *(f"{name} {value!r}" for name, value in sorted(record.environment.items())),
            *record.parameters.names,
            *(f"{value:.{DIGITS - 1}e}" for value in values.tolist()),
            record.status,
            record.verdict.name,
            *(["unconfirmed"] if record.unconfirmed else []),
        ]
    )


def digest_test(record: CampaignRecord) -> str:
    """Return the SHA-256 of the measured data of a record: modes, functions, other responses."""
    modes, frfs = record.test.modes, record.frfs
    arrays = [
        np.array(record.test.numbers),
        modes.frequencies_hz,
        modes.mode_shapes,
        modes.nodes,
        modes.components,
        modes.damping_ratios,
        *(block.measured for block in record.iterations[0].residual.blocks),
    ]
    if frfs is not None:
        arrays += [frfs.frequencies_hz, frfs.values, frfs.nodes, frfs.components]
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(f"{array.dtype.str}{array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _digest(texts: Iterable[str]) -> str:
    return hashlib.sha256("\n".join(texts).encode()).hexdigest()


def _order(run: PastRun) -> tuple[int, float]:
    return run.number, run.ended_at
