"""Mode shapes on a mesh as ParaView reads them: a .vtu file a mode, and a .pvd file over them.

Whatever solver they come from, the files have the same names in them: `mode_shape` (three
components, global axes, mass-normalised) and `node` at points, `element` at cells, and `mode`,
`frequency_hz` and `TimeValue` as fields. The time of a step is the number of its mode, since
frequencies may repeat.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable, Iterator, Mapping
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from modetune.core.errors import StorageUnavailable
from modetune.core.mesh import CellKind, Mesh, global_shapes
from modetune.core.modes import Floats, Integers, ModeSet
from modetune.core.storage.files import storage_errors

if TYPE_CHECKING:
    import pyvista

#: VTK's numbers of cell types (vtkCellType.h).
VTK_TYPES: dict[CellKind, int] = {
    "vertex": 1, "line": 3, "line3": 21, "triangle": 5, "triangle6": 22, "quad": 9, "quad8": 23,
    "tetra": 10, "tetra10": 24, "pyramid": 14, "pyramid13": 27, "wedge": 13, "wedge15": 26,
    "hexahedron": 12, "hexahedron20": 25,
}  # fmt: skip
#: The files of a series in its folder.
OWN_FILE = re.compile(r"mode_\d+\.vtu")
#: Names of data at points and cells.
SHAPE, NODE, ELEMENT = "mode_shape", "node", "element"
#: Names of fields: the mode's number, its frequency, and what ParaView takes for the time.
MODE, FREQUENCY, TIME = "mode", "frequency_hz", "TimeValue"


def unstructured_grid(mesh: Mesh) -> pyvista.UnstructuredGrid:
    """Return the mesh for VTK; points are its nodes, cells follow block by block."""
    import pyvista

    none = np.zeros(0, dtype=np.int64)
    blocks = [
        np.insert(mesh.rows(cells.nodes), 0, cells.nodes.shape[1], axis=1).ravel()
        for cells in mesh.cells
    ]
    kinds = [np.full(cells.elements.size, VTK_TYPES[cells.kind]) for cells in mesh.cells]
    grid = pyvista.UnstructuredGrid(
        np.concatenate([none, *blocks]),
        np.concatenate([none, *kinds]).astype(np.uint8),
        mesh.coordinates,
    )
    grid.point_data[NODE] = mesh.nodes
    grid.cell_data[ELEMENT] = np.concatenate([none, *(cells.elements for cells in mesh.cells)])
    return grid


def mode_grids(mesh: Mesh, modes: ModeSet) -> Iterator[pyvista.UnstructuredGrid]:
    """Yield the mesh with the shape of one mode after another."""
    grid = unstructured_grid(mesh)
    for shape in global_shapes(mesh, modes):
        grid.point_data[SHAPE] = shape
        yield grid


def write_fields(path: Path, mesh: Mesh, fields: Mapping[str, tuple[Integers, Floats]]) -> Path:
    """Write the mesh with values of its cells, NaN where an element has none.

    fields: by name the numbers of elements and their values, (n,) each. Raises StorageUnavailable.
    """
    grid = unstructured_grid(mesh)
    for name, (elements, values) in fields.items():
        known = dict(zip(elements.tolist(), values.tolist(), strict=True))
        numbers = grid.cell_data[ELEMENT].tolist()
        grid.cell_data[name] = np.array([known.get(number, np.nan) for number in numbers])
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        grid.save(path)
    return path


def write_series(
    folder: Path, name: str, grids: Iterable[pyvista.UnstructuredGrid], frequencies_hz: Floats
) -> Path:
    """Write NAME.pvd and NAME/mode_*.vtu; what stood there is replaced once all is written.

    grids: one a mode, in the order of frequencies_hz (n_modes,). Returns the .pvd file.
    Raises StorageUnavailable, also where NAME holds what this function never wrote; and what
    making the grids raises.
    """
    part, place, series = folder / f"{name}.part", folder / name, folder / f"{name}.pvd"
    digits = len(str(frequencies_hz.size))
    lines = []
    with storage_errors(part):
        check_series(folder, name)
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        try:
            for mode, (grid, hz) in enumerate(
                zip(grids, frequencies_hz.tolist(), strict=True), start=1
            ):
                grid.field_data[MODE] = np.array([mode])
                grid.field_data[FREQUENCY] = np.array([hz])
                grid.field_data[TIME] = np.array([float(mode)])
                file = f"mode_{mode:0{digits}}.vtu"
                grid.save(part / file)
                lines.append(
                    f'    <DataSet timestep="{mode}" part="0" name="mode {mode}: {hz:.6g} Hz" '
                    f'file="{escape(name)}/{file}"/>'
                )
        except BaseException:
            shutil.rmtree(part, ignore_errors=True)
            raise
        shutil.rmtree(place, ignore_errors=True)
        part.rename(place)
        series.write_text("\n".join([PVD_HEAD, *lines, PVD_TAIL]) + "\n", encoding="utf-8")
    return series


def check_series(folder: Path, name: str) -> None:
    """Fail where what a series would replace is not a series. Raises StorageUnavailable."""
    for old in (folder / name, folder / f"{name}.part"):
        with storage_errors(old):
            _refuse_strangers(old)


def _refuse_strangers(folder: Path) -> None:
    if not folder.exists() and not folder.is_symlink():
        return
    if folder.is_symlink() or not folder.is_dir():
        raise StorageUnavailable(
            f"{folder} is not a folder of mode shapes, and one is written there; move it, or name "
            "another place"
        )
    strange = sorted(file.name for file in folder.iterdir() if not OWN_FILE.fullmatch(file.name))
    if strange:
        raise StorageUnavailable(
            f"{folder} holds {strange[0]}, which is not a mode_*.vtu file of a series, so it is "
            "not replaced; move it, or name another place"
        )


PVD_HEAD = (
    '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1" byte_order="LittleEndian">\n'
    "  <Collection>"
)
PVD_TAIL = "  </Collection>\n</VTKFile>"
