"""A deck as a template: files with numbers that parameters scale, and the place of each.

A number is in a placeholder, with the deck's value and its format,

    {E_wing=7.1E+10:12.5E}      {E_wing:12.5E}   (the value is in another one of this name)

or where a rule says (`NumberRule`): a field or columns of a line, or what a pattern finds. Either
way it is a stretch of a file's text that other text replaces; everything else stays byte by byte.
Formats are Python's for numbers, and D for an E that some programs write so. A number that is
longer than its width is refused: the columns behind it would move.

`{n_modes}` is the number of requested modes.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path

from modetune.adapters.command.settings import CommandSettings, NumberRule
from modetune.adapters.regular_file import read_errors, read_regular
from modetune.core.errors import ModelError

#: The placeholder that is no parameter, and its value in a deck that is only shown.
N_MODES, SHOWN_MODES = "n_modes", 10
FORMAT = re.compile(r"([<>^]?[+\- ]?0?)(\d{0,3})(\.\d{1,3})?([eEfFgGdD]?)")
#: Decimal digits that identify a double.
DIGITS = 17


@dataclass(frozen=True, slots=True)
class Spot:
    """A number in the text of a file: what it is called, its place, its format.

    start, end: in the text. number: the deck's value; NaN for n_modes. form: of Python, empty for
    all digits; width: characters it must fit, 0 for any. head, tail: of a placeholder the text
    around its value, where a new one may be written; empty for a bare number.
    """

    name: str
    start: int
    end: int
    number: float
    where: str
    form: str = ""
    width: int = 0
    head: str = ""
    tail: str = ""

    def written(self, value: float) -> str:
        """Return the text of a number. Raises ModelError where it does not fit its width."""
        if not math.isfinite(value):
            raise ModelError(f"{self.where}: {self.name} would be {value}, which is not a number")
        if self.form:
            text = format(value, self.form.translate({ord("d"): "e", ord("D"): "E"}))
            text = text.replace("E", "D") if self.form[-1] == "D" else text
            text = text.replace("e", "d") if self.form[-1] == "d" else text
        elif self.width:
            texts = (f"{value:.{digits}G}" for digits in range(DIGITS, 0, -1))
            text = next((text for text in texts if len(text) <= self.width), f"{value:.0G}")
        else:
            text = repr(value)
        if self.width and len(text) > self.width:
            raise ModelError(
                f"{self.where}: `{text}` of {self.name} has {len(text)} characters where "
                f"{self.width} are; give its format fewer digits or more width"
            )
        return text.rjust(self.width)


@dataclass(frozen=True)
class TemplateFile:
    """One file of a deck: its name in the folder of the main file, its text and its numbers."""

    path: Path
    name: str
    text: str
    spots: tuple[Spot, ...]

    def replaced(self, new: Callable[[Spot], str]) -> bytes:
        """Return the file with new texts at its spots."""
        parts, at = [], 0
        for spot in self.spots:
            parts += [self.text[at : spot.start], new(spot)]
            at = spot.end
        return _bytes("".join([*parts, self.text[at:]]))

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the unedited text."""
        return hashlib.sha256(_bytes(self.text)).hexdigest()


@dataclass(frozen=True)
class Template:
    """A deck's files, the main one first."""

    files: tuple[TemplateFile, ...]

    @property
    def path(self) -> Path:
        return self.files[0].path

    @cached_property
    def spots(self) -> dict[str, list[Spot]]:
        """The numbers by their names, in the order of the files."""
        found: dict[str, list[Spot]] = {}
        for file in self.files:
            for spot in file.spots:
                found.setdefault(spot.name, []).append(spot)
        return found

    @property
    def has_placeholders(self) -> bool:
        return any(spot.head for spots in self.spots.values() for spot in spots)

    def filled(self, numbers: Mapping[Spot, float], n_modes: int) -> dict[str, bytes]:
        """Return the files with new numbers at some spots, as the program gets them, by name.

        Raises ModelError.
        """

        def new(spot: Spot) -> str:
            if spot.name == N_MODES:
                return format(n_modes, spot.form)
            return spot.written(numbers.get(spot, spot.number))

        return {file.name: file.replaced(new) for file in self.files}

    def updated(self, numbers: Mapping[Spot, float]) -> dict[str, bytes]:
        """Return the files with new numbers; placeholders stay, with the new values in them."""

        def new(spot: Spot) -> str:
            if spot.name == N_MODES:
                return f"{spot.head}{spot.tail}"
            text = spot.written(numbers.get(spot, spot.number))
            return f"{spot.head}={text.strip()}{spot.tail}" if spot.head else text

        return {file.name: file.replaced(new) for file in self.files}


def read_template(deck: Path, settings: CommandSettings) -> Template:
    """Read a deck's files and find its numbers. Raises ModelError with every problem."""
    problems: list[str] = []
    files = []
    for name in ("", *settings.inputs):
        path = deck.parent / name if name else deck
        with read_errors(path, ModelError):
            text = read_regular(path).decode("utf-8", "surrogateescape")
        spots = _placeholders(path, text, settings.delimiters, problems)
        for rule in settings.edits:
            if (rule.file or "") in (name, name or deck.name):
                spots += _ruled(path, text, rule, problems)
        files.append(TemplateFile(path, name or deck.name, text, _apart(spots, problems)))
    known = {"", deck.name, *settings.inputs}
    problems += [
        f"{deck}: an edit of {rule.parameter} names the file {rule.file}, which is not among "
        f"`inputs` ({', '.join(settings.inputs) or 'there are none'})"
        for rule in settings.edits
        if (rule.file or "") not in known
    ]
    files = _with_values(files, settings.delimiters, problems)
    if problems:
        raise ModelError("\n".join(problems))
    return Template(tuple(files))


def read_value(text: str) -> float:
    """Return a number of a deck, with E or D before its exponent. Raises ValueError."""
    value = float(text.strip().upper().replace("D", "E"))
    if not math.isfinite(value):
        raise ValueError(f"{text} is not a finite number")
    return value


def _placeholders(
    path: Path, text: str, delimiters: tuple[str, str], problems: list[str]
) -> list[Spot]:
    first, last = map(re.escape, delimiters)
    pattern = (
        rf"(?P<head>{first}(?P<name>[A-Za-z][\w.-]*))"
        rf"(?:=(?P<value>[^:\s]+?))?(?P<tail>(?::(?P<form>[^\s:]*?))?{last})"
    )
    spots = []
    for found in re.finditer(pattern, text):
        where, name = _where(path, text, found.start()), found["name"]
        form = found["form"] or ""
        shape = FORMAT.fullmatch(form)
        if name == N_MODES:
            if form and not re.fullmatch(r"[<>^]?0?\d{0,3}d?", form):
                problems.append(f"{where}: `{found[0]}`: a number of modes is whole; write `:5d`")
            spots.append(Spot(name, *found.span(), math.nan, where, form, 0, *_around(found)))
            continue
        if shape is None:
            problems.append(f"{where}: `{found[0]}`: {form} is not a format such as 12.5E")
            continue
        value = math.nan
        if found["value"]:
            try:
                value = read_value(found["value"])
            except ValueError:
                problems.append(f"{where}: `{found[0]}`: {found['value']} is not a number")
                continue
        width = int(shape[2] or 0)
        spots.append(Spot(name, *found.span(), value, where, form, width, *_around(found)))
    return spots


def _around(found: re.Match[str]) -> tuple[str, str]:
    return found["head"], found["tail"]


def _ruled(path: Path, text: str, rule: NumberRule, problems: list[str]) -> list[Spot]:
    """Return the numbers that a rule finds in a file."""
    try:
        spans = _by_pattern(text, rule) if rule.pattern else [_by_line(text, rule)]
    except (ModelError, re.error) as error:
        problems.append(f"{path}: the edit of {rule.parameter}: {error}")
        return []
    shape = FORMAT.fullmatch(rule.form)
    if shape is None:
        problems.append(f"{path}: the edit of {rule.parameter}: {rule.form} is not a format")
        return []
    spots = []
    for start, end in spans:
        where = _where(path, text, start)
        width = end - start if rule.columns[0] else int(shape[2] or 0)
        try:
            value = read_value(text[start:end])
        except ValueError:
            problems.append(
                f"{where}: the edit of {rule.parameter} finds `{text[start:end].strip()}`, which "
                "is not a number"
            )
            continue
        spots.append(Spot(rule.parameter, start, end, value, where, rule.form, width))
    return spots


def _by_pattern(text: str, rule: NumberRule) -> list[tuple[int, int]]:
    pattern = re.compile(rule.pattern, re.MULTILINE)
    if pattern.groups != 1:
        raise ModelError(
            f"`{rule.pattern}` has {pattern.groups} groups; it needs one, (...), around the number"
        )
    spans = [found.span(1) for found in pattern.finditer(text) if found.start(1) >= 0]
    if not spans:
        raise ModelError(f"`{rule.pattern}` is found nowhere")
    return spans


def _by_line(text: str, rule: NumberRule) -> tuple[int, int]:
    lines = text.splitlines(keepends=True)
    if rule.line > len(lines):
        raise ModelError(f"it has {len(lines)} lines, and not line {rule.line}")
    line = lines[rule.line - 1].rstrip("\r\n")
    start = sum(map(len, lines[: rule.line - 1]))
    if rule.columns[0]:
        first, last = rule.columns
        if last > len(line):
            raise ModelError(f"line {rule.line} has {len(line)} columns, and not {last}")
        return start + first - 1, start + last
    pattern = r"[^,]*" if "," in line else r"\S+"
    words = [found.span() for found in re.finditer(pattern, line)]
    if "," in line:  # between two commas there is a word, though it may be empty
        ends = [place for place, letter in enumerate(f"{line},") if letter == ","]
        words = list(zip([0, *(place + 1 for place in ends[:-1])], ends, strict=True))
    if rule.field > len(words):
        raise ModelError(f"line {rule.line} has {len(words)} fields, and not {rule.field}")
    first, last = words[rule.field - 1]
    word = line[first:last]
    blank = len(word) - len(word.lstrip())
    return start + first + blank, start + first + blank + len(word.strip())


def _apart(spots: list[Spot], problems: list[str]) -> tuple[Spot, ...]:
    """Return the spots in the order of the text; a problem where two overlap."""
    ordered = sorted(spots, key=lambda spot: spot.start)
    for one, other in pairwise(ordered):
        if other.start < one.end:
            problems.append(
                f"{other.where}: {one.name} and {other.name} both change one number here"
            )
    return tuple(ordered)


def _with_values(
    files: Sequence[TemplateFile], delimiters: tuple[str, str], problems: list[str]
) -> list[TemplateFile]:
    """Return the files with the value of a name's other placeholders where one has none."""
    values: dict[str, float] = {}
    for file in files:
        for spot in file.spots:
            if not math.isnan(spot.number):
                values.setdefault(spot.name, spot.number)
    for spot in (spot for file in files for spot in file.spots):
        if spot.name == N_MODES:
            continue
        written = f"{delimiters[0]}{spot.name}=VALUE{delimiters[1]}"
        if spot.name not in values:
            problems.append(
                f"{spot.where}: the placeholder of {spot.name} has no value; write the deck's own "
                f"as {written}, or choose other `delimiters` if this is not a placeholder"
            )
    return [
        replace(
            file,
            spots=tuple(
                replace(spot, number=values.get(spot.name, math.nan))
                if math.isnan(spot.number)
                else spot
                for spot in file.spots
            ),
        )
        for file in files
    ]


def _where(path: Path, text: str, start: int) -> str:
    return f"{path}, line {text.count(chr(10), 0, start) + 1}"


def _bytes(text: str) -> bytes:
    return text.encode("utf-8", "surrogateescape")
