"""What campaigns rely on of a solver, tried here: a line each.

Modes against a closed form, strain energies that balance, the solver's own sensitivities against
central differences of its modes, the modes of its matrices against its modes, a job that it must
refuse, and one that finds no licence. It works on any campaign's solver; models of ten elements
(`ten_elements.py`) have the closed forms. Jobs go the way of all jobs, without retries and waiting.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from modetune.adapters.solver import (
    Analysis,
    Capabilities,
    Command,
    Edited,
    MatrixAnalysis,
    ModalAnalysis,
    Program,
    Rendered,
    SensitivityAnalysis,
)
from modetune.core.algebra.eigen import solve_modes
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import (
    LicenceDenied,
    ModetuneError,
    SolverCancelled,
    SolverError,
    SolverMissing,
    SolverRejected,
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


@dataclass(frozen=True)
class FaultyProgram:
    """A program of which some jobs are spoilt.

    broken: a part of the input files and what stands in its place; where it is empty the largest
    file is cut in half. refusal: what is said in place of the program, as if it had no licence.
    """

    program: Program
    broken: tuple[str, str] | None = None
    refusal: str = ""

    @property
    def name(self) -> str:
        return self.program.name

    @property
    def capabilities(self) -> Capabilities:
        return self.program.capabilities

    def version(self) -> str:
        return self.program.version()

    def render(self, deck: Edited, analysis: Analysis) -> Rendered:
        """The program's job under another key, spoilt as it is written."""
        job = self.program.render(deck, analysis)

        def write(folder: Path) -> None:
            job.write(folder)
            if self.broken is not None:
                _spoil(folder, self.broken)

        spoilt = [list(self.broken or ()), self.refusal]
        return Rendered({"spoilt": spoilt, "job": job.content}, write, job.size)

    def command(self, threads: int) -> Command:
        if not self.refusal:
            return self.program.command(threads)
        says = "import sys; print(sys.argv[1]); sys.exit(1)"
        return Command((sys.executable, "-I", "-S", "-c", says, self.refusal))

    def read(self, deck: Edited, analysis: Analysis, folder: Path, return_code: int) -> Result:
        return self.program.read(deck, analysis, folder, return_code)


def _spoil(folder: Path, broken: tuple[str, str]) -> None:
    old, new = (part.encode() for part in broken)
    files = sorted(folder.iterdir(), key=lambda path: path.stat().st_size)
    if not old:
        data = files[-1].read_bytes()
        files[-1].write_bytes(data[: len(data) // 2])
        return
    for path in files:
        path.write_bytes(path.read_bytes().replace(old, new))


R = TypeVar("R", bound=Result)

#: Modes that are asked for.
N_MODES = 4
#: Relative difference of eigenvalues from a closed form. Programs write seven digits.
CLOSED_FORM = 1e-5
#: How far modal masses may be from one: shapes are written with five digits or more, squared.
MODAL_MASS = 1e-4
#: Relative step of differences. Seven digits of an eigenvalue leave 1e-7 / 0.02 of it, and the
#: curvature step^2 / 6 of the third derivative.
STEP = 0.01
#: Difference of derivatives, relative to the largest of their parameter: ten times both of those.
DERIVATIVES = 1e-3
#: The same of shapes, of which fewer digits are written.
SHAPES = 1e-2
#: Parameters of a user's campaign that are tried.
PARAMETERS = 3
#: Solvers that need no licence.
FREE = ("calculix", "mystran", "matrices")
#: What a licence manager says; a site's own words are tried besides (`run.licence_messages`).
REFUSAL = "FLEXlm error: Licensed number of users already reached. (-4,132)"
REPORT = "please report it with the file of this test"


@dataclass(frozen=True, slots=True)
class Verdict:
    """The outcome of one test, before it is a line."""

    state: State
    said: str
    remedy: str = ""


@dataclass(slots=True)
class SolverTests:
    """The tests of one campaign's solver; confirmed: capabilities that passed so far."""

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
        """Run all tests and report a line each."""
        if self._line("program", self._version) != "passed":
            return
        self._line("modes", self._modes)
        for item, test in (
            ("strain energies", self._energies),
            ("sensitivities", self._sensitivities),
            ("matrices", self._matrices),
        ):
            self._line(item, test if self.modal is not None else _without_modes)
        self._line("fatal error", self._refusal)
        self._line("licence", self._licence)

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
            said = f"this requires the package {error.name}, which is not installed"
            found = Verdict("not available", said, "install the extra that brings it, told above")
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
            said = (
                f"{found.modes.n_modes} modes, {found.n_rigid} of them rigid; first {first:.5g} Hz"
            )
            return Verdict("passed", f"{said}; this model has no closed form to compare with")
        right = self.model.eigenvalues[: found.eigenvalues.size]
        off = float(np.abs(found.eigenvalues / right - 1.0).max())
        said = f"{right.size} eigenvalues within {off:.1e} of the closed form ({CLOSED_FORM:.0e})"
        good = off <= CLOSED_FORM
        if self.model.mass:
            rows = found.modes.components == self.model.component
            masses = self.model.mass * (np.real(found.modes.mode_shapes[rows]) ** 2).sum(axis=0)
            off = float(np.abs(masses - 1.0).max())
            said += f", modal masses within {off:.1e} of one ({MODAL_MASS:.0e})"
            good = good and off <= MODAL_MASS
        if not good:
            self.modal = None
        return Verdict("passed" if good else "failed", said, "" if good else REPORT)

    def _energies(self) -> Verdict:
        assert self.modal is not None
        if not self.program.capabilities.strain_energies:
            return Verdict("not available", "this program gives none; campaigns do without")
        if not self.modal.groups:
            return Verdict("not available", "no parameter is proportional to a strain energy")
        off = float(np.abs(self.modal.energy_balance - 1.0).max())
        said = f"2 sum U / lambda within {off:.1e} of one ({BALANCE_TOLERANCE:.0e})"
        if off <= BALANCE_TOLERANCE:
            return Verdict("passed", said)
        return Verdict(
            "failed", said, "campaigns take another method where energies do not balance"
        )

    # derivatives

    def _sensitivities(self) -> Verdict:
        assert self.modal is not None
        has = self.program.capabilities
        names = self.campaign.parameters.names[:PARAMETERS]
        if not has.frequency_sensitivities or not names:
            said = "this program gives none" if names else "the campaign has no parameters"
            return Verdict("not available", f"{said}; campaigns take another method")
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
        said = (
            f"eigenvalue derivatives to {', '.join(names)} within {worst:.1e} of central "
            f"differences ({DERIVATIVES:.0e})"
        )
        good = worst <= DERIVATIVES
        if good:
            self.confirmed.add("frequency_sensitivities")
        if shapes:
            said += f", of shapes within {max(shape_errors):.1e} ({SHAPES:.0e})"
            good = good and max(shape_errors) <= SHAPES
            if good:
                self.confirmed.add("shape_sensitivities")
        remedy = f"campaigns take strain energies and differences instead; {REPORT}"
        return Verdict("passed" if good else "failed", said, "" if good else remedy)

    def _difference(self, name: str, analysis: ModalAnalysis) -> tuple[Floats, Floats]:
        """Eigenvalue derivatives (n_modes,) and those of shapes (n_dof, n_modes) to a parameter."""
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
            return Verdict("not available", "this program gives none; campaigns do without")
        found = self._solve(MatrixAnalysis(), MatrixResult)
        self.confirmed -= {"matrices", "matrix_modes"}
        elastic = slice(self.modal.n_rigid, None)
        count = self.modal.eigenvalues.size
        values, _ = solve_modes(found.stiffness, found.mass, count)
        off = float(np.abs(values[elastic] / self.modal.eigenvalues[elastic] - 1.0).max())
        said = f"modes of {found.nodes.size} equations within {off:.1e} of the program's own"
        said += f" ({EIGENVALUE_TOLERANCE:.0e})"
        if off <= EIGENVALUE_TOLERANCE:
            self.confirmed |= {"matrices", "matrix_modes"}
            return Verdict("passed", said)
        return Verdict("failed", said, f"campaigns do without its matrices; {REPORT}")

    # what goes wrong

    def _altered(self, program: FaultyProgram) -> SolverError | None:
        """The error that an altered program's job ends with; None where it gives a result."""
        case = self.campaign.cases[0]
        solver = replace(case.solver, program=program)
        campaign = replace(self.campaign, cases=(replace(case, solver=solver),))
        try:
            job_engine(campaign).solve(Job({}, ModalAnalysis(1, self._analysis.nodes)))
        except (SolverCancelled, SolverMissing):
            raise
        except SolverError as error:
            return error
        return None

    def _refusal(self) -> Verdict:
        broken = ("", "") if self.model is None else self.model.broken
        error = self._altered(FaultyProgram(self.program, broken))
        if error is None:
            said = "a job with an error in its input gave modes all the same"
            return Verdict("failed", said, REPORT)
        first = _first_line(error)
        if isinstance(error, SolverRejected):
            return Verdict("passed", f"recognised, and refused: {first}")
        if isinstance(error, LicenceDenied):
            return Verdict("failed", f"taken for a missing licence: {first}", REPORT)
        return Verdict("passed", f"recognised as a job without a result: {first}")

    def _licence(self) -> Verdict:
        if self.program.name in FREE:
            return Verdict("not available", "this program needs no licence")
        own = self.campaign.run.licence_messages
        for said in (REFUSAL, *own):
            error = self._altered(FaultyProgram(self.program, refusal=said))
            if not isinstance(error, LicenceDenied):
                kind = "a success" if error is None else _first_line(error)
                return Verdict("failed", f"{said!r} was taken for {kind}", REPORT)
        count = f" and {len(own)} of the site's own messages" if own else ""
        return Verdict("passed", f"a refusal{count} recognised: jobs wait and ask again")


def _without_modes() -> Verdict:
    return Verdict("not available", "it is compared with modes, which failed")


def _apart(modal: ModalResult) -> Integers:
    """Return the positions of elastic modes that a step does not bring close to another."""
    values = modal.eigenvalues
    gaps = np.diff(values) / np.maximum(np.abs(values[1:]), 1e-300)
    beside = np.minimum(np.append(np.inf, gaps), np.append(gaps, np.inf))
    places = np.arange(values.size)
    return places[(places >= modal.n_rigid) & (beside > 4.0 * STEP)]


def _off(found: Floats, right: Floats) -> float:
    return float(np.abs(found - right).max() / np.abs(right).max())


def _first_line(error: Exception) -> str:
    """Return the program's message, shortened."""
    lines = str(error).splitlines()
    said = [line.strip(" |*") for line in lines if line.startswith("  |")]
    told = [line for line in said if "ERROR" in line.upper() or "FATAL" in line]
    return (told[:1] or lines[:1] or [""])[0][:200]
