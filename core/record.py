"""The campaign's record, campaign.h5: every iteration, readable with h5py alone.

    /                     attributes: format, name, status, reason, solver, solver_version,
                          modetune_version, campaign (the file's text), settings (what --set
                          put over it, a line each), wall_s,
                          runs_modal, runs_sensitivity, runs_reused, core_s, licence_s
    /parameters/          names, quantities, deck_values, initial, lower, upper, updated,
                          standard_errors                                    (n_parameters,)
                          correlation                                        (n_par, n_par)
    /test/                numbers, frequencies_hz (n_modes,), mode_shapes (n_dof, n_modes),
                          nodes, components (n_dof,)
    /iterations/000/...   one group an evaluated parameter set, in order:
        attributes        accepted, decision, slope (e2; NaN at first), sensitivity_skipped
                          (by e2, at this set), worst_error, misfit, modal_key (in the store),
                          runs_modal, runs_sensitivity, runs_reused, wall_s,
                          core_s, licence_s (cores and licences times the time jobs held them)
        parameters        (n_parameters,), relative to the deck
        step              (n_parameters,), that led here, and of that step the attributes
                          sensitivity_methods, sensitivity_age (iterations since computed),
                          regularisation, condition (of the weighted sensitivity)
        sensitivity       (n_residuals, n_parameters), of that step; empty at 000
        sensitivity_keys  keys of the jobs behind it, in the store
        frequencies_hz    (n_elastic,), all computed elastic modes
        mode_shapes       (n_dof, n_pairs), of the paired modes at the record's sensors
        pair_measured, pair_computed   positions (from 0) of the pairs
        pair_mac, pair_subspace_mac (against close modes together), frequency_errors (n_pairs,)
        pair_reasons      text
        residual, weights (n_residuals,)

Relative values and lengths as in the campaign; frequencies in Hz. The file is written anew,
aside and renamed, after each iteration.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from modetune.core.modes import Floats, MeasuredModes, ModeSet
from modetune.core.pairing import Pairing
from modetune.core.parameters import ParameterSet
from modetune.core.residual import Residual
from modetune.core.store import writing

FORMAT = 1


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
class IterationRecord:
    """One evaluated parameter set; `core/record.py` says what each field is in the file."""

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

    @property
    def worst_error(self) -> float:
        return float(np.max(np.abs(self.frequency_errors)))


@dataclass(frozen=True, slots=True)
class CampaignRecord:
    """A campaign from its start to where it stands."""

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

    @property
    def best(self) -> IterationRecord:
        """The last accepted iteration, each being better than the one before: the answer."""
        return [iteration for iteration in self.iterations if iteration.accepted][-1]


def write_record(path: Path, record: CampaignRecord) -> None:
    """Write the record whole or not at all. Raises StorageUnavailable."""
    with writing(path) as part, h5py.File(part, "w") as file:
        file.attrs.update(
            format=FORMAT,
            name=record.name,
            status=record.status,
            reason=record.reason,
            solver=record.solver,
            solver_version=record.solver_version,
            modetune_version=record.modetune_version,
            campaign=record.campaign_text,
            settings="\n".join(record.settings),
            wall_s=record.wall_s,
            runs_modal=record.runs.modal,
            runs_sensitivity=record.runs.sensitivity,
            runs_reused=record.runs.reused,
            core_s=record.runs.core_s,
            licence_s=record.runs.licence_s,
        )
        _write_parameters(file.create_group("parameters"), record)
        test = file.create_group("test")
        test["numbers"] = np.array(record.test.numbers)
        _write_arrays(test, record.test.modes)
        iterations = file.create_group("iterations")
        for iteration in record.iterations:
            _write_iteration(iterations.create_group(f"{iteration.number:03d}"), iteration)


def _write_arrays(group: h5py.Group, modes: ModeSet) -> None:
    group["frequencies_hz"] = modes.frequencies_hz
    group["mode_shapes"] = modes.mode_shapes
    group["nodes"] = modes.nodes
    group["components"] = modes.components


def _write_parameters(group: h5py.Group, record: CampaignRecord) -> None:
    parameters = record.parameters
    text = h5py.string_dtype()
    group.create_dataset("names", data=list(parameters.names), dtype=text)
    group.create_dataset(
        "quantities", data=[item.quantity for item in parameters.parameters], dtype=text
    )
    group["deck_values"] = record.deck_values
    group["initial"] = parameters.initial
    group["lower"] = parameters.lower
    group["upper"] = parameters.upper
    group["updated"] = record.updated
    group["standard_errors"] = record.standard_errors
    group["correlation"] = record.correlation


def _write_iteration(group: h5py.Group, iteration: IterationRecord) -> None:
    group.attrs.update(
        accepted=iteration.accepted,
        decision=iteration.decision,
        slope=iteration.slope,
        sensitivity_skipped=iteration.sensitivity_skipped,
        sensitivity_methods=", ".join(iteration.sensitivity_methods),
        sensitivity_age=iteration.sensitivity_age,
        worst_error=iteration.worst_error,
        misfit=iteration.residual.misfit,
        regularisation=iteration.regularisation,
        condition=iteration.condition,
        modal_key=iteration.modal_key,
        runs_modal=iteration.runs.modal,
        runs_sensitivity=iteration.runs.sensitivity,
        runs_reused=iteration.runs.reused,
        core_s=iteration.runs.core_s,
        licence_s=iteration.runs.licence_s,
        wall_s=iteration.wall_s,
    )
    pairing = iteration.pairing
    group["parameters"] = iteration.parameters
    group["step"] = iteration.step
    group["pair_measured"] = pairing.measured
    group["pair_computed"] = pairing.computed
    group["pair_mac"] = pairing.mac
    group["pair_subspace_mac"] = pairing.subspace_mac
    group.create_dataset("pair_reasons", data=list(pairing.reasons), dtype=h5py.string_dtype())
    group["frequency_errors"] = iteration.frequency_errors
    group["residual"] = iteration.residual.values
    group["weights"] = iteration.residual.weights
    group["sensitivity"] = iteration.sensitivity
    group.create_dataset(
        "sensitivity_keys", data=list(iteration.sensitivity_keys), dtype=h5py.string_dtype()
    )
    group["frequencies_hz"] = iteration.computed.frequencies_hz
    shapes = iteration.computed.select(pairing.computed)
    group["mode_shapes"] = shapes.mode_shapes
    group["nodes"] = shapes.nodes
    group["components"] = shapes.components
