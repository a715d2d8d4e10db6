"""Modes of a campaign's model from its stored matrices, solved in this process.

The store keeps the modes at each point like a solver's result. An eigenvalue search that starts
from the modes of another point takes half as long as one from random vectors, but its last digits
differ. So a key includes the start of its search, and the digits are the same in every process:

    the first point            random vectors
    later points               the modes of the first one
    after the first basis      the modes of the newest reduced model at the point

If a factorisation takes longer than it saves (large models), a search from a reduced model uses the
factors with which the modes of that model were computed. If those factors have been replaced,
because a point was too far away, they are computed again.

Shapes of all unknowns and the newest basis stay in memory. After a kill the start of the next
search is computed again. The store keeps the shapes of a large model as long as a search may start
from them, so that one factorisation is enough; those of a small model are computed point by point.

Matrices that the solver assembles at the end have the modes found there, if they are the matrices
of all values at that point. Then one factorisation counts the modes, to prove that none is missing,
and nothing is searched. Other matrices are solved from these modes.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Mapping
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
from modetune.flows.updating.matrices import MatrixSource
from modetune.flows.updating.sensitivities import UnlikeMatrices

logger = logging.getLogger(__name__)

#: Increase this number when the same matrices give other modes.
MODES_VERSION = 7
#: Number of unobservable nodes in a message.
NAMED = 5
T = TypeVar("T")
#: Number of unknowns from which the store keeps full solutions as starts of searches: solving a
#: smaller model again takes only a few times as long as storing its modes.
KEPT_FROM = 50_000
#: Share of the memory that the matrices of all values, or a basis, may take.
IN_MEMORY = 0.1
#: The first task of a resumed campaign, on displays.
AGAIN = "start of the search, computed again"
#: Increase this number when the same matrices give other reduced models.
REDUCED_VERSION = 7
RANGE_VERSION = 5
#: The same for exact derivatives.
DERIVATIVES_VERSION = 1


def first_shift(campaign: Campaign) -> float:
    """Return a shift that follows from the test's first frequency, (rad/s)^2."""
    first = 2.0 * np.pi * float(np.min(campaign.case.measured.modes.frequencies_hz))
    return shift_below(first**2)


def rounding(campaign: Campaign) -> float:
    """Return the relative rounding error of the matrices' entries."""
    return PRINTED if campaign.case.solver.deck.summary.matrices is None else GIVEN


def solved_energies(
    campaign: Campaign, matrices: MatrixResult, solved: SolvedModes
) -> tuple[Floats, int]:
    """Return energies (n_modes,), NaN for rigid modes, and the number of rigid modes."""
    energies = matrix_energies(matrices.upper_stiffness, solved.shapes, rounding(campaign))
    energies[energies == 0.0] = np.nan
    return energies, count_rigid_modes(solved.eigenvalues, energies, lambda: np.inf)


def modes_at(
    model: StoredModel,
    eigenvalues: Floats,
    shapes: Floats,
    energies: Floats,
    n_rigid: int,
    analysis: ModalAnalysis,
) -> ModalResult:
    """Return the modes at an analysis' nodes from those of all the model's unknowns."""
    eigenvalues = eigenvalues[: analysis.n_modes]
    nodes, components = model.freedoms(analysis.nodes)
    shapes = model.observer(nodes, components) @ shapes[:, : analysis.n_modes]
    rigid = min(n_rigid, eigenvalues.size)
    energies = energies[: eigenvalues.size]
    return ModalResult.of_shapes(eigenvalues, shapes, nodes, components, energies, rigid)


def observer_of(
    campaign: Campaign, base: MatrixResult, nodes: Integers, components: Integers
) -> sparse.csr_array:
    """Return the map from all unknowns to these degrees of freedom. Raises UnlikeMatrices."""
    seen = campaign.case.solver.deck.observation(base, nodes, components)
    unknown = np.unique(nodes[seen.unknown])
    if unknown.size:
        named = ", ".join(map(str, unknown[:NAMED].tolist()))
        more = f" and {unknown.size - NAMED} more" if unknown.size > NAMED else ""
        raise UnlikeMatrices(
            f"the motion of node {named}{more} does not follow from the stored matrices' unknowns"
        )
    return seen.matrix


def named_freedoms(nodes: tuple[int, ...], turning: Integers) -> tuple[Integers, Integers]:
    """Return the degrees of freedom of a modal result at nodes, and their components.

    turning: nodes whose rotations sensors see. Node by node x, y, z, and rotations of these.
    """
    ordered = np.array(sorted(nodes), dtype=np.int64)
    counts = np.where(np.isin(ordered, turning), 6, 3)
    starts = np.repeat(np.cumsum(counts) - counts, counts)
    return np.repeat(ordered, counts), np.arange(starts.size) - starts + 1


@dataclass(frozen=True, slots=True, eq=False)
class ModalSet:
    """A number of modes at values (n_parameters,) as written in decks; start: of the search."""

    key: str
    values: Floats
    n_modes: int
    start: ModalSet | ReducedAround | None

    def is_in(self, other: ModalSet) -> bool:
        """Return whether another set at the same values has all these modes."""
        return self.n_modes <= other.n_modes and np.array_equal(self.values, other.values)


@dataclass(frozen=True, slots=True, eq=False)
class ReducedAround:
    """A reduced model around a point.

    modes: those whose derivatives it contains; seen: nodes and components of its rows.
    """

    key: str
    of: ModalSet
    modes: Integers
    seen: tuple[Integers, Integers]


@dataclass(frozen=True, slots=True)
class SolutionAt:
    """Modes at a point with shapes of all unknowns (n, n_modes).

    energies: (n_modes,), NaN for rigid modes, whose energies are below the rounding of the
    matrices.
    """

    solved: SolvedModes
    energies: Floats
    n_rigid: int

    @property
    def own_factors(self) -> bool:
        """Return whether the search used the point's own factors."""
        return not self.solved.way.startswith(KEPT)


@dataclass(frozen=True, slots=True)
class FactorsAt:
    """The point whose factors are in memory, and their shift, (rad/s)^2."""

    of: ModalSet
    shift: float


@dataclass(frozen=True, slots=True)
class SearchStart:
    """The start of a search: shift, (rad/s)^2, shapes of all unknowns, factors, a basis."""

    shift: float
    shapes: Floats | None = None
    factors: FactorsAt | None = None
    basis: Floats | None = None


@dataclass(frozen=True, slots=True)
class ReducedBasis:
    """A reduced model and its basis (n, r); factors: its modes', n_modes, n_rigid of them rigid."""

    of: ReducedAround
    n_modes: int
    n_rigid: int
    factors: FactorsAt
    reduced: ReducedModel
    vectors: Floats

    def available(self, n_modes: int) -> int:
        """Return n_modes, or the number of all modes of a model that has fewer."""
        return min(n_modes, self.n_modes) if self.n_modes < self.of.of.n_modes else n_modes

    def shapes(self, values: Floats, n_modes: int) -> tuple[Floats, Floats]:
        """Return eigenvalues (n_modes,) and shapes (n, n_modes). Raises ModesError."""
        eigenvalues, combined = self.reduced.combinations(values, self.available(n_modes))
        return eigenvalues, self.vectors @ combined


@dataclass(frozen=True)
class StoredModel:
    """A campaign's model as matrices, which are read when first needed."""

    campaign: Campaign
    source: MatrixSource

    @cached_property
    def matrices(self) -> ParameterMatrices:
        """Return the matrices of all values, in files if factors need the memory."""
        columns = range(len(self.source.parameters))
        found = self.source.last_matrices(self.campaign.start, columns)
        return found if found.n_bytes <= self.in_memory else self.in_files(found.in_files)

    @property
    def in_memory(self) -> float:
        """Return the permitted size of large arrays in memory, bytes."""
        return IN_MEMORY * self.source.engine.memory_bytes

    @cached_property
    def _turning(self) -> Integers:
        """Return the nodes whose rotations sensors see."""
        return np.array(self.campaign.case.rotation_nodes, dtype=np.int64)

    def freedoms(self, nodes: tuple[int, ...]) -> tuple[Integers, Integers]:
        """Return `named_freedoms` of the case's sensors."""
        return named_freedoms(nodes, self._turning)

    def named(self, nodes: tuple[int, ...]) -> dict[str, Json]:
        """Return what of a content key says at which degrees of freedom results are."""
        turning = sorted({*nodes} & {*self._turning.tolist()})
        return {"nodes": list(nodes), **({"rotations": turning} if turning else {})}

    def in_files(self, put: Callable[[Path], T]) -> T:
        """Return the result of `put` with arrays in unnamed files, which are freed with them."""
        files = self.source.engine.room.files()
        try:
            return put(files.folder)
        finally:
            files.remove()

    def observer(self, nodes: Integers, components: Integers) -> sparse.csr_array:
        """Return the map from all unknowns to these degrees of freedom. Raises UnlikeMatrices."""
        mark = nodes.tobytes(), components.tobytes()
        if mark not in self._observers:
            base = self.matrices.base
            self._observers[mark] = observer_of(self.campaign, base, nodes, components)
        return self._observers[mark]

    @cached_property
    def _observers(self) -> dict[tuple[bytes, bytes], sparse.csr_array]:
        """Cache observers by request: in a large model each takes as long as several solutions."""
        return {}


class Solutions:
    """The newest solutions of each type, in memory or computed again."""

    def __init__(
        self,
        model: StoredModel,
        engine: JobEngine,
        shift: float,
        sets: Mapping[tuple[float, ...], ModalSet],
    ) -> None:
        """Set up without solutions; shift: of the first search, (rad/s)^2; sets: all requests."""
        self.model = model
        self.engine = engine
        self.shift = shift
        self.sets = sets
        # The solver's own modes at the end would reveal a missed one, so these are not counted.
        self._solver = ModeSolver(count=False)
        self._newest: tuple[ModalSet, SolutionAt] | None = None
        self._first: tuple[ModalSet, SolutionAt] | None = None
        self._basis: ReducedBasis | None = None
        self._factors: FactorsAt | None = None

    @property
    def held(self) -> str:
        """Return where factors are kept, if not in memory in double precision."""
        return self._solver.held

    def modes(self, item: ModalSet) -> SolutionAt:
        """Return the modes of a point with shapes of all unknowns."""
        if self._newest is None or self._newest[0] is not item:
            self._newest = (
                item,
                self._with_energies(self._stored(item), self.model.matrices.at(item.values)),
            )
        return self._newest[1]

    def _with_energies(self, solved: SolvedModes, here: MatrixResult) -> SolutionAt:
        return SolutionAt(solved, *solved_energies(self.model.campaign, here, solved))

    @property
    def _keeps(self) -> bool:
        """Return whether the store keeps solutions while searches need them."""
        return self.model.matrices.base.nodes.size >= KEPT_FROM

    def _stored(self, item: ModalSet) -> SolvedModes:
        """Return the modes of a point, of a large model from the store."""
        if not self._keeps:
            return self._searched(item)
        known = _solution_key(item) in self.engine.store
        found = self.engine.derived(
            _asked_solution(item), lambda: self._searched(item), SolvedModes
        )
        if not known and not found.way.startswith(KEPT):
            self.forget(item)  # nothing leads back beyond this one
        return found

    def _searched(self, item: ModalSet) -> SolvedModes:
        start = self._beginning(item)
        here = self.model.matrices.at(item.values)
        at_hand, solved = self._solved(item, start, here, count=False)
        own = not solved.way.startswith(KEPT)
        self._factors = FactorsAt(item, solved.shift) if own else at_hand
        return solved

    def forget(self, but: ModalSet | None = None) -> None:
        """Remove solutions from the store, except one."""
        if self._keeps:
            for item in self.sets.values():
                if item is not but:
                    self.engine.store.drop(_solution_key(item))

    def assembled(
        self, item: ModalSet, begun: Callable[[], Callable[[], MatrixResult]], count: bool
    ) -> SolutionAt:
        """Return modes of the matrices that the solver assembles at a point.

        begun: starts the solver and returns a function that waits for its end. count: prove that no
        mode is missing, if there is memory for it.

        If the matrices differ from those of all values only by rounding in the text, they have the
        same modes. These are counted while the solver runs, if its job leaves cores free, with the
        existing order of unknowns; they are searched for if the point was not solved before. Raises
        ModelError if the matrices have other equations.
        """
        start, there = self._beginning(item), self.model.matrices.at(item.values)
        known = None
        if self._first is not None and item.is_in(self._first[0]):
            known = self._first[1].solved.first(item.n_modes)
        wait = begun()
        beside = self.engine.cores_beside
        if self.engine.policy.memory_bytes:  # what a campaign names is the job's alone
            self._solver, self._factors, beside = ModeSolver(count=False), None, 0
            self._newest = self._first = self._basis = None
            start = replace(start, basis=None)
        if not beside:
            wait()
        try:
            found = self._counted(item, start, there, count, beside, known)
        except ModetuneError:
            wait()
            raise
        here = wait()
        if any(upper.nnz for upper in differences(there, here)):
            there, found = here, self._counted(item, start, here, found.counted)
        return self._with_energies(found, there)

    def _counted(
        self,
        item: ModalSet,
        start: SearchStart,
        here: MatrixResult,
        count: bool,
        beside: int = 0,
        known: SolvedModes | None = None,
    ) -> SolvedModes:
        """Return `_solved`, without a count if it is optional and does not fit into memory.

        known: the modes of these matrices, if they need not be searched for.
        """
        try:
            if known is not None and count:
                self._newest = self._factors = None
                with self.engine.all_cores(beside):
                    known = self._solver.counted(here.upper_stiffness, here.upper_mass, known)
            if known is None:
                known = self._solved(item, start, here, count, beside)[1]
        except SolverExhausted as error:
            if not count or self.engine.policy.single_factors is False:
                raise
            logger.warning("modes at the end are not counted: %s", error)
            if known is None:
                known = self._solved(item, start, here, False, beside)[1]
        return known

    def lent(self) -> ModeSolver:
        """Lend the solver of the model to a caller that leaves other factors in it."""
        self._newest = self._factors = None
        return self._solver

    def _solved(
        self, item: ModalSet, start: SearchStart, here: MatrixResult, count: bool, beside: int = 0
    ) -> tuple[FactorsAt | None, SolvedModes]:
        """Return the previous factors, and the modes.

        beside: number of cores to use, 0 for all. PARDISO must use as many threads as for the order
        of unknowns: with another number its two-level factors are wrong. The call removes the
        shapes from memory and replaces the factors.
        """
        self._newest = None
        with self.engine.all_cores(beside):
            kept = self._at_hand(start.factors, item.n_modes)
            at_hand, self._factors = self._factors, None
            upper = here.upper_stiffness, here.upper_mass
            return at_hand, self._solver.solve_available(
                *upper, item.n_modes, start.shift, start.shapes, kept, count
            )

    def _at_hand(self, factors: FactorsAt | None, n_modes: int) -> int:
        """Return for how many blocks to keep these factors; compute them again if necessary."""
        blocks = 0 if factors is None else self._solver.blocks_that_pay(n_modes)
        if blocks and factors is not None:
            self._hold(factors)
        return blocks

    def _hold(self, factors: FactorsAt) -> None:
        """Compute these factors and keep them in memory."""
        if factors != self._factors:
            there, n_modes = self.model.matrices.at(factors.of.values), factors.of.n_modes
            upper = there.upper_stiffness, there.upper_mass
            self._solver.factorise(*upper, factors.shift, n_modes)
            self._factors = factors

    def basis(self, around: ReducedAround) -> ReducedBasis:
        """Return a reduced model with its basis."""
        if self._basis is None or self._basis.of is not around:
            found, observer = self.modes(around.of), self.model.observer(*around.seen)
            solved, own = found.solved, found.own_factors
            factors, previous = FactorsAt(around.of, solved.shift), None
            if not own:
                start = self._beginning(around.of)
                assert start.factors is not None
                factors, previous = start.factors, start.basis
            with self.engine.all_cores():
                self._hold(factors)
                made = reduce(
                    self.model.matrices,
                    around.of.values,
                    solved.eigenvalues,
                    solved.shapes,
                    self._solver.inverse,
                    around.modes,
                    found.n_rigid,
                    observer,
                    previous,
                    exact=own and self._solver.inverts_exactly,
                )
            reduced, vectors = made
            if vectors.nbytes > self.model.in_memory:
                vectors = self.model.in_files(lambda folder: put_in_file(folder, vectors.T).T)
            self._basis = ReducedBasis(
                around, solved.eigenvalues.size, found.n_rigid, factors, reduced, vectors
            )
        return self._basis

    def _beginning(self, item: ModalSet) -> SearchStart:
        """Return the start of a search."""
        if item.start is None:
            return SearchStart(self.shift)
        if isinstance(item.start, ModalSet):
            if self._first is None or self._first[0] is not item.start:
                self._first = item.start, self.modes(item.start)
            first, factors, basis = self._first[1], None, None
            eigenvalues, shapes, n_rigid = _all_unknowns(first)
        else:
            self._first = None
            again = self._basis is None or self._basis.of is not item.start
            try:
                name = AGAIN if again else ""
                around = item.start
                newest = self.engine.tasks.compute(name, lambda: (self.basis(around), ()))
                eigenvalues, shapes = newest.shapes(item.values, item.n_modes)
            except ModesError as error:
                logger.debug("the search does not start from a reduced model: %s", error)
                return SearchStart(self.shift)
            basis, n_rigid, factors = newest.vectors, newest.n_rigid, newest.factors
        elastic = eigenvalues[n_rigid:]
        shift = shift_below(float(elastic[0])) if elastic.size else self.shift
        return SearchStart(shift, shapes, factors, basis)


def _all_unknowns(found: SolutionAt) -> tuple[Floats, Floats, int]:
    """Return eigenvalues (n_modes,), shapes (n, n_modes) and the number of rigid modes."""
    return found.solved.eigenvalues, found.solved.shapes, found.n_rigid


def _asked_solution(item: ModalSet) -> Json:
    return {"solution": item.key}


def _solution_key(item: ModalSet) -> str:
    return content_key(canonical_json(_asked_solution(item)))


class NotCounted(Exception):
    """Modes were computed, but memory did not suffice to count them."""


class MatrixModes:
    """Modes and reduced models of one campaign's model by its stored matrices.

    The start of each search follows from the order of requests, not from the contents of the store.
    """

    def __init__(self, campaign: Campaign, engine: JobEngine, source: MatrixSource) -> None:
        self.campaign = campaign
        self.engine = engine
        self.source = source
        columns = range(len(source.parameters))
        self._model = StoredModel(campaign, source)
        self._matrices_key = source.key(campaign.start, columns)
        if source.jobs(campaign.start, columns):
            _ = self._model.matrices  # assemble the matrices from the jobs' results at once
        self._shift = first_shift(campaign)
        self._sets: dict[tuple[float, ...], ModalSet] = {}
        self._solutions = Solutions(self._model, engine, self._shift, self._sets)
        self._first: dict[int, ModalSet] = {}
        self._reduced: dict[str, ReducedAround] = {}
        self._around: ReducedAround | None = None
        #: Of the newest modes, as the store has them: factors that are not in memory in double
        #: precision.
        self.factors = ""

    def modal(self, theta: Floats, analysis: ModalAnalysis) -> tuple[str, ModalResult]:
        """Return the key and the modes of a point at the analysis' nodes.

        Raises UnlikeMatrices if the nodes' motion does not follow from the matrices' unknowns."""
        item = self._set(theta, analysis.n_modes)

        def compute() -> ModalResult:
            return self._seen(self._solutions.modes(item), analysis)

        asked = _asked_modes(item, self._model.named(analysis.nodes))
        found = self._derived(asked, compute, ModalResult, "modal by stored matrices")
        return self._noted(asked), self.engine.solver.by_hand(found)

    def assembled(
        self,
        theta: Floats,
        analysis: ModalAnalysis,
        job: str,
        begun: Callable[[], Callable[[], MatrixResult]],
    ) -> tuple[str, ModalResult, bool]:
        """Return `modal` for matrices that the solver assembles at a point, and whether counted.

        job: the key of its job; begun: as in `Solutions.assembled`, which begins with the modes of
        the matrices of all values. Factors in single precision cannot count modes: if the campaign
        requires them, or memory is too small for others, modes are not counted. Raises
        ModelError if the count shows that modes are missing.
        """
        n_modes = min(analysis.n_modes, self._model.matrices.base.nodes.size)
        here = ModalSet("", self.source.written(theta), n_modes, None)
        known = (item for item in self._sets.values() if here.is_in(item))
        start = next(known, self._newest or next(iter(self._first.values()), None))

        def asked(counted: bool) -> Json:
            return {
                "assembled modes": MODES_VERSION,
                "matrices": job,
                "from": self._shift if start is None else start.key,
                "n_modes": analysis.n_modes,
                **self._model.named(analysis.nodes),
                **({} if counted else {"counted": False}),
            }

        keys = {counted: content_key(canonical_json(asked(counted))) for counted in (True, False)}

        uncounted: list[SolutionAt] = []

        def solved_there(counted: bool) -> SolutionAt:
            item = replace(here, key=keys[counted], start=start)
            return self._solutions.assembled(item, begun, counted)

        def found(counted: bool) -> tuple[str, ModalResult, bool]:
            def compute() -> ModalResult:
                there = uncounted.pop() if uncounted else solved_there(counted)
                if counted and not there.solved.counted:
                    uncounted.append(there)
                    raise NotCounted
                self.engine.store.drop(job)  # as large as the model, and not needed again
                self._solutions.forget()
                return self._seen(there, analysis)

            name = "modes of assembled matrices" + ", counted" * counted
            modal = self._derived(asked(counted), compute, ModalResult, name)
            return self._noted(asked(counted)), self.engine.solver.by_hand(modal), counted

        if self.engine.policy.single_factors or keys[False] in self.engine.store:
            return found(counted=False)
        try:
            return found(counted=True)
        except NotCounted:
            return found(counted=False)

    def release(self) -> None:
        """Remove the stored starts of searches when no search follows."""
        self._solutions.forget()

    def key(self, theta: Floats, analysis: ModalAnalysis) -> str:
        """Return the key of `modal` without computing anything."""
        asked = _asked_modes(self._set(theta, analysis.n_modes), self._model.named(analysis.nodes))
        return content_key(canonical_json(asked))

    def foreseen(self, theta: Floats, analysis: ModalAnalysis) -> tuple[str, ModalResult]:
        """Return `modal` from the newest reduced model. Raises ModesError if it lacks modes."""
        around = self._around
        if around is None or around is not self._newest:  # it would have to be computed again
            return self.modal(theta, analysis)
        values = self.source.written(theta)

        def compute() -> ModalResult:
            basis = self._solutions.basis(around)
            eigenvalues, shapes = basis.shapes(values, analysis.n_modes)
            energies = 0.5 * eigenvalues
            energies[: basis.n_rigid] = np.nan
            found = eigenvalues, shapes, energies, basis.n_rigid
            return modes_at(self._model, *found, analysis)

        asked: Json = {
            "foreseen": around.key,
            "theta": values.tolist(),
            "n_modes": analysis.n_modes,
            **self._model.named(analysis.nodes),
        }
        found = self._derived(asked, compute, ModalResult, "modal by the reduced model")
        return self._noted(asked), self.engine.solver.by_hand(found)

    def over(
        self,
        point: Point,
        thetas: Floats,
        analysis: ModalAnalysis,
        accuracy: float,
        tell: Callable[[int, float], None],
    ) -> tuple[str, ReducedRange]:
        """Return the key and a reduced model for all these points (n_points, n_parameters).

        It begins at an evaluation point. The relative error of frequencies is at most `accuracy`.
        The store keeps the full solutions until it has the reduced model.
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
            # The start, and so the last digits, follow from the previous solutions.
            one: Json = {"full solution": len(kept), "of": asked, "theta": at.tolist()}
            kept.append(content_key(canonical_json(one)))
            return self.engine.derived(one, solve, SolvedModes)

        def compute() -> ReducedRange:
            begin, observer = self._solutions.basis(around), self._model.observer(*around.seen)
            with self.engine.all_cores():
                return reduce_over(
                    self._model.matrices,
                    values,
                    (begin.reduced, begin.vectors),
                    begin.available(analysis.n_modes),
                    begin.n_rigid,
                    observer,
                    accuracy,
                    tell,
                    keep,
                    self._solutions.lent(),
                )

        found = self._derived(asked, compute, ReducedRange, "reduced model between the bounds")
        for key in kept:  # large, and now part of the reduced model: needed only after a kill
            self.engine.store.drop(key)
        return content_key(canonical_json(asked)), found

    def reduced(self, point: Point, analysis: ModalAnalysis) -> ReducedModel:
        """Return the reduced model around a point, for its pairs, at the campaign's nodes."""
        item, nodes = self._set(point.theta, analysis.n_modes), self.campaign.case.nodes
        modes = point.pairing.computed + point.modal.n_rigid
        asked: Json = {
            "reduced": REDUCED_VERSION,
            "around": item.key,
            "pairs": modes.tolist(),
            **self._model.named(nodes),
        }
        key = content_key(canonical_json(asked))
        if key not in self._reduced:
            self._reduced[key] = ReducedAround(key, item, modes, self._model.freedoms(nodes))
        around = self._around = self._reduced[key]
        return self._derived(
            asked, lambda: self._solutions.basis(around).reduced, ReducedModel, "reduced model"
        )

    def derivatives(self, point: Point, analysis: ModalAnalysis) -> ModeDerivatives | None:
        """Return exact derivatives of an evaluation point's pairs at the campaign's nodes.

        None unless there are more pairs than a reduced model holds, whose derivatives of shapes
        would then be wrong by several per cent."""
        around, n = self._around, point.theta.size
        if around is None or n * around.modes.size <= MOST_FORCES:
            return None

        def compute() -> ModeDerivatives:
            there, matrices = self._solutions.modes(around.of), self._model.matrices
            observer, here = self._model.observer(*around.seen), matrices.at(around.of.values)
            eigenvalues, shapes, n_rigid = _all_unknowns(there)
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
        def note() -> str:
            return f"factors{self._solutions.held}" if self._solutions.held else ""

        return self.engine.derived(asked, compute, kind, self.campaign.case.of(name), note)

    def _noted(self, asked: Json) -> str:
        """Return the key of a result, and remember with which factors it was computed."""
        key = content_key(canonical_json(asked))
        holding = self.engine.store.holding(key)
        self.factors = "" if holding is None else holding.note
        return key

    @property
    def _newest(self) -> ReducedAround | None:
        """Return the reduced model of the newest request that was not a repetition."""
        return next(reversed(self._reduced.values()), None)

    def _seen(self, found: SolutionAt, analysis: ModalAnalysis) -> ModalResult:
        solved = found.solved.eigenvalues, found.solved.shapes, found.energies, found.n_rigid
        return modes_at(self._model, *solved, analysis)

    def _set(self, theta: Floats, n_modes: int) -> ModalSet:
        """Return a point with the start of its search."""
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


def _asked_modes(item: ModalSet, named: dict[str, Json]) -> Json:
    return {"modes at": item.key, **named}
