"""Modes from responses to unknown forces: subspace identification by pyOMA2.

Poles of all orders (`pole_estimators.py`) are judged and followed as those of response functions:
of each track the stable pole of middle frequency and its shape are the mode, since single orders
split poles of close modes. Shapes have no scale that forces would give: their largest entry is 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import signal

from modetune.adapters.pole_estimators import ssi_poles
from modetune.adapters.test_files import measurements
from modetune.core.brief import brief
from modetune.core.correlation.complexity import modal_phase_collinearity, real_shapes
from modetune.core.correlation.correlation import auto_mac
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import Measurement
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
from modetune.core.modes import Floats, MeasuredModes, dof_name, mode_set
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
#: A mode is stable at one in four orders at least; noise reached one in five.
LASTING = 4


@dataclass(frozen=True, slots=True, repr=False)
class OperationalModes:
    """Modes of responses to unknown forces.

    modes: real shapes, damping, ascending in frequency. phase_collinearity, stable_orders:
    (n_modes,). auto_mac: (n_modes, n_modes). tracks: all; orders: the poles of each. lines_hz,
    spectrum: (n_lines,), the sum of the responses' spectra in the band. notes: for people.
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
        measurements.write_modes(path, found.modes, test.geometry, text)


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
        values, step = signal.decimate(values, every, ftype="fir", axis=0), step * every
    criteria, order = settings.criteria, min(settings.order, MOST_ORDER)
    rows = max(BLOCK_ROWS, -(-2 * order // values.shape[1]) + 1)
    orders = []
    for number, (poles, shapes) in enumerate(ssi_poles(values, step, order, rows), start=1):
        kept = physical_poles(poles, (low, high), criteria.largest_damping)
        columns = [int(np.flatnonzero(poles == pole)[0]) for pole in kept]
        none = np.zeros(kept.size, dtype=np.int64)
        orders.append(OrderPoles(number, kept, shapes[:, columns], none))
    judged = judge_orders(orders, criteria)
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
    middles = [_middle(tracks[place], judged) for place in chosen]
    at = np.argsort([abs(pole) for pole, _ in middles])
    poles = np.array([middles[place][0] for place in at])
    shapes = np.column_stack([middles[place][1] for place in at])
    real = real_shapes(shapes)
    real = real / real[np.abs(real).argmax(axis=0), np.arange(poles.size)]
    modes = mode_set(
        np.abs(poles) / (2.0 * np.pi), real, nodes, components, -poles.real / np.abs(poles), "max"
    )
    length = min(values.shape[0], SEGMENT)
    lines, spectra = signal.welch(values, 1.0 / step, nperseg=length, axis=0)
    inside = (lines > 0.0) & (lines >= low) & (lines <= high)
    seconds = run.values.shape[0] * run.step_s
    slowest = float(modes.frequencies_hz[0] * modes.damping_ratios[0] * seconds)
    notes = [
        f"output only: {seconds:.4g} s of {values.shape[1]} channels at {1.0 / step:.4g} Hz, "
        f"subspace identification of covariances, orders up to {order}, {rows} block rows",
        "shapes have no scale, because the forces were not measured",
    ]
    if slowest < 3.0:
        notes.append(
            f"the recording holds {modes.frequencies_hz[0] * seconds:.3g} periods of mode 1: its "
            "damping is uncertain by a quarter and more; record longer"
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
        notes=tuple(notes),
    )


def _middle(track: Track, orders: tuple[OrderPoles, ...]) -> tuple[complex, Complexes]:
    """The stable pole of a track whose frequency is in the middle of all of them, and its shape."""
    stable = [
        (orders[place].poles[pole], orders[place].shapes[:, pole])
        for place, pole in track.places.tolist()
        if orders[place].stability[pole] == Stability.STABLE
    ]
    stable.sort(key=lambda item: abs(item[0]))
    return stable[len(stable) // 2]
