"""Models of the embedded solver: what is read, written, refused, and what their content is."""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy import io, sparse

from modetune.adapters.matrices.deck import read_deck, write_updated
from modetune.adapters.matrices.matrix_files import write_matrix
from modetune.adapters.matrices.solver import matrices_solver
from modetune.adapters.solver import MatrixAnalysis, ModalAnalysis
from modetune.core.errors import ModelError
from modetune.core.parameters import QUANTITIES, Parameter, Quantity
from modetune.core.storage.keys import canonical_json
from tests.one_matrix import read_matrix

SYSTEM = """\
# two masses, written by hand
masses: {m1: 2.0, m2: 1e0}     # kg
springs:
  k1: {between: [ground, m1], stiffness: 1_000}
  k2: {between: [m1, m2], stiffness: 500.0}   # the weak one
"""
MATRIX = sparse.csr_array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]])
MASS = sparse.csr_array(np.diag([1.0, 2.0, 3.0]))
JOINT = sparse.csr_array([[0.0, 0.0, 0.0], [0.0, 1.0, -1.0], [0.0, -1.0, 1.0]])
INDEX = """\
stiffness: K.mtx
mass: "model.h5:whole/M"
dofs: dofs.txt
parts:
  joint: {stiffness: "model.h5:joint/K"}
  lump: {mass: lump.npz, stiffness: lump_K.npz}
"""
Reads = Callable[[str], Any]


def parameter(name: str, quantity: Quantity, *targets: str) -> Parameter:
    return Parameter(name, quantity, QUANTITIES[quantity].targets[0], targets, 0.5, 2.0, 0.1)


@pytest.fixture
def deck(tmp_path: Path) -> Reads:
    def read(text: str) -> Any:
        path = tmp_path / "model.yaml"
        path.write_text(text)
        return read_deck(path)

    return read


@pytest.fixture
def index(tmp_path: Path) -> Path:
    """A model in files of all three kinds."""
    write_matrix(tmp_path, "K.mtx", MATRIX)
    write_matrix(tmp_path, "model.h5:whole/M", MASS)
    write_matrix(tmp_path, "model.h5:joint/K", JOINT)
    write_matrix(tmp_path, "lump.npz", sparse.csr_array(np.diag([0.0, 0.0, 1.0])))
    write_matrix(tmp_path, "lump_K.npz", sparse.csr_array(np.diag([0.1, 0.0, 0.0])))
    (tmp_path / "dofs.txt").write_text("# names\n7.x\n7.rz\n12.3\n")
    path = tmp_path / "model.yaml"
    path.write_text(INDEX)
    return path


def test_a_spring_mass_system_has_the_matrices_of_its_elements(deck: Reads) -> None:
    model = deck(SYSTEM).model
    np.testing.assert_array_equal(model.stiffness.toarray(), [[1500.0, -500.0], [-500.0, 500.0]])
    np.testing.assert_array_equal(model.mass.toarray(), np.diag([2.0, 1.0]))
    assert model.nodes.tolist() == [1, 2]
    assert model.total_mass(model.mass) == 3.0


def test_an_updated_system_changes_only_the_changed_numbers(deck: Reads, tmp_path: Path) -> None:
    read = deck(SYSTEM)
    path = write_updated(read, {"k1": 1.1, "m2": 0.5, "k2": 1.0}, tmp_path / "updated")
    expected = SYSTEM.replace("1_000", "1100.0").replace("1e0", "0.5")
    assert path.read_text() == expected
    scaled = read.model.assembled({"k1": 1.1, "m2": 0.5})
    stiffness, mass = scaled.stiffness, scaled.mass
    again = read_deck(path).model
    np.testing.assert_allclose(again.stiffness.toarray(), stiffness.toarray())
    np.testing.assert_allclose(again.mass.toarray(), mass.toarray())


def test_line_ends_of_another_system_are_kept(tmp_path: Path) -> None:
    path = tmp_path / "model.yaml"
    path.write_bytes(SYSTEM.replace("\n", "\r\n").encode())
    updated = write_updated(read_deck(path), {"k2": 2.0}, tmp_path / "updated")
    expected = SYSTEM.replace("500.0", "1000.0").replace("\n", "\r\n")
    assert updated.read_bytes() == expected.encode()


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("m2: 1e0", "m2: -1", "line 2: m2 needs a plain number above zero, found '-1'"),
        ("m2: 1e0", "m2: heavy", "found 'heavy'"),
        ("m2: 1e0", "m2: .nan", "needs a plain number"),
        ("m2: 1e0", "m2: [1]", "needs a plain number"),
        ("[m1, m2]", "[m1, m3]", "line 5: there is no mass m3"),
        ("[m1, m2]", "[m1, m1]", "line 5: `between` must name two ends"),
        ("[m1, m2]", "[m1, [m2]]", "there is no mass"),
        ("[m1, m2]", "m1", "`between` must name two ends"),
        ("stiffness: 500.0", "stifness: 500.0", "unknown key `stifness`"),
        ("k1: {between: [ground, m1], stiffness: 1_000}", "m1: 3", "m1 is a mass already"),
        ("masses: {m1: 2.0, m2: 1e0}", "masses: [2.0]", "`masses` must be a mapping of names"),
        ("masses: {m1: 2.0, m2: 1e0}", "masses: {}", "a mass is needed"),
        ("springs:", "strings:", "unknown key `strings`"),
        ("m1: 2.0", "m1: 2.0, m1: 3.0", "the key `m1` occurs twice"),
        ("masses: {", "masses: {{", "not readable as YAML"),
        ("m1: 2.0", "m1: !!python/object:os.system x", "not readable as YAML"),
    ],
)  # fmt: skip
def test_a_bad_system_is_told_with_its_place(
    deck: Reads, old: str, new: str, expected: str
) -> None:
    with pytest.raises(ModelError, match=r"model\.yaml") as caught:
        deck(SYSTEM.replace(old, new))
    assert expected in str(caught.value)


def test_all_problems_of_a_system_come_at_once(deck: Reads) -> None:
    with pytest.raises(ModelError) as caught:
        deck(SYSTEM.replace("2.0", "zero").replace("500.0", "none"))
    assert len(str(caught.value).splitlines()) == 2


def test_matrices_are_read_from_all_three_kinds_of_file(index: Path) -> None:
    model = read_deck(index).model
    np.testing.assert_array_equal(model.stiffness.toarray(), MATRIX.toarray())
    np.testing.assert_array_equal(model.mass.toarray(), MASS.toarray())
    assert model.nodes.tolist() == [7, 7, 12]
    assert model.components.tolist() == [1, 6, 3]
    assert set(model.parts) == {"joint", "lump"}
    scaled = model.assembled({"joint": 1.5, "lump": 3.0})
    stiffness, mass = scaled.stiffness, scaled.mass
    expected = MATRIX + 0.5 * JOINT + 2.0 * np.diag([0.1, 0.0, 0.0])
    np.testing.assert_allclose(stiffness.toarray(), np.asarray(expected))
    lumps = MASS.toarray() + 2.0 * np.diag([0.0, 0.0, 1.0])
    np.testing.assert_allclose(mass.toarray(), lumps)


def test_an_updated_model_of_matrices_is_a_model_again(index: Path, tmp_path: Path) -> None:
    read = read_deck(index)
    factors = {"joint": 1.5, "lump": 3.0}
    for _ in range(2):  # a second run writes over the first
        path = write_updated(read, factors, tmp_path / "updated")
    again = read_deck(path).model
    scaled = read.model.assembled(factors)
    for new, expected in ((again.stiffness, scaled.stiffness), (again.mass, scaled.mass)):
        np.testing.assert_allclose(new.toarray(), expected.toarray(), rtol=1e-15)
    # Parts are scaled too: going back by 1 / 1.5 gives the first model again.
    back = again.assembled({name: 1.0 / factor for name, factor in factors.items()})
    np.testing.assert_allclose(back.stiffness.toarray(), MATRIX.toarray(), atol=1e-14)
    assert again.nodes.tolist() == read.model.nodes.tolist()


def test_files_from_elsewhere_are_written_beside_the_updated_index(
    index: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "study"
    folder.mkdir()
    (folder / "model.yaml").write_text('stiffness: ../K.mtx\nmass: "../model.h5:whole/M"\n')
    path = write_updated(read_deck(folder / "model.yaml"), {}, tmp_path / "updated")
    assert path.read_text() == 'stiffness: "K.mtx"\nmass: "model.h5:whole/M"\n'
    stiffness = read_deck(path).model.stiffness
    np.testing.assert_array_equal(stiffness.toarray(), MATRIX.toarray())


def test_unknowns_are_nodes_in_order_where_nothing_names_them(index: Path) -> None:
    index.write_text(INDEX.replace("dofs: dofs.txt\n", ""))
    model = read_deck(index).model
    assert model.nodes.tolist() == [1, 2, 3]
    assert model.components.tolist() == [1, 1, 1]


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("K.mtx", "none.mtx", r"line 1: .*none\.mtx cannot be read"),
        ("K.mtx", "K.txt", r"a matrix is FILE\.mtx, FILE\.npz, FILE\.op4:NAME, FILE\.pch"),
        ("model.h5:whole/M", "model.h5", "NAME the dataset"),
        ("model.h5:whole/M", "model.h5:whole/N", "has no dataset or group 'whole/N'"),
        ("model.h5:whole/M", "model.h5:whole", "holds no matrix"),
        ("parts:", "pieces:", "unknown key `pieces`"),
        (
            "joint: {stiffness:",
            "joint: {damping:",
            "part joint needs one or several of `stiffness`, `mass`",
        ),
        ("dofs.txt", "none.txt", r"none\.txt cannot be read"),
    ],
)
def test_a_bad_index_is_told_with_its_place(index: Path, old: str, new: str, expected: str) -> None:
    index.write_text(INDEX.replace(old, new))
    with pytest.raises(ModelError, match=expected):
        read_deck(index)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("1.x\n2.x\n", "names 2 unknowns for matrices of 3"),
        ("1.x\n1.1\n2.x\n", r"line 2: 1\.1 occurs twice"),
        ("1.x\n2.q\n3.x\n", r"line 2: '2\.q' is not an unknown"),
        ("1\n2.x\n3.x\n", "line 1: '1' is not an unknown"),
    ],
)
def test_bad_names_of_unknowns_are_told(index: Path, names: str, expected: str) -> None:
    (index.parent / "dofs.txt").write_text(names)
    with pytest.raises(ModelError, match=expected):
        read_deck(index)


def test_matrices_of_different_sizes_are_refused(index: Path) -> None:
    write_matrix(index.parent, "K.mtx", sparse.csr_array(np.eye(2)))
    with pytest.raises(ModelError, match="the matrix is 3 x 3, but `stiffness` is 2 x 2"):
        read_deck(index)


@pytest.mark.parametrize("reference", ["a.mtx", "a.npz", "a.h5:x/y"])
def test_a_matrix_comes_back_as_it_was_written(tmp_path: Path, reference: str) -> None:
    matrix = sparse.csr_array(MATRIX * np.pi)
    write_matrix(tmp_path, reference, matrix)
    np.testing.assert_array_equal(read_matrix(tmp_path, reference).toarray(), matrix.toarray())


def test_dense_datasets_and_array_files_are_read(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["K"] = MATRIX.toarray()
    io.mmwrite(tmp_path / "a.mtx", MATRIX.toarray())
    for reference in ("a.h5:K", "a.mtx"):
        found = read_matrix(tmp_path, reference)
        np.testing.assert_array_equal(found.toarray(), MATRIX.toarray())


def test_what_is_no_matrix_is_an_error_of_ours(tmp_path: Path) -> None:
    write_matrix(tmp_path, "cut.npz", MATRIX)
    whole = (tmp_path / "cut.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(whole[: len(whole) // 2])
    (tmp_path / "cut.mtx").write_text("%%MatrixMarket matrix coordinate real general\n3 3 9\n1 1")
    (tmp_path / "cut.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    write_matrix(tmp_path, "half.mtx", MATRIX)
    io.mmwrite(tmp_path / "half.mtx", sparse.coo_array(sparse.triu(MATRIX)), symmetry="general")
    io.mmwrite(tmp_path / "complex.mtx", sparse.coo_array(1j * MATRIX.toarray()))
    for reference in (
        "cut.npz",
        "cut.mtx",
        "cut.h5:K",
        "other.npz",
        "half.mtx",
        "complex.mtx",
        "folder/a.npz",
    ):
        with pytest.raises(ModelError, match=reference.partition(":")[0]):
            read_matrix(tmp_path, reference)


def test_nothing_pickled_is_loaded(tmp_path: Path) -> None:
    class Trap:
        def __reduce__(self) -> Any:
            return (Path.touch, (tmp_path / "sprung",))

    data = pickle.dumps(Trap())
    with zipfile.ZipFile(tmp_path / "trap.npz", "w") as archive:
        archive.writestr("data.npy", data)
        archive.writestr("format.npy", data)
    with pytest.raises(ModelError, match=r"trap\.npz"):
        read_matrix(tmp_path, "trap.npz")
    assert not (tmp_path / "sprung").exists()


def test_parameters_are_checked_against_the_parts(deck: Reads, tmp_path: Path) -> None:
    deck(SYSTEM)
    solver = matrices_solver(tmp_path / "model.yaml", ())
    good = parameter("k", "spring_stiffness", "k1", "k2")
    assert solver.deck.problems((good, parameter("m", "mass", "m1"))) == []
    (unknown,) = solver.deck.problems((parameter("k", "spring_stiffness", "k9"),))
    assert "the model has no part k9 (there are m1, m2, k1, k2)" in unknown
    (wrong,) = solver.deck.problems((parameter("k", "mass", "k1"),))
    assert "part k1 has a spring_stiffness, which mass cannot scale" in wrong
    (twice,) = solver.deck.problems((good, parameter("j", "spring_stiffness", "k2")))
    assert twice == f"{tmp_path / 'model.yaml'}, line 5: part k2: both k and j change this number"
    assert solver.deck.deck_value(good) == 1000.0


def test_a_part_without_a_number_is_refused(index: Path) -> None:
    """Files of zeros, as an export of a group that has no stiffness leaves them."""
    write_matrix(index.parent, "lump.npz", sparse.csr_array((3, 3)))
    write_matrix(index.parent, "lump_K.npz", sparse.csr_array((3, 3)))
    solver = matrices_solver(index, ())
    (said,) = solver.deck.problems((parameter("l", "matrix_factor", "lump"),))
    assert said == (
        f"parameter l: {index}, line 6: all matrices of part lump are zero, so nothing depends on "
        "it: name other files or leave it out"
    )


def test_energies_are_claimed_only_where_stiffness_alone_is_scaled(index: Path) -> None:
    solver = matrices_solver(index, ())
    assert solver.deck.energy_sets(parameter("j", "matrix_factor", "joint")) == ("joint",)
    assert solver.deck.energy_sets(parameter("l", "matrix_factor", "lump")) == ()


def test_content_sees_numbers_and_not_how_they_are_written(deck: Reads, tmp_path: Path) -> None:
    k1, path = parameter("k1", "spring_stiffness", "k1"), tmp_path / "model.yaml"
    deck(SYSTEM)
    solver = matrices_solver(path, (k1,))
    content = solver.render({"k1": 1.0}, ModalAnalysis(2, (1,))).content
    deck(SYSTEM.replace("1_000", "1.0e3").replace("# kg", "# kilograms"))
    same = matrices_solver(path, (k1,))
    assert canonical_json(same.render({}, ModalAnalysis(2, (1,))).content) == canonical_json(
        content
    )
    deck(SYSTEM.replace("1_000", "1_001"))
    others = [
        matrices_solver(path, (k1,)).render({"k1": 1.0}, ModalAnalysis(2, (1,))).content,
        solver.render({"k1": 1.1}, ModalAnalysis(2, (1,))).content,
        solver.render({"k1": 1.0}, ModalAnalysis(1, (1,))).content,
        solver.render({"k1": 1.0}, ModalAnalysis(2, (1, 2))).content,
        solver.render({"k1": 1.0}, ModalAnalysis(2, (1,), (("k1", ("k1",)),))).content,
        solver.render({"k1": 1.0}, MatrixAnalysis()).content,
    ]
    texts = {canonical_json(item) for item in (content, *others)}
    assert len(texts) == 7


def test_the_digest_of_a_literal_model_is_pinned(deck: Reads) -> None:
    # A change here makes every stored result of the embedded solver unknown: raise the version
    # of its reader instead, if the numbers change.
    assert (
        deck(SYSTEM).model.digest
        == "bfdfac69067b9f911ff63981b3a633513f03dc7d97b17ac1e645eaca75dc6944"
    )
