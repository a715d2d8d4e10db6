"""What a self-test has passed counts for its installation alone."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from modetune.adapters.solver import Capabilities, Command, Program, Solver
from modetune.core.errors import SolverMissing
from modetune.flows.campaign.schema import ModelSection
from modetune.flows.campaign.site import HOME_VARIABLE
from modetune.flows.campaign.solvers import (
    bind_solver,
    read_self_test,
    untested_capabilities,
    write_self_test,
)

SENSITIVITIES = frozenset(("frequency_sensitivities", "shape_sensitivities"))
DECK = """\
GRID,1
GRID,2,,1.
CELAS2,1,5.,1,1,2,1
CONM2,2,2,,3.
SPC1,1,123456,1
"""


@pytest.fixture(autouse=True)
def _own_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(HOME_VARIABLE, str(tmp_path / "home"))


@dataclass(frozen=True)
class Installation:
    """As much of a program as tells its installation."""

    release: str = "1"
    option: str = "a"
    name: str = "solver"

    @property
    def capabilities(self) -> Capabilities:
        waiting = SENSITIVITIES | {"matrices"}
        return Capabilities(True, False, frequency_sensitivities=True, to_confirm=waiting)

    def version(self) -> str:
        if not self.release:
            raise SolverMissing("it is not here")
        return self.release

    def command(self, threads: int) -> Command:
        return Command(("solver", self.option))


def installation(release: str = "1", option: str = "a") -> Program:
    return Installation(release, option)  # type: ignore[return-value]


def test_what_passed_counts_for_its_version_and_command_line_alone() -> None:
    assert read_self_test(installation()) == frozenset()
    write_self_test(installation(), SENSITIVITIES)
    assert read_self_test(installation()) == SENSITIVITIES
    for other in (installation("2"), installation(option="b"), installation("")):
        assert read_self_test(other) == frozenset()
    write_self_test(installation(), ["matrices"])  # a later test that passed less
    assert read_self_test(installation()) == {"matrices"}


def test_a_damaged_note_says_that_nothing_passed() -> None:
    write_self_test(installation(), SENSITIVITIES).write_text('{"passed": 3')
    assert read_self_test(installation()) == frozenset()


def test_a_solver_offers_what_was_confirmed() -> None:
    solver = Solver(None, installation())  # type: ignore[arg-type]
    assert solver.unconfirmed == ("frequency_sensitivities",)  # it has no others to confirm
    assert not solver.offers.frequency_sensitivities
    assert solver.offers.strain_energies
    assert "frequency sensitivities of solver are not used" in untested_capabilities(solver)
    again = replace(solver, confirmed=SENSITIVITIES)
    assert again.offers.frequency_sensitivities
    assert untested_capabilities(again) == ""


def test_a_campaigns_nastran_has_what_its_installation_passed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    deck, program = tmp_path / "two.bdf", tmp_path / "nastran"
    deck.write_text(DECK)
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    monkeypatch.setenv("MODETUNE_NASTRAN", str(program))
    section = ModelSection(deck=deck.name, solver="nastran", units="m-kg-s")
    before = bind_solver(section, deck, ())
    assert set(before.unconfirmed) == SENSITIVITIES
    write_self_test(before.program, SENSITIVITIES)
    assert bind_solver(section, deck, ()).unconfirmed == ()
    nx = bind_solver(section.model_copy(update={"dialect": "nx"}), deck, ())
    assert nx.unconfirmed == ("frequency_sensitivities",)  # it is started otherwise
    program.write_text("#!/bin/sh\n# a newer release\n")
    os.utime(program, ns=(1, 1))
    assert set(bind_solver(section, deck, ()).unconfirmed) == SENSITIVITIES
