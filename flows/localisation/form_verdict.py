"""Whether a campaign's residual can be removed at all: the test for model-form error, in words.

`record_verdict` judges a campaign that has ended, from its record alone; `residual_form` any state
whose residual and sensitivity are known. The test itself is `core/model_form.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modetune.core.keys import Json
from modetune.core.model_form import ModelForm, model_form, model_form_sentence, shares_left
from modetune.core.modes import Floats
from modetune.core.numbering import mode_name
from modetune.core.parameters import ParameterSet
from modetune.core.record import CampaignRecord
from modetune.core.residual import Residual


def residual_form(
    sensitivity: Floats,
    found: Residual,
    modes: Sequence[str],
    parameters: ParameterSet,
    theta: Floats,
    moved: Floats | None = None,
    alike: bool = True,
) -> tuple[ModelForm, tuple[str, ...]]:
    """The test for model-form error, and what each entry that took part is of.

    sensitivity: (n_residuals, n_parameters), at theta (n_parameters,); modes: names of the test's
    modes, in the order of the pairs; moved: (n_parameters,), how far parameters went since; alike:
    whether all modes were measured at the same sensors. Raises CampaignError.
    """
    n_pairs = found.n_frequencies
    n_shapes = found.values.size - n_pairs
    labels = [f"the frequency of {name}" for name in modes]
    if alike:
        labels += [f"the shape of {name}" for name in modes for _ in range(n_shapes // n_pairs)]
    else:
        labels += ["the shapes"] * n_shapes
    names = list(dict.fromkeys(labels[n_pairs:]))
    owner = np.array([-1] * n_pairs + [names.index(label) for label in labels[n_pairs:]])
    used = found.weights > 0.0
    form = model_form(
        sensitivity[used],
        found.values[used],
        found.variances[used],
        np.minimum(parameters.lower - theta, 0.0),
        np.maximum(parameters.upper - theta, 0.0),
        shapes=owner[used],
        moved=moved,
    )
    return form, tuple(label for label, on in zip(labels, used.tolist(), strict=True) if on)


@dataclass(frozen=True, slots=True)
class FormVerdict:
    """What updating left, judged by measurement noise, and the sentence for people.

    labels: what each entry that took part is of.
    """

    form: ModelForm
    labels: tuple[str, ...]
    sentence: str


def record_verdict(record: CampaignRecord) -> FormVerdict | None:
    """The verdict on a campaign that has ended, by the last sensitivity it had; runs nothing.

    None where it ended without a sensitivity.
    """
    best = record.best
    size = best.residual.values.size, len(record.parameters)
    had = [(place, item) for place, item in enumerate(record.iterations)
           if item.sensitivity.shape == size]  # fmt: skip
    if not had:
        return None
    place, last = had[-1]
    # The sensitivity of a step was computed where the step began, or a few accepted steps before.
    began = [item for item in record.iterations[:place] if item.accepted]
    start = began[max(0, len(began) - 1 - last.sensitivity_age)].parameters
    numbers = [record.test.numbers[item] for item in best.pairing.measured.tolist()]
    names = [mode_name(record.configurations, number) for number in numbers]
    form, labels = residual_form(
        last.sensitivity, best.residual, names, record.parameters, best.parameters,
        best.parameters - start, alike=not record.configurations,
    )  # fmt: skip
    said = model_form_sentence(form, labels, record.parameters.names, updated=True)
    return FormVerdict(form, labels, said)


def verdict_summary(record: CampaignRecord) -> Json:
    """The key `model_form` of `modetune update --json`; null where nothing can be said."""
    found = record_verdict(record)
    return None if found is None else told_form(found.form, found.labels, found.sentence)


def told_form(form: ModelForm, labels: tuple[str, ...], sentence: str) -> Json:
    """The same of any state."""
    return {
        "suspected": form.suspected,
        "sentence": sentence,
        "chi_square": form.statistic,
        "degrees_of_freedom": form.dof,
        "p_value": form.p_value if np.isfinite(form.p_value) else None,
        "level": form.level,
        "times_noise": form.times_noise if np.isfinite(form.times_noise) else None,
        "left": [{"of": label, "share": share} for label, share in shares_left(form, labels)],
    }
