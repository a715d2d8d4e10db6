"""Writing and reading the record of a campaign; `core/record.py` says what stands where."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import h5py
import numpy as np

from modetune.core.errors import CampaignError, ModesError
from modetune.core.geometry import TestGeometry
from modetune.core.groups import read_modes, read_parts, texts, write_modes, write_parts
from modetune.core.held_out import HeldOut
from modetune.core.measurement import MeasuredFrfs
from modetune.core.modes import MeasuredModes, ModeSet, mode_set
from modetune.core.pairing import Pairing
from modetune.core.parameters import TARGETS, Parameter, ParameterSet, Quantity, TargetKind
from modetune.core.record import CampaignRecord, IterationRecord, RunCounts, SensorPlaces
from modetune.core.residual import Residual
from modetune.core.sensors import SensorMap
from modetune.core.store import writing
from modetune.core.surface import Surface
from modetune.core.trust_file import read_trust, write_trust

FORMAT = 1
#: What a file that is no record makes its reading end with.
UNREADABLE = (
    OSError, KeyError, IndexError, TypeError, ValueError, RuntimeError, AttributeError, ModesError,
)  # fmt: skip
#: Plain attributes of the file that are the record's fields of the same name.
TEXTS = ("name", "status", "reason", "solver", "solver_version", "modetune_version", "units",
         "deck_digest")  # fmt: skip
NUMBERS = ("e1_frequency", "e1_mac", "e2")


def write_record(path: Path, record: CampaignRecord) -> None:
    """Write the record whole or not at all. Raises StorageUnavailable."""
    with writing(path) as part, h5py.File(part, "w") as file:
        file.attrs.update({name: getattr(record, name) for name in (*TEXTS, *NUMBERS)})
        file.attrs.update(
            format=FORMAT,
            campaign=record.campaign_text,
            settings="\n".join(record.settings),
            versions="\n".join(record.versions),
            configurations="\n".join(record.configurations),
            wall_s=record.wall_s,
        )
        _write_runs(file, record.runs)
        _write_parameters(file.create_group("parameters"), record)
        test = file.create_group("test")
        test["numbers"] = np.array(record.test.numbers)
        write_modes(test, record.test.modes)
        write_parts(test, "geometry", record.geometry)
        write_parts(test, "frfs", record.frfs)
        write_parts(file, "sensors", record.sensors)
        write_parts(file, "sensor_places", record.places)
        write_parts(file, "model", record.surface)
        write_parts(file, "held_out", record.held_out)
        write_trust(file, record.trust)
        iterations = file.create_group("iterations")
        accepted = [item.number for item in record.iterations if item.accepted]
        shown = {accepted[0], accepted[-1]} if accepted else set()
        for item in record.iterations:
            _write_iteration(iterations.create_group(f"{item.number:03d}"), item)
            if item.number in shown and item.field.n_dof:
                write_modes(iterations.create_group(f"{item.number:03d}/field"), item.field, "f4")


def read_record(path: Path) -> CampaignRecord:
    """The record as it was written. Raises CampaignError.

    What an older file lacks is empty; shapes of modes without a pair are zero there.
    """
    try:
        with h5py.File(path, "r") as file:
            if int(file.attrs["format"]) > FORMAT:
                raise CampaignError(
                    f"{path} was written by modetune {file.attrs['modetune_version']}, whose "
                    f"records this one does not read; install that version"
                )
            record = _read(file)
            if not any(item.accepted for item in record.iterations):
                raise KeyError("no iteration was accepted")
            return record
    except FileNotFoundError as error:
        raise CampaignError(
            f"{path} is not there; a record is a campaign.h5 as `modetune update` leaves it"
        ) from error
    except UNREADABLE as error:
        raise CampaignError(
            f"{path} is no record of a campaign (a campaign.h5 as `modetune update` leaves it), "
            "or it is damaged; run the campaign again, the store answers what was solved"
        ) from error


def _read(file: h5py.File) -> CampaignRecord:
    group, test, attrs = file["parameters"], file["test"], file.attrs
    iterations = [file["iterations"][name] for name in sorted(file["iterations"], key=int)]
    return CampaignRecord(
        name=str(attrs["name"]),
        status=str(attrs["status"]),
        reason=str(attrs["reason"]),
        solver=str(attrs["solver"]),
        solver_version=str(attrs["solver_version"]),
        modetune_version=str(attrs["modetune_version"]),
        units=str(attrs.get("units", "")),
        deck_digest=str(attrs.get("deck_digest", "")),
        e1_frequency=float(attrs.get("e1_frequency", np.nan)),
        e1_mac=float(attrs.get("e1_mac", np.nan)),
        e2=float(attrs.get("e2", np.nan)),
        campaign_text=str(attrs["campaign"]),
        settings=tuple(str(attrs["settings"]).splitlines()),
        versions=tuple(str(attrs.get("versions", "")).splitlines()),
        configurations=tuple(str(attrs.get("configurations", "")).splitlines()),
        parameters=_read_parameters(group),
        deck_values=group["deck_values"][()],
        test=MeasuredModes(tuple(test["numbers"][()].tolist()), read_modes(test)),
        iterations=tuple(_read_iteration(item) for item in iterations),
        updated=group["updated"][()],
        standard_errors=group["standard_errors"][()],
        correlation=group["correlation"][()],
        runs=_read_runs(file),
        wall_s=float(attrs["wall_s"]),
        surface=read_parts(file, "model", Surface),
        geometry=read_parts(test, "geometry", TestGeometry),
        sensors=read_parts(file, "sensors", SensorMap),
        places=read_parts(file, "sensor_places", SensorPlaces),
        held_out=read_parts(file, "held_out", HeldOut),
        frfs=read_parts(test, "frfs", MeasuredFrfs),
        trust=read_trust(file),
    )


def _write_runs(group: h5py.Group, runs: RunCounts) -> None:
    group.attrs.update(
        runs_modal=runs.modal,
        runs_sensitivity=runs.sensitivity,
        runs_reused=runs.reused,
        core_s=runs.core_s,
        licence_s=runs.licence_s,
    )


def _read_runs(group: h5py.Group) -> RunCounts:
    counts = (int(group.attrs[f"runs_{kind}"]) for kind in ("modal", "sensitivity", "reused"))
    return RunCounts(*counts, *(float(group.attrs.get(s, 0.0)) for s in ("core_s", "licence_s")))


def _write_parameters(group: h5py.Group, record: CampaignRecord) -> None:
    items = record.parameters.parameters
    columns = {
        "names": record.parameters.names,
        "quantities": [item.quantity for item in items],
        "by": [item.by for item in items],
        "targets": ["\n".join(item.targets) for item in items],
    }
    for name, column in columns.items():
        group.create_dataset(name, data=list(column), dtype=h5py.string_dtype())
    group["items"] = [item.item for item in items]
    group["deviations"] = record.parameters.standard_deviations
    group["deck_values"] = record.deck_values
    group["initial"] = record.parameters.initial
    group["lower"] = record.parameters.lower
    group["upper"] = record.parameters.upper
    group["updated"] = record.updated
    group["standard_errors"] = record.standard_errors
    group["correlation"] = record.correlation


def _read_parameters(group: h5py.Group) -> ParameterSet:
    names, quantities = texts(group, "names"), cast(list[Quantity], texts(group, "quantities"))
    numbers = [group[name][()].tolist() for name in ("lower", "upper", "initial")]
    whole = "targets" in group
    by = [TARGETS[quantity][0] for quantity in quantities]
    if whole:
        by = cast(list[TargetKind], texts(group, "by"))
    targets = texts(group, "targets") if whole else [""] * len(names)
    deviations = group["deviations"][()].tolist() if whole else [np.nan] * len(names)
    items = group["items"][()].tolist() if whole else [0] * len(names)
    rows = zip(names, quantities, by, targets, *numbers, deviations, items, strict=True)
    return ParameterSet(
        tuple(
            Parameter(name, quantity, owner, tuple(target.splitlines()), lower, upper, deviation,
                      initial, item)
            for name, quantity, owner, target, lower, upper, initial, deviation, item in rows
        )
    )  # fmt: skip


def _write_iteration(group: h5py.Group, item: IterationRecord) -> None:
    group.attrs.update(
        accepted=item.accepted,
        decision=item.decision,
        slope=item.slope,
        sensitivity_skipped=item.sensitivity_skipped,
        sensitivity_methods=", ".join(item.sensitivity_methods),
        sensitivity_age=item.sensitivity_age,
        worst_error=item.worst_error,
        misfit=item.residual.misfit,
        regularisation=item.regularisation,
        condition=item.condition,
        modal_key=item.modal_key,
        solved_by=item.solved_by,
        wall_s=item.wall_s,
        normalisation=item.computed.normalisation,
    )
    _write_runs(group, item.runs)
    pairing, text = item.pairing, h5py.string_dtype()
    group["parameters"] = item.parameters
    group["step"] = item.step
    group["pair_measured"] = pairing.measured
    group["pair_computed"] = pairing.computed
    group["pair_mac"] = pairing.mac
    group["pair_subspace_mac"] = pairing.subspace_mac
    group.create_dataset("pair_reasons", data=list(pairing.reasons), dtype=text)
    group["frequency_errors"] = item.frequency_errors
    group["residual"] = item.residual.values
    group["weights"] = item.residual.weights
    group["variances"] = item.residual.variances
    group["sensitivity"] = item.sensitivity
    group.create_dataset("sensitivity_keys", data=list(item.sensitivity_keys), dtype=text)
    group["frequencies_hz"] = item.computed.frequencies_hz
    group["mode_shapes"] = item.computed.mode_shapes[:, pairing.computed]
    group["elastic_shapes"] = item.computed.mode_shapes
    group["nodes"] = item.computed.nodes
    group["components"] = item.computed.components


def _read_iteration(group: h5py.Group) -> IterationRecord:
    attrs, values = group.attrs, group["residual"][()]
    pairing = Pairing(
        measured=group["pair_measured"][()],
        computed=group["pair_computed"][()],
        mac=group["pair_mac"][()],
        subspace_mac=group["pair_subspace_mac"][()],
        reasons=tuple(texts(group, "pair_reasons")),
    )
    methods = str(attrs["sensitivity_methods"])
    return IterationRecord(
        number=int(group.name.rpartition("/")[2]),
        parameters=group["parameters"][()],
        step=group["step"][()],
        computed=_read_computed(group, pairing),
        pairing=pairing,
        frequency_errors=group["frequency_errors"][()],
        residual=Residual(
            values=values,
            weights=group["weights"][()],
            variances=group["variances"][()] if "variances" in group else values * np.nan,
            n_frequencies=pairing.measured.size,
        ),
        sensitivity=group["sensitivity"][()],
        sensitivity_methods=tuple(methods.split(", ")) if methods else (),
        sensitivity_keys=tuple(texts(group, "sensitivity_keys")),
        sensitivity_age=int(attrs["sensitivity_age"]),
        sensitivity_skipped=bool(attrs["sensitivity_skipped"]),
        slope=float(attrs["slope"]),
        accepted=bool(attrs["accepted"]),
        decision=str(attrs["decision"]),
        regularisation=float(attrs["regularisation"]),
        condition=float(attrs["condition"]),
        modal_key=str(attrs["modal_key"]),
        runs=_read_runs(group),
        wall_s=float(attrs["wall_s"]),
        field=read_modes(group["field"]) if "field" in group else mode_set([]),
        solved_by=str(attrs.get("solved_by", "")),
    )


def _read_computed(group: h5py.Group, pairing: Pairing) -> ModeSet:
    frequencies, nodes = group["frequencies_hz"][()], group["nodes"][()]
    if "elastic_shapes" in group:
        shapes = group["elastic_shapes"][()]
    else:
        shapes = np.zeros((nodes.size, frequencies.size))
        shapes[:, pairing.computed] = group["mode_shapes"][()]
    normalisation = group.attrs.get("normalisation", "unknown")
    return mode_set(frequencies, shapes, nodes, group["components"][()], (), normalisation)
