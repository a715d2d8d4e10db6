"""How a campaign ended, in a paragraph for people, with the main figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.updating.trust import trust_sentences
from modetune.flows.report.mode_tables import (
    ModeRow,
    mode_rows,
    unmatched_modes,
    unmatched_sentence,
)
from modetune.flows.report.parameter_tables import ParameterRow, parameter_rows
from modetune.flows.report.tables import Column, signed

#: How a campaign's end reads.
STATUS = {
    "converged": ("agrees with its test", "good"),
    "max_iterations": ("came nearer to its test, but does not agree with it yet", "fair"),
    "stationary": ("was brought as near to its test as these parameters can", "fair"),
    "running": ("is still being updated", "fair"),
}
#: ... and which end that is where e1 is met.
LEAST, ENOUGH = ", at the least misfit", " well enough (e1), short of the least misfit"
#: ... where it is in some, or in no respect nearer to its test than before.
IN_PART = ("came nearer to its test in part only", "fair")
NO_NEARER = ("did not come nearer to its test", "outside")
#: A MAC that changes by less is as before: shown digits.
SAME_MAC = 5e-4


#: How each verdict on the parameters looks.
MOOD = {"trusted": "good", "trusted with reservations": "fair", "not to be trusted": "outside"}
#: From the best to the worst; a model as a whole has the mood of its worst part.
MOODS = ("good", "fair", "outside")
#: Parameters that are shown at the top, those that changed the most.
SHOWN_PARAMETERS = 6


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure that is looked for first: its name, what it is, how it looks, what stands below."""

    name: str
    value: str
    below: str
    mood: str = ""


@dataclass(frozen=True, slots=True)
class TrustWord:
    """How far the answer can be trusted: in a word, why, and both in a sentence."""

    verdict: str
    mood: str
    why: str
    sentence: str


@dataclass(frozen=True, slots=True)
class Headline:
    """ending: what became of the model, with its mood (good, fair, outside); text: in sentences.

    changed, agrees, trust: what changed, how well it agrees now (agreement: its mood), how far to
    trust it; more_changed: parameters that are not among those shown; cost: of all that.
    """

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
    """The top of a report; a model with a doubt is never good."""
    rows, trust = mode_rows(record), _trust(record)
    ending, mood = _ending(record, rows)
    if unmatched_modes(record):
        mood = max(mood, "fair", key=MOODS.index)
    if record.trust is not None and trust.mood != "good":
        ending += f"; its parameters are {record.trust.verdict}"
    worst = max(mood, trust.mood, key=MOODS.index)
    changed, more = _changed(record)
    text = f"{_frequencies(rows)}{_shapes(rows)}{_parameters(record)}"
    return Headline(
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


def _trust(record: CampaignRecord) -> TrustWord:
    trust = record.trust
    if trust is None:
        why = "No sensitivity was computed, so nothing tells how well the parameters are known."
        return TrustWord("Not judged", "fair", why, f"How far to trust it was not judged: {why}")
    sentence = trust_sentences(trust)[0]
    _, _, why = sentence.partition(": ")
    return TrustWord(trust.verdict.capitalize(), MOOD[trust.verdict], why, sentence)


def _ending(record: CampaignRecord, rows: Sequence[ModeRow]) -> tuple[str, str]:
    """How the campaign's end reads, and its mood."""
    if record.status in ("max_iterations", "stationary") and record.best.number > 0:
        nearer = _changes(rows)
        if not any(change > 0.0 for change in nearer):
            return NO_NEARER
        if any(change < 0.0 for change in nearer):
            return IN_PART
    ending, mood = STATUS.get(record.status, (f"ended as {record.status}", "fair"))
    if record.status == "converged" and record.trust is not None:
        ending += LEAST if record.trust.ended == "least misfit" else ENOUGH
    return ending, mood


def _changes(rows: Sequence[ModeRow]) -> tuple[float, float, float]:
    """By how much worst error, mean error and least MAC are better than before.

    The MAC's is zero where it is as before, or unknown.
    """
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
    modes = f"all {len(rows)} measured modes were" if len(rows) > 1 else "the measured mode was"
    worst, mean, _ = _changes(rows)
    before = f"{percent(abs(worst_before.error_initial), sign=False)} (mode {worst_before.label})"
    after = f"{percent(abs(worst_after.error_updated), sign=False)} (mode {worst_after.label})"
    largest = (
        f"frequencies that were off by up to {before} are now within {after}"
        if worst > 0.0
        else f"the largest frequency error did not improve: {before} before, {after} now"
    )
    return (
        f"{modes.capitalize()} found in it; {largest}; the mean error "
        f"{'fell' if mean > 0.0 else 'did not improve: it went'} from "
        f"{percent(means[0], sign=False)} to {percent(means[1], sign=False)}. "
    )


def _shapes(rows: Sequence[ModeRow]) -> str:
    macs = [row.mac_updated for row in rows]
    if not np.isfinite(macs).all():
        return "No shapes were measured, so modes were paired by frequency and tracked by shape. "
    least = min(rows, key=lambda row: row.mac_updated)
    before = min(rows, key=lambda row: row.mac_initial)
    if _changes(rows)[2] < 0.0:
        return (
            f"Mode shapes did not improve: the least MAC fell from {before.mac_initial:.3f} "
            f"(mode {before.label}) to {least.mac_updated:.3f} (mode {least.label}). "
        )
    return (
        f"Mode shapes agree with a MAC of at least {least.mac_updated:.3f} (mode {least.label}; "
        f"{before.mac_initial:.3f} before). "
    )


def _parameters(record: CampaignRecord) -> str:
    change = record.updated / record.iterations[0].parameters - 1.0
    most = int(np.argmax(np.abs(change)))
    on = record.parameters.at_bounds(record.updated)
    bounds = "none stands on a bound" if not on else f"{', '.join(on)} on a bound"
    names = record.parameters.names
    if any(item.values != "relative" for item in record.parameters.parameters):
        return f"{', '.join(names)} updated; {bounds}."  # shares of what may be zero say nothing
    if len(names) == 1:
        return f"{names[0]} was changed by {percent(change[0], 1)}, {bounds}."
    return (
        f"{len(names)} parameters were updated, {names[most]} the most "
        f"({percent(float(change[most]), 1)}); {bounds}."
    )


def _changed(record: CampaignRecord) -> tuple[tuple[Figure, ...], str]:
    """The parameters that changed the most, in the campaign's order, and what is said of others."""
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
    """The number of the deck that a campaign began with."""
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
                "Least MAC",
                number(least, ".3f"),
                f"before {number(was, '.3f')}",
                "outside" if least < record.e1_mac else "",
            )
        )
    return tuple(figures)


def _cost(record: CampaignRecord) -> str:
    """Iterations, solver runs and time."""
    runs = record.runs
    stored = f", {runs.reused} more answered by the store" if runs.reused else ""
    return (
        f"It took {_count(record.best.number, 'iteration')}, "
        f"{_count(runs.modal + runs.sensitivity, 'solver run')}{stored}, "
        f"{number(runs.core_s / 60.0, '.2g')} core-minutes."
    )


def percent(share: float, decimals: int = 2, sign: bool = True) -> str:
    """A share in percent; what rounds to nothing has no sign."""
    text = Column("", "%", f"{'+' if sign else ''}.{decimals}f").shown(share)
    return signed(text) if text == "-" else f"{signed(text)} %"


def number(value: float, form: str = ".4g") -> str:
    return signed(Column("", form=form).shown(value))


def _count(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 else 's'}"
