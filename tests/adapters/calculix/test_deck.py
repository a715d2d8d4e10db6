"""Reading decks with includes, and edits that leave everything else byte for byte."""

from __future__ import annotations

import difflib
import re
import tempfile
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modetune.adapters.calculix.deck import (
    FIELD_WIDTH,
    KeywordDeck,
    canonical_name,
    format_number,
    read_deck,
    replace_field,
    write_edited,
)
from modetune.core.errors import ModelError
from modetune.flows.campaign.solvers import is_nastran

MATERIAL = "*MATERIAL, NAME=AL\n*ELASTIC\n71000., 0.3\n*DENSITY\n2.81e-9\n"


def write(folder: Path, **texts: str) -> Path:
    """Files by name (`__` for a folder, `.inp` added); returns the one called main."""
    for name, text in texts.items():
        path = folder / f"{name.replace('__', '/')}.inp"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(text.encode())
    return folder / "main.inp"


def keywords(deck: KeywordDeck) -> list[str]:
    return [card.keyword for card in deck.cards]


def position_of(deck: KeywordDeck, text: str) -> int:
    return next(place for place, line in enumerate(deck.lines) if line.text == text)


def test_nested_quoted_includes_in_any_case_are_read_in_place(tmp_path: Path) -> None:
    main = write(
        tmp_path,
        main='*HEADING\n*Include, Input="parts/nodes.inp"\n*STEP\n',
        parts__nodes="*NODE\n1, 0, 0, 0\n*INCLUDE,INPUT=parts/material.inp\n",
        parts__material=MATERIAL,
    )
    deck = read_deck(main)
    assert keywords(deck) == ["*HEADING", "*NODE", "*MATERIAL", "*ELASTIC", "*DENSITY", "*STEP"]
    elastic = deck.lines[position_of(deck, "71000., 0.3")]
    assert elastic.where == f"{tmp_path / 'parts' / 'material.inp'}, line 3"


def test_nested_includes_are_looked_for_beside_the_main_deck_first(tmp_path: Path) -> None:
    # ccx opens includes from where it runs, whatever file names them.
    main = write(
        tmp_path,
        main="*INCLUDE, INPUT=sub/a.inp\n",
        sub__a="*INCLUDE, INPUT=b.inp\n",
        sub__b="*NODE\n",
        b="*DENSITY\n",
    )
    assert keywords(read_deck(main)) == ["*DENSITY"]


def test_an_include_beside_the_including_file_is_taken_where_there_is_no_other(
    tmp_path: Path,
) -> None:
    main = write(
        tmp_path,
        main="*INCLUDE, INPUT=sub/a.inp\n",
        sub__a="*INCLUDE, INPUT=b.inp\n",
        sub__b="*NODE\n1,0,0,0\n",
    )
    deck = read_deck(main)
    assert keywords(deck) == ["*NODE"]
    updated = write_edited(deck, {}, tmp_path / "out")
    # ccx itself finds b.inp from beside the updated deck only.
    assert "INPUT=includes/b.inp" in (tmp_path / "out" / "sub" / "a.inp").read_text()
    assert keywords(read_deck(updated)) == ["*NODE"]


def test_keyword_lines_go_on_after_a_trailing_comma_past_comments(tmp_path: Path) -> None:
    main = write(
        tmp_path, main="*SOLID SECTION, ELSET=WING,\n** a comment\n  MATERIAL = My Al\n*STEP\n"
    )
    section, _ = read_deck(main).cards
    assert section.is_one_of("*SOLID SECTION")
    assert dict(section.options) == {"ELSET": "WING", "MATERIAL": "MYAL"}


def test_a_trailing_comma_does_not_swallow_data_or_the_next_keyword(tmp_path: Path) -> None:
    main = write(tmp_path, main="*ELASTIC,\n71000., 0.3\n*DENSITY,\n*STEP,\n*FREQUENCY\n")
    deck = read_deck(main)
    assert keywords(deck) == ["*ELASTIC", "*DENSITY", "*STEP", "*FREQUENCY"]
    assert deck.cards[0].data == (1,)


def test_blanks_and_case_carry_no_meaning_in_keywords_and_names(tmp_path: Path) -> None:
    main = write(tmp_path, main='* Solid Section ,Elset= my set,\tMATERIAL="Al 7075"\n')
    deck = read_deck(main)
    assert deck.named("*SOLIDSECTION") == deck.named("*SOLID SECTION") == list(deck.cards)
    assert deck.cards[0].option("ELSET") == "MYSET"
    assert deck.cards[0].option("MATERIAL") == canonical_name("AL 7075")


def test_comments_and_blank_lines_are_no_data(tmp_path: Path) -> None:
    main = write(tmp_path, main="** *NODE\n\n*ELASTIC\n** 1., 2.\n \n71000., 0.3\n**\n")
    deck = read_deck(main)
    assert keywords(deck) == ["*ELASTIC"]
    assert [deck.lines[place].text for place in deck.cards[0].data] == ["71000., 0.3"]


def test_a_commented_include_is_not_read(tmp_path: Path) -> None:
    main = write(tmp_path, main="** *INCLUDE, INPUT=gone.inp\n**INCLUDE, INPUT=gone.inp\n*NODE\n")
    assert keywords(read_deck(main)) == ["*NODE"]


def test_windows_line_ends_and_tabs_read_like_plain_ones(tmp_path: Path) -> None:
    plain = read_deck(write(tmp_path / "a", main=MATERIAL))
    dressed = MATERIAL.replace(", ", ",\t").replace("\n", "\r\n")
    windows = read_deck(write(tmp_path / "b", main=dressed))
    assert windows.cards == plain.cards
    for card in plain.cards:
        for place in card.data:
            assert windows.fields(place) == plain.fields(place)


def test_only_newlines_end_lines_so_numbers_agree_with_editors(tmp_path: Path) -> None:
    # str.splitlines also breaks at form feeds and Unicode separators; ccx and editors do not.
    main = write(tmp_path, main="** page\x0c\u2028break\n*NODE\n1, 0, 0, 0\n")
    deck = read_deck(main)
    assert deck.where(deck.cards[0]) == f"{main}, line 2"


def test_a_missing_include_names_the_line_that_asks_for_it(tmp_path: Path) -> None:
    main = write(tmp_path, main="*HEADING\n*INCLUDE, INPUT=a.inp\n", a="*NODE\n*INCLUDE,INPUT=b\n")
    expected = f"{tmp_path / 'a.inp'}, line 2: the included file {tmp_path / 'b'} is not there"
    with pytest.raises(ModelError, match=re.escape(expected)):
        read_deck(main)


def test_an_include_without_a_file_names_its_line(tmp_path: Path) -> None:
    main = write(tmp_path, main="*HEADING\n\n*INCLUDE\n")
    with pytest.raises(ModelError, match=re.escape(f"{main}, line 3: *INCLUDE needs INPUT=file")):
        read_deck(main)


@pytest.mark.parametrize("name", ["main.inp", "sub/../main.inp", "sub/link.inp"])
def test_a_deck_that_includes_itself_names_the_line(tmp_path: Path, name: str) -> None:
    main = write(tmp_path, main=f"*NODE\n*INCLUDE, INPUT={name}\n", sub__other="*NODE\n")
    (tmp_path / "sub" / "link.inp").symlink_to(main)
    expected = f"{main}, line 2: {tmp_path / name} includes itself"
    with pytest.raises(ModelError, match=re.escape(expected)):
        read_deck(main)


def test_a_ring_of_includes_is_found(tmp_path: Path) -> None:
    main = write(tmp_path, main="*INCLUDE,INPUT=a.inp\n", a="*NODE\n*INCLUDE,INPUT=main.inp\n")
    with pytest.raises(ModelError, match=re.escape(f"{tmp_path / 'a.inp'}, line 2: ")):
        read_deck(main)


def test_a_binary_file_names_file_and_line(tmp_path: Path) -> None:
    main = write(tmp_path, main="*NODE\n1, 0, 0, 0\n\0\1\2")
    with pytest.raises(ModelError, match=re.escape(f"{main}, line 3: not a text file")):
        read_deck(main)


@pytest.mark.parametrize("text", ["", "\n"])
def test_an_empty_deck_is_called_empty(tmp_path: Path, text: str) -> None:
    main = write(tmp_path, main=text)
    with pytest.raises(ModelError, match=re.escape(f"{main} is empty; a deck was expected")):
        read_deck(main)
    with pytest.raises(ModelError, match=re.escape(f"{main} is empty; a deck was expected")):
        is_nastran(main)


def test_a_deck_without_keywords_names_the_file(tmp_path: Path) -> None:
    main = write(tmp_path, main="** only a comment\n")
    with pytest.raises(ModelError, match=re.escape(f"{main}, line 1: the file holds no CalculiX")):
        read_deck(main)


def test_data_before_the_first_keyword_names_its_line(tmp_path: Path) -> None:
    main = write(tmp_path, main="** title\n1, 0, 0, 0\n*NODE\n")
    with pytest.raises(ModelError, match=re.escape(f"{main}, line 2: data before the first")):
        read_deck(main)


def test_a_missing_deck_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=re.escape(f"{tmp_path / 'main.inp'} cannot be read: No")):
        read_deck(tmp_path / "main.inp")


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_numbers_fit_the_field_and_read_back(value: float) -> None:
    text = format_number(value)
    assert len(text) <= FIELD_WIDTH
    # 1e-12 is what 13 significant digits hold; subnormal numbers have fewer of their own.
    assert float(text) == pytest.approx(value, rel=1e-12, abs=1e-320)


FIELDS = st.lists(
    st.text(st.characters(exclude_characters=",\n\r", codec="utf-8"), max_size=12), min_size=1
)


@given(FIELDS, st.data())
def test_replacing_a_field_changes_that_field_only(fields: list[str], data: st.DataObject) -> None:
    place = data.draw(st.integers(0, len(fields) - 1))
    after = replace_field(",".join(fields), place, "1.5").split(",")
    option, is_option, _ = fields[place].strip().partition("=")
    assert after[place].strip() == (f"{option}=1.5" if is_option else "1.5").strip()
    assert after[:place] == fields[:place]
    assert after[place + 1 :] == fields[place + 1 :]


def test_blanks_round_a_replaced_field_stay() -> None:
    assert replace_field("  71000.0\t,  0.3 ", 1, "0.33") == "  71000.0\t,  0.33 "
    assert replace_field("1, 2", 0, "7.1") == "7.1, 2"


TEXTS = st.text(st.characters(exclude_characters="\0*\r", codec="utf-8"), max_size=40)


@given(TEXTS, TEXTS, st.sampled_from(["\n", "\r\n"]), st.booleans())
def test_an_unchanged_deck_is_written_byte_for_byte(
    main: str, included: str, end: str, ended: bool
) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        head = f"*HEADING\n{main}\n*INCLUDE, INPUT=mesh/a.inp\n*DENSITY\n2.81e-9"
        path = write(
            folder,
            main=head.replace("\n", end) + (end if ended else ""),
            mesh__a=f"*NODE\n{included}".replace("\n", end),
        )
        written = write_edited(read_deck(path), {}, folder / "out")
        assert written == folder / "out" / "main.inp"
        for file in ("main.inp", "mesh/a.inp"):
            assert (folder / "out" / file).read_bytes() == (folder / file).read_bytes()


def test_bytes_that_are_no_utf8_survive(tmp_path: Path) -> None:
    main = tmp_path / "main.inp"
    main.write_bytes(b"** Fl\xfcgel\x85\n*DENSITY\n1.0\n")
    written = write_edited(read_deck(main), {}, tmp_path / "out")
    assert written.read_bytes() == main.read_bytes()


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_after_an_edit_only_the_changed_lines_differ(tmp_path: Path, end: str) -> None:
    main = write(
        tmp_path,
        main=("** wing\n*INCLUDE, INPUT=al.inp\n" + MATERIAL + "*STEP\n").replace("\n", end),
        al=("** skin\n" + MATERIAL.replace("AL", "SKIN")).replace("\n", end),
    )
    deck = read_deck(main)
    places = [place for place, line in enumerate(deck.lines) if line.text == "71000., 0.3"]
    assert len(places) == 2  # MATERIAL stands in both files
    written = write_edited(
        deck, {places[0]: "72000., 0.3", places[1]: "73000., 0.3"}, tmp_path / "o"
    )
    for file, new in ((tmp_path / "al.inp", "72000., 0.3"), (main, "73000., 0.3")):
        old_lines = file.read_bytes().decode().splitlines(keepends=True)
        new_lines = (written.parent / file.name).read_bytes().decode().splitlines(keepends=True)
        marks = [m for m in difflib.ndiff(old_lines, new_lines) if m[0] in "+-"]
        assert marks == [f"- 71000., 0.3{end}", f"+ {new}{end}"]


def test_includes_from_elsewhere_come_along_and_their_lines_follow(tmp_path: Path) -> None:
    # An absolute path or one with `..` would still lead to the old values, or nowhere.
    write(tmp_path / "shared", al=MATERIAL, mesh="*NODE\n1, 0, 0, 0\n")
    write(tmp_path / "other", mesh="*NODE\n2, 0, 0, 0\n")
    main = write(
        tmp_path / "model",
        main=f'*INCLUDE, INPUT="{tmp_path}/shared/al.inp"\n*INCLUDE, INPUT=../shared/mesh.inp\n'
        "*INCLUDE, INPUT=../other/mesh.inp\n*STEP\n",
    )
    deck = read_deck(main)
    changed = {position_of(deck, "71000., 0.3"): "80000.0, 0.3"}
    written = write_edited(deck, changed, tmp_path / "out")
    assert written.read_text() == (
        '*INCLUDE, INPUT="includes/al.inp"\n*INCLUDE, INPUT=includes/mesh.inp\n'
        "*INCLUDE, INPUT=includes/mesh_2.inp\n*STEP\n"
    )
    again = [line.text for line in read_deck(written).lines]
    assert again == [changed.get(place, line.text) for place, line in enumerate(deck.lines)]
