"""Selection of the solver for a campaign's model: the only module that names the adapters.

An adapter is imported when a campaign needs it. `calculix` takes CalculiX decks unchanged and
Nastran decks by translation. Other packages add solvers through an entry point of the group
`modetune.solvers`: its name is the solver's name in campaigns, and its object is a function that
returns a Solver for a deck's path and the parameters.

Some capabilities are used only after the self-test of the installation (`modetune doctor`) has
passed them. An installation is a program's name, version and command line; a new version, another
start script or another option requires a new test. What passed is noted in the user's own folder,
one file per installation, so that machines that share a home share it.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING

from modetune.adapters.regular_file import open_regular, read_errors
from modetune.adapters.solver import ModalCase, Program, Solver
from modetune.core.errors import ModelError, SolverMissing
from modetune.core.near_names import suggestion
from modetune.core.parameters import Parameter
from modetune.core.storage.files import writing
from modetune.core.storage.keys import Json, canonical_json, content_key
from modetune.flows.campaign.schema import ModelSection
from modetune.flows.campaign.site import HOME_VARIABLE, user_home
from modetune.flows.campaign.units import METRES

if TYPE_CHECKING:
    from modetune.adapters.function.solver import UserFunction

#: The name of the solver of a model that is a function of Python.
FUNCTION = "function"
#: Entry points of packages that bring a solver.
GROUP = "modetune.solvers"
#: The start of a Nastran deck: a comment, a statement, or a card.
NASTRAN_START = re.compile(r"\$|[A-Z][A-Z0-9]*[*,=(\s]|CEND|[A-Z0-9]{1,8}\s*$", re.IGNORECASE)


#: A function that binds a solver to a campaign's model and parameters.
Binder = Callable[[ModelSection, Path, tuple[Parameter, ...]], Solver]


def bind_solver(model: ModelSection, deck: Path, parameters: tuple[Parameter, ...]) -> Solver:
    """Return the campaign's solver bound to its deck. Raises ModelError."""
    if model.solver == FUNCTION:
        raise ModelError(
            f"{deck} belongs to a function of Python, which only the session that has it can run: "
            "call modetune.load or modetune.update with the function there; to run it from the "
            "command line or to deploy it, make it a program (`solver: command`)"
        )
    if model.solver in SOLVERS:
        solver = SOLVERS[model.solver](model, deck, parameters)
    else:
        solver = _registered(model.solver, deck, parameters)
    return replace(solver, confirmed=read_self_test(solver.program))


def bind_function(function: UserFunction) -> Binder:
    """Return what binds a function of Python to a campaign that was written for it."""
    from modetune.adapters.function.solver import function_solver

    return lambda model, deck, parameters: function_solver(function, deck, parameters)


def _calculix(model: ModelSection, deck: Path, parameters: tuple[Parameter, ...]) -> Solver:
    if is_nastran(deck):
        from modetune.adapters.translation.solver import translated_solver

        if model.step is not None:
            raise ModelError(f"{deck} is a Nastran deck: `model.subcase` chooses among its modes")
        return translated_solver(deck, parameters, model.subcase or 0)
    from modetune.adapters.abaqus.flattening import has_assembly
    from modetune.adapters.calculix.deck import read_deck

    if model.subcase is not None:
        raise ModelError(f"{deck} is a CalculiX deck: `model.step` chooses among its modes")
    read = read_deck(deck, model.step or 0)
    if has_assembly(read):
        from modetune.adapters.abaqus.solver import assembly_solver

        return assembly_solver(read, parameters)
    from modetune.adapters.calculix.solver import solver_of

    return solver_of(read, parameters)


def _nastran(model: ModelSection, deck: Path, parameters: tuple[Parameter, ...]) -> Solver:
    from modetune.adapters.nastran.solver import nastran_solver

    return nastran_solver(_nastran_deck(deck), parameters, model.dialect, model.subcase or 0)


def _mystran(model: ModelSection, deck: Path, parameters: tuple[Parameter, ...]) -> Solver:
    from modetune.adapters.nastran.solver import mystran_solver

    return mystran_solver(_nastran_deck(deck), parameters, model.subcase or 0)


def _matrices(model: ModelSection, deck: Path, parameters: tuple[Parameter, ...]) -> Solver:
    from modetune.adapters.matrices.solver import matrices_solver

    return matrices_solver(deck, parameters)


def _command(model: ModelSection, deck: Path, parameters: tuple[Parameter, ...]) -> Solver:
    from modetune.adapters.command.solver import command_solver

    assert model.command is not None
    return command_solver(deck, parameters, model.command.settings(METRES[model.units]))


def modal_cases(deck: Path) -> tuple[ModalCase, ...]:
    """Return the subcases or steps of a deck among which a campaign may choose.

    Empty where there is no choice. Raises ModelError.
    """
    if is_nastran(deck):
        from modetune.adapters.nastran.case_control import modal_subcases
        from modetune.adapters.nastran.deck import read_deck

        return modal_subcases(read_deck(deck))
    from modetune.adapters.calculix import deck as calculix
    from modetune.adapters.calculix.steps import frequency_steps

    found = frequency_steps(calculix.read_deck(deck))
    return found if len(found) > 1 else ()


def registered_solvers() -> dict[str, EntryPoint]:
    """Return the solvers of other installed packages by name, without importing them."""
    return {entry.name: entry for entry in entry_points(group=GROUP)}


def _registered(name: str, deck: Path, parameters: tuple[Parameter, ...]) -> Solver:
    """Return a solver of another package. Raises ModelError where there is none."""
    found = registered_solvers()
    if name not in found:
        raise ModelError(
            f"the solver {name} is not known here{suggestion(name, (*SOLVERS, *found))}; "
            f"packages bring others by an entry point of the group {GROUP}"
        )
    entry = found[name]
    package = f"package {entry.dist.name} {entry.dist.version}" if entry.dist else "its package"
    text = f"the solver {name} is `{entry.value}` of {package}"
    try:
        bind = entry.load()
    except Exception as error:  # importing a foreign module may raise anything
        raise ModelError(
            f"{text}, which cannot be imported: {type(error).__name__}: {error}; repair or remove "
            "that package"
        ) from error
    solver = bind(deck, parameters) if callable(bind) else bind
    if not isinstance(solver, Solver):
        raise ModelError(
            f"{text}, which gives a {type(solver).__name__} and must give a Solver of "
            "modetune.adapters.solver"
        )
    return solver


#: The function that binds each solver to its model.
SOLVERS: dict[str, Binder] = {
    "calculix": _calculix,
    "nastran": _nastran,
    "mystran": _mystran,
    "matrices": _matrices,
    "command": _command,
}


def is_nastran(deck: Path) -> bool:
    """Return whether a deck is Nastran's: its first line of content is not a CalculiX keyword."""
    with (
        read_errors(deck, ModelError),
        open_regular(deck) as file,
        io.TextIOWrapper(file, encoding="utf-8", errors="replace") as lines,
    ):
        first = next((line for line in lines if line.strip()), "")
    if not first:
        raise ModelError(f"{deck} is empty; a deck was expected")
    return NASTRAN_START.match(first) is not None


def _nastran_deck(deck: Path) -> Path:
    if not is_nastran(deck):
        raise ModelError(f"{deck} is not a Nastran deck; `solver: calculix` runs CalculiX decks")
    return deck


#: Threads for the command line of an installation, which includes options for several threads.
THREADS = 2
REMEDY = f"name another place with {HOME_VARIABLE}"


def read_self_test(program: Program) -> frozenset[str]:
    """Return the capabilities that passed the self-test; none where the program is missing."""
    if not program.capabilities.to_confirm:
        return frozenset()
    try:
        told = json.loads(_place(program).read_text(encoding="utf-8"))
        return frozenset(map(str, told["passed"]))
    except (OSError, ValueError, KeyError, TypeError, SolverMissing):
        return frozenset()


def write_self_test(program: Program, passed: Iterable[str]) -> Path:
    """Write the capabilities that passed the self-test, over those of an earlier test.

    Raises StorageUnavailable, SolverMissing.
    """
    place = _place(program)
    told = {**_installation(program), "passed": sorted(passed)}
    with writing(place, REMEDY) as part:
        part.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    return place


def untested_capabilities(solver: Solver) -> str:
    """Return why capabilities wait for a self-test; empty where none do."""
    names = " and ".join(name.replace("_", " ") for name in solver.unconfirmed)
    name = solver.program.name
    dialect = " (with --dialect as in the campaign)" if name == "nastran" else ""
    return names and (
        f"{names} of {name} are not used, because `modetune doctor --solver {name}`{dialect} has "
        "not passed for this installation (its version and command line)"
    )


def _installation(program: Program) -> dict[str, Json]:
    return {
        "solver": program.name,
        "version": program.version(),
        "command": list(program.command(THREADS).arguments),
    }


def _place(program: Program) -> Path:
    key = content_key(canonical_json(_installation(program)))
    return user_home() / "self_tests" / f"{program.name}-{key[:16]}.json"
