"""Solutions of a campaign's stored matrices in memory: what modes are found with.

Where a factorisation takes longer than what it spares (large models), a search from a reduced model
goes on with the factors that the modes behind that were found with, their own or again those of an
earlier set. So this too follows from the start alone; where other factors have taken their place,
since a set lay too far away and was not kept, they are made once more.

Shapes of all unknowns and the newest basis stay in memory. Where a campaign goes on that was killed
what its next search begins with is made once more. Of a large model the shapes are in the store
until they are of no more use, so that one factorisation does for that; of a small one they are
found set by set. Matrices that the solver assembles at a set are solved the same way, and their
modes are counted.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar

from scipy import sparse

from modetune.core.algebra.eigen import KEPT, ModeSolver, SolvedModes
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.algebra.pencil import shift_below
from modetune.core.algebra.vector_room import put_in_file
from modetune.core.errors import ModesError, ModetuneError, SolverExhausted
from modetune.core.modes import Floats, Integers
from modetune.core.storage.keys import Json, canonical_json, content_key
from modetune.core.updating.matrix_samples import differences
from modetune.core.updating.parameter_matrices import ParameterMatrices
from modetune.core.updating.reduced import ReducedModel
from modetune.core.updating.reduced_basis import reduce
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.updating.matrix_source import MatrixSource
from modetune.flows.updating.observed_modes import observer_of, solved_energies

logger = logging.getLogger(__name__)

T = TypeVar("T")

#: Unknowns from which full solutions that others begin with are in the store meanwhile: those of
#: smaller models are found again in a few times what it takes to keep them.
KEPT_FROM = 50_000
#: Share of the memory that the matrices of all values, or a basis, may take.
IN_MEMORY = 0.1
#: What a campaign that goes on makes first, for people who watch.
AGAIN = "what the search begins with, once more"


@dataclass(frozen=True, slots=True, eq=False)
class ModalSet:
    """So many modes at values (n_parameters,) as decks hold them; start: what they begin with."""

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
        # The solver's own modes at the end tell whether any was missed: no need to count them.
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
