"""A spring that starts from nothing leaves a body loose: told beforehand, and while updating."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.studies.check.pre_check import check_campaign
from modetune.flows.updating.mode_source import model_modes
from modetune.flows.updating.update import update_campaign

pytestmark = pytest.mark.skipif(shutil.which("ccx") is None, reason="ccx is not installed")

#: A rod of five bricks that moves along x alone, on a spring that the deck gives no stiffness.
CORNERS = [(0, 0), (10, 0), (10, 10), (0, 10)]
NODES = "".join(
    f"{4 * i + n}, {20.0 * i}, {y}, {z}\n" for i in range(6) for n, (y, z) in enumerate(CORNERS, 1)
)
BRICKS = "".join(
    f"{i + 1}, " + ", ".join(str(4 * i + n) for n in (1, 2, 3, 4, 5, 6, 7, 8)) + "\n"
    for i in range(5)
)
ROD = (
    f"*NODE, NSET=ALL\n{NODES}*ELEMENT, TYPE=C3D8, ELSET=ROD\n{BRICKS}"
    "*ELEMENT, TYPE=SPRING1, ELSET=MOUNT\n90, 1\n*SPRING, ELSET=MOUNT\n1\n0.\n"
    "*MATERIAL, NAME=AL\n*ELASTIC\n70000., 0.\n*DENSITY\n2.7e-9\n"
    "*SOLID SECTION, ELSET=ROD, MATERIAL=AL\n*BOUNDARY\nALL, 2, 3\n"
    "*STEP\n*FREQUENCY\n4\n*END STEP\n"
)
TRUTH = 300.0


def campaign(folder: Path, initial: float) -> Campaign:
    (folder / "rod.inp").write_text(ROD)
    if not (folder / "test.csv").exists():
        (folder / "test.csv").write_text("mode, 1\nfrequency_hz, 1.\n")
    (folder / "campaign.yaml").write_text(
        "name: rod\nmodel: {deck: rod.inp, solver: calculix, units: mm-t-s}\n"
        "test: {modes: test.csv}\nparameters:\n"
        "  - {name: mount, quantity: spring_stiffness, elset: MOUNT, values: absolute,\n"
        f"     initial: {initial}, bounds: [0.0, 2000.0], deviation: 200.0}}\n"
        "report: {page: false}\nupdate: {e1: {frequency: 1.0e-5}}\n"
    )
    return load_campaign(folder / "campaign.yaml")


def measured(folder: Path, mode: int) -> None:
    """A test that found one mode of the rod on its spring."""
    read = campaign(folder, TRUTH)
    found = model_modes(read, read.parameters.values(read.start))
    assert found.n_rigid == 0
    hertz = found.modes.frequencies_hz[mode - 1]
    (folder / "test.csv").write_text(f"mode, 1\nfrequency_hz, {hertz:.12g}\n")


def test_a_start_that_leaves_the_body_loose_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    measured(tmp_path, 2)
    loose = campaign(tmp_path, 0.0)
    report = check_campaign(loose)
    (said,) = [item for item in report.findings if item.where == "parameter mount"
               and "rigid" in item.what]  # fmt: skip
    assert said.level == "doubtful"
    assert said.what.startswith("it starts from nothing, where 1 modes are rigid; at 1000 0 are")
    # The matrices, and what the spring adds, serve both sets.
    assert (report.runs.modal, report.runs.sensitivity) == (0, 2)
    silent: Any = SimpleNamespace(working=lambda text: None, iteration=lambda record: None)
    with caplog.at_level("WARNING"):
        update_campaign(loose, tmp_path / "run", silent)
    assert "the number of rigid modes changes from 1 to 0" in caplog.text


def test_a_start_inside_of_the_bounds_costs_what_updating_costs_and_finds_the_spring(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    measured(tmp_path, 1)
    held = campaign(tmp_path, 500.0)
    report = check_campaign(held)
    assert not [item for item in report.findings if "starts from nothing" in item.what]
    assert (report.runs.modal, report.runs.sensitivity) == (0, 2)
    silent: Any = SimpleNamespace(working=lambda text: None, iteration=lambda record: None)
    with caplog.at_level("WARNING"):
        record = update_campaign(held, tmp_path / "run", silent).record
    assert record.runs.sensitivity == 0  # the pre-check left the matrices
    assert "number of rigid modes" not in caplog.text
    value = held.parameters.shown(record.iterations[-1].parameters)[0]
    assert value == pytest.approx(TRUTH, rel=1e-4)  # e1 is 1e-5 of the frequency, 2e-5 of k
