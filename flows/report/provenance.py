"""What the report says of the way there: iterations, solver runs, and how to repeat them."""

from __future__ import annotations

import shlex

import numpy as np

from modetune.core.record import CampaignRecord, IterationRecord
from modetune.flows.report.markup import (
    Html,
    code,
    duration,
    element,
    folded,
    joined,
    mono,
    number,
    paragraph,
    percent,
    table,
)


def iterations_table(record: CampaignRecord) -> Html:
    """A line an evaluated parameter set, with what was decided there."""
    lines: list[list[Html | str]] = []
    for item in record.iterations:
        errors, macs = np.abs(item.frequency_errors), item.pairing.mac
        lines.append([
            str(item.number), percent(float(errors.max()), sign=False),
            percent(float(errors.mean()), sign=False),
            number(float(macs.min()), ".3f"), number(item.residual.misfit, ".3g"),
            number(item.slope, ".2g"), _sensitivity(item), "yes" if item.accepted else "no",
            item.decision,
        ])  # fmt: skip
    headings = ("iteration", "largest error", "mean error", "least MAC", "weighted residual",
                "slope", "sensitivity of the step here", "kept", "decision")  # fmt: skip
    return table(headings, lines, (6, 8))


def _sensitivity(item: IterationRecord) -> str:
    if not item.sensitivity_methods:
        return ""
    methods = ", ".join(dict.fromkeys(name.replace("_", " ") for name in item.sensitivity_methods))
    age = f", {item.sensitivity_age} old" if item.sensitivity_age else ""
    skipped = "; no new one here (e2)" if item.sensitivity_skipped else ""
    return f"{methods}{age}{skipped}"


def runs_table(record: CampaignRecord) -> Html:
    """Solver runs of each iteration and what they cost, failed ones counted too."""
    lines: list[list[Html | str]] = []
    for item in record.iterations:
        runs = item.runs
        lines.append([
            str(item.number), str(runs.modal), str(runs.sensitivity), str(runs.reused),
            number(runs.core_s / 60.0, ".3g"), number(runs.licence_s / 60.0, ".3g"),
            duration(item.wall_s),
        ])  # fmt: skip
    total = record.runs
    lines.append([
        element("strong", "all"), str(total.modal), str(total.sensitivity), str(total.reused),
        number(total.core_s / 60.0, ".3g"), number(total.licence_s / 60.0, ".3g"),
        duration(record.wall_s),
    ])  # fmt: skip
    headings = ("iteration", "modal runs", "sensitivity runs", "answered by the store",
                "core-minutes", "licence-minutes", "time")  # fmt: skip
    return table(headings, lines)


def repetition(record: CampaignRecord) -> Html:
    """Everything that is needed to get the same numbers again."""
    facts: list[list[Html | str]] = [
        ["modetune", record.modetune_version],
        ["solver", f"{record.solver} {record.solver_version}"],
        ["ran with", ", ".join(record.versions) or "not recorded"],
        ["units", record.units or "not recorded"],
        *_deck(record),
        ["first modal job", mono(record.iterations[0].modal_key)],
        ["modal job of the updated model", mono(record.best.modal_key)],
        ["random numbers", _random_numbers(record)],
    ]  # fmt: skip
    if record.settings:
        facts.append(["settings over the file (--set)", code("\n".join(record.settings))])
    command = " ".join(
        ["modetune update CAMPAIGN.yaml", *(f"--set {shlex.quote(s)}" for s in record.settings)]
    )
    return joined([
        table(("", ""), facts, (0, 1)),
        paragraph("With the deck, the test and this campaign file beside each other:"),
        code(command),
        folded("The campaign file", code(record.campaign_text), is_open=True),
        folded("Keys of all solver jobs, as they stand in the store", _keys(record)),
    ])  # fmt: skip


def _deck(record: CampaignRecord) -> list[list[Html | str]]:
    """The deck's digest; records of before have one of the job's content, without a file's name."""
    if not record.deck_digest:
        return []
    is_file = " " in record.deck_digest
    return [["deck, as sha256sum tells it" if is_file else "content key of the deck",
             mono(record.deck_digest)]]  # fmt: skip


def _random_numbers(record: CampaignRecord) -> str:
    spread = None if record.trust is None else record.trust.spread
    if spread is None:
        return "none are used: the same inputs give the same steps"
    return f"starts 2 to {len(spread.outcomes)}, drawn with seed {spread.seed}; steps use none"


def _keys(record: CampaignRecord) -> Html:
    lines: list[list[Html | str]] = []
    for item in record.iterations:
        lines.append([str(item.number), "modal", mono(item.modal_key)])
        lines += [[str(item.number), "sensitivity", mono(key)]
                  for key in dict.fromkeys(item.sensitivity_keys)]  # fmt: skip
    return table(("iteration", "job", "key"), lines, (1, 2))
