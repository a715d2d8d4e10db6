"""Decks as files: the lines of a main file and its includes, and writing them back edited.

Every line keeps the file and line number it came from, so that messages name them and an updated
deck differs from the user's in the changed lines only, includes kept. How a solver names an
include and where it looks for it is the adapter's to say.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from modetune.adapters.regular_file import largest, read_errors, read_regular
from modetune.core.errors import ModelError
from modetune.core.storage.files import writing

#: Folder of an updated deck for includes that the solver would not find at their own place.
INCLUDES = "includes"


class Line(NamedTuple):
    """One line of a deck without its line end, and its file and number.

    added: the file does not have it; it goes behind the file's line of that number.
    """

    text: str
    file: Path
    number: int
    added: bool = False

    @property
    def where(self) -> str:
        return f"{self.file}, line {self.number}"


@dataclass(frozen=True, slots=True)
class Include:
    """The lines that bring in another file, and that file.

    keeps_place: whether the same lines find the file from an updated deck that keeps the file's
    place relative to the main deck's folder.
    """

    lines: tuple[Line, ...]
    target: Path
    keeps_place: bool


#: Includes nest some three deep and decks of whole vehicles have some hundreds of them; more are an
#: error of some script, as are files that include each other over and over.
DEEPEST, MOST_INCLUDES = 100, 2_000
#: What a line of a deck takes in memory, bytes.
LINE_BYTES = 250

#: Characters of a line; solvers read some hundred, and scripts write long lists in one line.
LONGEST_LINE = 500_000
#: A carriage return with text of another line behind it.
LONE_RETURN = re.compile(rb"\r(?![\r\n]|\Z)")
#: More digits than the largest floating-point number has.
DIGITS = 308
LONG_NUMBER = re.compile(rb"\d{%d,}" % (DIGITS + 1))
#: New texts of an include's lines: the lines, then the target's and the including file's places in
#: the updated deck, relative to its main file's folder.
Renamed = Callable[[Sequence[Line], Path, Path], list[str]]


def read_text(path: Path) -> str:
    """Return the text of a deck file, bytes that are not UTF-8 kept. Raises ModelError."""
    with read_errors(path, ModelError):
        data = read_regular(path)
    if b"\0" in data:
        number = data.count(b"\n", 0, data.index(b"\0")) + 1
        raise ModelError(f"{path}, line {number}: not a text file, it holds zero bytes")
    longest = largest_line(data)
    if longest > LONGEST_LINE:
        number = next(n for n, text in enumerate(data.split(b"\n"), 1) if len(text) == longest)
        raise ModelError(
            f"{path}, line {number} has {longest:,} characters, more than a solver reads in a "
            "line; is it a deck?"
        )
    if found := LONE_RETURN.search(data):
        number = data.count(b"\n", 0, found.start()) + 1
        raise ModelError(
            f"{path}, line {number}: a line ends with a carriage return (CR) alone, where solvers "
            "end no line; convert the file to LF or CRLF line ends (`mac2unix`)"
        )
    if longest > DIGITS:
        for number, line in enumerate(data.split(b"\n"), 1):
            if digits := LONG_NUMBER.search(line):
                raise ModelError(
                    f"{path}, line {number}: {len(digits.group())} digits in a row are no number "
                    "that a solver reads"
                )
    return data.decode("utf-8", "surrogateescape")


def text_with(
    file: Path,
    before: int,
    lines: Sequence[str],
    mark: str = "",
    comments: Iterable[int] = (),
) -> str:
    """Return a file's text with lines before the one of this number (from 1), 0 for its end.

    New lines end as the first line of the file does. comments: numbers of lines that become
    comments, by a mark before them. Raises ModelError.
    """
    pieces = read_text(file).split("\n")
    for number in comments:
        pieces[number - 1] = mark + pieces[number - 1]
    end = "\r" if pieces[0].endswith("\r") else ""
    if not before and pieces[-1]:
        pieces.append("")  # the last line had no end
    place = before - 1 if before else len(pieces) - 1
    return "\n".join([*pieces[:place], *(line + end for line in lines), *pieces[place:]])


def largest_line(data: bytes) -> int:
    """The length of the longest line."""
    return max(map(len, data.split(b"\n")))


def check_include(
    include: Include, above: Sequence[Path], lines: Sequence[Line], includes: Sequence[Include]
) -> None:
    """Raise ModelError where another include would be one of an endless series.

    above: the files, resolved, that lead to the include; lines, includes: read so far.
    """
    where = include.lines[0].where
    if include.target.resolve() in above:
        raise ModelError(f"{where}: {include.target} includes itself")
    if len(above) > DEEPEST:
        raise ModelError(f"{where}: files include each other more than {DEEPEST} deep")
    if len(includes) >= MOST_INCLUDES:
        raise ModelError(f"{where}: the deck has more than {MOST_INCLUDES} includes")
    if len(lines) * LINE_BYTES > largest(0.5):
        raise ModelError(
            f"{where}: the deck has more than {len(lines)} lines with its includes, more than this "
            "machine's memory holds"
        )


def with_added(
    lines: Sequence[Line], changed: Mapping[int, str], added: Mapping[int, Iterable[str]]
) -> tuple[Line, ...]:
    """Return lines of a deck, some with other texts, some with new lines behind them.

    changed, added: position of a line to its text, or to the texts of the lines behind it.
    """
    found: list[Line] = []
    for position, line in enumerate(lines):
        found.append(line._replace(text=changed.get(position, line.text)))
        found += (Line(text, line.file, line.number, True) for text in added.get(position, ()))
    return tuple(found)


def write_edited(
    main: Path,
    lines: Sequence[Line],
    includes: Sequence[Include],
    changed: Mapping[int, str],
    renamed: Renamed,
    folder: Path,
) -> Path:
    """Write a deck and its includes with some lines changed; all else stays byte for byte.

    changed: index into lines to the new text; lines that were added and texts that were changed
    since the deck was read are written too. Includes keep their places relative to the main
    file; one that the solver could not find there (an absolute path, a path that leads out of the
    main file's folder) goes into the folder `includes`, and the lines that name it are the only
    others that change. Returns the main file's path in `folder`. Raises ModelError,
    StorageUnavailable.
    """
    places = _places(main, includes)
    edits: dict[Path, dict[int, str]] = {file: {} for file in places}
    for include in includes:
        if not include.keeps_place:
            holder = include.lines[0].file
            texts = renamed(include.lines, places[include.target], places[holder])
            numbers = [line.number for line in include.lines]
            edits[holder].update(zip(numbers, texts, strict=True))
    behind: dict[Path, dict[int, list[str]]] = {file: {} for file in places}
    pieces = {file: read_text(file).split("\n") for file in places}
    for position, line in enumerate(lines):
        if line.added:
            text = changed.get(position, line.text)
            behind[line.file].setdefault(line.number, []).append(text)
        elif position in changed:
            edits[line.file][line.number] = changed[position]
        elif line.text != pieces[line.file][line.number - 1].rstrip("\r"):
            edits[line.file].setdefault(line.number, line.text)  # the file may be included twice
    for file, texts in pieces.items():
        for number in edits[file].keys() | behind[file].keys():
            old, added = texts[number - 1], behind[file].get(number, ())
            end = "\r" if old.endswith("\r") else ""
            text = edits[file].get(number, old.removesuffix(end))
            texts[number - 1] = f"{end}\n".join([text, *added]) + end
        with writing(folder / places[file]) as part:
            part.write_bytes("\n".join(texts).encode("utf-8", "surrogateescape"))
    return folder / main.name


def _places(main: Path, includes: Sequence[Include]) -> dict[Path, Path]:
    """Return every file of a deck and where an updated deck has it, relative to the main file."""
    places = {main: Path(main.name)}
    for include in includes:
        if include.keeps_place:
            relative = os.path.relpath(include.target, main.parent)
            places.setdefault(include.target, Path(relative))
    for include in includes:
        place = Path(INCLUDES) / include.target.name
        count = 1
        while include.target not in places and place in places.values():
            count += 1
            place = Path(INCLUDES) / f"{include.target.stem}_{count}{include.target.suffix}"
        places.setdefault(include.target, place)
    return places
