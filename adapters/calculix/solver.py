"""The program ccx behind the solver seam: a job of a deck written, started and read."""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import tempfile
import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from modetune.adapters.calculix.cyclic_symmetry import read_cyclic_symmetry
from modetune.adapters.calculix.deck import KeywordDeck, read_deck
from modetune.adapters.calculix.frd import with_frd
from modetune.adapters.calculix.job import NODES, check_frequency_step, job_text, modes_at_most
from modetune.adapters.calculix.model import CalculixModel, EditedCalculix, point_mass
from modetune.adapters.calculix.results import (
    SolverMessage,
    read_messages,
    read_modal,
    read_version,
)
from modetune.adapters.calculix.splitting import split_model
from modetune.adapters.calculix.structure import CalculixStructure, understand
from modetune.adapters.cross_checks import check_energies, mark_of, without_spare
from modetune.adapters.process import as_block, log_tail, read_log, run_process
from modetune.adapters.regular_file import read_errors, read_regular
from modetune.adapters.solver import (
    Analysis,
    Capabilities,
    Command,
    ModalAnalysis,
    Rendered,
    Solver,
)
from modetune.core.algebra.rigid_modes import STRAINED
from modetune.core.errors import (
    NoResult,
    SolverCrashed,
    SolverExhausted,
    SolverMissing,
    SolverRejected,
)
from modetune.core.modes import Floats, ModeSet
from modetune.core.parameters import Parameter
from modetune.core.storage.keys import Json
from modetune.core.updating.job_results import Result

logger = logging.getLogger(__name__)

JOB = "job"
#: Names another program than `ccx` on PATH.
PROGRAM_VARIABLE = "MODETUNE_CCX"
MISSING = (
    "the CalculiX program `{program}` is not on this machine; install it (Debian and Ubuntu: "
    "`apt-get install calculix-ccx`) or name it with " + PROGRAM_VARIABLE
)

#: CalculiX's own shift for free structures, (rad/s)^2: it loses modes far below (a free ring at
#: 0.03 Hz had none of its rigid modes, a plate at 0.07 Hz five of six).
OWN_SHIFT = 1.0
BELOW_SHIFT = (
    "an elastic mode is below 0.16 Hz, where CalculiX loses rigid and repeated modes of free "
    "structures; compare with another solver (`modetune model twin`)"
)

CAPABILITIES = Capabilities(strain_energies=True, matrices=True, tell_rigid=True, matrix_modes=True)


@dataclass(frozen=True)
class CalculixProgram:
    """The program ccx. with_frd: whether modal jobs leave job.frd too, for pictures."""

    program: str
    with_frd: bool = False
    capabilities: Capabilities = CAPABILITIES

    name = "calculix"
    #: Raised by hand when the same ccx output is read to other numbers.
    reader_version = 1
    #: Raised by hand when the same shapes are turned into frames in another way.
    frames_version = 1

    @cached_property
    def _version(self) -> str:
        if shutil.which(self.program) is None:
            raise SolverMissing(MISSING.format(program=self.program))
        with tempfile.TemporaryDirectory(prefix="modetune-") as folder:
            command = Command((self.program, "-v"))
            run_process(command, Path(folder), 60.0, threading.Event())
            banner = read_log(Path(folder))
        version = read_version(banner)
        if not version:
            raise SolverMissing(f"`{self.program} -v` printed no CalculiX version: {banner[:80]!r}")
        return version

    def version(self) -> str:
        return self._version

    def render(self, deck: EditedCalculix, analysis: Analysis) -> Rendered:
        text = job_text(deck.structure, deck.changed, analysis)
        modal = isinstance(analysis, ModalAnalysis)
        if not modal and find_spec("polars") is None:  # reads them: refused before the run
            raise ModuleNotFoundError("No module named 'polars'", name="polars")
        if self.with_frd and modal:
            text = with_frd(text)
        data = text.encode("utf-8", "surrogateescape")
        content: Json = {
            "solver": self.name,
            "version": self.version(),
            "reader": self.reader_version,
            "deck": hashlib.sha256(data).hexdigest(),
            "analysis": "modal" if modal else "matrices",
            "n_modes": analysis.n_modes if isinstance(analysis, ModalAnalysis) else 0,
            "groups": [[name, list(sets)] for name, sets in analysis.groups]
            if isinstance(analysis, ModalAnalysis)
            else [],
        }
        if deck.frames is not None:
            nodes = analysis.nodes if isinstance(analysis, ModalAnalysis) else ()
            content = {
                "calculix": content,
                "reader": self.frames_version,
                "frames": {str(n): deck.frames[n].tolist() for n in nodes if n in deck.frames},
            }
        marked = data.replace(NODES.encode(), f"{NODES}{mark_of(data)}".encode())
        return Rendered.of_texts(content, {f"{JOB}.inp": marked if modal else data})

    def command(self, threads: int) -> Command:
        count = str(threads)
        names = ("OMP_NUM_THREADS", "CCX_NPROC_STIFFNESS", "CCX_NPROC_EQUATION_SOLVER")
        return Command((self.program, "-i", JOB), tuple((name, count) for name in names))

    def read(
        self, deck: EditedCalculix, analysis: Analysis, folder: Path, return_code: int
    ) -> Result:
        log = read_log(folder)
        messages = read_messages(log)
        if messages:
            text = as_block("\n".join(message.text for message in messages))
            place = _place(messages, deck.structure, deck.changed)
            if "memory" in text.lower():
                raise SolverExhausted(f"CalculiX ran out of memory in {folder}:\n{text}")
            if "aupd" in text and isinstance(analysis, ModalAnalysis):  # ARPACK refused its sizes
                text += f"\n  {analysis.n_modes} modes need some more unknowns than the model has"
            raise SolverRejected(f"CalculiX refused the deck {place} (job in {folder}):\n{text}")
        if return_code != 0 or "Job finished" not in log:
            raise SolverCrashed(
                f"CalculiX ended in {folder} with code {return_code} and without its closing "
                f"line\n{log_tail(folder)}"
            )
        if isinstance(analysis, ModalAnalysis):
            ballast = point_mass(deck.structure, deck.changed)
            dat = folder / f"{JOB}.dat"
            asked = replace(analysis, n_modes=modes_at_most(deck.structure, analysis.n_modes))
            cyclic = read_cyclic_symmetry(deck.structure)
            found = read_modal(dat, asked, ballast, _node_set(folder), cyclic)
            result = without_spare(found)
            if not deck.structure.preload():
                try:
                    check_energies(result.eigenvalues, result.total_strain_energy)
                except ValueError as error:
                    raise NoResult(f"{dat} contradicts itself: {error}") from error
            energies = result.total_strain_energy
            if deck.structure.hides_energy:
                told = 2.0 * energies > STRAINED * result.eigenvalues
                energies = np.where(told, energies, np.nan)
            elastic = 2.0 * energies > STRAINED * np.abs(result.eigenvalues)
            if (elastic & (np.abs(result.eigenvalues) < OWN_SHIFT)).any():
                logger.warning(BELOW_SHIFT)
            modes = in_frames(result.modes, deck.frames or {})
            return replace(result, modes=modes, total_strain_energy=energies)
        from modetune.adapters.calculix.matrices import read_matrices  # polars takes a moment

        return read_matrices(folder, JOB)


def in_frames(modes: ModeSet, frames: Mapping[int, Floats]) -> ModeSet:
    """Shapes of basic coordinates (x, y, z node by node) in the nodes' own output frames."""
    if not frames:
        return modes
    shapes = modes.mode_shapes.reshape(-1, 3, modes.n_modes).copy()
    for place, node in enumerate(modes.nodes[::3].tolist()):
        if node in frames:
            shapes[place] = frames[node] @ shapes[place]
    return replace(modes, mode_shapes=np.reshape(shapes, (-1, modes.n_modes)))


def _node_set(folder: Path) -> str:
    """What a job calls the nodes whose shapes it wants. Raises NoResult where its deck is gone."""
    with read_errors(f"{folder / JOB}.inp", NoResult):
        text = read_regular(folder / f"{JOB}.inp").decode("utf-8", "surrogateescape")
    return text[text.rfind(NODES) :].partition(",")[0]


def _place(
    messages: list[SolverMessage], structure: CalculixStructure, changed: Mapping[int, str]
) -> str:
    """Return the place in the user's deck that the messages name, or the file.

    A message may quote a line (in upper case without blanks, often below the first message),
    name an element, or a keyword, which is enough if there is one such card.
    """
    lines = structure.deck.lines
    squeezed: dict[str, int] = {}
    for position, line in enumerate(lines):
        text = "".join(changed.get(position, line.text).upper().split())
        squeezed.setdefault(text, position)
    quoted = ("".join(message.card_image.upper().split()) for message in messages)
    found = [squeezed[text] for text in quoted if text and text in squeezed]
    elements = structure.mesh.elements
    found += [elements[m.element].line for m in messages if m.element in elements]
    cards = (structure.deck.named(message.keyword) for message in messages)
    found += [named[0].lines.start for named in cards if len(named) == 1]
    if found:
        return f"at {lines[found[0]].where}"
    return str(structure.deck.file)


def calculix_solver(deck: Path, parameters: tuple[Parameter, ...], step: int = 0) -> Solver:
    """CalculiX for a deck file; step: of the modes, 0 for the last with *FREQUENCY.

    Raises ModelError where the deck cannot be understood.
    """
    return solver_of(read_deck(deck, step), parameters)


def solver_of(deck: KeywordDeck, parameters: tuple[Parameter, ...]) -> Solver:
    """CalculiX for a deck that was read. Raises ModelError where it cannot be understood."""
    structure = split_model(understand(deck), parameters)
    for note in check_frequency_step(structure):
        logger.warning("%s", note)
    program = calculix_program()
    if read_cyclic_symmetry(structure) is not None:  # of a sector ccx stores no nodal diameter's
        without = replace(program.capabilities, matrices=False, matrix_modes=False)
        program = replace(program, capabilities=without)
    return Solver(CalculixModel(structure, parameters), program)


def calculix_program() -> CalculixProgram:
    """The ccx that the environment names, or the usual one."""
    return CalculixProgram(os.environ.get(PROGRAM_VARIABLE, "ccx"))
