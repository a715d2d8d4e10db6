"""What a campaign leaves: its record, and the summary that people and machines read."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path

import numpy as np

from modetune import __version__
from modetune.core.modes import Floats
from modetune.core.storage.keys import Json
from modetune.core.storage.record import CampaignRecord, IterationRecord, RunCounts
from modetune.core.updating.estimation import parameter_covariance
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.report.field_tables import told_fields
from modetune.flows.report.form_verdict import verdict_summary
from modetune.flows.report.mode_tables import held_out_rows, mode_rows, unmatched_modes
from modetune.flows.report.parameter_tables import parameter_rows
from modetune.flows.report.response_tables import response_rows
from modetune.flows.report.tables import json_object
from modetune.flows.updating.evaluation import Matrix
from modetune.flows.updating.judging import campaign_trust, field_answers, trust_summary
from modetune.flows.updating.showing import sensor_places, shown_surface
from modetune.flows.updating.stepping import prior_weights, used_weights, way_to_least_misfit

#: Packages whose arithmetic a campaign's numbers depend on, beside the solver's.
PACKAGES = ("numpy", "scipy", "h5py")


def campaign_record(
    campaign: Campaign,
    iterations: Sequence[IterationRecord],
    matrix: Matrix | None,
    status: str,
    reason: str,
    runs: RunCounts,
    wall_s: float,
) -> CampaignRecord:
    """The record of a campaign as it stands; standard errors are by its newest matrix."""
    accepted, only = [item for item in iterations if item.accepted], campaign.only
    own = campaign.parameters
    errors, correlation, remaining, held = _scatter(campaign, accepted[-1], matrix)
    answers = () if status == "running" else field_answers(campaign, iterations, matrix)
    return CampaignRecord(
        name=campaign.name,
        campaign_text=campaign.text,
        settings=campaign.settings,
        modetune_version=__version__,
        solver=campaign.solver_name,
        solver_version=campaign.solver_version(),
        parameters=own,
        deck_values=np.array(
            [campaign.deck_value(item) for item in (*own.parameters, *own.dependents)]
        ),
        test=campaign.test,
        iterations=tuple(iterations),
        status=status,
        reason=reason,
        updated=accepted[-1].parameters,
        standard_errors=errors,
        correlation=correlation,
        runs=runs,
        wall_s=wall_s,
        surface=None if only is None else shown_surface(only),
        geometry=None if only is None else only.measurement.geometry,
        sensors=only.sensors if only is not None and only.sensors.n_sensors else None,
        places=None if only is None else sensor_places(only),
        frfs=None if only is None else only.measurement.frfs,
        units=campaign.cases[0].units,
        e1_frequency=campaign.tolerances.frequency,
        e1_mac=campaign.tolerances.mac,
        e2=campaign.update.e2,
        configurations=campaign.configurations,
        splits=campaign.splits,
        versions=_versions(),
        # A large deck takes a moment to digest, so only the record that stays tells it.
        deck_digest="" if status == "running" else _deck_digest(campaign),
        trust=None
        if status == "running"
        else campaign_trust(
            campaign, iterations, matrix, errors, remaining, status == "converged", answers, held
        ),
        fields=answers,
    )


@cache
def _versions() -> tuple[str, ...]:
    python = f"Python {platform.python_version()}"
    return (python, *(f"{name} {version(name)}" for name in PACKAGES), platform.platform())


def _deck_digest(campaign: Campaign) -> str:
    """SHA-256 and name of each deck's file, as `sha256sum` tells them; includes are not in it."""
    files = [file for each in campaign.cases if (file := each.solver.deck.summary.file) is not None]
    try:
        told = [f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.name}" for file in files]
    except OSError:  # moved since it was read
        return ""
    return "; ".join(dict.fromkeys(told))


def _scatter(
    campaign: Campaign, last: IterationRecord, matrix: Matrix | None
) -> tuple[Floats, Floats, Floats, tuple[str, ...]]:
    """Standard errors (n,) and correlation (n, n) of the parameters as they stand, their way to the
    least misfit (n,), and what a limit holds there.

    Measurement variances leave the least misfit with a covariance C; the parameters, which stand d
    before it, are off the truth by C + d d^T. What bounds and limits hold does not scatter.
    """
    n, found, factor = len(campaign.parameters), last.residual, last.regularisation
    if matrix is None:
        return np.full(n, np.nan), np.full((n, n), np.nan), np.full(n, np.nan), ()
    remaining, held, limits = way_to_least_misfit(
        campaign, last.parameters, found, matrix.values, factor
    )
    weights = used_weights(campaign, found)
    prior = prior_weights(campaign, last.parameters, factor)
    rows = found.independent(matrix.values)
    # A pull that was found stronger than deviations beforehand draws real changes back.
    strength = max(factor, 1.0) if np.isfinite(factor) else 1.0
    covariance = parameter_covariance(rows, found.variances, weights, prior, held, strength)
    covariance = covariance + np.outer(remaining, remaining)
    errors = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = covariance / np.outer(errors, errors)
    still = errors == 0.0
    correlation[still], correlation[:, still] = 0.0, 0.0
    correlation[still, still] = 1.0
    return errors, correlation, remaining, tuple(found.labels[row] for row in limits.tolist())


def summary(record: CampaignRecord, run_dir: Path) -> dict[str, Json]:
    """The `--json` object of `modetune update`."""
    return json_object(
        record,
        "status reason",
        ended_at=record.trust and record.trust.ended,
        iterations=record.iterations[-1].number,
        solver_runs=record.runs,
        parameters=parameter_rows(record),
        modes=mode_rows(record),
        unmatched=[record.test.numbers[place] for place in unmatched_modes(record)],
        mean_error_initial=np.abs(record.iterations[0].frequency_errors).mean(),
        mean_error_updated=np.abs(record.best.frequency_errors).mean(),
        responses=response_rows(record),
        held_out=held_out_rows(record.held_out),
        fields=told_fields(record),
        splits=record.splits,
        sensitivity_skipped=sum(item.sensitivity_skipped for item in record.iterations),
        wall_s=round(record.wall_s, 3),
        core_minutes=round(record.runs.core_s / 60.0, 4),
        licence_minutes=round(record.runs.licence_s / 60.0, 4),
        run_dir=run_dir,
        solver=record.solver,
        solver_version=record.solver_version,
        trust=trust_summary(record.trust),
        model_form=verdict_summary(record),
    )
