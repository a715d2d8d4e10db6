"""Which solver runs a campaign's model: the one place that names the adapters.

An adapter is imported when a campaign asks for it. `calculix` takes CalculiX decks as they are and
Nastran decks through their translation.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from modetune.adapters.regular_file import open_regular
from modetune.adapters.solver import Solver
from modetune.core.errors import ModelError
from modetune.core.parameters import Parameter
from modetune.flows.campaign.schema import ModelSection, SolverName
from modetune.flows.campaign.self_test import passed_here

#: What a Nastran deck starts with: a comment, a statement, or a card.
NASTRAN_START = re.compile(r"\$|[A-Z][A-Z0-9]*[*,=(\s]|CEND|[A-Z0-9]{1,8}\s*$", re.IGNORECASE)


def bind_solver(model: ModelSection, deck: Path, parameters: tuple[Parameter, ...]) -> Solver:
    """The campaign's solver bound to its deck. Raises ModelError."""
    solver = SOLVERS[model.solver](model, deck, parameters)
    return replace(solver, confirmed=passed_here(solver.program))


def _calculix(model: ModelSection, deck: Path, parameters: tuple[Parameter, ...]) -> Solver:
    if is_nastran(deck):
        from modetune.adapters.translation.solver import translated_solver

        return translated_solver(deck, parameters)
    from modetune.adapters.calculix.solver import calculix_solver

    return calculix_solver(deck, parameters)


def _nastran(model: ModelSection, deck: Path, parameters: tuple[Parameter, ...]) -> Solver:
    from modetune.adapters.nastran.solver import nastran_solver

    return nastran_solver(_nastran_deck(deck), parameters, model.dialect)


def _mystran(model: ModelSection, deck: Path, parameters: tuple[Parameter, ...]) -> Solver:
    from modetune.adapters.nastran.solver import mystran_solver

    return mystran_solver(_nastran_deck(deck), parameters)


def _matrices(model: ModelSection, deck: Path, parameters: tuple[Parameter, ...]) -> Solver:
    from modetune.adapters.matrices.solver import matrices_solver

    return matrices_solver(deck, parameters)


#: What binds each solver of a campaign to its model.
SOLVERS: dict[SolverName, Callable[[ModelSection, Path, tuple[Parameter, ...]], Solver]] = {
    "calculix": _calculix,
    "nastran": _nastran,
    "mystran": _mystran,
    "matrices": _matrices,
}


def is_nastran(deck: Path) -> bool:
    """Whether a deck is Nastran's: its first line of content is not a CalculiX keyword."""
    try:
        with (
            open_regular(deck) as file,
            io.TextIOWrapper(file, encoding="utf-8", errors="replace") as lines,
        ):
            first = next((line for line in lines if line.strip()), "")
    except OSError as error:
        raise ModelError(f"{deck} cannot be read: {error.strerror}") from error
    if not first:
        raise ModelError(f"{deck} is empty; a deck was expected")
    return NASTRAN_START.match(first) is not None


def _nastran_deck(deck: Path) -> Path:
    if not is_nastran(deck):
        raise ModelError(f"{deck} is not a Nastran deck; `solver: calculix` runs CalculiX decks")
    return deck
