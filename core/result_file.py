"""Results as HDF5: one function a kind to write, one to read.

Matrices are kept as their upper triangles; parts of affine matrices by position in them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import assert_never

import h5py
import numpy as np
from scipy import sparse

from modetune.core.affine import AffineMatrices, Part
from modetune.core.derivatives import ModeDerivatives
from modetune.core.matrices import MatrixResult
from modetune.core.modes import ModeSet
from modetune.core.reduced import ReducedModel, ReducedPart
from modetune.core.results import ModalResult, Result

_MATRICES = ("stiffness", "mass")


def write_result(file: h5py.Group, result: Result) -> None:
    """Put a result into an empty file or group."""
    match result:
        case ModalResult():
            _write_modal(file, result)
        case MatrixResult():
            file.attrs["kind"] = "matrices"
            _write_matrices(file, result)
        case ModeDerivatives():
            file.attrs["kind"] = "derivatives"
            file["eigenvalues"] = result.eigenvalues
            file["mode_shapes"] = result.mode_shapes
        case AffineMatrices():
            file.attrs["kind"] = "affine"
            file["reference"] = result.reference
            _write_matrices(file, result.base)
            _write_parts(file, "stiffness", result.stiffness)
            _write_parts(file, "mass", result.mass)
        case ReducedModel():
            file.attrs["kind"] = "reduced"
            file.attrs["shift"] = result.shift
            for name in ("reference", "base_stiffness", "base_mass", "rows"):
                file[name] = getattr(result, name)
            _write_parts(file, "stiffness", result.stiffness)
            _write_parts(file, "mass", result.mass)
        case _:
            assert_never(result)


def read_result(file: h5py.Group) -> Result:
    """The result that was put into a file or group.

    Raises KeyError, ValueError, TypeError or OSError where there is none.
    """
    match str(file.attrs["kind"]):
        case "modal":
            return _read_modal(file)
        case "matrices":
            return _read_matrices(file)
        case "derivatives":
            return ModeDerivatives(file["eigenvalues"][()], file["mode_shapes"][()])
        case "affine":
            stiffness, mass = (_read_affine_parts(file[f"{name}_parts"]) for name in _MATRICES)
            return AffineMatrices(file["reference"][()], _read_matrices(file), stiffness, mass)
        case "reduced":
            return _read_reduced(file)
        case other:
            raise ValueError(f"an unknown kind of result: {other}")


def _write_modal(file: h5py.Group, result: ModalResult) -> None:
    file.attrs["kind"] = "modal"
    file.attrs["mass"] = result.mass
    file.attrs["normalisation"] = result.modes.normalisation
    file.attrs["groups"] = "\n".join(result.groups)
    file["eigenvalues"] = result.eigenvalues
    file["frequencies_hz"] = result.modes.frequencies_hz
    file["mode_shapes"] = result.modes.mode_shapes
    file["nodes"] = result.modes.nodes
    file["components"] = result.modes.components
    file["strain_energies"] = result.strain_energies
    file["total_strain_energy"] = result.total_strain_energy


def _read_modal(file: h5py.Group) -> ModalResult:
    groups = str(file.attrs["groups"])
    return ModalResult(
        eigenvalues=file["eigenvalues"][()],
        modes=ModeSet(
            frequencies_hz=file["frequencies_hz"][()],
            mode_shapes=file["mode_shapes"][()],
            nodes=file["nodes"][()],
            components=file["components"][()],
            damping_ratios=np.zeros(0),
            normalisation="mass" if file.attrs["normalisation"] == "mass" else "unknown",
        ),
        groups=tuple(groups.split("\n")) if groups else (),
        strain_energies=file["strain_energies"][()],
        total_strain_energy=file["total_strain_energy"][()],
        mass=float(file.attrs["mass"]),
    )


def _write_matrices(file: h5py.Group, result: MatrixResult) -> None:
    file["nodes"] = result.nodes
    file["components"] = result.components
    for name, upper in zip(_MATRICES, (result.upper_stiffness, result.upper_mass), strict=True):
        for part in ("data", "indices", "indptr"):
            file.create_dataset(f"{name}/{part}", data=getattr(upper, part))


def _read_matrices(file: h5py.Group) -> MatrixResult:
    nodes, components = file["nodes"][()], file["components"][()]
    stiffness, mass = (
        sparse.csr_array(
            tuple(file[name][part][()] for part in ("data", "indices", "indptr")),
            shape=(nodes.size,) * 2,
        )
        for name in _MATRICES
    )
    return MatrixResult(stiffness, mass, nodes, components)


def _read_reduced(file: h5py.Group) -> ReducedModel:
    stiffness, mass = (_read_reduced_parts(file[f"{name}_parts"]) for name in _MATRICES)
    return ReducedModel(
        reference=file["reference"][()],
        shift=float(file.attrs["shift"]),
        base_stiffness=file["base_stiffness"][()],
        base_mass=file["base_mass"][()],
        stiffness=stiffness,
        mass=mass,
        rows=file["rows"][()],
    )


def _write_parts(file: h5py.Group, name: str, parts: Sequence[Part | ReducedPart]) -> None:
    group = file.create_group(f"{name}_parts")
    for number, part in enumerate(parts):
        item = group.create_group(f"{number:06d}")  # read back in the order of names
        item.attrs["column"] = part.column
        item["powers"] = np.array(part.powers, dtype=np.int64)
        item["values"] = part.values
        if isinstance(part, Part):
            item["places"] = part.places


def _read_affine_parts(group: h5py.Group) -> tuple[Part, ...]:
    return tuple(
        Part(int(item.attrs["column"]), tuple(item["powers"][()].tolist()), item["places"][()],
             item["values"][()])
        for item in group.values()
    )  # fmt: skip


def _read_reduced_parts(group: h5py.Group) -> tuple[ReducedPart, ...]:
    return tuple(
        ReducedPart(int(item.attrs["column"]), tuple(item["powers"][()].tolist()),
                    item["values"][()])
        for item in group.values()
    )  # fmt: skip
