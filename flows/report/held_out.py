"""What the report says of modes that were held out of updating."""

from __future__ import annotations

from modetune.core.numbering import mode_name
from modetune.core.record import CampaignRecord
from modetune.flows.report.markup import (
    Html,
    bullets,
    element,
    hertz,
    number,
    paragraph,
    percent,
    table,
)


def held_out_section(record: CampaignRecord) -> Html:
    """Table and sentences, marked where something got worse; empty where nothing was held out."""
    held = record.held_out
    if held is None:
        return Html("")
    told = paragraph(
        "These modes were measured and not used for updating: what they say of the model is no "
        "echo of what it was fitted to. One got worse where its frequency error grew by more than "
        "frequencies are measured with, or its MAC fell by more than 0.02.", "note",
    )  # fmt: skip
    rows, worse = [], []
    for mode, test in enumerate(held.numbers.tolist()):
        name = mode_name(record.configurations, test)
        bad = bool(held.worse[mode])
        rows.append([
            name, hertz(float(held.test_hz[mode])), hertz(float(held.initial_hz[mode])),
            percent(float(held.error_initial[mode])), hertz(float(held.updated_hz[mode])),
            percent(float(held.error_updated[mode])), number(float(held.mac_initial[mode]), ".3f"),
            number(float(held.mac_updated[mode]), ".3f"),
            element("span", "got worse", "outside") if bad else "held",
        ])  # fmt: skip
        if bad:
            worse.append(f"{name.capitalize()} got worse: it {held.reason(mode)}.")
    headings = ("test", "test, Hz", "before, Hz", "error", "after, Hz", "error", "MAC before",
                "MAC after", "judgement")  # fmt: skip
    marked = bullets(worse, "remarks") if worse else Html("")
    return told + table(headings, rows, (0, 8)) + marked
