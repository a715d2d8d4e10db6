"""Dataclasses of arrays as groups of an HDF5 file."""

from __future__ import annotations

from dataclasses import fields
from typing import TypeVar

import h5py
import numpy as np

from modetune.core.geometry import TestGeometry
from modetune.core.held_out import HeldOut
from modetune.core.measurement import MeasuredFrfs
from modetune.core.modes import ModeSet, mode_set
from modetune.core.record import SensorPlaces
from modetune.core.sensors import SensorMap
from modetune.core.surface import Surface

Parts = TypeVar("Parts", Surface, TestGeometry, SensorMap, SensorPlaces, MeasuredFrfs, HeldOut)


def write_parts(group: h5py.Group, name: str, parts: Parts | None) -> None:
    """A dataclass of arrays as a group, field by field; texts and numbers are attributes.

    Nothing is written for None; the floats of a surface are for pictures, in single precision.
    """
    if parts is None:
        return
    made = group.create_group(name)
    for item in fields(parts):
        value = getattr(parts, item.name)
        if isinstance(value, np.ndarray):
            slim = isinstance(parts, Surface) and value.dtype == np.float64
            made[item.name] = value.astype(np.float32) if slim else value
        else:
            made.attrs[item.name] = value


def read_parts(group: h5py.Group, name: str, kind: type[Parts]) -> Parts | None:
    """What write_parts wrote under a name, None where nothing was."""
    if name not in group:
        return None
    found, values = group[name], {}
    for item in fields(kind):
        value = found[item.name][()] if item.name in found else found.attrs[item.name]
        slim = isinstance(value, np.ndarray) and value.dtype == np.float32
        values[item.name] = value.astype(np.float64) if slim else value
    return kind(**values)


def write_modes(group: h5py.Group, modes: ModeSet, digits: str = "") -> None:
    """Frequencies, shapes and their degrees of freedom; digits: "f4" for pictures."""
    group["frequencies_hz"] = modes.frequencies_hz
    group["mode_shapes"] = modes.mode_shapes.astype(digits) if digits else modes.mode_shapes
    group["nodes"] = modes.nodes
    group["components"] = modes.components
    group["damping_ratios"] = modes.damping_ratios
    group.attrs["normalisation"] = modes.normalisation


def read_modes(group: h5py.Group) -> ModeSet:
    """What write_modes wrote; files of before have neither damping nor normalisation."""
    return mode_set(
        group["frequencies_hz"][()],
        group["mode_shapes"][()],
        group["nodes"][()],
        group["components"][()],
        group["damping_ratios"][()] if "damping_ratios" in group else (),
        group.attrs.get("normalisation", "unknown"),
    )


def texts(group: h5py.Group, name: str) -> list[str]:
    """A dataset of texts."""
    return [str(text) for text in group[name].asstr()[()]]
