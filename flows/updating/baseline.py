"""Comparison of a model's agreement with its test to that of a baseline, within a band.

A baseline is the record of an updating campaign (campaign.h5), with the frequency error and the MAC
of each mode of the test. A checked model leaves the band in a mode if its frequency error exceeds
the baseline's by more than `frequency`, or its MAC is lower by more than `mac`. A model that agrees
better than the baseline never leaves the band.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np

from modetune.core.correlation.pairing import LostMode
from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, Integers, MeasuredModes, mode_name
from modetune.core.storage.campaign_record import RunCounts, read_record
from modetune.core.updating.verdict import TrustVerdict
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.report.tables import Column
from modetune.flows.updating.evaluation import Evaluation
from modetune.flows.updating.evaluator import evaluator_of

#: Model of a record: updated or initial.
State = Literal["updated", "initial"]
#: A mode of a test: its configuration (empty if there is one model) and its number.
Mode = tuple[str, int]


@dataclass(frozen=True, slots=True)
class Band:
    """Permitted deterioration of a mode, in relative frequency error and in MAC."""

    frequency: float
    mac: float


@dataclass(frozen=True, slots=True)
class Agreement:
    """The agreement of a model with its test.

    modes: the test's, configuration and number; test_hz: (n_modes,); errors: (n_modes,), relative
    frequency errors; macs: (n_modes,), the higher of MAC and cluster MAC, NaN if no shape was
    measured; verdict: on the update that produced the model.
    """

    modes: tuple[Mode, ...]
    test_hz: Floats
    errors: Floats
    macs: Floats
    verdict: TrustVerdict


@dataclass(frozen=True, slots=True)
class ModeCheck:
    """A mode's errors and the baseline's; reasons: why it left the band, empty within it."""

    mode: int
    configuration: str | None
    label: Annotated[str, Column("mode")]
    test_hz: Annotated[float, Column("test", "Hz")]
    error: Annotated[float, Column("error", "%", "+.2f")]
    baseline_error: Annotated[float, Column("error of the baseline", "%", "+.2f")]
    mac: Annotated[float, Column("MAC", form=".3f")]
    baseline_mac: Annotated[float, Column("MAC of the baseline", form=".3f")]
    within: Annotated[bool, Column("within the band")]
    reasons: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class BaselineCheck:
    """The result of a check.

    reason: empty if all modes are within the band. runs: solver runs of the check. verdict: on the
    updated parameters, from the checked record, or else from the baseline.
    """

    modes: tuple[ModeCheck, ...]
    reason: str
    remarks: tuple[str, ...]
    runs: RunCounts
    verdict: TrustVerdict

    @property
    def within(self) -> bool:
        return not self.reason


def read_agreement(path: Path, state: State) -> Agreement:
    """Return the agreement of a record's model with its test. Raises CampaignError."""
    record = read_record(path)
    accepted = [item for item in record.iterations if item.accepted]
    chosen = accepted[-1] if state == "updated" else accepted[0]
    measured = chosen.pairing.measured
    return Agreement(
        modes=_modes(record.test, record.configurations, measured),
        test_hz=record.test.modes.frequencies_hz[measured],
        errors=chosen.frequency_errors,
        macs=chosen.pairing.judged_mac,
        verdict=record.verdict,
    )


def check_deck(campaign: Campaign, path: Path, state: State, band: Band) -> BaselineCheck:
    """Compare the model at the deck's values with a baseline: one modal run, unless it is cached.

    Raises CampaignError if the baseline has other modes; SolverError, StoreError.
    """
    baseline = _fitting(campaign, path, state)
    engine = job_engine(campaign)
    own = replace(
        campaign, cases=tuple(replace(item, eigensolver="solver") for item in campaign.cases)
    )  # a baseline has the solver's own modes
    evaluator = evaluator_of(own, engine)
    theta = np.ones(len(campaign.parameters))
    try:
        evaluation, _ = evaluator.evaluate("deck's values", theta, None, alone=True)
    except LostMode as error:
        lost = f"a mode is lost: {error}"
        return BaselineCheck((), lost, (), evaluator.runs, baseline.verdict)
    now = _agreement(campaign, evaluation, baseline.verdict)
    found = _compared(now, baseline, band, evaluator.runs)
    return found if found.within else _hinted(found, path, state, band)


def check_record(
    campaign: Campaign, record: Path, path: Path, state: State, band: Band
) -> BaselineCheck:
    """Compare the updated model of another record with a baseline, without a run.

    Raises CampaignError if a record cannot be read or has other modes.
    """
    baseline, now = _fitting(campaign, path, state), read_agreement(record, "updated")
    if set(now.modes) != set(baseline.modes):
        raise CampaignError(_other_modes(path, baseline, record, now.modes))
    return _compared(now, baseline, band, RunCounts())


def _fitting(campaign: Campaign, path: Path, state: State) -> Agreement:
    """Return the baseline. Raises CampaignError if its modes are not the campaign's."""
    baseline = read_agreement(path, state)
    test = campaign.test
    every = _modes(test, campaign.configurations, np.arange(len(test.numbers)))
    if set(baseline.modes) != set(every):
        raise CampaignError(_other_modes(path, baseline, campaign.file, every))
    return baseline


def _modes(
    test: MeasuredModes, configurations: tuple[str, ...], places: Integers
) -> tuple[Mode, ...]:
    """Return the test's modes at these positions."""
    of = configurations or ("",) * len(test.numbers)
    return tuple((of[place], test.numbers[place]) for place in places.tolist())


def _label(mode: Mode) -> str:
    """Return the name of a mode, to follow the word "mode"."""
    return mode_name(mode[1], mode[0]).removeprefix("mode ")


def _other_modes(path: Path, baseline: Agreement, other: Path, modes: tuple[Mode, ...]) -> str:
    before, now = (", ".join(map(_label, sorted(item))) for item in (baseline.modes, modes))
    return (
        f"{path} is a baseline of test modes {before}, but {other} has modes {now}; make a new "
        "baseline with `modetune update`"
    )


def _agreement(campaign: Campaign, evaluation: Evaluation, verdict: TrustVerdict) -> Agreement:
    measured = evaluation.pairing.measured
    return Agreement(
        modes=_modes(campaign.test, campaign.configurations, measured),
        test_hz=campaign.test.modes.frequencies_hz[measured],
        errors=evaluation.errors,
        macs=evaluation.pairing.judged_mac,
        verdict=verdict,
    )


def _compared(now: Agreement, before: Agreement, band: Band, runs: RunCounts) -> BaselineCheck:
    places = {mode: place for place, mode in enumerate(before.modes)}
    modes = []
    for place, mode in sorted(enumerate(now.modes), key=lambda item: item[1]):
        then = places[mode]
        modes.append(
            _mode(
                mode,
                float(now.test_hz[place]),
                (float(now.errors[place]), float(before.errors[then])),
                (float(now.macs[place]), float(before.macs[then])),
                band,
            )
        )
    left = [mode for mode in modes if not mode.within]
    reason = "; ".join(f"mode {mode.label}: {', '.join(mode.reasons)}" for mode in left)
    then_hz = np.array([before.test_hz[places[mode]] for mode in now.modes])
    remarks = (
        ()
        if np.array_equal(then_hz, now.test_hz)
        else (
            "the test's frequencies are not those of the baseline: errors are each of its own test",
        )
    )
    return BaselineCheck(tuple(modes), reason, remarks, runs, now.verdict)


def _mode(
    mode: Mode, test_hz: float, errors: tuple[float, float], macs: tuple[float, float], band: Band
) -> ModeCheck:
    """errors, macs: now and in the baseline."""
    reasons = []
    if abs(errors[0]) > abs(errors[1]) + band.frequency:
        reasons.append(
            f"frequency error {100 * errors[0]:+.2f} %, baseline {100 * errors[1]:+.2f} %, band "
            f"{100 * band.frequency:g} %"
        )
    if macs[0] < macs[1] - band.mac:
        reasons.append(f"MAC {macs[0]:.3f}, baseline {macs[1]:.3f}, band {band.mac:g}")
    if np.isnan(macs[0]) and not np.isnan(macs[1]):
        reasons.append("no MAC, because the test no longer has shapes")
    return ModeCheck(
        mode[1], mode[0] or None, _label(mode), test_hz, *errors, *macs, not reasons, tuple(reasons)
    )


def _hinted(found: BaselineCheck, path: Path, state: State, band: Band) -> BaselineCheck:
    """Add a remark if the deck seems to be compared with the wrong model of the baseline."""
    if state == "initial":
        return found
    earlier = read_agreement(path, "initial")
    initial = dict(zip(map(_label, earlier.modes), np.abs(earlier.errors).tolist(), strict=True))
    if any(abs(mode.error) > initial[mode.label] + band.frequency for mode in found.modes):
        return found
    remark = (
        "the deck is as near to its test as the model that the baseline's campaign started from: "
        "is it the deck before updating? Then compare with --state initial"
    )
    return replace(found, remarks=(*found.remarks, remark))
