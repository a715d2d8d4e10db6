"""The top of a report: the outcome of a campaign in a paragraph, with its main figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.updating.trust import trust_sentences, verdict_reasons
from modetune.core.updating.verdict import TrustVerdict
from modetune.flows.report.mode_tables import (
    ModeRow,
    mode_rows,
    unmatched_modes,
    unmatched_sentence,
)
from modetune.flows.report.parameter_tables import ParameterRow, parameter_rows
from modetune.flows.report.tables import Column, signed

#: What each status means for the model, and its mood.
STATUS = {
    "converged": ("agrees with its test", "good"),
    "max_iterations": ("is closer to its test than before, but does not agree with it yet", "fair"),
    "stationary": ("is as close to its test as these parameters allow", "fair"),
    "running": ("is still being updated", "fair"),
}
#: Added where the model agrees: at the minimum misfit, or where e1 stopped updating before it.
AT_MINIMUM, BEFORE_MINIMUM = ", at the minimum misfit", " (e1), short of the minimum misfit"
#: Number of reasons for a verdict in the first line.
REASONS = 2
#: Replace the status where only some measures of agreement improved, or none.
PARTLY_CLOSER = ("is closer to its test in part only", "fair")
NO_CLOSER = ("is no closer to its test than before", "outside")
#: Smaller changes of MAC are invisible in the three decimals shown.
SAME_MAC = 5e-4


#: The mood of each verdict on the parameters.
MOOD = {
    TrustVerdict.TRUSTED: "good",
    TrustVerdict.RESERVATIONS: "fair",
    TrustVerdict.NOT_TRUSTED: "outside",
    TrustVerdict.NOT_JUDGED: "fair",
}
#: From best to worst; a model has the mood of its worst part.
MOODS = ("good", "fair", "outside")
#: States of a structure that belong in the first line: before them it is only being learned.
SHOWN_STATES = ("steady", "changed")
#: At most this many parameters appear at the top: those that changed most.
SHOWN_PARAMETERS = 6


@dataclass(frozen=True, slots=True)
class Figure:
    """A main figure of the report: name, value, the small print below it, mood ("" for none)."""

    name: str
    value: str
    below: str
    mood: str = ""


@dataclass(frozen=True, slots=True)
class TrustWord:
    """The verdict on the parameters, its mood, the reason, and verdict and reason in a sentence."""

    verdict: str
    mood: str
    why: str
    sentence: str


@dataclass(frozen=True, slots=True)
class Headline:
    """What the top of a report shows.

    line is the result in one line. ending completes "The model of ... "; mood is good, fair or
    outside; text is a paragraph. changed has the parameters that changed most and more_changed
    summarises the others; agrees has the agreement with the test, agreement its mood; cost is a
    sentence.
    """

    line: str
    ending: str
    mood: str
    text: str
    changed: tuple[Figure, ...]
    more_changed: str
    agreement: str
    agrees: tuple[Figure, ...]
    trust: TrustWord
    cost: str


def headline(record: CampaignRecord) -> Headline:
    """Return the top of a record's report; its mood is never better than that of the verdict.

    It is the worst mood where the structure has changed.
    """
    rows, trust = mode_rows(record), _trust(record)
    ending, mood = _ending(record, rows)
    if unmatched_modes(record):
        mood = max(mood, "fair", key=MOODS.index)
    structure = "outside" if record.state == "changed" else "good"
    worst = max(mood, trust.mood, structure, key=MOODS.index)
    changed, more = _changed(record)
    text = f"{_frequencies(rows)}{_shapes(rows)}{_parameters(record)}"
    return Headline(
        first_line(record),
        ending,
        worst,
        " ".join(filter(None, (unmatched_sentence(record), text))),
        changed,
        more,
        "" if mood == "good" != worst else mood,
        _agrees(record, rows),
        trust,
        _cost(record),
    )


def first_line(record: CampaignRecord) -> str:
    """Return what an update found, how well the model agrees, and whether to use the values."""
    rows, verdict = mode_rows(record), record.verdict
    before, after = (
        percent(max(abs(getattr(row, f"error_{when}")) for row in rows), sign=False)
        for when in ("initial", "updated")
    )
    macs = record.best.pairing.judged_mac
    agreement = f"frequencies within {after}"
    agreement += f" ({before} before)" if record.best.number else ""
    agreement += f", MAC at least {macs.min():.3f}" if np.isfinite(macs).all() else ""
    lost = len(unmatched_modes(record))
    agreement += f", {_count(lost, 'measured mode')} without a pair" if lost else ""
    agreement += "" if record.status == "converged" else ", e1 not met"
    reasons = () if record.trust is None else verdict_reasons(record.trust)
    shown, more = list(reasons[:REASONS]), len(reasons) - REASONS
    shown += [_count(more, "more reason")] if more > 0 else []
    why = f" ({'; '.join(shown)})" if shown else ""
    state = f"{record.drift}; " if record.state in SHOWN_STATES else ""
    found = f"{record.name}: {state}{_found(record)}"
    return f"{found}; {agreement}; {verdict}: {verdict.advice}{why}."


def _found(record: CampaignRecord) -> str:
    """The number of parameters that were updated, and the one that changed the most."""
    names = record.parameters.names
    if not record.best.number:
        return "no parameter was changed"
    count = f"{_count(len(names), 'parameter')} updated"
    if any(item.values != "relative" for item in record.parameters.parameters):
        return count  # shares of what may be zero mean nothing
    change = record.updated / record.iterations[0].parameters - 1.0
    most = int(np.argmax(np.abs(change)))
    text = percent(float(change[most]), 1)
    if len(names) == 1:
        return f"{names[0]} changed by {text}"
    return f"{count}, {names[most]} the most ({text})"


def _trust(record: CampaignRecord) -> TrustWord:
    trust = record.trust
    if trust is None:
        why = "Without a sensitivity the parameters have no standard errors."
        return TrustWord("Not assessed", "fair", why, f"The parameters were not assessed: {why}")
    sentence = trust_sentences(trust)[0]
    _, _, why = sentence.partition(": ")
    return TrustWord(trust.verdict.capitalize(), MOOD[trust.verdict], why, sentence)


def _ending(record: CampaignRecord, rows: Sequence[ModeRow]) -> tuple[str, str]:
    if record.status in ("max_iterations", "stationary") and record.best.number > 0:
        improvements = _improvements(rows)
        if not any(change > 0.0 for change in improvements):
            return NO_CLOSER
        if any(change < 0.0 for change in improvements):
            return PARTLY_CLOSER
    ending, mood = STATUS.get(record.status, (f"ended as {record.status}", "fair"))
    if record.status == "converged" and record.trust is not None:
        ending += AT_MINIMUM if record.trust.ended == "least misfit" else BEFORE_MINIMUM
    return ending, mood


def _improvements(rows: Sequence[ModeRow]) -> tuple[float, float, float]:
    """The improvements of worst error, mean error and lowest MAC (zero below SAME_MAC, or NaN)."""
    before = np.abs([row.error_initial for row in rows])
    after = np.abs([row.error_updated for row in rows])
    rise = min(row.mac_updated for row in rows) - min(row.mac_initial for row in rows)
    return (
        float(before.max() - after.max()),
        float(before.mean() - after.mean()),
        rise if abs(rise) >= SAME_MAC else 0.0,
    )


def _frequencies(rows: Sequence[ModeRow]) -> str:
    worst_before = max(rows, key=lambda row: abs(row.error_initial))
    worst_after = max(rows, key=lambda row: abs(row.error_updated))
    means = [
        float(np.mean([abs(getattr(row, f"error_{when}")) for row in rows]))
        for when in ("initial", "updated")
    ]
    modes = f"All {len(rows)} measured modes are" if len(rows) > 1 else "The measured mode is"
    worst, mean, _ = _improvements(rows)
    before = f"{percent(abs(worst_before.error_initial), sign=False)} (mode {worst_before.label})"
    after = f"{percent(abs(worst_after.error_updated), sign=False)} (mode {worst_after.label})"
    return (
        f"{modes} paired. The largest frequency error "
        f"{'fell' if worst > 0.0 else 'did not improve: it went'} from {before} to {after}, the "
        f"mean error {'fell' if mean > 0.0 else 'did not improve: it went'} from "
        f"{percent(means[0], sign=False)} to {percent(means[1], sign=False)}. "
    )


def _shapes(rows: Sequence[ModeRow]) -> str:
    macs = [row.mac_updated for row in rows]
    if not np.isfinite(macs).all():
        return "Without measured shapes, modes were paired by frequency and tracked by shape. "
    least = min(rows, key=lambda row: row.mac_updated)
    before = min(rows, key=lambda row: row.mac_initial)
    if _improvements(rows)[2] < 0.0:
        return (
            f"Mode shapes did not improve: the lowest MAC fell from {before.mac_initial:.3f} "
            f"(mode {before.label}) to {least.mac_updated:.3f} (mode {least.label}). "
        )
    return (
        f"The lowest MAC is {least.mac_updated:.3f} (mode {least.label}; "
        f"{before.mac_initial:.3f} before). "
    )


def _parameters(record: CampaignRecord) -> str:
    change = record.updated / record.iterations[0].parameters - 1.0
    most = int(np.argmax(np.abs(change)))
    on = record.parameters.at_bounds(record.updated)
    bounds = f"on a bound: {', '.join(on)}" if on else "none is on a bound"
    names = record.parameters.names
    if any(item.values != "relative" for item in record.parameters.parameters):
        # An absolute value may start at zero, where a relative change means nothing.
        return f"Updated parameters: {', '.join(names)}; {bounds}."
    if len(names) == 1:
        where = "on a bound" if on else "not on a bound"
        return f"{names[0]} changed by {percent(change[0], 1)} and is {where}."
    return (
        f"Of {len(names)} parameters {names[most]} changed most "
        f"({percent(float(change[most]), 1)}); {bounds}."
    )


def _changed(record: CampaignRecord) -> tuple[tuple[Figure, ...], str]:
    """The parameters that changed most, in the campaign's order, and a sentence on the others."""
    rows = parameter_rows(record)
    sizes = [abs(row.change) if np.isfinite(row.change) else np.inf for row in rows]
    most = sorted(np.argsort(sizes, kind="stable")[::-1][:SHOWN_PARAMETERS].tolist())
    shown = tuple(
        Figure(
            row.name,
            percent(row.change, 1) if np.isfinite(row.change) else number(row.updated_value),
            " ".join(
                filter(
                    None,
                    (
                        f"{_start(row)} \N{RIGHTWARDS ARROW} {number(row.updated_value, '.6g')}",
                        row.unit,
                        "(on a bound)" if row.on_bound else "",
                    ),
                )
            ),
            "outside" if row.on_bound else "",
        )
        for row in (rows[place] for place in most)
    )
    rest = len(rows) - len(shown)
    largest = max((sizes[place] for place in range(len(rows)) if place not in most), default=0.0)
    more = f"{_count(rest, 'more parameter')} changed by at most {percent(largest, 1, sign=False)}."
    return shown, more if rest else ""


def _start(row: ParameterRow) -> str:
    return number(row.initial * (row.deck_value if row.values == "relative" else 1.0), ".6g")


def _agrees(record: CampaignRecord, rows: Sequence[ModeRow]) -> tuple[Figure, ...]:
    first, last = record.iterations[0], record.best
    before, after = (
        float(np.mean([abs(getattr(row, f"error_{when}")) for row in rows]))
        for when in ("initial", "updated")
    )
    figures = [
        Figure(
            "Largest frequency error",
            percent(last.worst_error, sign=False),
            f"before {percent(first.worst_error, sign=False)}",
            "outside" if last.worst_error > record.e1_frequency else "",
        ),
        Figure(
            "Mean frequency error",
            percent(after, sign=False),
            f"before {percent(before, sign=False)}",
        ),
    ]
    if record.test.has_shapes:
        was, least = (
            min(getattr(row, f"mac_{when}") for row in rows) for when in ("initial", "updated")
        )
        figures.append(
            Figure(
                "Lowest MAC",
                number(least, ".3f"),
                f"before {number(was, '.3f')}",
                "outside" if least < record.e1_mac else "",
            )
        )
    else:
        lost = len(unmatched_modes(record))
        all_modes = f"of {_count(len(rows) + lost, 'measured mode')}"
        figures.append(Figure("Paired modes", str(len(rows)), all_modes, "outside" * bool(lost)))
    return tuple(figures)


def _cost(record: CampaignRecord) -> str:
    runs = record.runs
    cached = f" ({runs.reused} more cached)" if runs.reused else ""
    return (
        f"{_count(record.best.number, 'iteration')}, "
        f"{_count(runs.modal + runs.sensitivity, 'solver run')}{cached}, "
        f"{number(runs.core_s / 60.0, '.2g')} core-minutes."
    )


def percent(share: float, decimals: int = 2, sign: bool = True) -> str:
    """Return a relative value in percent; one that rounds to zero has no sign."""
    text = Column("", "%", f"{'+' if sign else ''}.{decimals}f").shown(share)
    return signed(text) if text == "-" else f"{signed(text)} %"


def number(value: float, form: str = ".4g") -> str:
    return signed(Column("", form=form).shown(value))


def _count(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 else 's'}"
