"""One row model: the same rows on a terminal, in JSON, for Prefect and as a data frame."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest
from rich.console import Console

from modetune.core.storage.campaign_record import CampaignRecord
from modetune.flows.report.iteration_tables import run_table
from modetune.flows.report.mode_tables import ModeRow, mode_rows, mode_table
from modetune.flows.report.parameter_tables import ParameterRow, parameter_rows, parameter_table
from modetune.flows.report.tables import (
    Column,
    artifact_rows,
    columns_of,
    frame,
    hertz,
    json_object,
    json_of,
    show,
    table_of,
)


@dataclass(frozen=True, slots=True)
class Row:
    """A row with one field that people are not shown."""

    name: Annotated[str, Column("what it is called")]
    share: Annotated[float, Column("share", "%", "+.1f", "not known")]
    key: int


def printed(record: CampaignRecord) -> str:
    console = Console(file=io.StringIO(), width=200)
    show([mode_table(record)], console)
    text = console.file.getvalue()  # type: ignore[attr-defined]  # a StringIO
    assert isinstance(text, str)
    return text


def test_shares_are_written_in_percent_and_what_rounds_to_nothing_has_no_sign() -> None:
    rows = [Row("a", 0.25, 1), Row("b", -0.0001, 2), Row("c", np.nan, 3)]
    table = table_of("", rows, Row)
    assert [column.head for column in table.columns] == ["what it is called", "share, %"]
    assert table.texts == [["a", "+25.0"], ["b", "0.0"], ["c", "not known"]]


def test_words_stand_to_the_left_and_numbers_to_the_right() -> None:
    assert [column.words for column in columns_of(Row)] == [True, False]


@pytest.mark.parametrize(
    ("value", "shown"), [(0.0, "0.000"), (4.7912, "4.791"), (123.456, "123.46"), (99999.4, "99999")]
)
def test_a_frequency_has_five_digits_and_three_decimals_at_most(value: float, shown: str) -> None:
    assert hertz(value) == shown


def test_every_reader_gets_the_same_modes(record: CampaignRecord) -> None:
    table, rows = mode_table(record), mode_rows(record)
    told = json.loads(json.dumps(json_of(rows)))
    assert [row["initial_hz"] for row in told] == [row.initial_hz for row in rows]
    assert list(told[0]) == list(frame(rows, ModeRow)) == [item.name for item in fields(ModeRow)]
    headed = json.loads(json.dumps(artifact_rows(table)))
    assert [str(value) for value in headed[0].values()] == table.texts[0]
    assert list(headed[0]) == [column.head for column in table.columns]
    shown = printed(record)
    for texts in (*table.texts, *table.foot_texts):
        assert all(text in shown for text in texts)


def test_what_the_tolerance_does_not_allow_is_outside(record: CampaignRecord) -> None:
    assert mode_table(record).outside == frozenset()
    strict = mode_table(replace(record, e1_frequency=1e-4))
    assert strict.outside == {(place, "error_updated") for place in range(3)}
    assert parameter_table(record).outside == {(1, "on_bound")}  # t ends at 1.2, its upper bound


def test_parameters_are_told_in_the_decks_units(record: CampaignRecord) -> None:
    rows = parameter_rows(record)
    assert [(row.deck_value, row.unit) for row in rows] == [(210e3, "MPa"), (2.0, "mm")]
    assert rows[1].updated_value == pytest.approx(2.4)  # 20 % more
    assert rows[1].meaning == "thickness of SKIN, RIB"
    assert rows[1].bounds == (0.5, 1.2)
    data = frame(rows, ParameterRow)
    assert data["updated"].tolist() == [1.0, 1.2]


def test_costs_are_summed_below(record: CampaignRecord) -> None:
    # Three iterations of one modal and two sensitivity runs each.
    assert run_table(record).foot_texts[0][:3] == ["all", "3", "6"]


def test_an_empty_table_is_not_shown() -> None:
    console = Console(file=io.StringIO())
    show([table_of("nothing", [], Row)], console)
    assert console.file.getvalue() == ""  # type: ignore[attr-defined]  # a StringIO
    assert list(frame([], Row)) == ["name", "share", "key"]


def test_json_has_no_number_that_is_not_finite() -> None:
    found = {"a": np.array([1.0, np.inf]), "b": (np.float64("nan"), Path("x")), "c": Row("", 1, 2)}
    told = json_of(found)
    assert told == {
        "a": [1.0, None], "b": [None, "x"], "c": {"name": "", "share": 1, "key": 2},
    }  # fmt: skip
    with pytest.raises(TypeError, match="object has no form in JSON"):
        json_of(object())


def test_a_result_is_told_by_its_attributes_and_by_names_of_its_own() -> None:
    assert json_object(Row("a", 0.5, 1), "name key", status="done") == {
        "name": "a",
        "key": 1,
        "status": "done",
    }


@dataclass
class Measured:
    """A row with a number that may be unknown."""

    name: str
    order: int
    error: Annotated[float | None, Column("error")]
    used: bool


@pytest.mark.parametrize("rows", [[], [Measured("a", 1, None, True)], [Measured("a", 1, 2, True)]])
def test_columns_of_a_frame_have_the_types_of_their_fields(rows: list[Measured]) -> None:
    types = frame(rows, Measured).dtypes.astype(str)
    assert types[["order", "error", "used"]].tolist() == ["int64", "float64", "bool"]
