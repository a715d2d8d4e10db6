"""OP2 files: recorded ones of several programs, small ones written here, damaged ones."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.nastran.op2 import read_op2
from modetune.adapters.nastran.results import NastranModes
from modetune.core.errors import SolverCrashed
from modetune.core.modes import Floats

#: Twenty rods in a row, twelve modes, solved by MYSTRAN 17.
RODS = Path(__file__).parents[1] / "data" / "nastran" / "rods.op2"
SOLVED = (
    "pn_beam_modes",
    "pn_goland_sol200_dscm2",
    "pn_mode_solid_shell_bar",
    "pn_modes_elements",
    "pn_plate_py",
    "pn_sdof_crod",
    "yeti_gpwg1",
)
#: MYSTRAN 17's own weight generator is wrong for solids and layered plates (its F06 prints the
#: same wrong mass); expected.json has the mass that its matrices hold.
WRONG_WEIGHT = ("chexa", "ctetra4", "ctetra10", "pcomp")


class Writer:
    """Writes the records of an OP2 file, words of 4 or 8 bytes."""

    def __init__(self, word: int = 4) -> None:
        self.word = word
        self.data = b""
        self.mark(3).raw(self.words([1, 1, 26])).mark(7)
        self.raw(self.text("NASTRAN FORT TAPE ID CODE - "))
        self.mark(2).raw(self.text("XXXXXXXX")).mark(-1).mark(0)

    def words(self, values: Sequence[int | float]) -> bytes:
        letters = {4: "if", 8: "qd"}[self.word]
        return b"".join(
            struct.pack("<" + letters[isinstance(value, float)], value) for value in values
        )

    def text(self, text: str) -> bytes:
        filler = b" " * (self.word - 4)
        data = text.encode()
        return b"".join(data[at : at + 4] + filler for at in range(0, len(data), 4))

    def raw(self, body: bytes) -> Writer:
        length = struct.pack("<i", len(body))
        self.data += length + body + length
        return self

    def mark(self, mark: int) -> Writer:
        return self.raw(self.words([mark]))

    def record(self, body: bytes) -> Writer:
        return self.mark(len(body) // self.word).raw(body)

    def table(self, name: str, records: list[list[bytes]]) -> Writer:
        self.record(self.text(name.ljust(8))).mark(-1).record(self.words([101] + 6 * [0]))
        for number, pieces in enumerate([[self.text(name.ljust(8))], *records], start=2):
            self.mark(-number).mark(1).mark(0)
            for piece in pieces:
                self.record(piece)
        self.mark(-len(records) - 3).mark(1).mark(0).mark(0)
        return self

    def shape(self, mode: int, eigenvalue: float, code: int = 7, width: int = 8) -> list[bytes]:
        """Identification and data of one mode of nodes 3 and 12: components mode, 2, 3, 4, 5, 6.

        The data stands in two pieces, as long ones do.
        """
        head = self.words([21, code, 0, 1, mode, eigenvalue, 0.0, 0, 1, width] + [0] * 136)
        rows = [
            self.words([10 * node + 1, 1, float(mode), 2.0, 3.0, 4.0, 5.0, 6.0]) for node in (12, 3)
        ]
        return [head, *rows]

    def shapes(self, code: int = 7, width: int = 8) -> Writer:
        records = []
        for mode in (1, 2):
            head, *rows = self.shape(mode, 100.0 * mode, code, width)
            records += [[head], rows]
        return self.table("OUGV1", records)

    def energies(self, name: str, kind: str, rows: list[tuple[int, float]]) -> Writer:
        head = self.words([21, 18, 50.0, 1, 1]) + self.text(kind.ljust(8))
        head += self.words([0, 1, 4] + [0] * 136)
        body = b"".join(
            self.words([10 * element + 1, energy, 2.0 * energy, 1.0]) for element, energy in rows
        )
        total = self.words([1_000_000_001, 99.0, 99.0, 99.0])
        return self.table(name, [[head], [body + total]])

    def save(self, folder: Path) -> Path:
        path = folder / "modes.op2"
        path.write_bytes(
            self.data
            + struct.pack("<i", self.word)
            + bytes(self.word)
            + struct.pack("<i", self.word)
        )
        return path


def assert_eigenvalues(found: Floats, wanted: Floats) -> None:
    """Equal to single precision; rigid modes are rounding and equal on the scale of the others."""
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-9 * np.abs(wanted).max())


@pytest.mark.parametrize("name", SOLVED)
def test_files_of_msc_and_simcenter_read_as_pynastran_reads_them(
    shared_data: Path, name: str
) -> None:
    """expected.json of each case is what pyNastran 1.4.1 reads in it."""
    folder = shared_data / "nastran" / name
    case = json.loads((folder / "expected.json").read_text())["op2"]
    modes = read_op2(folder / case["file"])
    for table in case["eigenvalues"].values():
        assert_eigenvalues(modes.eigenvalues, np.array(table["eigenvalues"]))
        np.testing.assert_allclose(modes.generalized_mass, table["gen_mass"], rtol=1e-5)
    for vectors in case["eigenvectors"]:
        frequencies = np.array(vectors["freq_from_eigenvalue"])
        wanted = np.sign(frequencies) * (2.0 * np.pi * frequencies) ** 2
        assert_eigenvalues(modes.eigenvalues, wanted)
        np.testing.assert_allclose(
            np.abs(modes.mode_shapes).max(axis=0), vectors["max_abs"], rtol=1e-5
        )
        n_modes, n_points, _ = vectors["shape"]
        assert np.unique(modes.nodes).size == n_points
        assert modes.mode_shapes.shape[1] == n_modes
    assert np.isfinite(modes.mass) == case["gpwg"]
    assert (modes.elements.size > 0) == bool(case["strain_energy"])


def test_all_probes_of_mystran_agree_with_its_matrices_in_double_precision(
    shared_data: Path,
) -> None:
    folder = shared_data / "nastran" / "mystran_probes"
    cases = json.loads((folder / "expected.json").read_text())["cases"]
    for name, case in cases.items():
        modes = read_op2(folder / f"{name}.OP2")
        exact = np.load(folder / f"{name}_KM.npz")
        assert_eigenvalues(modes.eigenvalues, exact["lam"])
        # phi is PHIG of OUTPUT4 in double precision, node by node; the OP2 is single.
        np.testing.assert_allclose(
            modes.mode_shapes, exact["phi"], rtol=1e-5, atol=1e-6 * np.abs(exact["phi"]).max()
        )
        np.testing.assert_array_equal(np.unique(modes.nodes), exact["grid_ids"])
        if name not in WRONG_WEIGHT:
            assert modes.mass == pytest.approx(case["mass"], rel=1e-6)  # single precision
        frequencies = np.sign(modes.eigenvalues) * np.sqrt(np.abs(modes.eigenvalues)) / 2 / np.pi
        np.testing.assert_allclose(
            # A rigid frequency is the root of rounding, 1e-5 of the others at most.
            frequencies,
            case["freq_hz"],
            rtol=1e-5,
            atol=1e-5 * max(case["freq_hz"]),
        )


def test_strain_energies_sum_to_half_the_eigenvalue_of_mass_normalised_modes(
    shared_data: Path,
) -> None:
    folder = shared_data / "nastran" / "pn_mode_solid_shell_bar"
    modes = read_op2(folder / "mode_solid_shell_bar.op2")
    # phi^T K phi / 2 = lambda / 2, with every element printed; single precision.
    np.testing.assert_allclose(modes.strain_energies.sum(axis=0), modes.eigenvalues / 2, rtol=1e-5)
    np.testing.assert_allclose(modes.total_strain_energy, modes.eigenvalues / 2, rtol=1e-5)
    assert modes.elements.tolist() == list(range(1, 22))
    bar = modes.strain_energies[modes.elements == 13, 0]
    assert bar == pytest.approx(2.143645e04, rel=1e-6)  # printed in the F06 of the same run


def test_kinetic_energies_are_not_taken_for_strain_energies(shared_data: Path) -> None:
    """ONRGY2 of this file has the kinetic energies of CONM2 50 and 51 in the same layout."""
    modes = read_op2(shared_data / "nastran" / "pn_modes_elements" / "modes_elements.op2")
    assert not np.isin([50, 51], modes.elements).any()


def test_the_mass_is_the_one_printed(shared_data: Path) -> None:
    modes = read_op2(shared_data / "nastran" / "yeti_gpwg1" / "rdop2gpwg_1.op2")
    # Figures of the F06 of the same run, seven digits.
    assert modes.mass == pytest.approx(5.005019e01, rel=1e-6)


@pytest.mark.parametrize("word", [4, 8])
def test_shapes_come_by_node_and_component_from_words_of_both_widths(
    tmp_path: Path, word: int
) -> None:
    modes = read_op2(Writer(word).shapes().save(tmp_path))
    assert modes.nodes.tolist() == [3] * 6 + [12] * 6  # sorted, whatever the file's order
    assert modes.components.tolist() == [1, 2, 3, 4, 5, 6] * 2
    np.testing.assert_array_equal(modes.mode_shapes[:6].T, [[1, 2, 3, 4, 5, 6], [2, 2, 3, 4, 5, 6]])
    np.testing.assert_array_equal(modes.eigenvalues, [100.0, 200.0])
    assert np.isnan(modes.mass)
    assert np.isnan(modes.total_strain_energy).all()
    assert np.isnan(modes.generalized_mass).all()


def test_an_element_number_of_two_types_has_the_energy_of_both_and_a_repeated_table_counts_once(
    tmp_path: Path,
) -> None:
    writer = Writer().shapes().energies("ONRGY1", "QUAD4", [(7, 10.0), (8, 20.0)])
    writer.energies("ONRGY1", "BAR", [(7, 5.0)]).energies("ONRGY1", "QUAD4", [(7, 10.0), (8, 20.0)])
    modes = read_op2(writer.save(tmp_path))
    assert modes.elements.tolist() == [7, 8]
    np.testing.assert_array_equal(modes.strain_energies[:, 0], [15.0, 20.0])
    assert np.isnan(modes.strain_energies[:, 1]).all()  # the file has none of mode 2
    assert modes.total_strain_energy[0] == 50.0


@pytest.mark.parametrize(("code", "width", "reason"), [(2007, 8, "SORT2"), (7, 14, "complex")])
def test_modes_sorted_by_point_and_complex_ones_are_refused_with_the_reason(
    tmp_path: Path, code: int, width: int, reason: str
) -> None:
    with pytest.raises(SolverCrashed, match=reason):
        read_op2(Writer().shapes(code=code, width=width).save(tmp_path))


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"", "0 bytes"),
        (b"SOL 103\nCEND\n", "first bytes"),
        (struct.pack(">i", 4) + struct.pack(">i", 3) + struct.pack(">i", 4), "big-endian"),
        (RODS.read_bytes()[:9000], "cut short"),
        (RODS.read_bytes()[:-12], "end mark"),
        (struct.pack("<i", 4) * 3 + struct.pack("<i", 2_000_000_000), "2000000000 bytes"),
    ],
)
def test_what_is_no_whole_op2_file_is_refused_with_what_was_found(
    tmp_path: Path, content: bytes, found: str
) -> None:
    path = tmp_path / "job.op2"
    path.write_bytes(content)
    with pytest.raises(SolverCrashed, match=found) as refused:
        read_op2(path)
    assert str(path) in str(refused.value)


def test_a_missing_file_and_one_without_modes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SolverCrashed, match="cannot be read"):
        read_op2(tmp_path / "none.op2")
    with pytest.raises(SolverCrashed, match="neither"):
        read_op2(Writer().save(tmp_path))


def test_a_file_cut_anywhere_is_refused(tmp_path: Path) -> None:
    whole = RODS.read_bytes()
    for length in np.linspace(0, len(whole) - 1, 40).astype(int):
        path = tmp_path / "cut.op2"
        path.write_bytes(whole[:length])
        with pytest.raises(SolverCrashed):
            read_op2(path)


def test_a_byte_changed_anywhere_is_refused_or_changes_one_number_at_most(tmp_path: Path) -> None:
    """An OP2 file has no checksum: a changed digit of a result cannot be seen, a structure can."""
    good = read_op2(RODS)
    generator = np.random.default_rng(7)
    refused = 0
    for _ in range(200):
        data = bytearray(RODS.read_bytes())
        data[generator.integers(len(data))] ^= int(generator.integers(1, 256))
        path = tmp_path / "flipped.op2"
        path.write_bytes(data)
        try:
            found = read_op2(path)
        except SolverCrashed:
            refused += 1
            continue
        assert differences(found, good) <= 1
    assert refused > 20


def differences(found: NastranModes, good: NastranModes) -> int:
    """How many numbers differ; the last modes may be lost with the name of their table."""
    n_modes = found.eigenvalues.size
    if found.nodes.shape != good.nodes.shape:
        return good.nodes.size
    pairs = [
        (found.mode_shapes, good.mode_shapes[:, :n_modes]),
        (found.eigenvalues, good.eigenvalues[:n_modes]),
        (found.nodes, good.nodes),
        (found.components, good.components),
    ]
    if np.isfinite(found.mass):  # not lost
        pairs.append((np.array(found.mass), np.array(good.mass)))
    return sum(int((one != other).sum()) for one, other in pairs)
