"""Spoilt input of every kind: it is read, or refused in a sentence; never a traceback or a hang.

`mutations.py` has the kinds and what is done to them, `benchmarks/mutations.py` does many more.
"""

from __future__ import annotations

import io
import logging
import os
import struct
import threading
import warnings
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path

import h5py
import numpy as np
import pytest

from modetune.adapters.calculix.deck import read_deck as read_keyword_deck
from modetune.adapters.matrices.matrix_files import read_matrices
from modetune.adapters.nastran.deck import read_deck as read_bulk_deck
from modetune.adapters.regular_file import largest
from modetune.adapters.test_files.measurements import read_measurement
from modetune.adapters.translation.solver import translated_solver
from modetune.core.errors import CampaignError, ModelError, ModetuneError, NoResult
from modetune.flows.campaign.campaign import load_campaign
from tests.mutations import (
    KINDS,
    NASTRAN,
    PLATE_DECK,
    bounded,
    read_all,
    read_stiffness,
    read_test,
)
from tests.mutators import mat_file, workbook
from tests.one_matrix import read_matrix

MUTATIONS = 30
#: Kinds whose reader is given the path.
READ_BY_PATH = {
    "campaign", "test", "CalculiX deck", "assembly", "Nastran deck", "translated Nastran deck",
    "CalculiX modes", "OP2", "F06", "Nastran sensitivities", "CalculiX shapes", "unknowns",
    "site file",
}  # fmt: skip


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


@pytest.mark.parametrize("name", KINDS)
def test_spoilt_input_is_read_or_refused_in_a_sentence(tmp_path: Path, name: str) -> None:
    kind = KINDS[name]
    count = round(kind.share * MUTATIONS)
    ends = read_all(kind, tmp_path, 1, range(count))
    assert sum(ends.values()) > 0.8 * count
    assert ends["no sentence"] == 0
    if not kind.believed:
        assert ends["read"] == 0


DIGITS = b"7" * 4_400


@pytest.mark.parametrize(
    ("name", "old", "new", "said"),
    [
        ("CalculiX deck", b"\n", b"\r", "line 1: a line ends with a carriage return (CR) alone"),
        ("Nastran deck", b"\n", b"\r", "line 1: a line ends with a carriage return (CR) alone"),
        ("universal datasets", b"\n", b"\r", "line 1: lines end with a carriage return (CR) alone"),
        ("CalculiX deck", b"*NODE, NSET=NALL\n1", DIGITS, "line 1: 4400 digits in a row"),
        (
            "translated Nastran deck",
            b"SPC = 1\n",
            b"SPC = " + DIGITS + b"\n",
            "line 4: 4400 digits",
        ),
        ("translated Nastran deck", b"GRID,1,", b"GRID," + DIGITS + b",", "line 8: 4400 digits"),
        ("translated Nastran deck", b"70.E9", b"70.E999", "line 21: MAT1: 70.E999 is no finite"),
    ],
)
def test_line_ends_and_numbers_that_nothing_reads_are_named_with_their_line(
    name: str, old: bytes, new: bytes, said: str, tmp_path: Path
) -> None:
    good = KINDS[name].good
    assert old in good
    (tmp_path / "input").write_bytes(good.replace(old, new))
    with pytest.raises(ModetuneError) as refused:
        KINDS[name].read(tmp_path / "input")
    assert said in str(refused.value)


LONG_NAME = b"a" * 5000
NODES = b"*NODE, NSET=NALL\n"
PARTS = b"\nSESET,1,1\nPSHELL,29,1,.006,1,,"
SECTION = b"*SOLID SECTION, ELSET=BLOCK, MATERIAL=AL\n"


@pytest.mark.parametrize(
    ("name", "old", "new", "said"),
    [
        ("CalculiX deck", b"*NODE", b"*INCLUDE, INPUT=" + LONG_NAME + b"\n*NODE", "is not there"),
        ("Nastran deck", b"BULK", b"BULK\nINCLUDE '" + LONG_NAME + b"'", "is not there"),
        ("draft for CalculiX", NODES, NODES + b"3" * 19 + b",0.,0.,0.\n", "larger than 2147483647"),
        ("draft for CalculiX", SECTION, SECTION * 5000, ""),
        ("CalculiX deck", b"*MATERIAL", b"*MATERIAL, NAME=AL\n" * 8000 + b"*MATERIAL", ""),
        ("assembly", b"0.4", b"0.4 0.4", "'0.4 0.4' is not a number"),
        ("Nastran deck", b"BULK\n", b"BULK\nDVGRID" + b"," * 300_000 + b"\n", "300,000 fields"),
        ("Nastran deck", b"BULK", b"BULK" + PARTS + b"A" * 30, "too long for a field"),
        ("draft by SOL 200, plate", b",5,1.\n", b",5,1.\n" * 300, "more than 50 operations"),
        ("draft by SOL 200, beam", b"DESVAR,1,", b"DESVAR,1\xbc", ""),
        ("translated Nastran deck", b"70.E9,,.3,", b"70.E9,,1.,", "Poisson's ratio 1 is too large"),
        ("CalculiX modes", b"\n", b"\n" + b"\n" * 300_000, ""),
        ("F06", b"MSC Nastran", b"MSC Nastran" + b"A" * 100_000, ""),
        ("F06", b"1.000000E+00", b"7" * 300_000 + b"1.000000E+00", "do not fit"),
        ("campaign", b"\n", b"\n# " + b"x" * 700_000 + b"\n", "has more than 1 MB"),
        ("table of a spreadsheet", b"Mode", b"A" + b" " * 100_000 + b"B", "the first row must be"),
        ("draft for CalculiX", NODES, NODES + b"999,1e300,0.,0.\n", "coordinates expected"),
        ("repeated tests", b"c,9.9,,0.012", b"c,9.9,,1e300", "1e300"),
        ("template", b":.9E}", b":.9999999999E}", "is not a format such as 12.5E"),
        ("template", b"{n_modes}", b"{n_modes:9999999999d}", "a number of modes is whole"),
        ("repeated tests", b"c,9.9,,0.012,0.025\n", b"c,9.9,,0.012,0.025\n" * 40, ""),
    ],
)  # fmt: skip
def test_what_readers_once_failed_at_is_read_or_refused(
    name: str, old: bytes, new: bytes, said: str, tmp_path: Path
) -> None:
    good = KINDS[name].good
    assert old in good
    (tmp_path / "input").write_bytes(good.replace(old, new, 1))
    with bounded():
        if said:
            with pytest.raises(ModetuneError) as refused:
                KINDS[name].read(tmp_path / "input")
            assert said in str(refused.value)
        else:
            KINDS[name].read(tmp_path / "input")


@pytest.mark.parametrize("name", ["OUTPUT4", "binary OUTPUT4", "DMIG"])
def test_matrices_that_pynastran_refuses_are_refused_and_print_nothing(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "input").write_bytes(KINDS[name].good[:-37])
    with pytest.raises(ModelError):
        KINDS[name].read(tmp_path / "input")
    assert capsys.readouterr().out == ""  # where `--json` prints its object


def test_headings_of_two_lines_and_books_without_styles_are_read(tmp_path: Path) -> None:
    rows = [["mode\nnumber", 1, 2], ["Frequency\n[Hz]", 10.5, 20.25], ["1.z", 1.0, -0.5]]
    with zipfile.ZipFile(io.BytesIO(workbook(rows))) as book:
        members = {name: book.read(name) for name in book.namelist() if "styles" not in name}
    with zipfile.ZipFile(tmp_path / "input", "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    read_test(".xlsx")(tmp_path / "input")


@pytest.mark.parametrize(
    ("variables", "said"),
    [
        ({"dof": np.array([1.01, np.inf])}, "no variable names their nodes"),
        ({"node": np.array([[1e300, 0.0, 0.0, 0.0]])}, "no variable names their nodes"),
    ],
)
def test_numbers_of_nodes_that_are_none_are_refused(
    variables: dict[str, object], said: str, tmp_path: Path
) -> None:
    modes = {"fn": np.array([1.0, 2.0]), "phi": np.eye(2)}
    (tmp_path / "input").write_bytes(mat_file(modes | variables))
    with pytest.raises(CampaignError, match=said):
        read_test(".mat")(tmp_path / "input")


@pytest.mark.parametrize("packed", [False, True])
def test_an_element_of_a_matlab_file_without_a_type_is_refused(
    packed: bool, tmp_path: Path
) -> None:
    data = mat_file({"fn": np.array([1.0, 2.0]), "phi": np.eye(2)})
    kinds = data[:128] + data[128:].replace(b"\x09\0\0\0", b"\xd0\x3f\0\0", 1)
    if packed:
        inner = zlib.compress(kinds[128:])
        kinds = data[:128] + struct.pack("<II", 15, len(inner)) + inner
    (tmp_path / "input").write_bytes(kinds)  # SciPy crashes at it
    with pytest.raises(CampaignError, match="has no type or is cut short"):
        read_test(".mat")(tmp_path / "input")


def test_a_repeated_keyword_line_changes_nothing(tmp_path: Path) -> None:
    good = KINDS["CalculiX deck"].good
    (tmp_path / "input").write_bytes(good.replace(b"*NODE", b"*NODE, NSET=NALL\n*NODE", 1))
    KINDS["CalculiX deck"].read(tmp_path / "input")


@pytest.mark.parametrize("name", KINDS)
def test_what_is_not_spoilt_is_read(tmp_path: Path, name: str) -> None:
    path = tmp_path / "input"
    path.write_bytes(KINDS[name].good)
    KINDS[name].read(path)
    assert threading.active_count() < 50
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        KINDS[name].read(path)


#: Each value holds the one above nine times.
BOMB = "a0: &a0 [1, 1]\n" + "".join(
    f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 15)
)


@pytest.mark.parametrize(
    "text",
    [
        "name: 2020-99-99",
        "? [a]\n: b",
        "name: &x [*x]",
        "name: " + "[" * 5000,
        BOMB,
        "name: \0",
        "<<: 3",
    ],
)
def test_yaml_that_is_endless_or_no_data_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "campaign.yaml"
    path.write_text(text)
    with bounded(), pytest.raises(CampaignError, match=r"campaign\.yaml"):
        load_campaign(path)


def test_a_shell_of_three_different_corners_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "input"
    path.write_text(PLATE_DECK.replace("CQUAD4,1,1,1,2,5,4", "CQUAD4,1,1,1,2,5,5"))
    with pytest.raises(ModelError, match="cannot be translated"):
        translated_solver(path, NASTRAN)


def test_a_matrix_line_without_its_row_is_no_result(tmp_path: Path) -> None:
    path, good = tmp_path / "input", KINDS["CalculiX matrix"].good
    path.write_bytes(good.replace(good.split(b"\n")[3].strip(), b", 1 2.5", 1))
    with pytest.raises(NoResult):
        read_stiffness(path)


@pytest.mark.parametrize("include", ["*INCLUDE, INPUT={}", "INCLUDE '{}'"])
def test_files_that_include_each_other_twice_are_refused_at_once(
    tmp_path: Path, include: str
) -> None:
    for number in range(26):
        lines = 2 * f"{include.format(f'f{number + 1}.inc')}\n"
        (tmp_path / f"f{number}.inc").write_text(lines)
    (tmp_path / "f26.inc").write_text("\n")
    read = read_keyword_deck if include.startswith("*") else read_bulk_deck
    with bounded(), pytest.raises(ModelError, match=r"line \d: .* more than 2000 includes"):
        read(tmp_path / "f0.inc")


@pytest.mark.parametrize("number", ["99999999999999999999", "-9223372036854775809", "2147483648"])
def test_a_number_beyond_nastrans_integers_is_told_with_its_line(
    tmp_path: Path, number: str
) -> None:
    path = tmp_path / "model.bdf"
    path.write_text(PLATE_DECK.replace("GRID,8,", f"GRID,{number},"))
    with pytest.raises(ModelError, match=r"model\.bdf, line 15: GRID: .* larger than 2147483647"):
        translated_solver(path, NASTRAN)


BILLION = 10**9


@pytest.mark.parametrize(
    "text",
    [
        f"%%MatrixMarket matrix coordinate real symmetric\n{BILLION} {BILLION} 1\n1 1 1.0\n",
        f"%%MatrixMarket matrix coordinate real general\n3 3 {BILLION}\n1 1 1.0\n",
        f"%%MatrixMarket matrix array real general\n{BILLION} {BILLION}\n1.0\n",
    ],
)
def test_a_market_file_that_declares_more_than_it_holds_is_refused(
    tmp_path: Path, text: str
) -> None:
    (tmp_path / "K.mtx").write_text(text)
    with bounded(), pytest.raises(ModelError, match=r"K\.mtx .*declares"):
        read_matrix(tmp_path, "K.mtx")


def test_an_hdf5_file_that_declares_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "K.h5", "w") as file:
        file.create_dataset("flat", shape=(31623, 31623), dtype="f8")
        file.create_dataset("chunks", shape=(31623, 31623), dtype="f8", compression="gzip")
        file["good"] = np.eye(3)
    with bounded():
        flat, chunks, good = read_matrices(tmp_path, ["K.h5:flat", "K.h5:chunks", "K.h5:good"])
    for found in (flat, chunks):
        assert isinstance(found, ModelError)
        assert "declares 8000113032 bytes and holds 0" in str(found)
    assert not isinstance(good, ModelError)
    np.testing.assert_array_equal(good.toarray(), np.eye(3))


def test_an_npz_file_that_declares_more_than_it_holds_is_refused(tmp_path: Path) -> None:
    head = b"\x93NUMPY\x01\x00"
    text = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({BILLION},), }}".ljust(117) + "\n"
    array = head + len(text).to_bytes(2, "little") + text.encode()
    with zipfile.ZipFile(tmp_path / "K.npz", "w") as file:
        file.writestr("data.npy", array)
    with bounded(), pytest.raises(ModelError, match="declares the shape"):
        read_matrix(tmp_path, "K.npz")


@pytest.mark.parametrize(
    "text",
    [
        "matrix coordinate real symmetric\n2 2 3\n1 1 2.0\n2 1 -1.0\n2 2 1.0",
        "matrix array real general\n2 2\n2.0\n-1.0\n-1.0\n1.0",
        "matrix array integer symmetric\n% none\n\n2 2\n2\n-1\n1",
        "MATRIX Coordinate Integer General\n2\t2 4\n1 1 2\n1 2 -1\n2 1 -1\n2 2 1\n\n",
    ],
)
def test_a_market_file_may_end_without_a_line_end(tmp_path: Path, text: str) -> None:
    (tmp_path / "K.mtx").write_text(f"%%MatrixMarket {text}")
    expected = [[2.0, -1.0], [-1.0, 1.0]]
    np.testing.assert_array_equal(read_matrix(tmp_path, "K.mtx").toarray(), expected)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("matrix array real general\n1 1\n1.0\n2.0\n", "declares 1 lines of 1"),
        ("matrix coordinate real general\n1 1 1\n1 1 1.0 5\n", "declares 1 lines of 3"),
        ("matrix coordinate real general\n1 1 1\n2 1 1.0\n", "none of the matrix"),
        ("matrix coordinate real general\n1 1 1\n1.5 1 1.0\n", "none of the matrix"),
        ("matrix coordinate complex general\n1 1 1\n1 1 1.0 0.0\n", "complex"),
        ("vector array real general\n1 1\n1.0\n", "does not start with"),
    ],
)
def test_a_market_file_that_is_not_what_it_declares_is_refused(
    tmp_path: Path, text: str, said: str
) -> None:
    (tmp_path / "K.mtx").write_text(f"%%MatrixMarket {text}")
    with pytest.raises(ModelError, match=said):
        read_matrix(tmp_path, "K.mtx")


def test_indices_out_of_range_are_refused(tmp_path: Path) -> None:
    np.savez(
        tmp_path / "K.npz",
        format=np.array(b"csr"), shape=np.array([3, 3]), data=np.ones(3),
        indices=np.array([0, 10**8, 2]), indptr=np.array([0, 1, 2, 3]),
    )  # fmt: skip
    with pytest.raises(ModelError, match="holds no matrix"):
        read_matrix(tmp_path, "K.npz")


@pytest.mark.parametrize("name", sorted(READ_BY_PATH))
def test_a_pipe_is_refused_and_never_waited_for(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / "input")
    with bounded(), pytest.raises(ModetuneError, match="regular file is needed"):
        KINDS[name].read(tmp_path / "input")


@pytest.mark.parametrize("name", ["K.mtx", "K.npz", "K.h5:K", "t.uff", "t.csv", "t.h5", "t.dat"])
def test_a_pipe_or_a_device_as_a_named_file_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name.partition(":")[0]
    for device in (False, True):
        if device:
            path.symlink_to("/dev/zero")
        else:
            os.mkfifo(path)
        with bounded(), pytest.raises(ModetuneError, match="regular file is needed"):
            read_matrix(tmp_path, name) if name[0] == "K" else read_measurement([path])
        path.unlink()


def test_a_file_larger_than_memory_is_refused(tmp_path: Path) -> None:
    with (tmp_path / "t.uff").open("wb") as file:
        file.truncate(largest() + 1)
    with bounded(), pytest.raises(CampaignError, match="more than can be read here"):
        read_measurement([tmp_path / "t.uff"])
