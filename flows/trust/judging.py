"""How far a campaign's answer can be trusted: worked out at its end, and told to machines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from modetune.core.estimation import LCurve, StepProblem, l_curve
from modetune.core.identifiability import identifiability, remaining_step
from modetune.core.judgement import (
    combination_sentences,
    judge_parameters,
    short_sentences,
    trust_sentences,
)
from modetune.core.keys import Json, number_or_null
from modetune.core.modes import Floats
from modetune.core.numbering import mode_name
from modetune.core.record import CampaignRecord, IterationRecord
from modetune.core.trust import StartSpread, Trust, with_concerns
from modetune.flows.campaign import Campaign
from modetune.flows.evaluating import Matrix
from modetune.flows.localisation.form_verdict import record_verdict

#: Collinear subsets that the summary names.
NAMED = 10


def campaign_trust(
    campaign: Campaign,
    iterations: Sequence[IterationRecord],
    matrix: Matrix | None,
    standard_errors: Floats,
    agrees: bool,
) -> Trust | None:
    """What the newest sensitivity and the test say of the parameters; None without a sensitivity.

    standard_errors: (n_parameters,); agrees: whether e1 is met.
    """
    if matrix is None:
        return None
    last = [iteration for iteration in iterations if iteration.accepted][-1]
    parameters, factor = campaign.parameters, 1.0
    if campaign.update.step == "pulled_to_initial" and np.isfinite(last.regularisation):
        factor = last.regularisation
    found = identifiability(
        matrix.values, last.residual.weights, parameters.standard_deviations, last.parameters,
        factor,
    )  # fmt: skip
    return Trust(
        parameters=judge_parameters(
            parameters, last.parameters, iterations[0].parameters, standard_errors, found,
            matrix.missing,
        ),
        identifiability=found,
        agrees=agrees,
        unseen=combination_sentences(parameters.names, found),
        curve=_curve(campaign, iterations),
        regularisation=last.regularisation,
        age=matrix.age,
        concerns=_short(campaign, last, matrix, standard_errors) if agrees else (),
    )  # fmt: skip


def checked(record: CampaignRecord) -> CampaignRecord:
    """The record of an update that has ended, its trust judged by what is left and held out too."""
    if record.trust is None:
        return record
    trust, found = record.trust, record_verdict(record)
    if found is not None and found.form.suspected:
        trust = replace(with_concerns(trust, found.sentence), times_noise=found.form.times_noise)
    elif found is not None and found.form.overstated:
        trust = replace(trust, notes=(*trust.notes, found.sentence))
    return replace(record, trust=with_concerns(trust, *_worse(record)))


def _worse(record: CampaignRecord) -> tuple[str, ...]:
    """A sentence where held-out modes got worse."""
    held = record.held_out
    if held is None or not held.any_worse:
        return ()
    names = [mode_name(record.configurations, number) for number in held.numbers[held.worse]]
    return (
        f"{len(names)} of {held.numbers.size} held-out modes got worse by updating "
        f"({', '.join(names)}): the parameters may have been bent to fit the others.",
    )


def _short(
    campaign: Campaign, last: IterationRecord, matrix: Matrix, standard_errors: Floats
) -> tuple[str, ...]:
    if campaign.update.step == "pulled_to_initial":
        return ()  # its answer is not the least misfit, and its standard errors know that
    remaining = remaining_step(
        matrix.values, last.residual.values, last.residual.weights,
        campaign.parameters.standard_deviations,
    )  # fmt: skip
    return short_sentences(campaign.parameters.names, remaining, standard_errors)


def _curve(campaign: Campaign, iterations: Sequence[IterationRecord]) -> LCurve | None:
    """The L-curve of the last step that was kept."""
    kept = [iteration for iteration in iterations if iteration.accepted]
    if len(kept) < 2:
        return None
    before, last = kept[-2].residual, kept[-1]
    n = len(campaign.parameters)
    fits = last.sensitivity.shape == (before.values.size, n)
    if not fits or not last.sensitivity.any() or not before.values[before.weights > 0.0].any():
        return None
    free = np.full(n, np.inf)
    return l_curve(StepProblem(
        sensitivity=last.sensitivity,
        residual=before.values,
        weights=before.weights,
        parameter_weights=campaign.parameters.standard_deviations**-2,
        offset=np.zeros(n),
        lower=-free,
        upper=free,
    ))  # fmt: skip


def trust_summary(trust: Trust | None) -> Json:
    """The key `trust` of `modetune update --json`; null where no sensitivity was computed."""
    if trust is None:
        return None
    found, names = trust.identifiability, [item.name for item in trust.parameters]
    subsets = zip(
        found.collinearity.members.tolist(), found.collinearity.indices.tolist(), strict=True
    )
    told: dict[str, Json] = {
        "verdict": trust.verdict,
        "sentences": list(trust_sentences(trust)),
        "condition": number_or_null(found.condition),
        "singular_values": [number_or_null(value) for value in found.singular_values],
        "parameters_told": number_or_null(found.n_told),
        "collinearity_index": number_or_null(found.collinearity.whole),
        "collinear_subsets": [
            {
                "parameters": [names[place] for place in row if place >= 0],
                "index": number_or_null(index),
            }
            for row, index in list(subsets)[:NAMED]
        ],
        "unseen_combinations": [
            {
                "parameters": [names[place] for place in item.members],
                "changes": [number_or_null(change) for change in item.changes],
                "seen": number_or_null(item.seen),
            }
            for item in found.unseen
        ],
        "regularisation": number_or_null(trust.regularisation),
        "l_curve_corner": None if trust.curve is None else number_or_null(trust.curve.corner),
        "sensitivity_age": trust.age,
        "parameters": [
            {
                "name": item.name,
                "test_share": number_or_null(item.test_share),
                "standard_error": number_or_null(item.standard_error),
                "on_bound": item.on_bound,
                "collinear_with": list(item.collinear_with),
                "flags": list(item.flags),
                "sentence": item.sentence,
            }
            for item in trust.parameters
        ],
    }
    if trust.spread is not None:
        told["starts"] = _told_starts(trust.spread)
    return told


def _told_starts(spread: StartSpread) -> Json:
    return {
        "seed": spread.seed,
        "chosen": spread.chosen,
        "places": int(spread.minima.max(initial=-1)) + 1,
        "fit_as_well": list(spread.rivals),
        "differ": list(spread.differ),
        "runs": [
            {
                "start": [number_or_null(value) for value in spread.starts[number]],
                "updated": [number_or_null(value) for value in spread.updated[number]],
                "misfit": number_or_null(spread.misfits[number]),
                "outcome": spread.outcomes[number],
                "place": int(spread.minima[number]),
            }
            for number in range(len(spread.outcomes))
        ],
    }
