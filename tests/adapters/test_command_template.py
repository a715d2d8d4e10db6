"""Numbers of a deck template: where they stand, how they are written, what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modetune.adapters.command.settings import CommandSettings, NumberRule
from modetune.adapters.command.template import Spot, Template, read_template, read_value
from modetune.core.errors import ModelError

DECK = "MAT,1,{E=7.0E+10:.6E}\r\nT={t=2.5:8.4f};  again {E:12.5D} {n_modes:4d}\r\n"


def template(folder: Path, text: str = DECK, *rules: NumberRule, **settings: object) -> Template:
    deck = folder / "deck.txt"
    deck.write_bytes(text.encode("latin-1"))
    made = CommandSettings("p", ("p",), "1", "nodes.csv", edits=rules, **settings)  # type: ignore[arg-type]
    return read_template(deck, made)


def scaled(found: Template, factors: dict[str, float]) -> dict[Spot, float]:
    return {s: s.number * f for name, f in factors.items() for s in found.spots[name]}


def test_placeholders_become_numbers_and_all_else_stays_as_it_was(tmp_path: Path) -> None:
    found = template(tmp_path)
    text = found.filled(scaled(found, {"E": 1.1}), 12)["deck.txt"]
    assert text == b"MAT,1,7.700000E+10\r\nT=  2.5000;  again  7.70000D+10   12\r\n"
    assert [spot.where.rpartition(", ")[2] for spot in found.spots["E"]] == ["line 1", "line 2"]
    assert {spot.number for spot in found.spots["E"]} == {7.0e10}


def test_an_updated_template_holds_what_was_run_as_its_own_values(tmp_path: Path) -> None:
    values = {"E": 1.23456789, "t": 0.777777}
    found = template(tmp_path)
    (tmp_path / "deck.txt").write_bytes(found.updated(scaled(found, values))["deck.txt"])
    again = read_template(tmp_path / "deck.txt", CommandSettings("p", ("p",), "1", "nodes.csv"))
    assert again.filled({}, 12) == found.filled(scaled(found, values), 12)
    assert again.spots["t"][0].number == 1.9444  # the deck holds four decimals


def test_bytes_of_no_encoding_survive(tmp_path: Path) -> None:
    found = template(tmp_path, "Tr\xe4ger {E=1.}\xff\n")
    assert found.filled(scaled(found, {"E": 2.0}), 1)["deck.txt"] == b"Tr\xe4ger 2.0\xff\n"


@given(st.floats(min_value=1e-12, max_value=1e15), st.floats(min_value=0.2, max_value=5.0))
def test_a_number_without_a_format_loses_nothing(value: float, factor: float) -> None:
    spot = Spot("E", 0, 1, value, "here")
    assert read_value(spot.written(value * factor)) == value * factor


@given(st.floats(min_value=1e-12, max_value=1e15))
def test_columns_hold_as_many_digits_as_fit(value: float) -> None:
    text = Spot("E", 0, 10, value, "here", width=10).written(value)
    # Four characters of an exponent and a point leave at least five digits of ten columns.
    assert len(text) == 10
    assert read_value(text) == pytest.approx(value, rel=0.5e-4)


RULED = """* stiffness of the joints
  101   2.5E6  2.5E6   0.
  102 , 3.0D6 ,, 7.
PBAR           1       1  0.0012  1.6E-6
k_joint = 12.5   # first
k_joint = 25     # second
"""
RULES = (
    NumberRule("k1", line=2, field=2),
    NumberRule("k2", line=3, field=2, form=".4E"),
    NumberRule("A", line=4, columns=(25, 32)),
    NumberRule("kj", pattern=r"^k_joint = (\S+)"),
)


def test_rules_find_numbers_by_field_columns_and_pattern(tmp_path: Path) -> None:
    found = template(tmp_path, RULED, *RULES)
    at = {name: [spot.number for spot in spots] for name, spots in found.spots.items()}
    assert at == {"k1": [2.5e6], "k2": [3.0e6], "A": [0.0012], "kj": [12.5, 25.0]}
    text = found.filled(scaled(found, {"k1": 2.0, "k2": 0.5, "A": 1.1, "kj": 3.0}), 1)[
        "deck.txt"
    ].decode()
    assert text.splitlines() == [
        "* stiffness of the joints",
        "  101   5000000.0  2.5E6   0.",
        "  102 , 1.5000E+06 ,, 7.",
        "PBAR           1       1 0.00132  1.6E-6",
        "k_joint = 37.5   # first",
        "k_joint = 75.0     # second",
    ]
    assert not found.has_placeholders


def test_numbers_may_stand_in_files_beside_the_deck(tmp_path: Path) -> None:
    (tmp_path / "inc").mkdir()
    (tmp_path / "inc" / "sizes.inc").write_text("t = {t=2.0}\nd = 5.5\n")
    rule = NumberRule("d", file="inc/sizes.inc", line=2, field=3)
    found = template(tmp_path, "*INCLUDE, inc/sizes.inc\n", rule, inputs=("inc/sizes.inc",))
    assert found.filled(scaled(found, {"t": 1.5, "d": 2.0}), 1) == {
        "deck.txt": b"*INCLUDE, inc/sizes.inc\n",
        "inc/sizes.inc": b"t = 3.0\nd = 11.0\n",
    }


@pytest.mark.parametrize(
    ("text", "rules", "said"),
    [
        ("E {E:12.5E}\n", (), "line 1: the placeholder of E has no value; write the deck's own"),
        ("a\nE {E=steel}\n", (), "line 2: `{E=steel}`: steel is not a number"),
        ("E {E=1.:5x}\n", (), "line 1: `{E=1.:5x}`: 5x is not a format such as 12.5E"),
        ("{n_modes:.3E}\n", (), "a number of modes is whole; write `:5d`"),
        ("1 2\n", (NumberRule("E", line=3, field=1),), "it has 1 lines, and not line 3"),
        ("1 2\n", (NumberRule("E", line=1, field=3),), "line 1 has 2 fields, and not 3"),
        ("1 2\n", (NumberRule("E", line=1, columns=(3, 8)),), "line 1 has 3 columns, and not 8"),
        ("1 x\n", (NumberRule("E", line=1, field=2),), "line 1: the edit of E finds `x`"),
        ("1 2\n", (NumberRule("E", pattern="E=(.*)"),), "`E=(.*)` is found nowhere"),
        ("1 2\n", (NumberRule("E", pattern="E=.*"),), "has 0 groups; it needs one"),
        ("1 2\n", (NumberRule("E", pattern="(E"),), "edit of E: missing )"),
        ("1 2\n", (NumberRule("E", file="b.inc", line=1, field=1),), "names the file b.inc"),
        (
            "1 25\n",
            (NumberRule("E", line=1, field=2), NumberRule("t", line=1, columns=(4, 4))),
            "E and t both change one number",
        ),
    ],
)
def test_what_cannot_be_a_number_is_told_with_its_place(
    tmp_path: Path, text: str, rules: tuple[NumberRule, ...], said: str
) -> None:
    with pytest.raises(ModelError) as caught:
        template(tmp_path, text, *rules)
    assert said in str(caught.value)
    assert str(tmp_path / "deck.txt") in str(caught.value)


def test_other_delimiters_leave_braces_alone(tmp_path: Path) -> None:
    text = "print(f'{E:.3E}', {'a': 1}, <<E=1.0>>)\n"
    found = template(tmp_path, text, delimiters=("<<", ">>"))
    assert found.filled({}, 1)["deck.txt"].decode() == text.replace("<<E=1.0>>", "1.0")


def test_a_number_that_does_not_fit_its_columns_is_refused(tmp_path: Path) -> None:
    found = template(tmp_path, "E{E=1.0:6.1f}|\n")
    with pytest.raises(ModelError, match=r"line 1: `100000\.0` of E has 8 characters where 6 are"):
        found.filled(scaled(found, {"E": 1e5}), 1)
    with pytest.raises(ModelError, match="which is not a number"):
        found.filled(scaled(found, {"E": float("nan")}), 1)
