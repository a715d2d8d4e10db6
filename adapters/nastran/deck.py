"""Nastran decks: reading with includes, and editing that changes only the lines that must change.

A deck is file management and executive control up to CEND, case control up to BEGIN BULK, and
bulk data up to ENDDATA; a file that has none of these is bulk data alone. `$` starts a comment.
INCLUDE may be anywhere; its file is searched in the folder of the file that names it, then in that
of the main deck.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import chain
from pathlib import Path

from modetune.adapters import deck_files
from modetune.adapters.deck_files import Include, Line, check_include, read_text
from modetune.adapters.nastran.fields import NastranCard, read_cards, read_changed, read_number
from modetune.adapters.nastran.parts import Part, is_partitioned, merged_cards
from modetune.adapters.regular_file import is_file
from modetune.core.errors import ModelError

INCLUDE = re.compile(r"\s*INCLUDE(?=[\s,='\"]|$)\s*[,=]?\s*(.*)", re.IGNORECASE)
CONTROL = re.compile(r"\s*(SOL(?=[\s=,])|CEND\b|BEGIN\b)\s*[=,]?\s*([^$]*)", re.IGNORECASE)
END = re.compile(r"\s*ENDDATA\b", re.IGNORECASE)
#: The beginning of a part, behind the word BEGIN.
PART = re.compile(r"(?:BULK\s*)?SUPER\s*=\s*0*([1-9]\d*)")
#: A quoted file name that has not ended after this many lines has lost its quote.
LONGEST_NAME = 20


@dataclass(frozen=True)
class NastranDeck:
    """A deck with its includes in place: its lines, and the cards of its bulk data.

    executive, case_control, bulk: positions in lines; CEND belongs to executive. subcase: the
    number of the subcase whose modes count, 0 where the case control leaves no choice. parts: the
    sections of superelements, the residual structure first; empty for a deck of one model. cards:
    those of the whole model, in its numbers.
    """

    file: Path
    lines: tuple[Line, ...]
    includes: tuple[Include, ...]
    cards: tuple[NastranCard, ...]
    executive: range
    case_control: range
    bulk: range
    subcase: int = 0
    parts: tuple[Part, ...] = ()

    def named(self, *names: str) -> list[NastranCard]:
        """All cards of these names, in order."""
        found = [self._places.get(name, []) for name in set(names)]
        places = found[0] if len(found) == 1 else sorted(chain.from_iterable(found))
        return [self.cards[place] for place in places]

    @cached_property
    def _places(self) -> dict[str, list[int]]:
        """Positions in cards of each name."""
        places: dict[str, list[int]] = {}
        for place, card in enumerate(self.cards):
            places.setdefault(card.name, []).append(place)
        return places

    def where(self, card: NastranCard) -> str:
        return self.lines[card.lines[0]].where

    def number(self, card: NastranCard, field: int) -> float | None:
        """A number of a card, None where the field is blank. Raises ModelError."""
        found = card.fields[field] if field < len(card.fields) else None
        if found is None:
            return None
        try:
            return read_number(found.text)
        except ValueError as error:
            raise ModelError(f"{self.lines[found.line].where}: {error}") from None


def read_deck(path: Path, subcase: int = 0) -> NastranDeck:
    """Read a deck and its includes. Raises ModelError naming file and line."""
    lines: list[Line] = []
    includes: list[Include] = []
    _read_file(path, path.parent, (path.resolve(),), lines, includes)
    executive, case_control, bulk, parts = _sections(path, lines)
    cards = _cards(lines, bulk, parts)
    if not parts and is_partitioned(cards):
        parts = ((0, bulk),)
        cards = _cards(lines, bulk, parts)
    if not cards:
        raise ModelError(f"{path}, line 1: the file holds no bulk data")
    return NastranDeck(
        path, tuple(lines), tuple(includes), cards, executive, case_control, bulk, subcase, parts
    )


def _cards(lines: Sequence[Line], bulk: range, parts: Sequence[Part]) -> tuple[NastranCard, ...]:
    return merged_cards(lines, parts) if parts else read_cards(lines, bulk)


def with_lines(deck: NastranDeck, changed: Mapping[int, str]) -> NastranDeck:
    """The deck as it reads with some lines changed. Raises ModelError."""
    lines = texts_at(deck, changed)
    cards = None if deck.parts else read_changed(deck.cards, deck.lines, changed, deck.bulk)
    if cards is None:
        cards = _cards(lines, deck.bulk, deck.parts)
    return replace(deck, lines=lines, cards=cards)


def texts_at(deck: NastranDeck, changed: Mapping[int, str]) -> tuple[Line, ...]:
    """The lines of a deck, some of them changed."""
    lines = list(deck.lines)
    for position, text in changed.items():
        lines[position] = lines[position]._replace(text=text)
    return tuple(lines)


def with_added(
    deck: NastranDeck, changed: Mapping[int, str], added: Mapping[int, Iterable[str]]
) -> NastranDeck:
    """The deck with some lines of its bulk data changed and new ones behind some. Raises
    ModelError."""
    lines = deck_files.with_added(deck.lines, changed, added)
    bulk = range(deck.bulk.start, deck.bulk.stop + len(lines) - len(deck.lines))
    more = {position: len(list(texts)) for position, texts in added.items()}
    parts = tuple(
        (number, range(*(end + sum(n for at, n in more.items() if at < end) for end in
                         (own.start, own.stop))))
        for number, own in deck.parts
    )  # fmt: skip
    return replace(deck, lines=lines, bulk=bulk, parts=parts, cards=_cards(lines, bulk, parts))


def write_edited(deck: NastranDeck, changed: Mapping[int, str], folder: Path) -> Path:
    """Write the deck and its includes with some lines changed; all else stays byte for byte.

    changed: position of a line in the deck to its new text. Returns the main file's path in
    `folder`. Raises ModelError, StorageUnavailable.
    """
    return deck_files.write_edited(deck.file, deck.lines, deck.includes, changed, _renamed, folder)


def _read_file(
    path: Path, main: Path, above: tuple[Path, ...], lines: list[Line], includes: list[Include]
) -> bool:
    """Add a file's lines and those of its includes; returns whether ENDDATA ended the deck."""
    pieces = read_text(path).split("\n")
    if not pieces[-1]:
        pieces.pop()
    numbered = (Line(text.rstrip("\r"), path, number) for number, text in enumerate(pieces, 1))
    for line in numbered:
        if END.match(line.text):
            lines.append(line)
            return True
        if not INCLUDE.match(line.text):
            lines.append(line)
            continue
        include = _include(line, numbered, main, includes)
        check_include(include, above, lines, includes)
        includes.append(include)
        below = (*above, include.target.resolve())
        if _read_file(include.target, main, below, lines, includes):
            return True
    return False


def _include(
    line: Line, following: Iterator[Line], main: Path, includes: Sequence[Include]
) -> Include:
    """Return the file of an INCLUDE; a name in quotes may continue in the following lines."""
    taken, written = _file_name(line, following)
    holder = line.file
    # Windows decks part folders by backslashes, which elsewhere are letters of a name.
    for name in dict.fromkeys((written, written.replace("\\", "/"))):
        for folder in (holder.parent, main):
            target = Path(os.path.normpath(folder / name))
            if not is_file(target):
                continue
            below = not os.path.relpath(target, main).startswith("..")
            moved = any(other.target == holder and not other.keeps_place for other in includes)
            keeps = below and not moved and not Path(name).is_absolute() and name == written
            return Include(taken, target, keeps)
    raise ModelError(f"{line.where}: the included file {holder.parent / written} is not there")


def _file_name(line: Line, following: Iterator[Line]) -> tuple[tuple[Line, ...], str]:
    """The lines of an INCLUDE and the file it names."""
    found = INCLUDE.match(line.text)
    rest = found.group(1) if found else ""
    quote = rest[:1]
    if quote not in ("'", '"'):
        name = rest.partition("$")[0].strip()
        if not name:
            raise ModelError(f"{line.where}: INCLUDE needs the name of a file")
        return (line,), name
    taken, name, open_text = [line], "", rest[1:]
    while quote not in open_text:
        name += open_text.strip()
        another = next(following, None)
        if another is None or len(taken) >= LONGEST_NAME:
            raise ModelError(
                f"{line.where}: the quote round the included file's name is not closed"
            )
        taken.append(another)
        open_text = another.text
    return tuple(taken), name + open_text.partition(quote)[0].strip()


def _renamed(lines: Sequence[Line], place: Path, holder: Path) -> list[str]:
    """An INCLUDE of another file, named from the one that holds it; its other lines are emptied."""
    name = Path(os.path.relpath(place, holder.parent)).as_posix()
    return [f"INCLUDE '{name}'", *("$" for _ in lines[1:])]


def _sections(path: Path, lines: Sequence[Line]) -> tuple[range, range, range, tuple[Part, ...]]:
    """Find executive, case control and bulk data, and the sections of parts if there are any.

    Raises ModelError where one has no end.
    """
    cend, begin, has_solution = None, None, False
    starts: list[tuple[int, int]] = []
    for position, line in enumerate(lines):
        found = CONTROL.match(line.text)
        if found is None:
            continue
        word, rest = found.group(1).upper(), found.group(2).strip().upper()
        if word == "BEGIN":
            part = PART.fullmatch(rest)
            if begin is None and rest == "BULK":
                begin = position
            elif begin is None or part is None or int(part.group(1)) in [n for n, _ in starts]:
                raise ModelError(
                    f"{line.where}: superelements: BEGIN {rest} is none of BEGIN BULK once, then "
                    "BEGIN SUPER = n once for each part"
                )
            else:
                starts.append((int(part.group(1)), position))
        elif begin is not None:
            raise ModelError(f"{line.where}: {word} after BEGIN BULK")
        elif word == "CEND":
            cend = position
        else:
            has_solution = True
    if begin is None and (cend is not None or has_solution):
        raise ModelError(f"{path}, line {len(lines)}: the deck ends without BEGIN BULK")
    first_case = 0 if cend is None else cend + 1
    first_bulk = 0 if begin is None else begin + 1
    last = len(lines) - 1 if lines and END.match(lines[-1].text) else len(lines)
    stops = [position for _, position in starts] + [last]
    parts = [(0, range(first_bulk, stops[0]))] if starts else []
    for (number, start), stop in zip(starts, stops[1:], strict=True):
        parts.append((number, range(start + 1, stop)))
    sections = range(first_case), range(first_case, first_bulk - 1), range(first_bulk, last)
    return *sections, tuple(parts)
