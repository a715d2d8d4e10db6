"""Modes from responses to unknown forces: subspace identification by pyOMA2.

Poles of all orders (`pole_estimators.py`) are judged and followed as those of response functions:
of each track the stable pole of middle frequency and its shape are the mode, since single orders
split poles of close modes. Shapes have no scale that forces would give: their largest entry is 1.

Standard deviations are the jackknife's (Efron 1982): the modes, as means over their orders, are
found again from the recording without one of its parts, for each part. On simulated chains they
were 1.1 to 2.4 times the scatter of repeated recordings. Another day's conditions are not in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy

from modetune.adapters.pole_estimators import PolesOfOrder, ssi_poles, ssi_poles_of_parts
from modetune.adapters.test_files import measurements
from modetune.adapters.test_files.file_kind import SUFFIXES
from modetune.core.brief import brief
from modetune.core.correlation.complexity import modal_phase_collinearity, real_shapes
from modetune.core.correlation.correlation import auto_mac
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import MeasuredDeviations, Measurement
from modetune.core.measurement.response_functions import Complexes
from modetune.core.measurement.stabilisation import (
    OrderPoles,
    Stability,
    Track,
    follow_poles,
    judge_orders,
    physical_poles,
    pick_tracks,
)
from modetune.core.measurement.time_histories import TimeHistories
from modetune.core.modes import Floats, Integers, MeasuredModes, ModeSet, dof_name, mode_set
from modetune.flows.studies.identify.identification import (
    Identification,
    IdentificationSettings,
    identify,
    write_modes,
)

#: Samples in a period of the highest frequency of interest.
SAMPLES = 2.5
#: Block rows that are used at least; more where the channels are few for the order.
BLOCK_ROWS = 30
#: Pairs of poles that distinguish a structure from noise; more split the poles of modes.
MOST_ORDER = 30
#: Samples of a segment of the spectra that figures show: 1,024 lines, more than pixels.
SEGMENT = 2048
#: Parts of the jackknife: at most, and at least; fewer say little of the scatter.
MOST_PARTS, LEAST_PARTS = 20, 8
#: Samples of a part, per block row at least; rows and channels of a matrix that is decomposed fast.
PART_ROWS, FAST = 20, 800
#: Share of its orders and of the parts in which a mode must be found again, within this change of
#: its pole and with this MAC.
FOUND, NEAR, ALIKE = 0.8, 0.05, 0.9
#: A mode is stable at one in four orders at least; noise reached one in five.
LASTING = 4


@dataclass(frozen=True, slots=True, repr=False)
class OperationalModes:
    """Modes of responses to unknown forces.

    modes: real shapes, damping, ascending in frequency. phase_collinearity, stable_orders:
    (n_modes,). auto_mac: (n_modes, n_modes). tracks: all; orders: the poles of each. lines_hz,
    spectrum: (n_lines,), the sum of the responses' spectra in the band. notes: for people.
    deviations: None for a short recording.
    """

    modes: MeasuredModes
    phase_collinearity: Floats
    auto_mac: Floats
    stable_orders: tuple[int, ...]
    tracks: tuple[Track, ...]
    orders: tuple[OrderPoles, ...]
    lines_hz: Floats
    spectrum: Floats
    notes: tuple[str, ...]
    deviations: MeasuredDeviations | None = None

    __repr__ = brief


def identify_test(
    test: Measurement,
    outputs: TimeHistories | None,
    settings: IdentificationSettings,
    files: Sequence[Path] = (),
    out: Path | None = None,
    figures: Path | None = None,
) -> tuple[Identification | OperationalModes, tuple[Path, ...]]:
    """Identify the modes of a test's response functions, or of outputs of unknown forces.

    files: of the test; out: a test file for the modes; figures: a folder. Returns the modes, and
    the figures as files. Raises CampaignError where there are neither functions nor outputs or
    these do not determine modes; StorageUnavailable.
    """
    if out is not None:
        measurements.check_out(out)
    found: Identification | OperationalModes
    drawn: tuple[Path, ...] = ()
    title = ", ".join(path.name for path in files)
    if outputs is not None:
        found = operational_modes(outputs, settings)
        if figures is not None:
            from modetune.flows.studies.identify.figures import write_operational_figures

            spectrum = found.lines_hz, found.spectrum
            drawn = write_operational_figures(
                figures, title, found.modes, found.auto_mac, found.orders, spectrum
            )
    elif test.frfs is None:
        raise CampaignError("the test has no frequency response functions to identify modes from")
    else:
        found = identify(test.frfs, settings)
        if figures is not None:
            from modetune.flows.studies.identify.figures import write_figures

            drawn = write_figures(figures, title, found)
    if out is not None:
        _write(out, found, test, ", ".join(map(str, files)))
    return found, drawn


def _write(
    path: Path, found: Identification | OperationalModes, test: Measurement, source: str
) -> None:
    """Write identified modes as a test file."""
    if isinstance(found, Identification):
        write_modes(path, found, test.geometry, source)
    else:
        text = f"identified by modetune from {' '.join(source.split())}", *test.notes, *found.notes
        deviations = None if SUFFIXES[path.suffix.lower()] == "universal" else found.deviations
        geometry = None if path.suffix.lower() == ".csv" else test.geometry
        whole = Measurement(found.modes, geometry, None, text, deviations)
        measurements.write_test(path, whole, text)


def operational_modes(run: TimeHistories, settings: IdentificationSettings) -> OperationalModes:
    """Identify modes of a recording. Raises CampaignError where it does not allow that."""
    step, values = run.step_s, run.values[:, ~run.forces] * run.signs[~run.forces]
    top = 0.5 / step
    low, high = settings.band_hz or (0.0, top)
    if not low < min(high, top):
        raise CampaignError(f"--band {low:g} {high:g}: the recording reaches up to {top:g} Hz")
    still = np.flatnonzero(values.std(axis=0) == 0.0)
    nodes, components = run.nodes[~run.forces], run.components[~run.forces]
    if still.size:
        dof = int(nodes[still[0]]), int(components[still[0]])
        raise CampaignError(f"{run.where}: channel {dof_name(dof)} measured nothing")
    every = int(1.0 / (SAMPLES * high * step))
    if every > 1:
        values, step = scipy.signal.decimate(values, every, ftype="fir", axis=0), step * every
    criteria, order = settings.criteria, min(settings.order, MOST_ORDER)
    rows = max(BLOCK_ROWS, -(-2 * order // values.shape[1]) + 1)
    found = ssi_poles(values, step, order, rows)
    judged = judge_orders(_physical(found, (low, high), criteria.largest_damping), criteria)
    tracks = follow_poles(judged, criteria)
    # The share of a pole in the responses is unknown here, so poles must be stable at more orders.
    enough = criteria.least_stable or max(criteria.least_picked, order // LASTING)
    chosen = [k for k, track in enumerate(tracks) if track.n_stable >= enough]
    if settings.pick:
        chosen = list(pick_tracks(tracks, settings.pick, criteria))
    if not chosen:
        raise CampaignError(
            f"no pole is stable over {enough} orders up to {order}: record longer, or name a "
            "narrower --band"
        )
    stable = [_stable(tracks[place], judged) for place in chosen]
    middles = [_middle(poles) for poles in stable]
    at = np.argsort([abs(middle.pole) for middle in middles])
    poles = np.array([middles[place].pole for place in at])
    shapes = np.column_stack([middles[place].shape for place in at])
    real = real_shapes(shapes)
    real = real / real[np.abs(real).argmax(axis=0), np.arange(poles.size)]
    modes = mode_set(
        np.abs(poles) / (2.0 * np.pi), real, nodes, components, -poles.real / np.abs(poles), "max"
    )
    length = min(values.shape[0], SEGMENT)
    lines, spectra = scipy.signal.welch(values, 1.0 / step, nperseg=length, axis=0)
    inside = (lines > 0.0) & (lines >= low) & (lines <= high)
    seconds = run.values.shape[0] * run.step_s
    notes = (
        f"output only: {seconds:.4g} s of {values.shape[1]} channels at {1.0 / step:.4g} Hz, "
        f"subspace identification of covariances, orders up to {order}, {rows} block rows",
        "shapes have no scale, because the forces were not measured",
        *_short_recording(modes, seconds),
    )
    return OperationalModes(
        modes=MeasuredModes(tuple(range(1, poles.size + 1)), modes),
        phase_collinearity=modal_phase_collinearity(shapes),
        auto_mac=auto_mac(real),
        stable_orders=tuple(tracks[chosen[place]].n_stable for place in at),
        tracks=tracks,
        orders=judged,
        lines_hz=lines[inside],
        spectrum=spectra[inside].sum(axis=1),
        notes=notes,
        deviations=_deviations(values, step, rows, [stable[place] for place in at]),
    )


def _physical(
    found: Sequence[PolesOfOrder], band_hz: tuple[float, float], largest_damping: float
) -> list[OrderPoles]:
    """Return the poles of each order that a structure can have."""
    orders = []
    for number, (poles, shapes) in enumerate(found, start=1):
        kept = physical_poles(poles, band_hz, largest_damping)
        columns = [int(np.flatnonzero(poles == pole)[0]) for pole in kept]
        none = np.zeros(kept.size, dtype=np.int64)
        orders.append(OrderPoles(number, kept, shapes[:, columns], none))
    return orders


def _short_recording(modes: ModeSet, seconds: float) -> list[str]:
    """Return a note where a recording is short for the first mode's damping."""
    periods = float(modes.frequencies_hz[0] * seconds)
    if periods * float(modes.damping_ratios[0]) >= 3.0:
        return []
    return [
        f"the recording holds {periods:.3g} periods of mode 1: its damping is uncertain by a "
        "quarter and more; record longer"
    ]


@dataclass(frozen=True, slots=True)
class _Pole:
    """A pole, its shape (n_channels,), and the order that has it."""

    pole: complex
    shape: Complexes
    order: int


def _middle(poles: list[_Pole]) -> _Pole:
    """Return the pole of middle frequency."""
    return sorted(poles, key=lambda item: abs(item.pole))[len(poles) // 2]


def _stable(track: Track, orders: tuple[OrderPoles, ...]) -> list[_Pole]:
    """Return the stable poles of a track."""
    return [
        _Pole(complex(orders[place].poles[pole]), orders[place].shapes[:, pole], place + 1)
        for place, pole in track.places.tolist()
        if orders[place].stability[pole] == Stability.STABLE
    ]


def _deviations(
    values: Floats, step_s: float, rows: int, modes: Sequence[list[_Pole]]
) -> MeasuredDeviations | None:
    """Return the deviations of modes by the jackknife; NaN where a mode is not found again.

    modes: the stable poles of each.
    """
    most = MOST_PARTS if rows * values.shape[1] <= FAST else LEAST_PARTS
    parts = min(most, values.shape[0] // (PART_ROWS * rows))
    if parts < LEAST_PARTS:
        return None
    frequencies = np.full((parts, len(modes)), np.nan)
    shapes = np.full((parts, len(modes), values.shape[1]), np.nan)
    order = max(pole.order for mode in modes for pole in mode)
    for part, found in enumerate(ssi_poles_of_parts(values, step_s, order, rows, parts)):
        for column, mode in enumerate(modes):
            again = list(filter(None, (_again(pole, *found[pole.order - 1]) for pole in mode)))
            if len(again) < FOUND * len(mode):
                continue
            middle = _middle(mode)
            frequencies[part, column] = np.mean([abs(item.pole) for item in again])
            frequencies[part, column] /= abs(middle.pole)
            every = np.column_stack([middle.shape, *(item.shape for item in again)])
            whole, *others = real_shapes(every).T
            scaled = [other * (other @ whole) / (other @ other) for other in others]
            shapes[part, column] = np.mean(scaled, axis=0) / np.sqrt(np.mean(whole**2))
    seen = np.isfinite(frequencies).sum(axis=0)
    enough = seen >= FOUND * parts
    of_frequencies = _jackknife(frequencies, seen)
    of_shapes = np.sqrt(np.mean(_jackknife(shapes, seen[:, None]) ** 2, axis=1))
    return MeasuredDeviations(
        np.where(enough, of_frequencies, np.nan), np.where(enough, of_shapes, np.nan)
    )


def _again(pole: _Pole, poles: Complexes, shapes: Complexes) -> _Pole | None:
    """Return the pole most like another one by frequency and shape; None where none is alike."""
    away = np.abs(poles - pole.pole) / abs(pole.pole)
    alike = np.abs(pole.shape.conj() @ shapes) ** 2
    alike /= np.sum(np.abs(shapes) ** 2, axis=0) * np.sum(np.abs(pole.shape) ** 2)
    near = int((away + (1.0 - alike)).argmin())
    if away[near] > NEAR or alike[near] < ALIKE:
        return None
    return _Pole(complex(poles[near]), shapes[:, near], pole.order)


def _jackknife(values: Floats, seen: Integers) -> Floats:
    """Return the standard deviation of estimates without each part, (n_parts, ...)."""
    total = np.nansum((values - np.nanmean(values, axis=0)) ** 2, axis=0)
    return np.asarray(np.sqrt(total * (seen - 1) / np.maximum(seen, 1)))
