"""Tests of the solver features that campaigns need, with one line of the report each.

The tests compare modes with a closed form, strain energies with the eigenvalues, the solver's own
sensitivities with central differences of its modes, and the modes of its matrices with its modes.
They work for any campaign's solver; models of ten elements (`ten_elements.py`) have the closed
forms. The jobs are ordinary jobs without retries and waiting.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from modetune.adapters.solver import (
    Analysis,
    MatrixAnalysis,
    ModalAnalysis,
    Program,
    SensitivityAnalysis,
)
from modetune.core.algebra.eigen import solve_modes
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import (
    LicenceDenied,
    ModetuneError,
    SolverCancelled,
)
from modetune.core.modes import Floats, Integers
from modetune.core.updating.job_results import ModalResult, Result
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.job import Job
from modetune.flows.studies.doctor.installation import DoctorLine, State, Tell
from modetune.flows.studies.doctor.ten_elements import TenElements
from modetune.flows.updating.sensitivities import BALANCE_TOLERANCE, EIGENVALUE_TOLERANCE

R = TypeVar("R", bound=Result)

#: Number of modes to compute.
N_MODES = 4
#: Relative tolerance of eigenvalues against a closed form. Programs write seven digits.
CLOSED_FORM = 1e-5
#: Tolerance of modal masses: shapes have five printed digits or more, and enter squared.
MODAL_MASS = 1e-4
#: Relative step of central differences. The error is 1e-7 / 0.02 from seven printed digits, and
#: step^2 / 6 times the third derivative.
STEP = 0.01
#: Tolerance of derivatives, relative to the largest of a parameter: ten times both errors.
DERIVATIVES = 1e-3
#: The same for shapes, which have fewer printed digits.
SHAPES = 1e-2
#: Number of parameters of a user's campaign to test.
PARAMETERS = 3
#: Solvers that need no licence.
FREE = ("calculix", "mystran", "matrices")
REPORT = "please report this with the file that `modetune doctor` wrote"


@dataclass(frozen=True, slots=True)
class Verdict:
    """The outcome of one test."""

    state: State
    said: str
    remedy: str = ""


@dataclass(slots=True)
class SolverTests:
    """The tests of one campaign's solver. confirmed: capabilities that have passed so far."""

    campaign: Campaign
    model: TenElements | None
    tell: Tell
    working: Callable[[str], None]
    confirmed: set[str]
    modal: ModalResult | None = None

    @property
    def program(self) -> Program:
        return self.campaign.cases[0].solver.program

    def run(self) -> None:
        """Run all tests and report one line for each."""
        if self._line("program", self._version) != "passed":
            return
        self._line("modes", self._modes)
        for item, test in (
            ("strain energies", self._energies),
            ("sensitivities", self._sensitivities),
            ("matrices", self._matrices),
        ):
            self._line(item, test if self.modal is not None else _without_modes)

    def _line(self, item: str, test: Callable[[], Verdict]) -> State:
        self.working(f"{self.program.name}: {item}")
        started = time.monotonic()
        try:
            found = test()
        except SolverCancelled:
            raise
        except ModetuneError as error:
            denied = isinstance(error, LicenceDenied)
            remedy = "try again when a licence is free" if denied else ""
            found = Verdict("failed", str(error), remedy)
        except ModuleNotFoundError as error:  # a package of an extra
            text = f"this requires the package {error.name}, which is not installed"
            found = Verdict("not available", text, "install the extra that contains it (see above)")
        seconds = time.monotonic() - started
        self.tell(
            DoctorLine(self.program.name, item, found.state, found.said, found.remedy, seconds)
        )
        return found.state

    def _solve(
        self, analysis: Analysis, kind: type[R], values: dict[str, float] | None = None
    ) -> R:
        return job_engine(self.campaign).solve(Job(values or {}, analysis)).result(kind)

    def _version(self) -> Verdict:
        version = self.program.version()
        return Verdict("passed", f"{version}, started as {self.program.command(1).arguments[0]}")

    # modes

    @property
    def _analysis(self) -> ModalAnalysis:
        case, has = self.campaign.cases[0], self.program.capabilities
        parameters = self.campaign.parameters.parameters
        groups = tuple(
            (item.name, case.solver.deck.energy_sets(item))
            for item in parameters
            if has.strain_energies and case.solver.deck.energy_sets(item)
        )
        if self.model is not None:
            return ModalAnalysis(N_MODES, self.model.nodes, groups)
        return ModalAnalysis(case.n_modes, case.nodes, groups)

    def _modes(self) -> Verdict:
        found = self._solve(self._analysis, ModalResult)
        self.modal = found
        first = float(found.elastic.frequencies_hz[0])
        if self.model is None:
            text = (
                f"{found.modes.n_modes} modes, {found.n_rigid} of them rigid; first {first:.5g} Hz"
            )
            return Verdict("passed", f"{text}; this model has no closed form to compare with")
        right = self.model.eigenvalues[: found.eigenvalues.size]
        off = float(np.abs(found.eigenvalues / right - 1.0).max())
        text = f"{right.size} eigenvalues within {off:.1e} of the closed form ({CLOSED_FORM:.0e})"
        good = off <= CLOSED_FORM
        if self.model.mass:
            rows = found.modes.components == self.model.component
            masses = self.model.mass * (np.real(found.modes.mode_shapes[rows]) ** 2).sum(axis=0)
            off = float(np.abs(masses - 1.0).max())
            text += f", modal masses within {off:.1e} of one ({MODAL_MASS:.0e})"
            good = good and off <= MODAL_MASS
        if not good:
            self.modal = None
        return Verdict("passed" if good else "failed", text, "" if good else REPORT)

    def _energies(self) -> Verdict:
        assert self.modal is not None
        if not self.program.capabilities.strain_energies:
            return Verdict("not available", "this program computes none; they are optional")
        if not self.modal.groups:
            return Verdict("not available", "no parameter is proportional to a strain energy")
        off = float(np.abs(self.modal.energy_balance - 1.0).max())
        text = f"2 sum U / lambda within {off:.1e} of one ({BALANCE_TOLERANCE:.0e})"
        if off <= BALANCE_TOLERANCE:
            return Verdict("passed", text)
        return Verdict("failed", text, "campaigns use another method where energies do not balance")

    # derivatives

    def _sensitivities(self) -> Verdict:
        assert self.modal is not None
        has = self.program.capabilities
        names = self.campaign.parameters.names[:PARAMETERS]
        if not has.frequency_sensitivities or not names:
            text = "this program computes none" if names else "the campaign has no parameters"
            return Verdict("not available", f"{text}; campaigns use another method")
        modal = replace(self._analysis, groups=())
        shapes = has.shape_sensitivities and bool(modal.nodes)
        asked = SensitivityAnalysis(modal.n_modes, names, modal.nodes if shapes else ())
        found = self._solve(asked, ModeDerivatives)
        self.confirmed -= {"frequency_sensitivities", "shape_sensitivities"}
        apart = _apart(self.modal)
        errors, shape_errors = [], []
        for column, name in enumerate(names):
            values, slopes = self._difference(name, modal)
            errors.append(_off(found.eigenvalues[apart, column], values[apart]))
            if shapes:
                shape_errors.append(_off(found.mode_shapes[:, apart, column], slopes[:, apart]))
        worst = max(errors)
        text = (
            f"eigenvalue derivatives to {', '.join(names)} within {worst:.1e} of central "
            f"differences ({DERIVATIVES:.0e})"
        )
        good = worst <= DERIVATIVES
        if good:
            self.confirmed.add("frequency_sensitivities")
        if shapes:
            text += f", of shapes within {max(shape_errors):.1e} ({SHAPES:.0e})"
            good = good and max(shape_errors) <= SHAPES
            if good:
                self.confirmed.add("shape_sensitivities")
        remedy = f"campaigns use strain energies and finite differences instead; {REPORT}"
        return Verdict("passed" if good else "failed", text, "" if good else remedy)

    def _difference(self, name: str, analysis: ModalAnalysis) -> tuple[Floats, Floats]:
        """Return the derivatives of eigenvalues (n_modes,) and shapes (n_dof, n_modes)."""
        assert self.modal is not None
        deck = self.campaign.cases[0].solver.deck
        parameter = self.campaign.parameters.parameters[self.campaign.parameters.names.index(name)]
        base = np.real(self.modal.modes.mode_shapes)
        ends = []
        for factor in (1.0 + STEP, 1.0 - STEP):
            end = self._solve(analysis, ModalResult, {name: factor})
            shapes = np.real(end.modes.mode_shapes)
            signs = np.where((shapes * base).sum(axis=0) < 0.0, -1.0, 1.0)
            ends.append((deck.written(parameter, factor), end.eigenvalues, signs * shapes))
        width = ends[0][0] - ends[1][0]
        return (ends[0][1] - ends[1][1]) / width, (ends[0][2] - ends[1][2]) / width

    # matrices

    def _matrices(self) -> Verdict:
        assert self.modal is not None
        has = self.program.capabilities
        if not has.matrices:
            return Verdict("not available", "this program writes none; they are optional")
        found = self._solve(MatrixAnalysis(), MatrixResult)
        self.confirmed -= {"matrices", "matrix_modes"}
        elastic = slice(self.modal.n_rigid, None)
        count = self.modal.eigenvalues.size
        values, _ = solve_modes(found.stiffness, found.mass, count)
        off = float(np.abs(values[elastic] / self.modal.eigenvalues[elastic] - 1.0).max())
        text = f"modes of {found.nodes.size} equations within {off:.1e} of the program's own"
        text += f" ({EIGENVALUE_TOLERANCE:.0e})"
        if off <= EIGENVALUE_TOLERANCE:
            self.confirmed |= {"matrices", "matrix_modes"}
            return Verdict("passed", text)
        return Verdict("failed", text, f"campaigns do not use its matrices; {REPORT}")


def _without_modes() -> Verdict:
    return Verdict("not available", "it needs the modes, whose test failed")


def _apart(modal: ModalResult) -> Integers:
    """Return the positions of elastic modes that stay well separated over a step."""
    values = modal.eigenvalues
    gaps = np.diff(values) / np.maximum(np.abs(values[1:]), 1e-300)
    beside = np.minimum(np.append(np.inf, gaps), np.append(gaps, np.inf))
    places = np.arange(values.size)
    return places[(places >= modal.n_rigid) & (beside > 4.0 * STEP)]


def _off(found: Floats, right: Floats) -> float:
    return float(np.abs(found - right).max() / np.abs(right).max())
