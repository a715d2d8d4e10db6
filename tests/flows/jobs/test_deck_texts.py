"""Where two decks differ is told by their kept texts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from modetune.adapters.solver import ModalAnalysis, Rendered, Solver
from modetune.core.errors import ModelError
from modetune.core.storage.store import Store
from modetune.flows.jobs import job_difference
from modetune.flows.jobs.job import NOMINAL, Job, Plans
from modetune.flows.jobs.job_difference import (
    deck_difference,
    deck_text,
    differences_with_places,
    job_of_note,
    load_text,
    save_text,
)
from tests.flows.conftest import ChainDeck, ScriptedProgram

DECK = ["*NODE", "1, 0, 0, 0", "2, 1, 0, 0", "*ELASTIC", "71000., 0.3", "*DENSITY", "2.8e-9"]


@dataclass(frozen=True)
class Written(ScriptedProgram):
    """The scripted program with a text of its own."""

    data: bytes = b""

    def render(self, deck: Any, analysis: Any) -> Rendered:
        rest = super().render(deck, analysis).content
        content = {"deck": self.data.hex(), "rest": rest}
        return Rendered.of_texts(content, {"job.inp": self.data})


def nominal(bench: Any, data: bytes) -> Rendered:
    return Written(bench.folder, data=data).render(NOMINAL.values, NOMINAL.analysis)


def test_one_changed_line_is_told_with_its_keyword() -> None:
    other = [line.replace("71000.", "72000.") for line in DECK]
    assert deck_difference(DECK, other) == ("`71000., 0.3` (below *ELASTIC), there `72000., 0.3`")


def test_added_and_removed_lines_are_told() -> None:
    assert deck_difference(DECK, DECK[:2] + DECK[3:]) == (
        "`2, 1, 0, 0` (below *NODE), there nothing"
    )
    assert deck_difference(DECK[:2] + DECK[3:], DECK).endswith("there `2, 1, 0, 0`")


def test_many_places_are_counted() -> None:
    ours = [f"{number}" for number in range(20)]
    theirs = [text if int(text) % 3 else f"{text} changed" for text in ours]
    assert deck_difference(ours, theirs).endswith("and in 4 more places")  # 0, 3 .. 18 are seven


def test_decks_that_differ_all_over_are_counted_not_compared() -> None:
    ours, theirs = [f"a{n}" for n in range(5000)], [f"b{n}" for n in range(6000)]
    assert deck_difference(ours, theirs) == "5000 lines in place of 6000"


@pytest.mark.parametrize(("ours", "theirs"), [([], []), (DECK, DECK)])
def test_equal_decks_differ_nowhere(ours: list[str], theirs: list[str]) -> None:
    assert deck_difference(ours, theirs) == ""


def test_a_kept_text_comes_back_as_it_was(bench: Any) -> None:
    store = Store(bench.folder / "store")
    deck = nominal(bench, "\n".join([*DECK, "** Grüße"]).encode("latin-1"))
    save_text(store, "digest", deck)
    text = deck_text(deck)
    assert text is not None
    assert load_text(store, "digest") == text
    assert text[:7] == DECK


def test_a_damaged_or_missing_text_is_none(bench: Any) -> None:
    store = Store(bench.folder / "store")
    assert load_text(store, "none") is None
    (store.folder / "models").mkdir(parents=True)
    for data in (b"", b"no gzip", b"\x1f\x8b\x08\x00broken off"):
        (store.folder / "models" / "bad.gz").write_bytes(data)
        assert not load_text(store, "bad")


def test_binary_and_large_decks_are_not_kept(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    store = Store(bench.folder / "store")
    save_text(store, "binary", nominal(bench, b"\0\1"))
    monkeypatch.setattr(job_difference, "LARGEST", 10)
    save_text(store, "large", nominal(bench, b"*NODE\n1, 0, 0, 0\n"))
    assert not (store.folder / "models").exists()


def test_a_text_that_cannot_be_kept_harms_nothing(bench: Any) -> None:
    def refuse(folder: Path) -> None:
        raise ModelError("no such deck")

    save_text(Store(bench.folder / "store"), "refused", Rendered({}, refuse))


def test_a_result_of_a_changed_deck_says_where_it_changed(bench: Any) -> None:
    texts: dict[str, list[str]] = {}
    jobs = []
    for number, lines in enumerate((DECK, [*DECK[:4], "72000., 0.3", *DECK[5:]])):
        program = Written(bench.folder, data="\n".join(lines).encode())
        solver = Solver(ChainDeck(), program)
        note = Plans(solver).note(Job({"k1": 1.0}, ModalAnalysis(6, (1,))), threads=1)
        texts[note.model_digest] = lines
        jobs.append(job_of_note(str(number), note))
    other, job = jobs
    assert differences_with_places(job, other, texts.get) == (
        "the deck's text differs: `72000., 0.3` (below *ELASTIC), there `71000., 0.3`",
    )
    assert differences_with_places(job, other, lambda digest: None) == ("the deck's text differs",)
