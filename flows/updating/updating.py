"""An updating campaign: the loop, and the record that grows with it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from modetune.core.storage.record import CampaignRecord, IterationRecord, RunCounts
from modetune.core.updating.trust import with_spread
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.updating.evaluation import Evaluation, Matrix
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.judging import checked
from modetune.flows.updating.loop import End, Loop
from modetune.flows.updating.recording import campaign_record
from modetune.flows.updating.showing import shown_field
from modetune.flows.updating.trials import Noted
from modetune.flows.updating.tried_starts import OtherStarts, TriedStarts


class Progress(Protocol):
    """The watcher of a study; its own methods do nothing."""

    def keep(self, folder: Path) -> None:
        """Keep the progress of the jobs in a file of a run folder too."""
        return

    def forecast(self, forecast: Any) -> None:
        """A `Forecast` of the jobs that are still to come, before the start and later."""
        return

    def working(self, text: str) -> None:
        """What is being computed now."""
        return

    def iteration(self, record: IterationRecord) -> None:
        """An iteration is complete."""
        return

    def page(self, address: str) -> None:
        """Prefect shows the run at this address."""
        return


class Unwatched(Progress):
    """Watches nothing."""


@dataclass
class Updating:
    """A campaign under way. `run` carries it to its end.

    around: an evaluation point that the modes of the start are tracked from.
    """

    campaign: Campaign
    evaluator: Evaluator
    progress: Progress
    save: Callable[[CampaignRecord], None]
    around: Evaluation | None = None
    matrix: Matrix | None = None
    counted: RunCounts = field(default_factory=RunCounts)

    def __post_init__(self) -> None:
        self.iterations: list[IterationRecord] = []
        self.kept: list[Evaluation] = []
        self.started = self.lap = time.monotonic()

    def run(self) -> CampaignRecord:
        """Update until e1 holds, nothing more is gained, or the iterations are used up."""
        campaign, evaluator = self.campaign, self.evaluator
        others = OtherStarts(campaign, evaluator)

        def seek() -> None:
            if self.kept[-1].agrees(campaign.tolerances):
                others.seek(self._record("converged", ""))

        evaluator.idle, idle = seek, evaluator.idle
        end = Loop(campaign, evaluator, self, around=self.around).run()
        evaluator.idle, self.matrix = idle, end.matrix
        tried = others.tried(self._record(end.status, end.reason), end.last)
        if tried is not None and tried.chosen:
            end = self._from(tried)
        held_out = self.evaluator.held_out(self.kept[0], self.kept[-1])
        record = checked(replace(self._record(end.status, end.reason), held_out=held_out))
        if tried is not None and record.trust is not None:
            spread = tried.spread(record)
            record = replace(record, trust=with_spread(record.trust, spread))
        at_bounds = self.campaign.parameters.at_bounds(record.updated)
        if at_bounds:
            record = replace(record, reason=f"{end.reason}; on a bound: {', '.join(at_bounds)}")
        self.save(record)
        return record

    def _from(self, tried: TriedStarts) -> End:
        """Go on from where another start led that fits better."""
        campaign = replace(self.campaign, begin=tuple(tried.better.tolist()))
        title, number = "another start fits better", self.iterations[-1].number + 1
        end = Loop(campaign, self.evaluator, self, first=number, title=title).run()
        self.matrix = end.matrix
        return replace(end, reason=f"{end.reason}; the best of {len(tried.ends)} starts")

    def working(self, text: str) -> None:
        self.progress.working(text)

    def noted(self, trial: Noted) -> None:
        """Keep an evaluation point in the record."""
        evaluation, by = trial.evaluation, trial.by
        step, matrix = (by.step, by.matrix) if by else (None, None)
        now, parameters = time.monotonic(), self.campaign.parameters
        runs, wall_s = self.evaluator.runs.since(self.counted), now - self.lap
        self.counted, self.lap = self.evaluator.runs, now
        record = IterationRecord(
            number=trial.number,
            parameters=evaluation.theta,
            step=step.change if step else np.zeros(len(parameters)),
            computed=evaluation.seen,
            pairing=evaluation.pairing,
            frequency_errors=evaluation.errors,
            residual=evaluation.residual,
            sensitivity=matrix.values if matrix else np.zeros((0, len(parameters))),
            sensitivity_methods=matrix.methods_had if matrix else (),
            sensitivity_keys=matrix.keys if matrix else (),
            sensitivity_age=matrix.age if matrix else 0,
            sensitivity_skipped=trial.skipped,
            slope=trial.slope,
            accepted=trial.accepted,
            decision=trial.decision,
            regularisation=step.regularisation if step else np.nan,
            condition=step.condition if step else np.nan,
            modal_key=evaluation.key,
            runs=runs,
            wall_s=wall_s,
            field=shown_field(self.campaign, evaluation),
            solved_by=evaluation.solved_by,
        )
        self.iterations.append(record)
        self.matrix = trial.newest
        if trial.accepted:
            self.kept = [*self.kept[:1], evaluation]
        self.progress.iteration(record)
        self.save(self._record("running", ""))

    def confirmed(self, evaluation: Evaluation) -> None:
        """Put the solver's own modes in place of those of the last accepted set."""
        place = max(n for n, record in enumerate(self.iterations) if record.accepted)
        before, runs = self.iterations[place], self.evaluator.runs
        apart = float(np.max(np.abs(evaluation.errors - before.frequency_errors)))
        said = f"confirmed by {evaluation.solved_by}: frequencies within {apart:.1e}"
        now = time.monotonic()
        self.iterations[place] = replace(
            before,
            computed=evaluation.seen,
            pairing=evaluation.pairing,
            frequency_errors=evaluation.errors,
            residual=evaluation.residual,
            modal_key=evaluation.key,
            decision="; ".join(filter(None, (before.decision, said))),
            runs=before.runs.plus(runs.since(self.counted)),
            wall_s=before.wall_s + now - self.lap,
            field=shown_field(self.campaign, evaluation),
            solved_by=evaluation.solved_by,
        )
        self.counted, self.lap = runs, now
        self.kept[-1] = evaluation
        self.progress.working(said)
        self.save(self._record("running", ""))

    def _record(self, status: str, reason: str) -> CampaignRecord:
        return campaign_record(
            self.campaign,
            self.iterations,
            self.matrix,
            status,
            reason,
            self.evaluator.runs,
            time.monotonic() - self.started,
        )
