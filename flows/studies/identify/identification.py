"""Modes from measured response functions, without a user where that is wanted.

The steps: the functions in the band; poles of all orders (adapters/pole_estimators); residues;
stability and tracks (core/measurement/stabilisation); the choice; better poles and final residues
(core/measurement/modal_fit); shapes, of unit modal mass where a driving point was measured; real
shapes and how real they were; synthesised against measured functions.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from modetune.adapters.pole_estimators import lscf_poles
from modetune.adapters.test_files import measurements
from modetune.core.brief import brief
from modetune.core.correlation.complexity import DOUBTFUL, modal_phase_collinearity, real_shapes
from modetune.core.correlation.correlation import auto_mac
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import MeasuredFrfs, TestGeometry
from modetune.core.measurement.modal_fit import (
    ModalFit,
    fit_residues,
    mode_shares,
    refine_poles,
    shapes_and_participations,
    unexplained_peaks,
    unit_mass_factors,
)
from modetune.core.measurement.response_functions import Complexes, Response, frac
from modetune.core.measurement.stabilisation import (
    Criteria,
    OrderPoles,
    Track,
    follow_poles,
    judge_orders,
    physical_poles,
    pick_tracks,
)
from modetune.core.modes import Floats, Integers, MeasuredModes, dof_name, mode_set
from modetune.flows.studies.identify.measured_functions import functions_in_band

#: Share of a mode's residues outside one shape from which it is reported. References that are
#: driven and measured with care leave some per cent; two modes of one frequency leave 30 to 100 %,
#: unless the references see them nearly alike.
ANOTHER_SHAPE = 0.2


@dataclass(frozen=True, slots=True)
class IdentificationSettings:
    """What a user asks for.

    band_hz: lower and upper frequency, nothing for all lines; order: pairs of poles of the largest
    polynomial; pick: frequencies of poles chosen by hand, empty for the choice without a user.
    """

    band_hz: tuple[float, float] | None = None
    order: int = 60
    pick: tuple[float, ...] = ()
    criteria: Criteria = field(default_factory=Criteria)


@dataclass(frozen=True, slots=True, repr=False)
class Identification:
    """Modes of a set of response functions, and how good they are.

    modes: real shapes, damping, ascending in frequency. complex_shapes: (n_dof, n_modes) before
    they were made real; phase_collinearity: (n_modes,), 1 for real ones; auto_mac: (n_modes,
    n_modes). frfs: those that were fitted, in the band; synthesised, like its values; frac:
    (n_functions,). orders, tracks: the stabilisation diagram; chosen: places in `tracks`.
    driving_points: functions (places) measured where the force acts. notes: for people.
    """

    settings: IdentificationSettings
    modes: MeasuredModes
    complex_shapes: Complexes
    phase_collinearity: Floats
    auto_mac: Floats
    frfs: MeasuredFrfs
    synthesised: Complexes
    frac: Floats
    orders: tuple[OrderPoles, ...]
    tracks: tuple[Track, ...]
    chosen: tuple[int, ...]
    driving_points: tuple[int, ...]
    notes: tuple[str, ...]

    __repr__ = brief

    @property
    def stable_orders(self) -> tuple[int, ...]:
        """Of each mode, (n_modes,)."""
        return tuple(self.tracks[place].n_stable for place in self.chosen)

    @property
    def worst_functions(self) -> Integers:
        """Places of the functions, least FRAC first."""
        return np.argsort(self.frac)

    def function_name(self, place: int) -> str:
        """Response / reference of a function, such as 12.z / 1.z."""
        frfs = self.frfs
        response = int(frfs.nodes[place]), int(frfs.components[place])
        force = int(frfs.reference_nodes[place]), int(frfs.reference_components[place])
        return f"{dof_name(response)} / {dof_name(force)}"


def identify(frfs: MeasuredFrfs, settings: IdentificationSettings) -> Identification:
    """Identify modes. Raises CampaignError where the functions or what is asked do not allow it."""
    used, notes = functions_in_band(frfs, settings.band_hz)
    lines = used.frequencies_hz
    scaled = np.asarray(used.values / np.sqrt(np.mean(np.abs(used.values) ** 2, axis=0)))
    orders = _orders(lines, scaled, used.kind, settings)
    tracks = follow_poles(orders, settings.criteria)
    fitted, kept, chosen = _choose(lines, scaled, used.kind, tracks, settings, notes)
    fit = fit_residues(lines, used.values, fitted, used.kind).select(kept)
    poles = fit.poles
    driving = _driving_points(used)
    dofs, shapes = _shapes(used, fit, driving, notes)
    collinearity = modal_phase_collinearity(shapes)
    real = real_shapes(shapes)
    if not driving:
        real = real / real[np.abs(real).argmax(axis=0), np.arange(poles.size)]
    modes = mode_set(
        np.abs(poles) / (2.0 * np.pi),
        real,
        dofs[:, 0],
        dofs[:, 1],
        -poles.real / np.abs(poles),
        "mass" if driving else "max",
    )
    synthesised = fit.synthesise(lines)
    alike = frac(used.values[:, :, None], synthesised[:, :, None])[:, 0]
    result = Identification(
        settings=settings,
        modes=MeasuredModes(tuple(range(1, poles.size + 1)), modes),
        complex_shapes=shapes,
        phase_collinearity=collinearity,
        auto_mac=auto_mac(real),
        frfs=used,
        synthesised=synthesised,
        frac=alike,
        orders=orders,
        tracks=tracks,
        chosen=chosen,
        driving_points=driving,
        notes=(),
    )
    return replace(result, notes=(*notes, *_doubts(result)))


def _orders(
    lines: Floats, scaled: Complexes, kind: Response, settings: IdentificationSettings
) -> tuple[OrderPoles, ...]:
    """The stabilisation diagram, judged."""
    criteria, band = settings.criteria, (float(lines[0]), float(lines[-1]))
    found = []
    for order, poles in enumerate(lscf_poles(lines, scaled, settings.order), start=1):
        kept = physical_poles(poles, band, criteria.largest_damping)
        residues = fit_residues(lines, scaled, kept, kind).residues
        found.append(OrderPoles(order, kept, residues, np.zeros(kept.size, dtype=np.int64)))
    return judge_orders(found, criteria)


def _choose(
    lines: Floats,
    scaled: Complexes,
    kind: Response,
    tracks: tuple[Track, ...],
    settings: IdentificationSettings,
    notes: list[str],
) -> tuple[Complexes, Integers, tuple[int, ...]]:
    """The poles to fit, ascending in frequency, places of the modes in them, and their tracks."""
    criteria, enough = settings.criteria, settings.criteria.enough(settings.order)
    picked = pick_tracks(tracks, settings.pick, criteria) if settings.pick else ()
    # Poles that were not picked are fitted too: without them their neighbours would be biased.
    fitted = [k for k, track in enumerate(tracks) if track.n_stable >= enough or k in picked]
    kept = np.ones(len(fitted), dtype=np.bool_)
    poles = refine_poles(lines, scaled, _poles(tracks, fitted), kind)
    if fitted:
        frequencies = np.abs(poles) / (2.0 * np.pi)
        shares = mode_shares(lines, scaled, poles, kind)
        wanted = criteria.wanted_shares(frequencies, (float(lines[0]), float(lines[-1])))
        kept = (shares >= wanted) | np.isin(fitted, picked)
        notes.extend(
            f"the stable pole at {frequencies[k]:.4g} Hz was left out: only "
            f"{100.0 * shares[k]:.2g} % of the response there needs it (--pick takes it anyway)"
            for k in np.flatnonzero(~kept)
            if not picked
        )
    if not kept.all():
        fitted = [place for place, good in zip(fitted, kept, strict=True) if good]
        poles = refine_poles(lines, scaled, _poles(tracks, fitted), kind)
    if not fitted:
        raise CampaignError(
            f"no pole is stable over {enough} orders up to {settings.order}: widen the band, raise "
            "--order, or look at the data"
        )
    order = np.argsort(np.abs(poles))
    places = [fitted[k] for k in order]
    modes = np.array([k for k, place in enumerate(places) if not picked or place in picked])
    return poles[order], modes, tuple(places[k] for k in modes)


def _poles(tracks: tuple[Track, ...], places: list[int]) -> Complexes:
    return np.array([tracks[place].pole for place in places], dtype=np.complex128)


def _driving_points(frfs: MeasuredFrfs) -> tuple[int, ...]:
    same = (frfs.nodes == frfs.reference_nodes) & (frfs.components == frfs.reference_components)
    return tuple(np.flatnonzero(same).tolist())


def _shapes(
    frfs: MeasuredFrfs, fit: ModalFit, driving: tuple[int, ...], notes: list[str]
) -> tuple[Integers, Complexes]:
    """Degrees of freedom (n_dof, 2) and complex shapes (n_dof, n_modes).

    Where the hammer went round instead of the sensor, the points of the force are the shape's:
    functions are reciprocal.
    """
    responses, rows = np.unique(
        np.stack([frfs.nodes, frfs.components], axis=1), axis=0, return_inverse=True
    )
    forces = np.stack([frfs.reference_nodes, frfs.reference_components], axis=1)
    references, columns = np.unique(forces, axis=0, return_inverse=True)
    if references.shape[0] > responses.shape[0]:
        notes.append(
            f"{references.shape[0]} points were struck and {responses.shape[0]} measured: shapes "
            "are at the points of the force"
        )
        responses, rows, references, columns = references, columns, responses, rows
    rows, columns = rows.reshape(-1), columns.reshape(-1)
    u, v = shapes_and_participations(fit.residues, rows, columns)
    left = np.linalg.norm(fit.residues - u[rows] * v[columns], axis=0)
    left /= np.maximum(np.linalg.norm(fit.residues, axis=0), np.finfo(float).tiny)
    notes.extend(
        f"mode {mode + 1} ({abs(fit.poles[mode]) / (2.0 * np.pi):.4g} Hz): the references do not "
        f"have one shape, {100.0 * left[mode]:.0f} % of its residues belong to none: two modes of "
        "one frequency, of which only the stronger is given, or references that were measured "
        "differently; identify the functions of each reference alone to see both"
        for mode in np.flatnonzero(left > ANOTHER_SHAPE)
    )
    lost = np.flatnonzero(~u.all(axis=1))
    if lost.size:
        raise CampaignError(
            f"nothing ties {dof_name(tuple(responses[lost[0]].tolist()))} to the other sensors: a "
            "reference must be common to all parts of a test"
        )
    if driving:
        at = list(driving)
        own, force = u[rows[at]], v[columns[at]]
        u = u * unit_mass_factors(own, force, fit.poles)
    return responses, u


def _doubts(found: Identification) -> list[str]:
    """Return the warnings about the result."""
    texts = []
    frequencies = found.modes.modes.frequencies_hz
    for place in np.flatnonzero(found.phase_collinearity < DOUBTFUL):
        texts.append(
            f"mode {place + 1} ({frequencies[place]:.4g} Hz) is complex: its modal phase "
            f"collinearity is {found.phase_collinearity[place]:.2f}"
        )
    for i, j in zip(*np.nonzero(np.triu(found.auto_mac, 1) > 0.9), strict=True):
        texts.append(
            f"modes {i + 1} and {j + 1} have a MAC of {found.auto_mac[i, j]:.2f}: the "
            "sensors can hardly distinguish them"
        )
    size = np.sqrt(np.mean(np.abs(found.frfs.values) ** 2, axis=0))
    lines = found.frfs.frequencies_hz
    peaks = unexplained_peaks(lines, found.frfs.values / size, found.synthesised / size)
    if peaks:
        named = ", ".join(f"{peak:.4g}" for peak in peaks[:5])
        texts.append(
            f"the responses have a peak at {named} Hz that the modes do not explain: raise "
            "--order, or identify it in a narrower --band"
        )
    worst = [place for place in found.worst_functions[:5].tolist() if found.frac[place] < 0.9]
    if worst:
        names = ", ".join(f"{found.function_name(k)} ({found.frac[k]:.2f})" for k in worst)
        texts.append(f"functions that the modes fit poorly (FRAC): {names}")
    coherences = found.frfs.coherences
    told = np.flatnonzero(np.isfinite(coherences).all(axis=0)) if coherences.size else np.zeros(0)
    if told.size:
        mean = coherences[:, told].mean(axis=0)
        low = int(told[mean.argmin()])
        texts.append(
            f"mean coherence in the band is {mean.mean():.2f}, least {mean.min():.2f} at "
            f"{found.function_name(low)}; the fit does not use it as a weight"
        )
    return texts


def write_modes(
    path: Path, found: Identification, geometry: TestGeometry | None, source: str
) -> None:
    """Write the real modes. Raises StorageUnavailable, CampaignError for an unknown ending."""
    measurements.write_modes(path, found.modes, geometry, comments(found, source))


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
