"""Tables of measured modes and their partners before and after updating, and in one iteration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from modetune.core.correlation.holdout import HeldOut
from modetune.core.modes import mode_name
from modetune.core.storage.campaign_record import CampaignRecord, IterationRecord
from modetune.flows.report.tables import Column, Table, columns_of, table_of


@dataclass(frozen=True, slots=True)
class ModeRow:
    """A measured mode and its partner before and after; errors are relative, a MAC may be NaN.

    label follows the word "mode"; elastic_mode is the model's, from 1; frequency_weight and
    frequency_deviation are those of the measured frequency, weight 0 leaves it out.
    """

    mode: int
    configuration: str | None
    label: Annotated[str, Column("test mode")]
    test_hz: Annotated[float, Column("test", "Hz")]
    initial_hz: Annotated[float, Column("before", "Hz")]
    error_initial: Annotated[float, Column("error before", "%", "+.2f")]
    updated_hz: Annotated[float, Column("after", "Hz")]
    error_updated: Annotated[float, Column("error after", "%", "+.2f")]
    mac_initial: Annotated[float, Column("MAC before", form=".3f")]
    mac_updated: Annotated[float, Column("MAC after", form=".3f")]
    elastic_mode_initial: int
    elastic_mode: Annotated[int, Column("model's elastic mode")]
    pairing: str
    frequency_weight: Annotated[float, Column("weight", form="g")]
    frequency_deviation: Annotated[float, Column("deviation", "%", ".3g")]


@dataclass(frozen=True, slots=True)
class PairRow:
    """A measured mode and its partner in one iteration; subspace_mac includes close modes."""

    label: Annotated[str, Column("test mode")]
    elastic_mode: Annotated[int, Column("elastic mode")]
    test_hz: Annotated[float, Column("test", "Hz")]
    computed_hz: Annotated[float, Column("model", "Hz")]
    error: Annotated[float, Column("error", "%", "+.2f")]
    mac: Annotated[float, Column("MAC", form=".3f")]
    subspace_mac: Annotated[float, Column("MAC with close modes", form=".3f")]
    reason: Annotated[str, Column("reason")]


def mode_label(record: CampaignRecord, place: int) -> str:
    """Return the label of a test mode, which follows the word "mode": 3, or 3 of fuelled."""
    of = record.configurations[place] if record.configurations else ""
    return mode_name(record.test.numbers[place], of).removeprefix("mode ")


def mode_labels(record: CampaignRecord) -> list[str]:
    """Return the labels of all test modes, in the test's order."""
    return [mode_label(record, place) for place in range(len(record.test.numbers))]


def unmatched_modes(record: CampaignRecord) -> tuple[int, ...]:
    """Return the positions of test modes without a partner."""
    paired = record.iterations[0].pairing.measured
    return tuple(np.setdiff1d(np.arange(len(record.test.numbers)), paired).tolist())


def unmatched_sentence(record: CampaignRecord) -> str:
    """Return a sentence on test modes without a partner, "" if there are none."""
    names = [mode_label(record, place) for place in unmatched_modes(record)]
    if not names:
        return ""
    text = "mode " + names[0] if len(names) == 1 else "modes " + ", ".join(names)
    return f"No computed mode is paired with {text} of the test, so updating left it out."


def mode_rows(record: CampaignRecord) -> tuple[ModeRow, ...]:
    """Return a row for each paired mode, in the order of the pairs."""
    first, last, rows = record.iterations[0], record.best, []
    variances = first.residual.variances  # of eigenvalues: twice the frequency's deviation
    for pair, measured in enumerate(first.pairing.measured.tolist()):
        before, after = int(first.pairing.computed[pair]), int(last.pairing.computed[pair])
        rows.append(
            ModeRow(
                mode=record.test.numbers[measured],
                configuration=record.configurations[measured] if record.configurations else None,
                label=mode_label(record, measured),
                test_hz=float(record.test.modes.frequencies_hz[measured]),
                initial_hz=float(first.computed.frequencies_hz[before]),
                error_initial=float(first.frequency_errors[pair]),
                updated_hz=float(last.computed.frequencies_hz[after]),
                error_updated=float(last.frequency_errors[pair]),
                mac_initial=float(first.pairing.mac[pair]),
                mac_updated=float(last.pairing.mac[pair]),
                elastic_mode_initial=before + 1,
                elastic_mode=after + 1,
                pairing=last.pairing.reasons[pair],
                frequency_weight=float(first.residual.weights[pair] * variances[pair]),
                frequency_deviation=0.5 * float(np.sqrt(variances[pair])),
            )
        )
    return tuple(rows)


def mode_table(record: CampaignRecord) -> Table:
    """Return frequencies, errors and MAC before and after; values that violate e1 are marked.

    Weights and deviations appear if they differ, MAC if shapes were measured.
    """
    rows = mode_rows(record)
    alike = [
        name
        for name in ("frequency_weight", "frequency_deviation")
        if np.ptp([getattr(row, name) for row in rows]) <= 1e-9 * getattr(rows[0], name)
    ]
    if all(np.isnan(row.mac_updated) for row in rows):
        alike += ["mac_initial", "mac_updated"]
    columns = [column for column in columns_of(ModeRow) if column.name not in alike]
    outside = [
        (place, "error_updated")
        for place, row in enumerate(rows)
        if row.frequency_weight > 0.0 and abs(row.error_updated) > record.e1_frequency
    ]
    outside += [
        (place, "mac_updated") for place, row in enumerate(rows) if row.mac_updated < record.e1_mac
    ]
    means = [
        f"{100 * np.mean([abs(getattr(row, name)) for row in rows]):.2f}"
        for name in ("error_initial", "error_updated")
    ]
    foot = ("mean |error|", "", "", means[0], "", means[1], *[""] * (len(columns) - 6))
    return table_of("Modes", rows, columns, foot=[foot], outside=outside)


def pair_table(record: CampaignRecord, item: IterationRecord) -> Table:
    """Return the pairs of an iteration with their reasons."""
    pairing = item.pairing
    rows = [
        PairRow(
            label=mode_label(record, measured),
            elastic_mode=computed + 1,
            test_hz=float(record.test.modes.frequencies_hz[measured]),
            computed_hz=float(item.computed.frequencies_hz[computed]),
            error=float(item.frequency_errors[pair]),
            mac=float(pairing.mac[pair]),
            subspace_mac=float(pairing.subspace_mac[pair]),
            reason=pairing.reasons[pair],
        )
        for pair, (measured, computed) in enumerate(
            zip(pairing.measured.tolist(), pairing.computed.tolist(), strict=True)
        )
    ]
    kept = "" if item.accepted else " (not kept)"
    title = f"Iteration {item.number}{kept}: largest error {100 * item.worst_error:.2f} %"
    return table_of(title, rows, PairRow)


@dataclass(frozen=True, slots=True)
class HeldOutRow:
    """A held-out mode before and after; NaN if it has no partner."""

    test: int
    configuration: str | None
    label: Annotated[str, Column("test")]
    test_hz: Annotated[float, Column("test", "Hz")]
    initial_hz: Annotated[float, Column("before", "Hz")]
    error_initial: Annotated[float, Column("error before", "%", "+.2f")]
    updated_hz: Annotated[float, Column("after", "Hz")]
    error_updated: Annotated[float, Column("error after", "%", "+.2f")]
    mac_initial: Annotated[float, Column("MAC before", form=".3f")]
    mac_updated: Annotated[float, Column("MAC after", form=".3f")]
    worse: Annotated[bool, Column("got worse")]


def held_out_rows(held: HeldOut | None) -> tuple[HeldOutRow, ...]:
    """Return a row for each held-out mode."""
    if held is None:
        return ()
    return tuple(
        HeldOutRow(
            test=number,
            configuration=held.configurations[mode] if held.configurations else None,
            label=held.names[mode],
            test_hz=float(held.test_hz[mode]),
            initial_hz=float(held.initial_hz[mode]),
            error_initial=float(held.error_initial[mode]),
            updated_hz=float(held.updated_hz[mode]),
            error_updated=float(held.error_updated[mode]),
            mac_initial=float(held.mac_initial[mode]),
            mac_updated=float(held.mac_updated[mode]),
            worse=bool(held.worse[mode]),
        )
        for mode, number in enumerate(held.numbers.tolist())
    )


def held_out_table(held: HeldOut | None) -> Table:
    """Return the held-out modes before and after; those that got worse are marked."""
    rows = held_out_rows(held)
    worse = [(place, "") for place, row in enumerate(rows) if row.worse]
    return table_of("Held out: not used for updating", rows, HeldOutRow, outside=worse)


def held_out_lines(held: HeldOut | None) -> list[str]:
    """Return a sentence for each held-out mode that got worse."""
    return (
        []
        if held is None
        else [
            f"{name}, held out, got worse: it {held.reason(mode)}"
            for mode, name in enumerate(held.names)
            if held.worse[mode]
        ]
    )
