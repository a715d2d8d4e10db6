"""What the report says in words and tables of how model and test agree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modetune.core.record import CampaignRecord, IterationRecord
from modetune.flows.report.comparison import ModeRow, mode_label, mode_rows, remarks
from modetune.flows.report.deck_units import unit_of
from modetune.flows.report.markup import (
    Html,
    bullets,
    element,
    folded,
    hertz,
    joined,
    number,
    paragraph,
    percent,
    table,
)

#: How a campaign's end reads.
STATUS = {
    "converged": ("agrees with its test", "good"),
    "max_iterations": ("came nearer to its test, but does not agree with it yet", "fair"),
    "stationary": ("was brought as near to its test as these parameters can", "fair"),
    "running": ("is still being updated", "fair"),
}
#: ... where it is in some, or in no respect nearer to its test than before.
IN_PART = ("came nearer to its test in part only", "fair")
NO_NEARER = ("did not come nearer to its test", "outside")
#: A MAC that changes by less is as before: shown digits.
SAME_MAC = 5e-4


def headline(record: CampaignRecord) -> Html:
    """One paragraph that a person understands, and the figures beside it."""
    rows, kept = mode_rows(record), record.best
    said, mood = _ending(record, rows)
    paragraphs = paragraph(
        joined([
            "The model of ", element("strong", record.name), " ", element("strong", said, mood),
            ". ", _frequencies(rows), _shapes(rows), _parameters(record),
            f" It took {_count(kept.number, 'iteration')} and "
            f"{_count(record.runs.modal + record.runs.sensitivity, 'solver run')}"
            + (f" ({record.runs.reused} more were answered by the store)." if record.runs.reused
               else "."),
        ]),
        "lead",
    )  # fmt: skip
    reason = paragraph(f"How it ended: {record.reason}.", "note") if record.reason else Html("")
    return paragraphs + _tiles(record, rows) + reason


def _ending(record: CampaignRecord, rows: Sequence[ModeRow]) -> tuple[str, str]:
    """How the campaign's end reads, and its mood."""
    if record.status in ("max_iterations", "stationary") and record.best.number > 0:
        nearer = _changes(rows)
        if not any(change > 0.0 for change in nearer):
            return NO_NEARER
        if any(change < 0.0 for change in nearer):
            return IN_PART
    return STATUS.get(record.status, (f"ended as {record.status}", "fair"))


def _changes(rows: Sequence[ModeRow]) -> tuple[float, float, float]:
    """By how much worst error, mean error and least MAC are better than before.

    The MAC's is zero where it is as before, or unknown.
    """
    before = np.abs([row.error_before for row in rows])
    after = np.abs([row.error_after for row in rows])
    rise = min(row.mac_after for row in rows) - min(row.mac_before for row in rows)
    return (
        float(before.max() - after.max()),
        float(before.mean() - after.mean()),
        rise if abs(rise) >= SAME_MAC else 0.0,
    )


def _frequencies(rows: Sequence[ModeRow]) -> str:
    worst_before = max(rows, key=lambda row: abs(row.error_before))
    worst_after = max(rows, key=lambda row: abs(row.error_after))
    means = [float(np.mean([abs(getattr(row, f"error_{when}")) for row in rows]))
             for when in ("before", "after")]  # fmt: skip
    modes = f"all {len(rows)} measured modes were" if len(rows) > 1 else "the measured mode was"
    worst, mean, _ = _changes(rows)
    before = f"{percent(abs(worst_before.error_before), sign=False)} (mode {worst_before.label})"
    after = f"{percent(abs(worst_after.error_after), sign=False)} (mode {worst_after.label})"
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
    macs = [row.mac_after for row in rows]
    if not np.isfinite(macs).all():
        return "No shapes were measured, so modes were paired by frequency and tracked by shape. "
    least = min(rows, key=lambda row: row.mac_after)
    before = min(rows, key=lambda row: row.mac_before)
    if _changes(rows)[2] < 0.0:
        return (
            f"Mode shapes did not improve: the least MAC fell from {before.mac_before:.3f} "
            f"(mode {before.label}) to {least.mac_after:.3f} (mode {least.label}). "
        )
    return (
        f"Mode shapes agree with a MAC of at least {least.mac_after:.3f} (mode {least.label}; "
        f"{before.mac_before:.3f} before). "
    )


def _parameters(record: CampaignRecord) -> str:
    change = record.updated / record.iterations[0].parameters - 1.0
    most = int(np.argmax(np.abs(change)))
    on = record.parameters.at_bounds(record.updated)
    bounds = "none stands on a bound" if not on else f"{', '.join(on)} on a bound"
    names = record.parameters.names
    if len(names) == 1:
        return f"{names[0]} was changed by {percent(change[0], 1)}, {bounds}."
    return (
        f"{len(names)} parameters were updated, {names[most]} the most "
        f"({percent(float(change[most]), 1)}); {bounds}."
    )


def _tiles(record: CampaignRecord, rows: Sequence[ModeRow]) -> Html:
    """The figures that are looked for first."""
    means = [np.mean([abs(row.error_before) for row in rows]),
             np.mean([abs(row.error_after) for row in rows])]  # fmt: skip
    least = [min(row.mac_before for row in rows), min(row.mac_after for row in rows)]
    tiles = [
        ("largest frequency error", percent(record.best.worst_error, sign=False),
         f"before {percent(record.iterations[0].worst_error, sign=False)}"),
        ("mean frequency error", percent(float(means[1]), sign=False),
         f"before {percent(float(means[0]), sign=False)}"),
        ("least MAC", number(least[1], ".3f"), f"before {number(least[0], '.3f')}"),
        ("solver runs", str(record.runs.modal + record.runs.sensitivity),
         f"{number(record.runs.core_s / 60.0, '.2g')} core-minutes"),
    ]  # fmt: skip
    return element(
        "div",
        joined([
            element("div", joined([element("span", name, "name"), element("span", value, "value"),
                                   element("span", below, "below")]), "tile")
            for name, value, below in tiles
        ]),
        "tiles",
    )  # fmt: skip


def points_to_look_at(record: CampaignRecord) -> Html:
    found = remarks(record)
    if not found:
        return paragraph("Nothing stands out: no parameter on a bound, none in doubt.", "note")
    return bullets(found, "remarks")


def modes_table(record: CampaignRecord) -> Html:
    """Frequencies, errors and MAC before and after."""
    rows = mode_rows(record)
    lines: list[list[Html | str]] = [
        [
            row.label, hertz(row.test_hz), hertz(row.before_hz), percent(row.error_before),
            hertz(row.after_hz), _judged(row.error_after, record), number(row.mac_before, ".3f"),
            _judged_mac(row.mac_after, record), str(row.partner_after),
        ]
        for row in rows
    ]  # fmt: skip
    lines.append(
        [element("strong", "mean |error|"), "", "",
         percent(float(np.mean([abs(row.error_before) for row in rows])), sign=False), "",
         percent(float(np.mean([abs(row.error_after) for row in rows])), sign=False), "", "", ""]
    )  # fmt: skip
    headings = ("test mode", "test, Hz", "before, Hz", "error", "after, Hz", "error", "MAC before",
                "MAC after", "model's elastic mode")  # fmt: skip
    return table(headings, lines)


def _judged(error: float, record: CampaignRecord) -> Html | str:
    return _marked(percent(error), abs(error) > record.e1_frequency)


def _judged_mac(mac: float, record: CampaignRecord) -> Html | str:
    return _marked(number(mac, ".3f"), mac < record.e1_mac)


def _marked(shown: str, outside: bool) -> Html | str:
    return element("span", shown, "outside") if outside else shown


def tolerance_note(record: CampaignRecord) -> Html:
    if not np.isfinite(record.e1_frequency):
        return Html("")
    mac = "" if not record.test.has_shapes else f" and a MAC of at least {record.e1_mac:g}"
    return paragraph(
        f"The campaign asks for frequencies within {percent(record.e1_frequency, 3, sign=False)}"
        f"{mac} (e1); what is outside is marked.", "note",
    )  # fmt: skip


def parameters_table(record: CampaignRecord) -> Html:
    """Values, bounds and standard errors."""
    at_bounds, lines = record.parameters.at_bounds(record.updated), []
    for place, item in enumerate(record.parameters.parameters):
        updated, start = float(record.updated[place]), float(record.iterations[0].parameters[place])
        error = float(record.standard_errors[place])
        bounds = f"{item.lower:g} … {item.upper:g}"
        unit = unit_of(record.units, item.quantity)
        lines.append([
            item.name,
            " of ".join([_words(item.quantity), *([", ".join(item.targets)] * bool(item.targets))]),
            f"{number(float(record.deck_values[place]), '.6g')} {unit}".rstrip(),
            f"{number(float(record.deck_values[place]) * updated, '.6g')} {unit}".rstrip(),
            number(start, ".4f"), number(updated, ".4f"), percent(updated / start - 1.0, 1),
            "not known" if not np.isfinite(error) else f"±{percent(error, sign=False)}",
            element("span", f"{bounds} (on it)", "outside") if item.name in at_bounds else bounds,
        ])  # fmt: skip
    headings = ("parameter", "what it is", "deck", "updated", "start, relative",
                "updated, relative", "change", "standard error, of deck",
                "bounds, relative")  # fmt: skip
    return table(headings, lines, (0, 1))


def pairing_tables(record: CampaignRecord) -> Html:
    """The pairs of every iteration with their reasons; the last one kept is open."""
    return joined([_pairing(record, item) for item in record.iterations])


def _pairing(record: CampaignRecord, item: IterationRecord) -> Html:
    pairing, lines = item.pairing, []
    for pair, (measured, computed) in enumerate(
        zip(pairing.measured.tolist(), pairing.computed.tolist(), strict=True)
    ):
        lines.append([
            mode_label(record, record.test.numbers[measured]), str(computed + 1),
            hertz(float(record.test.modes.frequencies_hz[measured])),
            hertz(float(item.computed.frequencies_hz[computed])),
            percent(float(item.frequency_errors[pair])),
            number(float(pairing.mac[pair]), ".3f"),
            number(float(pairing.subspace_mac[pair]), ".3f"),
            pairing.reasons[pair],
        ])  # fmt: skip
    headings = ("test mode", "elastic mode", "test, Hz", "model, Hz", "error", "MAC",
                "MAC with close modes", "why")  # fmt: skip
    kept = "" if item.accepted else " (not kept)"
    summary = (
        f"Iteration {item.number}{kept}: largest error {percent(item.worst_error, sign=False)}"
    )
    return folded(summary, table(headings, lines, (7,)), item is record.best)


def _words(quantity: str) -> str:
    words = quantity.replace("_", " ")
    return words.replace("youngs", "Young's").replace("poissons", "Poisson's")


def _count(count: int, word: str) -> str:
    return f"{count} {word}{'' if count == 1 else 's'}"
