"""Modes of a campaign's model from its stored matrices, solved in this process.

The store keeps the modes at each point like a solver's result. A search that begins with the modes
of another point takes half as long as one from random vectors, and differs in the last digits. So
a key names what its search began with, and the digits are the same in every process:

    the first point            random vectors
    later points               the modes of the first one
    once there is a basis      the modes of the newest reduced model at the point

Where a factorisation takes longer than it saves (large models), a search from a reduced model
continues with the factors that the modes behind that model were found with. Where those factors
have been replaced, because a point lay too far away, they are computed again.

Shapes of all unknowns and the newest basis stay in memory. After a kill the start of the next
search is computed again. The shapes of a large model are in the store as long as a search may begin
with them, so that one factorisation is enough; those of a small model are computed point by point.
Matrices that the solver assembles at a point are solved in the same way, and their modes are
counted.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
from scipy import sparse

from modetune.adapters.solver import ModalAnalysis
from modetune.core.algebra.eigen import KEPT, ModeSolver, SolvedModes
from modetune.core.algebra.matrices import MatrixResult, symmetric
from modetune.core.algebra.pencil import shift_below
from modetune.core.algebra.rigid_modes import GIVEN, PRINTED, count_rigid_modes, matrix_energies
from modetune.core.algebra.vector_room import put_in_file
from modetune.core.correlation.clusters import rotation_onto
from modetune.core.errors import ModesError, ModetuneError, SolverExhausted
from modetune.core.modes import CLOSE, Floats, Integers
from modetune.core.storage.keys import Json, canonical_json, content_key
from modetune.core.updating.derivative_vectors import MOST_FORCES
from modetune.core.updating.job_results import ModalResult
from modetune.core.updating.parameter_matrices import ParameterMatrices, differences
from modetune.core.updating.reduced_basis import ReducedModel, ReducedRange, reduce, reduce_over
from modetune.core.updating.sensitivity import ModeDerivatives, nelson
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.engine import JobEngine, R
from modetune.flows.updating.evaluation import Point
from modetune.flows.updating.matrices import MatrixSource, one_thread
from modetune.flows.updating.sensitivities import UnlikeMatrices

logger = logging.getLogger(__name__)

#: Raised by hand when the same matrices are solved to other numbers.
MODES_VERSION = 6
#: Unobservable nodes that a message names.
NAMED = 5
T = TypeVar("T")
#: From this many unknowns on the store has full solutions that searches begin with: those of
#: smaller models take only a few times as long to solve again as to store.
KEPT_FROM = 50_000
#: Share of the memory that the matrices of all values, or a basis, may take.
IN_MEMORY = 0.1
#: The first task of a resumed campaign, on displays.
AGAIN = "what the search begins with, once more"
#: Raised by hand when the same matrices are reduced to other numbers.
REDUCED_VERSION = 6
RANGE_VERSION = 4
#: The same of exact derivatives.
DERIVATIVES_VERSION = 1


def first_shift(campaign: Campaign) -> float:
    """A shift by the test's first frequency, (rad/s)^2."""
    first = 2.0 * np.pi * float(np.min(campaign.case.measured.modes.frequencies_hz))
    return shift_below(first**2)


def rounding(campaign: Campaign) -> float:
    """Of the matrices' entries, relative."""
    return PRINTED if campaign.case.solver.deck.summary.matrices is None else GIVEN


def solved_energies(
    campaign: Campaign, matrices: MatrixResult, solved: SolvedModes
) -> tuple[Floats, int]:
    """Energies (n_modes,), NaN of rigid modes, and how many modes are rigid."""
    energies = matrix_energies(matrices.upper_stiffness, solved.shapes, rounding(campaign))
    energies[energies == 0.0] = np.nan
    return energies, count_rigid_modes(solved.eigenvalues, energies, lambda: np.inf)


def modes_at(
    observer: Callable[[Integers, Integers], sparse.csr_array],
    eigenvalues: Floats,
    shapes: Floats,
    energies: Floats,
    n_rigid: int,
    analysis: ModalAnalysis,
) -> ModalResult:
    """The modes at an analysis' nodes, of shapes of all unknowns; observer: as `observer_of`."""
    eigenvalues = eigenvalues[: analysis.n_modes]
    nodes, components = named_freedoms(analysis.nodes)
    shapes = observer(nodes, components) @ shapes[:, : analysis.n_modes]
    rigid = min(n_rigid, eigenvalues.size)
    energies = energies[: eigenvalues.size]
    return ModalResult.of_shapes(eigenvalues, shapes, nodes, components, energies, rigid)


def observer_of(
    campaign: Campaign, base: MatrixResult, nodes: Integers, components: Integers
) -> sparse.csr_array:
    """What takes shapes of all unknowns to these degrees of freedom. Raises UnlikeMatrices."""
    seen = campaign.case.solver.deck.observation(base, nodes, components)
    unknown = np.unique(nodes[seen.unknown])
    if unknown.size:
        named = ", ".join(map(str, unknown[:NAMED].tolist()))
        more = f" and {unknown.size - NAMED} more" if unknown.size > NAMED else ""
        raise UnlikeMatrices(
            f"the motion of node {named}{more} does not follow from the stored matrices' unknowns"
        )
    return seen.matrix


def named_freedoms(nodes: tuple[int, ...]) -> tuple[Integers, Integers]:
    """The degrees of freedom of a modal result at these nodes: node by node, x, y, z."""
    ordered = np.array(sorted(nodes), dtype=np.int64)
    return np.repeat(ordered, 3), np.tile(np.arange(1, 4), ordered.size)


@dataclass(frozen=True, slots=True, eq=False)
class ModalSet:
    """A number of modes at values (n_parameters,) as written in decks; start: of the search."""

    key: str
    values: Floats
    n_modes: int
    start: ModalSet | ReducedAround | None


@dataclass(frozen=True, slots=True, eq=False)
class ReducedAround:
    """A reduced model of the modes at a set; modes: those whose derivatives it holds; seen: nodes
    and components of its rows."""

    key: str
    of: ModalSet
    modes: Integers
    seen: tuple[Integers, Integers]


@dataclass(frozen=True, slots=True)
class SolutionAt:
    """Modes at a set with shapes of all unknowns (n, n_modes).

    energies: (n_modes,), NaN where the rounding of the matrices hides them: of rigid modes.
    factors: those that it was found with. previous: the basis (n, r) it was found from, where
    these are not its own.
    """

    eigenvalues: Floats
    shapes: Floats
    energies: Floats
    n_rigid: int
    factors: FactorsAt
    previous: Floats | None


@dataclass(frozen=True, slots=True)
class FactorsAt:
    """The set whose factors are at hand, and their shift, (rad/s)^2."""

    of: ModalSet
    shift: float


@dataclass(frozen=True, slots=True)
class SearchStart:
    """What a search begins with: shift, (rad/s)^2, shapes of all unknowns, factors, a basis."""

    shift: float
    shapes: Floats | None = None
    factors: FactorsAt | None = None
    basis: Floats | None = None


@dataclass(frozen=True, slots=True)
class ReducedBasis:
    """A reduced model and its basis (n, r); n_rigid: modes that are rigid; factors: its modes'."""

    of: ReducedAround
    n_rigid: int
    factors: FactorsAt
    reduced: ReducedModel
    vectors: Floats

    def shapes(self, values: Floats, n_modes: int) -> tuple[Floats, Floats]:
        """Eigenvalues (n_modes,) and shapes of all unknowns (n, n_modes). Raises ModesError."""
        eigenvalues, combined = self.reduced.combinations(values, n_modes)
        return eigenvalues, self.vectors @ combined


@dataclass(frozen=True)
class StoredModel:
    """A campaign's model as matrices, read when something is found from them."""

    campaign: Campaign
    source: MatrixSource

    @cached_property
    def matrices(self) -> ParameterMatrices:
        """For all values; in files where they would take much of the memory that factors need."""
        columns = range(len(self.source.parameters))
        found = self.source.last_matrices(self.campaign.start, columns)
        return found if found.n_bytes <= self.in_memory else self.in_files(found.in_files)

    @property
    def in_memory(self) -> float:
        """What large arrays may take in memory, bytes."""
        return IN_MEMORY * self.source.engine.memory_bytes

    def in_files(self, put: Callable[[Path], T]) -> T:
        """What puts arrays in files of a folder; these have no names, and go with the arrays."""
        files = self.source.engine.room.files()
        try:
            return put(files.folder)
        finally:
            files.remove()

    def observer(self, nodes: Integers, components: Integers) -> sparse.csr_array:
        """What takes shapes of all unknowns to these degrees of freedom. Raises UnlikeMatrices."""
        mark = nodes.tobytes(), components.tobytes()
        if mark not in self._observers:
            base = self.matrices.base
            self._observers[mark] = observer_of(self.campaign, base, nodes, components)
        return self._observers[mark]

    @cached_property
    def _observers(self) -> dict[tuple[bytes, bytes], sparse.csr_array]:
        """By what they were asked for: in a large model each takes as long as some solutions."""
        return {}


class Solutions:
    """Solutions in memory, and found again where they have left it: the newest of each kind."""

    def __init__(self, model: StoredModel, engine: JobEngine, shift: float) -> None:
        """shift: where none is known, (rad/s)^2."""
        self.model = model
        self.engine = engine
        self.shift = shift
        # The solver's own modes at the end show whether any was missed, so they are not counted.
        self._solver = ModeSolver(count=False)
        self._newest: tuple[ModalSet, SolutionAt] | None = None
        self._first: tuple[ModalSet, SolutionAt] | None = None
        self._basis: ReducedBasis | None = None
        self._factors: FactorsAt | None = None
        self._kept: list[str] = []

    @property
    def held(self) -> str:
        """How the factors are held, where that is not in double precision in memory."""
        return self._solver.held

    def modes(self, item: ModalSet) -> SolutionAt:
        """The modes of a set with shapes of all unknowns."""
        if self._newest is not None and self._newest[0] is item:
            return self._newest[1]
        solved = self._stored(item)
        here = self.model.matrices.at(item.values)
        energies, n_rigid = solved_energies(self.model.campaign, here, solved)
        factors, previous = FactorsAt(item, solved.shift), None
        if solved.way.startswith(KEPT):
            start = self._beginning(item)
            assert start.factors is not None
            factors, previous = start.factors, start.basis
        shapes = solved.shapes
        found = SolutionAt(solved.eigenvalues, shapes, energies, n_rigid, factors, previous)
        self._newest = item, found
        return found

    def _stored(self, item: ModalSet) -> SolvedModes:
        """The modes of a set; of a large model in the store, as long as others begin with them."""
        if self.model.matrices.base.nodes.size < KEPT_FROM:
            return self._searched(item)
        asked: Json = {"solution": item.key}
        key = content_key(canonical_json(asked))
        known = key in self.engine.store
        found = self.engine.derived(asked, lambda: self._searched(item), SolvedModes)
        self._kept.append(key)
        if not known and not found.way.startswith(KEPT):
            self.forget(key)  # nothing leads back beyond this one
        return found

    def _searched(self, item: ModalSet) -> SolvedModes:
        start = self._beginning(item)
        here = self.model.matrices.at(item.values)
        at_hand, solved = self._solved(item, start, here, count=False)
        own = not solved.way.startswith(KEPT)
        self._factors = FactorsAt(item, solved.shift) if own else at_hand
        return solved

    def forget(self, but: str = "") -> None:
        """Take what is kept for others to begin with out of the store, all but the one named."""
        for key in set(self._kept) - {but}:
            self.engine.store.drop(key)
        self._kept = [but] if but else []

    def assembled(
        self, item: ModalSet, begun: Callable[[], Callable[[], MatrixResult]], count: bool
    ) -> tuple[SolvedModes, tuple[Floats, int]]:
        """Modes of the matrices that the solver assembles at a set, and of these modes energies
        (n_modes,) and how many are rigid. begun: has it begin, and gives what waits for its end;
        count: whether it is to be proved that none is missing, for which there may be no room.

        Where the matrices differ from those of all values by the rounding of their text alone they
        have the same modes, which are looked for while the solver is at it, if its job leaves
        cores: the order of unknowns and the factors at hand serve. Raises ModelError where they
        have other equations.
        """
        start, there = self._beginning(item), self.model.matrices.at(item.values)
        wait = begun()
        beside = self.engine.cores_beside
        if self.engine.policy.memory_bytes:  # what a campaign names is the job's alone
            self._solver, self._factors, beside = ModeSolver(count=False), None, 0
            self._newest = self._first = self._basis = None
            start = replace(start, basis=None)
        if not beside:
            wait()
        try:
            found = self._counted(item, start, there, count, beside)
        except ModetuneError:
            wait()
            raise
        here = wait()
        if any(upper.nnz for upper in differences(there, here)):
            there, found = here, self._counted(item, start, here, found.counted)
        return found, solved_energies(self.model.campaign, there, found)

    def _counted(
        self, item: ModalSet, start: SearchStart, here: MatrixResult, count: bool, beside: int = 0
    ) -> SolvedModes:
        """As `_solved`, uncounted where a count has no room and may be left out."""
        try:
            return self._solved(item, start, here, count, beside)[1]
        except SolverExhausted as error:
            if not count or self.engine.policy.single_factors is False:
                raise
            logger.warning("modes at the end are not counted: %s", error)
            return self._solved(item, start, here, False, beside)[1]

    def lent(self) -> ModeSolver:
        """What solves the model, to whoever leaves other factors in it."""
        self._newest = self._factors = None
        return self._solver

    def _solved(
        self, item: ModalSet, start: SearchStart, here: MatrixResult, count: bool, beside: int = 0
    ) -> tuple[FactorsAt | None, SolvedModes]:
        """The factors that were at hand, and modes.

        beside: cores that are counted for it, 0 for all. PARDISO keeps to as many threads as it
        has ordered the unknowns with: on others its factors in two levels are wrong.
        Of what is in memory the shapes are gone after it, and other factors are at hand.
        """
        self._newest = None
        with self.engine.all_cores(beside):
            kept = self._at_hand(start.factors, item.n_modes)
            at_hand, self._factors = self._factors, None
            upper = here.upper_stiffness, here.upper_mass
            return at_hand, self._solver.solve(
                *upper, item.n_modes, start.shift, start.shapes, kept, count
            )

    def _at_hand(self, factors: FactorsAt | None, n_modes: int) -> int:
        """For how many blocks these factors are worth being kept; made once more if need be."""
        blocks = 0 if factors is None else self._solver.blocks_that_pay(n_modes)
        if blocks and factors is not None:
            self._hold(factors)
        return blocks

    def _hold(self, factors: FactorsAt) -> None:
        """Make these the factors at hand."""
        if factors != self._factors:
            there, n_modes = self.model.matrices.at(factors.of.values), factors.of.n_modes
            upper = there.upper_stiffness, there.upper_mass
            self._solver.factorise(*upper, factors.shift, n_modes)
            self._factors = factors

    def basis(self, around: ReducedAround) -> ReducedBasis:
        """A reduced model with its basis."""
        if self._basis is None or self._basis.of is not around:
            solved, observer = self.modes(around.of), self.model.observer(*around.seen)
            own = solved.factors.of is around.of
            with self.engine.all_cores():
                self._hold(solved.factors)
                made = reduce(
                    self.model.matrices,
                    around.of.values,
                    solved.eigenvalues,
                    solved.shapes,
                    self._solver.inverse,
                    around.modes,
                    solved.n_rigid,
                    observer,
                    solved.previous,
                    exact=own and self._solver.inverts_exactly,
                )
            reduced, vectors = made
            if vectors.nbytes > self.model.in_memory:
                vectors = self.model.in_files(lambda folder: put_in_file(folder, vectors.T).T)
            self._basis = ReducedBasis(around, solved.n_rigid, solved.factors, reduced, vectors)
        return self._basis

    def _beginning(self, item: ModalSet) -> SearchStart:
        """What a search begins with."""
        if item.start is None:
            return SearchStart(self.shift)
        if isinstance(item.start, ModalSet):
            if self._first is None or self._first[0] is not item.start:
                self._first = item.start, self.modes(item.start)
            first, factors, basis = self._first[1], None, None
            eigenvalues, shapes, n_rigid = first.eigenvalues, first.shapes, first.n_rigid
        else:
            self._first = None
            again = self._basis is None or self._basis.of is not item.start
            try:
                name = AGAIN if again else ""
                around = item.start
                newest = self.engine.tasks.compute(name, lambda: (self.basis(around), ()))
                eigenvalues, shapes = newest.shapes(item.values, item.n_modes)
            except ModesError as error:
                logger.debug("no start from a reduced model: %s", error)
                return SearchStart(self.shift)
            basis, n_rigid, factors = newest.vectors, newest.n_rigid, newest.factors
        elastic = eigenvalues[n_rigid:]
        shift = shift_below(float(elastic[0])) if elastic.size else self.shift
        return SearchStart(shift, shapes, factors, basis)


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
