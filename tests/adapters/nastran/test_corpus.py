"""Public decks: all that are whole are read and written back, and no fewer run than once did."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import pytest
from benchmarks.card_decks import decks
from benchmarks.corpus import decks_below

from modetune.adapters.nastran.deck import NastranDeck, read_deck, write_edited
from modetune.adapters.nastran.dialect import MYSTRAN
from modetune.adapters.nastran.job import job_text
from modetune.adapters.nastran.model import NastranModel, understand
from modetune.adapters.solver import ModalAnalysis
from modetune.adapters.translation.solver import TranslatedDeck
from modetune.core.errors import ModelError

#: Of the main decks of the corpus (119), those whose jobs can be written; no solver is run.
MYSTRAN_TAKES, CALCULIX_TAKES, EITHER_TAKES = 38, 46, 48
#: Of the decks that benchmarks.card_decks writes, those that neither solver takes.
CARDS_REFUSED = {"CGAP", "NSM1", "RSPLINE"}


def mystran_job(model: NastranModel) -> None:
    model.check()
    job_text(model, {}, ModalAnalysis(1, ()), MYSTRAN)


def calculix_job(model: NastranModel) -> None:
    model.check()
    TranslatedDeck(model.structure, model.objections, model.parameters).edited({})


def takes(job: Callable[[NastranModel], None], model: NastranModel) -> bool:
    """Whether a job can be written; anything but a ModelError is a bug."""
    try:
        job(model)
    except ModelError:
        return False
    return True


def same_bytes(deck: NastranDeck, folder: Path) -> bool:
    copy = write_edited(deck, {}, folder)
    return copy.read_bytes() == deck.file.read_bytes()


@pytest.mark.nightly
def test_public_decks_are_read_and_written_back(shared_data: Path, tmp_path: Path) -> None:
    """All that are whole: others lack a file that they include, or hold several models."""
    refused, counts = {}, [0, 0, 0]
    paths = [
        path
        for path in sorted((shared_data / "nastran" / "corpus").rglob("*"))
        if path.suffix in (".bdf", ".dat", ".nas")
    ]
    main = set(decks_below(shared_data / "nastran" / "corpus"))
    for number, path in enumerate(paths):
        try:
            model = understand(read_deck(path))
        except ModelError as error:
            refused[path.name] = str(error)
            continue
        model.mesh()
        assert same_bytes(model.deck, tmp_path / str(number)), path
        if path in main:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of decks with strange geometry
                found = [takes(job, model) for job in (mystran_job, calculix_job)]
            counts = [a + b for a, b in zip(counts, [*found, any(found)], strict=True)]
    assert len(paths) > 130
    assert all("include" in text or "superelements" in text for text in refused.values())
    assert len(refused) <= 0.05 * len(paths)
    assert counts[0] >= MYSTRAN_TAKES
    assert counts[1] >= CALCULIX_TAKES
    assert counts[2] >= EITHER_TAKES


def test_each_card_has_a_deck_that_a_free_solver_takes(tmp_path: Path) -> None:
    refused = set()
    for name, text in decks():
        path = tmp_path / f"{name}.bdf"
        path.write_text(text)
        model = understand(read_deck(path))
        assert same_bytes(model.deck, tmp_path / name), name
        if not (takes(mystran_job, model) or takes(calculix_job, model)):
            refused.add(name)
    assert refused == CARDS_REFUSED
