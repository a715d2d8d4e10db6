"""What modes are identified from: response functions, as they are or from time histories, and
which of them can be fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from modetune.adapters.test_files.file_kind import kind_of
from modetune.adapters.test_files.measurements import (
    inspect_files,
    read_histories,
    read_measurement,
)
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import MeasuredFrfs, Measurement
from modetune.core.measurement.time_histories import (
    Estimator,
    TimeHistories,
    Window,
    response_functions,
)
from modetune.core.modes import dof_name


@dataclass(frozen=True, slots=True)
class SpectraSettings:
    """How time histories become response functions; None where nothing was asked."""

    estimator: Estimator | None = None
    segment_s: float | None = None
    window: Window | None = None


def read_functions(
    paths: Sequence[Path], asked: SpectraSettings
) -> tuple[Measurement, TimeHistories | None]:
    """A test with response functions; or one without, and the responses to unknown forces.

    Raises CampaignError with file and line.
    """
    names = ", ".join(map(str, paths))
    runs, notes = read_histories(paths)
    if not runs:
        measurement = read_measurement(paths)
        if measurement.frfs is None:
            missing = f"{names}: no response functions and no time histories are in there"
            raise CampaignError([missing, *measurement.notes, *notes])
        if asked != SpectraSettings():
            raise CampaignError(
                f"{names}: --estimator, --segment and --window are for time histories, and these "
                "are response functions"
            )
        return measurement, None
    universal = [path for path in paths if kind_of(path).form == "universal"]
    whole = inspect_files(universal).measurement if universal else Measurement()
    test = Measurement(geometry=whole.geometry, notes=tuple(notes))
    if not any(run.forces.any() for run in runs):
        if len(runs) > 1 or asked != SpectraSettings():
            raise CampaignError(
                f"{names}: responses without forces are identified from one recording (there are "
                f"{len(runs)}), and have no response functions for --estimator, --segment, --window"
            )
        return test, runs[0]
    estimator, window = asked.estimator or "h1", asked.window or "hann"
    frfs = response_functions(runs, estimator, asked.segment_s, window)
    text = (
        f"{frfs.values.shape[1]} response functions ({estimator.upper()}, {window}, lines of "
        f"{frfs.frequencies_hz[0]:.4g} Hz) from {len(runs)} recordings"
    )
    return replace(test, frfs=frfs, notes=(*test.notes, text)), None


def functions_in_band(
    frfs: MeasuredFrfs, band_hz: tuple[float, float] | None
) -> tuple[MeasuredFrfs, list[str]]:
    """The functions that can be fitted: lines above 0 Hz in the band, signs applied, none zero."""
    if frfs.values.shape[1] == 0:
        raise CampaignError("there are no response functions to identify modes from")
    _check_directions(frfs)
    lines = frfs.frequencies_hz
    low, high = band_hz or (float(lines[0]), float(lines[-1]))
    kept = (lines >= low) & (lines <= high) & (lines > 0.0)
    if not low < high or np.count_nonzero(kept) < 6:
        raise CampaignError(
            f"{np.count_nonzero(kept)} lines of the response functions lie in the band {low:g} to "
            f"{high:g} Hz, at least 6 are needed; they reach from {lines[0]:g} to {lines[-1]:g} Hz"
        )
    values = frfs.values[kept] * frfs.signs * frfs.reference_signs
    alive = np.flatnonzero(np.abs(values).max(axis=0) > 0.0)
    if alive.size == 0:
        raise CampaignError("all response functions are zero in the band: nothing was measured")
    ones = np.ones(alive.size)
    used = MeasuredFrfs(
        frfs.kind,
        lines[kept],
        values[:, alive],
        frfs.nodes[alive],
        frfs.components[alive],
        ones,
        frfs.reference_nodes[alive],
        frfs.reference_components[alive],
        ones,
        frfs.coherences[kept][:, alive] if frfs.coherences.size else frfs.coherences,
    )
    left_out = [
        f"{dof_name((int(frfs.nodes[place]), int(frfs.components[place])))} is zero in the band "
        "and was left out"
        for place in np.setdiff1d(np.arange(frfs.nodes.size), alive)
    ]
    return used, left_out


def _check_directions(frfs: MeasuredFrfs) -> None:
    if ((frfs.components < 1) | (frfs.components > 6)).any():
        raise CampaignError("a response function lacks the direction of its sensor (1 to 6)")
    if ((frfs.reference_components < 1) | (frfs.reference_components > 6)).any():
        raise CampaignError(
            "a response function names no reference: where, and in which direction, the force acts"
        )
