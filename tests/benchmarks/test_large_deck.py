"""The deck of the benchmark of large decks, and what it measures."""

from __future__ import annotations

from pathlib import Path

from benchmarks.large_deck import STRIPS, measure, plate

from modetune.adapters.nastran.deck import read_deck


def test_the_plate_has_the_grids_that_it_states_in_every_strip(tmp_path: Path) -> None:
    text, n_grids = plate(100)
    path = tmp_path / "plate.bdf"
    path.write_text(text)
    deck = read_deck(path)
    # Four elements across the plate, sixteen along it.
    assert n_grids == len(deck.named("GRID")) == 5 * 17
    shells = deck.named("CQUAD4")
    assert len(shells) == 4 * 16
    assert {card.text(2) for card in shells} == {str(strip) for strip in range(1, STRIPS + 1)}


def test_a_small_plate_is_measured() -> None:
    found = measure(100)
    assert found["grids"] == 85
    assert min(found["write_s"], found["read_s"]) > 0.0
    assert found["peak_bytes"] > 1e7
