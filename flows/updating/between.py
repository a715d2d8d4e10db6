"""Between two sensitivities: what the old one is good for, and as long as it pays.

Where a sensitivity takes solver runs, an accepted set may do with the matrix of before: as it is
(`keep`, thesis, 4.2), or corrected by what the last step showed (Broyden), the rows of frequencies
by the strain energies of the modal run, which are exact and cost nothing. A corrected matrix costs
a round of runs a step, a new one its jobs side by side and the step; how they compare is told in
docs/how-it-works.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from modetune.core.modes import Floats
from modetune.core.updating.estimation import BELIEVED, Step
from modetune.core.updating.sensitivity import broyden_update
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.updating.evaluation import Evaluation, Matrix
from modetune.flows.updating.evaluator import Evaluator

#: How far from e1, at least, Broyden's rate is asked to bring errors down: a rate that hardly is
#: one is none, also where the frequencies hold already and the shapes do not.
LEAST_WAY = 2.0


@dataclass(frozen=True, slots=True)
class Between:
    """What a campaign does without new sensitivities; lower, upper: (n_parameters,), its region."""

    campaign: Campaign
    evaluator: Evaluator
    lower: Floats
    upper: Floats

    @property
    def waits(self) -> bool:
        """Whether a set is looked at before its sensitivity is begun: Broyden's may do for it."""
        e2, between = self.campaign.update.e2, self.campaign.sensitivity.between
        if e2 == 0.0 or between == "keep" or self.evaluator.cheap:
            return False
        return self.n_jobs > self.campaign.parallel  # else a sensitivity takes no time of its own

    @property
    def n_jobs(self) -> int:
        """Jobs of a set with its sensitivity; those that all sets share are in the store by then.

        Sets far from each other are compared for that; the solver is asked nothing.
        """
        low, high = (
            [job for work in self.evaluator.planned(theta) for job in work.jobs]
            for theta in (self.lower, self.upper)
        )
        return sum(job not in low for job in high)

    def pays(self, matrix: Matrix, step: Step, evaluation: Evaluation, left: float) -> bool:
        """Whether Broyden's correction after a step brings e1 about as soon as a new matrix.

        matrix: of the step; evaluation: of the set it led to; left: share of the objective that it
        left. The new matrix takes its rounds of jobs side by side and one more for the step, which
        is taken to arrive; a corrected one takes one a step, at the rate of the last. After a new
        matrix this is not known yet, and tried.
        """
        if step.rank < step.change.size and step.regularisation == 0.0:
            return False  # errors of the matrix would go where the test does not hold them
        if matrix.age == 0:
            return True
        rounds = 1 + math.ceil((self.n_jobs - 1) / self.campaign.parallel)
        worst = float(np.max(np.abs(evaluation.used_errors), initial=0.0))
        far = worst / self.campaign.tolerances.frequency
        # The objective is a square: its share left is that of the errors, squared.
        return 2.0 * math.log(max(far, LEAST_WAY)) <= -rounds * math.log(max(left, 1e-300))

    def tries_again(self, slope: float) -> bool:
        """Whether a step by an old matrix that made things worse is gone on from: Broyden's, where
        the residual changed by no more than e2 a parameter."""
        campaign = self.campaign
        return campaign.sensitivity.between == "broyden" and 0.0 < slope <= campaign.update.e2

    def goes_on(self, matrix: Matrix | None, evaluation: Evaluation) -> bool:
        """Whether the end of an old matrix is followed to the least misfit, as new ones would end.

        e1 then asks for less than what the deviations of frequencies leave: there is no noise.
        """
        if matrix is None or matrix.age == 0 or self.campaign.fields:
            return False
        if self.campaign.sensitivity.between == "keep":
            return False
        noise = evaluation.residual.noise[evaluation.residual.rows("frequencies")]
        asked = 2.0 * self.campaign.tolerances.frequency  # of an eigenvalue
        return noise.size > 0 and asked <= BELIEVED * math.sqrt(float(noise.min()))

    def older(self, matrix: Matrix, begun: Evaluation, evaluation: Evaluation) -> Matrix:
        """The matrix of a step from where it began for use once more, as it is or corrected."""
        if self.campaign.sensitivity.between == "keep":
            return replace(matrix, age=matrix.age + 1)
        change = begun.residual.values - evaluation.residual.values
        rows = begun.residual.rows("frequencies")
        step = evaluation.theta - begun.theta
        values = broyden_update(matrix.values, step, change, rows.stop)
        exact = self.evaluator.by_energies(evaluation)
        known = np.isfinite(exact)
        values[rows][known] = exact[known]
        methods = tuple(
            f"{name}+strain_energy" if new and "strain_energy" not in name else name
            for name, new in zip(matrix.methods, known.any(axis=0).tolist(), strict=True)
        )
        return replace(matrix, values=values, methods=methods, age=matrix.age + 1)
