"""`modetune receive`: update with each new test of the lab's folder."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modetune.core.errors import (
    CampaignError,
    CampaignRunning,
    ModesError,
    ModetuneError,
    StorageUnavailable,
)
from modetune.flows.report.tables import Column, json_object, table_of
from modetune.flows.studies.result import StudyResult, near
from modetune.flows.studies.study import (
    CampaignOptions,
    FailOnOption,
    Runs,
    StudyContext,
    study,
)

if TYPE_CHECKING:
    from modetune.core.modes import MeasuredModes
    from modetune.flows.campaign.campaign import Campaign
    from modetune.flows.campaign.schema import TestSection
    from modetune.flows.studies.identify.identification import IdentificationSettings
    from modetune.flows.studies.receive.lab_files import Inbox, ReceivedFile


@dataclass(frozen=True)
class ReceiveOptions(CampaignOptions):
    """Options of receiving tests."""

    lab: Annotated[
        tuple[Path, ...], typer.Argument(help="Folders in which tests arrive, or test files.")
    ] = ()
    settle: Annotated[
        float,
        typer.Option(min=0.0, help="Seconds for which a file has not changed before it is read."),
    ] = 30.0
    again: Annotated[bool, typer.Option(help="Judge files that were set aside again.")] = False
    band: Annotated[
        str | None,
        typer.Option(
            help="Lowest and highest frequency for identification, Hz: 5,80; default: from 0.6 "
            "times the lowest mode of the campaign's test to 1.25 times the highest."
        ),
    ] = None
    order: Annotated[
        int, typer.Option(min=2, help="Number of pole pairs of the largest model.")
    ] = 60
    fail_on: FailOnOption = None
    runs: Runs = Path("runs")

    def folder(self, campaign: Campaign) -> Path:
        return self.runs / campaign.name

    def identification(self) -> IdentificationSettings:
        """Return how recordings are identified. Raises CampaignError."""
        from modetune.flows.studies.identify.identification import IdentificationSettings

        if self.band is None:
            return IdentificationSettings(order=self.order)
        try:
            low, high = (float(part) for part in self.band.split(","))
        except ValueError:
            raise CampaignError(f"--band {self.band}: expected two frequencies: 5,80") from None
        return IdentificationSettings((low, high), self.order)


@dataclass(frozen=True, slots=True)
class ReceivedRow:
    """A row of the table."""

    file: Annotated[str, Column("file", words=True)]
    measured: Annotated[str, Column("measured (UTC)", words=True)]
    decision: Annotated[str, Column("decision", words=True)]
    modes: Annotated[str, Column("modes found again", words=True)]
    remark: Annotated[str, Column("result", words=True)]


@study(ReceiveOptions)
def receive(on: StudyContext, options: ReceiveOptions) -> StudyResult:
    """Update with each new test of the lab's folder, oldest first.

    A test is a file with modes, response functions or a recording, from which modes are identified.
    They get the numbers of the campaign's own test by their shapes and frequencies. Doubtful files
    are set aside with the reason, and each accepted one updates the model and adds a run to the
    history. Files that were received before are left alone, so a schedule can repeat this.
    """
    from modetune.core.storage.locks import FileLock
    from modetune.flows.studies.receive.lab_files import FOLDER, Inbox

    if not options.lab:
        raise CampaignError("name the lab's folder: modetune receive campaign.yaml lab")
    identification, section = options.identification(), _section(options)
    with FileLock(on.folder / FOLDER / ".lock") as lock:
        if not lock.take():
            raise CampaignRunning(
                f"tests are being received in {on.folder} already; wait for that run"
            )
        inbox = Inbox(on.folder)
        if options.again:
            inbox.forget_aside()
        new, arriving = inbox.new_files(options.lab, options.settle)
        # An update that was killed is repeated.
        waiting = [item for item in inbox.received if item.accepted and not item.updated]
        ended: list[ReceivedFile] = []
        for item in sorted([*waiting, *new], key=lambda item: (item.at, item.file)):
            if not item.accepted:
                on.working(f"reading {near(Path(item.file))}")
                item = _judged(on, section, inbox, item, identification)
                inbox.keep(item)
            if item.accepted:
                item = _updated(on, options, section, inbox, item)
                inbox.keep(item)
            ended.append(item)
    return _result(on, ended, arriving, len(inbox.received))


def _judged(
    on: StudyContext,
    section: TestSection,
    inbox: Inbox,
    item: ReceivedFile,
    identification: IdentificationSettings,
) -> ReceivedFile:
    """Return a new file with the decision, and write the modes of an accepted one."""
    from modetune.flows.studies.receive.lab_test import read_lab_test, write_lab_test

    case = on.campaign.case
    before = _newest_modes(inbox, section, item, case.measurement.modes)
    try:
        test = read_lab_test(Path(item.file), section, before, case.measurement, identification)
    except StorageUnavailable:
        raise
    except ModetuneError as error:
        return replace(item, decision="set aside", reasons=(str(error),))
    tracked, at = test.tracked, test.measurement.measured_at
    found = replace(
        item,
        at=item.at if at != at else at,
        modes=tracked.modes.numbers,
        missing=tracked.missing,
        new_hz=tuple(round(float(hz), 4) for hz in tracked.new_hz),
        notes=test.measurement.notes,
    )
    used = section.use or tuple(set(before.numbers) - set(section.hold_out))
    reasons = list(test.doubts)
    if not set(used) & set(found.modes):
        reasons.append("none of the modes that the campaign uses was found again")
    if reasons:
        return replace(found, decision="set aside", reasons=tuple(reasons))
    write_lab_test(inbox.modes_file(found), test)
    return replace(found, decision="accepted")


def _section(options: ReceiveOptions) -> TestSection:
    from modetune.adapters.yaml_file import read_yaml
    from modetune.flows.campaign.campaign import campaign_form

    source = read_yaml(options.campaign_file, "a campaign")
    return campaign_form(source, options.settings or []).test


def _newest_modes(
    inbox: Inbox, section: TestSection, item: ReceivedFile, own: MeasuredModes | None
) -> MeasuredModes:
    """Return each mode of the campaign's test as the newest accepted test before a file has it.

    Frequencies follow the structure, which may have changed; shapes stay those of the own test,
    whose sensors are the campaign's.
    """
    import numpy as np

    from modetune.adapters.test_files.hdf5 import read_test_hdf5
    from modetune.core.modes import MeasuredModes

    assert own is not None
    frequencies = own.modes.frequencies_hz.copy()
    known: set[int] = set()
    for earlier in reversed(inbox.received):
        if not earlier.accepted or earlier.at > item.at or known >= set(own.numbers):
            continue
        found = read_test_hdf5(inbox.modes_file(earlier)).modes
        assert found is not None
        for number, hz in zip(found.numbers, found.modes.frequencies_hz.tolist(), strict=True):
            if number not in known:
                known.add(number)
                frequencies[own.numbers.index(number)] = hz
    return MeasuredModes(own.numbers, replace(own.modes, frequencies_hz=np.array(frequencies)))


def _updated(
    on: StudyContext,
    options: ReceiveOptions,
    section: TestSection,
    inbox: Inbox,
    item: ReceivedFile,
) -> ReceivedFile:
    """Update with an accepted test.

    A test that the campaign or its model cannot use is reported, and the next one follows. Any
    other failure, such as a solver's, ends the study, and its repetition begins with this test.
    """
    from modetune.core.monitoring.past_runs import utc
    from modetune.flows.updating.forecast import Unwatched

    assert on.run_study is not None
    on.working(f"updating with {near(Path(item.file))}")
    changed: dict[str, Any] = {
        "modes": [str(inbox.modes_file(item).absolute())],
        "repeats": [],
        "measured_at": utc(item.at),
    }
    for key, numbers in (("use", section.use or ()), ("hold_out", section.hold_out)):
        if numbers:
            changed[key] = [number for number in numbers if number in item.modes]
    settings = [f"test.{key}={json.dumps(value)}" for key, value in changed.items()]
    pairs = (f"{n}: {mode}" for n, mode in section.pairs.items() if n in item.modes)
    settings += [f"test.pairs={{{', '.join(pairs)}}}"] * bool(section.pairs)
    given = {
        "campaign_file": options.campaign_file,
        "settings": [*(options.settings or []), *settings],
        "runs": options.runs,
        "fail_on": options.fail_on,
    }
    try:
        end = on.run_study("update", given, Unwatched())
    except CampaignRunning:
        raise
    except (CampaignError, ModesError) as error:
        said = str(error)
        return replace(item, updated=True, exit_code=error.exit_code, state=said, sentence=said)
    return replace(
        item, updated=True, exit_code=end.exit_code, state=end.state, sentence=end.sentence
    )


def _result(
    on: StudyContext, ended: list[ReceivedFile], arriving: list[Path], n_received: int
) -> StudyResult:
    aside = [item for item in ended if not item.accepted]
    counts = [
        f"{len(ended) - len(aside)} new tests" if len(ended) - len(aside) != 1 else "1 new test"
    ]
    counts += [f"{len(aside)} set aside"] * bool(aside)
    counts += [f"{len(arriving)} still arriving"] * bool(arriving)
    status = ", ".join(counts)
    sentence = f"{on.name}: {status}; {n_received} received in all"
    codes = [item.exit_code for item in ended if item.accepted]
    code = (codes[-1] if codes else 0) or 2 * bool(aside)
    lines = [f"{near(path)} still arrives" for path in arriving]
    return StudyResult(
        tuple(ended),
        sentence,
        json_object(
            status="received",
            sentence=sentence,
            exit_code=code,
            tests=[_json(item) for item in ended],
            arriving=[near(path) for path in arriving],
        ),
        [table_of("New tests", [_row(item) for item in ended], ReceivedRow)] if ended else [],
        [*lines, sentence],
        doubts=[f"{near(Path(item.file))}: {'; '.join(item.reasons)}" for item in aside],
        status=status,
        exit_code=code,
    )


def _json(item: ReceivedFile) -> dict[str, Any]:
    from modetune.core.monitoring.past_runs import utc

    names = "digest decision reasons notes modes missing new_hz updated exit_code state sentence"
    return json_object(item, names, file=near(Path(item.file)), at=utc(item.at))


def _row(item: ReceivedFile) -> ReceivedRow:
    from modetune.core.monitoring.past_runs import utc

    modes = ", ".join(map(str, item.modes))
    if item.missing:
        modes += f" (not {', '.join(map(str, item.missing))})"
    said = item.state if item.accepted else "; ".join(item.reasons)
    at = utc(item.at)[:16].replace("T", " ")
    return ReceivedRow(str(near(Path(item.file))), at, item.decision, modes, said)
