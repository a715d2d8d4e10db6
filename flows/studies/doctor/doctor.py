"""The doctor's report: the installation, and the solver features that campaigns need.

A solver can name capabilities that need confirmation (`Capabilities.to_confirm`). The doctor stores
those that pass on the model of ten elements for this installation; until then `auto` ignores them.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from modetune.core.errors import CampaignError, SolverMissing
from modetune.core.near_names import suggestion
from modetune.core.storage.files import storage_errors
from modetune.core.storage.keys import Json
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.campaign.schema import ModelFile, NastranDialect
from modetune.flows.campaign.site import RunSection
from modetune.flows.campaign.solvers import SOLVERS, registered_solvers, write_self_test
from modetune.flows.report.tables import json_object
from modetune.flows.studies.doctor.installation import DoctorLine, Tell, look_around, without_names
from modetune.flows.studies.doctor.solver_tests import FREE, SolverTests
from modetune.flows.studies.doctor.ten_elements import MODELS, TenElements


@dataclass(frozen=True, slots=True)
class DoctorReport:
    """The lines of the report, and the capabilities stored as passed."""

    lines: tuple[DoctorLine, ...]
    confirmed: tuple[str, ...] = ()

    @property
    def status(self) -> str:
        return "failed" if any(line.state == "failed" for line in self.lines) else "passed"

    @property
    def exit_code(self) -> int:
        return 4 if self.status == "failed" else 0

    def to_json(self, now: datetime) -> dict[str, Json]:
        """Return the JSON object of the report."""
        made = json_object(self, "status exit_code confirmed", lines=self.lines)
        return {**made, "written": now.astimezone(UTC).isoformat(timespec="seconds")}


def run_doctor(
    solver: str | None = None,
    dialect: NastranDialect = "msc",
    campaign: Path | None = None,
    tell: Tell = lambda line: None,
    working: Callable[[str], None] = lambda text: None,
) -> DoctorReport:
    """Examine the installation, then test the named solver, a campaign's, or all free ones.

    tell: receives each line at once, without names of people and machines. working: receives the
    current step. Raises CampaignError for a solver or campaign that cannot be tested.
    """
    known = (*SOLVERS, *registered_solvers())
    if solver is not None and solver not in known:
        raise CampaignError(f"--solver {solver!r}: unknown solver{suggestion(solver, known)}")
    if solver is not None and campaign is None and solver not in MODELS:
        raise CampaignError(
            f"--solver {solver}: modetune has no test model for it; name a campaign file, so that "
            "its own model is tested"
        )
    lines: list[DoctorLine] = []

    def keep(line: DoctorLine) -> None:
        lines.append(without_names(line))
        tell(lines[-1])

    look_around(keep, working)
    confirmed: list[str] = []
    if campaign is not None:
        confirmed += _test_campaign(campaign, solver, keep, working)
    else:
        for name in [solver] if solver else MODELS:
            if solver or name in FREE:
                confirmed += _test(name, dialect, solver is not None, keep, working)
            else:
                keep(_not_tested(name))
    return DoctorReport(tuple(lines), tuple(confirmed))


def _not_tested(name: str) -> DoctorLine:
    text = "not tested, because it needs a licence"
    remedy = f"test it with `modetune doctor --solver {name}`"
    return DoctorLine(name, "program", "not available", text, remedy)


def _test(
    name: str, dialect: NastranDialect, asked: bool, tell: Tell, working: Callable[[str], None]
) -> list[str]:
    """Test a solver on its model of ten elements and return the capabilities stored as passed."""
    model = MODELS[name]()
    with _folder() as folder:
        tests = _tests(model.write(folder, name, dialect), folder, [], model, tell, working)
        program = tests.program
        if not asked:
            try:
                program.version()
            except SolverMissing as error:
                tell(DoctorLine(name, "program", "not available", str(error)))
                return []
        tests.run()
    return _note(tests, tell)


def _note(tests: SolverTests, tell: Tell) -> list[str]:
    """Store the capabilities that need confirmation and passed, if the modes are right."""
    program = tests.program
    to_confirm = program.capabilities.to_confirm
    if not to_confirm or tests.modal is None:
        return []
    passed = sorted(tests.confirmed & to_confirm)
    write_self_test(program, passed)
    used = ", ".join(item.replace("_", " ") for item in passed) or "nothing"
    text = f"stored for this installation: {used}; `auto` uses this from now on"
    tell(DoctorLine(program.name, "confirmed", "passed" if passed else "not available", text))
    return passed


def _test_campaign(
    path: Path, solver: str | None, tell: Tell, working: Callable[[str], None]
) -> list[str]:
    """Test the solver of a campaign on the campaign's model, which has no closed form.

    The result is stored only for a solver without a model of ten elements.
    """
    settings = [f"model.solver={solver}"] if solver else []
    with _folder() as folder:
        tests = _tests(path, folder, settings, None, tell, working)
        tests.run()
    return [] if tests.program.name in MODELS else _note(tests, tell)


def _tests(
    path: Path,
    folder: Path,
    settings: list[str],
    model: TenElements | None,
    tell: Tell,
    working: Callable[[str], None],
) -> SolverTests:
    """Return the tests of a campaign, with a separate store and without retries."""
    alone = [f"store={folder / 'store'}", "run.retries=0", "run.licence_wait_s=0.5"]
    campaign = load_campaign(path, [*settings, *alone], ModelFile)
    first = campaign.alone(campaign.cases[0])
    return SolverTests(first, model, tell, working, set())


@contextmanager
def _folder() -> Iterator[Path]:
    """Yield a temporary folder for jobs, in the working folder if a cluster runs them."""
    here = RunSection().on_site().engine == "local"
    base = None if here else Path(".modetune").absolute()
    with storage_errors(Path(".modetune") / "doctor"):
        if base is not None:
            base.mkdir(exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix="modetune-doctor-", dir=base))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
