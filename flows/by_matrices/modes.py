"""Modes of a campaign's model from its stored matrices, solved in this process.

What a set cost is in the store like a solver's result; shapes of all unknowns, which the next
solution starts from and reduced models are made of, stay in memory for the newest set alone.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from scipy import sparse

from modetune.adapters.solver import ModalAnalysis
from modetune.core.eigen import ModeSolver, Solved
from modetune.core.keys import Json, canonical_json, content_key
from modetune.core.modes import Floats, Integers, count_rigid_modes, mode_set
from modetune.core.reduced import ReducedModel
from modetune.core.reduced_basis import reduce
from modetune.core.results import ModalResult
from modetune.flows.by_matrices.source import MatrixSource
from modetune.flows.campaign import Campaign
from modetune.flows.evaluation import Evaluation
from modetune.flows.execution.engine import JobEngine
from modetune.flows.semi_analytic import UnlikeMatrices

logger = logging.getLogger(__name__)

#: Raised by hand when the same matrices are solved, or reduced, to other numbers.
MODES_VERSION = 1
REDUCED_VERSION = 1
#: The shift below the spectrum, in first elastic eigenvalues.
SHIFT = -0.1
#: Unobservable nodes that a message names.
NAMED = 5


class MatrixModes:
    """Modes and reduced models of one campaign's model by its stored matrices."""

    def __init__(self, campaign: Campaign, engine: JobEngine, source: MatrixSource) -> None:
        self.campaign = campaign
        self.engine = engine
        self.source = source
        self.affine = source.matrices()
        self._solver = ModeSolver()
        self._newest: tuple[Floats, Solved] | None = None
        self._shift: float | None = None

    def modal(self, theta: Floats, analysis: ModalAnalysis) -> tuple[str, ModalResult]:
        """The key and the modes of a set at the analysis' nodes. Raises UnlikeMatrices where
        their motion does not follow from the matrices' unknowns."""
        asked = self._asked("modes", MODES_VERSION, theta, analysis)
        found = self.engine.derived(asked, lambda: self._modal(theta, analysis), ModalResult)
        return content_key(canonical_json(asked)), found

    def reduced(self, evaluation: Evaluation, analysis: ModalAnalysis) -> ReducedModel:
        """The reduced model around an evaluated set, for its pairs, at the campaign's nodes."""
        here = replace(analysis, nodes=self.campaign.nodes)
        modes = evaluation.pairing.computed + evaluation.modal.n_rigid
        asked = {
            "pairs": modes.tolist(),
            "of": self._asked("reduced", REDUCED_VERSION, evaluation.theta, here),
        }
        return self.engine.derived(
            asked, lambda: self._reduced(evaluation.theta, modes, here), ReducedModel
        )

    def _asked(self, what: str, version: int, theta: Floats, analysis: ModalAnalysis) -> Json:
        return {
            what: version,
            "affine": self.source.key,
            "theta": self.source.written(theta).tolist(),
            "n_modes": analysis.n_modes,
            "nodes": list(analysis.nodes),
        }

    def _solved(self, theta: Floats, n_modes: int) -> Solved:
        """Modes at a set with shapes of all unknowns, from memory if it is the newest one."""
        if self._newest is not None:
            at, solved = self._newest
            if np.array_equal(at, theta) and solved.eigenvalues.size >= n_modes:
                return solved
        with self.engine.all_cores():
            matrices = self.affine.at(self.source.written(theta))
            start = None if self._newest is None else self._newest[1].shapes
            solved = self._solver.solve(
                matrices.upper_stiffness, matrices.upper_mass, n_modes, self._shift, start
            )
        rigid = count_rigid_modes(solved.eigenvalues)
        if rigid < solved.eigenvalues.size:
            self._shift = SHIFT * float(solved.eigenvalues[rigid])
        self._newest = theta.copy(), solved
        return solved

    def _modal(self, theta: Floats, analysis: ModalAnalysis) -> ModalResult:
        solved = self._solved(theta, analysis.n_modes)
        eigenvalues = solved.eigenvalues[: analysis.n_modes]
        nodes, components = _named(analysis.nodes)
        shapes = self._observer(nodes, components) @ solved.shapes[:, : analysis.n_modes]
        return ModalResult(
            eigenvalues=eigenvalues,
            modes=mode_set(
                np.sqrt(np.maximum(eigenvalues, 0.0)) / (2.0 * np.pi), shapes, nodes, components,
                normalisation="mass",
            ),
            groups=(),
            strain_energies=np.zeros((0, eigenvalues.size)),
            total_strain_energy=0.5 * eigenvalues,
            mass=np.nan,
        )  # fmt: skip

    def _reduced(self, theta: Floats, modes: Integers, here: ModalAnalysis) -> ReducedModel:
        solved = self._solved(theta, here.n_modes)
        nodes, components = _named(here.nodes)
        with self.engine.all_cores():
            model, _ = reduce(
                self.affine, self.source.written(theta), solved.eigenvalues, solved.shapes,
                self._solver.inverse, modes, self._observer(nodes, components),
            )  # fmt: skip
        return model

    def _observer(self, nodes: Integers, components: Integers) -> sparse.csr_array:
        """What takes shapes of all unknowns to these degrees of freedom. Raises UnlikeMatrices."""
        seen = self.campaign.solver.observation(self.affine.base, nodes, components)
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
