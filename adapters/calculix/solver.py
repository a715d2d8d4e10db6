"""CalculiX behind the solver seam."""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import tempfile
import threading
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from modetune.adapters.calculix.affected_elements import Place, affected_elements_of
from modetune.adapters.calculix.cyclic_symmetry import read_cyclic_symmetry
from modetune.adapters.calculix.damping import damped_materials, dampers
from modetune.adapters.calculix.deck import read_deck, write_edited
from modetune.adapters.calculix.frd import with_frd
from modetune.adapters.calculix.geometry import read_geometry
from modetune.adapters.calculix.incidence import Incidence
from modetune.adapters.calculix.job import NODES, check_frequency_step, job_text
from modetune.adapters.calculix.loads import load_case
from modetune.adapters.calculix.model import CalculixModel, understand
from modetune.adapters.calculix.observation import observe
from modetune.adapters.calculix.places import edited_lines, energy_sets, find_numbers
from modetune.adapters.calculix.results import (
    SolverMessage,
    read_messages,
    read_modal,
    read_version,
)
from modetune.adapters.calculix.sections import (
    elastic_constants,
    least_thickness,
    material_masses,
    point_mass,
    targets,
)
from modetune.adapters.calculix.spare_unknowns import modes_at_most
from modetune.adapters.calculix.splitting import split_model
from modetune.adapters.cross_checks import check_energies, mark_of, without_spare
from modetune.adapters.damping import NOTHING, Dampers, damps_only
from modetune.adapters.numbers import Number
from modetune.adapters.process import as_block, log_tail, read_log, run_process
from modetune.adapters.regular_file import read_errors, read_regular
from modetune.adapters.solver import (
    AffectedElements,
    Analysis,
    Capabilities,
    Command,
    Deck,
    ModalAnalysis,
    ModelSummary,
    Rendered,
    Solver,
    Target,
)
from modetune.core.algebra.rigid_modes import STRAINED
from modetune.core.errors import (
    ModelError,
    NoResult,
    SolverCrashed,
    SolverExhausted,
    SolverMissing,
    SolverRejected,
)
from modetune.core.expressions import degree
from modetune.core.mesh import Mesh, cell_sizes
from modetune.core.modes import Floats, Integers, ModeSet
from modetune.core.parameters import DAMPING, Parameter, Quantity, Values, assigned, driven_by
from modetune.core.storage.keys import Json
from modetune.core.updating.damping import DampingModel
from modetune.core.updating.observation import Observation
from modetune.core.updating.results import MatrixResult, Result
from modetune.core.updating.static import LoadCase

logger = logging.getLogger(__name__)

JOB = "job"
#: Names another program than `ccx` on PATH.
PROGRAM_VARIABLE = "MODETUNE_CCX"
#: Stiffness and mass matrices are linear in these.
LINEAR: frozenset[Quantity] = DAMPING | {
    "youngs_modulus", "shear_modulus", "density", "spring_stiffness", "mass", "variable",
}  # fmt: skip
#: Items of Young's moduli of engineering constants.
DIRECTIONS = (1, 2, 3)
MISSING = (
    "the CalculiX program `{program}` is not on this machine; install it (Debian and Ubuntu: "
    "`apt-get install calculix-ccx`) or name it with " + PROGRAM_VARIABLE
)


@dataclass(frozen=True, slots=True)
class EditedCalculix:
    """A model with some lines of its deck changed.

    frames: axes in which shapes are wanted, by node, where another deck (one that was translated)
    stands behind this one; None where this one is the user's.
    """

    model: CalculixModel
    changed: dict[int, str]
    frames: Mapping[int, Floats] | None = None

    def texts(self) -> list[str]:
        """The lines of the deck as they are now."""
        lines = enumerate(self.model.deck.lines)
        return [self.changed.get(position, line.text) for position, line in lines]


@dataclass(frozen=True)
class CalculixDeck(Deck):
    """A CalculiX deck and the parameters that edit it."""

    model: CalculixModel
    parameters: tuple[Parameter, ...]

    @cached_property
    def summary(self) -> ModelSummary:
        return self.model.summary

    @cached_property
    def _mesh(self) -> Mesh:
        return read_geometry(self.model.deck, self.model.mesh, self.summary.node_ids)

    def mesh(self) -> Mesh:
        return self._mesh

    def numbers(self, parameter: Parameter) -> list[Number]:
        return find_numbers(self.model, parameter)

    def splits(self) -> tuple[str, ...]:
        return self.model.split

    def targets(self) -> tuple[Target, ...]:
        return targets(self.model)

    def elastic_constants(self) -> dict[str, tuple[float, float]]:
        return elastic_constants(self.model)

    def material_masses(self) -> dict[str, float]:
        return material_masses(self.model, cell_sizes(self.mesh()))

    def least_length(self) -> float:
        return min(super().least_length(), least_thickness(self.model))

    def energy_sets(self, parameter: Parameter) -> tuple[str, ...]:
        if self.preload() or not parameter.proportional or driven_by(parameter, self.parameters):
            return ()
        return energy_sets(self.model, parameter)

    def is_linear(self, parameter: Parameter) -> bool:
        """Of engineering constants a single Young's modulus is coupled with the others."""
        return not self.preload() and all(
            item.quantity in LINEAR
            and (item.quantity != "youngs_modulus" or item.item not in DIRECTIONS)
            and degree(item.expression or "0") < 2
            for item in (parameter, *driven_by(parameter, self.parameters))
        )

    def preload(self) -> str:
        return self.model.preload()

    @cached_property
    def _incidence(self) -> Incidence:
        mesh = self.model.mesh
        return Incidence({number: item.nodes for number, item in mesh.elements.items()}, mesh)

    @cached_property
    def _affected(self) -> dict[tuple[frozenset[Place], tuple[int, ...]], AffectedElements | None]:
        """Elements by what they were asked for: several times in a campaign."""
        return {}

    def affected_elements(self, parameter: Parameter) -> AffectedElements | None:
        if damps_only(parameter, self.parameters):
            return NOTHING
        driven = driven_by(parameter, self.parameters)
        across = parameter.quantity in ("thickness", "dimension")
        plain = parameter.proportional and not driven
        if not (across and plain) and not self.is_linear(parameter):
            return None
        numbers = [n for item in (parameter, *driven) for n in find_numbers(self.model, item)]
        found = self.affected_elements_of({number.place for number in numbers})
        return found and replace(
            found, proportional=found.proportional and plain, related=bool(driven)
        )

    def affected_elements_of(
        self, places: Collection[Place], powers: tuple[int, ...] = (1,)
    ) -> AffectedElements | None:
        """What these numbers of the deck move, as one relative value of theirs."""
        asked = frozenset(places), powers
        if asked not in self._affected:
            self._affected[asked] = affected_elements_of(
                self.model, self._incidence, self.mesh(), places, powers
            )
        return self._affected[asked]

    def observation(
        self, matrices: MatrixResult, nodes: Integers, components: Integers
    ) -> Observation:
        return observe(
            self.model, self._incidence, matrices.nodes, matrices.components, nodes, components
        )

    def load_case(self, number: int, values: Values | None = None) -> LoadCase:
        model, changed = self.model, self.edited(values or {}).changed
        if changed:
            lines = list(model.deck.lines)
            for place, text in changed.items():
                lines[place] = lines[place]._replace(text=text)
            model = replace(model, deck=replace(model.deck, lines=lines))
        return load_case(model, self.mesh(), number)

    def undamped(self) -> str:
        try:
            found = self._dampers
        except ModelError as error:
            return str(error)
        if found.links or found.losses:
            return ""
        return f"{self.model.deck.file}: the deck has no *DASHPOT, nor *DAMPING of a material"

    def losses(self) -> tuple[Parameter, ...]:
        return self._losses

    def damping(self, base: MatrixResult) -> DampingModel:
        return self._dampers.model(self, base)

    @cached_property
    def _losses(self) -> tuple[Parameter, ...]:
        return damped_materials(self.model)

    @cached_property
    def _dampers(self) -> Dampers:
        return dampers(self.model, self, self.parameters)

    def edited(self, values: Values) -> EditedCalculix:
        moving = [pair for pair in self._assigned(values) if pair[0].quantity not in DAMPING]
        return EditedCalculix(self.model, edited_lines(self.model, moving))

    def write_updated(self, values: Values, folder: Path) -> Path:
        changed = edited_lines(self.model, self._assigned(values))
        return write_edited(self.model.deck, changed, folder)

    def _assigned(self, values: Values) -> list[tuple[Parameter, float]]:
        """Parameters with values, those of groups' stiffness last."""
        groups = values.keys() - {item.name for item in self.parameters}
        return assigned((*self.parameters, *(self._losses if groups else ())), values)


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
        text = job_text(deck.model, deck.changed, analysis)
        modal = isinstance(analysis, ModalAnalysis)
        if not modal and find_spec("polars") is None:  # reads them: told before the run
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
            said = as_block("\n".join(message.text for message in messages))
            place = _place(messages, deck.model, deck.changed)
            if "memory" in said.lower():
                raise SolverExhausted(f"CalculiX ran out of memory in {folder}:\n{said}")
            if "aupd" in said and isinstance(analysis, ModalAnalysis):  # ARPACK refused its sizes
                said += f"\n  {analysis.n_modes} modes need some more unknowns than the model has"
            raise SolverRejected(f"CalculiX refused the deck {place} (job in {folder}):\n{said}")
        if return_code != 0 or "Job finished" not in log:
            raise SolverCrashed(
                f"CalculiX ended in {folder} with code {return_code} and without its closing "
                f"line\n{log_tail(folder)}"
            )
        if isinstance(analysis, ModalAnalysis):
            ballast = point_mass(deck.model, deck.changed)
            dat = folder / f"{JOB}.dat"
            asked = replace(analysis, n_modes=modes_at_most(deck.model, analysis.n_modes))
            cyclic = read_cyclic_symmetry(deck.model)
            found = read_modal(dat, asked, ballast, _node_set(folder), cyclic)
            result = without_spare(found)
            if not deck.model.preload():
                try:
                    check_energies(result.eigenvalues, result.total_strain_energy)
                except ValueError as error:
                    raise NoResult(f"{dat} contradicts itself: {error}") from error
            energies = result.total_strain_energy
            if deck.model.hides_energy:
                told = 2.0 * energies > STRAINED * result.eigenvalues
                energies = np.where(told, energies, np.nan)
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


def _place(messages: list[SolverMessage], model: CalculixModel, changed: Mapping[int, str]) -> str:
    """Where the user's deck has what the messages speak of, the file alone where none tells.

    A message may quote a line (in upper case without blanks, often below the first message),
    name an element, or at least the keyword, which tells if there is one such card.
    """
    lines = model.deck.lines
    squeezed: dict[str, int] = {}
    for position, line in enumerate(lines):
        text = "".join(changed.get(position, line.text).upper().split())
        squeezed.setdefault(text, position)
    quoted = ("".join(message.card_image.upper().split()) for message in messages)
    found = [squeezed[text] for text in quoted if text and text in squeezed]
    elements = model.mesh.elements
    found += [elements[m.element].line for m in messages if m.element in elements]
    cards = (model.deck.named(message.keyword) for message in messages)
    found += [named[0].lines.start for named in cards if len(named) == 1]
    if found:
        return f"at {lines[found[0]].where}"
    return str(model.deck.file)


def calculix_solver(deck: Path, parameters: tuple[Parameter, ...]) -> Solver:
    """CalculiX for a deck file. Raises ModelError where the deck cannot be understood."""
    model = split_model(understand(read_deck(deck)), parameters)
    for note in check_frequency_step(model):
        logger.warning("%s", note)
    program = calculix_program()
    if read_cyclic_symmetry(model) is not None:  # of a sector ccx stores no nodal diameter's
        without = replace(program.capabilities, matrices=False, matrix_modes=False)
        program = replace(program, capabilities=without)
    return Solver(CalculixDeck(model, parameters), program)


def calculix_program() -> CalculixProgram:
    """The ccx that the environment names, or the usual one."""
    return CalculixProgram(os.environ.get(PROGRAM_VARIABLE, "ccx"))
