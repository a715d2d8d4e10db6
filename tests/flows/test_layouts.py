"""What files of our own look like: a changed layout needs a new number of its format.

Where a case fails, a field of a dataclass that is written was added, renamed, removed or got
another type. Files of before cannot be read then: raise the FORMAT of the store, or the number of
the record's RecordFile, and set the new digest here.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any, get_args

import pytest

from modetune.core.monitoring.past_runs import PAST_RUN
from modetune.core.storage import codec, store
from modetune.core.storage.campaign_record import CAMPAIGN
from modetune.core.updating.job_results import Result
from modetune.flows.studies.sample.record import POSTERIOR
from modetune.flows.studies.scatter.record import SCATTER
from modetune.flows.studies.screen.record import SCREENING


def layout(form: Any) -> Any:
    """Names and types of what a form writes, all the way down."""
    match form:
        case codec._Dataclass():
            return {name: layout(inner) for name, inner in form.forms}
        case codec._OneOf():
            return {name: layout(codec._form(kind)) for name, kind in form.kinds.items()}
        case codec._Optional():
            return ["or nothing", layout(form.form)]
        case codec._Items():
            return ["group", form.count, [layout(inner) for inner in form.forms]]
        case codec._Mapping():
            return ["mapping", layout(form.keys), layout(form.values)]
        case codec._Column():
            return ["column", form.count, layout(form.item)]
        case codec._Array():
            return ["array", *(dtype.name for dtype in form.dtypes)]
        case codec._Scalar():
            return form.kind.__name__
        case _:
            return type(form).__name__


def digest(kind: Any) -> str:
    text = json.dumps(layout(codec._form(kind)), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


@pytest.mark.parametrize(
    ("kind", "number", "expected"),
    [
        (CAMPAIGN.kind, CAMPAIGN.format, (12, "9890f0c936b9")),
        (PAST_RUN.kind, PAST_RUN.format, (2, "a4f4fb9e7f33")),
        (SCREENING.kind, SCREENING.format, (7, "0750f1b2a126")),
        (SCATTER.kind, SCATTER.format, (2, "abe5ba0d35f1")),
        (POSTERIOR.kind, POSTERIOR.format, (5, "333c51fb996e")),
        (store.KINDS["modal"], store.FORMAT, (4, "9910e8ca9987")),
        (store.KINDS["matrices"], store.FORMAT, (4, "2a942894df94")),
        (store.KINDS["derivatives"], store.FORMAT, (4, "98c110189d0b")),
        (store.KINDS["parameter_matrices"], store.FORMAT, (4, "de47f344f415")),
        (store.KINDS["reduced"], store.FORMAT, (4, "a31ca021cd2b")),
        (store.KINDS["reduced_range"], store.FORMAT, (4, "013c5407802b")),
        (store.KINDS["modes_forecast"], store.FORMAT, (4, "ab1c5574bce3")),
        (store.KINDS["registration"], store.FORMAT, (4, "fc6b6dd27463")),
        (store.KINDS["solved_modes"], store.FORMAT, (4, "7cb524389032")),
        (store.KINDS["search_ends"], store.FORMAT, (4, "4fd03a8bbbe8")),
    ],
    ids=lambda item: getattr(item, "__name__", None),
)
def test_a_layout_belongs_to_its_format(kind: type, number: int, expected: tuple[int, str]) -> None:
    assert (number, digest(kind)) == expected


def test_every_result_has_a_kind_in_the_store() -> None:
    assert set(store.KINDS.values()) == set(get_args(Result))
