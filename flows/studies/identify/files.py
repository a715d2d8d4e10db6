"""Identified modes as a test file that campaigns read."""

from __future__ import annotations

from pathlib import Path

from modetune.adapters.test_files import writing
from modetune.core.measurement.measurement import TestGeometry
from modetune.flows.studies.identify.identify import Identification


def write_modes(
    path: Path, found: Identification, geometry: TestGeometry | None, source: str
) -> None:
    """Write the real modes. Raises StorageUnavailable, CampaignError for an unknown ending."""
    writing.write_modes(path, found.modes, geometry, comments(found, source))


def comments(found: Identification, source: str) -> tuple[str, ...]:
    """Source, settings and quality, a line each."""
    lines, settings = found.frfs.frequencies_hz, found.settings
    limits = settings.criteria
    names = " ".join(source.split())
    chosen = f"nearest to {', '.join(map(str, settings.pick))} Hz" if settings.pick else "automatic"
    collinear = ", ".join(f"{value:.3f}" for value in found.phase_collinearity)
    worst = int(found.worst_functions[0])
    scale = {"mass": "unit modal mass in kg", "max": "largest entry 1"}
    return (
        f"identified by modetune from {names}",
        f"{found.frac.size} functions ({found.frfs.kind}), {lines[0]:g} to {lines[-1]:g} Hz, "
        f"{lines.size} lines, least-squares complex frequency, order {settings.order}",
        f"stable poles: frequency {limits.frequency:g}, damping {limits.damping:g}, shape "
        f"{limits.shape:g}; choice: {chosen}",
        f"shapes: {scale.get(found.modes.modes.normalisation, 'any scale')}; modal phase "
        f"collinearity {collinear}",
        f"FRAC: mean {found.frac.mean():.4f}, least {found.frac[worst]:.4f} at "
        f"{found.function_name(worst)}",
        *found.notes,
    )
