"""What changed between two runs: parameters, modes, pairs, environment and lines of the deck."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from modetune.core.brief import brief
from modetune.core.monitoring.past_runs import PastRun
from modetune.flows.report.tables import Column, Table, table_of
from modetune.flows.studies.history.named_runs import NamedRun
from modetune.flows.studies.history.trends import frequency_errors

#: Lines of a deck that are shown, and files up to which inserted lines are looked for.
LINES, LONGEST = 20, 20_000


@dataclass(frozen=True, slots=True)
class ParameterDifference:
    """A parameter in two runs, relative to the second one's deck.

    errors: the difference in repeatability errors of a difference, NaN where these are unknown or
    zero, as on a bound.
    """

    name: Annotated[str, Column("parameter")]
    before: Annotated[float, Column("first, of deck", "%", ".2f")]
    after: Annotated[float, Column("second, of deck", "%", ".2f")]
    change: Annotated[float, Column("difference, of deck", "%", "+.2f")]
    errors: Annotated[float, Column("in repeatability errors", form="+.1f", unknown="unknown")]


@dataclass(frozen=True, slots=True)
class ModeDifference:
    """A test mode in two runs; NaN where one of them lacks it or its pair.

    pair: what became of its pair: "", "gained", "lost", "other".
    """

    label: Annotated[str, Column("test mode")]
    test_before_hz: Annotated[float, Column("test, first", "Hz")]
    test_after_hz: Annotated[float, Column("test, second", "Hz")]
    change: Annotated[float, Column("change of the test", "%", "+.2f")]
    error_before: Annotated[float, Column("error of the model, first", "%", "+.2f")]
    error_after: Annotated[float, Column("second", "%", "+.2f")]
    mac_before: Annotated[float, Column("MAC, first", form=".3f")]
    mac_after: Annotated[float, Column("second", form=".3f")]
    pair: Annotated[str, Column("pair")]


@dataclass(frozen=True, slots=True)
class DeckLine:
    """A line of the updated deck that differs; a text is empty where only the other deck has it."""

    file: Annotated[str, Column("file")]
    line: Annotated[int, Column("line")]
    before: Annotated[str, Column("first")]
    after: Annotated[str, Column("second")]


@dataclass(frozen=True, slots=True, repr=False)
class RunDifference:
    """What changed between two runs.

    deck: the lines of the updated decks that differ; deck_remark: why there are none, or not all.
    """

    before: PastRun
    after: PastRun
    parameters: tuple[ParameterDifference, ...]
    modes: tuple[ModeDifference, ...]
    deck: tuple[DeckLine, ...]
    deck_remark: str

    __repr__ = brief

    @property
    def largest(self) -> ParameterDifference | None:
        """The parameter that changed most in repeatability errors; None where none is known."""
        known = [item for item in self.parameters if np.isfinite(item.errors)]
        return max(known, key=lambda item: abs(item.errors), default=None)

    @property
    def sentence(self) -> str:
        """The result in a sentence."""
        both = f"from {self.before.at} to {self.after.at}"
        most = self.largest
        if most is None:
            found = "no parameter has a known repeatability in both runs"
        else:
            found = (
                f"{most.name} changed most: {100.0 * most.change:+.1f} % of the deck "
                f"({abs(most.errors):.0f} repeatability errors)"
            )
        pairs = [item.label for item in self.modes if item.pair]
        return f"{both} {found}" + (f"; other pairs: mode {', '.join(pairs)}" if pairs else "")

    @property
    def lines(self) -> list[str]:
        """What else changed, a sentence each."""
        before, after = self.before, self.after
        lines = []
        for name in dict.fromkeys((*before.environment, *after.environment)):
            values = [
                f"{run.environment[name]:g}" if name in run.environment else "unknown"
                for run in (before, after)
            ]
            lines.append(f"{name}: {values[0]} and {values[1]}")
        if before.test_digest == after.test_digest:
            lines.append("both runs have the same test")
        for what in ("deck_digest", "solver", "solver_version", "modetune_version", "settings"):
            one, other = getattr(before, what), getattr(after, what)
            if one != other:
                lines.append(f"{what.replace('_', ' ')}: {_text(one)}, then {_text(other)}")
        verdicts = [run.verdict.value for run in (before, after)]
        if verdicts[0] != verdicts[1]:
            lines.append(f"verdict: {verdicts[0]}, then {verdicts[1]}")
        return [*lines, *filter(None, [self.deck_remark])]

    @property
    def tables(self) -> list[Table]:
        """Parameters, modes and lines of the deck."""
        deck = self.deck[:LINES]
        return [
            table_of("Parameters", self.parameters, ParameterDifference),
            table_of("Modes", self.modes, ModeDifference),
            *([table_of("Lines of the updated deck", deck, DeckLine)] if deck else []),
        ]


def difference(first: NamedRun, second: NamedRun) -> RunDifference:
    """Return what changed from a first run to a second one."""
    before, after = first.run, second.run
    deck, remark = _deck_lines(first.folder, second.folder)
    return RunDifference(
        before, after, _parameters(before, after), _modes(before, after), deck, remark
    )


def _parameters(before: PastRun, after: PastRun) -> tuple[ParameterDifference, ...]:
    rows = []
    for name in dict.fromkeys((*after.names, *before.names)):
        there = [
            (float(run.values[at]), float(run.repeatability[at]), float(run.references[at]))
            if (at := run.names.index(name) if name in run.names else -1) >= 0
            else (np.nan, np.nan, np.nan)
            for run in (before, after)
        ]
        (one, error, reference), (other, other_error, other_reference) = there
        scale = other_reference if np.isfinite(other_reference) else reference
        both = float(np.hypot(error, other_error))
        gap = other - one
        rows.append(
            ParameterDifference(
                name,
                one / scale,
                other / scale,
                gap / scale,
                gap / both * np.sign(scale) if both > 0.0 else np.nan,
            )
        )
    return tuple(rows)


def _modes(before: PastRun, after: PastRun) -> tuple[ModeDifference, ...]:
    rows = []
    errors = [frequency_errors(run) for run in (before, after)]
    for label in dict.fromkeys((*before.modes, *after.modes)):
        hz, error, mac = np.full((3, 2), np.nan)
        for side, run in enumerate((before, after)):
            if label in run.modes:
                place = run.modes.index(label)
                hz[side], mac[side] = run.test_hz[place], run.macs[place]
                error[side] = errors[side][place]
        one, other = before.pairs.get(label), after.pairs.get(label)
        pair = "" if one == other else "lost" if other is None else "gained" if one is None else ""
        rows.append(
            ModeDifference(
                label, hz[0], hz[1], hz[1] / hz[0] - 1.0, error[0], error[1], mac[0], mac[1],
                pair or ("" if one == other else "other"),
            )
        )  # fmt: skip
    return tuple(rows)


def _deck_lines(first: Path | None, second: Path | None) -> tuple[tuple[DeckLine, ...], str]:
    """Return the lines of the updated decks that differ, and a remark."""
    if first is None or second is None:
        gone = "the first run" if first is None else "the second run"
        return (), f"the deck of {gone} is no longer kept (`run.keep`), so its lines are unknown"
    folders = [place / "updated" for place in (first, second)]
    names = [
        {str(file.relative_to(folder)) for file in folder.rglob("*") if file.is_file()}
        for folder in folders
    ]
    lines: list[DeckLine] = []
    remarks = [
        f"only one of the runs has {name} in its deck" for name in sorted(names[0] ^ names[1])
    ]
    for name in sorted(names[0] & names[1]):
        texts = [
            (folder / name).read_text("utf-8", "surrogateescape").splitlines() for folder in folders
        ]
        if texts[0] == texts[1]:
            continue
        if len(texts[0]) == len(texts[1]):
            lines += [
                DeckLine(name, number, one, other)
                for number, (one, other) in enumerate(zip(*texts, strict=True), start=1)
                if one != other
            ]
        elif max(map(len, texts)) <= LONGEST:
            lines += _inserted(name, *texts)
        else:
            counts = " and ".join(str(len(text)) for text in texts)
            remarks.append(f"{name} has {counts} lines, too many to find those that differ")
    if len(lines) > LINES:
        remarks.append(f"{len(lines)} lines of the decks differ; the first {LINES} are shown")
    return tuple(lines), "; ".join(remarks)


def _inserted(name: str, before: list[str], after: list[str]) -> list[DeckLine]:
    """Return the lines that differ where some were inserted or removed."""
    found = []
    for tag, a, b, c, d in difflib.SequenceMatcher(None, before, after, False).get_opcodes():
        if tag == "equal":
            continue
        for place in range(max(b - a, d - c)):
            one = before[a + place] if a + place < b else ""
            other = after[c + place] if c + place < d else ""
            found.append(DeckLine(name, c + place + 1, one, other))
    return found


def _text(value: object) -> str:
    return (", ".join(value) or "none") if isinstance(value, tuple) else str(value)
