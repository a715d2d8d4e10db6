"""A mass on two springs in series."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.solver import Analysis, Capabilities, Solver
from modetune.core.errors import SolverRejected
from modetune.core.measurement.measurement import Measurement
from modetune.core.modes import Floats, MeasuredModes, mode_set
from modetune.core.parameters import Values
from modetune.core.updating.job_results import ModalResult, Result
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.schema import SensitivitySection
from tests.flows.conftest import Bench, ChainDeck, ScriptedProgram, recased

#: Stiffnesses of the springs and the mass.
FIRST, SECOND, MASS = 1500.0, 500.0, 2.0


def series_hz(k1: Floats, k2: Floats, m1: Floats) -> Floats:
    """The frequency of the mass at relative values."""
    stiffness = 1.0 / (1.0 / (FIRST * k1) + 1.0 / (SECOND * k2))
    return np.asarray(np.sqrt(stiffness / (MASS * m1)) / (2.0 * np.pi))


@dataclass(frozen=True)
class SeriesProgram(ScriptedProgram):
    """The scripted program with one mass on two springs in series behind it, and modes alone."""

    @property
    def capabilities(self) -> Capabilities:
        return Capabilities(False, False, False, False)

    def read(self, deck: Values, analysis: Analysis, folder: Path, return_code: int) -> Result:
        if "REJECTED" in (folder / "solver.log").read_text():
            raise SolverRejected(f"the scripted solver refused its input in {folder}")
        at = (np.array([deck.get(name, 1.0)]) for name in ("k1", "k2", "m1"))
        frequency = series_hz(*at)
        eigenvalue = (2.0 * np.pi * frequency) ** 2
        modes = mode_set(frequency, np.ones((1, 1)), [1], [1], normalisation="mass")
        return ModalResult(eigenvalue, modes, (), np.zeros((0, 1)), 0.5 * eigenvalue, MASS)


@pytest.fixture
def series(bench: Bench) -> Campaign:
    """A campaign on the mass: both springs and the mass within 0.5 and 1.5."""
    campaign = bench.campaign(
        {"k1": 1.2},
        modes=(1,),
        bounds=(0.5, 1.5),
        parameters={"k1": "spring_stiffness", "k2": "spring_stiffness", "m1": "mass"},
        sensitivity=SensitivitySection(method="finite_difference", difference="central", step=1e-3),
    )
    one = np.ones(1)
    test = MeasuredModes((1,), mode_set(series_hz(1.2 * one, one, one)))
    return recased(
        campaign,
        solver=Solver(ChainDeck(), SeriesProgram(bench.folder)),
        test=test,
        measurement=Measurement(test),
    )
