"""A user's own reader of results: a function of Python, named by a file or a module.

    reader: read_modes.py:modes         a file next to the deck
    reader: laboratory.opensees:modes   a module that Python finds

It gets the job's folder (`pathlib.Path`) and gives frequencies_hz (n_modes,), mode_shapes
(n_dof, n_modes), nodes and components 1..6 (n_dof,), in this order. Its text is part of every job's
key.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from modetune.adapters.regular_file import read_regular
from modetune.core.errors import ModelError, ModesError, SolverRejected
from modetune.core.modes import ModeSet, mode_set

GIVES = "(frequencies_hz, mode_shapes, nodes, components)"
KEY = "`reader` under `model.command`"


@dataclass(frozen=True, slots=True)
class UserReader:
    """A function of the user, and the digest of its file."""

    name: str
    file: Path
    function: Callable[[Path], Any]
    digest: str

    def read(self, folder: Path) -> ModeSet:
        """Return the modes of a job's folder. Raises SolverRejected where the function fails."""
        try:
            frequencies, shapes, nodes, components = self.function(folder)
        except Exception as error:  # a user's function may raise anything
            place = traceback.extract_tb(error.__traceback__)[-1]
            inside = place.filename != __file__
            where = f"{place.filename}, line {place.lineno}" if inside else str(self.file)
            text = f"{type(error).__name__}: {error}" if inside else f"it must give {GIVES}"
            raise SolverRejected(
                f"{where}: the reader {self.name} failed on {folder}: {text}"
            ) from error
        try:
            return mode_set(np.asarray(frequencies, dtype=np.float64), shapes, nodes, components)
        except (ModesError, ValueError, TypeError) as error:
            raise SolverRejected(
                f"{self.file}: what the reader {self.name} gives for {folder} does not fit "
                f"{GIVES}: {error}"
            ) from error


def load_reader(name: str, folder: Path) -> UserReader:
    """Return the function that a campaign names; folder: the deck's. Raises ModelError."""
    place, _, function_name = name.rpartition(":")
    if not place or not function_name.isidentifier():
        raise ModelError(f"{name}: {KEY} is `file.py:function` or `package.module:function`")
    try:
        module = _of_file(folder / place) if place.endswith(".py") else _of_name(place)
    except Exception as error:  # whatever importing a user's module raises
        frames = traceback.extract_tb(error.__traceback__)
        own = [frame for frame in frames if place.rpartition(".")[0] in frame.filename]
        at = f", line {own[-1].lineno}" if own and own[-1].filename.endswith(".py") else ""
        if isinstance(error, SyntaxError):
            at = f", line {error.lineno}"
        raise ModelError(
            f"{place}{at}: {KEY} cannot be imported: {type(error).__name__}: {error}"
        ) from error
    function = getattr(module, function_name, None)
    if not callable(function):
        there = ", ".join(item for item, value in vars(module).items() if inspect.isfunction(value))
        raise ModelError(
            f"{place}: {KEY} names {function_name}, which is not a function there; there are: "
            f"{there or 'none'}"
        )
    try:
        file = Path(inspect.getfile(module))
        text = read_regular(file)
    except (OSError, TypeError) as error:
        raise ModelError(f"{place}: {KEY} must stand in a file of Python: {error}") from error
    return UserReader(name, file, function, hashlib.sha256(text).hexdigest())


def _of_name(name: str) -> ModuleType:
    return importlib.import_module(name)


def _of_file(path: Path) -> ModuleType:
    found = importlib.util.spec_from_file_location(f"modetune_reader_{path.stem}", path)
    if found is None or found.loader is None:
        raise ImportError(f"{path} is not a file of Python")
    module = importlib.util.module_from_spec(found)
    found.loader.exec_module(module)
    return module
