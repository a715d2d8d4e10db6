"""Reading Nastran decks in every format, and edits that change one number and nothing else."""

from __future__ import annotations

import contextlib
import difflib
import json
import re
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyNastran.bdf.bdf import BDF
from pyNastran.bdf.field_writer_8 import print_float_8

from modetune.adapters.nastran.deck import NastranDeck, read_deck, with_lines, write_edited
from modetune.adapters.nastran.fields import (
    CardField,
    NastranCard,
    changed_texts,
    format_number,
    read_number,
)
from modetune.core.errors import ModelError

#: The last digits before a double overflows may round to what is none.
FINITE = st.floats(-1e300, 1e300)
#: What engineering decks hold; a double goes further than a Nastran's single precision.
ORDINARY = st.floats(1e-30, 1e30).flatmap(lambda value: st.sampled_from((value, -value)))


def write(folder: Path, **texts: str) -> Path:
    """Files by name (`__` for a folder, `.bdf` added); returns the one called main."""
    for name, text in texts.items():
        path = folder / f"{name.replace('__', '/')}.bdf"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text.encode())
    return folder / "main.bdf"


def names(deck: NastranDeck) -> list[str]:
    return [card.name for card in deck.cards]


def texts(card: NastranCard) -> list[str]:
    return [field.text if field else "" for field in card.fields]


def only(folder: Path, text: str) -> NastranCard:
    """The one card of a deck of bulk data alone."""
    (card,) = read_deck(write(folder, main=text)).cards
    return card


def field_of(card: NastranCard, place: int) -> CardField:
    field = card.fields[place]
    assert field is not None
    return field


@pytest.mark.parametrize(
    ("text", "value"),
    [("7.1+4", 7.1e4), ("7.1D4", 7.1e4), ("7.1d+4", 7.1e4), ("-.5", -0.5), ("1.E-3", 1e-3),
     ("+2.", 2.0), ("-1.5-3", -1.5e-3), (" 30 ", 30.0)],
)  # fmt: skip
def test_numbers_are_read_as_nastran_reads_them(text: str, value: float) -> None:
    assert read_number(text) == value  # the manuals' ways of writing reals


@pytest.mark.parametrize("text", ["", ".", "1.2.3", "E5", "1.+", "nan", "inf", "1e999", "THRU"])
def test_what_is_no_number_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match="is not"):
        read_number(text)


@pytest.mark.parametrize(
    ("value", "text"),
    [(71000.0, "71000."), (0.3, ".3"), (-0.0012345, "-.0012345"), (0.0, "0."), (2.81e-9, "2.81-9"),
     (7.1e10, "7.1+10"), (-1.5e-30, "-1.5-30"), (1234567.8, "1234568.")],
)  # fmt: skip
def test_short_numbers_are_written_as_people_write_them(value: float, text: str) -> None:
    # 16 columns hold -.0012345, which has nine characters, and all the others too.
    width = max(8, len(text))
    assert format_number(value, width) == text


@given(FINITE, st.sampled_from([8, 16]))
def test_written_numbers_fit_and_are_the_nearest_of_their_width(value: float, width: int) -> None:
    text = format_number(value, width)
    assert len(text) <= width
    assert "." in text
    # The worst case is -d.ddd-300: sign, point and a three-digit exponent leave width - 6 digits,
    # each of which halves nothing but the last; subnormal doubles have fewer digits themselves.
    assert read_number(text) == pytest.approx(value, rel=0.51 * 10.0 ** (7 - width), abs=1e-320)
    assert format_number(value, width) == text


@given(ORDINARY)
def test_eight_columns_hold_as_much_as_the_best_known_writer_gives_them(value: float) -> None:
    # pyNastran's own writer of small fields is the yardstick; a rounding error of a double is free.
    theirs = abs(read_number(print_float_8(value)) - value)
    ours = abs(read_number(format_number(value, 8)) - value)
    assert ours <= theirs * (1 + 1e-9) + abs(value) * 1e-15


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_numbers_that_are_none_are_not_written(value: float) -> None:
    with pytest.raises(ValueError, match="not a finite number"):
        format_number(value, 8)


SMALL = "MAT1    30      7.1+10          .33     2700.                           "
LARGE = "MAT1*                 30          7.1+10                             .33\n*           "
FORMATS = {
    "small": SMALL,
    "large": f"{LARGE}    2700.",
    "free": "MAT1, 30, 7.1+10,, .33 ,2700.",
    "free large": "MAT1*,30,7.1+10,,.33\n*,2700.",
    "tabs": "MAT1\t30\t7.1+10\t\t.33\t2700.",
    "large with tabs": "MAT1*\t30\t\t7.1+10\t\t\t\t.33\n*\t2700.",
    "lower case": "mat1    30      7.1+10          .33     2700.",
    "comment": "MAT1    30      7.1+10          .33     2700.   $ steel, not",
    "sequence numbers": f"{SMALL}00000010",
    "windows": "MAT1,30,7.1+10,,.33,2700.\r",
    "trailing comma": "MAT1,30,7.1+10,,.33,2700.,",
}  # fmt: skip


@pytest.mark.parametrize("text", FORMATS.values(), ids=FORMATS.keys())
def test_a_card_reads_the_same_in_every_format(tmp_path: Path, text: str) -> None:
    card = only(tmp_path, text + "\n")
    assert card.name == "MAT1"
    assert [text.upper() for text in texts(card)][1:] == ["30", "7.1+10", "", ".33", "2700."]


CONTINUED = {
    "plus": "PBAR    1       2       3.      4.      5.      6.\n+       7.",
    "blank": "PBAR    1       2       3.      4.      5.      6.\n        7.",
    "tags": f"{'PBAR    1       2       3.      4.      5.      6.':72}+A\n+A      7.",
    "free after fixed": "PBAR    1       2       3.      4.      5.      6.\n+,7.",
    "fixed after free": "PBAR,1,2,3.,4.,5.,6.\n+       7.",
    "large after small": "PBAR    1       2       3.      4.      5.      6.\n*       7.",
    "free tags": "PBAR,1,2,3.,4.,5.,6.,,,+A\n+A,7.",
    "comma": "PBAR,1,2,3.,4.,5.,6.,,,\n,7.",
    "comment between": "PBAR,1,2,3.,4.,5.,6.\n$ more\n\n+,7.",
    "tag only below": "PBAR,1,2,3.,4.,5.,6.\n+B,7.",
}


@pytest.mark.parametrize("text", CONTINUED.values(), ids=CONTINUED.keys())
def test_continuations_count_on_from_nine(tmp_path: Path, text: str) -> None:
    card = only(tmp_path, text)
    assert texts(card) == ["PBAR", "1", "2", "3.", "4.", "5.", "6.", "", "", "7."]


def test_tagged_continuations_are_found_where_they_stand(tmp_path: Path) -> None:
    first = "MAT1,1,2.,3.,4.,5.,6.,7.,8.,+ONE\n"
    second = "MAT1,2,20.,30.,40.,50.,60.,70.,80.,+TWO\n"
    main = write(tmp_path, main=f"{first}{second}+TWO,90.\n+ONE,9.\n")
    one, two = read_deck(main).cards
    assert texts(one)[9] == "9."
    assert texts(two)[9] == "90."
    assert one.lines == (0, 3)


def test_a_large_continuation_gives_four_fields(tmp_path: Path) -> None:
    text = "PBAR*   1               2               3.              4.\n*       5.\n*       7.\n"
    # Two lines of four make one of eight: the third line's first field is number 9.
    assert texts(only(tmp_path, text)) == ["PBAR*", "1", "2", "3.", "4.", "5.", "", "", "", "7."]


@pytest.mark.parametrize(
    ("text", "line", "message"),
    [
        ("GRID,1\n+B,2.,,,,,,,,+B\n\0", 3, "not a text file"),
        ("GRID,1\n=,*x\n", 2, "x"),
        ("GRID,1\n=,*1\n=9999999\n", 3, "9999999 copies of a card"),
        ("SOL 103\nCEND\nMETHOD=1\n", 3, "ends without BEGIN BULK"),
        ("SOL 103\nCEND\nBEGIN SUPER=1\nGRID,1\n", 3, "superelements"),
        ("CEND\nBEGIN BULK\nGRID,1\nBEGIN BULK\n", 4, "superelements"),
        ("INCLUDE\n", 1, "INCLUDE needs the name of a file"),
        ("GRID,1\nINCLUDE 'a\n", 2, "quote round the included file's name is not closed"),
        ("", 1, "the file holds no bulk data"),
        ("$ nothing\n", 1, "the file holds no bulk data"),
    ],
)
def test_malformed_decks_name_file_and_line(
    tmp_path: Path, text: str, line: int, message: str
) -> None:
    main = write(tmp_path, main=text)
    with pytest.raises(ModelError, match=rf"main\.bdf, line {line}: .*{re.escape(message)}"):
        read_deck(main)


@given(st.binary(max_size=200))
def test_no_bytes_raise_anything_but_a_model_error(data: bytes) -> None:
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "main.bdf"
        path.write_bytes(data)
        with contextlib.suppress(ModelError):
            read_deck(path)


CONTROL = """NASTRAN SYSTEM(151)=1
ASSIGN OUTPUT2='x.op2',UNIT=12
sol = SEMODES  $ by name
CEND
TITLE = include this SOL
METHOD = 1
BEGIN BULK $ here
GRID,1
ENDDATA
what follows is nothing, not even an
INCLUDE 'gone.bdf'
"""


def test_the_sections_of_a_deck_are_told_apart(tmp_path: Path) -> None:
    deck = read_deck(write(tmp_path, main=CONTROL))
    assert [deck.lines[place].text for place in deck.executive][-1] == "CEND"
    assert [deck.lines[place].text for place in deck.case_control][-1] == "METHOD = 1"
    assert deck.bulk.start == 7
    assert names(deck) == ["GRID"]


def test_bulk_data_alone_has_no_other_section(tmp_path: Path) -> None:
    deck = read_deck(write(tmp_path, main="GRID,1\nGRID,2\n"))
    assert (len(deck.executive), len(deck.case_control)) == (0, 0)
    assert len(deck.cards) == 2


def test_includes_are_found_beside_the_file_that_names_them_then_beside_the_main(
    tmp_path: Path,
) -> None:
    main = write(
        tmp_path,
        main="CEND\ninclude 'case.bdf'\nBEGIN BULK\n  Include \"sub/a.bdf\" $ nodes\n",
        case="METHOD = 1\n",
        sub__a="INCLUDE b.bdf\nINCLUDE 'c.bdf'\n",
        sub__b="GRID,1\n",
        b="MAT1,1\n",
        c="EIGRL,1\n",
    )
    deck = read_deck(main)
    assert names(deck) == ["GRID", "EIGRL"]
    assert deck.lines[deck.case_control.start].text == "METHOD = 1"
    assert deck.where(deck.cards[0]) == f"{tmp_path / 'sub' / 'b.bdf'}, line 1"


def test_a_quoted_name_goes_on_over_lines(tmp_path: Path) -> None:
    main = write(tmp_path, main="INCLUDE 'sub/\n  deep/\n  a.bdf'\nGRID,2\n", sub__deep__a="GRID,1")
    deck = read_deck(main)
    assert [texts(card)[1] for card in deck.cards] == ["1", "2"]
    assert [line.number for line in deck.includes[0].lines] == [1, 2, 3]


def test_a_missing_include_names_the_line_that_asks_for_it(tmp_path: Path) -> None:
    main = write(tmp_path, main="INCLUDE 'a.bdf'\n", a="GRID,1\nINCLUDE 'b.bdf'\n")
    expected = f"{tmp_path / 'a.bdf'}, line 2: the included file {tmp_path / 'b.bdf'} is not there"
    with pytest.raises(ModelError, match=re.escape(expected)):
        read_deck(main)


def test_a_deck_that_includes_itself_names_the_line(tmp_path: Path) -> None:
    main = write(tmp_path, main="GRID,1\nINCLUDE 'a.bdf'\n", a="include main.bdf\n")
    with pytest.raises(ModelError, match=re.escape(f"{tmp_path / 'a.bdf'}, line 1: ")):
        read_deck(main)


def test_a_chain_of_includes_without_end_is_refused(tmp_path: Path) -> None:
    for number in range(300):  # three times what is allowed, and less than Python's own depth
        (tmp_path / f"{number}.bdf").write_text(f"INCLUDE '{number + 1}.bdf'\n")
    with pytest.raises(ModelError, match=r"100\.bdf, line 1: files include each other more than"):
        read_deck(tmp_path / "0.bdf")


def test_only_changed_lines_differ_and_includes_stay(tmp_path: Path) -> None:
    write(tmp_path / "else", mat="MAT1,1,7.+4,,.3\r\n")
    main = write(
        tmp_path / "model",
        main="INCLUDE 'sub/a.bdf'\nINCLUDE '../else/\nmat.bdf'\nMAT1,2,8.+4,,.3 $ E\nENDDATA\nx\n",
        sub__a="GRID,1\nINCLUDE '../b.bdf'\n",
        b="MAT1    3       9.+4            .3\n",
    )
    deck = read_deck(main)
    fields = {field_of(card, 2): 72345.0 for card in deck.named("MAT1")}
    written = write_edited(deck, changed_texts(deck.lines, fields), tmp_path / "out")
    out = tmp_path / "out"
    assert written == out / "main.bdf"
    assert written.read_text() == (
        "INCLUDE 'sub/a.bdf'\nINCLUDE 'includes/mat.bdf'\n$\nMAT1,2,72345.,,.3 $ E\nENDDATA\nx\n"
    )
    assert (out / "sub" / "a.bdf").read_bytes() == (main.parent / "sub" / "a.bdf").read_bytes()
    assert (out / "b.bdf").read_text() == "MAT1    3       72345.          .3\n"
    assert (out / "includes" / "mat.bdf").read_bytes() == b"MAT1,1,72345.,,.3\r\n"
    again = read_deck(written)
    assert [texts(card)[2] for card in again.named("MAT1")] == ["72345."] * 3


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("MAT1    30      7.1+4           .33     ", "MAT1    30      72345.67        .33     "),
        ("MAT1          30   7.1+4             .33", "MAT1          3072345.67             .33"),
        ("MAT1    30       7.1+4          .33", "MAT1    30      72345.67        .33"),
        ("MAT1,30, 7.1+4 ,,.33", "MAT1,30, 72345.67 ,,.33"),
        ("MAT1,30,71000.00000,,.33", "MAT1,30,72345.67123,,.33"),
        ("MAT1*,30,7.1+4,,.33", "MAT1*,30,72345.671234,,.33"),
        ("MAT1\t30\t7.1+4\t\t.33", "MAT1\t30\t72345.67\t.33"),
        ("MAT1    30      7.1+4$ modulus", "MAT1    30      72345.67$ modulus"),
        (
            "MAT1*                 30           7.1+4                             .33",
            "MAT1*                 30    72345.671234                             .33",
        ),
    ],
)
def test_a_number_keeps_its_format_and_place(tmp_path: Path, before: str, after: str) -> None:
    deck = read_deck(write(tmp_path, main=before))
    changed = changed_texts(deck.lines, {field_of(deck.cards[0], 2): 72345.671234})
    assert changed[0].expandtabs() == after.expandtabs()
    # What pyNastran reads of the line is the number as it was written there.
    bulk = BDF(debug=None)
    bulk.add_card([changed[0].partition("$")[0]], "MAT1", is_list=False)
    assert bulk.materials[30].e == pytest.approx(72345.671234, rel=1e-6)  # 7 digits of 8 columns


def test_a_number_that_is_none_is_refused_with_its_line(tmp_path: Path) -> None:
    deck = read_deck(write(tmp_path, main="GRID,1\nMAT1,1,2.\n"))
    with pytest.raises(ModelError, match=r"main\.bdf, line 2: inf is not a finite number"):
        changed_texts(deck.lines, {field_of(deck.cards[1], 2): float("inf")})


def small(fields: list[str]) -> str:
    return (
        "MAT8    "
        + "".join(text.ljust(8) for text in fields[:8])
        + "\n"
        + ("+       " + "".join(text.rjust(8) for text in fields[8:]) + "\n")
    )


def large(fields: list[str]) -> str:
    rows = [fields[start : start + 4] for start in range(0, len(fields), 4)]
    heads = ["MAT8*", *("*" for _ in rows[1:])]
    return "".join(
        head.ljust(8) + "".join(text.rjust(16) for text in row) + "\n"
        for head, row in zip(heads, rows, strict=True)
    )


def free(fields: list[str]) -> str:
    return f"MAT8,{','.join(fields[:8])}\n+, {' , '.join(fields[8:])}\n"


def mixed(fields: list[str]) -> str:
    return f"MAT8\t{chr(9).join(fields[:8])}\n,{','.join(fields[8:])}\n"


LAYOUTS: tuple[Callable[[list[str]], str], ...] = (small, large, free, mixed)


@given(
    st.sampled_from(LAYOUTS),
    st.lists(ORDINARY, min_size=11, max_size=11),
    st.integers(0, 10),
    ORDINARY,
)
def test_one_number_changes_and_nothing_else(
    layout: Callable[[list[str]], str], values: list[float], place: int, new: float
) -> None:
    # Seven characters leave a column for the tab of `mixed`.
    fields = ["7", *(format_number(value, 7) for value in values)]
    text = f"$ before\nGRID,1\n{layout(fields)}GRID,2\n"
    with tempfile.TemporaryDirectory() as name:
        main = write(Path(name), main=text)
        deck = read_deck(main)
        card = deck.cards[1]
        changed = changed_texts(deck.lines, {field_of(card, place + 2): new})
        written = write_edited(deck, changed, Path(name) / "out")
        after, raw = read_deck(written).cards[1], written.read_text()
    expected = texts(card)
    width = 16 if layout is large else 8
    expected[place + 2] = format_number(new, width)
    assert texts(after) == expected
    marks = [mark for mark in difflib.ndiff(text.splitlines(), raw.splitlines()) if mark[0] in "+-"]
    assert len(marks) in (0, 2)  # one line out, one in; none where the same text came again
    assert after.lines == card.lines
    # pyNastran splits the written lines itself.
    lines = [line for line in raw.splitlines() if not line.startswith(("$", "GRID"))]
    bulk = BDF(debug=None)
    theirs, _ = bulk.create_card_object(lines, "MAT8", is_list=False, has_none=False)
    assert read_number(theirs.field(place + 2)) == read_number(expected[place + 2])


REAL = (
    "pn_beam_modes",
    "pn_goland_sol200_dscm2",
    "pn_mode_solid_shell_bar",
    "pn_plate_py",
    "pn_sdof_crod",
    "yeti_gpwg1",
)


@pytest.mark.parametrize("case", REAL)
def test_real_decks_have_the_cards_pynastran_counts(shared_data: Path, case: str) -> None:
    folder = shared_data / "nastran" / case
    expected = json.loads((folder / "expected.json").read_text())
    (path,) = (folder / name for name in expected["files"] if name.endswith((".bdf", ".dat")))
    deck = read_deck(path)
    assert Counter(names(deck)) == expected["cards"]


def test_an_include_that_is_not_beside_a_real_deck_is_named(shared_data: Path) -> None:
    path = shared_data / "nastran" / "pn_modes_elements" / "modes_elements.bdf"
    with pytest.raises(ModelError, match=r"modes_elements\.bdf, line 29: the included file"):
        read_deck(path)


@pytest.mark.parametrize("case", ["nastran/mystran_probes/*.dat", "garteur/*/*.[di][an][tp]"])
def test_real_decks_are_written_back_byte_for_byte(
    shared_data: Path, tmp_path: Path, case: str
) -> None:
    for path in shared_data.glob(case):
        written = write_edited(read_deck(path), {}, tmp_path / path.stem)
        assert written.read_bytes() == path.read_bytes()


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("+,1.\nGRID,1\n", ["+", "GRID"]),  # continues nothing
        ("GRID,1\nMAT 1,2\n", ["GRID", "MAT 1"]),
        ("GRID,1\n%PDF-1.4 \xe2\n", ["GRID", "%PDF-1.4"]),
    ],
)
def test_what_is_no_card_stays_under_its_own_name(
    tmp_path: Path, text: str, names: list[str]
) -> None:
    path = tmp_path / "main.bdf"
    path.write_text(text, encoding="latin-1")
    assert [card.name for card in read_deck(path).cards] == names


def test_a_card_that_is_repeated_with_increments(tmp_path: Path) -> None:
    path = tmp_path / "main.bdf"
    path.write_text("GRID,101,2,48.97,-78.87,0.,1\n=,*(1),=,=,*(12.5),==\n=(2)\n=,*1,7,,1.,==\n")
    cards = read_deck(path).cards
    assert [[card.text(field) for field in range(1, 7)] for card in cards] == [
        ["101", "2", "48.97", "-78.87", "0.", "1"],
        ["102", "2", "48.97", "-66.37", "0.", "1"],
        ["103", "2", "48.97", "-53.87", "0.", "1"],
        ["104", "2", "48.97", "-41.37", "0.", "1"],
        ["105", "7", "", "1.", "0.", "1"],
    ]
    assert [card.lines for card in cards] == [(0,), (1,), (2,), (2,), (3,)]


def test_a_number_of_a_repeated_card_is_not_changed_by_itself(tmp_path: Path) -> None:
    path = tmp_path / "main.bdf"
    path.write_text("PELAS,1,100.\n=,*1,=\n")
    deck = read_deck(path)
    field = deck.cards[1].fields[2]
    assert field is not None
    with pytest.raises(ModelError, match=r"line 2: the number 100\. .*write the card out"):
        changed_texts(deck.lines, {field: 110.0})


def test_a_comma_makes_free_field_in_the_first_ten_columns_only(tmp_path: Path) -> None:
    path = tmp_path / "main.bdf"
    path.write_text("DEQATN  1       F(D1,D2)= D2/D1\nGRID    ,1,,2.\n")
    equation, grid = read_deck(path).cards
    assert (equation.name, equation.text(1), equation.text(2)) == ("DEQATN", "1", "F(D1,D2)")
    assert [grid.text(field) for field in range(1, 4)] == ["1", "", "2."]


def test_blanks_part_fields_of_a_free_line_too(tmp_path: Path) -> None:
    path = tmp_path / "main.bdf"
    path.write_text(
        "PSHEAR, 401     1       1.0     0.5, 1.,30.$ F1\nCBUSH   7211,   7010,  ,205\n"
    )
    deck = read_deck(path)
    shear, bush = deck.cards
    assert [shear.text(field) for field in range(1, 7)] == ["401", "1", "1.0", "0.5", "1.", "30."]
    assert [bush.text(field) for field in range(1, 5)] == ["7211", "7010", "", "205"]
    thickness = shear.fields[3]
    assert thickness is not None
    changed = changed_texts(deck.lines, {thickness: 2.5})
    assert changed == {0: "PSHEAR, 401     1       2.5     0.5, 1.,30.$ F1"}


def test_a_free_line_may_hold_more_than_eight_fields(tmp_path: Path) -> None:
    path = tmp_path / "main.bdf"
    path.write_text("CORD2C,1,0, 0.,0.,0., 0.,0.,1., 0.,1.,5.\n")
    (card,) = read_deck(path).cards
    assert card.text(11) == "5."


def test_a_tag_may_stand_in_many_places(tmp_path: Path) -> None:
    # The third line's tag stands in the field before its column, as some generators write it.
    rows = [
        "GRID    1               0.      0.      0.",
        "CONM2   1       1               1.                                      +C1",
        "+C1     .1",
        "CONM2   2       1               2.                              +C1",
        "+C1     .2",
        "CONM2   3       1               3.                                      +C1",
        "+C1     .3",
    ]
    path = tmp_path / "model.bdf"
    path.write_text("\n".join(["BEGIN BULK", *rows, "ENDDATA", ""]))
    bodies = read_deck(path).named("CONM2")
    assert [card.text(9) for card in bodies] == [".1", ".2", ".3"]


#: Cards in all formats; a tag that a later line continues; a card that another copies.
EDITED = """GRID    1               0.      0.      0.
MAT1    1       7.+4            .3      2.7-9                   .02
MAT1,2,2.1+5,,.3,7.8-9
PSHELL*                7               1              2.               1
*                                      1
CONM2   1       1               1.                                      +C1
$ a comment
PSHELL  3       1       2.      1               1       $ another
+C1     .1
"""


@pytest.mark.parametrize(
    ("position", "text", "kept"),
    [
        (1, "MAT1    1       7.1+4           .3      2.7-9                   .02", 5),
        (2, "MAT1,2,2.2+5,,.3,7.8-9", 5),
        (3, "PSHELL*                7               1            2.25               1", 5),
        (4, "*                                      2", 5),
        (8, "+C1     .2", 5),
        # What moves a card's lines, or is a card no longer, means another reading of all.
        (8, "+C2     .2", 0),
        (1, "MAT8    1       7.+4", 0),
        (6, "GRID,9", 0),
        (0, "$", 0),
        (7, "PSHELL  3       1       2.      1\nGRID,9", 0),
    ],
)
def test_an_edited_deck_reads_as_its_file_does(
    tmp_path: Path, position: int, text: str, kept: int
) -> None:
    deck = read_deck(write(tmp_path, main=EDITED))
    edited = with_lines(deck, {position: text})
    lines = EDITED.splitlines()
    lines[position] = text
    if "\n" not in text:  # the deck then has a line less than its file
        assert edited.cards == read_deck(write(tmp_path, main="\n".join(lines))).cards
    before = {id(card) for card in deck.cards}
    assert len([card for card in edited.cards if id(card) in before]) == kept


def test_a_copy_follows_an_edit_of_the_card_that_it_repeats(tmp_path: Path) -> None:
    deck = read_deck(write(tmp_path, main="PELAS,1,100.\n=,*1,=\n"))
    edited = with_lines(deck, {0: "PELAS,1,110."})
    assert [card.text(2) for card in edited.cards] == ["110.", "110."]


def test_columns_mean_the_same_with_and_without_tabs(tmp_path: Path) -> None:
    # Lines with tabs take another way through the reader than those without.
    plain = "GRID    1               1.      2.      3.      4\nMAT1*   1               7.+4\n"
    tabbed = "GRID\t1\t\t1.\t2.\t3.\t4\nMAT1*\t1\t\t7.+4\n"
    one, other = (read_deck(write(tmp_path, main=text)).cards for text in (plain, tabbed))
    assert [texts(card) for card in one] == [texts(card) for card in other]
    first = field_of(one[0], 6)
    assert (first.start, first.stop, first.width) == (48, 49, 8)
    second = field_of(one[1], 2)
    assert (second.start, second.stop, second.width) == (24, 28, 16)
