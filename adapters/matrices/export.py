"""The matrices of a condensed or corrected model, in files for other programs.

    FILE.npz     stiffness, mass, nodes, components, and what else there is (NumPy)
    FILE.op4     KAAX and MAAX as OUTPUT4 text; their rows in FILE_dofs.txt
    FILE.bdf     the same as DMIG bulk data for K2GG and M2GG (also .dat, .nas, .dmig)
    FILE.yaml    a model of matrices that modetune itself takes, with FILE.h5 and FILE_dofs.txt

Unknowns that are no motion of a node (amplitudes of fixed-interface modes) follow the others, as
scalar points with numbers above those of the deck.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy import sparse

from modetune.adapters.matrices.dmig import dmig_lines
from modetune.adapters.matrices.matrix_files import op4_lines, write_matrix
from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, Integers, dof_name
from modetune.core.storage.files import check_writable, storage_errors, writing

BULK = (".bdf", ".dat", ".nas", ".dmig")
FORMS = (".npz", ".op4", *BULK, ".yaml")
STIFFNESS, MASS = "KAAX", "MAAX"


@dataclass(frozen=True, slots=True)
class WrittenMatrices:
    """stiffness, mass: (n, n), symmetric; nodes, components: (n,), of their rows.

    n_scalar: unknowns at the end that are scalar points; extra: arrays that npz takes along;
    comments: on how they came about.
    """

    stiffness: Floats
    mass: Floats
    nodes: Integers
    components: Integers
    n_scalar: int = 0
    extra: Mapping[str, Floats | Integers] = field(default_factory=dict)
    comments: tuple[str, ...] = ()


def check_form(path: Path) -> None:
    """Refuse what cannot be written, before the work is done. Raises CampaignError."""
    if path.suffix.lower() not in FORMS:
        raise CampaignError(
            f"{path}: matrices are written as {', '.join(FORMS)}, by the name of the file "
            "(CalculiX reads no matrices)"
        )
    check_writable(path.parent, "name another file with --out")


def write_matrices(path: Path, found: WrittenMatrices) -> tuple[Path, ...]:
    """Write the files of a form. Raises CampaignError, StorageUnavailable."""
    check_form(path)
    suffix, dofs = path.suffix.lower(), path.with_name(f"{path.stem}_dofs.txt")
    if suffix in BULK:
        with writing(path) as part:
            part.write_text("\n".join(_bulk(found)) + "\n", encoding="ascii", errors="replace")
        return (path,)
    if suffix == ".npz":
        named = {"nodes": found.nodes, "components": found.components, **found.extra}
        with writing(path) as part, part.open("wb") as out:
            np.savez(out, allow_pickle=False, stiffness=found.stiffness, mass=found.mass, **named)
        return (path,)
    with writing(dofs) as part:
        names = zip(found.nodes.tolist(), found.components.tolist(), strict=True)
        part.write_text("".join(f"{dof_name(name)}\n" for name in names))
    if suffix == ".op4":
        with writing(path) as part, part.open("w", encoding="ascii") as text:
            text.writelines(op4_lines(STIFFNESS, found.stiffness))
            text.writelines(op4_lines(MASS, found.mass))
        return path, dofs
    arrays = path.with_suffix(".h5")
    with storage_errors(arrays):
        arrays.unlink(missing_ok=True)
        for name, matrix in (("stiffness", found.stiffness), ("mass", found.mass)):
            write_matrix(arrays.parent, f"{arrays.name}:{name}", sparse.csr_array(matrix))
    lines = [f"# {line}" for line in found.comments]
    lines += [f'{name}: "{arrays.name}:{name}"' for name in ("stiffness", "mass")]
    with writing(path) as part:
        part.write_text("\n".join([*lines, f'dofs: "{dofs.name}"']) + "\n", encoding="utf-8")
    return path, arrays, dofs


def _bulk(found: WrittenMatrices) -> list[str]:
    """Return the lines of scalar points and matrices."""
    lines = [f"$ {line}" for line in found.comments]
    lines += [f"$ case control: K2GG = {STIFFNESS}, M2GG = {MASS}; the GRIDs are the deck's own"]
    scalar = found.nodes.size - found.n_scalar
    lines += [f"SPOINT  {node:8d}" for node in found.nodes[scalar:].tolist()]
    components = found.components.copy()
    components[scalar:] = 0
    names = list(zip(found.nodes.tolist(), components.tolist(), strict=True))
    for name, matrix in ((STIFFNESS, found.stiffness), (MASS, found.mass)):
        lines += dmig_lines(name, matrix, names)
    return lines
