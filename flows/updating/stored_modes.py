"""Modes of a campaign's model from its stored matrices, solved in this process.

What a set cost is in the store like a solver's result; shapes of all unknowns, which reduced models
are made of, and the newest of their bases, which the next solution starts from, stay in memory.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from modetune.adapters.solver import ModalAnalysis
from modetune.core.algebra.eigen import ModeSolver, SolvedModes
from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers, count_rigid_modes, mode_set
from modetune.core.storage.keys import Json, canonical_json, content_key
from modetune.core.updating.reduced import ReducedModel
from modetune.core.updating.reduced_basis import reduce
from modetune.core.updating.results import ModalResult
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.updating.evaluation import Point
from modetune.flows.updating.matrix_source import MatrixSource
from modetune.flows.updating.semi_analytic import UnlikeMatrices

logger = logging.getLogger(__name__)

#: Raised by hand when the same matrices are solved, or reduced, to other numbers.
MODES_VERSION = 2
REDUCED_VERSION = 2
#: The shift below the spectrum, in first elastic eigenvalues.
SHIFT = -0.1
#: Unobservable nodes that a message names.
NAMED = 5


@dataclass(frozen=True, slots=True)
class _Basis:
    """A reduced model with its basis (n, r); around: its key."""

    around: str
    reduced: ReducedModel
    vectors: Floats

    def shapes(self, theta: Floats, n_modes: int) -> tuple[Floats, Floats]:
        """Eigenvalues (n_modes,) and shapes of all unknowns (n, n_modes). Raises ModesError."""
        eigenvalues, combined = self.reduced.combinations(theta, n_modes)
        return eigenvalues, self.vectors @ combined


class MatrixModes:
    """Modes and reduced models of one campaign's model by its stored matrices."""

    def __init__(self, campaign: Campaign, engine: JobEngine, source: MatrixSource) -> None:
        self.campaign = campaign
        self.engine = engine
        self.source = source
        columns = range(len(source.parameters))
        self.affine = source.last_matrices(campaign.start, columns)
        self._matrices_key = source.key(campaign.start, columns)
        # The solver's own modes at the end tell whether any was missed: no need to count them.
        self._solver = ModeSolver(count=False)
        self._newest: tuple[Floats, SolvedModes] | None = None
        self._basis: _Basis | None = None
        self._around = ""
        first = float(np.min(campaign.case.measured.modes.frequencies_hz))
        self._shift = SHIFT * (2.0 * np.pi * first) ** 2  # the model's own, once it is known

    def modal(self, theta: Floats, analysis: ModalAnalysis) -> tuple[str, ModalResult]:
        """The key and the modes of a set at the analysis' nodes. Raises UnlikeMatrices where
        their motion does not follow from the matrices' unknowns."""
        asked = self._asked("modes", MODES_VERSION, theta, analysis)
        found = self.engine.derived(asked, lambda: self._modal(theta, analysis), ModalResult)
        return content_key(canonical_json(asked)), found

    def foreseen(self, theta: Floats, analysis: ModalAnalysis) -> tuple[str, ModalResult]:
        """As `modal`, by the newest reduced model. Raises ModesError where it has no such modes."""
        asked = {
            "around": self._around,
            "of": self._asked("foreseen", REDUCED_VERSION, theta, analysis),
        }
        found = self.engine.derived(asked, lambda: self._foreseen(theta, analysis), ModalResult)
        return content_key(canonical_json(asked)), found

    def reduced(self, point: Point, analysis: ModalAnalysis) -> ReducedModel:
        """The reduced model around an evaluation point, for its pairs, at the campaign's nodes."""
        here = replace(analysis, nodes=self.campaign.case.nodes)
        modes = point.pairing.computed + point.modal.n_rigid
        asked = {
            "pairs": modes.tolist(),
            "of": self._asked("reduced", REDUCED_VERSION, point.theta, here),
        }
        self._around = content_key(canonical_json(asked))
        return self.engine.derived(
            asked, lambda: self._reduced(point.theta, modes, here), ReducedModel
        )

    def _asked(self, what: str, version: int, theta: Floats, analysis: ModalAnalysis) -> Json:
        return {
            what: version,
            "matrices": self._matrices_key,
            "theta": self.source.written(theta).tolist(),
            "n_modes": analysis.n_modes,
            "nodes": list(analysis.nodes),
        }

    def _solved(self, theta: Floats, n_modes: int) -> SolvedModes:
        """Modes at a set with shapes of all unknowns, from memory if it is the newest one."""
        if self._newest is not None:
            at, solved = self._newest
            if np.array_equal(at, theta) and solved.eigenvalues.size >= n_modes:
                return solved
        with self.engine.all_cores():
            matrices = self.affine.at(self.source.written(theta))
            solved = self._solver.solve(
                matrices.upper_stiffness,
                matrices.upper_mass,
                n_modes,
                self._shift,
                self._start(theta, n_modes),
            )
        rigid = count_rigid_modes(solved.eigenvalues)
        if rigid < solved.eigenvalues.size:
            self._shift = SHIFT * float(solved.eigenvalues[rigid])
        self._newest = theta.copy(), solved
        return solved

    def _start(self, theta: Floats, n_modes: int) -> Floats | None:
        """Shapes near those of a set: the newest reduced model's there, else the newest ones."""
        if self._basis is not None:
            try:
                return self._basis.shapes(theta, n_modes)[1]
            except ModesError as error:
                logger.debug("no start from a reduced model: %s", error)
        return None if self._newest is None else self._newest[1].shapes

    def _modal(self, theta: Floats, analysis: ModalAnalysis) -> ModalResult:
        solved = self._solved(theta, analysis.n_modes)
        return self._seen(solved.eigenvalues, solved.shapes, analysis)

    def _foreseen(self, theta: Floats, analysis: ModalAnalysis) -> ModalResult:
        if self._basis is None or self._basis.around != self._around:
            return self._modal(theta, analysis)  # an earlier run died before this was stored
        found = self._basis.shapes(self.source.written(theta), analysis.n_modes)
        return self._seen(*found, analysis)

    def _seen(self, eigenvalues: Floats, shapes: Floats, analysis: ModalAnalysis) -> ModalResult:
        """The modes at an analysis' nodes, of shapes of all unknowns."""
        eigenvalues = eigenvalues[: analysis.n_modes]
        nodes, components = _named(analysis.nodes)
        shapes = self._observer(nodes, components) @ shapes[:, : analysis.n_modes]
        return ModalResult(
            eigenvalues=eigenvalues,
            modes=mode_set(
                np.sqrt(np.maximum(eigenvalues, 0.0)) / (2.0 * np.pi),
                shapes,
                nodes,
                components,
                normalisation="mass",
            ),
            groups=(),
            strain_energies=np.zeros((0, eigenvalues.size)),
            total_strain_energy=0.5 * eigenvalues,
            mass=np.nan,
        )

    def _reduced(self, theta: Floats, modes: Integers, here: ModalAnalysis) -> ReducedModel:
        solved = self._solved(theta, here.n_modes)
        nodes, components = _named(here.nodes)
        with self.engine.all_cores():
            model, basis = reduce(
                self.affine,
                self.source.written(theta),
                solved.eigenvalues,
                solved.shapes,
                self._solver.inverse,
                modes,
                self._observer(nodes, components),
            )
        self._basis = _Basis(self._around, model, basis)
        return model

    def _observer(self, nodes: Integers, components: Integers) -> sparse.csr_array:
        """What takes shapes of all unknowns to these degrees of freedom. Raises UnlikeMatrices."""
        seen = self.campaign.case.solver.deck.observation(self.affine.base, nodes, components)
        unknown = np.unique(nodes[seen.unknown])
        if unknown.size:
            named = ", ".join(map(str, unknown[:NAMED].tolist()))
            more = f" and {unknown.size - NAMED} more" if unknown.size > NAMED else ""
            raise UnlikeMatrices(
                f"the motion of node {named}{more} does not follow from the stored matrices' "
                "unknowns"
            )
        return seen.matrix


def _named(nodes: tuple[int, ...]) -> tuple[Integers, Integers]:
    """The degrees of freedom of a modal result at these nodes: node by node, x, y, z."""
    ordered = np.array(sorted(nodes), dtype=np.int64)
    return np.repeat(ordered, 3), np.tile(np.arange(1, 4), ordered.size)
