"""Reading what ccx left: recorded output of ccx 2.20, whole, cut short and untrue.

In data/: `bar` is a free bar of two C3D8I elements (bar.inp, 200 x 10 x 10 mm aluminium),
`untrue_modes` the same 20 mm long, `clamped` one element on a clamp (clamped.inp). The other logs
are bar.inp with the fault they are named after; too_many_modes.log is shortened in the middle.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.calculix.results import (
    read_messages,
    read_modal,
    read_version,
)
from modetune.adapters.solver import ModalAnalysis
from modetune.core.algebra.rigid_modes import count_rigid_modes
from modetune.core.errors import SolverCrashed

DATA = Path(__file__).parents[1] / "data"
ANALYSIS = ModalAnalysis(8, (1, 6, 12), (("E_bar", ("BAR",)),))
TEXT = (DATA / "bar.dat").read_text()


def dat_of(folder: Path, text: str) -> Path:
    path = folder / "job.dat"
    path.write_text(text)
    return path


def test_a_whole_file_gives_all_modes_with_energies_and_mass() -> None:
    result = read_modal(DATA / "bar.dat", ANALYSIS, 0.0)
    # The numbers as they stand in bar.dat.
    assert result.eigenvalues[[0, 2, 7]].tolist() == [-1.181118e-04, 3.473837e-06, 9.909436e07]
    assert result.modes.frequencies_hz[6] == pytest.approx(1584.326, rel=1e-6)
    assert result.modes.nodes.tolist() == [1, 1, 1, 6, 6, 6, 12, 12, 12]
    assert result.modes.components.tolist() == [1, 2, 3] * 3
    assert result.modes.normalisation == "mass"
    assert result.groups == ("E_bar",)
    np.testing.assert_array_equal(result.strain_energies[0], result.total_strain_energy)
    # phi^T K phi = lambda for mass-normalised modes
    balance = 2.0 * result.total_strain_energy[6:] / result.eigenvalues[6:]
    np.testing.assert_allclose(balance, 1.0, rtol=1e-5)
    assert result.mass == pytest.approx(200.0 * 10.0 * 10.0 * 2.81e-9, rel=1e-6)  # volume * density


def test_rigid_modes_with_negative_eigenvalues_are_at_zero_hertz() -> None:
    result = read_modal(DATA / "bar.dat", ANALYSIS, 0.0)
    assert (result.eigenvalues[:2] < 0.0).all()
    assert result.modes.frequencies_hz[:2].tolist() == [0.0, 0.0]
    energies = result.total_strain_energy
    assert count_rigid_modes(result.eigenvalues, energies, lambda: 0.0) == 6


def test_repeated_modes_keep_their_own_shapes() -> None:
    # The square bar bends in both directions at one frequency; results belong to mode numbers.
    result = read_modal(DATA / "bar.dat", ANALYSIS, 0.0)
    assert result.eigenvalues[6] == result.eigenvalues[7]
    first, second = result.modes.mode_shapes[:, 6], result.modes.mode_shapes[:, 7]
    cosine = abs(first @ second) / np.linalg.norm(first) / np.linalg.norm(second)
    assert cosine < 0.5


def test_point_masses_are_added_to_the_mass_that_ccx_prints() -> None:
    plain = read_modal(DATA / "bar.dat", ANALYSIS, 0.0).mass
    assert read_modal(DATA / "bar.dat", ANALYSIS, 2.0).mass == plain + 2.0


LAST = TEXT.rindex("total internal energy for set BAR")
CUTS = {
    "empty": 0,
    "in the table of eigenvalues": TEXT.index("      5  "),
    "after the table": TEXT.index("     P A R T"),
    "before the last mode": TEXT.rindex("                    E I G E N"),
    "in the last shape, at a line end": TEXT.rindex("        12 "),
    "in the last shape, within a line": TEXT.rindex("        12 ") + 30,
    "before the last energy": LAST,
    "in the last number read": TEXT.index("E+", LAST) + 2,
    "within the very last line": len(TEXT) - 2,
}


@pytest.mark.parametrize("cut", CUTS)
def test_a_file_cut_short_is_no_result(tmp_path: Path, cut: str) -> None:
    with pytest.raises(SolverCrashed, match=r"job\.dat"):
        read_modal(dat_of(tmp_path, TEXT[: CUTS[cut]]), ANALYSIS, 0.0)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("  0.9909436E+08", "            NaN"),
        ("         6 ", "         6  x"),
        ("        12 ", "        ** "),
        ("N U M B E R     8", "N U M B E R     9"),
    ],
)
def test_garbled_files_are_no_result(tmp_path: Path, old: str, new: str) -> None:
    assert old in TEXT
    text = TEXT.replace(old, new, 1)
    with pytest.raises(SolverCrashed, match=r"job\.dat"):
        read_modal(dat_of(tmp_path, text), ANALYSIS, 0.0)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("7   0.9909436E+08", "7   0.0000000E+00"),
        ("7   0.9909436E+08", "7  -0.9909436E+08"),
        ("7   0.9909436E+08", "7   0.9919436E+08"),
        ("0.1584326E+04   0.0", "0.1584426E+04   0.0"),
        ("0.1584326E+04   0.0000000E+00", "0.1584326E+04   0.1000000E+00"),
        ("1  -0.1181118E-03", "1   0.1181118E-03"),
    ],
)
def test_an_eigenvalue_that_its_frequency_contradicts_is_no_result(
    tmp_path: Path, old: str, new: str
) -> None:
    assert old in TEXT
    with pytest.raises(SolverCrashed, match=r"job\.dat is not a result: eigenvalue . is .* contra"):
        read_modal(dat_of(tmp_path, TEXT.replace(old, new, 1)), ANALYSIS, 0.0)


def test_a_shape_that_is_no_number_is_no_result(tmp_path: Path) -> None:
    start = TEXT.rindex("        12 ") + len("        12 ")
    text = f"{TEXT[:start]}          NaN{TEXT[start + 13 :]}"
    with pytest.raises(SolverCrashed, match="not a finite number"):
        read_modal(dat_of(tmp_path, text), ANALYSIS, 0.0)


@pytest.mark.parametrize(
    "analysis",
    [
        ModalAnalysis(9, ANALYSIS.nodes, ANALYSIS.groups),
        ModalAnalysis(7, ANALYSIS.nodes[:2], ANALYSIS.groups),
        ModalAnalysis(8, ANALYSIS.nodes, (("E_wing", ("WING",)),)),
    ],
    ids=["more modes", "other nodes", "another group"],
)
def test_a_file_that_answers_another_question_is_no_result(analysis: ModalAnalysis) -> None:
    with pytest.raises(SolverCrashed, match=r"bar\.dat"):
        read_modal(DATA / "bar.dat", analysis, 0.0)


def test_exponents_of_three_digits_are_read(tmp_path: Path) -> None:
    # Fortran's e13.6 prints 1e-123 as 1.000000-123.
    start = TEXT.rindex("        12 ") + len("        12 ")
    text = f"{TEXT[:start]} 1.000000-123{TEXT[start + 13 :]}"
    result = read_modal(dat_of(tmp_path, text), ANALYSIS, 0.0)
    assert result.modes.mode_shapes[6, 7] == 1e-123


def test_untrue_modes_are_refused() -> None:
    # For a short stiff free bar ccx 2.20 ends well with modes of strain energy 1e28.
    with pytest.raises(SolverCrashed, match="impossible strain energy"):
        read_modal(DATA / "untrue_modes.dat", ANALYSIS, 0.0)


@pytest.mark.parametrize("name", ["nothing.dat", "."])
def test_a_file_that_cannot_be_read_is_no_result(name: str) -> None:
    with pytest.raises(SolverCrashed, match="cannot be read"):
        read_modal(DATA / name, ANALYSIS, 0.0)


@pytest.mark.parametrize(
    ("banner", "version"),
    [
        ("\nThis is Version 2.20\n\n", "2.20"),  # ccx -v
        ("CalculiX Version 2.20, Copyright(C) 1998-2022 Guido Dhondt\n", "2.20"),  # its log
        ("\nThis is Version 2.19p1\n", "2.19p1"),
        ("This is Version  2.22.1", "2.22.1"),
        ("ccx: error while loading shared libraries: libspooles.so", ""),
        ("Version", ""),
        ("", ""),
    ],
)
def test_versions_are_read_from_banners(banner: str, version: str) -> None:
    assert read_version(banner) == version


def test_the_version_is_read_from_a_recorded_log() -> None:
    assert read_version((DATA / "bar.log").read_text()) == "2.20"


def test_a_good_log_has_no_messages() -> None:
    assert read_messages((DATA / "bar.log").read_text()) == []


@pytest.mark.parametrize(
    ("name", "texts", "card_image", "keyword", "element"),
    [
        (
            "unknown_material",
            ["nonexistent material", "no material was assigned\nto element            2"],
            "*SOLIDSECTION,ELSET=BAR,MATERIAL=STEEL", "*SOLID SECTION", 1,
        ),
        (
            "unknown_set", ["node set CLAMP\nhas not yet been defined."],
            "CLAMP,1,3", "*BOUNDARY", 0,
        ),
        ("bad_number", ["*ERROR reading *ELASTIC. Card image:"], "7X000,0.0", "*ELASTIC", 0),
        ("unknown_type", ["C3D9     is an unknown element type"], "", "*ELEMENT", 0),
        ("turned_element", ["nonpositive jacobian\ndeterminant in element"], "", "", 1),
        ("no_density", ["no density was assigned\nto any material"], "", "", 0),
        ("too_many_modes", ["d[n,s]aupd: info=-3"], "", "", 0),
    ],
)  # fmt: skip
def test_messages_are_read_from_recorded_logs(
    name: str, texts: list[str], card_image: str, keyword: str, element: int
) -> None:
    messages = read_messages((DATA / f"{name}.log").read_text())
    said = "\n".join(message.text for message in messages)
    assert all(text in said for text in texts)
    assert next((m.card_image for m in messages if m.card_image), "") == card_image
    assert next((m.keyword for m in messages if m.keyword), "") == keyword
    assert next((m.element for m in messages if m.element), 0) == element
    assert not any("STEP" in message.text for message in messages)
