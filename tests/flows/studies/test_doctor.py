"""`modetune doctor`: closed forms on real solvers, and a scripted Nastran, right and wrong."""

from __future__ import annotations

import getpass
import importlib.util
import json
import math
import os
import re
import shutil
import socket
import sys
from pathlib import Path
from typing import Any

import pytest

from modetune.adapters.nastran.dialect import MEMORY_VARIABLE, VERSION_VARIABLE
from modetune.core.errors import CampaignError
from modetune.flows.campaign import solvers
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.campaign.schema import STORE_VARIABLE
from modetune.flows.campaign.site import HOME_VARIABLE, SITE_VARIABLE
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.studies.doctor.doctor import DoctorReport, run_doctor
from modetune.flows.studies.doctor.installation import DoctorLine, without_names
from modetune.flows.studies.doctor.ten_elements import MODELS
from modetune.flows.updating.forecast import Unwatched
from modetune.flows.updating.mode_source import by_solver
from modetune.flows.updating.update import update_campaign
from tests.command_line import run_command

ROOT = Path(__file__).resolve().parents[3]
MYSTRAN = shutil.which(os.environ.get("MODETUNE_MYSTRAN", "mystran"))
CCX = shutil.which("ccx")


@pytest.fixture(autouse=True)
def _here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(HOME_VARIABLE, str(tmp_path / "home"))
    for name in (STORE_VARIABLE, SITE_VARIABLE, VERSION_VARIABLE, MEMORY_VARIABLE):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MODETUNE_NASTRAN", "no-such-nastran")


@pytest.fixture
def nastran(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of a scripted Nastran; `outcomes.json` in it says what its runs do."""
    program = tmp_path / "bin" / "nastran"
    program.parent.mkdir()
    source = (ROOT / "tests" / "adapters" / "fake_nastran.py").read_text()
    program.write_text(f"#!{sys.executable}\n{source}")
    program.chmod(0o755)
    monkeypatch.setenv("MODETUNE_NASTRAN", str(program))
    return program.parent


def states(report: DoctorReport, topic: str) -> dict[str, str]:
    return {line.item: line.state for line in report.lines if line.topic == topic}


def line(report: DoctorReport, topic: str, item: str) -> DoctorLine:
    return next(row for row in report.lines if (row.topic, row.item) == (topic, item))


def error_told(found: DoctorLine) -> float:
    """The largest difference that a line tells."""
    return float(re.findall(r"within (\S+) of", found.said)[0])


@pytest.mark.parametrize(
    ("solver", "found", "off"),
    [  # off: what the program's printed digits leave: seven in CalculiX and in OP2 files
        pytest.param(
            "calculix",
            {"strain energies": "passed", "matrices": "passed"},
            2e-7,
            marks=pytest.mark.skipif(CCX is None, reason="CalculiX is not here"),
        ),
        pytest.param(
            "mystran",
            {"matrices": "passed"},
            2e-7,
            marks=pytest.mark.skipif(MYSTRAN is None, reason="no MYSTRAN"),
        ),
        ("matrices", {"strain energies": "passed", "matrices": "passed"}, 1e-12),
    ],
)
def test_a_solver_is_as_exact_as_its_digits_on_ten_elements(
    solver: str, found: dict[str, str], off: float
) -> None:
    report = run_doctor(solver)
    told = states(report, solver)
    wanted = {"program": "passed", "modes": "passed", **found}
    assert {item: told[item] for item in wanted} == wanted
    assert told["sensitivities"] == "not available"
    assert error_told(line(report, solver, "modes")) < off
    assert (report.status, report.exit_code) == ("passed", 0)


#: Masses and springs in a row, held at one end: more modes than a campaign asks for.
LINKS = 14


def campaign_of(folder: Path) -> Campaign:
    """A campaign on the scripted Nastran whose model is right already; a mass has no energy."""
    folder.mkdir()
    lines = ["CEND", "SPC = 1", "BEGIN BULK", "GRID,1", "SPC1,1,123456,1"]
    for node in range(2, LINKS + 2):
        lines += [f"GRID,{node},,{node}.", f"CELAS2,{node},50.,{node - 1},1,{node},1"]
        lines.append(f"CONM2,{100 + node},{node},,.001")
    (folder / "chain.bdf").write_text("\n".join([*lines, "ENDDATA", ""]))
    # Fixed-free chain of equal links: sqrt(k / m) / pi sin((2 j - 1) pi / (4 n + 2)).
    angles = [(2 * mode - 1) * math.pi / (4 * LINKS + 2) for mode in (1, 2)]
    hertz = [f"{(50.0 / 0.001) ** 0.5 / math.pi * math.sin(angle):.9g}" for angle in angles]
    (folder / "test.csv").write_text(f"mode,1,2\nfrequency_hz,{','.join(hertz)}\n")
    (folder / "chain.yaml").write_text(
        "name: chain\nmodel: {deck: chain.bdf, solver: nastran, units: mm-t-s}\n"
        "test: {modes: test.csv}\nparameters:\n"
        "  - {name: k, quantity: spring_stiffness, element: 2-8}\n"
        "  - {name: m, quantity: mass, element: 115}\n"
    )
    return load_campaign(folder / "chain.yaml")


def test_a_nastran_that_passes_is_used_for_sensitivities_from_then_on(
    nastran: Path, tmp_path: Path
) -> None:
    before = campaign_of(tmp_path / "before")
    assert by_solver(before, job_engine(before)).methods == ("strain_energy", "finite_difference")
    update_campaign(before, tmp_path / "run", Unwatched())
    log = (tmp_path / "run" / "campaign.log").read_text()
    assert "because `modetune doctor --solver nastran` (with --dialect" in log

    runs, seen = len((nastran / "runs.log").read_text().splitlines()), list[str]()
    report = run_doctor("nastran", tell=lambda row: seen.append(row.item))
    assert seen == [row.item for row in report.lines]
    assert set(states(report, "nastran").values()) == {"passed", "not available"}
    assert states(report, "nastran")["sensitivities"] == "passed"
    assert "within" in line(report, "nastran", "sensitivities").said
    assert set(report.confirmed) == {"frequency_sensitivities", "shape_sensitivities"}
    # Modes, sensitivities and two runs per parameter.
    assert len((nastran / "runs.log").read_text().splitlines()) == runs + (1 + 1 + 2 * 3)

    after = campaign_of(tmp_path / "after")
    assert by_solver(after, job_engine(after)).methods == ("strain_energy", "solver")


def test_wrong_sensitivities_fail_and_take_back_what_passed_before(nastran: Path) -> None:
    assert run_doctor("nastran").confirmed
    (nastran / "outcomes.json").write_text('["halved"]')
    report = run_doctor("nastran")
    assert states(report, "nastran")["modes"] == "passed"
    failed = line(report, "nastran", "sensitivities")
    assert failed.state == "failed"
    assert error_told(failed) == pytest.approx(0.5, rel=1e-2)
    assert "use strain energies and finite differences instead" in failed.remedy
    assert (report.confirmed, report.exit_code) == ((), 4)
    assert json.loads(next((Path("home") / "self_tests").iterdir()).read_text())["passed"] == []


def test_a_licence_that_is_not_there_is_told_and_leaves_the_note_as_it_was(nastran: Path) -> None:
    (nastran / "outcomes.json").write_text('["denied"]')
    report = run_doctor("nastran")
    modes = line(report, "nastran", "modes")
    assert modes.state == "failed"
    assert "no licence" in modes.said
    assert modes.remedy == "try again when a licence is free"
    assert states(report, "nastran")["sensitivities"] == "not available"
    assert not (Path("home") / "self_tests").exists()


def test_a_missing_solver_fails_where_it_was_asked_for_and_only_there() -> None:
    asked = run_doctor("nastran")
    assert states(asked, "nastran") == {"program": "failed"}
    assert "MODETUNE_NASTRAN" in line(asked, "nastran", "program").said
    assert asked.exit_code == 4
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MODETUNE_MYSTRAN", "no-such-mystran")
        patch.setenv("MODETUNE_CCX", "no-such-ccx")
        report = run_doctor()
    assert states(report, "mystran") == {"program": "not available"}
    assert "needs a licence" in line(report, "nastran", "program").said
    assert report.exit_code == 0


def test_a_solver_nobody_knows_and_one_without_a_deck_are_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with pytest.raises(CampaignError, match="there are calculix, nastran"):
        run_doctor("ansys")
    monkeypatch.delitem(MODELS, "matrices")
    with pytest.raises(CampaignError, match="name a campaign file"):
        run_doctor("matrices")


def test_a_store_that_cannot_be_written_fails_with_what_to_do(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    Path("file").write_text("")
    monkeypatch.setenv(STORE_VARIABLE, str(Path("file") / "store"))
    failed = line(run_doctor("matrices"), "machine", "store")
    assert failed.state == "failed"
    assert "is a file, and a folder is needed" in failed.said


def test_looking_at_a_store_leaves_nothing_behind() -> None:
    assert line(run_doctor("matrices"), "machine", "store").state == "passed"
    assert not Path(".modetune").exists()


def test_any_program_and_deck_are_tried_on_a_campaign_of_their_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The solver that the documentation takes apart: a rod in two materials."""
    found = importlib.util.spec_from_file_location(
        "rod_solver", ROOT / "docs" / "examples" / "rod_solver.py"
    )
    assert found is not None
    assert found.loader is not None
    module: Any = importlib.util.module_from_spec(found)
    monkeypatch.setitem(sys.modules, "rod_solver", module)
    found.loader.exec_module(module)
    bound = {"matrices": lambda model, deck, given: module.rod_solver(deck, given)}
    monkeypatch.setitem(solvers.SOLVERS, "matrices", bound["matrices"])
    Path("bar.rod").write_text(
        "material A 7e4 2.7e-9\nmaterial B 2e5 7.9e-9\nrod A 250. 5 10.\nrod B 250. 5 10.\n"
    )
    Path("rod.yaml").write_text(
        "name: rod\nmodel: {deck: bar.rod, solver: matrices, units: mm-t-s}\n"
        "parameters: [{name: E, quantity: youngs_modulus, material: B}]\n"
    )
    report = run_doctor(campaign=Path("rod.yaml"))
    told = states(report, "rod")
    assert told["modes"] == "passed"
    assert told["strain energies"] == told["matrices"] == "not available"
    assert "no closed form" in line(report, "rod", "modes").said


def test_the_report_names_neither_people_nor_machines() -> None:
    home, user, host = str(Path.home()), getpass.getuser(), socket.gethostname()
    said = f"{home}/store of {user} on {host}: {user}s"
    told = without_names(DoctorLine("machine", "store", "passed", said)).said
    assert told == "~/store of USER on HOST: " + f"{user}s"


def test_the_command_prints_a_line_each_and_writes_a_file_to_send(tmp_path: Path) -> None:
    ended = run_command(tmp_path, "doctor", "--solver", "matrices")
    assert ended.returncode == 0
    assert re.search(r"^passed +matrices: modes: 4 eigenvalues within", ended.stdout, re.M)
    sent = json.loads((tmp_path / "modetune-doctor.json").read_text())
    assert [row["topic"] for row in sent["lines"]].count("matrices") == 5
    again = run_command(
        tmp_path, "doctor", "--solver", "matrices", "--json", "--file", "report.txt"
    )
    told = json.loads(again.stdout)
    assert (told["status"], told["exit_code"], told["file"]) == ("passed", 0, "report.txt")
    text = (tmp_path / "report.txt").read_text()
    assert len(text.splitlines()) == len(told["lines"]) + 1
    failed = run_command(tmp_path, "doctor", "--solver", "nastran")
    assert failed.returncode == 4
    assert "Traceback" not in failed.stderr
    assert run_command(tmp_path, "doctor", "--dialect", "cosmic").returncode == 2


COMMAND = """
import numpy as np
K, LINKS = <<k=50.0:.10E>>, 12
stiffness = K * (2.0 * np.eye(LINKS) - np.eye(LINKS, k=1) - np.eye(LINKS, k=-1))
stiffness[-1, -1] = K
values, shapes = np.linalg.eigh(stiffness / 0.001)
hertz = np.sqrt(values) / 2.0 / np.pi
rows = [["mode", *range(1, LINKS + 1)], ["frequency_hz", *hertz]]
rows += [[f"{node}.x", *shape] for node, shape in enumerate(shapes / 0.001**0.5, start=1)]
open("modes.csv", "w").write("".join(",".join(map(str, row)) + "\\n" for row in rows))
print("CHAIN SOLVED")
"""


def test_a_program_that_a_command_line_starts_is_tried_on_its_template() -> None:
    Path("chain.py").write_text(COMMAND)
    nodes = "".join(f"{node},{node}.,0.,0.\n" for node in range(1, 13))
    Path("nodes.csv").write_text(f"node,x,y,z\n{nodes}")
    Path("chain.yaml").write_text(
        "name: chain\nmodel:\n  deck: chain.py\n  solver: command\n  units: mm-t-s\n  command:\n"
        "    name: chain\n    run: ['{python}', '{deck}']\n    version: '1'\n"
        "    delimiters: ['<<', '>>']\n    nodes: nodes.csv\n    results: modes.csv\n"
        "    components: [x]\n"
        "    success: ['^CHAIN SOLVED']\n    fatal: ['Error:']\n"
        "parameters: [{name: k, quantity: spring_stiffness}]\n"
        "run: {licence_messages: [no chain for you]}\n"
    )
    report = run_doctor(campaign=Path("chain.yaml"))
    told = states(report, "chain")
    wanted = dict.fromkeys(("program", "modes"), "passed")
    assert {item: told.get(item) for item in wanted} == wanted, [row.text for row in report.lines]
    # Fixed-free chain of equal links: sqrt(k / m) / pi sin(pi / (4 n + 2)).
    first = (50.0 / 0.001) ** 0.5 / math.pi * math.sin(math.pi / 50.0)
    assert f"first {first:.5g} Hz" in line(report, "chain", "modes").said
