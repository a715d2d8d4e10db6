"""Which of a test's response functions can be fitted, and what they are called."""

from __future__ import annotations

import numpy as np

from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import MeasuredFrfs
from modetune.core.modes import dof_name


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
        raise CampaignError(
            "a response function does not tell in which direction its sensor measures (1 to 6)"
        )
    if ((frfs.reference_components < 1) | (frfs.reference_components > 6)).any():
        raise CampaignError(
            "a response function names no reference: where, and in which direction, the force acts"
        )
