"""The stabilisation diagram of a campaign's own response functions, and poles picked in it."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path

import numpy as np

from modetune.adapters.test_files.measurements import read_measurement
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import Measurement
from modetune.core.storage.keys import Json
from modetune.flows.report.chart import chart_json
from modetune.flows.studies.identify.figures import stabilisation_chart
from modetune.flows.studies.identify.identification import (
    Identification,
    IdentificationSettings,
    identify,
    write_modes,
)
from modetune.flows.studies.view.campaign_changes import Band, Change, Part


def poles_json(part: Part, band: Band, order: int) -> dict[str, Json]:
    """The diagram and the columns of it that may be picked; those of the modes that the campaign
    has are, or where it has none those that the choice without a user takes.

    Raises CampaignError.
    """
    measurement = read_measurement([path for path, _ in _stamped(part)])
    found = _identified(_stamped(part), band, order, ())
    lines = found.frfs.frequencies_hz
    enough = found.settings.criteria.least_picked
    tracks = sorted(
        (track for track in found.tracks if track.n_stable >= enough),
        key=lambda track: track.frequency_hz,
    )
    known = found.modes if measurement.modes is None else measurement.modes
    at = np.array([track.frequency_hz for track in tracks])
    limit = found.settings.criteria.frequency
    picked = {
        int(np.abs(at - hz).argmin())
        for hz in known.modes.frequencies_hz.tolist()
        if at.size and np.abs(at - hz).min() <= limit * hz
    }
    return {
        "band": [float(lines[0]), float(lines[-1])],
        "order": order,
        "chart": chart_json(stabilisation_chart("", found)),
        "tracks": [
            {"hz": float(track.frequency_hz), "damping": float(track.damping_ratio),
             "stable": track.n_stable, "picked": place in picked}
            for place, track in enumerate(tracks)
        ],
        "notes": list(found.notes),
    }  # fmt: skip


def poles_change(part: Part, band: Band, order: int, pick: Sequence[float]) -> Change:
    """Modes of the poles that were picked, in a separate file that `test.modes` then names.

    Raises CampaignError.
    """
    if not pick:
        raise CampaignError("no pole is selected")
    found = _identified(_stamped(part), band, order, tuple(sorted(pick)))
    kept, replaced = _kept(part)
    geometry = next((part.geometry for part in replaced.values() if part.geometry), None)
    stem = "-".join(filter(None, (part.source.path.stem, part.name, "picked")))
    name = f"{stem}{'.csv' if geometry is None else '.unv'}"
    functions = ", ".join(kept)
    write = partial(write_modes, part.source.path.parent / name, found, geometry, functions)
    listed = ", ".join(f"{hz:.4g}" for hz in found.modes.modes.frequencies_hz)
    notes = [f"{name} is written with {len(found.modes.numbers)} modes: {listed} Hz", *found.notes]
    test = part.at("test")
    named = [key for key in ("use", "hold_out", "pairs") if isinstance(test, dict) and key in test]
    if named:
        notes.append(
            f"modes are renumbered from 1: check {', '.join(f'test.{key}' for key in named)}"
        )
    files = [name, *(file for file in kept if file != name)]
    return part.change({("test", "modes"): files}, tuple(notes), write)


def _named(part: Part) -> list[str]:
    """The files of `test.modes`, as they are written there."""
    named = part.at("test", "modes")
    return [str(item) for item in named] if isinstance(named, list) else [str(named or "")]


def _stamped(part: Part) -> tuple[tuple[Path, int], ...]:
    """The test's files with the times they were written."""
    paths = [part.source.path.parent / name for name in _named(part)]
    return tuple((path, path.stat().st_mtime_ns if path.is_file() else 0) for path in paths)


def _kept(part: Part) -> tuple[list[str], dict[str, Measurement]]:
    """Files of the test that stay, and those whose modes are replaced."""
    kept, replaced = [], {}
    for name in _named(part):
        held = read_measurement([part.source.path.parent / name])
        if held.modes is None:
            kept.append(name)
        elif held.frfs is None:
            replaced[name] = held
        else:
            raise CampaignError(
                f"{name} holds modes and response functions; selected poles need a file "
                "that contains only the functions"
            )
    return kept, replaced


@lru_cache(maxsize=4)
def _identified(
    files: tuple[tuple[Path, int], ...], band: Band, order: int, pick: tuple[float, ...]
) -> Identification:
    paths = [path for path, _ in files]
    frfs = read_measurement(paths).frfs
    if frfs is None:
        raise CampaignError(
            f"{', '.join(path.name for path in paths)}: found no frequency response functions; add "
            "their file to `test.modes`"
        )
    return identify(frfs, IdentificationSettings(band, order, pick))
