"""`model.command`: a program that modetune has no adapter for, described by its user."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from modetune.adapters.command.settings import CommandSettings, NumberRule
from modetune.core.modes import COMPONENTS
from modetune.flows.campaign.site import Word
from modetune.flows.responses.section import Name, Section

Number = Annotated[int, Field(ge=1)]
Delimiter = Annotated[str, Field(pattern=r"^[^\w\s.:=-]{1,8}$")]


class EditSection(Section):
    """Where a number of the deck stands that has no placeholder."""

    parameter: Name
    """The parameter that scales it."""
    file: str | None = None
    """Which of `inputs` it stands in; without it the deck."""
    line: Number | None = None
    """Its line, with `field` or `columns`."""
    field: Number | None = None
    """Which word of the line: between commas, or between blanks where the line has none."""
    columns: tuple[Number, Number] | None = None
    """First and last column, for decks of fixed fields."""
    pattern: str | None = None
    """A regular expression with one group, the number, wherever it matches."""
    format: str = ""
    """How it is written, `12.5E`; without it all digits, in `columns` as many as fit."""

    @model_validator(mode="after")
    def _placed(self) -> EditSection:
        by_line = [key for key in ("field", "columns") if getattr(self, key) is not None]
        if (self.line is None) == (self.pattern is None) or len(by_line) != (self.line is not None):
            raise ValueError("give `line` with `field` or `columns`, or `pattern`")
        if self.columns is not None and self.columns[0] > self.columns[1]:
            raise ValueError("columns: the first must not be behind the last")
        return self

    def rule(self) -> NumberRule:
        """The edit as the adapter has it."""
        return NumberRule(
            self.parameter,
            self.file,
            self.line or 0,
            self.field or 0,
            self.columns or (0, 0),
            self.pattern or "",
            self.format,
        )


class CommandSection(Section):
    """The program of `solver: command`: how it is started, and what it leaves. Its files are named
    relative to the deck."""

    run: Annotated[tuple[Word, ...], Field(min_length=1)]
    """Program and arguments, one a word, no shell: `[abaqus, "job={job}", interactive]`. {deck},
    {job} (the deck without its ending), {cores}, {folder} and {python} stand for those of the
    job."""
    version: Annotated[str, Field(min_length=1)] | Annotated[tuple[Word, ...], Field(min_length=1)]
    """The program's version, or the command line that prints it: results of another version are
    other results."""
    name: Name = "command"
    """What the program is called in tables and in `run.licences`."""
    nodes: str
    """File of the nodes that results have: `node,x,y,z` as CSV, a universal file, or HDF5; lines
    and faces in it are drawn."""
    components: Annotated[
        tuple[Literal["x", "y", "z", "rx", "ry", "rz"], ...], Field(min_length=1)
    ] = ("x", "y", "z")
    """Which motions results have at each node."""
    results: str | None = None
    """File that the program leaves with frequencies and shapes: .csv, .unv, .h5, .op2, .f06, .pch
    or .frd."""
    reader: str | None = None
    """In place of `results` a function that reads them, `file.py:function` or
    `package.module:function`."""
    normalisation: Literal["mass", "max", "unknown"] = "mass"
    """How the program scales shapes, where the file does not tell."""
    most_modes: Number | None = None
    """How many modes the deck gives at most, where that is fewer than are asked for."""
    inputs: tuple[str, ...] = ()
    """More files that the deck needs beside it; numbers may stand in them too."""
    delimiters: tuple[Delimiter, Delimiter] = ("{", "}")
    """What stands around placeholders."""
    edits: tuple[EditSection, ...] = ()
    """Where numbers without a placeholder stand."""
    success: tuple[str, ...] = ()
    """Patterns that each must be found in a line of `logs`: without them a run has failed."""
    fatal: tuple[str, ...] = ()
    """Patterns of lines by which the program refuses a deck."""
    logs: tuple[str, ...] = ("solver.log",)
    """Files that both are looked for in, `*.msg`; solver.log is what the program prints."""
    exit_codes: Annotated[tuple[int, ...], Field(min_length=1)] = (0,)
    """Codes that the program ends with after a good run."""

    @model_validator(mode="after")
    def _one_form(self) -> CommandSection:
        if (self.results is None) == (self.reader is None):
            raise ValueError("give either `results` or `reader`")
        outside = [
            name
            for name in (*self.inputs, self.results or "")
            if name.startswith("/") or ".." in name.split("/")
        ]
        if outside:
            raise ValueError(f"{outside[0]} is not in the deck's folder, or below it")
        return self

    def settings(self, metres: float) -> CommandSettings:
        """The program as the adapter has it; metres: of the deck's unit of length."""
        return CommandSettings(
            name=self.name,
            run=self.run,
            version=self.version,
            nodes=self.nodes,
            results=self.results or "",
            reader=self.reader or "",
            components=tuple(COMPONENTS.index(name) + 1 for name in self.components),
            normalisation=self.normalisation,
            inputs=self.inputs,
            delimiters=self.delimiters,
            edits=tuple(item.rule() for item in self.edits),
            most_modes=self.most_modes or 0,
            success=self.success,
            fatal=self.fatal,
            logs=self.logs,
            exit_codes=self.exit_codes,
            metres=metres,
        )
