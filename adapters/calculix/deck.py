"""CalculiX decks: reading with includes, and editing that changes only the lines that must change.

A deck is a list of cards: a keyword line (`*ELASTIC, TYPE=ISO`, which a trailing comma continues)
and its data lines. Comments start with `**`. Every line keeps the file and line number it came
from, so that messages name them and an updated deck differs from the user's in the changed fields
only, includes kept.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from modetune.core.errors import ModelError
from modetune.core.store import writing

#: ccx reads at most this many characters of a number.
FIELD_WIDTH = 20


@dataclass(frozen=True, slots=True)
class Line:
    """One line of a deck without its line end, and where it stands."""

    text: str
    file: Path
    number: int

    @property
    def where(self) -> str:
        return f"{self.file}, line {self.number}"


@dataclass(frozen=True, slots=True)
class Card:
    """A keyword with its options and the positions of its lines in the deck."""

    keyword: str
    options: Mapping[str, str]
    lines: range
    data: tuple[int, ...]

    def option(self, name: str) -> str:
        """An option's value in upper case, empty where it is not given."""
        return self.options.get(name, "")


@dataclass(frozen=True, slots=True)
class Deck:
    """A deck with its includes in place: lines as they stand, and the cards they form."""

    file: Path
    lines: tuple[Line, ...]
    cards: tuple[Card, ...]
    files: tuple[Path, ...]

    def named(self, *keywords: str) -> list[Card]:
        """All cards of these keywords, in order."""
        return [card for card in self.cards if card.keyword in keywords]

    def where(self, card: Card) -> str:
        return self.lines[card.lines.start].where

    def fields(self, position: int) -> list[str]:
        """The comma-separated fields of one data line, stripped."""
        return [field.strip() for field in self.lines[position].text.split(",")]

    def rows(self, card: Card) -> Iterable[list[str]]:
        """The card's data with continued lines (trailing comma) joined."""
        row: list[str] = []
        for position in card.data:
            fields = self.fields(position)
            row += fields if fields[-1] else fields[:-1]
            if fields[-1]:
                yield row
                row = []
        if row:
            yield row


def read_deck(path: Path) -> Deck:
    """Read a deck and its includes. Raises ModelError naming file and line."""
    lines = tuple(_read_lines(path, ()))
    cards = tuple(_cards(lines))
    if not cards:
        raise ModelError(f"{path} holds no CalculiX keyword (a line that starts with one `*`)")
    return Deck(path, lines, cards, tuple(dict.fromkeys([path, *(line.file for line in lines)])))


def read_text(path: Path) -> str:
    """The text of a deck file, bytes that are no UTF-8 kept. Raises ModelError."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path} cannot be read: {error.strerror}") from error
    if b"\0" in data:
        raise ModelError(f"{path} is not a text file: it holds zero bytes")
    return data.decode("utf-8", "surrogateescape")


def _read_lines(path: Path, above: tuple[Path, ...]) -> Iterable[Line]:
    if path in above:
        raise ModelError(f"{path} includes itself by way of {above[-1]}")
    for number, text in enumerate(read_text(path).splitlines(), start=1):
        line = Line(text, path, number)
        if not re.match(r"\s*\*\s*INCLUDE", text, re.IGNORECASE):
            yield line
            continue
        found = re.search(r"INPUT\s*=\s*(\"[^\"]*\"|[^,]+)", text, re.IGNORECASE)
        if found is None:
            raise ModelError(f"{line.where}: *INCLUDE needs INPUT=file")
        target = path.parent / found.group(1).strip().strip('"')
        if not target.is_file():
            raise ModelError(f"{line.where}: the included file {target} is not there")
        yield from _read_lines(target, (*above, path))


def _cards(lines: tuple[Line, ...]) -> Iterable[Card]:
    start, header, data = 0, "", list[int]()
    open_header = False
    for position, line in enumerate(lines):
        text = line.text.strip()
        if not text or text.startswith("**"):
            continue
        if open_header:
            header += text
            open_header = text.endswith(",")
        elif text.startswith("*"):
            if header:
                yield _card(header, range(start, position), data)
            start, header, data = position, text, []
            open_header = text.endswith(",")
        elif header:
            data.append(position)
        else:
            raise ModelError(f"{line.where}: data before the first keyword: {text[:40]!r}")
    if header:
        yield _card(header, range(start, len(lines)), data)


def _card(header: str, lines: range, data: list[int]) -> Card:
    # Blanks carry no meaning in a keyword line; names are not case sensitive.
    keyword, *options = header.upper().split(",")
    pairs = (option.partition("=") for option in options)
    settings = {name.strip(): value.strip().strip('"') for name, _, value in pairs if name.strip()}
    return Card(" ".join(keyword.split()).replace("* ", "*"), settings, lines, tuple(data))


def format_number(value: float) -> str:
    """A number in at most 20 characters, as many as ccx reads."""
    text = repr(float(value))
    return text if len(text) <= FIELD_WIDTH else f"{value:.12e}"


def replace_field(text: str, place: int, value: str) -> str:
    """A data line with one of its comma-separated fields replaced, blanks round it kept."""
    fields = text.split(",")
    old = fields[place]
    lead = old[: len(old) - len(old.lstrip())]
    tail = old[len(old.rstrip()) :] if old.strip() else ""
    fields[place] = f"{lead}{value}{tail}"
    return ",".join(fields)


def write_edited(deck: Deck, changed: Mapping[int, str], folder: Path) -> Path:
    """Write the deck and its includes with some lines changed; all else stays byte for byte.

    changed: position of a line in the deck to its new text. Files keep their places relative to
    the main deck; an include from outside the main deck's folder is refused.
    Returns the main file's path in `folder`. Raises ModelError, StorageUnavailable.
    """
    edits: dict[Path, dict[int, str]] = {file: {} for file in deck.files}
    for position, text in changed.items():
        line = deck.lines[position]
        edits[line.file][line.number] = text
    for file, lines in edits.items():
        pieces = read_text(file).splitlines(keepends=True)
        for number, text in lines.items():
            old = pieces[number - 1]
            pieces[number - 1] = text + old[len(old.rstrip("\r\n")) :]
        target = folder / _relative(file, deck.file)
        with writing(target) as part:
            part.write_bytes("".join(pieces).encode("utf-8", "surrogateescape"))
    return folder / deck.file.name


def _relative(file: Path, main: Path) -> Path:
    try:
        return file.resolve().relative_to(main.parent.resolve())
    except ValueError:
        raise ModelError(
            f"the include {file} lies outside {main.parent}: the updated deck cannot keep its "
            "place; move it below the main deck's folder"
        ) from None
