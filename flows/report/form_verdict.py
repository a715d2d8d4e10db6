"""Whether a campaign's residual can be removed at all: the test for model-form error, in words.

`record_verdict` judges a campaign that has ended, from its record alone; `residual_form` any state
whose residual and sensitivity are known. The test itself is `core/updating/model_form`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modetune.core.modes import Floats
from modetune.core.parameters import ParameterSet
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.storage.keys import Json
from modetune.core.updating.model_form import (
    ModelForm,
    model_form,
    model_form_sentence,
    shares_left,
)
from modetune.core.updating.parameter_fields import prior_precision
from modetune.core.updating.responses.response import Residual
from modetune.flows.report.tables import json_object


def residual_form(
    sensitivity: Floats,
    found: Residual,
    parameters: ParameterSet,
    theta: Floats,
    moved: Floats | None = None,
    least: float = 0.0,
    prior: Floats | None = None,
) -> tuple[ModelForm, tuple[str, ...]]:
    """The test for model-form error, and what each entry that took part is of.

    sensitivity: (n_residuals, n_parameters), at theta (n_parameters,); moved: (n_parameters,), how
    far parameters went since; least: times noise that have to be left before a fault is suspected.
    prior: (n_parameters, n_parameters), what holds the zones of fields. Raises CampaignError.
    """
    used = found.weights > 0.0
    form = model_form(
        found.independent(sensitivity)[used],
        found.independent(found.values)[used],
        found.variances[used],
        np.minimum(parameters.lower - theta, 0.0),
        np.maximum(parameters.upper - theta, 0.0),
        shapes=found.owners(scaled=True)[used],
        moved=moved,
        least=least,
        prior=prior,
        offset=theta - parameters.initial,
    )
    labels = zip(found.labels, used.tolist(), strict=True)
    return form, tuple(f"the {label}" for label, on in labels if on)


#: Ends the sentence of an update that suspects an error.
WHERE = " `modetune localise` shows where."


@dataclass(frozen=True, slots=True)
class FormVerdict:
    """The test for model-form error, the labels of the residuals in it, and a sentence."""

    form: ModelForm
    labels: tuple[str, ...]
    sentence: str


def record_verdict(record: CampaignRecord) -> FormVerdict | None:
    """Return the verdict on a finished campaign from its last sensitivity; None without one."""
    best = record.best
    size = best.residual.values.size, len(record.parameters)
    had = [
        (place, item)
        for place, item in enumerate(record.iterations)
        if item.sensitivity.shape == size
    ]
    if not had:
        return None
    place, last = had[-1]
    # The sensitivity of a step was computed where the step began, or a few accepted steps before.
    began = [item for item in record.iterations[:place] if item.accepted]
    start = began[max(0, len(began) - 1 - last.sensitivity_age)].parameters
    fields, own = [item.field for item in record.fields], record.parameters
    factor = last.regularisation if np.isfinite(last.regularisation) else 1.0
    offset = best.parameters - own.initial
    form, labels = residual_form(
        last.sensitivity,
        best.residual,
        record.parameters,
        best.parameters,
        best.parameters - start,
        prior=factor * prior_precision(fields, offset, own.standard_deviations) if fields else None,
    )
    text = model_form_sentence(form, labels, record.parameters.names, updated=True)
    if form.suspected:
        text += WHERE
    return FormVerdict(form, labels, text)


def verdict_summary(record: CampaignRecord) -> Json:
    """Return the key `model_form` of `modetune update --json`; null without a sensitivity."""
    found = record_verdict(record)
    return None if found is None else form_json(found.form, found.labels, found.sentence)


def form_json(form: ModelForm, labels: tuple[str, ...], sentence: str) -> Json:
    """Return the JSON of a test for model-form error."""
    return json_object(
        form,
        "suspected p_value level times_noise",
        sentence=sentence,
        chi_square=form.statistic,
        degrees_of_freedom=form.dof,
        left=[{"of": label, "share": share} for label, share in shares_left(form, labels)],
    )
