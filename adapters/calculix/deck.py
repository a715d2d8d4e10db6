"""CalculiX decks: reading with includes, and editing that changes only the lines that must change.

A deck is a list of cards: a keyword line (`*ELASTIC, TYPE=ISO`) and its data lines. Comments start
with `**` or `>**`. Blanks carry no meaning outside quotes and names are not case sensitive, so both
are taken out of keywords and names. Every line keeps the file and line number it came from, so that
messages name them and an updated deck differs from the user's in the changed fields only, includes
kept.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from itertools import count, pairwise, repeat
from pathlib import Path
from typing import overload

from modetune.adapters import deck_files
from modetune.adapters.deck_files import Include, Line, check_include, read_text
from modetune.adapters.regular_file import is_file
from modetune.core.errors import ModelError

#: ccx reads at most this many characters of a number.
FIELD_WIDTH = 20
#: Relative change of a number cut to them that is negligible.
CUT = 1e-12
#: What comments start with. ccx passes over `>**` before the first keyword and in steps.
COMMENTS = ("**", ">**")
INCLUDE = re.compile(r"\s*\*\s*INCLUDE", re.IGNORECASE)
INCLUDED = re.compile(r"INPUT\s*=\s*(\"[^\"]*\"|[^,]+)", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class KeywordCard:
    """A keyword with its options and the positions of its lines in the deck.

    keyword: upper case without blanks; `is_one_of` compares it with names as manuals write them.
    """

    keyword: str
    options: Mapping[str, str]
    lines: range
    data: tuple[int, ...]

    def option(self, name: str) -> str:
        """An option's value in upper case without blanks, empty where it is not given."""
        return self.options.get(name, "")

    def is_one_of(self, *keywords: str) -> bool:
        return any(self.keyword == canonical_name(keyword) for keyword in keywords)


class OwnLines(Sequence[Line]):
    """Lines of a text, each created at its access: a translated deck has a million."""

    def __init__(self, texts: Sequence[str], file: Path) -> None:
        self._texts = texts
        self._file = file

    def __len__(self) -> int:
        return len(self._texts)

    @overload
    def __getitem__(self, place: int) -> Line: ...
    @overload
    def __getitem__(self, place: slice) -> Sequence[Line]: ...
    def __getitem__(self, place: int | slice) -> Line | Sequence[Line]:
        if isinstance(place, slice):
            return list(self)[place]
        return Line(self._texts[place], self._file, range(1, len(self._texts) + 1)[place])

    def __iter__(self) -> Iterator[Line]:
        fields = zip(self._texts, repeat(self._file), count(1), repeat(False))
        return map(partial(tuple.__new__, Line), fields)  # without a call of Python each


@dataclass(frozen=True, slots=True)
class KeywordDeck:
    """A deck with its includes in place: its lines, and the cards they form.

    step: number of the *STEP whose modes count, 0 for the last with *FREQUENCY.
    """

    file: Path
    lines: Sequence[Line]
    cards: tuple[KeywordCard, ...]
    includes: tuple[Include, ...]
    step: int = 0
    _places: dict[str, list[int]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    _materials: dict[str, list[KeywordCard]] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    def named(self, *keywords: str) -> list[KeywordCard]:
        """All cards of these keywords, in order."""
        if not self._places:  # found once: decks with thousands of cards are asked for each
            found = dict[str, list[int]]()
            for place, card in enumerate(self.cards):
                found.setdefault(card.keyword, []).append(place)
            self._places.update(found)
        wanted = {canonical_name(keyword) for keyword in keywords}
        places = sorted(place for name in wanted for place in self._places.get(name, ()))
        return [self.cards[place] for place in places]

    def of_material(self, name: str) -> list[KeywordCard] | None:
        """The cards that follow the *MATERIAL cards of a name, in order; None if it has none."""
        if not self._materials:
            found, cards = dict[str, list[KeywordCard]](), list[KeywordCard]()
            for card in self.cards:
                if card.keyword == "*MATERIAL":
                    cards = found.setdefault(card.option("NAME"), [])
                else:
                    cards.append(card)
            self._materials.update(found)
        return self._materials.get(name)

    def where(self, card: KeywordCard) -> str:
        return self.lines[card.lines.start].where

    def fields(self, position: int) -> list[str]:
        """The comma-separated fields of one data line, stripped."""
        return [field.strip() for field in self.lines[position].text.split(",")]

    def number(self, line: int, place: int) -> float:
        """A number of a data line. Raises ModelError where there is none."""
        fields = self.fields(line)
        text = fields[place] if place < len(fields) else ""
        check_width(self.lines[line], [text])
        try:
            return read_number(text)
        except ValueError:
            where = self.lines[line].where
            raise ModelError(f"{where}: {text!r} is not a number") from None


def read_deck(path: Path, step: int = 0) -> KeywordDeck:
    """Read a deck and its includes. Raises ModelError naming file and line."""
    lines: list[Line] = []
    includes: list[Include] = []
    _read_file(path, path.parent, (path.resolve(),), lines, includes)
    cards = tuple(_cards(lines))
    if not cards:
        if not any(line.text.strip() for line in lines):
            raise ModelError(f"{path} is empty; a deck was expected")
        raise ModelError(
            f"{path}, line 1: the file holds no CalculiX keyword (a line that starts with one `*`)"
        )
    return KeywordDeck(path, tuple(lines), cards, tuple(includes), step)


def parse_deck(file: Path, text: str) -> KeywordDeck:
    """A deck from text of our own; `file` is what messages call it.

    It has no includes, comments, blank lines and keywords of more than a line.
    """
    texts = text.split("\n")
    starts = [place for place, line in enumerate(texts) if line[:1] == "*"]
    cards = tuple(
        _card(texts[start], range(start, stop), range(start + 1, stop))
        for start, stop in pairwise([*starts, len(texts) - 1])
    )
    return KeywordDeck(file, OwnLines(texts, file), cards, ())


def deck_of(file: Path, lines: Sequence[Line]) -> KeywordDeck:
    """A deck of lines that come from elsewhere; `file` is what messages call it."""
    return KeywordDeck(file, lines, tuple(_cards(lines)), ())


def with_added(
    deck: KeywordDeck, changed: Mapping[int, str], added: Mapping[int, Iterable[str]]
) -> KeywordDeck:
    """The deck with some lines changed and new ones behind some. Raises ModelError."""
    lines = deck_files.with_added(deck.lines, changed, added)
    return replace(deck, lines=lines, cards=tuple(_cards(lines)))


def _read_file(
    path: Path, main: Path, above: tuple[Path, ...], lines: list[Line], includes: list[Include]
) -> None:
    pieces = read_text(path).split("\n")  # ccx knows no other line end; a \r before it is dropped
    if not pieces[-1]:
        pieces.pop()
    own = [*OwnLines([piece.rstrip("\r") for piece in pieces], path)]
    done = 0
    for place, text in enumerate(pieces):
        if "*" not in text or not INCLUDE.match(text):
            continue
        lines += own[done:place]
        done = place + 1
        include = _include(own[place], main)
        check_include(include, above, lines, includes)
        includes.append(include)
        _read_file(include.target, main, (*above, include.target.resolve()), lines, includes)
    lines += own[done:]


def _include(line: Line, main: Path) -> Include:
    """Return the file of an *INCLUDE line: ccx searches in the folder of the main deck.

    A file in the folder of the including one, where other programs search, is accepted too.
    """
    found = INCLUDED.search(line.text)
    if found is None:
        raise ModelError(f"{line.where}: *INCLUDE needs INPUT=file on the same line")
    written = Path(found.group(1).strip().strip('"'))
    for folder in (main, line.file.parent):
        if is_file(folder / written):
            keeps = folder is main and not written.is_absolute() and ".." not in written.parts
            return Include((line,), folder / written, keeps)
    raise ModelError(f"{line.where}: the included file {main / written} is not there")


def _cards(lines: Sequence[Line]) -> Iterable[KeywordCard]:
    start, header, data = 0, "", list[int]()
    open_header = False
    for position, line in enumerate(lines):
        if header and line.text[:1].isdigit() and not open_header:
            data.append(position)
            continue
        text = line.text.strip()
        if not text or text.startswith(COMMENTS):
            continue
        # ccx 2.20 does not continue keyword lines: only what can be nothing else is taken as such.
        if open_header and "=" in text and not text.startswith("*"):
            header += text
            open_header = text.endswith(",")
        elif text.startswith("*"):
            if header:
                yield _card(header, range(start, position), data)
            start, header, data = position, text, []
            open_header = text.endswith(",")
        elif header:
            data.append(position)
            open_header = False
        else:
            raise ModelError(f"{line.where}: data before the first keyword: {text[:40]!r}")
    if header:
        yield _card(header, range(start, len(lines)), data)


def _card(header: str, lines: range, data: Iterable[int]) -> KeywordCard:
    keyword, *options = header.split(",")
    pairs = (option.partition("=") for option in options)
    settings = {canonical_name(name): canonical_name(value) for name, _, value in pairs}
    settings.pop("", None)
    return KeywordCard(canonical_name(keyword), settings, lines, tuple(data))


def canonical_name(text: str) -> str:
    """A keyword or name in upper case without blanks and quotes."""
    return "".join(text.replace('"', "").split()).upper()


@lru_cache(maxsize=1 << 17)
def format_number(value: float) -> str:
    """A number in at most 20 characters, as many as ccx reads."""
    text = repr(float(value))
    return text if len(text) <= FIELD_WIDTH else f"{value:.12e}"


def check_width(line: Line, texts: Iterable[str]) -> None:
    """Raise ModelError where ccx, which takes 20 characters of each, reads another number."""
    for text in map(str.strip, texts):
        if len(text) <= FIELD_WIDTH:
            continue
        with suppress(ValueError):  # what is no number is refused elsewhere
            whole, left = float(text), text[:FIELD_WIDTH]
            try:
                same = math.isclose(float(left), whole, rel_tol=CUT)
            except ValueError:
                same = False
            if not same:
                raise ModelError(
                    f"{line.where}: of {text} ccx reads {FIELD_WIDTH} characters alone, {left}: "
                    "write it with fewer digits"
                )


def replace_field(text: str, place: int, value: str) -> str:
    """A line with one of its comma-separated fields, or the value of an option, replaced.

    Blanks round it are kept.
    """
    fields = text.split(",")
    old = fields[place]
    lead = old[: len(old) - len(old.lstrip())]
    tail = old[len(old.rstrip()) :] if old.strip() else ""
    option, is_option, _ = old.strip().partition("=")
    fields[place] = f"{lead}{option + '=' if is_option else ''}{value}{tail}"
    return ",".join(fields)


def write_edited(deck: KeywordDeck, changed: Mapping[int, str], folder: Path) -> Path:
    """Write the deck and its includes with some lines changed; all else stays byte for byte.

    changed: position of a line in the deck to its new text. Returns the main file's path in
    `folder`. Raises ModelError, StorageUnavailable.
    """
    return deck_files.write_edited(deck.file, deck.lines, deck.includes, changed, _renamed, folder)


def _renamed(lines: Sequence[Line], place: Path, holder: Path) -> list[str]:
    """Return an *INCLUDE line that names another file, relative to the main deck, not to holder."""
    (line,) = lines
    found = INCLUDED.search(line.text)
    assert found is not None
    quote = '"' if found.group(1).startswith('"') else ""
    before, after = line.text[: found.start(1)], line.text[found.end(1) :]
    return [f"{before}{quote}{place.as_posix()}{quote}{after}"]


#: No number of a deck is larger, and its square is finite.
LARGEST_VALUE = 1e150


def read_number(text: str) -> float:
    """A number as ccx reads it: 7.1E4, 7.1d4 and 7.1+4 are one. Raises ValueError."""
    plain = re.sub(r"(?<=[\d.])([+-]\d+)$", r"E\1", text.strip().upper().replace("D", "E"))
    value = float(plain)
    if not abs(value) < LARGEST_VALUE:
        raise ValueError(f"{text} is not finite")
    return value
