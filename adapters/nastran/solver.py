"""Nastran and MYSTRAN behind the solver seam."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from modetune.adapters.nastran.deck import read_deck, with_lines, write_edited
from modetune.adapters.nastran.design_sensitivity import read_dscm2
from modetune.adapters.nastran.dialect import DECK, DIALECTS, Dialect, DialectName
from modetune.adapters.nastran.f06 import F06, FatalMessage, licence_denied, read_f06
from modetune.adapters.nastran.geometry import read_geometry
from modetune.adapters.nastran.job import job_text
from modetune.adapters.nastran.model import NastranModel, understand
from modetune.adapters.nastran.op2 import read_op2
from modetune.adapters.nastran.results import completed, modal_result, mode_derivatives
from modetune.adapters.process import LOG, as_block, log_tail
from modetune.adapters.solver import (
    Analysis,
    Capabilities,
    Command,
    Footprint,
    ModalAnalysis,
    ModelSummary,
    SensitivityAnalysis,
)
from modetune.core.errors import (
    LicenceDenied,
    ModesError,
    NoResult,
    SolverCrashed,
    SolverExhausted,
    SolverRejected,
)
from modetune.core.keys import Json
from modetune.core.mesh import Mesh
from modetune.core.modes import Integers
from modetune.core.observation import Observation, nothing_known
from modetune.core.parameters import Parameter, Values
from modetune.core.results import MatrixResult, ModalResult, ModeDerivatives, Result

#: Fatal messages that a machine with more memory or disk would not give.
RESOURCES = re.compile(
    r"INSUFFICIENT (?:\w+ )*(?:MEMORY|CORE|SPACE|STORAGE)|UNABLE TO ALLOCATE|OUT OF MEMORY|"
    r"NO (?:MORE )?(?:DISK )?SPACE|DISK(?: IS)? FULL|DISK QUOTA|ERROR OCCURR?ED IN WRITING|"
    r"CANNOT ALLOCATE|ALLOCATION (?:ERROR|FAILED)",
    re.IGNORECASE,
)
#: Cards of which MYSTRAN (17, 18) weighs too little; its modes are right.
MISWEIGHED = ("CHEXA", "CPENTA", "CTETRA", "PCOMP", "PCOMPG")
#: A licence is refused before anything is computed: within this many bytes of each file.
HEAD_BYTES = 1 << 20
#: Messages of one run that an error shows.
SHOWN = 5


@dataclass(frozen=True)
class NastranSolver:
    """A program that reads Nastran decks, bound to one deck and the parameters that edit it."""

    deck: NastranModel
    parameters: tuple[Parameter, ...]
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

    @cached_property
    def model(self) -> ModelSummary:
        return self.deck.summary

    @cached_property
    def _mesh(self) -> Mesh:
        return read_geometry(self.deck.bulk)

    def mesh(self) -> Mesh:
        return self._mesh

    def version(self) -> str:
        return self.dialect.version(self.program)

    def problems(self, parameters: tuple[Parameter, ...]) -> list[str]:
        return self.deck.problems(parameters)

    def deck_value(self, parameter: Parameter) -> float:
        return self.deck.places(parameter)[0].value

    def written(self, parameter: Parameter, value: float) -> float:
        return self.deck.written(parameter, value)

    def wave_speeds(self) -> dict[str, float]:
        return self.deck.wave_speeds()

    def energy_sets(self, parameter: Parameter) -> tuple[str, ...]:
        return self.deck.energy_sets(parameter)

    def is_linear(self, parameter: Parameter) -> bool:
        return self.deck.is_linear(parameter)

    def footprint(self, parameter: Parameter) -> Footprint | None:
        return None

    def observation(
        self, matrices: MatrixResult, nodes: Integers, components: Integers
    ) -> Observation:
        return nothing_known(nodes.size, matrices.nodes.size)

    def content(self, values: Values, analysis: Analysis) -> Json:
        text = self._text(values, analysis)
        groups = analysis.groups if isinstance(analysis, ModalAnalysis) else ()
        asked = analysis.parameters if isinstance(analysis, SensitivityAnalysis) else ()
        return {
            "solver": self.name,
            "dialect": self.dialect.name,
            "version": self.version(),
            "reader": self.reader_version,
            "deck": hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest(),
            "analysis": "modal" if isinstance(analysis, ModalAnalysis) else "sensitivity",
            "groups": [[name, list(sets)] for name, sets in groups],
            # The deck numbers them; the values divide what it gives.
            "parameters": [[name, float(values.get(name, 1.0))] for name in asked],
        }

    def write(self, values: Values, analysis: Analysis, folder: Path) -> None:
        text = self._text(values, analysis)
        (folder / DECK).write_bytes(text.encode("utf-8", "surrogateescape"))

    def command(self, threads: int) -> Command:
        return Command(
            self.dialect.arguments(self.program, threads), (("OMP_NUM_THREADS", str(threads)),)
        )

    def read(self, values: Values, analysis: Analysis, folder: Path, return_code: int) -> Result:
        printed = self._judged(self._changed(values), folder, return_code)
        try:
            if isinstance(analysis, SensitivityAnalysis):
                return self._derivatives(values, analysis, folder, printed)
            assert isinstance(analysis, ModalAnalysis)
            return self._modes(analysis, folder, printed)
        except SolverCrashed as error:
            raise NoResult(str(error)) from error
        except (ValueError, ModesError) as error:
            raise NoResult(f"the {self.dialect.title} run in {folder} left {error}") from error

    def write_updated(self, values: Values, folder: Path) -> Path:
        return write_edited(self.deck.deck, self._changed(values), folder)

    def _changed(self, values: Values) -> dict[int, str]:
        return self.deck.edit((p, values[p.name]) for p in self.parameters if p.name in values)

    def _text(self, values: Values, analysis: Analysis) -> str:
        return job_text(self.deck, self._changed(values), analysis, self.dialect, self.parameters)

    def _judged(self, changed: Mapping[int, str], folder: Path, return_code: int) -> F06:
        """What the run printed, if it came to its end; its return code may be 0 in any case.

        Raises LicenceDenied, SolverRejected, SolverExhausted or SolverCrashed.
        """
        title = self.dialect.title
        printed = _read_if_there(folder / self.dialect.print_file)
        # What MYSTRAN finds wrong it says in its error file too, and sometimes only there.
        errors = [_read_if_there(folder / name) for name in self.dialect.logs if "ERR" in name]
        fatal = [m for file in (printed, *errors) if file for m in file.fatal_messages]
        if printed and printed.ended and not fatal:
            return printed
        refusal = self._licence_refusal(folder)
        if refusal:
            raise LicenceDenied(f"{title} got no licence in {folder}: {refusal}")
        if fatal:
            texts = {m.text.partition("\n")[0]: m.text for m in reversed(fatal[:SHOWN])}
            said = as_block("\n".join(reversed(texts.values())))  # two files may say the same
            if RESOURCES.search(said):
                raise SolverExhausted(f"{title} ran out of memory or disk in {folder}:\n{said}")
            place = self._place(fatal, changed)
            raise SolverRejected(f"{title} refused the deck {place} (job in {folder}):\n{said}")
        without = "its closing line" if printed else f"a print file ({self.dialect.print_file})"
        raise SolverCrashed(
            f"{title} ended in {folder} with code {return_code} and without {without}\n"
            f"{log_tail(folder)}"
        )

    def _licence_refusal(self, folder: Path) -> str:
        """What the first file that tells of a refused licence says, empty if none does."""
        for name in (*self.dialect.logs, LOG, self.dialect.print_file):
            path = folder / name
            if path.is_file():
                with path.open("rb") as file:
                    said = licence_denied(file.read(HEAD_BYTES).decode("latin-1"))
                if said:
                    return said
        return ""

    def _place(self, fatal: Iterable[FatalMessage], changed: Mapping[int, str]) -> str:
        """Where the user's deck has what messages speak of, the file alone where none tells.

        A message may quote a card (in fields of eight whatever the deck's format), or name a
        card, or a number of one.
        """
        deck = with_lines(self.deck.deck, changed)
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

    def _modes(self, analysis: ModalAnalysis, folder: Path, printed: F06) -> ModalResult:
        modes = completed(read_op2(folder / self.dialect.result_file), printed)
        elements = [
            frozenset[int]().union(*map(self.deck.set_elements, sets))
            for _, sets in analysis.groups
        ]
        result = modal_result(modes, analysis, elements, self.deck.wtmass)
        doubtful = self.dialect.name == "mystran" and self.deck.deck.named(*MISWEIGHED)
        return replace(result, mass=math.nan) if doubtful else result

    def _derivatives(
        self, values: Values, analysis: SensitivityAnalysis, folder: Path, printed: F06
    ) -> ModeDerivatives:
        found = read_dscm2(folder / self.dialect.result_file)
        at = [values.get(name, 1.0) for name in analysis.parameters]
        return mode_derivatives(found, analysis, at, printed.eigenvalues[: analysis.n_modes])


def _read_if_there(path: Path) -> F06 | None:
    return read_f06(path) if path.is_file() else None


def _squeezed(text: str) -> str:
    """A card without what differs between its formats."""
    return re.sub(r"[\s,]", "", text.split("$", 1)[0]).upper()


def nastran_solver(
    deck: Path, parameters: tuple[Parameter, ...], dialect: DialectName = "msc"
) -> NastranSolver:
    """MSC Nastran or Simcenter (NX) Nastran for a deck file.

    Raises ModelError where the deck cannot be understood, or means no job that can be written.
    """
    return _solver(deck, parameters, DIALECTS[dialect])


def mystran_solver(deck: Path, parameters: tuple[Parameter, ...]) -> NastranSolver:
    """MYSTRAN for a deck file. Raises ModelError, as nastran_solver and for all cards it lacks."""
    return _solver(deck, parameters, DIALECTS["mystran"])


def _solver(deck: Path, parameters: tuple[Parameter, ...], dialect: Dialect) -> NastranSolver:
    model = understand(read_deck(deck))
    job_text(model, {}, ModalAnalysis(1, ()), dialect)  # what no job can carry is told at once
    return NastranSolver(model, parameters, dialect, dialect.program_name())
