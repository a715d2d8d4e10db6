"""A function of Python behind the solver seam: it takes parameter values and returns a model.

It returns frequencies_hz (n_modes,) and mode_shapes (n_dof, n_modes), or the stiffness and mass
matrices (n_dof, n_dof), dense or sparse, whose modes are computed here. Its rows are at the deck's
`dofs`. It gets each value by name where its arguments have the names of the parameters, else one
array in their order. It runs in this process, so no timeout can stop it.
"""

from __future__ import annotations

import hashlib
import inspect
import linecache
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from modetune.adapters.function.deck import EditedFunction, FunctionDeck, read_deck
from modetune.adapters.solver import (
    Analysis,
    Capabilities,
    Command,
    ModalAnalysis,
    Rendered,
    Solver,
)
from modetune.core.algebra.eigen import available_modes
from modetune.core.algebra.factorisation import symmetric_matrix
from modetune.core.algebra.matrices import upper_triangle
from modetune.core.algebra.repeated_modes import canonical_rotation
from modetune.core.algebra.rigid_modes import GIVEN, matrix_energies
from modetune.core.errors import ModelError, ModesError, SolverMissing, SolverRejected
from modetune.core.modes import Floats, dof_name, mode_set
from modetune.core.near_names import listed
from modetune.core.parameters import Parameter
from modetune.core.storage.keys import Json
from modetune.core.updating.job_results import ModalResult

#: What a function may return, for messages.
GIVES = "(frequencies_hz, mode_shapes) or (stiffness, mass)"


@dataclass(frozen=True)
class UserFunction:
    """A function of the user; version: of its results, empty where none may be used again."""

    function: Callable[..., Any]
    version: str = ""

    @cached_property
    def name(self) -> str:
        inner = self._plain
        return str(getattr(inner, "__name__", type(inner).__name__))

    @cached_property
    def file(self) -> str:
        """The file of its text, empty where it has none."""
        code = getattr(self._plain, "__code__", None)
        return str(code.co_filename) if code else ""

    @property
    def place(self) -> str:
        """Its name, file and line."""
        code = getattr(self._plain, "__code__", None)
        if not code:
            return self.name
        return f"{self.name} ({Path(self.file).name}, line {code.co_firstlineno})"

    @cached_property
    def digest(self) -> str:
        """A digest of its text, empty where it has none; its version covers what it calls."""
        try:
            return hashlib.sha256(inspect.getsource(self._plain).encode()).hexdigest()
        except (OSError, TypeError):
            return ""

    @property
    def _plain(self) -> Any:
        """The function below decorators and partial arguments."""
        inner: Any = self.function
        while isinstance(inner, partial):
            inner = inner.func
        return inspect.unwrap(inner) if callable(inner) else inner

    def takes_names(self, names: Sequence[str]) -> bool:
        """Return whether it takes values by name, not as one array. Raises ModelError."""
        try:
            arguments = inspect.signature(self.function).parameters.values()
        except (TypeError, ValueError):  # compiled, without a signature
            return False
        kinds = {item.kind for item in arguments}
        by_name = {
            item.name
            for item in arguments
            if item.kind in (item.POSITIONAL_OR_KEYWORD, item.KEYWORD_ONLY)
        }
        required = [item for item in arguments if item.default is item.empty]
        required = [
            item for item in required if item.kind not in (item.VAR_POSITIONAL, item.VAR_KEYWORD)
        ]
        if {item.name for item in required} <= set(names) and (
            set(names) <= by_name or inspect.Parameter.VAR_KEYWORD in kinds
        ):
            return True
        places = [item for item in arguments if item.kind is not item.KEYWORD_ONLY]
        if places and all(item is places[0] for item in required):
            return False
        raise ModelError(
            f"{self.place} has the arguments {', '.join(item.name for item in arguments) or 'none'}"
            f", but the parameters are {', '.join(names)}: name its arguments after the "
            "parameters, or give it one argument for the array of their values in this order"
        )

    def called(self, values: Mapping[str, float]) -> Any:
        """Return what it returns at these values. Raises SolverRejected where it fails."""
        by_name = self.takes_names(tuple(values))
        try:
            if by_name:
                return self.function(**values)
            return self.function(np.array(list(values.values())))
        except Exception as error:  # a user's function may raise anything
            raise SolverRejected(
                f"{self.failure(error)} {at_values(values)}; correct the function, or narrow the "
                "bounds to values that it can take"
            ) from error

    def failure(self, error: Exception) -> str:
        """Return where it failed, and with what."""
        frames = traceback.extract_tb(error.__traceback__)[1:]
        own = [frame for frame in frames if frame.filename == self.file] or frames
        raised = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
        if not own:  # the call itself, with its arguments
            return f"the function {self.place} raised {raised}"
        last = own[-1]
        line = (last.line or linecache.getline(last.filename, last.lineno or 0)).strip()
        return (
            f"{Path(last.filename).name}, line {last.lineno}, in {last.name}: `{line}` raised "
            f"{raised}"
        )


def at_values(values: Mapping[str, float]) -> str:
    """Return parameter values as a message has them."""
    return "at " + listed([f"{name} = {value!r}" for name, value in values.items()], 12)


@dataclass(frozen=True)
class FunctionProgram:
    """A function as a program that runs in this process."""

    function: UserFunction
    name = "function"
    #: Raised by hand when the same function gives other numbers.
    reader_version = 1
    capabilities = Capabilities(strain_energies=False, matrices=False, tell_rigid=True)

    def version(self) -> str:
        return self.function.version or "without a version"

    def render(self, deck: EditedFunction, analysis: Analysis) -> Rendered:
        assert isinstance(analysis, ModalAnalysis)
        own = deck.deck
        rows = zip(own.nodes.tolist(), own.components.tolist(), strict=True)
        content: Json = {
            "solver": self.name,
            "version": self.version(),
            "reader": self.reader_version,
            "model": [self.function.name, self.function.digest],
            "values": dict(deck.values),
            "dofs": [dof_name(dof) for dof in rows],
            "n_modes": analysis.n_modes,
            "nodes": list(analysis.nodes),
        }
        return Rendered.of_call(content, partial(solve_function, self.function, deck, analysis))

    def command(self, threads: int) -> Command:
        raise SolverMissing(f"{self.function.place} runs in this process and has no command")

    def read(
        self, deck: EditedFunction, analysis: Analysis, folder: Path, return_code: int
    ) -> ModalResult:
        raise SolverMissing(f"{self.function.place} runs in this process and leaves no files")


def function_solver(
    function: UserFunction, deck: Path, parameters: tuple[Parameter, ...]
) -> Solver:
    """Return a function as the solver of its deck. Raises ModelError where the two do not fit."""
    read = read_deck(deck, parameters)
    function.takes_names(tuple(read.values))
    return Solver(read, FunctionProgram(function))


def solve_function(
    function: UserFunction, edited: EditedFunction, analysis: ModalAnalysis
) -> ModalResult:
    """Return the lowest modes of what a function returns. Raises SolverRejected."""
    found = function.called(edited.values)
    try:
        return _modes(found, edited.deck, analysis)
    except (ModelError, ModesError, TypeError, ValueError) as error:
        raise SolverRejected(
            f"what {function.place} returned {at_values(edited.values)} does not fit: {error}"
        ) from error


def _modes(found: Any, deck: FunctionDeck, analysis: ModalAnalysis) -> ModalResult:
    if not isinstance(found, tuple | list) or len(found) != 2:
        raise ModesError(f"it is a {_kind(found)}; expected {GIVES}")
    parts: list[Any] = [item if sparse.issparse(item) else np.asarray(item) for item in found]
    first, second = parts
    n_dof = deck.nodes.size
    for name, item in zip(("first", "second"), (first, second), strict=True):
        numbers = item if isinstance(item, np.ndarray) else item.tocsr().data
        if numbers.dtype.kind not in "fiu":
            raise ModesError(f"its {name} part has {numbers.dtype} values; expected real numbers")
        if not np.isfinite(numbers).all():
            bad = np.count_nonzero(~np.isfinite(numbers))
            raise ModesError(
                f"its {name} part has {bad} values that are NaN or infinite; expected finite "
                "numbers"
            )
    if first.ndim == 2:
        if first.shape != (n_dof, n_dof) or second.shape != (n_dof, n_dof):
            raise ModesError(
                f"its matrices have the shapes {first.shape} and {second.shape}; expected "
                f"{(n_dof, n_dof)} for stiffness and mass, a row for each of the {n_dof} `dofs`"
            )
        eigenvalues, shapes, energies = _solved(first, second, analysis.n_modes)
    else:
        if first.ndim != 1 or not first.size or second.shape != (n_dof, first.size):
            raise ModesError(
                f"its parts have the shapes {first.shape} and {second.shape}; expected (n_modes,) "
                f"for frequencies in Hz and ({n_dof}, n_modes) for shapes, a row for each of the "
                f"{n_dof} `dofs`"
            )
        if first.min() < 0.0:
            raise ModesError(f"a frequency is {first.min():g} Hz; expected none below zero")
        order = np.argsort(first, kind="stable")[: analysis.n_modes]
        eigenvalues = (2.0 * np.pi * first[order].astype(np.float64)) ** 2
        shapes, energies = second[:, order], np.full(order.size, np.nan)
    seen = np.isin(deck.nodes, analysis.nodes)
    return ModalResult(
        eigenvalues=eigenvalues,
        modes=mode_set(
            np.sqrt(np.maximum(eigenvalues, 0.0)) / (2.0 * np.pi),
            shapes[seen],
            deck.nodes[seen],
            deck.components[seen],
            normalisation="mass" if first.ndim == 2 else "unknown",
        ),
        groups=(),
        strain_energies=np.zeros((0, eigenvalues.size)),
        total_strain_energy=energies,
        mass=float("nan"),
    )


def _solved(stiffness: Any, mass: Any, n_modes: int) -> tuple[Floats, Floats, Floats]:
    """Return eigenvalues, mass-normalised shapes and strain energies of the lowest modes."""
    K, M = symmetric_matrix(stiffness, "stiffness"), symmetric_matrix(mass, "mass")
    eigenvalues, shapes = available_modes(K, M, n_modes)
    shapes = shapes @ canonical_rotation(eigenvalues, shapes)
    return eigenvalues, shapes, matrix_energies(upper_triangle(K), shapes, GIVEN)


def _kind(found: Any) -> str:
    """Return what kind of object this is, with its length where it is a sequence."""
    size = f" of {len(found)}" if isinstance(found, tuple | list) else ""
    return f"{type(found).__name__}{size}"
