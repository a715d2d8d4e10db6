"""Campaigns of `solver: command`: found truths, counted runs, the store, licences, Slurm, twins."""

from __future__ import annotations

import importlib.util
import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from modetune.configs.cases import write_case
from modetune.core.errors import CampaignError, LicenceDenied, SolverRejected
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.studies.twin.solver_modes import run_twin
from modetune.flows.updating.forecast import Unwatched
from modetune.flows.updating.mode_source import model_modes
from modetune.flows.updating.update import update_campaign
from tests.command_line import run_command
from tests.shaft_line import shaft_frequencies, write_shaft

ROOT = Path(__file__).resolve().parents[3]
TRUTH = {"k_engine": 0.8, "k_shaft": 1.25, "propeller": 1.1}
CAMPAIGN = """name: shaft
model:
  deck: shaft.txt
  solver: command
  units: m-kg-s
  command:
    name: shaftline
    run: ["{{python}}", "{folder}/shaft.py", "{{deck}}"]
    version: 2.5.1
    nodes: nodes.csv
    components: [rx]
    results: twist.csv
    most_modes: 6
    success: [^END OF SHAFT]
    fatal: ['\\bE-\\d{{4}}\\b']
test: {{modes: measured.csv}}
parameters:
  - {{name: k_engine, quantity: spring_stiffness}}
  - {{name: k_shaft, quantity: spring_stiffness}}
  - {{name: propeller, quantity: number}}
update: {{step: weighted_least_squares, e1: {{frequency: 1.0e-6}}, e2: 0.0}}
report: {{page: false}}
run: {{parallel: 3, threads: 1}}
"""


@pytest.fixture
def shaft(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Path]:
    """Writes the campaign of a shaft line, with other texts in place; gives its file."""
    monkeypatch.setattr("modetune.flows.campaign.campaign.cores", lambda: 4)

    def write(*changes: tuple[str, str]) -> Path:
        write_shaft(tmp_path)
        hertz = shaft_frequencies(**TRUTH)[:5]
        rows = ("mode,1,2,3,4,5", "frequency_hz," + ",".join(f"{f:.12g}" for f in hertz))
        (tmp_path / "measured.csv").write_text("\n".join(rows) + "\n")
        text = CAMPAIGN.format(folder=tmp_path)
        for old, new in changes:
            assert old in text
            text = text.replace(old, new)
        (tmp_path / "campaign.yaml").write_text(text)
        return tmp_path / "campaign.yaml"

    return write


def runs(file: Path) -> int:
    """How often the program was started."""
    log = file.with_name("runs.log")
    return len(log.read_text().splitlines()) if log.exists() else 0


def updated(file: Path, name: str = "run") -> CampaignRecord:
    return update_campaign(load_campaign(file), file.with_name(name), Unwatched()).record


def test_an_update_finds_the_truth_and_counts_its_runs(shaft: Callable[..., Path]) -> None:
    file = shaft()
    record = updated(file)
    assert record.status == "converged", record.reason
    # Ten digits of stiffnesses and frequencies, four decimals of the propeller's inertia.
    np.testing.assert_allclose(record.updated, list(TRUTH.values()), rtol=1e-5)
    assert runs(file) == record.runs.modal + record.runs.sensitivity
    deck = file.with_name("run") / "updated"
    assert "{propeller=165.0000:10.4f}" in (deck / "shaft.txt").read_text()
    assert "  165.0000" in (deck / "filled" / "shaft.txt").read_text()
    # All of it stands in the store: nothing is run again, by other judging words neither.
    again = updated(shaft(("^END OF SHAFT", "^END OF")), "again")
    np.testing.assert_array_equal(again.updated, record.updated)
    assert again.runs.modal + again.runs.sensitivity == 0
    assert runs(file) == record.runs.modal + record.runs.sensitivity


def test_another_template_or_version_is_another_result(shaft: Callable[..., Path]) -> None:
    file = shaft()
    first = model_modes(load_campaign(file), {})
    assert runs(file) == 1
    model_modes(load_campaign(file), {"k_shaft": 1.0})
    assert runs(file) == 1  # the deck's own value
    model_modes(load_campaign(shaft(("2.5.1", "2.5.2"))), {})
    assert runs(file) == 2
    deck = file.with_name("shaft.txt")
    deck.write_text(deck.read_text().replace("240.", "264."))
    second = model_modes(load_campaign(file), {})
    assert runs(file) == 3
    assert (second.eigenvalues < first.eigenvalues + 1e-9).all()


def test_a_refused_licence_is_waited_for_and_its_words_are_the_campaign_s(
    shaft: Callable[..., Path],
) -> None:
    limits = "run: {licences: {shaftline: 1}, licence_wait_s: 0.3, licence_pause_s: 0.1,"
    file = shaft(("run: {", f"{limits} licence_messages: [token pool empty], "))
    deck = file.with_name("shaft.txt")
    deck.write_text(deck.read_text().replace("shaft line", "denied"))
    with pytest.raises(LicenceDenied, match=r"(?s)shaftline got no licence.*TOKEN POOL EMPTY"):
        model_modes(load_campaign(file), {})
    assert runs(file) > 1
    with pytest.raises(
        CampaignError, match=r"licences has the unknown name shaft; .* command, shaftline"
    ):
        load_campaign(shaft(("run: {", "run: {licences: {shaft: 1}, ")))


def test_what_the_program_refuses_is_not_tried_again(shaft: Callable[..., Path]) -> None:
    file = shaft()
    deck = file.with_name("shaft.txt")
    deck.write_text(deck.read_text().replace("shaft line", "refuse"))
    with pytest.raises(SolverRejected, match=r"(?s)shaft\.txt .*E-1001 unknown keyword"):
        model_modes(load_campaign(file), {})
    assert runs(file) == 1


SRUN = """#!{python} -IS
import os, sys
place = next(i for i, word in enumerate(sys.argv[1:], 1) if not word.startswith("-"))
with open({notes!r}, "a") as notes:
    notes.write(" ".join(sys.argv[1:]) + "\\n")
os.execvp(sys.argv[place], sys.argv[place:])
"""


def test_slurm_starts_the_program_in_the_job_s_folder(
    shaft: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    programs, notes = tmp_path / "bin", tmp_path / "notes"
    programs.mkdir()
    (programs / "srun").write_text(SRUN.format(python=sys.executable, notes=str(notes)))
    (programs / "srun").chmod(0o755)
    monkeypatch.setenv("PATH", str(programs), prepend=":")
    monkeypatch.delenv("SLURM_JOB_ID", raising=False)
    file = shaft(
        ("run: {", "run: {engine: slurm, licences: {shaftline: 2}, "),
        ('"{deck}"]', '"{folder}/{deck}"]'),
    )
    result = model_modes(load_campaign(file), {})
    np.testing.assert_allclose(result.modes.frequencies_hz[:5], shaft_frequencies()[:5], rtol=1e-6)
    (asked,) = notes.read_text().splitlines()
    assert "--licenses=shaftline:1" in asked
    job = asked.split()[-1]
    assert Path(job).is_absolute()
    assert Path(job).name == "shaft.txt"


PLATE = """*NODE, NSET=NALL
{nodes}
*ELEMENT, TYPE=S4, ELSET=WEB
{cells}
*MATERIAL, NAME=STEEL
*ELASTIC
210000., 0.3
*DENSITY
7.85E-9
*SHELL SECTION, ELSET=WEB, MATERIAL=STEEL
2.
*BOUNDARY
{held}
*STEP
*FREQUENCY
{{n_modes=10}}
*NODE FILE, OUTPUT=2D
U
*END STEP
"""


def ladder(folder: Path) -> Path:
    """A punched web: a strip of shells with holes, clamped at one end, for ccx by both ways."""
    cells = [(i, j) for i in range(9) for j in range(3) if not (j == 1 and i % 3 == 1)]
    corners = sorted({(i + a, j + b) for i, j in cells for a in (0, 1) for b in (0, 1)})
    number = {corner: place for place, corner in enumerate(corners, start=1)}
    around = [[number[i + a, j + b] for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))] for i, j in cells]
    rows = [f"{n}, {20.0 * i}, {20.0 * j}, 0." for (i, j), n in number.items()]
    text = PLATE.format(
        nodes="\n".join(rows),
        cells="\n".join(f"{n}, {', '.join(map(str, row))}" for n, row in enumerate(around, 1)),
        held="\n".join(f"{n}, 1, 6" for (i, _), n in number.items() if i == 0),
    )
    (folder / "web.inp").write_text(text)
    (folder / "plain.inp").write_text(text.replace("{n_modes=10}", "10"))
    (folder / "nodes.csv").write_text(
        "node,x,y,z\n" + "\n".join(row.replace(" ", "") for row in rows) + "\n"
    )
    (folder / "measured.csv").write_text("mode,1,2,3\nfrequency_hz,50.,200.,300.\n")
    (folder / "web.yaml").write_text(f"""name: web
model:
  deck: web.inp
  solver: command
  units: mm-t-s
  command:
    run: [ccx, -i, "{{job}}"]
    version: [ccx, -v]
    nodes: nodes.csv
    results: web.frd
    edits:
      - {{parameter: t_web, pattern: 'MATERIAL=STEEL\\n(\\S+)', format: .6f}}
      - {{parameter: E_web, line: {text.splitlines().index("*ELASTIC") + 2}, field: 1}}
    success: [Job finished]
    fatal: ['\\*ERROR']
test: {{modes: measured.csv}}
parameters:
  - {{name: E_web, quantity: youngs_modulus, material: STEEL}}
  - {{name: t_web, quantity: thickness, elset: WEB}}
""")
    return folder / "web.yaml"


def test_a_twin_sets_the_command_beside_an_adapter(tmp_path: Path) -> None:
    # The adapter leaves the deck's own request out; a template's placeholder it cannot read.
    file = ladder(tmp_path)
    text = (tmp_path / "web.inp").read_text().replace("{n_modes=10}", "16")
    (tmp_path / "web.inp").write_text(text)
    twin = run_twin(file, ["command", "calculix"], ["E_web=0.9", "t_web=1.2"], [])
    assert [item.solver for item in twin.solvers] == ["command", "calculix"]
    command, calculix = twin.solvers
    assert command.version == calculix.version
    # Both print seven digits of eigenvalues or frequencies.
    np.testing.assert_allclose(twin.differences(calculix), 0.0, atol=1e-6)
    np.testing.assert_allclose(calculix.pairing.judged_mac, 1.0, atol=1e-9)


def test_a_frame_of_openseespy_is_found_from_its_shipped_campaign(tmp_path: Path) -> None:
    if importlib.util.find_spec("openseespy") is None:
        pytest.skip("openseespy is not installed")
    write_case("frame", tmp_path)
    file = tmp_path / "frame.yaml"
    record = updated(file)
    assert record.status == "converged", record.reason
    # e1 asks for frequencies to 1e-4, of which half is what stiffnesses move.
    np.testing.assert_allclose(record.updated, [0.88, 1.1, 0.6], rtol=5e-3)
    assert record.runs.modal <= 5
    assert record.runs.sensitivity <= 3 * record.runs.modal
    solver = load_campaign(file).case.solver
    assert solver.program.name == "opensees"
    assert solver.deck.summary.n_elements == 39


def test_the_command_line_tells_all_of_it(shaft: Callable[..., Path], tmp_path: Path) -> None:
    file = shaft()
    said = run_command(tmp_path, "modes", str(file), "--json", MODETUNE_HOME=str(tmp_path / "home"))
    assert said.returncode == 0, said.stderr
    told = json.loads(said.stdout)
    assert told["solver"] == "shaftline"
    assert told["solver_version"] == "2.5.1"
    np.testing.assert_allclose(told["frequencies_hz"][:5], shaft_frequencies()[:5], rtol=1e-6)
    checked = run_command(tmp_path, "check", str(file), MODETUNE_HOME=str(tmp_path / "home"))
    assert checked.returncode in (0, 3), checked.stderr
    assert "propeller" in checked.stdout


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ((("solver: command", "solver: calculix"),), "line 2: model: `solver: command` and the"),
        ((("twist.csv", "/tmp/twist.csv"),), "/tmp/twist.csv is not in the deck's folder"),
        ((("    results: twist.csv\n", ""),), "give either `results` or `reader`"),
        ((("name: propeller", "name: screw"),), r"line 2\d: .*shaft\.txt: screw does not occur"),
        ((("    most_modes", "    edits: [{parameter: p, line: 2}]\n    most_modes"),),
         "give `line` with `field` or `columns`, or `pattern`"),
        ((("solver: command", "solver: shaftline"),
          ("    name: shaftline\n", "")), "belong together"),
    ],
)  # fmt: skip
def test_bad_input_is_one_paragraph_with_file_and_line(
    shaft: Callable[..., Path], changes: tuple[tuple[str, str], ...], said: str
) -> None:
    file = shaft(*changes)
    with pytest.raises(CampaignError, match=said) as caught:
        load_campaign(file)
    assert "campaign.yaml, line" in str(caught.value)
    assert runs(file) == 0


def test_a_parameter_without_a_target_is_for_templates_alone(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "configs" / "six_mass", tmp_path / "six")
    file = tmp_path / "six" / "campaign.yaml"
    text = file.read_text()
    file.write_text(text.replace("parameters:", "parameters:\n  - {name: q, quantity: number}", 1))
    with pytest.raises(CampaignError, match=r"line \d+: parameters\.0: number needs `solver: com"):
        load_campaign(file)
