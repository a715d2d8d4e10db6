"""What a file is shows in its first bytes; what is not read is told by what it is."""

from __future__ import annotations

import gzip
import io
import pickle
import zipfile
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from modetune.adapters.test_files.file_kind import kind_of
from modetune.adapters.test_files.measurements import read_measurement
from modetune.core.errors import CampaignError
from tests.adapters.test_files.result_decks import bracket, ladder


def drawn(form: str) -> bytes:
    """A page with nothing on it, by the library that makes such files."""
    made = io.BytesIO()
    Figure((1, 1)).savefig(made, format=form)
    return made.getvalue()


def zipped(*names: str) -> bytes:
    made = io.BytesIO()
    with zipfile.ZipFile(made, "w") as archive:
        for name in names:
            archive.writestr(name, "x")
    return made.getvalue()


def arrays() -> bytes:
    made = io.BytesIO()
    np.savez(made, K=np.eye(2))
    return made.getvalue()


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (drawn("pdf"), "is a PDF document"),
        (drawn("png"), r"is a picture \(PNG\)"),
        (drawn("svg"), "is an XML file"),
        (gzip.compress(b"mode,1\n", mtime=0), "is a file compressed by gzip, .*; unpack it"),
        (zipped("word/document.xml"), "is a Word document"),
        (zipped("mimetype", "content.xml"), "is an OpenDocument file.*save it as .xlsx"),
        (zipped("lab.unv", "notes.txt"), "is a ZIP archive of lab.unv, notes.txt"),
        (arrays(), r"is an archive of NumPy's arrays \(K.npy\)"),
        (pickle.dumps({"fn": [1.0]}), "is a pickle of Python"),
        (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(504), "save it as .xlsx or CSV"),
        (b"", "is an empty file"),
        (b"\x07\0\x01\x02" * 90, "is a binary file of an unknown form"),
        (bracket().encode(), "is a CalculiX deck, .*it is a model"),
        (ladder().encode(), "is a Nastran deck, .*it is a model"),
        (b"# mine\nname: bell\nmodel: {deck: bell.inp}\n", "is a campaign file"),
        (b'{"modes": []}', "is a JSON file"),
        (b"<!DOCTYPE html>\n<html>", "is a web page"),
    ],
)
@pytest.mark.parametrize("name", ["lab.csv", "lab.dat"])
def test_what_is_not_read_is_told_by_what_it_is(
    tmp_path: Path, name: str, data: bytes, said: str
) -> None:
    path = tmp_path / name
    path.write_bytes(data)
    with pytest.raises(CampaignError, match=said):
        read_measurement([path])


def test_a_picture_that_is_called_a_universal_file_is_told(tmp_path: Path) -> None:
    path = tmp_path / "lab.unv"
    path.write_bytes(drawn("pdf"))
    with pytest.raises(CampaignError, match=r"lab.unv is a PDF document"):
        read_measurement([path])


def test_real_files_are_known_by_their_content(shared_data: Path) -> None:
    kinds = {
        "uff/TestLab 161 164 18 15 82.uff": "universal",
        "uff/Sample_UFF58b_bin.uff": "universal",
        "garteur/mystran/gart.F06": "f06",
        "garteur/mystran/gart.OP2": "op2",
        "garteur/supaero/nastran_dynamic_ref.out": "f06",
        "garteur/supaero/nastran_dynamic_ref.pnh": "punch",
        "garteur/supaero/nastran_dynamic_ref.inp": "",
        "nastran/pn_beam_modes/beam_modes.f06": "f06",
        "nastran/pn_beam_modes/beam_modes_m1.op2": "op2",
        "four_storey/tests_br.csv": "table",
    }
    assert {name: kind_of(shared_data / name).form for name in kinds} == kinds


def test_no_public_deck_is_taken_for_a_result(shared_data: Path) -> None:
    decks = [
        path
        for path in (shared_data / "nastran" / "corpus").rglob("*")
        if path.suffix.lower() in (".bdf", ".dat", ".nas")
    ]
    assert len(decks) > 100
    forms = {kind_of(path).form for path in decks}
    assert forms <= {"", "table"}  # parts of decks, that others include, may be any table
