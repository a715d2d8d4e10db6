"""Strains of modes at gauges beside frequencies, run by ccx."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.solver import ModalAnalysis
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.core.modes import Floats
from modetune.core.updating.job_results import ModalResult
from tests.adapters.ccx_decks import bar
from tests.adapters.test_solver_contract import run
from tests.command_line import run_command

pytestmark = pytest.mark.skipif(shutil.which("ccx") is None, reason="ccx is not installed")

#: Of the moduli of both halves.
TRUTH = 1.15, 0.88
SENSORS = 13, 17, 21
#: Along the bar's edge, 10 mm each.
GAUGES = "2-6", "6-10", "10-14", "14-18"
MATERIAL = "*MATERIAL, NAME={0}\n*ELASTIC\n{1}, 0.3\n*DENSITY\n2.7e-9\n"
CAMPAIGN = """name: bar
model: {{deck: bar.inp, solver: calculix, units: mm-t-s{how}}}
test: {{modes: measured.csv}}
parameters:
  - {{name: E_root, quantity: youngs_modulus, material: A, bounds: [0.5, 2.0]}}
  - {{name: E_tip, quantity: youngs_modulus, material: B, bounds: [0.5, 2.0]}}
residuals:
  frequency_weight: {{1: 1.0, others: 0.0}}
  modal_strain:
    gauges: [{gauges}]
    scale: {scale}
    modes: {{{modes}}}
    deviation: 0.002
    tolerance: 0.001
update: {{e1: {{frequency: 1.0e-4}}}}
report: {{page: false}}
"""


def deck(root: float = 1.0, tip: float = 1.0) -> str:
    """A clamped bar of five bricks, 50 x 10 x 8, of two materials."""
    whole = bar("C3D8I", bricks=5, held="*BOUNDARY\n1,1,3\n2,1,3\n3,1,3\n4,1,3\n")
    mesh = whole[: whole.index("*MATERIAL")]
    held = whole[whole.index("*BOUNDARY") :]
    return (
        mesh
        + "*ELSET, ELSET=R\n1, 2\n*ELSET, ELSET=T\n3, 4, 5\n"
        + MATERIAL.format("A", 70000.0 * root)
        + MATERIAL.format("B", 70000.0 * tip)
        + "*SOLID SECTION, ELSET=R, MATERIAL=A\n*SOLID SECTION, ELSET=T, MATERIAL=B\n"
        + held
    )


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> tuple[ModalResult, Floats]:
    """The first three modes by ccx at the sensors, and their strains at the gauges (n, 3)."""
    folder = tmp_path_factory.mktemp("truth")
    (folder / "bar.inp").write_text(deck(*TRUTH))
    nodes = tuple(sorted({*SENSORS, *(int(n) for g in GAUGES for n in g.split("-"))}))
    found = run(calculix_solver(folder / "bar.inp", ()), {}, ModalAnalysis(3, nodes), folder)
    assert isinstance(found, ModalResult)
    along = {
        int(node): found.modes.mode_shapes[row]
        for row, (node, component) in enumerate(
            zip(found.modes.nodes, found.modes.components, strict=True)
        )
        if component == 1
    }
    ends = [tuple(map(int, gauge.split("-"))) for gauge in GAUGES]
    return found, np.array([(along[b] - along[a]) / 10.0 for a, b in ends])


def campaign(
    folder: Path, truth: tuple[ModalResult, Floats], scale: str, how: str = "", shapes: bool = True
) -> Path:
    found, strains = truth
    kept = np.isin(found.modes.nodes, SENSORS) & shapes
    modes = replace(
        found.modes,
        nodes=found.modes.nodes[kept],
        components=found.modes.components[kept],
        mode_shapes=found.modes.mode_shapes[kept],
    )
    (folder / "bar.inp").write_text(deck())
    write_modes_csv(folder / "measured.csv", range(1, 4), modes)
    rows = (", ".join(f"{value:.9g}" for value in strains[:, mode]) for mode in range(3))
    text = CAMPAIGN.format(
        gauges=", ".join(f'"{gauge}"' for gauge in GAUGES),
        scale=scale,
        modes=", ".join(f"{mode}: [{row}]" for mode, row in enumerate(rows, start=1)),
        how=how,
    )
    (folder / "bar.yaml").write_text(text)
    return folder / "bar.yaml"


@pytest.mark.parametrize(("scale", "how"), [("shapes", ""), ("own", ", eigensolver: solver")])
def test_strains_and_one_frequency_tell_both_halves(
    tmp_path: Path, truth: tuple[ModalResult, Floats], scale: str, how: str
) -> None:
    path = campaign(tmp_path, truth, scale, how)
    ended = run_command(tmp_path, "update", str(path), "--json")
    assert ended.returncode == 0, ended.stderr
    updated = [item["updated"] for item in json.loads(ended.stdout)["parameters"]]
    # e1 of 1e-4 in one frequency and 1e-3 of the strains.
    assert updated == pytest.approx(TRUTH, rel=3e-3)


#: Of each other study its options.
STUDIES = {
    "screen": ["--method", "morris", "--points", "6"],
    "sample": ["--steps", "300"],
    "pretest": ["--method", "information"],
    "localise": [],
    "validate": ["--leave-one-out"],
    "check": [],
}


def test_every_study_counts_the_strains(tmp_path: Path, truth: tuple[ModalResult, Floats]) -> None:
    """One folder: what one study ran answers the others."""
    path = campaign(tmp_path, truth, "shapes", ", eigensolver: pardiso")
    found = {}
    for study, options in STUDIES.items():
        ended = run_command(tmp_path, study, str(path), *options, "--json", "--no-prefect")
        assert ended.returncode == 0, study + ended.stderr
        found[study] = json.loads(ended.stdout)
        assert found[study]["status"] in ("done", "good", "sound", "doubtful"), study
    for item in found["screen"]["parameters"]:
        assert set(item["others"]) == {"modal_strain"}
        assert any(item["others"]["modal_strain"])
    for item, true in zip(found["sample"]["parameters"], TRUTH, strict=True):
        # The test is exact but for its digits, and the prior's pull is below a deviation.
        assert abs(item["mean"] - true) < 2.0 * item["deviation"]
    ended = run_command(tmp_path, "update", str(path), "--starts", "2", "--json", "--no-prefect")
    assert ended.returncode == 0, ended.stderr
    told = json.loads(ended.stdout)
    assert [item["updated"] for item in told["parameters"]] == pytest.approx(TRUTH, rel=3e-3)
    assert told["trust"]["starts"]["places"] == 1


def test_two_configurations_share_what_strains_tell(
    tmp_path: Path, truth: tuple[ModalResult, Floats]
) -> None:
    text = campaign(tmp_path, truth, "own", ", eigensolver: pardiso").read_text()
    lines = text.splitlines()
    model, test = lines[1], lines[2]
    each = "".join(f"  - {{name: {name}, {model}, {test}}}\n" for name in ("left", "right"))
    two = tmp_path / "two.yaml"
    two.write_text(text.replace(f"{model}\n{test}\n", f"configurations:\n{each}"))
    ended = run_command(tmp_path, "update", str(two), "--json", "--no-prefect")
    assert ended.returncode == 0, ended.stderr
    updated = [item["updated"] for item in json.loads(ended.stdout)["parameters"]]
    assert updated == pytest.approx(TRUTH, rel=3e-3)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"2-6"', '"2-666"', "the model has no node 666"),
        ("modes: {1:", "modes: {7:", "the test has no mode 7"),
        ('"2-6", ', "", "mode 1 has 4 strains for 3 gauges"),
        ("scale: own", "scale: shapes", "no shapes to define the scale"),
        ("modes: {1:", "modes: {x:", "'x' is not the number of a mode"),
    ],
)
def test_what_cannot_be_compared_is_told_with_file_and_line(
    tmp_path: Path, truth: tuple[ModalResult, Floats], old: str, new: str, said: str
) -> None:
    path = campaign(tmp_path, truth, "own", shapes=False)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    ended = run_command(tmp_path, "check", str(path))
    assert ended.returncode == 2
    assert said in " ".join(ended.stderr.split()), ended.stderr
    assert "bar.yaml, line" in ended.stderr
