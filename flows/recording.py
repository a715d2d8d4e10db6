"""What a campaign leaves: its record, and the summary that people and machines read."""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np

from modetune import __version__
from modetune.core.estimation import parameter_covariance
from modetune.core.held_out import HeldOut
from modetune.core.keys import Json, number_or_null
from modetune.core.modes import Floats
from modetune.core.numbering import configuration_of
from modetune.core.record import CampaignRecord, IterationRecord, RunCounts
from modetune.flows.campaign import Campaign
from modetune.flows.evaluating import Matrix
from modetune.flows.localisation.form_verdict import verdict_summary
from modetune.flows.showing import sensor_places, shown_surface
from modetune.flows.trust.judging import campaign_trust, trust_summary

#: Packages whose arithmetic a campaign's numbers hang on, beside the solver's.
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
    accepted = [iteration for iteration in iterations if iteration.accepted]
    errors, correlation = _trust(campaign, accepted[-1], matrix)
    return CampaignRecord(
        name=campaign.name,
        campaign_text=campaign.text,
        settings=campaign.settings,
        modetune_version=__version__,
        solver=campaign.solver.name,
        solver_version=campaign.solver.version(),
        parameters=campaign.parameters,
        deck_values=np.array(
            [campaign.solver.deck_value(item) for item in campaign.parameters.parameters]
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
        surface=shown_surface(campaign),
        geometry=campaign.measurement.geometry,
        sensors=campaign.sensors if campaign.sensors.n_sensors else None,
        places=sensor_places(campaign),
        frfs=campaign.measurement.frfs,
        units=campaign.units,
        e1_frequency=campaign.tolerances.frequency,
        e1_mac=campaign.tolerances.mac,
        e2=campaign.update.e2,
        configurations=tuple(item.name for item in campaign.configurations),
        versions=_versions(),
        # A large deck takes a moment to digest, so only the record that stays tells it.
        deck_digest="" if status == "running" else _deck_digest(campaign),
        trust=None
        if status == "running"
        else campaign_trust(campaign, iterations, matrix, errors, status == "converged"),
    )


def _versions() -> tuple[str, ...]:
    python = f"Python {platform.python_version()}"
    return (python, *(f"{name} {version(name)}" for name in PACKAGES), platform.platform())


def _deck_digest(campaign: Campaign) -> str:
    """SHA-256 and name of each deck's file, as `sha256sum` tells them; includes are not in it."""
    single = [each.campaign for each in campaign.configurations] or [campaign]
    files = [file for each in single if (file := each.solver.model.file) is not None]
    try:
        told = [f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.name}" for file in files]
    except OSError:  # moved since it was read
        return ""
    return "; ".join(dict.fromkeys(told))


def _trust(
    campaign: Campaign, last: IterationRecord, matrix: Matrix | None
) -> tuple[Floats, Floats]:
    """Standard errors (n,) and correlation (n, n) of the parameters from measurement variances."""
    n = len(campaign.parameters)
    if matrix is None:
        return np.full(n, np.nan), np.full((n, n), np.nan)
    prior, weights = None, last.residual.weights
    if campaign.update.step in ("pseudo_inverse", "minimum_norm"):
        weights = (weights > 0.0).astype(np.float64)
    if campaign.update.step == "pulled_to_initial":
        factor = last.regularisation if np.isfinite(last.regularisation) else 1.0
        prior = factor * campaign.parameters.standard_deviations**-2
    covariance = parameter_covariance(matrix.values, last.residual.variances, weights, prior)
    errors = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = covariance / np.outer(errors, errors)
    return errors, correlation


def summary(record: CampaignRecord, run_dir: Path) -> dict[str, Json]:
    """The `--json` object of `modetune update`."""
    first, last = record.iterations[0], record.best
    return {
        "status": record.status,
        "reason": record.reason,
        "iterations": record.iterations[-1].number,
        "solver_runs": {
            "modal": record.runs.modal,
            "sensitivity": record.runs.sensitivity,
            "reused": record.runs.reused,
        },
        "parameters": [
            {
                "name": item.name,
                "quantity": item.quantity,
                "initial": number_or_null(first.parameters[place]),
                "updated": number_or_null(record.updated[place]),
                "standard_error": number_or_null(record.standard_errors[place]),
                "deck_value": number_or_null(record.deck_values[place]),
                "updated_value": number_or_null(record.deck_values[place] * record.updated[place]),
            }
            for place, item in enumerate(record.parameters.parameters)
        ],
        "modes": [_mode(record, first, last, pair) for pair in range(len(record.test.numbers))],
        "mean_error_initial": number_or_null(np.abs(first.frequency_errors).mean()),
        "mean_error_updated": number_or_null(np.abs(last.frequency_errors).mean()),
        "held_out": held_out_summary(record.held_out, record.configurations),
        "sensitivity_skipped": sum(item.sensitivity_skipped for item in record.iterations),
        "wall_s": round(record.wall_s, 3),
        "core_minutes": round(record.runs.core_s / 60.0, 4),
        "licence_minutes": round(record.runs.licence_s / 60.0, 4),
        "run_dir": str(run_dir),
        "solver": record.solver,
        "solver_version": record.solver_version,
        "trust": trust_summary(record.trust),
        "model_form": verdict_summary(record),
    }


def _mode(
    record: CampaignRecord, first: IterationRecord, last: IterationRecord, pair: int
) -> dict[str, Json]:
    before, after = first.pairing, last.pairing
    return {
        "mode": record.test.numbers[int(before.measured[pair])],
        "configuration": configuration_of(
            record.configurations, record.test.numbers[int(before.measured[pair])]
        ),
        "test_hz": number_or_null(record.test.modes.frequencies_hz[before.measured[pair]]),
        "initial_hz": number_or_null(first.computed.frequencies_hz[before.computed[pair]]),
        "updated_hz": number_or_null(last.computed.frequencies_hz[after.computed[pair]]),
        "error_initial": number_or_null(first.frequency_errors[pair]),
        "error_updated": number_or_null(last.frequency_errors[pair]),
        "mac_initial": number_or_null(before.mac[pair]),
        "mac_updated": number_or_null(after.mac[pair]),
        "pairing": after.reasons[pair],
    }


def held_out_summary(held: HeldOut | None, configurations: tuple[str, ...]) -> list[Json]:
    """What was held out, before and after, as JSON."""
    if held is None:
        return []
    return [
        {
            "test": int(held.numbers[mode]),
            "configuration": configuration_of(configurations, int(held.numbers[mode])),
            "test_hz": number_or_null(held.test_hz[mode]),
            "initial_hz": number_or_null(held.initial_hz[mode]),
            "updated_hz": number_or_null(held.updated_hz[mode]),
            "error_initial": number_or_null(held.error_initial[mode]),
            "error_updated": number_or_null(held.error_updated[mode]),
            "mac_initial": number_or_null(held.mac_initial[mode]),
            "mac_updated": number_or_null(held.mac_updated[mode]),
            "worse": bool(held.worse[mode]),
        }
        for mode in range(held.numbers.size)
    ]
