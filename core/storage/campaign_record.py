"""The campaign's record, campaign.h5: every iteration, readable with h5py alone.

The file is the dataclass CampaignRecord below as `core/storage/codec` writes it: single values are
attributes, arrays datasets, dataclasses groups, each by the name of its field. A seal precedes the
HDF5 content (`core/storage/sealed_file`).

    /                      attributes: name, status, reason, solver, solver_version,
                           modetune_version, units, deck_digest (SHA-256 and name of its file),
                           e1_frequency, e1_mac, e2, campaign_text (of its file), wall_s,
                           ended_at (seconds since 1970, UTC; NaN while it runs), state and drift
                           (of the structure over its runs, a word and a sentence)
                           datasets: deck_values (n_parameters + n_dependents,), updated,
                           standard_errors (NaN if withheld), repeatability (n_parameters,),
                           correlation (n_par, n_par), covariance (n_par, n_par; of repeatability),
                           settings (what was put over the campaign for this run), changed
                           (names of parameters that changed over the runs),
                           versions (of Python and packages), configurations (n_modes,): whose
                           test each mode is of, empty where the campaign has one model
    /environment/          keys, values (n_quantities,): what was measured with the test, such as
                           temperature_C
    /runs/                 attributes: modal, sensitivity, reused, core_s, licence_s
    /parameters/parameters/0000/...   one group a parameter: attributes name, quantity, by, lower,
                           upper, standard_deviation, initial, item, values, origin, scale,
                           expression; dataset targets; /parameters/dependents/0000/... alike
    /test/                 numbers (n_modes,)
    /test/modes/           frequencies_hz (n_modes,), mode_shapes (n_dof, n_modes), nodes,
                           components (n_dof,), damping_ratios (n_modes,; empty if unknown);
                           attribute normalisation: of every group that holds modes
    /geometry/             nodes (n,), coordinates (n, 3), frames (n, 3, 3), lines (n_lines, 2),
                           faces (n_faces, 3); attribute metres
    /frfs/                 kind (attribute), frequencies_hz (n_lines,), values (n_lines, n),
                           coherences; nodes, components, signs, reference_nodes,
                           reference_components, reference_signs (n,)
    /sensors/              nodes, components, model_nodes, turns, distances (n_sensors,),
                           directions (n_sensors, 3)
    /places/               coordinates, directions (n_sensors, 3), on the model, global axes
    /surface/              nodes (n,), coordinates (n, 3), triangles (n_triangles, 3), edges
                           (n_edges, 2): the surface that is shown; rows of `nodes`
    /trust/                how far the parameters can be trusted: `core/updating/trust`
    /held_out/             numbers, test_hz, initial_hz, updated_hz, error_initial, error_updated,
                           mac_initial, mac_updated, worse, configurations (n_held_out,): modes
                           that were not used, before and after (`core/correlation/holdout`)
    /fields/0000/          strengths, alone, changes (n_zones,), places, doubts, sentences;
                           attributes left, started; field/: columns, neighbours, elements,
                           owners, centres (`core/updating/parameter_fields`)
    /iterations/0000/...   one group an evaluated parameter set, in order:
        attributes         number, accepted, decision, slope (e2; NaN at first),
                           sensitivity_skipped (by e2, at this set), sensitivity_age (iterations
                           since computed), regularisation, condition (of the weighted sensitivity),
                           modal_key (in the store), solved_by (the program that found the modes),
                           wall_s
        parameters, step   (n_parameters,), relative to the deck, and the step that led here
        sensitivity        (n_residuals, n_parameters), of that step; empty at 0000;
                           sensitivity_methods, sensitivity_keys: of the jobs behind it
        frequency_errors   (n_pairs,)
        runs/              as /runs/
        computed/          all computed elastic modes at the record's sensors, as /test/modes/
        pairing/           measured, computed: positions (from 0) of the pairs; mac, subspace_mac
                           (against close modes together), reasons (n_pairs,)
        residual/          values, weights, variances, noise (n_residuals,)
        residual/blocks/0000/...   what rows are of, in their order, a group a kind of response and
                           configuration: attributes kind, scaled; names, sizes (n_items,), measured
                           (n_rows,), mixing (n_rows, n_rows), limits (n_rows, 2):
                           `core/updating/responses/response`
        field/             shapes of the paired modes at the nodes of /surface/, as /test/modes/;
                           of the first and of the best accepted iteration only, else empty

Relative values and lengths as in the campaign; frequencies in Hz. Groups of what a campaign does
not have are not there. The file is rewritten, under another name and then renamed, after each
iteration.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import astuple, dataclass, replace
from operator import add, sub
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from modetune.core.brief import brief
from modetune.core.correlation.holdout import HeldOut
from modetune.core.correlation.pairing import Pairing
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import MeasuredFrfs, TestGeometry
from modetune.core.measurement.sensor_map import SensorMap
from modetune.core.modes import Floats, MeasuredModes, ModeSet, mode_set
from modetune.core.parameters import ParameterSet
from modetune.core.storage.codec import are_alike
from modetune.core.storage.sealed_file import HDF5, LONGEST_TITLE, RecordFile, title_of
from modetune.core.surface import Surface
from modetune.core.updating.parameter_fields import FieldAnswer
from modetune.core.updating.responses.response import Residual
from modetune.core.updating.trust import UNCONFIRMED, Trust
from modetune.core.updating.verdict import TrustVerdict


@dataclass(frozen=True, slots=True)
class RunCounts:
    """Solver runs by kind: started for modes, started for sensitivities, cached.

    core_s, licence_s: cores and licences times the time that jobs held them, failed ones too.
    """

    modal: int = 0
    sensitivity: int = 0
    reused: int = 0
    core_s: float = 0.0
    licence_s: float = 0.0

    @property
    def sentence(self) -> str:
        return (
            f"solver runs: {self.modal} modal, {self.sensitivity} sensitivity, {self.reused} cached"
        )

    def plus(self, other: RunCounts) -> RunCounts:
        return RunCounts(*map(add, astuple(self), astuple(other)))

    def since(self, earlier: RunCounts) -> RunCounts:
        return RunCounts(*map(sub, astuple(self), astuple(earlier)))


@dataclass(frozen=True, slots=True)
class SensorPlaces:
    """Where the sensors are on the model, and which way they look, both in global axes.

    coordinates, directions: (n_sensors, 3), in the order of the record's sensors.
    """

    coordinates: Floats
    directions: Floats


@dataclass(frozen=True, slots=True, repr=False)
class IterationRecord:
    """One evaluated parameter set; the module's docstring says what each field is in the file.

    field: the paired modes at the nodes of the displayed surface; empty where there is none;
    solved_by: the program that found the modes, empty in records without it.
    """

    number: int
    parameters: Floats
    step: Floats
    computed: ModeSet
    pairing: Pairing
    frequency_errors: Floats
    residual: Residual
    sensitivity: Floats
    sensitivity_methods: tuple[str, ...]
    sensitivity_keys: tuple[str, ...]
    sensitivity_age: int
    sensitivity_skipped: bool
    slope: float
    accepted: bool
    decision: str
    regularisation: float
    condition: float
    modal_key: str
    runs: RunCounts
    wall_s: float
    field: ModeSet = dataclasses.field(default_factory=lambda: mode_set([]))
    solved_by: str = ""

    __repr__ = brief

    @property
    def worst_error(self) -> float:
        """The largest error of a frequency that is compared."""
        used = self.residual.of_used("frequencies", self.frequency_errors)
        return float(np.max(np.abs(used), initial=0.0))


@dataclass(frozen=True, slots=True, repr=False)
class CampaignRecord:
    """A campaign from its start to its present state.

    surface, geometry, sensors, places, frfs: of model and test, None where the campaign has none.
    e1_frequency, e1_mac, e2: the campaign's tolerances. versions: what it ran with, `name number`.
    trust: None while the campaign runs, and where no sensitivity was computed. held_out: None while
    it runs, and where nothing was held out. configurations: (n_modes,), whose test each
    mode of `test` is of; empty where the campaign has one model. splits: cards that were added for
    the elements of parameters, a sentence each. fields: what the test says of parameters an element
    or zone; none while the campaign runs. covariance: of repeatability, empty without a
    sensitivity. ended_at: seconds since 1970. environment: what was measured with the test;
    measured_at: when, seconds since 1970, NaN if unknown.
    state, drift: of the structure over its runs, empty where no history was kept; changed: names of
    the parameters that changed.
    """

    name: str
    campaign_text: str
    settings: tuple[str, ...]
    modetune_version: str
    solver: str
    solver_version: str
    parameters: ParameterSet
    deck_values: Floats
    test: MeasuredModes
    iterations: tuple[IterationRecord, ...]
    status: str
    reason: str
    updated: Floats
    standard_errors: Floats
    repeatability: Floats
    correlation: Floats
    runs: RunCounts
    wall_s: float
    surface: Surface | None = None
    geometry: TestGeometry | None = None
    sensors: SensorMap | None = None
    places: SensorPlaces | None = None
    frfs: MeasuredFrfs | None = None
    units: str = ""
    e1_frequency: float = float("nan")
    e1_mac: float = float("nan")
    e2: float = float("nan")
    versions: tuple[str, ...] = ()
    deck_digest: str = ""
    trust: Trust | None = None
    held_out: HeldOut | None = None
    fields: tuple[FieldAnswer, ...] = ()
    configurations: tuple[str, ...] = ()
    splits: tuple[str, ...] = ()
    covariance: Floats = dataclasses.field(default_factory=lambda: np.zeros((0, 0)))
    ended_at: float = float("nan")
    environment: Mapping[str, float] = dataclasses.field(default_factory=dict)
    measured_at: float = float("nan")
    state: str = ""
    drift: str = ""
    changed: tuple[str, ...] = ()

    __repr__ = brief

    @property
    def best(self) -> IterationRecord:
        """The last accepted iteration, each being better than the one before: the answer."""
        return [iteration for iteration in self.iterations if iteration.accepted][-1]

    @property
    def verdict(self) -> TrustVerdict:
        """How far the updated parameters can be trusted."""
        return TrustVerdict.NOT_JUDGED if self.trust is None else self.trust.verdict

    @property
    def unconfirmed(self) -> bool:
        """Whether the solver has still to confirm the answer."""
        return self.trust is not None and UNCONFIRMED in self.trust.concerns


def _with_extent(file: h5py.File) -> None:
    """Change the content of format 7 into that of 8, which has valleys and exchanges of starts."""
    spread = file.get("trust/spread")
    if spread is None:
        return
    starts, updated, minima = (spread[name][()] for name in ("starts", "updated", "minima"))
    own = updated[minima == 0]
    spread.attrs["n_starts"] = len(starts)
    spread["exchanged"] = np.zeros(0, dtype=np.int64)
    spread["extent"] = np.vstack([own.min(axis=0), own.max(axis=0)])
    spread.create_dataset("valley", shape=(0,), dtype=h5py.string_dtype())


def _with_repeatability(file: h5py.File) -> None:
    """Change the content of format 8 into that of 9, which keeps errors of the model apart."""
    file.copy("standard_errors", file, "repeatability")
    if "trust" in file:
        file["trust"].attrs["n_predicted"] = 0
        file["trust"].create_dataset("missed", shape=(0,), dtype=h5py.string_dtype())
        for item in file["trust/parameters"].values():
            item.attrs["repeatability"] = item.attrs["standard_error"]


def _without_sections(file: h5py.File) -> None:
    """Leave the content of format 9 as it is: format 10 may have sensors on sections of bars."""


def _with_history(file: h5py.File) -> None:
    """Change the content of format 10 into that of 11, which knows when a run ended."""
    file["covariance"] = np.zeros((0, 0))
    file.attrs["ended_at"] = np.nan
    for name in ("state", "drift"):
        file.attrs[name] = ""
    file.create_dataset("changed", shape=(0,), dtype=h5py.string_dtype())
    made = file.create_group("environment")
    made.create_dataset("keys", shape=(0,), dtype=h5py.string_dtype())
    made["values"] = np.zeros(0)


def _with_time(file: h5py.File) -> None:
    """Change the content of format 11 into that of 12, which may know when the test was."""
    file.attrs["measured_at"] = np.nan


CAMPAIGN = RecordFile(
    CampaignRecord,
    "campaign",
    "campaign.h5",
    12,
    {
        7: _with_extent,
        8: _with_repeatability,
        9: _without_sections,
        10: _with_history,
        11: _with_time,
    },
)


def write_record(path: Path, record: CampaignRecord) -> None:
    """Write the record whole or not at all. Raises StorageUnavailable."""
    CAMPAIGN.write(path, _as_written(record))


def is_same_run(record: CampaignRecord, written: CampaignRecord) -> bool:
    """Return whether a record differs from one that was read in the time of its end alone."""
    return are_alike(replace(_as_written(record), ended_at=written.ended_at), written)


def _as_written(record: CampaignRecord) -> CampaignRecord:
    """Return the record with what is for pictures alone in single precision, which packs.

    That is the surface, and the shapes on it, of the first and best accepted iteration only.
    """
    accepted = [item.number for item in record.iterations if item.accepted]
    shown = {accepted[0], accepted[-1]} if accepted else set()
    surface = record.surface
    if surface is not None:
        surface = replace(surface, coordinates=_single(surface.coordinates))
    iterations = tuple(
        replace(item, field=_pictured(item) if item.number in shown else mode_set([]))
        for item in record.iterations
    )
    return replace(record, surface=surface, iterations=iterations)


def read_record(path: Path) -> CampaignRecord:
    """A campaign's record as it was written, from its file or its run folder.

    Raises CampaignError, StoreDamaged.
    """
    record = CAMPAIGN.read(path / CAMPAIGN.file if path.is_dir() else path)
    if not any(item.accepted for item in record.iterations):
        raise CampaignError(f"{path} is not a record of a campaign: no iteration was accepted")
    return record


def is_record(path: Path) -> bool:
    """Whether a file is, by its first bytes, a campaign's record, or HDF5 without a seal."""
    with path.open("rb") as file:
        head = file.read(LONGEST_TITLE)
    return head.startswith(HDF5) or title_of(head).startswith(CAMPAIGN.title)


def _pictured(item: IterationRecord) -> ModeSet:
    return replace(item.field, mode_shapes=_single(item.field.mode_shapes))


def _single(values: Any) -> Any:
    single = np.complex64 if np.iscomplexobj(values) else np.float32
    return values.astype(single).astype(values.dtype)
