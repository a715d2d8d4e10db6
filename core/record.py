"""The campaign's record, campaign.h5: every iteration, readable with h5py alone.

    /                     attributes: format, name, status, reason, solver, solver_version,
                          modetune_version, versions (of Python and packages, a line each), units,
                          deck_digest (SHA-256 and name of its file), e1_frequency, e1_mac, e2,
                          campaign (the file's text), settings (what --set put over it, a line
                          each), wall_s, configurations (their names, a line each; a
                          mode's number is then 1000 k + its own in the test of the k-th),
                          runs_modal, runs_sensitivity, runs_reused, core_s, licence_s
    /parameters/          names, quantities, by, targets (a line each), items, deviations,
                          deck_values, initial, lower, upper, updated,
                          standard_errors                                    (n_parameters,)
                          correlation                                        (n_par, n_par)
    /test/                numbers, frequencies_hz, damping_ratios (n_modes,; empty if unknown),
                          mode_shapes (n_dof, n_modes), nodes, components (n_dof,)
    /test/geometry/       nodes (n,), coordinates (n, 3), frames (n, 3, 3), lines (n_lines, 2),
                          faces (n_faces, 3); attribute metres
    /test/frfs/           kind (attribute), frequencies_hz (n_lines,), values (n_lines, n),
                          coherences; nodes, components, signs, reference_nodes,
                          reference_components, reference_signs (n,)
    /sensors/             nodes, components, model_nodes, turns, distances (n_sensors,),
                          directions (n_sensors, 3)
    /sensor_places/       coordinates, directions (n_sensors, 3), on the model, global axes
    /model/               nodes (n,), coordinates (n, 3), triangles (n_triangles, 3), edges
                          (n_edges, 2): the surface that is shown; rows of `nodes`, float32
    /trust/               how far the parameters can be trusted: `core/trust_file.py`
    /held_out/            numbers, test_hz, initial_hz, updated_hz, error_initial, error_updated,
                          mac_initial, mac_updated, worse (n_held_out,): modes that were not used,
                          before and after updating (`core/held_out.py`)
    /iterations/000/...   one group an evaluated parameter set, in order:
        attributes        accepted, decision, slope (e2; NaN at first), sensitivity_skipped
                          (by e2, at this set), worst_error, misfit, modal_key (in the store),
                          solved_by (the program that found the modes),
                          runs_modal, runs_sensitivity, runs_reused, wall_s,
                          core_s, licence_s (cores and licences times the time jobs held them)
        parameters        (n_parameters,), relative to the deck
        step              (n_parameters,), that led here, and of that step the attributes
                          sensitivity_methods, sensitivity_age (iterations since computed),
                          regularisation, condition (of the weighted sensitivity)
        sensitivity       (n_residuals, n_parameters), of that step; empty at 000
        sensitivity_keys  keys of the jobs behind it, in the store
        frequencies_hz    (n_elastic,), all computed elastic modes; attribute normalisation
        mode_shapes       (n_dof, n_pairs), of the paired modes at the record's sensors
        elastic_shapes    (n_dof, n_elastic), of all of them
        pair_measured, pair_computed   positions (from 0) of the pairs
        pair_mac, pair_subspace_mac (against close modes together), frequency_errors (n_pairs,)
        pair_reasons      text
        residual, weights, variances (n_residuals,)
        field/            shapes of the paired modes at the nodes of /model/, float32: nodes,
                          components, mode_shapes, frequencies_hz; of the first and of the best
                          accepted iteration only

Relative values and lengths as in the campaign; frequencies in Hz. Groups and attributes that a
file lacks, since it is older or has nothing to tell there, read as empty. The file is written
anew, aside and renamed, after each iteration; `core/record_file.py` writes and reads it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np

from modetune.core.geometry import TestGeometry
from modetune.core.held_out import HeldOut
from modetune.core.measurement import MeasuredFrfs
from modetune.core.modes import Floats, MeasuredModes, ModeSet, mode_set
from modetune.core.pairing import Pairing
from modetune.core.parameters import ParameterSet
from modetune.core.residual import Residual
from modetune.core.sensors import SensorMap
from modetune.core.surface import Surface
from modetune.core.trust import Trust


@dataclass(frozen=True, slots=True)
class RunCounts:
    """Solver runs by kind: started for modes, started for sensitivities, answered by the store.

    core_s, licence_s: cores and licences times the time that jobs held them, failed ones too.
    """

    modal: int = 0
    sensitivity: int = 0
    reused: int = 0
    core_s: float = 0.0
    licence_s: float = 0.0

    def plus(self, other: RunCounts) -> RunCounts:
        return RunCounts(
            self.modal + other.modal,
            self.sensitivity + other.sensitivity,
            self.reused + other.reused,
            self.core_s + other.core_s,
            self.licence_s + other.licence_s,
        )

    def since(self, earlier: RunCounts) -> RunCounts:
        return RunCounts(
            self.modal - earlier.modal,
            self.sensitivity - earlier.sensitivity,
            self.reused - earlier.reused,
            self.core_s - earlier.core_s,
            self.licence_s - earlier.licence_s,
        )


@dataclass(frozen=True, slots=True)
class SensorPlaces:
    """Where the sensors are on the model, and which way they look, both in global axes.

    coordinates, directions: (n_sensors, 3), in the order of the record's sensors.
    """

    coordinates: Floats
    directions: Floats


@dataclass(frozen=True, slots=True)
class IterationRecord:
    """One evaluated parameter set; the module's docstring says what each field is in the file.

    field: the paired modes at the nodes of the displayed surface; empty where there is none;
    solved_by: the program that found the modes, empty in records that do not tell.
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

    @property
    def worst_error(self) -> float:
        return float(np.max(np.abs(self.frequency_errors)))


@dataclass(frozen=True, slots=True)
class CampaignRecord:
    """A campaign from its start to where it stands.

    surface, geometry, sensors, places, frfs: of model and test, None where the campaign has none.
    e1_frequency, e1_mac, e2: the campaign's tolerances. versions: what it ran with, `name number`.
    trust: None while the campaign runs, and where no sensitivity was computed. held_out: None while
    it runs, and where nothing was held out. configurations: their names where there are several;
    number 1003 of a mode is then mode 3 of the test of the first one.
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
    configurations: tuple[str, ...] = ()

    @property
    def best(self) -> IterationRecord:
        """The last accepted iteration, each being better than the one before: the answer."""
        return [iteration for iteration in self.iterations if iteration.accepted][-1]
