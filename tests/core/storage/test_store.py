"""The store: whole entries or none, damage found, many at once."""

from __future__ import annotations

import multiprocessing
import threading
import time
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy import sparse

from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModesError, StorageUnavailable
from modetune.core.modes import mode_set
from modetune.core.storage.files import writing
from modetune.core.storage.keys import Json, canonical_json, content_key
from modetune.core.storage.sealed_file import read_head, sealed
from modetune.core.storage.store import TITLE, Entry, Holding, Store
from modetune.core.updating.job_results import ModalResult, Result, finite
from modetune.core.updating.parameter_matrices import (
    ParameterMatrices,
    Powers,
    parameter_matrices,
)
from modetune.core.updating.reduced_basis import ReducedModel, ReducedPart
from modetune.core.updating.sensitivity import ModeDerivatives

KEY = "ab" + "0" * 62


def modal(seed: int = 0) -> ModalResult:
    noise = np.random.default_rng(seed)
    lam = np.array([-1e-6, 2e-6, 100.0, 400.0])
    shapes = noise.normal(size=(6, 4))
    return ModalResult(
        lam,
        mode_set(
            np.sqrt(np.maximum(lam, 0)),
            shapes,
            np.repeat([1, 2], 3),
            np.tile([1, 2, 3], 2),
            normalisation="mass",
        ),
        ("wing", "fin"),
        noise.uniform(size=(2, 4)),
        noise.uniform(size=4),
        41.4,
    )


def matrices() -> MatrixResult:
    k = sparse.csr_array(np.array([[2.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]]))
    return MatrixResult.of_full(
        k, sparse.csr_array(sparse.eye_array(3, format="csr")), np.arange(1, 4), np.ones(3, int)
    )


def affine() -> ParameterMatrices:
    """Two parameters; the second's part has entries that the base lacks."""
    corner = sparse.csr_array(np.array([[0.3, 0.0, 0.1], [0.0, 0.0, 0.0], [0.0, 0.0, 0.2]]))
    first = Powers(0, (1,), (sparse.csr_array(matrices().upper_stiffness * 0.7),))
    return parameter_matrices(
        matrices(),
        np.array([1.0, 0.9]),
        [first, Powers(1, (-1, 3), (corner, 2.0 * corner))],
        [Powers(1, (1,), (corner,))],
    )


def reduced() -> ReducedModel:
    noise = np.random.default_rng(3)
    parts = [
        ReducedPart(c, p, noise.normal(size=(len(p), 4, 4))) for c, p in ((0, (1,)), (1, (-1, 3)))
    ]
    return ReducedModel(
        np.array([1.0, 0.9]),
        -3.5,
        noise.normal(size=(4, 4)),
        np.eye(4),
        tuple(parts),
        tuple(parts[1:]),
        noise.normal(size=(6, 4)),
    )


def derivatives() -> ModeDerivatives:
    return ModeDerivatives(np.ones((2, 3)), np.zeros((0, 2, 3)))


def put(store: Store, result: Result, key: str = KEY) -> None:
    store.put(Entry(key, result, "calculix", "2.20", 1.5), "{}")


def holdings(store: Store) -> list[Holding]:
    """What stands before all entries."""
    found = (store.holding(path.name.partition(".")[0]) for path in store.entries())
    return [holding for holding in found if holding is not None]


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


def test_the_digest_of_a_literal_case_never_changes() -> None:
    content: Json = {"solver": "calculix", "version": "2.20", "values": [1, 0.5], "deck": "x"}
    assert canonical_json(content) == (
        '{"deck":"x","solver":"calculix","values":[1,0.5],"version":"2.20"}'
    )
    assert content_key(canonical_json(content)) == (
        "e3497d267b0e074fba62959715c01489952f622da72791f1309fc096f1397f83"
    )


def test_keys_refuse_numbers_that_are_none() -> None:
    with pytest.raises(ValueError, match="JSON"):
        canonical_json({"x": float("nan")})


def test_a_modal_result_comes_back_to_the_last_bit(store: Store) -> None:
    put(store, modal())
    entry = store.get(KEY)
    assert entry is not None
    assert isinstance(entry.result, ModalResult)
    expected = modal()
    for name in ("eigenvalues", "strain_energies", "total_strain_energy"):
        assert np.array_equal(getattr(entry.result, name), getattr(expected, name))
    assert np.array_equal(entry.result.modes.mode_shapes, expected.modes.mode_shapes)
    assert entry.result.groups == expected.groups
    assert entry.result.modes.normalisation == "mass"
    assert (entry.solver, entry.solver_version, entry.wall_s) == ("calculix", "2.20", 1.5)


def test_matrices_and_derivatives_come_back(store: Store) -> None:
    put(store, matrices())
    put(store, derivatives(), "cd" + KEY[2:])
    first, second = store.get(KEY), store.get("cd" + KEY[2:])
    assert first is not None
    assert isinstance(first.result, MatrixResult)
    assert np.array_equal(first.result.stiffness.toarray(), matrices().stiffness.toarray())
    assert second is not None
    assert isinstance(second.result, ModeDerivatives)
    assert second.result.mode_shapes.shape == (0, 2, 3)


def test_matrices_for_all_values_come_back_to_the_last_bit(store: Store) -> None:
    put(store, affine())
    entry, expected = store.get(KEY), affine()
    assert entry is not None
    assert isinstance(entry.result, ParameterMatrices)
    theta = np.array([1.3, 0.6])
    for one, other in (
        (entry.result.base, expected.base),
        (entry.result.at(theta), expected.at(theta)),
    ):
        for name in ("upper_stiffness", "upper_mass"):
            for array in ("data", "indices", "indptr"):
                found, own = (getattr(getattr(m, name), array) for m in (one, other))
                np.testing.assert_array_equal(found, own)
                assert found.dtype == own.dtype
    for part, own in zip(
        (*entry.result.stiffness, *entry.result.mass),
        (*expected.stiffness, *expected.mass),
        strict=True,
    ):
        assert (part.column, part.powers) == (own.column, own.powers)
        np.testing.assert_array_equal(part.places, own.places)
        np.testing.assert_array_equal(part.values, own.values)


def test_a_reduced_model_comes_back_to_the_last_bit(store: Store) -> None:
    put(store, reduced())
    entry, expected = store.get(KEY), reduced()
    assert entry is not None
    assert isinstance(entry.result, ReducedModel)
    theta = np.array([1.3, 0.6])
    for found, own in zip(entry.result.at(theta), expected.at(theta), strict=True):
        np.testing.assert_array_equal(found, own)
    np.testing.assert_array_equal(entry.result.rows, expected.rows)
    assert entry.result.shift == expected.shift
    assert [part.powers for part in entry.result.mass] == [(-1, 3)]


def test_results_with_numbers_that_are_none_are_refused() -> None:
    whole: list[Result] = [matrices(), affine(), reduced(), modal(), derivatives()]
    for result in whole:
        assert finite(result) is result
    part = reduced().stiffness[0]
    part.values[0, 0, 0] = np.nan
    spoilt: list[Result] = [
        replace(matrices(), upper_mass=matrices().upper_mass * np.nan),
        replace(affine(), reference=np.array([1.0, np.inf])),
        replace(reduced(), stiffness=(part,)),
        ModeDerivatives(np.full((2, 3), np.nan), np.zeros((0, 2, 3))),
    ]
    for result in spoilt:
        with pytest.raises(ModesError, match="not finite"):
            finite(result)


def test_an_entry_that_is_dropped_is_gone(store: Store) -> None:
    put(store, modal())
    store.drop(KEY)
    store.drop(KEY)
    assert KEY not in store
    assert store.get(KEY) is None


def test_what_is_not_there_is_nothing(store: Store) -> None:
    assert store.get(KEY) is None
    assert KEY not in store


@pytest.mark.parametrize("place", [0.02, 0.3, 0.5, 0.7, 0.9])
def test_a_flipped_bit_is_never_believed(store: Store, place: float) -> None:
    put(store, modal())
    path = store.path(KEY)
    with h5py.File(path) as file:  # a byte of the data itself, wherever HDF5 put it
        shapes = file["modes/mode_shapes"][()].tobytes()
    data = bytearray(path.read_bytes())
    start = bytes(data).index(shapes)
    data[start + int(place * len(shapes))] ^= 1
    path.write_bytes(data)
    assert store.get(KEY) is None
    assert (store.folder / "damaged" / path.name).is_file()
    assert not path.exists()


@pytest.mark.parametrize("result", [affine(), reduced()], ids=["affine", "reduced"])
@pytest.mark.parametrize("place", [0.1, 0.4, 0.6, 0.8, 0.99])
def test_damage_to_what_was_made_of_matrices_is_set_aside(
    store: Store, result: Result, place: float
) -> None:
    put(store, result)
    path = store.path(KEY)
    data = bytearray(path.read_bytes())
    data[int(place * len(data))] ^= 16
    path.write_bytes(data)
    assert store.get(KEY) is None
    assert (store.folder / "damaged" / path.name).is_file()
    put(store, result)
    assert store.get(KEY) is not None


def test_an_entry_of_an_unknown_kind_is_set_aside(store: Store) -> None:
    put(store, reduced())
    path = store.path(KEY)
    head = store.path(KEY).open("rb")
    with head:
        told = read_head(head, TITLE).replace('"reduced"', '"riddle"')
    path.write_bytes(sealed(TITLE, lambda file: None, told))
    assert store.get(KEY) is None
    assert (store.folder / "damaged" / path.name).is_file()


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.99])
def test_a_cut_file_is_set_aside_and_can_be_written_again(store: Store, share: float) -> None:
    put(store, modal())
    path = store.path(KEY)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    assert store.get(KEY) is None
    put(store, modal())
    assert store.get(KEY) is not None


def test_an_entry_under_another_key_is_not_believed(store: Store) -> None:
    put(store, modal())
    other = store.path("ab" + "1" * 62)
    other.write_bytes(store.path(KEY).read_bytes())
    assert store.get("ab" + "1" * 62) is None


def test_a_file_that_only_looks_like_hdf5_is_set_aside(store: Store) -> None:
    store.path(KEY).parent.mkdir(parents=True)
    store.path(KEY).write_text("hello")
    assert store.get(KEY) is None


def test_a_full_disk_is_told_and_harms_nothing(store: Store) -> None:
    put(store, modal())

    def fill() -> None:
        with writing(store.path(KEY)) as part:
            part.write_text("half")
            with Path("/dev/full").open("w") as full:  # every write to it meets a full disk
                full.write("x")

    with pytest.raises(StorageUnavailable, match="full"):
        fill()
    assert store.get(KEY) is not None


def test_a_lock_lets_one_in_at_a_time(store: Store) -> None:
    inside, most = [0], [0]

    def work() -> None:
        for _ in range(20):
            with store.lock(KEY, lambda: time.sleep(0.001)):
                inside[0] += 1
                most[0] = max(most[0], inside[0])
                inside[0] -= 1

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == [1]


def _write_and_read(folder: str, seed: int) -> int:
    store, wrong = Store(Path(folder)), 0
    for number in range(15):
        key = f"{number:02d}" + "0" * 62
        put(store, modal(number), key)
        entry = store.get(key)
        good = entry is not None and isinstance(entry.result, ModalResult)
        wrong += not good
    return wrong + 0 * seed


def test_many_processes_write_and_read_the_same_keys(store: Store) -> None:
    with multiprocessing.get_context("spawn").Pool(3) as pool:
        wrong = pool.starmap(_write_and_read, [(str(store.folder), seed) for seed in range(3)])
    assert wrong == [0, 0, 0]
    assert not list(store.folder.glob("**/*.part"))
