"""Modes of a campaign's model from its stored matrices, solved in this process.

What a set cost is in the store like a solver's result. A search for modes that begins with those
of another set takes half as long as one from nothing, and ends on other last digits. So a key names
what its search began with, and has the same digits whoever finds them, and whenever:

    the first set            random vectors
    others                   the modes of the first one
    once there is a basis    what the newest reduced model, made of the modes at a set, has there

How they are found is told in solutions.py.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy import sparse

from modetune.adapters.solver import ModalAnalysis
from modetune.core.algebra.eigen import SolvedModes
from modetune.core.algebra.matrices import MatrixResult, symmetric
from modetune.core.correlation.clusters import rotation_onto
from modetune.core.modes import CLOSE, Floats
from modetune.core.storage.keys import Json, canonical_json, content_key
from modetune.core.updating.derivative_vectors import MOST_FORCES
from modetune.core.updating.reduced import ReducedModel
from modetune.core.updating.reduced_range import ReducedRange, reduce_over
from modetune.core.updating.results import ModalResult
from modetune.core.updating.sensitivity import ModeDerivatives, nelson
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.engine import JobEngine, R
from modetune.flows.updating.evaluation import Point
from modetune.flows.updating.matrix_source import MatrixSource
from modetune.flows.updating.observed_modes import (
    MODES_VERSION,
    first_shift,
    modes_at,
    named_freedoms,
)
from modetune.flows.updating.small_matrices import one_thread
from modetune.flows.updating.solutions import (
    KEPT_FROM,
    ModalSet,
    ReducedAround,
    Solutions,
    StoredModel,
)

logger = logging.getLogger(__name__)

#: Raised by hand when the same matrices are reduced to other numbers.
REDUCED_VERSION = 6
RANGE_VERSION = 4
#: The same of exact derivatives.
DERIVATIVES_VERSION = 1


class NotCounted(Exception):
    """Modes were found for which a count had no room."""


class MatrixModes:
    """Modes and reduced models of one campaign's model by its stored matrices.

    What they are found from follows from the order in which they are asked for, and not from what
    the store has of them.
    """

    def __init__(self, campaign: Campaign, engine: JobEngine, source: MatrixSource) -> None:
        self.campaign = campaign
        self.engine = engine
        self.source = source
        columns = range(len(source.parameters))
        self._model = StoredModel(campaign, source)
        self._matrices_key = source.key(campaign.start, columns)
        if source.jobs(campaign.start, columns):
            _ = self._model.matrices  # what jobs left is made into the matrices at once
        self._shift = first_shift(campaign)
        self._solutions = Solutions(self._model, engine, self._shift)
        self._sets: dict[tuple[float, ...], ModalSet] = {}
        self._first: dict[int, ModalSet] = {}
        self._reduced: dict[str, ReducedAround] = {}
        self._around: ReducedAround | None = None

    def modal(self, theta: Floats, analysis: ModalAnalysis) -> tuple[str, ModalResult]:
        """The key and the modes of a set at the analysis' nodes. Raises UnlikeMatrices where
        their motion does not follow from the matrices' unknowns."""
        item = self._set(theta, analysis.n_modes)

        def compute() -> ModalResult:
            solved = self._solutions.modes(item)
            found = solved.eigenvalues, solved.shapes, solved.energies, solved.n_rigid
            return modes_at(self._model.observer, *found, analysis)

        asked = _asked_modes(item, analysis)
        found = self._derived(asked, compute, ModalResult, "modal by stored matrices")
        return content_key(canonical_json(asked)), self.engine.solver.by_hand(found)

    def assembled(
        self,
        theta: Floats,
        analysis: ModalAnalysis,
        job: str,
        begun: Callable[[], Callable[[], MatrixResult]],
    ) -> tuple[str, ModalResult, bool]:
        """As `modal`, of the matrices that the solver assembles at a set, and whether counted.

        job: the key of its job, begun: as of `Solutions.assembled`. The search begins with the
        modes by the matrices of all values. Factors in single precision count nothing: where the
        campaign wants these, or has no room for others, modes are not. Raises ModelError where the
        count says that modes are missing.
        """
        start = self._newest or next(iter(self._first.values()), None)

        def asked(counted: bool) -> Json:
            return {
                "assembled modes": MODES_VERSION,
                "matrices": job,
                "from": self._shift if start is None else start.key,
                "n_modes": analysis.n_modes,
                "nodes": list(analysis.nodes),
                **({} if counted else {"counted": False}),
            }

        keys = {counted: content_key(canonical_json(asked(counted))) for counted in (True, False)}

        uncounted: list[tuple[SolvedModes, tuple[Floats, int]]] = []

        def solved_there(counted: bool) -> tuple[SolvedModes, tuple[Floats, int]]:
            n_modes = min(analysis.n_modes, self._model.matrices.base.nodes.size)
            item = ModalSet(keys[counted], self.source.written(theta), n_modes, start)
            return self._solutions.assembled(item, begun, counted)

        def found(counted: bool) -> tuple[str, ModalResult, bool]:
            def compute() -> ModalResult:
                solved, more = uncounted.pop() if uncounted else solved_there(counted)
                if counted and not solved.counted:
                    uncounted.append((solved, more))
                    raise NotCounted
                self.engine.store.drop(job)  # as large as the model, and not asked for again
                self._solutions.forget()
                return modes_at(
                    self._model.observer, solved.eigenvalues, solved.shapes, *more, analysis
                )

            name = "modes of assembled matrices" + ", counted" * counted
            modal = self._derived(asked(counted), compute, ModalResult, name)
            return keys[counted], self.engine.solver.by_hand(modal), counted

        if self.engine.policy.single_factors or keys[False] in self.engine.store:
            return found(counted=False)
        try:
            return found(counted=True)
        except NotCounted:
            return found(counted=False)

    def release(self) -> None:
        """What is kept for later searches leaves the store: there are none."""
        self._solutions.forget()

    def key(self, theta: Floats, analysis: ModalAnalysis) -> str:
        """The key of `modal`; nothing is computed."""
        asked = _asked_modes(self._set(theta, analysis.n_modes), analysis)
        return content_key(canonical_json(asked))

    def foreseen(self, theta: Floats, analysis: ModalAnalysis) -> tuple[str, ModalResult]:
        """As `modal`, by the newest reduced model. Raises ModesError where it has no such modes."""
        around = self._around
        if around is None or around is not self._newest:  # it would have to be made once more
            return self.modal(theta, analysis)
        values = self.source.written(theta)

        def compute() -> ModalResult:
            basis = self._solutions.basis(around)
            eigenvalues, shapes = basis.shapes(values, analysis.n_modes)
            energies = 0.5 * eigenvalues
            energies[: basis.n_rigid] = np.nan
            found = eigenvalues, shapes, energies, basis.n_rigid
            return modes_at(self._model.observer, *found, analysis)

        asked: Json = {
            "foreseen": around.key,
            "theta": values.tolist(),
            "n_modes": analysis.n_modes,
            "nodes": list(analysis.nodes),
        }
        found = self._derived(asked, compute, ModalResult, "modal by the reduced model")
        return content_key(canonical_json(asked)), self.engine.solver.by_hand(found)

    def over(
        self,
        point: Point,
        thetas: Floats,
        analysis: ModalAnalysis,
        accuracy: float,
        tell: Callable[[int, float], None],
    ) -> tuple[str, ReducedRange]:
        """The key and a reduced model for all these sets (n_sets, n_parameters), from an evaluation
        point on, whose frequencies are off by `accuracy` at most, relative.

        Full solutions are in the store until the range is.
        """
        self.reduced(point, analysis)
        around = self._around
        assert around is not None
        values = np.array([self.source.written(theta) for theta in thetas])
        asked: Json = {
            "reduced range": RANGE_VERSION,
            "around": around.key,
            "n_modes": analysis.n_modes,
            "sets": hashlib.sha256(values.tobytes()).hexdigest(),
            "accuracy": accuracy,
        }

        kept: list[str] = []

        def keep(at: Floats, solve: Callable[[], SolvedModes]) -> SolvedModes:
            if self._model.matrices.base.nodes.size < KEPT_FROM:
                return solve()
            # What it begins with, and so its last digits, follows from the ones before.
            one: Json = {"full solution": len(kept), "of": asked, "theta": at.tolist()}
            kept.append(content_key(canonical_json(one)))
            return self.engine.derived(one, solve, SolvedModes)

        def compute() -> ReducedRange:
            begin, observer = self._solutions.basis(around), self._model.observer(*around.seen)
            with self.engine.all_cores(), one_thread():
                return reduce_over(
                    self._model.matrices,
                    values,
                    (begin.reduced, begin.vectors),
                    analysis.n_modes,
                    begin.n_rigid,
                    observer,
                    accuracy,
                    tell,
                    keep,
                    self._solutions.lent(),
                )

        found = self._derived(asked, compute, ReducedRange, "reduced model between the bounds")
        for key in kept:  # large, and in the range now: only one that was killed needs them
            self.engine.store.drop(key)
        return content_key(canonical_json(asked)), found

    def reduced(self, point: Point, analysis: ModalAnalysis) -> ReducedModel:
        """The reduced model around an evaluation point, for its pairs, at the campaign's nodes."""
        item, nodes = self._set(point.theta, analysis.n_modes), self.campaign.case.nodes
        modes = point.pairing.computed + point.modal.n_rigid
        asked: Json = {
            "reduced": REDUCED_VERSION,
            "around": item.key,
            "pairs": modes.tolist(),
            "nodes": list(nodes),
        }
        key = content_key(canonical_json(asked))
        if key not in self._reduced:
            self._reduced[key] = ReducedAround(key, item, modes, named_freedoms(nodes))
        around = self._around = self._reduced[key]
        return self._derived(
            asked, lambda: self._solutions.basis(around).reduced, ReducedModel, "reduced model"
        )

    def derivatives(self, point: Point, analysis: ModalAnalysis) -> ModeDerivatives | None:
        """Exact derivatives of an evaluation point's pairs at the campaign's nodes where there are
        more than a reduced model holds: its shapes' would be off by some per cent. Else None."""
        around, n = self._around, point.theta.size
        if around is None or n * around.modes.size <= MOST_FORCES:
            return None

        def compute() -> ModeDerivatives:
            solved, matrices = self._solutions.modes(around.of), self._model.matrices
            observer, here = self._model.observer(*around.seen), matrices.at(around.of.values)
            eigenvalues, shapes, n_rigid = solved.eigenvalues, solved.shapes, solved.n_rigid
            turn = np.eye(eigenvalues.size)
            turn[n_rigid:, n_rigid:] = rotation_onto(
                observer @ shapes[:, n_rigid:],
                np.real(point.modal.elastic.mode_shapes),
                np.sqrt(np.abs(eigenvalues[n_rigid:])),
            )
            changes = [matrices.change(around.of.values, column) for column in range(n)]
            rows = np.unique(observer.indices).astype(np.int64)
            found = nelson(
                here.stiffness,
                here.mass,
                eigenvalues @ turn**2,
                shapes @ turn,
                [(symmetric(stiffness), symmetric(mass)) for stiffness, mass in changes],
                around.modes.tolist(),
                rows,
                2.0 * CLOSE,
            )
            seen = sparse.csr_array(observer[:, rows]) @ found.mode_shapes.reshape(rows.size, -1)
            return replace(found, mode_shapes=seen.reshape(-1, *found.mode_shapes.shape[1:]))

        asked: Json = {"derivatives": DERIVATIVES_VERSION, "of": around.key}
        return self._derived(asked, compute, ModeDerivatives, "sensitivities from matrices")

    def _derived(self, asked: Json, compute: Callable[[], R], kind: type[R], name: str) -> R:
        return self.engine.derived(asked, compute, kind, self.campaign.case.of(name))

    @property
    def held(self) -> str:
        """How the factors are held, where that is not in double precision in memory."""
        return self._solutions.held

    @property
    def _newest(self) -> ReducedAround | None:
        """The reduced model that was asked for last for the first time."""
        return next(reversed(self._reduced.values()), None)

    def _set(self, theta: Floats, n_modes: int) -> ModalSet:
        """A set, with what its modes are found from."""
        values = self.source.written(theta)
        mark = (*values.tolist(), n_modes)
        if mark not in self._sets:
            start = self._newest or self._first.get(n_modes)
            asked: Json = {
                "modes": MODES_VERSION,
                "matrices": self._matrices_key,
                "theta": values.tolist(),
                "n_modes": n_modes,
                "from": self._shift if start is None else start.key,
            }
            key = content_key(canonical_json(asked))
            self._sets[mark] = ModalSet(key, values, n_modes, start)
            self._first.setdefault(n_modes, self._sets[mark])
        return self._sets[mark]


def _asked_modes(item: ModalSet, analysis: ModalAnalysis) -> Json:
    return {"modes at": item.key, "nodes": list(analysis.nodes)}
