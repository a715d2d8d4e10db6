"""The record of a campaign: what was written is read, all else is refused in a sentence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from modetune.core.correlation.pairing import Pairing
from modetune.core.errors import CampaignError, StoreDamaged
from modetune.core.measurement.measurement import MeasuredFrfs
from modetune.core.modes import MeasuredModes, mode_set
from modetune.core.parameters import Parameter, ParameterSet
from modetune.core.storage.campaign_record import (
    CAMPAIGN,
    CampaignRecord,
    IterationRecord,
    RunCounts,
    SensorPlaces,
    is_record,
    read_record,
    write_record,
)
from modetune.core.storage.codec import write_value
from modetune.core.storage.sealed_file import sealed
from modetune.core.surface import Surface
from modetune.core.updating.identifiability import identifiability
from modetune.core.updating.responses.response import residual_of
from modetune.core.updating.trust import StartSpread, Trust
from tests.core.storage.test_sealed_file import refused_when_damaged, resealed
from tests.node_sensors import by_number

NODES = np.array([3, 7])
#: Exact in single precision, in which surfaces and fields are kept.
SURFACE = Surface(
    np.array([3, 5, 7]),
    np.array([[0.0, 0, 0], [1, 0, 0.5], [0, 1, 0]]),
    np.array([[0, 1, 2]]),
    np.array([[0, 1], [1, 2]]),
)


def iteration(number: int, accepted: bool) -> IterationRecord:
    return IterationRecord(
        number=number,
        parameters=np.array([1.0 + 0.1 * number]),
        step=np.array([0.1]),
        computed=mode_set(
            [1.0, 2.0, 3.0], np.arange(1.0, 7.0).reshape(2, 3), NODES, [1, 1], normalisation="mass"
        ),
        pairing=Pairing(
            np.array([0, 1]),
            np.array([0, 2]),
            np.array([0.9, 0.8]),
            np.array([0.9, 0.85]),
            ("highest MAC, 0.900", "the second"),
        ),
        frequency_errors=np.array([0.02, -0.01]),
        residual=residual_of(
            "frequencies",
            ["frequency of mode 1", "frequency of mode 2"],
            None,
            np.array([0.04, -0.02]),
            np.array([3.0, 8.0]),
            np.array([3.0, 4.0]),
        ),
        sensitivity=np.array([[1.0], [0.5]]),
        sensitivity_methods=("strain_energy",),
        sensitivity_keys=("a" * 64, "b" * 64),
        sensitivity_age=1,
        sensitivity_skipped=True,
        slope=0.01,
        accepted=accepted,
        decision="e2: slope 0.01",
        regularisation=0.5,
        condition=10.0,
        modal_key="c" * 64,
        runs=RunCounts(1, 2, 3, 4.0, 5.0),
        wall_s=6.0,
        field=mode_set([1.0, 3.0], np.arange(6.0).reshape(3, 2), [3, 5, 7], [3, 3, 3]),
    )


def record() -> CampaignRecord:
    sensors = by_number(NODES, np.array([1, 1]))
    one = np.ones(1)
    return CampaignRecord(
        name="two masses",
        campaign_text="name: two masses\n# µ\n",
        settings=("update.e2=0", "run.parallel=1"),
        modetune_version="9",
        solver="scripted",
        solver_version="1.2",
        parameters=ParameterSet(
            (Parameter("k", "dimension", "property", ("4", "5"), 0.5, 2.0, 0.3, 0.9, 2),)
        ),
        deck_values=np.array([1500.0]),
        test=MeasuredModes((4, 6), mode_set([1.0, 3.0], np.eye(2), NODES, [1, 1], [0.01, 0.02])),
        iterations=(iteration(0, True), iteration(1, False), iteration(2, True)),
        status="converged",
        reason="e1 is met",
        updated=np.array([1.2]),
        standard_errors=np.array([0.01]),
        repeatability=np.array([0.01]),
        correlation=np.ones((1, 1)),
        runs=RunCounts(3, 6, 9, 12.0, 15.0),
        wall_s=20.0,
        surface=SURFACE,
        geometry=None,
        sensors=sensors,
        places=SensorPlaces(np.zeros((2, 3)), np.eye(3)[:2]),
        frfs=MeasuredFrfs(
            "accelerance",
            np.array([1.0, 2.0]),
            np.array([[1 + 1j], [2 - 1j]]),
            np.array([3]),
            np.array([1]),
            one,
            np.array([7]),
            np.array([1]),
            -one,
            np.zeros((0, 0)),
        ),
        units="m-kg-s",
        e1_frequency=0.01,
        e1_mac=0.9,
        e2=0.002,
        versions=("Python 3", "numpy 1"),
        deck_digest="d" * 64,
    )


def assert_same(one: Any, other: Any) -> None:
    """Equal field by field, all the way down."""
    assert type(one) is type(other)
    if is_dataclass(one):
        for item in fields(one):
            assert_same(getattr(one, item.name), getattr(other, item.name))
    elif isinstance(one, tuple):
        assert len(one) == len(other)
        for part, counterpart in zip(one, other, strict=True):
            assert_same(part, counterpart)
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    else:
        assert one == other or (one != one and other != other)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    write_record(tmp_path / "campaign.h5", record())
    return tmp_path / "campaign.h5"


def kept() -> CampaignRecord:
    """Return the record as a file keeps it."""
    written = record()
    # Of sets that are neither the first nor the best no field is kept.
    middle = replace(written.iterations[1], field=mode_set([]))
    return replace(written, iterations=(written.iterations[0], middle, written.iterations[2]))


def test_what_was_written_is_read(file: Path) -> None:
    assert_same(read_record(file), kept())


def test_a_record_without_model_and_sensors_is_read_without(tmp_path: Path) -> None:
    bare = replace(
        record(),
        surface=None,
        sensors=None,
        places=None,
        frfs=None,
        iterations=tuple(replace(item, field=mode_set([])) for item in record().iterations),
    )
    write_record(tmp_path / "bare.h5", bare)
    assert_same(read_record(tmp_path / "bare.h5"), bare)


def test_a_record_of_an_earlier_version_is_told_with_the_remedy(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "campaign.h5", "w") as older:
        older.attrs["format"] = 1
    with pytest.raises(CampaignError, match=r"HDF5 without a seal, .* run the campaign again"):
        read_record(tmp_path / "campaign.h5")


def test_a_record_of_another_format_is_told_with_the_remedy(file: Path) -> None:
    title = f"campaign record {CAMPAIGN.format}".encode()
    assert title in file.read_bytes()
    file.write_bytes(file.read_bytes().replace(title, b"campaign record 99"))
    said = rf"record 99, .* reads format 7 to {CAMPAIGN.format}; use the later version that"
    with pytest.raises(CampaignError, match=said):
        read_record(file)


def test_a_record_of_format_7_is_read_with_what_it_had(tmp_path: Path) -> None:
    ends = np.array([[1.1, 0.9], [1.1, 0.9], [0.9, 1.1]])
    spread = StartSpread(
        starts=np.ones((3, 2)),
        updated=ends,
        misfits=np.ones(3),
        outcomes=("a", "b", "c"),
        minima=np.array([0, 0, 1]),
        rivals=(1,),
        differ=(),
        chosen=0,
        seed=0,
        n_starts=3,
        exchanged=(),
        extent=ends[[0, 0]],
        valley=(),
    )
    values = identifiability(np.eye(2), np.ones(2), np.ones(2), np.ones(2))
    trust = Trust((), values, True, np.zeros(2), 1, (), spread=spread)

    def older(file: h5py.File) -> None:
        write_value(file, replace(record(), trust=trust))
        del file["repeatability"], file["trust/missed"], file["trust"].attrs["n_predicted"]
        del file["trust/spread"].attrs["n_starts"]
        for name in ("exchanged", "extent", "valley"):
            del file["trust/spread"][name]
        del file["covariance"], file["environment"], file["changed"]
        for name in ("ended_at", "state", "drift"):
            del file.attrs[name]

    (tmp_path / "campaign.h5").write_bytes(sealed(f"{CAMPAIGN.title}7", older))
    found = CAMPAIGN.read(tmp_path / "campaign.h5")
    assert found.trust is not None
    assert repr(found.trust.spread) == repr(spread)


def test_a_stored_record_of_format_7_is_read(tmp_path: Path) -> None:
    older = Path(__file__).parent / "campaign_7.h5"
    assert f"{CAMPAIGN.title}7".encode() in older.read_bytes()
    assert_same(read_record(older), kept())


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def without_dataset(file: h5py.File) -> None:
    del file["iterations/0002/residual/values"]


def without_attribute(file: h5py.File) -> None:
    del file["iterations/0002"].attrs["decision"]


def with_a_stranger(file: h5py.File) -> None:
    file["iterations/0001"].attrs["colour"] = "red"


def with_a_gap(file: h5py.File) -> None:
    del file["iterations/0001"]


def misshapen(file: h5py.File) -> None:
    del file["test/modes/mode_shapes"]
    file["test/modes/mode_shapes"] = np.zeros((3, 3))


def of_another_type(file: h5py.File) -> None:
    del file["deck_values"]
    file["deck_values"] = np.array([1 + 1j])


def of_an_unknown_word(file: h5py.File) -> None:
    file["parameters/parameters/0000"].attrs["quantity"] = "luck"


@pytest.mark.parametrize(
    "change",
    [
        without_dataset,
        without_attribute,
        with_a_stranger,
        with_a_gap,
        misshapen,
        of_another_type,
        of_an_unknown_word,
    ],
)
def test_content_that_does_not_fit_is_refused_in_a_sentence(
    file: Path, change: Callable[[h5py.File], None]
) -> None:
    resealed(file, change)
    with pytest.raises(StoreDamaged, match=r"campaign\.h5 is not a record of a campaign"):
        read_record(file)


def test_a_record_without_an_accepted_iteration_is_refused(tmp_path: Path) -> None:
    none = tuple(replace(item, accepted=False) for item in record().iterations)
    write_record(tmp_path / "none.h5", replace(record(), iterations=none))
    with pytest.raises(CampaignError, match="no iteration was accepted"):
        read_record(tmp_path / "none.h5")


def test_every_damage_is_one_clear_error_and_hdf5_sees_none_of_it(file: Path) -> None:
    refused_when_damaged(file, read_record)


def test_what_is_not_there_is_told(tmp_path: Path) -> None:
    for path in (tmp_path / "none.h5", tmp_path):
        with pytest.raises(CampaignError, match="is not there; a record is the campaign"):
            read_record(path)


def test_what_is_a_record_is_known_by_its_first_bytes(file: Path, tmp_path: Path) -> None:
    (tmp_path / "text.h5").write_text("hello")
    assert is_record(file)
    assert not is_record(tmp_path / "text.h5")
