"""Which capabilities the self-test of an installation has passed: `modetune doctor` notes them.

An installation is a program's name, version and command line; a new version, another start script
or another option asks for the test again. What passed stands in the user's own folder, one file an
installation, so that machines that share a home share it.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path

from modetune.adapters.solver import Program, Solver
from modetune.core.errors import SolverMissing
from modetune.core.storage.files import writing
from modetune.core.storage.keys import Json, canonical_json, content_key
from modetune.flows.campaign.site import HOME_VARIABLE, user_home

#: Threads with which the command line is asked for: options for several are part of it.
THREADS = 2
REMEDY = f"name another place with {HOME_VARIABLE}"


def passed_here(program: Program) -> frozenset[str]:
    """The capabilities that the self-test has passed; none where the program is missing."""
    if not program.capabilities.to_confirm:
        return frozenset()
    try:
        told = json.loads(_place(program).read_text(encoding="utf-8"))
        return frozenset(map(str, told["passed"]))
    except (OSError, ValueError, KeyError, TypeError, SolverMissing):
        return frozenset()


def note_passed(program: Program, passed: Iterable[str]) -> Path:
    """Note what the self-test passed, in place of what it passed before.

    Raises StorageUnavailable, SolverMissing.
    """
    place = _place(program)
    told = {**_installation(program), "passed": sorted(passed)}
    with writing(place, REMEDY) as part:
        part.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    return place


def not_confirmed(solver: Solver) -> str:
    """What of the solver is left aside until a self-test has passed it; empty where nothing is."""
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
