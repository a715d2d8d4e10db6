"""Measured time histories, and response functions from those with forces.

With cross spectra S_xy averaged over segments (Welch 1967) and F the forces, X the responses,

    H1 = S_XF S_FF^-1,   unbiased by noise of the responses (any number of independent forces),
    H2 = S_XX / S_FX,    unbiased by noise of the one force,
    coherence = |S_XF|^2 / (S_FF S_XX); of several forces the multiple one, X_F^H S_FF^-1 X_F / S_XX

(Bendat and Piersol 2010, 6.1 and 7.3; Ewins 2000, 3.9). SciPy makes the spectra.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from modetune.core.errors import CampaignError, ModesError
from modetune.core.measurement.measurement import MeasuredFrfs
from modetune.core.measurement.response_functions import Complexes, Response
from modetune.core.modes import Floats, Integers

Estimator = Literal["h1", "h2"]
Window = Literal["hann", "boxcar"]
#: Segments that a record is cut into, half over each other, where no length is named.
SEGMENTS = 8


@dataclass(frozen=True, slots=True)
class TimeHistories:
    """One recording: channels sampled at the same times.

    step_s: between samples. values: (n_times, n_channels), SI. nodes, components, signs:
    (n_channels,), as of response functions. forces: (n_channels,), whether a channel is one; kind:
    what the others measure. where: file, and line where there is one, for messages.
    Raises ModesError where these do not fit together or a value is not finite.
    """

    step_s: float
    values: Floats
    nodes: Integers
    components: Integers
    signs: Floats
    forces: NDArray[np.bool_]
    kind: Response
    where: str

    def __post_init__(self) -> None:
        columns = (self.nodes, self.components, self.signs, self.forces)
        if self.values.ndim != 2 or any(c.shape != self.values.shape[1:] for c in columns):
            raise ModesError(f"{self.where}: the channels do not fit together")
        if not (np.isfinite(self.values).all() and self.step_s > 0.0):
            raise ModesError(f"{self.where}: a sample is not a finite number")


def response_functions(
    runs: Sequence[TimeHistories],
    estimator: Estimator = "h1",
    segment_s: float | None = None,
    window: Window = "hann",
) -> MeasuredFrfs:
    """Response functions of recordings with forces; those with the same forces are averaged.

    segment_s: length of a segment, an eighth of the shortest recording where None. Raises
    CampaignError where recordings do not allow it.
    """
    first = runs[0]
    for run in runs:
        if run.step_s != first.step_s or run.kind != first.kind:
            raise CampaignError(
                f"{run.where} has other samples or measures other quantities than {first.where}"
            )
        if not run.forces.any() or run.forces.all():
            raise CampaignError(f"{run.where}: response functions require a force and a response")
    shortest = min(run.values.shape[0] for run in runs)
    length = shortest // SEGMENTS if segment_s is None else round(segment_s / first.step_s)
    if not 16 <= length <= shortest:
        raise CampaignError(
            f"segments of {length} samples: the length is not between 16 and {shortest}, the "
            f"shortest recording ({first.where})"
        )
    sets: dict[tuple[bytes, ...], list[TimeHistories]] = {}
    for run in runs:
        sets.setdefault(tuple(a.tobytes() for a in _channels(run)), []).append(run)
    found = [_functions(group, estimator, length, window) for group in sets.values()]
    values, coherences, names = zip(*found, strict=True)
    columns = np.hstack(names)
    told = all(item.size for item in coherences)
    return MeasuredFrfs(
        kind=first.kind,
        frequencies_hz=np.fft.rfftfreq(length, first.step_s)[1:],
        values=np.hstack(values)[1:],
        nodes=columns[0].astype(np.int64),
        components=columns[1].astype(np.int64),
        signs=columns[2].astype(np.float64),
        reference_nodes=columns[3].astype(np.int64),
        reference_components=columns[4].astype(np.int64),
        reference_signs=columns[5].astype(np.float64),
        coherences=np.hstack(coherences)[1:] if told else np.zeros((0, 0)),
    )


def _channels(run: TimeHistories) -> tuple[NDArray[np.generic], ...]:
    return run.nodes, run.components, run.signs, run.forces


def _functions(
    runs: Sequence[TimeHistories], estimator: Estimator, length: int, window: Window
) -> tuple[Complexes, Floats, NDArray[np.float64]]:
    """Functions (n_lines, n_functions), coherences alike, and names (6, n_functions)."""
    overlap = length // 2 if window == "hann" else 0
    n_segments = 0
    whole: Complexes | None = None
    for run in runs:
        count = (run.values.shape[0] - overlap) // (length - overlap)
        _, part = scipy.signal.csd(
            run.values[:, :, None],
            run.values[:, None, :],
            window=window,
            nperseg=length,
            noverlap=overlap,
            axis=0,
        )
        whole = count * part if whole is None else whole + count * part
        n_segments += count
    assert whole is not None
    run, force = runs[0], np.flatnonzero(runs[0].forces)
    motion = np.flatnonzero(~run.forces)
    if estimator == "h2" and force.size > 1:
        raise CampaignError(f"H2 is for one force; {run.where} has {force.size}")
    if n_segments <= force.size:
        raise CampaignError(
            f"{run.where}: {n_segments} segments cannot separate {force.size} forces from noise: "
            "use shorter segments, or more recordings"
        )
    s_ff, s_fx = whole[:, force[:, None], force], whole[:, force[:, None], motion]
    s_xx = whole[:, motion, motion].real
    try:
        h1 = np.linalg.solve(s_ff, s_fx)
    except np.linalg.LinAlgError as error:
        raise CampaignError(f"{run.where}: its forces follow from each other") from error
    explained = np.sum(s_fx.conj() * h1, axis=1).real
    coherence = np.clip(explained / np.where(s_xx > 0.0, s_xx, np.inf), 0.0, 1.0)
    functions = h1 if estimator == "h1" else s_xx[:, None, :] / s_fx.conj()
    names = [
        [float(a[k]) for k in (m, f) for a in (run.nodes, run.components, run.signs)]
        for f in force
        for m in motion
    ]
    flat = functions.reshape(functions.shape[0], -1)
    return flat, np.tile(coherence, (1, force.size)), np.array(names).T
