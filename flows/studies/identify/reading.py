"""What modes are identified from: response functions, as they are or from time histories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from modetune.adapters.test_files.histories import read_histories
from modetune.adapters.test_files.kinds import kind_of
from modetune.adapters.test_files.measurements import inspect_files, read_measurement
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import Measurement
from modetune.core.measurement.time_histories import (
    Estimator,
    TimeHistories,
    Window,
    response_functions,
)


@dataclass(frozen=True, slots=True)
class SpectraSettings:
    """How time histories become response functions; None where nothing was asked."""

    estimator: Estimator | None = None
    segment_s: float | None = None
    window: Window | None = None


def spectra_settings(
    estimator: str | None, segment_s: float | None, window: str | None
) -> SpectraSettings:
    """Settings by their names. Raises CampaignError."""
    if estimator not in (None, "h1", "h2"):
        raise CampaignError(f"--estimator {estimator!r}: expected h1 or h2")
    if window not in (None, "hann", "boxcar"):
        raise CampaignError(f"--window {window!r}: expected hann or boxcar")
    return SpectraSettings(
        {"h1": "h1", "h2": "h2"}.get(estimator or ""),  # type: ignore[arg-type]
        segment_s,
        {"hann": "hann", "boxcar": "boxcar"}.get(window or ""),  # type: ignore[arg-type]
    )


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
    said = (
        f"{frfs.values.shape[1]} response functions ({estimator.upper()}, {window}, lines of "
        f"{frfs.frequencies_hz[0]:.4g} Hz) from {len(runs)} recordings"
    )
    return replace(test, frfs=frfs, notes=(*test.notes, said)), None
