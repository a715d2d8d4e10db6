"""The diagnosis of a campaign's answer: how far to trust it, at its end and in `--json`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from modetune.core.modes import Floats
from modetune.core.storage.campaign_record import CampaignRecord, IterationRecord
from modetune.core.storage.keys import Json
from modetune.core.updating.identifiability import identifiability
from modetune.core.updating.parameter_fields import FieldAnswer, answer
from modetune.core.updating.parameter_steps import RANK_TOLERANCE, LCurve, from_initial, l_curve
from modetune.core.updating.trust import (
    StartSpread,
    Trust,
    combination_sentences,
    judge_parameters,
    trust_sentences,
    with_concerns,
)
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.report.form_verdict import record_verdict
from modetune.flows.report.tables import json_object
from modetune.flows.updating.evaluation import Matrix
from modetune.flows.updating.step import step_problem

#: Collinear subsets that the summary names.
NAMED = 10


def campaign_trust(
    campaign: Campaign,
    iterations: Sequence[IterationRecord],
    matrix: Matrix | None,
    standard_errors: Floats,
    remaining: Floats,
    agrees: bool,
    answers: Sequence[FieldAnswer] = (),
    held: Sequence[str] = (),
) -> Trust | None:
    """What the newest sensitivity and the test say of the parameters; None without a sensitivity.

    standard_errors, remaining: (n_parameters,), at the answer, and its way to the least misfit;
    agrees: whether e1 is met; answers: of the campaign's fields; held: responses at a
    limit.
    """
    if matrix is None:
        return None
    last = [iteration for iteration in iterations if iteration.accepted][-1]
    parameters, factor = campaign.parameters, 1.0
    if campaign.update.step == "pulled_to_initial" and np.isfinite(last.regularisation):
        factor = last.regularisation
    zones = [column for field in campaign.fields for column in field.columns.tolist()]
    found = identifiability(
        last.residual.independent(matrix.values),
        last.residual.weights,
        parameters.standard_deviations,
        last.parameters,
        factor,
        campaign.precision(last.parameters) if zones else None,
        zones,
    )
    return Trust(
        parameters=judge_parameters(
            parameters,
            last.parameters,
            iterations[0].parameters,
            standard_errors,
            found,
            matrix.missing,
            set(zones),
        ),
        identifiability=found,
        agrees=agrees,
        remaining=remaining,
        freedom=_freedom(campaign, last, matrix),
        unseen=(
            *combination_sentences(parameters.names, found),
            *(said for item in answers for said in item.doubts),
        ),
        notes=(*(said for item in answers for said in item.sentences), *_real_parts(campaign)),
        curve=_curve(campaign, iterations),
        regularisation=last.regularisation,
        age=matrix.age,
        concerns=tuple(
            f"The test asks for more than the limit of {name} allows: the answer stands on the "
            "limit, and standard errors are those of changes that keep to it."
            for name in held
        ),
    )


def _real_parts(campaign: Campaign) -> tuple[str, ...]:
    """A sentence where complex shapes are compared by their real parts alone."""
    found = []
    for case in campaign.used:
        kinds = {item.kind for item in case.responses}
        if case.measurement.complex_shapes is not None and "complex_shapes" not in kinds:
            what = case.of("The measured shapes") + " are complex: their real parts are "
            what += "compared" if kinds & {"shapes", "mac"} else "looked at"
            found.append(f"{what}; `residuals.complex_shapes` compares them as they are.")
    return tuple(found)


def _freedom(campaign: Campaign, last: IterationRecord, matrix: Matrix) -> int:
    """Measured values that are left to judge the fit by; a pull to the initial values adds some."""
    values, theta = last.residual.n_independent, last.parameters
    if campaign.update.step == "pulled_to_initial":
        return values
    held = set(campaign.parameters.at_bounds(theta))
    free = [place for place, name in enumerate(campaign.parameters.names) if name not in held]
    rows = last.residual.independent(matrix.values[:, free])
    weighted = np.sqrt(last.residual.weights)[:, None] * rows
    singular = np.linalg.svd(weighted, compute_uv=False)
    return values - int(np.sum(singular > RANK_TOLERANCE * singular.max(initial=0.0)))


def checked(record: CampaignRecord) -> CampaignRecord:
    """The record of an update that has ended, its trust judged by what is left and held out too."""
    if record.trust is None:
        return record
    trust, found = record.trust, record_verdict(record)
    if found is not None and found.form.suspected:
        trust = replace(with_concerns(trust, found.sentence), times_noise=found.form.times_noise)
    elif found is not None and found.form.overstated:
        trust = replace(trust, notes=(*trust.notes, found.sentence))
    return replace(record, trust=with_concerns(trust, *_worse(record), *_new_below(record)))


def _worse(record: CampaignRecord) -> tuple[str, ...]:
    """A sentence where held-out modes got worse."""
    held = record.held_out
    if held is None or not held.any_worse:
        return ()
    names = held.only(held.worse).names
    return (
        f"{len(names)} of {held.numbers.size} held-out modes got worse by updating "
        f"({', '.join(names)}): the parameters may have been bent to fit the others.",
    )


def _curve(campaign: Campaign, iterations: Sequence[IterationRecord]) -> LCurve | None:
    """The L-curve of the last step that was kept."""
    kept = [iteration for iteration in iterations if iteration.accepted]
    if len(kept) < 2:
        return None
    before, last = kept[-2], kept[-1]
    found, theta = before.residual, before.parameters
    fits = last.sensitivity.shape == (found.values.size, len(campaign.parameters))
    if not fits or not last.sensitivity.any() or not found.values[found.weights > 0.0].any():
        return None
    problem = step_problem(campaign, theta, found, last.sensitivity)
    pulled = campaign.update.step == "pulled_to_initial"
    return l_curve(from_initial(problem) if pulled else problem)


def field_answers(
    campaign: Campaign, iterations: Sequence[IterationRecord], matrix: Matrix | None
) -> tuple[FieldAnswer, ...]:
    """Return the answer for each field at the present point; none without a sensitivity."""
    last, own = [item for item in iterations if item.accepted][-1], campaign.parameters
    found = last.residual
    if matrix is None:
        return ()
    return tuple(
        answer(
            item,
            found.independent(matrix.values),
            found.independent(found.values),
            found.weights,
            last.parameters - own.initial,
            own.standard_deviations,
            own.names,
            float(found.weights @ found.noise),
            (own.lower - own.initial, own.upper - own.initial),
        )
        for item in campaign.fields
    )


def trust_summary(trust: Trust | None) -> Json:
    """The key `trust` of `modetune update --json`; null where no sensitivity was computed."""
    if trust is None:
        return None
    found, names = trust.identifiability, [item.name for item in trust.parameters]
    subsets = zip(
        found.collinearity.members.tolist(), found.collinearity.indices.tolist(), strict=True
    )
    return json_object(
        trust,
        "verdict regularisation",
        ended_at=trust.ended,
        degrees_of_freedom=trust.freedom,
        sentences=trust_sentences(trust),
        condition=found.condition,
        singular_values=found.singular_values,
        parameters_told=found.n_told,
        collinearity_index=found.collinearity.whole,
        collinear_subsets=[
            {"parameters": [names[place] for place in row if place >= 0], "index": index}
            for row, index in list(subsets)[:NAMED]
        ],
        unseen_combinations=[
            json_object(item, "changes seen", parameters=[names[place] for place in item.members])
            for item in found.unseen
        ],
        l_curve_corner=trust.curve and trust.curve.corner,
        sensitivity_age=trust.age,
        parameters=[
            json_object(
                item,
                "name test_share on_bound collinear_with flags sentence",
                standard_error=item.error,
                to_least_misfit=way,
            )
            for item, way in zip(trust.parameters, trust.remaining.tolist(), strict=True)
        ],
        **({} if trust.spread is None else {"starts": _told_starts(trust, trust.spread)}),
    )


def _told_starts(trust: Trust, spread: StartSpread) -> Json:
    columns = zip(
        spread.starts, spread.updated, spread.misfits, spread.outcomes, spread.minima, strict=True
    )
    heads = ("start", "updated", "misfit", "outcome", "place")
    return json_object(
        spread,
        "seed chosen differ",
        places=int(spread.minima.max(initial=-1)) + 1,
        fit_as_well=trust.fit_as_well,
        exchanged=spread.exchanged,
        valley={
            name: [low, high]
            for name, low, high in zip(
                (item.name for item in trust.parameters), *spread.extent.tolist(), strict=True
            )
            if name in spread.valley
        },
        runs=[dict(zip(heads, run, strict=True)) for run in columns],
    )


def _new_below(record: CampaignRecord) -> tuple[str, ...]:
    """A sentence where updating brought modes below all that answer the test."""
    first, last = record.iterations[0], [item for item in record.iterations if item.accepted][-1]
    below = min(last.pairing.computed, default=0)
    if len(record.configurations) or below <= min(first.pairing.computed, default=0):
        return ()
    frequencies = ", ".join(f"{hz:.4g}" for hz in last.computed.frequencies_hz[:below])
    return (
        f"The updated model has modes below all that answer the test ({frequencies} Hz), more than "
        "before updating: if the test covers that range the structure has none there, and the "
        "values are not its own.",
    )
