"""Whether a campaign's residual can be removed at all: the test for model-form error, in words.

`record_verdict` judges a campaign that has ended, from its record alone; `residual_form` any state
whose residual and sensitivity are known. The test itself is `core/updating/model_form`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from modetune.core.modes import Floats, common_dofs
from modetune.core.parameters import ParameterSet
from modetune.core.storage.keys import Json
from modetune.core.storage.record import CampaignRecord
from modetune.core.updating.model_form import (
    ModelForm,
    model_form,
    model_form_sentence,
    shares_left,
)
from modetune.core.updating.residual import Residual
from modetune.flows.report.mode_tables import mode_label
from modetune.flows.report.tables import json_object


def residual_form(
    sensitivity: Floats,
    found: Residual,
    modes: Sequence[str],
    parameters: ParameterSet,
    theta: Floats,
    moved: Floats | None = None,
    entries: Sequence[int] | None = None,
    least: float = 0.0,
) -> tuple[ModelForm, tuple[str, ...]]:
    """The test for model-form error, and what each entry that took part is of.

    sensitivity: (n_residuals, n_parameters), at theta (n_parameters,); modes: names of the test's
    modes, in the order of the pairs; moved: (n_parameters,), how far parameters went since;
    entries: how many entries each pair's shape has, equally many if left out; least: times noise
    that have to be left before a fault is suspected. Raises CampaignError.
    """
    n_pairs = found.n_frequencies
    n_shapes = found.values.size - n_pairs
    labels = [f"the frequency of {name}" for name in modes]
    sizes = [n_shapes // n_pairs] * n_pairs if entries is None else list(entries)
    labels += [
        f"the shape of {name}" for name, size in zip(modes, sizes, strict=True) for _ in range(size)
    ]
    owner = np.concatenate([np.full(n_pairs, -1), np.repeat(np.arange(n_pairs), sizes)])
    used = found.weights > 0.0
    form = model_form(
        sensitivity[used],
        found.values[used],
        found.variances[used],
        np.minimum(parameters.lower - theta, 0.0),
        np.maximum(parameters.upper - theta, 0.0),
        shapes=owner[used],
        moved=moved,
        least=least,
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
    names = [f"mode {mode_label(record, item)}" for item in best.pairing.measured.tolist()]
    form, labels = residual_form(
        last.sensitivity,
        best.residual,
        names,
        record.parameters,
        best.parameters,
        best.parameters - start,
        _entries(record) if record.configurations else None,
    )
    said = model_form_sentence(form, labels, record.parameters.names, updated=True)
    if form.suspected:
        said += " `modetune localise` shows where."
    return FormVerdict(form, labels, said)


def _entries(record: CampaignRecord) -> list[int]:
    """How many entries the shape of each pair has, where configurations have sensors of their own.

    Node n of the configuration at a place stands as base * place + n, the base a power of ten.
    """
    best = record.best
    order = [*dict.fromkeys(record.configurations)]
    paired = best.pairing.measured.tolist()
    places = [order.index(record.configurations[pair]) + 1 for pair in paired]
    rows, _ = common_dofs(record.test.modes, best.computed)
    nodes = record.test.modes.nodes[rows]
    fits = [base for base in 10 ** np.arange(18, 2, -1) if np.isin(nodes // base, places).all()]
    sizes = [int(np.sum(nodes // fits[0] == place)) for place in places] if fits else []
    n_shapes = best.residual.values.size - best.residual.n_frequencies
    if sum(sizes) == n_shapes and sizes:
        return sizes
    # Shapes that take no part in some configurations: equally many is as near as can be known.
    return [part.size for part in np.array_split(np.arange(n_shapes), len(places))]


def verdict_summary(record: CampaignRecord) -> Json:
    """The key `model_form` of `modetune update --json`; null where nothing can be said."""
    found = record_verdict(record)
    return None if found is None else told_form(found.form, found.labels, found.sentence)


def told_form(form: ModelForm, labels: tuple[str, ...], sentence: str) -> Json:
    """The same of any state."""
    return json_object(
        form,
        "suspected p_value level times_noise",
        sentence=sentence,
        chi_square=form.statistic,
        degrees_of_freedom=form.dof,
        left=[{"of": label, "share": share} for label, share in shares_left(form, labels)],
    )
