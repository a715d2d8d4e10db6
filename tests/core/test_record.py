"""The record of a campaign: what was written is read, old files too, damaged ones are refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from modetune.core.errors import CampaignError
from modetune.core.measurement import MeasuredFrfs
from modetune.core.modes import MeasuredModes, mode_set
from modetune.core.pairing import Pairing
from modetune.core.parameters import Parameter, ParameterSet
from modetune.core.record import CampaignRecord, IterationRecord, RunCounts, SensorPlaces
from modetune.core.record_file import read_record, write_record
from modetune.core.residual import Residual
from modetune.core.sensors import by_number
from modetune.core.surface import Surface

NODES = np.array([3, 7])
#: Exact in single precision, in which surfaces and fields are kept.
SURFACE = Surface(
    np.array([3, 5, 7]), np.array([[0.0, 0, 0], [1, 0, 0.5], [0, 1, 0]]), np.array([[0, 1, 2]]),
    np.array([[0, 1], [1, 2]]),
)  # fmt: skip


def iteration(number: int, accepted: bool) -> IterationRecord:
    return IterationRecord(
        number=number,
        parameters=np.array([1.0 + 0.1 * number]),
        step=np.array([0.1]),
        computed=mode_set([1.0, 2.0, 3.0], np.arange(1.0, 7.0).reshape(2, 3), NODES, [1, 1],
                          normalisation="mass"),
        pairing=Pairing(np.array([0, 1]), np.array([0, 2]), np.array([0.9, 0.8]),
                        np.array([0.9, 0.85]), ("highest MAC, 0.900", "the second")),
        frequency_errors=np.array([0.02, -0.01]),
        residual=Residual(np.array([0.04, -0.02]), np.array([1.0, 2.0]), np.array([3.0, 4.0]), 2),
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
    )  # fmt: skip


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
        correlation=np.ones((1, 1)),
        runs=RunCounts(3, 6, 9, 12.0, 15.0),
        wall_s=20.0,
        surface=SURFACE,
        geometry=None,
        sensors=sensors,
        places=SensorPlaces(np.zeros((2, 3)), np.eye(3)[:2]),
        frfs=MeasuredFrfs("accelerance", np.array([1.0, 2.0]), np.array([[1 + 1j], [2 - 1j]]),
                          np.array([3]), np.array([1]), one, np.array([7]), np.array([1]),
                          -one, np.zeros((0, 0))),
        units="m-kg-s",
        e1_frequency=0.01,
        e1_mac=0.9,
        e2=0.002,
        versions=("Python 3", "numpy 1"),
        deck_digest="d" * 64,
    )  # fmt: skip


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


def test_what_was_written_is_read(file: Path) -> None:
    written = record()
    # Of sets that are neither the first nor the best no field is kept.
    middle = replace(written.iterations[1], field=mode_set([]))
    kept = replace(written, iterations=(written.iterations[0], middle, written.iterations[2]))
    assert_same(read_record(file), kept)


def test_a_record_without_model_and_sensors_is_read_without(tmp_path: Path) -> None:
    bare = replace(record(), surface=None, sensors=None, places=None, frfs=None,
                   iterations=tuple(replace(item, field=mode_set([]))
                                    for item in record().iterations))  # fmt: skip
    write_record(tmp_path / "bare.h5", bare)
    assert_same(read_record(tmp_path / "bare.h5"), bare)


def test_a_file_of_before_reads_with_empty_fields(file: Path) -> None:
    with h5py.File(file, "a") as older:
        for name in ("model", "sensors", "sensor_places", "test/frfs", "test/damping_ratios",
                     "iterations/000/field", "iterations/000/elastic_shapes",
                     "iterations/000/variances", "parameters/targets", "parameters/by",
                     "parameters/items", "parameters/deviations"):  # fmt: skip
            del older[name]
        for name in ("units", "deck_digest", "versions", "e1_frequency", "e2"):
            del older.attrs[name]
    read = read_record(file)
    assert (read.surface, read.sensors, read.frfs, read.units) == (None, None, None, "")
    assert np.isnan(read.e2)
    assert read.parameters.names == ("k",)
    assert read.parameters.parameters[0].by == "property"  # what a dimension is given by first
    first = read.iterations[0]
    assert first.field.n_dof == 0
    # Shapes of the pairs 0 and 2 stand in the file, that of mode 1 does not.
    assert first.computed.mode_shapes.tolist() == [[1.0, 0.0, 3.0], [4.0, 0.0, 6.0]]


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def without_group(file: Path) -> None:
    with h5py.File(file, "a") as damaged:
        del damaged["iterations/002/residual"]


def misshapen(file: Path) -> None:
    with h5py.File(file, "a") as damaged:
        del damaged["test/mode_shapes"]
        damaged["test/mode_shapes"] = np.zeros((3, 3))


def nothing_kept(file: Path) -> None:
    with h5py.File(file, "a") as damaged:
        for group in damaged["iterations"].values():
            group.attrs["accepted"] = False


@pytest.mark.parametrize("damage", [cut, without_group, misshapen, nothing_kept])
def test_a_damaged_record_is_refused_in_a_sentence(
    file: Path, damage: Callable[[Path], None]
) -> None:
    damage(file)
    with pytest.raises(CampaignError, match=r"campaign\.h5 is no record of a campaign .* damaged"):
        read_record(file)


def test_what_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(CampaignError, match="is not there; a record is a campaign"):
        read_record(tmp_path / "none.h5")


def test_a_record_of_a_later_format_names_the_version_that_wrote_it(file: Path) -> None:
    with h5py.File(file, "a") as later:
        later.attrs["format"] = 2
    with pytest.raises(CampaignError, match="written by modetune 9,"):
        read_record(file)
