"""The stiffness and mass matrices of a campaign's model for all parameter values, taken once.

The matrix jobs of `plan.py` go to the solver once in the life of a model; what follows from them,
`core/affine.py`, takes their place in the store: it is as large as two of them, whatever the number
of parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from modetune.adapters.solver import Footprint, MatrixAnalysis
from modetune.core.affine import AffineMatrices, Share, affine_matrices, fit_powers
from modetune.core.keys import Json, canonical_json, content_key
from modetune.core.matrices import MatrixResult
from modetune.core.modes import Floats
from modetune.core.parameters import ParameterSet
from modetune.core.shares import differences, remainder, separate
from modetune.flows.by_matrices.plan import Plan, factors, plan
from modetune.flows.execution.engine import Job, JobEngine

#: Raised by hand when the same matrices are taken apart in another way.
VERSION = 1
#: Upper triangles of stiffness and mass.
Triangles = tuple[sparse.csr_array, sparse.csr_array]
NOTHING = sparse.csr_array((0, 0))


@dataclass(frozen=True)
class MatrixSource:
    """Where a campaign's matrices come from; footprints stand in the parameters' order."""

    engine: JobEngine
    parameters: ParameterSet
    footprints: tuple[Footprint, ...]

    @cached_property
    def plan(self) -> Plan:
        cells = self.engine.solver.mesh().cells
        elements = frozenset(number for item in cells for number in item.elements.tolist())
        return plan(self.parameters, self.footprints, elements)

    @cached_property
    def asked(self) -> Json:
        """Everything that the matrices depend on."""
        return {
            "affine": VERSION,
            "jobs": [self.engine.key(job) for job in self._all_jobs()],
            "columns": [list(sample.columns) for sample in self.plan.samples],
            "rest": list(self.plan.rest),
        }

    @cached_property
    def key(self) -> str:
        """The content key of the matrices for all values."""
        return content_key(canonical_json(self.asked))

    def jobs(self) -> tuple[Job, ...]:
        """The jobs that have to go before `matrices`; none where the store has what they gave."""
        return () if self.key in self.engine.store else self._all_jobs()

    def matrices(self) -> AffineMatrices:
        """The matrices for all values. Raises ModelError where the jobs' do not fit together."""
        jobs = self.jobs()
        found = self.engine.derived(
            self.asked, lambda: self._take_apart(self._all_jobs()), AffineMatrices
        )
        for job in jobs:  # what was made of them is all that is wanted from now on
            self.engine.store.drop(self.engine.key(job))
        return found

    def written(self, theta: Floats) -> Floats:
        """The relative values (n_parameters,) that an edited deck would really hold."""
        solver = self.engine.solver
        pairs = zip(self.parameters.parameters, theta.tolist(), strict=True)
        return np.array([solver.written(item, value) for item, value in pairs])

    def _all_jobs(self) -> tuple[Job, ...]:
        thetas = [self.parameters.initial, *(sample.values for sample in self.plan.samples)]
        return tuple(Job(self.parameters.values(theta), MatrixAnalysis()) for theta in thetas)

    def _take_apart(self, jobs: Sequence[Job]) -> AffineMatrices:
        base, reference = self._result(jobs[0]), self.written(self.parameters.initial)
        sampled: dict[int, list[Triangles]] = {}
        for sample, job in zip(self.plan.samples, jobs[1:], strict=True):
            changed = differences(base, self._result(job))
            for column, pair in self._separated(base, changed, sample.columns).items():
                sampled.setdefault(column, []).append(pair)
        stiffness: list[Share] = []
        mass: list[Share] = []
        for column, pairs in sampled.items():
            footprint = self.footprints[column]
            scaled = [factor * self.parameters.initial for factor in factors(footprint)]
            values = [float(self.written(theta)[column]) for theta in scaled]
            for moved, shares, uppers in (
                (footprint.stiffness, stiffness, [pair[0] for pair in pairs]),
                (footprint.mass, mass, [pair[1] for pair in pairs]),
            ):
                if moved:
                    known = float(reference[column])
                    fitted = fit_powers(uppers, values, known, footprint.powers)
                    shares.append(Share(column, footprint.powers, fitted))
        if self.plan.rest:
            taken = [(float(reference[share.column]), share.uppers[0]) for share in stiffness]
            left = remainder(base.upper_stiffness, taken)
            apart = self._separated(base, (left, NOTHING), self.plan.rest)
            stiffness += [
                Share(column, (1,), (sparse.csr_array(pair[0] / float(reference[column])),))
                for column, pair in apart.items()
            ]
        return affine_matrices(base, reference, stiffness, mass)

    def _separated(
        self, base: MatrixResult, changed: Triangles, columns: Sequence[int]
    ) -> dict[int, Triangles]:
        """What of a job's change of stiffness and mass each of its columns made."""
        found = {column: [NOTHING, NOTHING] for column in columns}
        wholes = (base.upper_stiffness, base.upper_mass)
        for place, (upper, whole) in enumerate(zip(changed, wholes, strict=True)):
            movers = [
                column
                for column in columns
                if (self.footprints[column].stiffness, self.footprints[column].mass)[place]
            ]
            if movers:
                nodes = [self.footprints[column].nodes for column in movers]
                for column, part in zip(
                    movers, separate(upper, base.nodes, nodes, whole), strict=True
                ):
                    found[column][place] = part
        return {column: (pair[0], pair[1]) for column, pair in found.items()}

    def _result(self, job: Job) -> MatrixResult:
        result = self.engine.result(job)
        assert isinstance(result, MatrixResult)
        return result
