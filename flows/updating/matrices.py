"""The stiffness and mass matrices of a campaign's model as functions of its parameters.

If the matrices are sums of powers of each parameter, the solver runs the jobs of `matrix_plan` once
for a model. The result, `core/updating/parameter_matrices`, replaces them in the store; it is as
large as two of them for any number of parameters. Otherwise (Poisson's ratio, two parameters that
scale the same quantity) the jobs are run around one point, and the result is valid only for
derivatives at that point. A model given as matrices has its own parts and needs no job.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy import sparse

from modetune.adapters.solver import MatrixAnalysis
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from modetune.core.parameters import Parameter, ParameterSet
from modetune.core.storage.keys import Json, canonical_json, content_key
from modetune.core.updating.damping_model import GroupStiffness
from modetune.core.updating.parameter_matrices import (
    ParameterMatrices,
    Powers,
    differences,
    fit_powers,
    parameter_matrices,
    remainder,
    separate,
)
from modetune.flows.campaign.matrix_plan import MatrixPlan, Sampling, plan, sampling, scale_together
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.execution import Work
from modetune.flows.jobs.job import Job

#: Increase this number when the decomposition of the matrices changes.
VERSION = 3
#: Upper triangles of stiffness and mass.
Triangles = tuple[sparse.csr_array, sparse.csr_array]
NOTHING = sparse.csr_array((0, 0))
#: Remedy if stored matrices are not those of the model.
WITHOUT_MATRICES = (
    "`sensitivity.method: finite_difference` with `model.eigensolver: solver` needs no matrices"
)
#: Model size in elements above which freed memory is returned to the system. It has a price: new
#: pages for each array took 4 to 8 s of the 47 s of a campaign on 270,000 equations.
LARGE = 100_000
#: Smallest array in bytes that gets separate pages, and bytes of freed smaller arrays that the C
#: library may keep, by the names of its parameters (mallopt(3)).
OWN_PAGES, M_MMAP_THRESHOLD, KEPT, M_TRIM_THRESHOLD = 1 << 22, -3, 1 << 24, -1


@dataclass(frozen=True)
class MatrixSource:
    """The source of a model's matrices; step: relative step of differences for other parameters.

    with_losses: damping needs the stiffness of groups that have loss factors. beside: values of
    other parameters.

    The matrices at a point cover `columns`, positions of parameters. If the matrices are known
    `everywhere`, they are the same for all points and columns.
    """

    engine: JobEngine
    parameters: ParameterSet
    step: float
    with_losses: bool = False
    beside: Mapping[str, float] = field(default_factory=dict)

    @cached_property
    def everywhere(self) -> bool:
        """Return whether the same jobs give K and M for all values."""
        if self._given is not None:
            return True
        pairs = list(zip(self.parameters.parameters, self._samplings, strict=True))
        powers = all(item.powers for item in self._samplings)
        return powers and not any(scale_together(*both) for both in combinations(pairs, 2))

    def jobs(self, theta: Floats, columns: Sequence[int]) -> tuple[Job, ...]:
        """Return the jobs that must precede `matrices`, that of the unchanged model first.

        Empty if the store has their result, or the model is given as matrices.
        """
        if self._given is not None:
            return ()
        known = self.everywhere and self.key(theta, columns) in self.engine.store
        own = () if known else self._jobs(self._plan(theta, columns))
        groups = self._groups(theta)
        if groups is None:
            return own
        more = groups.jobs(groups.parameters.initial, range(len(groups.parameters)))
        return tuple({self.engine.key(job): job for job in (*more, *own)}.values()) if more else own

    def works(self, theta: Floats, columns: Sequence[int]) -> list[Work]:
        """Return the same jobs, a piece of work each."""
        jobs = self.jobs(theta, columns)
        return [
            Work(f"matrices {place} of {len(jobs)}", (job,)) for place, job in enumerate(jobs, 1)
        ]

    def key(self, theta: Floats, columns: Sequence[int]) -> str:
        """Return the content key of the matrices at a point."""
        if self._given is not None or self.everywhere:
            return self._key_everywhere
        return content_key(canonical_json(self._asked(self._plan(theta, columns))))

    def stored(self, columns: Sequence[int]) -> tuple[str, ...]:
        """Return the keys of the stored results that replace the jobs of these columns."""
        return (self._key_everywhere,) if columns and self.everywhere and not self._given else ()

    def matrices(
        self, theta: Floats, columns: Sequence[int], wide: bool = False
    ) -> ParameterMatrices:
        """Return the matrices at a point, from finished jobs.

        wide: use the wider pair for parameters without powers. Raises ModelError if the jobs'
        matrices do not fit together.
        """
        if self._given is not None:
            return self._given
        chosen = self._plan(theta, columns)
        try:
            if not self.everywhere:
                return self._take_apart(chosen, wide)
            return self.engine.derived(
                self._asked(chosen),
                lambda: self._take_apart(chosen, wide),
                ParameterMatrices,
                "matrices of all values",
            )
        except ModelError as error:
            raise ModelError(f"{error}; {WITHOUT_MATRICES}") from error

    def last_matrices(self, theta: Floats, columns: Sequence[int]) -> ParameterMatrices:
        """Return `matrices`; the store then drops the jobs' results and keeps the matrices."""
        found = self.matrices(theta, columns)
        self.group_stiffness(theta)
        # Those of a run that was killed before it dropped them, too.
        own = () if self._given is not None else self._jobs(self._plan(theta, columns))
        for job in (*self.jobs(theta, columns), *own):
            self.engine.store.drop(self.engine.key(job))
        return found

    def group_stiffness(self, theta: Floats) -> GroupStiffness | None:
        """Return the stiffness of the groups that have loss factors, from finished jobs."""
        groups = self._groups(theta)
        if groups is None:
            return None
        deck, start = self.engine.solver.deck, groups.parameters.initial
        if groups.beside:
            at = self.written(theta)
        else:
            values = [(p, deck.deck_value(p)) for p in self.parameters.parameters]
            at = np.array([p.relative_to(value, value) for p, value in values])
        return GroupStiffness(groups.matrices(start, range(start.size)), at)

    def _groups(self, theta: Floats) -> MatrixSource | None:
        """Where these come from: of the deck's own values, or around a set."""
        if not self._losses:
            return None
        return self._own_groups if self.everywhere else self._groups_beside(theta)

    def _groups_beside(self, theta: Floats | None) -> MatrixSource:
        beside = {} if theta is None else self.parameters.values(theta)
        return MatrixSource(self.engine, ParameterSet(self._losses), self.step, beside=beside)

    @cached_property
    def _own_groups(self) -> MatrixSource:
        return self._groups_beside(None)

    @cached_property
    def _losses(self) -> tuple[Parameter, ...]:
        return self.engine.solver.deck.losses() if self.with_losses else ()

    def without_powers(self, columns: Sequence[int]) -> list[int]:
        """Return the columns whose derivatives are differences of pairs of matrices."""
        if self._given is not None:
            return []
        return [column for column in columns if not self._samplings[column].powers]

    def written(self, theta: Floats) -> Floats:
        """Return the relative values (n_parameters,) after rounding to the digits of the deck."""
        solver = self.engine.solver
        pairs = zip(self.parameters.parameters, theta.tolist(), strict=True)
        return np.array([solver.deck.written(item, value) for item, value in pairs])

    @cached_property
    def _given(self) -> ParameterMatrices | None:
        own = self.engine.solver.deck.summary.matrices
        return None if own is None else own(self.parameters.parameters)

    @cached_property
    def _samplings(self) -> tuple[Sampling, ...]:
        solver = self.engine.solver
        return tuple(sampling(solver, item, self.step) for item in self.parameters.parameters)

    @cached_property
    def _elements(self) -> frozenset[int]:
        cells = self.engine.solver.deck.mesh().cells
        return frozenset(number for item in cells for number in item.elements.tolist())

    @cached_property
    def _plan_everywhere(self) -> MatrixPlan:
        samplings = dict(enumerate(self._samplings))
        return plan(self.parameters.initial, samplings, self._elements)

    @cached_property
    def _key_everywhere(self) -> str:
        if self._given is None:
            return content_key(canonical_json(self._asked(self._plan_everywhere)))
        model = Job(self.parameters.values(self.parameters.initial), MatrixAnalysis())
        targets = [list(item.targets) for item in self.parameters.parameters]
        asked: dict[str, Json] = {"given": self.engine.key(model), "targets": targets}
        scales = [[p.values, p.origin, p.scale] for p in self.parameters.parameters]
        if any(scale != ["relative", 0.0, 1.0] for scale in scales):
            asked["scales"] = scales
        if self.parameters.dependents:
            asked["names"] = list(self.parameters.names)
            asked["relations"] = [
                [p.expression, p.values, list(p.targets)] for p in self.parameters.dependents
            ]
        return content_key(canonical_json(asked))

    def _plan(self, theta: Floats, columns: Sequence[int]) -> MatrixPlan:
        if self.everywhere:
            return self._plan_everywhere
        samplings = {column: self._samplings[column] for column in columns}
        return plan(theta, samplings, self._elements)

    def _asked(self, chosen: MatrixPlan) -> Json:
        """Return everything that the matrices depend on."""
        return {
            "parameter matrices": VERSION,
            "jobs": [self.engine.key(job) for job in self._jobs(chosen)],
            "columns": [list(sample.columns) for sample in chosen.samples],
            "rest": list(chosen.rest),
        }

    def _jobs(self, chosen: MatrixPlan) -> tuple[Job, ...]:
        thetas = [np.array(chosen.base), *(sample.values for sample in chosen.samples)]
        return tuple(
            Job({**self.beside, **self.parameters.values(theta)}, MatrixAnalysis())
            for theta in thetas
        )

    def _take_apart(self, chosen: MatrixPlan, wide: bool) -> ParameterMatrices:
        first, *others = self._jobs(chosen)
        base, reference = self._result(first), self.written(np.array(chosen.base))
        sampled: dict[int, list[tuple[float, Triangles]]] = {}
        for sample, job in zip(chosen.samples, others, strict=True):
            values = self.written(sample.values)
            changed = differences(base, self._result(job))
            for column, pair in self._separated(base, changed, sample.columns).items():
                sampled.setdefault(column, []).append((float(values[column]), pair))
        stiffness: list[Powers] = []
        mass: list[Powers] = []
        for column, found in sampled.items():
            if not self._samplings[column].powers:
                found = found[2:] if wide else found[:2]
            for place, into in enumerate((stiffness, mass)):
                uppers = [pair[place] for _, pair in found]
                if not all(upper is NOTHING for upper in uppers):
                    into.append(
                        self._powers(
                            column, [value for value, _ in found], uppers, float(reference[column])
                        )
                    )
        if chosen.rest:
            taken = [(float(reference[item.column]), item.uppers[0]) for item in stiffness]
            left = remainder(base.upper_stiffness, taken)
            apart = self._separated(base, (left, NOTHING), chosen.rest)
            stiffness += [
                Powers(column, (1,), (sparse.csr_array(pair[0] / float(reference[column])),))
                for column, pair in apart.items()
            ]
        return parameter_matrices(base, reference, stiffness, mass)

    def _powers(
        self, column: int, values: list[float], uppers: list[sparse.csr_array], reference: float
    ) -> Powers:
        """Return the coefficients of a parameter's powers, or the slope of the first two values."""
        powers = self._samplings[column].powers
        if powers:
            return Powers(column, powers, fit_powers(uppers, values, reference, powers))
        slope = (uppers[0] - uppers[1]) / (values[0] - values[1])
        return Powers(column, (1,), (sparse.csr_array(slope),))

    def _separated(
        self, base: MatrixResult, changed: Triangles, columns: Sequence[int]
    ) -> dict[int, Triangles]:
        """Return the part of a job's change of stiffness and mass that belongs to each column."""
        if len(columns) == 1:  # all of it, also what is at knots of beams, whatever they are named
            affected = self._samplings[columns[0]].affected
            moved = (True, True) if affected is None else (affected.stiffness, affected.mass)
            kept = [part if own else NOTHING for part, own in zip(changed, moved, strict=True)]
            return {columns[0]: (kept[0], kept[1])}
        found = {column: [NOTHING, NOTHING] for column in columns}
        wholes = (base.upper_stiffness, base.upper_mass)
        for place, (upper, whole) in enumerate(zip(changed, wholes, strict=True)):
            nodes: dict[int, frozenset[int]] = {}
            for column in columns:
                affected = self._samplings[column].affected
                if affected is not None and (affected.stiffness, affected.mass)[place]:
                    nodes[column] = affected.nodes
            if nodes:
                parts = separate(upper, base.nodes, list(nodes.values()), whole)
                for column, part in zip(nodes, parts, strict=True):
                    found[column][place] = part
        return {column: (pair[0], pair[1]) for column, pair in found.items()}

    def _result(self, job: Job) -> MatrixResult:
        return self.engine.solve(job).result(MatrixResult)


def return_freed_memory() -> None:
    """Make glibc return freed arrays of 4 MB or more, instead of 32 MB.

    With 136,539 equations it kept 4.3 kB per equation, a third of the memory in use. Does nothing
    with another C library.
    """
    with suppress(OSError, AttributeError):
        library = ctypes.CDLL(None)
        library.mallopt(M_MMAP_THRESHOLD, OWN_PAGES)
        library.mallopt(M_TRIM_THRESHOLD, KEPT)
