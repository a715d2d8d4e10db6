"""CalculiX behind the solver seam."""

from __future__ import annotations

import hashlib
import os
import shutil
import tempfile
import threading
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from modetune.adapters.calculix.deck import read_deck, write_edited
from modetune.adapters.calculix.footprint import footprint_of
from modetune.adapters.calculix.frd import with_frd
from modetune.adapters.calculix.geometry import read_geometry
from modetune.adapters.calculix.incidence import Incidence, read_incidence
from modetune.adapters.calculix.job import job_text
from modetune.adapters.calculix.matrices import read_matrices
from modetune.adapters.calculix.model import CalculixModel, understand
from modetune.adapters.calculix.observation import observe
from modetune.adapters.calculix.results import (
    SolverMessage,
    read_messages,
    read_modal,
    read_version,
)
from modetune.adapters.process import LOG, as_block, log_tail, run_process
from modetune.adapters.solver import (
    Analysis,
    Capabilities,
    Command,
    Footprint,
    ModalAnalysis,
    ModelSummary,
)
from modetune.core.errors import (
    ModelError,
    SolverCrashed,
    SolverExhausted,
    SolverMissing,
    SolverRejected,
)
from modetune.core.keys import Json
from modetune.core.mesh import Mesh
from modetune.core.modes import Integers
from modetune.core.observation import Observation
from modetune.core.parameters import Parameter, Quantity, Values
from modetune.core.results import MatrixResult, Result

JOB = "job"
#: Names another program than `ccx` on PATH.
PROGRAM_VARIABLE = "MODETUNE_CCX"
#: Stiffness and mass matrices are linear in these.
LINEAR: frozenset[Quantity] = frozenset({"youngs_modulus", "density", "spring_stiffness", "mass"})
MISSING = (
    "the CalculiX program `{program}` is not on this machine; install it (Debian and Ubuntu: "
    "`apt-get install calculix-ccx`) or name it with " + PROGRAM_VARIABLE
)


@dataclass(frozen=True)
class CalculixSolver:
    """CalculiX bound to one deck and the parameters that edit it."""

    deck: CalculixModel
    parameters: tuple[Parameter, ...]
    program: str
    #: Whether modal jobs leave their shapes in job.frd too, for pictures.
    with_frd: bool = False

    name = "calculix"
    #: Raised by hand when the same ccx output is read to other numbers.
    reader_version = 1
    capabilities = Capabilities(strain_energies=True, matrices=True, matrix_modes=True)

    @property
    def model(self) -> ModelSummary:
        return self.deck.summary

    @cached_property
    def _mesh(self) -> Mesh:
        return read_geometry(self.deck.deck, self.model.node_ids)

    def mesh(self) -> Mesh:
        return self._mesh

    @cached_property
    def _version(self) -> str:
        if shutil.which(self.program) is None:
            raise SolverMissing(MISSING.format(program=self.program))
        with tempfile.TemporaryDirectory(prefix="modetune-") as folder:
            command = Command((self.program, "-v"))
            run_process(command, Path(folder), 60.0, threading.Event())
            banner = (Path(folder) / LOG).read_text(errors="replace")
        version = read_version(banner)
        if not version:
            raise SolverMissing(f"`{self.program} -v` printed no CalculiX version: {banner[:80]!r}")
        return version

    def version(self) -> str:
        return self._version

    def problems(self, parameters: tuple[Parameter, ...]) -> list[str]:
        found = []
        owners: dict[tuple[int, int], str] = {}
        for parameter in parameters:
            try:
                fields = self.deck.fields(parameter)
            except ModelError as error:
                found.append(f"parameter {parameter.name}: {error}")
                continue
            for field in fields:
                first = owners.setdefault((field.line, field.place), parameter.name)
                if first != parameter.name:
                    where = self.deck.deck.lines[field.line].where
                    found.append(f"{where}: both {first} and {parameter.name} change this number")
        return found

    def deck_value(self, parameter: Parameter) -> float:
        return self.deck.fields(parameter)[0].value

    def written(self, parameter: Parameter, value: float) -> float:
        return value

    def wave_speeds(self) -> dict[str, float]:
        return self.deck.wave_speeds()

    def energy_sets(self, parameter: Parameter) -> tuple[str, ...]:
        return self.deck.energy_sets(parameter)

    def is_linear(self, parameter: Parameter) -> bool:
        return parameter.quantity in LINEAR

    @cached_property
    def _incidence(self) -> Incidence:
        return read_incidence(self.deck.deck, self.deck.mesh)

    def footprint(self, parameter: Parameter) -> Footprint | None:
        if parameter.quantity not in LINEAR and parameter.quantity != "thickness":
            return None
        return self.footprint_of({field.line for field in self.deck.fields(parameter)})

    def footprint_of(self, lines: Collection[int]) -> Footprint | None:
        """What the numbers in these lines of the deck move, as one relative value of theirs."""
        return footprint_of(self.deck, self._incidence, self.mesh(), lines)

    def observation(
        self, matrices: MatrixResult, nodes: Integers, components: Integers
    ) -> Observation:
        return observe(
            self.deck, self._incidence, matrices.nodes, matrices.components, nodes, components
        )

    def content(self, values: Values, analysis: Analysis) -> Json:
        text = self._text(values, analysis)
        modal = isinstance(analysis, ModalAnalysis)
        return {
            "solver": self.name,
            "version": self.version(),
            "reader": self.reader_version,
            "deck": hashlib.sha256(text.encode("utf-8", "surrogateescape")).hexdigest(),
            "analysis": "modal" if modal else "matrices",
            "n_modes": analysis.n_modes if isinstance(analysis, ModalAnalysis) else 0,
            "groups": [[name, list(sets)] for name, sets in analysis.groups]
            if isinstance(analysis, ModalAnalysis)
            else [],
        }

    def write(self, values: Values, analysis: Analysis, folder: Path) -> None:
        text = self._text(values, analysis)
        (folder / f"{JOB}.inp").write_bytes(text.encode("utf-8", "surrogateescape"))

    def command(self, threads: int) -> Command:
        count = str(threads)
        names = ("OMP_NUM_THREADS", "CCX_NPROC_STIFFNESS", "CCX_NPROC_EQUATION_SOLVER")
        return Command((self.program, "-i", JOB), tuple((name, count) for name in names))

    def read(self, values: Values, analysis: Analysis, folder: Path, return_code: int) -> Result:
        log = (folder / LOG).read_text(errors="replace")
        messages = read_messages(log)
        if messages:
            said = as_block("\n".join(message.text for message in messages))
            place = self._place(messages, self._changed(values))
            if "memory" in said.lower():
                raise SolverExhausted(f"CalculiX ran out of memory in {folder}:\n{said}")
            if "aupd" in said and isinstance(analysis, ModalAnalysis):  # ARPACK refused its sizes
                said += f"\n  {analysis.n_modes} modes want some more unknowns than the model has"
            raise SolverRejected(f"CalculiX refused the deck {place} (job in {folder}):\n{said}")
        if return_code != 0 or "Job finished" not in log:
            raise SolverCrashed(
                f"CalculiX ended in {folder} with code {return_code} and without its closing "
                f"line\n{log_tail(folder)}"
            )
        if isinstance(analysis, ModalAnalysis):
            point_mass = self.deck.point_mass(self._changed(values))
            return read_modal(folder / f"{JOB}.dat", analysis, point_mass)
        return read_matrices(folder, JOB)

    def write_updated(self, values: Values, folder: Path) -> Path:
        return write_edited(self.deck.deck, self._changed(values), folder)

    def _text(self, values: Values, analysis: Analysis) -> str:
        text = job_text(self.deck, self._changed(values), analysis)
        return with_frd(text) if self.with_frd and isinstance(analysis, ModalAnalysis) else text

    def _changed(self, values: Values) -> dict[int, str]:
        return self.deck.edit((p, values[p.name]) for p in self.parameters if p.name in values)

    def _place(self, messages: list[SolverMessage], changed: Mapping[int, str]) -> str:
        """Where the user's deck has what the messages speak of, the file alone where none tells.

        A message may quote a line (in upper case without blanks, often below the first message),
        name an element, or at least the keyword, which tells if there is one such card.
        """
        lines = self.deck.deck.lines
        squeezed: dict[str, int] = {}
        for position, line in enumerate(lines):
            text = "".join(changed.get(position, line.text).upper().split())
            squeezed.setdefault(text, position)
        quoted = ("".join(message.card_image.upper().split()) for message in messages)
        found = [squeezed[text] for text in quoted if text and text in squeezed]
        elements = self.deck.mesh.elements
        found += [elements[m.element].line for m in messages if m.element in elements]
        cards = (self.deck.deck.named(message.keyword) for message in messages)
        found += [named[0].lines.start for named in cards if len(named) == 1]
        if found:
            return f"at {lines[found[0]].where}"
        return str(self.deck.deck.file)


def calculix_solver(deck: Path, parameters: tuple[Parameter, ...]) -> CalculixSolver:
    """CalculiX for a deck file. Raises ModelError where the deck cannot be understood."""
    program = os.environ.get(PROGRAM_VARIABLE, "ccx")
    return CalculixSolver(understand(read_deck(deck)), parameters, program)
