"""Packages of the extras of `modetune[...]`, and the message about one that is not installed.

A cluster's packages report themselves.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from modetune.core.errors import ModetuneError

#: The extra that brings a package.
EXTRAS = {
    **dict.fromkeys(("polars", "pypardiso"), "calculix"),
    **dict.fromkeys(("pyvista", "vtkmodules", "ccx2paraview"), "pictures"),
    **dict.fromkeys(("SALib", "emcee"), "studies"),
    "pyoma2": "oma",
    "xarray": "arrays",
    "prefect_dask": "cluster",
}


@contextmanager
def named_extras() -> Iterator[None]:
    """Name the extra of a package that is not installed. Raises ModetuneError."""
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if package not in EXTRAS:
            raise
        raise ModetuneError(
            f"this requires the package {package}, which is not installed: pip install "
            f"'modetune[{EXTRAS[package]}]', or modetune[all] for everything"
        ) from error
