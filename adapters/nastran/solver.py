"""Nastran and MYSTRAN behind the solver seam."""

from __future__ import annotations

import hashlib
import logging
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from modetune.adapters.cross_checks import without_spare
from modetune.adapters.licence import licence_refusal
from modetune.adapters.nastran.case_control import choice_note, parts_note, range_note
from modetune.adapters.nastran.deck import read_deck, with_lines
from modetune.adapters.nastran.design import mode_derivatives, read_dscm2
from modetune.adapters.nastran.dialect import DECK, DIALECTS, Dialect, DialectName
from modetune.adapters.nastran.f06 import F06, FatalMessage, read_f06
from modetune.adapters.nastran.job import job_text
from modetune.adapters.nastran.matrices import STOPPED, read_restart
from modetune.adapters.nastran.model import EditedNastran, NastranModel, understand
from modetune.adapters.nastran.op2 import read_op2
from modetune.adapters.nastran.results import completed, modal_result
from modetune.adapters.process import as_block, log_tail
from modetune.adapters.solver import (
    Analysis,
    Capabilities,
    Command,
    MatrixAnalysis,
    ModalAnalysis,
    Rendered,
    SensitivityAnalysis,
    Solver,
)
from modetune.core.errors import (
    LicenceDenied,
    ModesError,
    NoResult,
    SolverCrashed,
    SolverExhausted,
    SolverRejected,
)
from modetune.core.parameters import Parameter
from modetune.core.storage.keys import Json
from modetune.core.updating.job_results import ModalResult, Result

logger = logging.getLogger(__name__)

#: Fatal messages that a machine with more memory or disk would not give.
RESOURCES = re.compile(
    r"INSUFFICIENT (?:\w+ )*(?:MEMORY|CORE|SPACE|STORAGE)|UNABLE TO ALLOCATE|OUT OF MEMORY|"
    r"NO (?:MORE )?(?:DISK )?SPACE|DISK(?: IS)? FULL|DISK QUOTA|ERROR OCCURR?ED IN WRITING|"
    r"CANNOT ALLOCATE|ALLOCATION (?:ERROR|FAILED)",
    re.IGNORECASE,
)
#: Cards of which MYSTRAN (17, 18) weighs too little, and masses that have one direction alone; its
#: modes are right.
MISWEIGHED = (
    "CHEXA", "CPENTA", "CTETRA", "PCOMP", "PCOMPG", "CMASS1", "CMASS2", "CMASS3", "CMASS4",
)  # fmt: skip
#: What analyses are called in keys.
ANALYSES = {ModalAnalysis: "modal", SensitivityAnalysis: "sensitivity", MatrixAnalysis: "matrices"}
#: Messages of one run that an error shows.
SHOWN = 5


@dataclass(frozen=True)
class NastranProgram:
    """A program that reads Nastran decks."""

    dialect: Dialect
    program: str

    #: Raised by hand when the same output is read to other numbers.
    reader_version = 1

    @property
    def name(self) -> str:
        return "mystran" if self.dialect.name == "mystran" else "nastran"

    @property
    def capabilities(self) -> Capabilities:
        return self.dialect.capabilities

    def version(self) -> str:
        return self.dialect.version(self.program)

    def render(self, deck: EditedNastran, analysis: Analysis) -> Rendered:
        text = job_text(deck.model, deck.changed, analysis, self.dialect, deck.values)
        data = text.encode("utf-8", "surrogateescape")
        groups = analysis.groups if isinstance(analysis, ModalAnalysis) else ()
        asked = analysis.parameters if isinstance(analysis, SensitivityAnalysis) else ()
        content: Json = {
            "solver": self.name,
            "dialect": self.dialect.name,
            "version": self.version(),
            "reader": self.reader_version,
            "deck": hashlib.sha256(data).hexdigest(),
            "analysis": ANALYSES[type(analysis)],
            "groups": [[name, list(sets)] for name, sets in groups],
            # The deck numbers them; the values divide what it gives.
            "parameters": [[name, float(deck.values.get(name, 1.0))] for name in asked],
        }
        return Rendered.of_texts(content, {DECK: data})

    def command(self, threads: int) -> Command:
        return Command(
            self.dialect.arguments(self.program, threads), (("OMP_NUM_THREADS", str(threads)),)
        )

    def read(
        self, deck: EditedNastran, analysis: Analysis, folder: Path, return_code: int
    ) -> Result:
        printed = self._judged(deck, analysis, folder, return_code)
        try:
            if isinstance(analysis, SensitivityAnalysis):
                at = [deck.values.get(name, 1.0) for name in analysis.parameters]
                return mode_derivatives(read_dscm2(folder / self.dialect.result_file), analysis, at)
            if isinstance(analysis, MatrixAnalysis):
                grids = deck.model.summary.node_ids
                return read_restart(folder, self.dialect.print_file, grids)
            return self._modes(deck.model, analysis, folder, printed)
        except SolverCrashed as error:
            raise NoResult(str(error)) from error
        except (ValueError, ModesError) as error:
            raise NoResult(f"the {self.dialect.title} run in {folder} left {error}") from error

    def _judged(
        self, edited: EditedNastran, analysis: Analysis, folder: Path, return_code: int
    ) -> F06:
        """What the run printed, if it came to its end; its return code may be 0 in any case.

        A run for matrices has come to its end where it was made to stop.

        Raises LicenceDenied, SolverRejected, SolverExhausted or SolverCrashed.
        """
        title = self.dialect.title
        matrices = isinstance(analysis, MatrixAnalysis)
        printed = _read_if_there(folder / self.dialect.print_file, tables=not matrices)
        # What MYSTRAN finds wrong it says in its error file too, and sometimes only there.
        errors = [
            _read_if_there(folder / name, False) for name in self.dialect.logs if "ERR" in name
        ]
        fatal = [m for file in (printed, *errors) if file for m in file.fatal_messages]
        others = [m for m in fatal if not (matrices and STOPPED.search(m.text))]
        if printed and not others and (printed.ended or fatal):
            return printed
        refusal = licence_refusal(folder)
        if refusal:
            raise LicenceDenied(f"{title} got no licence in {folder}: {refusal}")
        if fatal:
            texts = {m.text.partition("\n")[0]: m.text for m in reversed(fatal[:SHOWN])}
            text = as_block("\n".join(reversed(texts.values())))  # two files may say the same
            if RESOURCES.search(text):
                raise SolverExhausted(f"{title} ran out of memory or disk in {folder}:\n{text}")
            place = _place(fatal, edited)
            raise SolverRejected(f"{title} refused the deck {place} (job in {folder}):\n{text}")
        without = "its closing line" if printed else f"a print file ({self.dialect.print_file})"
        raise SolverCrashed(
            f"{title} ended in {folder} with code {return_code} and without {without}\n"
            f"{log_tail(folder)}"
        )

    def _modes(
        self, model: NastranModel, analysis: ModalAnalysis, folder: Path, printed: F06
    ) -> ModalResult:
        modes = completed(read_op2(folder / self.dialect.result_file), printed.modes)
        elements = [
            frozenset[int]().union(*map(model.set_elements, sets)) for _, sets in analysis.groups
        ]
        result = without_spare(modal_result(modes, analysis, elements, model.wtmass))
        doubtful = self.dialect.name == "mystran" and model.deck.named(*MISWEIGHED)
        return replace(result, mass=math.nan) if doubtful else result


def _place(fatal: Iterable[FatalMessage], edited: EditedNastran) -> str:
    """Return the place in the user's deck that the messages name, or the file.

    A message may quote a card (in fields of eight whatever the deck's format), or name a
    card, or a number of one.
    """
    deck = with_lines(edited.model.deck, edited.changed)
    by_text = {_squeezed(deck.lines[card.lines[0]].text): card for card in reversed(deck.cards)}
    for message in fatal:
        card = by_text.get(_squeezed(message.card_image)) if message.card_image else None
        found = [card] if card else []
        if not found and message.number:
            numbered = [c for c in deck.cards if c.text(1) == str(message.number)]
            found = [c for c in numbered if c.name == message.card] or numbered
        if not found and message.card:
            found = deck.named(message.card)
        if len(found) == 1:
            return f"at {deck.where(found[0])}"
    return str(deck.file)


def _read_if_there(path: Path, tables: bool) -> F06 | None:
    return read_f06(path, tables) if path.exists() else None


def _squeezed(text: str) -> str:
    """A card without what differs between its formats."""
    return re.sub(r"[\s,]", "", text.split("$", 1)[0]).upper()


def nastran_solver(
    deck: Path,
    parameters: tuple[Parameter, ...],
    dialect: DialectName = "msc",
    subcase: int = 0,
) -> Solver:
    """MSC Nastran or Simcenter (NX) Nastran for a deck file.

    subcase: whose modes are wanted, 0 where the deck leaves no choice. Raises ModelError where the
    deck cannot be understood, or means no job that can be written.
    """
    return _solver(deck, parameters, DIALECTS[dialect], subcase)


def mystran_solver(deck: Path, parameters: tuple[Parameter, ...], subcase: int = 0) -> Solver:
    """MYSTRAN for a deck file. Raises ModelError, and for cards that it cannot take."""
    return _solver(deck, parameters, DIALECTS["mystran"], subcase)


def _solver(
    deck: Path, parameters: tuple[Parameter, ...], dialect: Dialect, subcase: int
) -> Solver:
    model = understand(read_deck(deck, subcase), parameters)
    notes = (note(model.deck) for note in (parts_note, choice_note, range_note))
    for note in filter(None, notes):
        logger.warning("%s", note)
    if dialect.name == "mystran":
        model.check()
        has = replace(dialect.capabilities, masses=model.other_masses() or "lumped")
        dialect = replace(dialect, capabilities=has)
    elif model.objections:
        logger.warning(
            "%s: %d of its cards are left to Nastran alone, such as %s",
            deck,
            len(model.objections),
            model.objections[0].text,
        )
    job_text(model, {}, ModalAnalysis(1, ()), dialect)  # what no job can contain is refused at once
    return Solver(model, NastranProgram(dialect, dialect.program_name()))
