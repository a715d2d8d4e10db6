"""Print files: recorded ones of four programs, a small one written here, damaged ones."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.licence import licence_denied
from modetune.adapters.nastran.f06 import F06, read_f06
from modetune.adapters.nastran.op2 import read_op2
from modetune.core.errors import SolverCrashed

PAGE = "1    A PAGE                         JANUARY   1, 2020  MSC Nastran  3/11/18   PAGE     1\n"
SUBCASE = "0" + " " * 108 + "SUBCASE {}\n"
EIGENVALUES = "                        R E A L   E I G E N V A L U E S\n"
VECTOR = (
    "      EIGENVALUE =  {:.6E}\n          CYCLES =  1.000000E+00         "
    "R E A L   E I G E N V E C T O R   N O .          {}\n \n"
    "      POINT ID.   TYPE          T1             T2\n"
)
END = "1                                        * * * END OF JOB * * *\n"


def row(mode: int, eigenvalue: float, star: str = "") -> str:
    radians = np.sqrt(abs(eigenvalue))
    return (
        f"   {mode:6d}  {mode:6d}   {eigenvalue:.6E}{star}   {radians:.6E}   "
        f"{radians / (2.0 * np.pi):.6E}   1.000000E+00   {eigenvalue:.6E}\n"
    )


def point(node: int, values: list[str], kind: str = "G") -> str:
    return f"{node:14d}      {kind}     " + "  ".join(values) + "\n"


def small() -> str:
    """Two modes of nodes 1 and 2 and scalar points 7, 8, broken over pages; and subcase 2."""
    ones = ["1.000000E+00", "0.0", "-2.5E-01", "0.0", "0.0", "3.000000-101"]
    twos = ["2.0E+00"] * 6
    lines = [
        "     MSC Nastran 2022.1 \n",
        PAGE,
        SUBCASE.format(1),
        EIGENVALUES,
        row(1, -4.0e-7, "*"),
    ]
    lines += [PAGE, SUBCASE.format(1), EIGENVALUES, row(2, 100.0)]
    lines += [
        " *** USER INFORMATION MESSAGE 4114\n",
        "      101      2      0     0     0    0    0\n",
    ]
    for mode, eigenvalue in ((1, -4.0e-7), (2, 100.0)):
        head = VECTOR.format(eigenvalue, mode)
        lines += [PAGE, SUBCASE.format(1), head, point(1, ones)]
        lines += [PAGE, SUBCASE.format(1), head, point(2, twos), point(7, ["5.0", "6.0"], "S")]
    lines += [PAGE, SUBCASE.format(2), EIGENVALUES, row(1, 900.0)]
    lines += [PAGE, SUBCASE.format(2), VECTOR.format(900.0, 1), point(1, twos)]
    return "".join([*lines, END])


def write(folder: Path, text: str) -> Path:
    path = folder / "job.f06"
    path.write_text(text)
    return path


def test_tables_broken_over_pages_are_put_together_and_the_first_subcase_is_read(
    tmp_path: Path,
) -> None:
    f06 = read_f06(write(tmp_path, small()))
    np.testing.assert_array_equal(f06.modes.eigenvalues, [-4.0e-7, 100.0])
    assert f06.modes.mode_numbers.tolist() == [1, 2]
    assert f06.modes.nodes.tolist() == [1] * 6 + [2] * 6 + [7, 8]
    assert f06.modes.components.tolist() == [1, 2, 3, 4, 5, 6] * 2 + [1, 1]
    wanted = [1.0, 0.0, -0.25, 0.0, 0.0, 3.0e-101] + [2.0] * 6 + [5.0, 6.0]
    np.testing.assert_array_equal(f06.modes.mode_shapes[:, 0], wanted)
    assert (f06.version, f06.ended) == ("MSC Nastran 2022.1", True)
    assert np.isnan(f06.modes.mass)


def test_modes_of_a_component_give_way_to_those_of_the_whole(tmp_path: Path) -> None:
    """Component mode synthesis prints fixed-interface modes first, before residual vectors."""
    before = "                 (BEFORE AUGMENTATION OF RESIDUAL VECTORS)\n"
    after = before.replace("BEFORE", "AFTER")
    fixed = [PAGE, EIGENVALUES, before, row(1, 400.0), PAGE, EIGENVALUES, before, row(2, 900.0)]
    more = [PAGE, EIGENVALUES, after, row(1, 400.0), row(2, 900.0), row(3, 4e8)]
    whole = [PAGE, EIGENVALUES, row(1, 25.0), row(2, 36.0), PAGE, EIGENVALUES, row(3, 49.0)]
    alone = read_f06(write(tmp_path, "".join([*fixed, *more, END])))
    np.testing.assert_array_equal(alone.modes.eigenvalues, [400.0, 900.0])
    found = read_f06(write(tmp_path, "".join([*fixed, *more, *whole, END])))
    np.testing.assert_array_equal(found.modes.eigenvalues, [25.0, 36.0, 49.0])


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("pn_beam_modes", "Simcenter Nastran 2019.2"),
        ("pn_goland_sol200_dscm2", "Version 2018.1.0-CL553137"),
        ("pn_mode_solid_shell_bar", "Version 2005.1.0"),
        ("yeti_gpwg1", "Simcenter Nastran 2019.2"),
    ],
)
def test_files_of_msc_and_simcenter_have_the_expected_frequencies(
    shared_data: Path, name: str, version: str
) -> None:
    """expected.json lists the printed cycles; of SOL 200 a line that is not a mode, too."""
    folder = shared_data / "nastran" / name
    case = json.loads((folder / "expected.json").read_text())["f06"]
    f06 = read_f06(next(folder.glob("*.f06")))
    cycles = np.sqrt(np.abs(f06.modes.eigenvalues)) / (2.0 * np.pi)
    wanted = np.array(next(iter(case.values()))[0])[: cycles.size]
    assert cycles.size == np.count_nonzero(next(iter(case.values()))[0])
    np.testing.assert_allclose(cycles, wanted, rtol=1e-5)
    assert (f06.version, f06.ended, f06.fatal_messages) == (version, True, ())


def assert_same_shapes(f06: F06, op2: Path) -> None:
    modes = read_op2(op2)
    np.testing.assert_array_equal(f06.modes.nodes, modes.nodes)
    np.testing.assert_array_equal(f06.modes.components, modes.components)
    # Seven printed digits against single precision.
    largest = np.abs(modes.mode_shapes).max()
    np.testing.assert_allclose(
        f06.modes.mode_shapes, modes.mode_shapes, rtol=1e-5, atol=1e-6 * largest
    )


def test_shapes_and_strain_energies_are_those_of_the_op2_file_of_the_run(shared_data: Path) -> None:
    folder = shared_data / "nastran" / "pn_mode_solid_shell_bar"
    f06, modes = (
        read_f06(folder / "mode_solid_shell_bar.f06"),
        read_op2(folder / "mode_solid_shell_bar.op2"),
    )
    assert_same_shapes(f06, folder / "mode_solid_shell_bar.op2")
    np.testing.assert_array_equal(f06.modes.elements, modes.elements)
    np.testing.assert_allclose(f06.modes.strain_energies, modes.strain_energies, rtol=1e-5)
    np.testing.assert_allclose(f06.modes.total_strain_energy, modes.total_strain_energy, rtol=1e-5)


def test_all_probes_of_mystran_are_those_of_their_op2_files(
    shared_data: Path, tmp_path: Path
) -> None:
    folder = shared_data / "nastran" / "mystran_probes"
    for packed in sorted(folder.glob("*.F06.gz")):
        path = tmp_path / "job.F06"
        path.write_bytes(gzip.decompress(packed.read_bytes()))
        f06, op2 = read_f06(path), folder / packed.name.replace(".F06.gz", ".OP2")
        modes = read_op2(op2)
        assert (f06.version, f06.ended) == ("MYSTRAN Version 17.0.0", True)
        # Rigid eigenvalues are rounding, equal on the scale of the elastic ones.
        largest = modes.eigenvalues.max()
        np.testing.assert_allclose(
            f06.modes.eigenvalues, modes.eigenvalues, rtol=1e-5, atol=1e-9 * largest
        )
        assert_same_shapes(f06, op2)
        assert f06.modes.mass == pytest.approx(modes.mass, rel=1e-6)


def test_nastran_95_prints_the_garteur_mass_and_thirty_eigenvalues(shared_data: Path) -> None:
    f06 = read_f06(shared_data / "garteur" / "supaero" / "nastran_dynamic_ref.out")
    assert f06.modes.eigenvalues.size == 30
    # Rows 7 and 10 of the file's own table.
    cycles = np.sqrt(f06.modes.eigenvalues[[6, 9]]) / (2.0 * np.pi)
    np.testing.assert_allclose(cycles, [6.366620, 46.01503], rtol=1e-6)
    assert f06.modes.generalized_mass[6] == pytest.approx(3.826903e-03)
    assert f06.modes.mass == pytest.approx(41.265, rel=1e-6)  # the README of the data, in kg
    assert f06.ended


@pytest.mark.parametrize(
    ("text", "card", "number", "image"),
    [
        (" *** USER FATAL MESSAGE 307 (IFPDRV)\n     ILLEGAL NAME FOR BULK DATA ENTRY CQUAD9\n"
         "     CQUAD9  12      1\n\n", "CQUAD9", 12, "CQUAD9  12      1"),
        ("0*** USER FATAL MESSAGE 2010 (GP2)\n     ELEMENT 33 OF CARD CBAR NEEDS GRID POINT 9\n\n",
         "CBAR", 33, ""),
        (" *** SYSTEM FATAL MESSAGE 4276 (QOPEN)\n     ERROR CODE 1002\n\n", "", 0, ""),
        (" ^^^ USER FATAL MESSAGE 9050 (SEKRRS) - RUN TERMINATED\n\n", "", 0, ""),
        (" *ERROR  1308: PROPERTY ID 7 ON CROD ENTRY NOT FOUND\n\n", "CROD", 7, ""),
    ],
)  # fmt: skip
def test_fatal_messages_tell_their_lines_and_what_they_name(
    tmp_path: Path, text: str, card: str, number: int, image: str
) -> None:
    f06 = read_f06(write(tmp_path, PAGE + text + PAGE))
    (message,) = f06.fatal_messages
    assert message.text.splitlines() == [
        line.lstrip("0").strip() for line in text.splitlines() if line
    ]
    assert (message.card, message.number, message.card_image) == (card, number, image)
    assert not f06.ended


def test_sentences_about_fatal_errors_are_no_fatal_messages(tmp_path: Path) -> None:
    text = (
        "        IF THE FLAG IS FATAL, THEN THE RUN ENDS\n      12-    $ *** USER FATAL MESSAGE 1\n"
    )
    text += " ^^^ USER INFORMATION MESSAGE 9051 (FEA)\n"
    assert read_f06(write(tmp_path, text)).fatal_messages == ()


@pytest.mark.parametrize(
    "line",
    [
        "MSC Licensing Error: cannot connect to the server",
        "FLEXlm error: -15,570.  Feature NASTRAN not available",
        "Could not check out license for NX Nastran",
        "SPLM8018E: SPLM license server connection error",
        "*** SYSTEM FATAL MESSAGE 3060 (PREFACE)  SUBROUTINE MODEL - AUTHORIZATION ERROR",
        "License server is down or not responding",
    ],
)
def test_a_refused_licence_is_found_in_a_log(line: str) -> None:
    assert licence_denied(f"starting\n  {line}\nend\n") == line.strip("* ")


@pytest.mark.parametrize(
    "line",
    [
        "This software is used under license. All Rights Reserved.",
        "$ could not check out license",
        "MSC.Licensing was checked out: 1 license of NASTRAN",
        "FEATURE: CONTACT",
    ],
)
def test_ordinary_words_about_licences_are_no_refusal(line: str) -> None:
    assert licence_denied(line) == ""


def test_a_run_that_broke_off_keeps_its_messages_and_loses_its_half_tables(tmp_path: Path) -> None:
    text = small().removesuffix(END) + " *** USER FATAL MESSAGE 9\n"
    broken = text.replace(point(7, ["5.0", "6.0"], "S"), "", 1)
    f06 = read_f06(write(tmp_path, broken))
    assert len(f06.fatal_messages) == 1
    assert f06.modes.mode_shapes.size == 0
    with pytest.raises(SolverCrashed, match="different points"):
        read_f06(write(tmp_path, broken + END))


def test_an_eigenvalue_that_its_own_frequency_contradicts_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SolverCrashed, match="a row of the eigenvalues"):
        read_f06(write(tmp_path, small().replace("1.000000E+02", "1.000000E+03", 1)))


def test_a_missing_print_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SolverCrashed, match="cannot be read"):
        read_f06(tmp_path / "none.f06")


def test_a_file_cut_anywhere_has_not_ended_and_tells_no_wrong_eigenvalue(tmp_path: Path) -> None:
    text = small()
    for length in np.linspace(0, len(text) - 30, 40).astype(int):
        f06 = read_f06(write(tmp_path, text[:length]))
        assert not f06.ended
        np.testing.assert_array_equal(
            f06.modes.eigenvalues, [-4.0e-7, 100.0][: f06.modes.eigenvalues.size]
        )


def test_a_byte_changed_anywhere_is_refused_or_read(tmp_path: Path) -> None:
    """A digit of a shape cannot be checked; an eigenvalue is printed three times and can."""
    generator = np.random.default_rng(11)
    for _ in range(200):
        data = bytearray(small().encode())
        data[generator.integers(len(data))] ^= int(generator.integers(1, 256))
        path = tmp_path / "flipped.f06"
        path.write_bytes(data)
        try:
            f06 = read_f06(path)
        except SolverCrashed:
            continue
        np.testing.assert_allclose(
            f06.modes.eigenvalues, [-4.0e-7, 100.0][: f06.modes.eigenvalues.size], rtol=1e-4
        )
