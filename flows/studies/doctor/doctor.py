"""What is installed, and whether solvers do here what campaigns rely on: one report.

What a solver that asks for confirmation (`Capabilities.to_confirm`) passes on its model of ten
elements is noted for its installation; until then `auto` leaves it aside.
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
    """All lines, and the capabilities that were noted as passed."""

    lines: tuple[DoctorLine, ...]
    confirmed: tuple[str, ...] = ()

    @property
    def status(self) -> str:
        return "failed" if any(line.state == "failed" for line in self.lines) else "passed"

    @property
    def exit_code(self) -> int:
        return 4 if self.status == "failed" else 0

    def to_json(self, now: datetime) -> dict[str, Json]:
        """The report for machines."""
        told = json_object(self, "status exit_code confirmed", lines=self.lines)
        return {**told, "written": now.astimezone(UTC).isoformat(timespec="seconds")}


def run_doctor(
    solver: str | None = None,
    dialect: NastranDialect = "msc",
    campaign: Path | None = None,
    tell: Tell = lambda line: None,
    working: Callable[[str], None] = lambda text: None,
) -> DoctorReport:
    """Look around, then test a solver: the one named, a campaign's own, or all free ones.

    tell: is given each line as it comes, without names of people and machines; working: what is
    under way. Raises CampaignError for a solver or campaign that cannot be tested.
    """
    known = (*SOLVERS, *registered_solvers())
    if solver is not None and solver not in known:
        raise CampaignError(
            f"--solver {solver!r}: there is no such solver{suggestion(solver, known)}"
        )
    if solver is not None and campaign is None and solver not in MODELS:
        raise CampaignError(
            f"--solver {solver}: there is no model of ten elements for it; name a campaign file "
            "in its place, whose own model is tried"
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
                keep(_asked(name))
    return DoctorReport(tuple(lines), tuple(confirmed))


def _asked(name: str) -> DoctorLine:
    said = "not tried unasked, for it takes a licence"
    remedy = f"`modetune doctor --solver {name}` tries it"
    return DoctorLine(name, "program", "not available", said, remedy)


def _test(
    name: str, dialect: NastranDialect, asked: bool, tell: Tell, working: Callable[[str], None]
) -> list[str]:
    """Test a solver on its model of ten elements; what was noted as passed."""
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
    """Note what passed of a solver that asks for it, where its modes are right."""
    program = tests.program
    to_confirm = program.capabilities.to_confirm
    if not to_confirm or tests.modal is None:
        return []
    passed = sorted(tests.confirmed & to_confirm)
    write_self_test(program, passed)
    used = ", ".join(item.replace("_", " ") for item in passed) or "nothing"
    said = f"noted for this installation: {used}; campaigns with `auto` go by it from now on"
    tell(DoctorLine(program.name, "confirmed", "passed" if passed else "not available", said))
    return passed


def _test_campaign(
    path: Path, solver: str | None, tell: Tell, working: Callable[[str], None]
) -> list[str]:
    """Test the solver of a campaign on its own model, which has no closed form.

    What passes is noted of a solver that has no model of ten elements.
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
    """The tests of a campaign; results go into a store of their own, and nothing is repeated."""
    alone = [f"store={folder / 'store'}", "run.retries=0", "run.licence_wait_s=0.5"]
    campaign = load_campaign(path, [*settings, *alone], ModelFile)
    first = campaign.alone(campaign.cases[0])
    return SolverTests(first, model, tell, working, set())


@contextmanager
def _folder() -> Iterator[Path]:
    """A folder for jobs: where a queue runs them, one that its machines see too."""
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
