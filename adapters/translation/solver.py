"""A Nastran deck run by CalculiX: the Nastran model translated at each set of parameter values.

Parameters edit the user's Nastran deck; the edited deck is translated, and CalculiX runs the
translation as it runs any deck. Shapes come back in the output frames of the grid points, as
Nastran gives them, so that a test file fits either solver.
"""

from __future__ import annotations

import logging
import os
import threading
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy import sparse

from modetune.adapters.calculix.deck import parse_deck
from modetune.adapters.calculix.footprint import changed_lines
from modetune.adapters.calculix.model import WITHOUT_ENERGY, understand
from modetune.adapters.calculix.solver import PROGRAM_VARIABLE, CalculixSolver
from modetune.adapters.nastran import model as nastran_model
from modetune.adapters.nastran.case_control import read_case_control
from modetune.adapters.nastran.deck import read_deck, write_edited
from modetune.adapters.nastran.geometry import read_geometry
from modetune.adapters.nastran.model import NastranModel
from modetune.adapters.solver import (
    Analysis,
    Capabilities,
    Command,
    Footprint,
    ModalAnalysis,
    ModelSummary,
)
from modetune.adapters.translation.cards import refused_commands
from modetune.adapters.translation.shells import KINDS as SHELLS
from modetune.adapters.translation.translate import Translation, translate
from modetune.core.errors import ModelError
from modetune.core.keys import Json
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats, Integers, ModeSet
from modetune.core.observation import Observation
from modetune.core.parameters import Parameter, Values
from modetune.core.results import MatrixResult, ModalResult, Result

logger = logging.getLogger(__name__)

#: Thickness as a share of an element's length below which expanded shells are ill-conditioned:
#: at 1/150 derivatives by differences of 1 % were found off by a quarter.
THIN = 0.01
#: Translated models that are kept for the next look at the same values.
KEPT = 4


@dataclass(frozen=True, slots=True)
class Translated:
    """The translation at some parameter values, and CalculiX bound to it."""

    translation: Translation
    solver: CalculixSolver


@dataclass(frozen=True)
class TranslatedSolver:
    """CalculiX bound to a Nastran deck and the parameters that edit it."""

    deck: NastranModel
    parameters: tuple[Parameter, ...]
    program: str
    _kept: OrderedDict[tuple[tuple[str, float], ...], Translated] = field(
        default_factory=OrderedDict, repr=False, compare=False
    )
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False, compare=False)

    name = "calculix"
    #: Raised by hand when the same translated deck's output is read to other numbers.
    reader_version = 1
    capabilities = Capabilities(strain_energies=True, matrices=True, matrix_modes=True)

    @cached_property
    def model(self) -> ModelSummary:
        nominal = self._at({})
        grids = frozenset(self.deck.summary.node_ids)
        return replace(
            self.deck.summary,
            node_ids=nominal.solver.model.node_ids & grids,
            components=nominal.solver.model.components,
            solid_shapes=nominal.solver.model.solid_shapes,
            matrix_shapes=nominal.solver.model.matrix_shapes,
        )

    @cached_property
    def _mesh(self) -> Mesh:
        return read_geometry(self.deck.bulk)

    def mesh(self) -> Mesh:
        """The user's own mesh, not the translated one."""
        return self._mesh

    def version(self) -> str:
        return self._at({}).solver.version()

    def problems(self, parameters: tuple[Parameter, ...]) -> list[str]:
        return self.deck.problems(parameters)

    def deck_value(self, parameter: Parameter) -> float:
        return self.deck.places(parameter)[0].value

    def written(self, parameter: Parameter, value: float) -> float:
        return self.deck.written(parameter, value)

    def wave_speeds(self) -> dict[str, float]:
        return self.deck.wave_speeds()

    def energy_sets(self, parameter: Parameter) -> tuple[str, ...]:
        """The deck's sets, none where CalculiX prints no whole energy of their elements."""
        names = self.deck.energy_sets(parameter)
        mesh = self._at({}).solver.deck.mesh
        members = [mesh.element_sets.get(name, frozenset()) for name in names]
        kinds = {mesh.elements[number].kind for numbers in members for number in numbers}
        whole = all(members) and not any(WITHOUT_ENERGY.fullmatch(kind) for kind in kinds)
        return names if whole else ()

    def is_linear(self, parameter: Parameter) -> bool:
        return self.deck.is_linear(parameter)

    def footprint(self, parameter: Parameter) -> Footprint | None:
        """By what of the translated deck changes with the parameter.

        Not every parameter that a Nastran model is linear in is so in its translation.
        """
        if parameter.quantity == "poissons_ratio" or self.deck.problems((parameter,)):
            return None
        nominal = self._at({}).solver
        values = [self.deck.written(parameter, value) for value in (0.5, 2.0)]
        try:
            decks = [self._translate(self.deck.edit([(parameter, value)])).solver.deck
                     for value in values]  # fmt: skip
        except ModelError:
            return None
        lines = changed_lines(nominal.deck, decks, values)
        return nominal.footprint_of(lines) if lines else None

    def observation(
        self, matrices: MatrixResult, nodes: Integers, components: Integers
    ) -> Observation:
        nominal = self._at({})
        frames = nominal.translation.frames
        if frames.keys().isdisjoint(nodes.tolist()):
            return nominal.solver.observation(matrices, nodes, components)
        # The nodes' three basic displacements, then what is wanted of each.
        size = nodes.size
        basic = nominal.solver.observation(
            matrices, np.repeat(nodes, 3), np.tile(np.arange(1, 4), size)
        )
        axes = [frames.get(node, np.eye(3))[component - 1] for node, component in
                zip(nodes.tolist(), components.tolist(), strict=True)]  # fmt: skip
        turn = sparse.csr_array(
            (np.concatenate(axes), np.arange(3 * size), np.arange(0, 3 * size + 1, 3)),
            shape=(size, 3 * size),
        )
        turn.eliminate_zeros()
        return basic.turned(turn)

    def content(self, values: Values, analysis: Analysis) -> Json:
        translated = self._at(values)
        frames: dict[str, Json] = {}
        if isinstance(analysis, ModalAnalysis):
            turned = translated.translation.frames
            frames = {str(node): turned[node].tolist() for node in analysis.nodes if node in turned}
        return {
            "calculix": translated.solver.content({}, analysis),
            "reader": self.reader_version,
            "frames": frames,
        }

    def write(self, values: Values, analysis: Analysis, folder: Path) -> None:
        self._at(values).solver.write({}, analysis, folder)

    def command(self, threads: int) -> Command:
        return self._at({}).solver.command(threads)

    def read(self, values: Values, analysis: Analysis, folder: Path, return_code: int) -> Result:
        translated = self._at(values)
        result = translated.solver.read({}, analysis, folder, return_code)
        if not isinstance(result, ModalResult):
            return result
        return replace(result, modes=in_frames(result.modes, translated.translation.frames))

    def write_updated(self, values: Values, folder: Path) -> Path:
        return write_edited(self.deck.deck, self._changed(values), folder)

    def _changed(self, values: Values) -> dict[int, str]:
        return self.deck.edit((p, values[p.name]) for p in self.parameters if p.name in values)

    def _at(self, values: Values) -> Translated:
        """The translation at these values, kept for a while. Raises ModelError."""
        known = tuple(sorted((name, float(value)) for name, value in values.items()
                             if value != 1.0))  # fmt: skip
        with self._lock:
            if known not in self._kept:
                self._kept[known] = self._translate(self._changed(values))
                while len(self._kept) > KEPT:
                    # The nominal translation, the first one, is always of use.
                    self._kept.pop(next(key for key in self._kept if key != ()))
            self._kept.move_to_end(known)
            return self._kept[known]

    def _translate(self, changed: dict[int, str]) -> Translated:
        """The translation with some lines of the deck changed. Raises ModelError."""
        stem = self.deck.deck.file.stem
        case = read_case_control(self.deck.deck)
        lost = refused_commands(case)
        if lost:
            raise ModelError(f"{stem} cannot be translated to CalculiX:\n" + "\n".join(lost))
        translation = translate(
            self.deck.bulk_at(changed), stem, spc=case.selected("SPC"),
            mpc=case.selected("MPC"), single=self._single, wtmass=self.deck.wtmass,
        )  # fmt: skip
        logger.info("%s translated: %s", stem, translation.mass_check)
        # The text is not a file: messages name it as what it is.
        deck = parse_deck(Path(f"{stem} (translated to CalculiX)"), translation.text)
        return Translated(translation, CalculixSolver(understand(deck), (), self.program))

    @cached_property
    def _single(self) -> frozenset[int]:
        """Elements that are sets of their own because a parameter's energy is theirs."""
        names = [name for item in self.parameters if not self.deck.problems((item,))
                 for name in self.deck.energy_sets(item)]  # fmt: skip
        return frozenset(int(name[1:]) for name in names if name.startswith("E"))


def in_frames(modes: ModeSet, frames: dict[int, Floats]) -> ModeSet:
    """Shapes of basic coordinates (x, y, z node by node) in the nodes' own output frames."""
    if not frames:
        return modes
    shapes = modes.mode_shapes.reshape(-1, 3, modes.n_modes).copy()
    for place, node in enumerate(modes.nodes[::3].tolist()):
        if node in frames:
            shapes[place] = frames[node] @ shapes[place]
    return replace(modes, mode_shapes=np.reshape(shapes, (-1, modes.n_modes)))


def thin_shells(model: NastranModel) -> int:
    """How many shells are so thin for their size that CalculiX's frequencies grow noisy."""
    return sum(
        element.Thickness() < THIN * element.Area() ** 0.5
        for element in model.bulk.elements.values() if element.type in SHELLS
    )  # fmt: skip


def translated_solver(deck: Path, parameters: tuple[Parameter, ...]) -> TranslatedSolver:
    """CalculiX for a Nastran deck file. Raises ModelError where it cannot be translated."""
    program = os.environ.get(PROGRAM_VARIABLE, "ccx")
    solver = TranslatedSolver(nastran_model.understand(read_deck(deck)), parameters, program)
    solver.model  # noqa: B018  # translates once, so that what cannot be is refused here
    thin = thin_shells(solver.deck)
    if thin:
        logger.warning(
            "%s: %d shells are thinner than 1/%.0f of their length; CalculiX expands shells to "
            "solids, and the frequencies of such thin ones are right to some digits only",
            deck, thin, 1.0 / THIN,
        )  # fmt: skip
    return solver
