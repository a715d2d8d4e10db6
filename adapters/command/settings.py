"""The campaign's description of a program that has no adapter."""

from __future__ import annotations

from dataclasses import dataclass

from modetune.core.modes import Normalisation

#: Placeholders for properties of the job in a program's arguments.
ARGUMENTS = ("deck", "job", "cores", "folder", "python")


@dataclass(frozen=True, slots=True)
class NumberRule:
    """The place of a number that has no placeholder in the deck.

    parameter: what it is called. file: which of the deck's files, by name; None: the deck itself.
    line: counted from 1, with the field (words between commas, or blanks where there is no comma)
    or the columns, both counted from 1; or pattern: a regular expression whose one group is the
    number, wherever it matches. form: how the number is written, empty for all of its digits.
    """

    parameter: str
    file: str | None = None
    line: int = 0
    field: int = 0
    columns: tuple[int, int] = (0, 0)
    pattern: str = ""
    form: str = ""


@dataclass(frozen=True, slots=True)
class CommandSettings:
    """A program as its campaign describes it.

    run: its arguments, with ARGUMENTS in braces. version: a text, or arguments that print it.
    results: the file of a job's folder that holds the modes; reader: a function that reads them
    from the folder instead, `file.py:function` or `package.module:function`. nodes: file of the
    nodes that results have; components: 1..6, which of their motions. inputs: more files of the
    deck, by their names in its folder. depends: files and folders that the program reads besides;
    environment: variables that change its results. delimiters: around placeholders. most_modes: the
    largest number of modes that the deck gives. success, fatal: regular expressions for lines of
    `logs` (patterns of file names). metres: of the deck's unit of length, NaN where unknown.
    """

    name: str
    run: tuple[str, ...]
    version: str | tuple[str, ...]
    nodes: str
    results: str = ""
    reader: str = ""
    components: tuple[int, ...] = (1, 2, 3)
    normalisation: Normalisation = "mass"
    inputs: tuple[str, ...] = ()
    depends: tuple[str, ...] = ()
    environment: tuple[str, ...] = ()
    delimiters: tuple[str, str] = ("{", "}")
    edits: tuple[NumberRule, ...] = ()
    most_modes: int = 0
    success: tuple[str, ...] = ()
    fatal: tuple[str, ...] = ()
    logs: tuple[str, ...] = ("solver.log",)
    exit_codes: tuple[int, ...] = (0,)
    metres: float = float("nan")
