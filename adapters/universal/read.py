"""A test from universal files: points, modes and functions, in one file or in several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from modetune.adapters.universal.contents import Function, UniversalFile
from modetune.adapters.universal.file import read_file
from modetune.adapters.universal.functions import frfs
from modetune.adapters.universal.geometry import geometry
from modetune.adapters.universal.modes import modes
from modetune.core.errors import CampaignError, ModesError
from modetune.core.measurement import Measurement
from modetune.core.modes import Floats


@dataclass(frozen=True, slots=True)
class UniversalTest:
    """A test with its files and, of complex modes, how collinear their phases are, (n_modes,)."""

    measurement: Measurement
    files: tuple[UniversalFile, ...]
    collinearity: Floats
    n_functions: int


def read_universal(paths: Sequence[Path]) -> UniversalTest:
    """Read files as one test. Raises CampaignError with file and line."""
    files = tuple(read_file(path) for path in paths)
    notes = [note for file in files for note in file.notes]
    try:
        points, responses, found = geometry(files, notes), frfs(files, notes), modes(files, notes)
    except ModesError as error:
        raise CampaignError(f"{', '.join(map(str, paths))}: {error}") from error
    measured = None if found is None else found.measured
    if points is not None and measured is not None:
        shapes = np.unique(measured.modes.nodes)
        unmeasured = np.setdiff1d(points.nodes, shapes)
        if unmeasured.size:
            notes.append(f"{unmeasured.size} of {points.nodes.size} points have no shape")
        lost = np.setdiff1d(shapes, points.nodes)
        if lost.size:
            notes.append(f"doubtful: {lost.size} nodes have a shape and no place")
    return UniversalTest(
        Measurement(measured, points, responses, tuple(notes)),
        files,
        np.zeros(0) if found is None else found.collinearity,
        sum(isinstance(item, Function) for file in files for item in file.contents),
    )
