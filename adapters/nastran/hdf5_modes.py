"""The modes in an HDF5 result file of MSC Nastran (MDLPRM,HDF5,1): /NASTRAN and its tables.

    RESULT/DOMAINS               ID, SUBCASE, MODE, TIME_FREQ_EIGR (the eigenvalue), EIGI
    RESULT/SUMMARY/EIGENVALUE    MODE, EIGEN, MASS ...; eigenvalues in (rad/s)^2
    RESULT/NODAL/EIGENVECTOR     ID, X, Y, Z, RX, RY, RZ, DOMAIN_ID, of all modes in one table
    INPUT/NODE/GRID              ID, CP, X (3), CD

Names and fields are those of the program's own description of its data types. Of several subcases
the first is read.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modetune.adapters.hdf5_reader import read_hdf5
from modetune.adapters.nastran.results import GridShape, shape_matrix
from modetune.core.errors import ModelError
from modetune.core.modes import Floats, Integers, ModeSet, mode_set

DOMAINS, SHAPES, GRIDS = (
    "/NASTRAN/RESULT/DOMAINS",
    "/NASTRAN/RESULT/NODAL/EIGENVECTOR",
    "/NASTRAN/INPUT/NODE/GRID",
)
COMPONENTS = ("X", "Y", "Z", "RX", "RY", "RZ")
#: Fields that each table must have.
FIELDS = {
    DOMAINS: ("ID", "SUBCASE", "MODE", "TIME_FREQ_EIGR", "EIGI"),
    SHAPES: ("ID", *COMPONENTS, "DOMAIN_ID"),
    GRIDS: ("ID", "CP", "X"),
}
Table = NDArray[Any]


def read_hdf5_modes(path: Path) -> tuple[ModeSet, tuple[Integers, Floats]]:
    """The modes of a file, and nodes (n,) with coordinates (n, 3) where all are in basic axes.

    Raises ValueError with the reason where it holds none.
    """
    tables = read_hdf5(path, (DOMAINS, SHAPES, GRIDS))
    domains, shapes = _table(tables[DOMAINS], DOMAINS), _table(tables[SHAPES], SHAPES)
    first = domains[np.isin(domains["ID"], shapes["DOMAIN_ID"])]
    first = first[first["SUBCASE"] == first["SUBCASE"][:1]]
    if not first.size:
        raise ValueError("its eigenvectors are of no domain that it lists")
    if first["EIGI"].any():
        raise ValueError("its modes are complex; real normal modes (SOL 103) are needed")
    first = first[np.argsort(first["MODE"], kind="stable")]
    grids = [_shape(domain, shapes[shapes["DOMAIN_ID"] == domain["ID"]]) for domain in first]
    nodes, components, matrix = shape_matrix(grids, len(grids))
    frequencies = np.sqrt(np.maximum(first["TIME_FREQ_EIGR"], 0.0)) / (2.0 * np.pi)
    modes = mode_set(frequencies, matrix, nodes, components)
    try:
        points = _table(tables[GRIDS], GRIDS)
    except ValueError:
        points = np.zeros(0, dtype=[("ID", "i8"), ("CP", "i8"), ("X", "f8", 3)])
    placed = points.size and not points["CP"].any()
    kept = points if placed else points[:0]
    places = kept["X"].astype(np.float64).reshape(-1, 3)
    return modes, (kept["ID"].astype(np.int64), places)


def _table(found: dict[str, Table] | ModelError, name: str) -> Table:
    """One table. Raises ValueError where it is not there, or has other fields."""
    if isinstance(found, ModelError):
        raise ValueError(str(found))
    table = found.get("dense", np.zeros(0)).ravel()
    missing = [field for field in FIELDS[name] if field not in (table.dtype.names or ())]
    if missing:
        raise ValueError(f"its table {name} has no field {missing[0]}")
    return table


def _shape(domain: Any, rows: Table) -> GridShape:
    return GridShape(
        int(domain["MODE"]),
        float(domain["TIME_FREQ_EIGR"]),
        rows["ID"].astype(np.int64),
        np.zeros(rows.size, dtype=np.bool_),
        np.stack([rows[name] for name in COMPONENTS], axis=1).astype(np.float64),
    )
