"""The diagnosis of a campaign's solution: how far to trust it, at its end and in `--json`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modetune.core.modes import Floats
from modetune.core.storage.campaign_record import CampaignRecord, IterationRecord
from modetune.core.storage.keys import Json
from modetune.core.updating.identifiability import identifiability
from modetune.core.updating.model_error import (
    LARGEST,
    LinearFit,
    effective_number,
    linear_fit,
    missed_modes,
    model_error_columns,
    with_model_error,
)
from modetune.core.updating.parameter_fields import FieldAnswer, answer
from modetune.core.updating.parameter_steps import (
    RANK_TOLERANCE,
    LCurve,
    from_initial,
    l_curve,
    parameter_covariance,
)
from modetune.core.updating.responses.response import Residual
from modetune.core.updating.trust import (
    StartSpread,
    Trust,
    combination_sentences,
    judge_parameters,
    too_many_missed,
    trust_sentences,
    with_concerns,
)
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.report.form_verdict import record_verdict
from modetune.flows.report.tables import json_object
from modetune.flows.updating.evaluation import Evaluation, Matrix, model_state, part_rows
from modetune.flows.updating.step import (
    prior_weights,
    step_problem,
    used_weights,
    way_to_least_misfit,
)

#: Number of collinear subsets in the summary.
NAMED = 10


@dataclass(frozen=True, slots=True)
class ParameterErrors:
    """The errors of parameters, and whether predictions of left-out modes confirm them.

    standard_errors: (n,), NaN if withheld. repeatability: (n,), from the test's noise alone.
    correlation: (n, n). covariance: (n, n), of repeatability. remaining: (n,), the distance to the
    minimum misfit. limited: names of
    responses at a limit there. missed: names of the modes, among n_predicted, that lie outside the
    interval predicted from the other modes. notes: sentences on the model's own error.
    """

    standard_errors: Floats
    repeatability: Floats
    correlation: Floats
    covariance: Floats
    remaining: Floats
    limited: tuple[str, ...] = ()
    missed: tuple[str, ...] = ()
    n_predicted: int = 0
    notes: tuple[str, ...] = ()


def parameter_errors(
    campaign: Campaign, last: IterationRecord, matrix: Matrix | None, errors: Floats | None
) -> ParameterErrors:
    """Return the errors of the present parameters; NaN without a sensitivity.

    errors: (n_residuals, n_errors), what unit errors of the model change; None for the test's noise
    alone, as while updating is under way.

    The variances of the test give the covariance of the minimum, and with the model's own error
    (`core/updating/model_error`) a larger one, C. Parameters at a distance d from the minimum have
    the mean square error C + d d^T. Parameters at bounds and limits have no scatter.
    """
    n, found, factor = len(campaign.parameters), last.residual, last.regularisation
    if matrix is None:
        none = np.full(n, np.nan)
        return ParameterErrors(none, none, np.full((n, n), np.nan), np.zeros((0, 0)), none)
    remaining, held, limits = way_to_least_misfit(
        campaign, last.parameters, found, matrix.values, factor
    )
    weights = used_weights(campaign, found)
    prior = prior_weights(campaign, last.parameters, factor)
    rows = found.independent(matrix.values)
    # A pull stronger than the prior deviations reduces real changes.
    strength = max(factor, 1.0) if np.isfinite(factor) else 1.0
    given = weights, prior, held, strength
    noise = parameter_covariance(rows, found.variances, *given)
    covariance, n_predicted, size = noise, 0, 0.0
    missed: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    if errors is not None:
        columns = found.independent(errors)
        fit = linear_fit(found, rows, remaining, weights, columns, prior, held)
        missed, n_predicted = missed_modes(fit)
        fit, size = with_model_error(fit)
        covariance = parameter_covariance(rows, fit.variances, *given, fit.errors)
        notes = _size_note(found, fit) if size <= LARGEST else ()
    covariance = covariance + np.outer(remaining, remaining)
    deviations = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = covariance / np.outer(deviations, deviations)
    still = deviations == 0.0
    correlation[still], correlation[:, still] = 0.0, 0.0
    correlation[still, still] = 1.0
    if size > LARGEST or too_many_missed(len(missed), n_predicted):
        deviations = np.where(np.isfinite(deviations) & ~still, np.nan, deviations)
    return ParameterErrors(
        deviations,
        np.sqrt(np.diag(noise)),
        correlation,
        noise,
        remaining,
        tuple(found.labels[row] for row in limits.tolist()),
        missed,
        n_predicted,
        notes,
    )


def model_errors(campaign: Campaign, evaluation: Evaluation) -> Floats:
    """Return what unit errors of the model change of the residual, (n_residuals, n_errors).

    The models of several configurations err independently.
    """
    parts = []
    for case, part in zip(campaign.used, evaluation.parts, strict=True):
        state = model_state(case, part.seen, part.pairing, part.modal, part.matrices)
        parts.append(model_error_columns(state, part.responses))
    whole = np.zeros((evaluation.residual.values.size, sum(part.shape[1] for part in parts)))
    first = 0
    for columns, rows in zip(parts, part_rows(evaluation.parts), strict=True):
        whole[rows, first : first + columns.shape[1]] = columns
        first += columns.shape[1]
    return whole


def _between(sizes: Sequence[float]) -> str:
    """Return the size in one configuration, or the least and the largest of several."""
    ends = dict.fromkeys(f"{size:.2g}" for size in (min(sizes), max(sizes)))
    return " to ".join(ends)


def _size_note(found: Residual, fit: LinearFit) -> tuple[str, ...]:
    """Return a sentence on the size of the model's own error if it exceeds the test's noise."""
    sizes, used = np.sum(fit.errors**2, axis=1), fit.weights > 0.0
    own_sizes: dict[str, list[float]] = {}
    exceeds, counts = False, ""
    for block, rows in zip(found.blocks, found.block_rows, strict=True):
        own = np.flatnonzero(used[rows]) + rows.start
        if block.kind not in ("frequencies", "shapes") or own.size == 0:
            continue
        size, noise = float(sizes[own].mean()), float(fit.variances[own].mean())
        exceeds |= size > noise
        if block.kind == "frequencies":
            # Of eigenvalues: twice.
            own_sizes.setdefault("a frequency", []).append(50.0 * np.sqrt(size))
            continue
        # An entry of a unit shape is one of its root mean square over the root of their number.
        share = np.sqrt(size * float(block.sizes.mean()))
        own_sizes.setdefault("a shape's rms", []).append(100.0 * share)
        n = effective_number(fit, own)
        if n < 0.5 * own.size:
            counts = f"; the {own.size} values of shapes count as {max(n, 1.0):.0f}"
    if not exceeds:
        return ()
    text = " and ".join(f"{_between(sizes)} % of {what}" for what, sizes in own_sizes.items())
    if int(used.sum()) <= fit.sensitivity.shape[1]:
        # Without a degree of freedom the size is that of the prior alone.
        return (f"The standard errors assume that the model errs by {text}: no residual tests it.",)
    return (f"What updating leaves puts the model's own error at {text}{counts}.",)


def campaign_trust(
    campaign: Campaign,
    iterations: Sequence[IterationRecord],
    matrix: Matrix | None,
    errors: ParameterErrors,
    agrees: bool,
    answers: Sequence[FieldAnswer] = (),
) -> Trust | None:
    """Return the trust in the parameters from the newest sensitivity; None without a sensitivity.

    errors: at the solution. agrees: e1 is met. answers: solutions of the campaign's fields.
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
            errors.standard_errors,
            errors.repeatability,
            found,
            matrix.missing,
            set(zones),
        ),
        identifiability=found,
        agrees=agrees,
        remaining=errors.remaining,
        freedom=_freedom(campaign, last, matrix),
        unseen=(
            *combination_sentences(parameters.names, found),
            *(text for item in answers for text in item.doubts),
        ),
        notes=(
            *errors.notes,
            *(text for item in answers for text in item.sentences),
            *_real_parts(campaign),
        ),
        curve=_curve(campaign, iterations),
        regularisation=last.regularisation,
        age=matrix.age,
        concerns=tuple(
            f"The test asks for more than the limit of {name} allows: the answer stands on the "
            "limit, and standard errors are those of changes that keep to it."
            for name in errors.limited
        ),
        missed=errors.missed,
        n_predicted=errors.n_predicted,
    )


def _real_parts(campaign: Campaign) -> tuple[str, ...]:
    """Return a sentence if only the real parts of complex shapes are compared."""
    found = []
    for case in campaign.used:
        kinds = {item.kind for item in case.responses}
        if case.measurement.complex_shapes is not None and "complex_shapes" not in kinds:
            what = case.of("The measured shapes") + " are complex: their real parts are "
            what += "compared" if kinds & {"shapes", "mac"} else "looked at"
            found.append(f"{what}; `residuals.complex_shapes` compares them as they are.")
    return tuple(found)


def _freedom(campaign: Campaign, last: IterationRecord, matrix: Matrix) -> int:
    """Return the degrees of freedom left; a pull to the initial values adds some."""
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
    """Return the record of a finished update with the verdict, which includes held-out modes."""
    if record.trust is None:
        return record
    trust, found = record.trust, record_verdict(record)
    if found is not None and found.form.suspected:
        trust = replace(with_concerns(trust, found.sentence), times_noise=found.form.times_noise)
    elif found is not None and found.form.overstated:
        trust = replace(trust, notes=(*trust.notes, found.sentence))
    return replace(record, trust=with_concerns(trust, *_worse(record), *_new_below(record)))


def _worse(record: CampaignRecord) -> tuple[str, ...]:
    """Return a sentence if held-out modes got worse."""
    held = record.held_out
    if held is None or not held.any_worse:
        return ()
    names = held.only(held.worse).names
    return (
        f"{len(names)} of {held.numbers.size} held-out modes got worse by updating "
        f"({', '.join(names)}): the parameters may have been bent to fit the others.",
    )


def _curve(campaign: Campaign, iterations: Sequence[IterationRecord]) -> LCurve | None:
    """Return the L-curve of the last accepted step."""
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
    """Return the key `trust` of `modetune update --json`; null if no sensitivity was computed."""
    if trust is None:
        return None
    found, names = trust.identifiability, [item.name for item in trust.parameters]
    subsets = zip(
        found.collinearity.members.tolist(), found.collinearity.indices.tolist(), strict=True
    )
    return json_object(
        trust,
        "verdict regularisation missed n_predicted",
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
                repeatability=item.repeatability or None,
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
    """Return a sentence if updating added modes below all paired ones."""
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
