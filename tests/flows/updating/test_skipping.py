"""e2 where sensitivities cost runs: the thesis's cases on MYSTRAN, Broyden's on other models."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from benchmarks.zoo.__main__ import campaign_of, truth_of
from benchmarks.zoo.families import FAMILIES
from benchmarks.zoo.twins import measured

import modetune
from modetune.flows.jobs import prefect_server
from tests.adapters.mystran_decks import frame
from tests.adapters.solved import needs_mystran
from tests.flows.conftest import api_of
from tests.flows.updating.test_mystran_matrices import SENSORS, campaign_file

FOUR = {
    f"E_{m}": ("youngs_modulus", f"material: {m}", value)
    for m, value in zip(range(1, 5), (0.9, 1.08, 1.1, 0.94), strict=True)
}
#: The thesis: differences in each iteration, or the old matrix as long as the slope is small.
THESIS = (
    "model.eigensolver=solver",
    "sensitivity={method: finite_difference, between: keep}",
    "update.e1={frequency: 1.0e-5, mac: 0.99}",
    "update.starts=1",
    "report.page=true",
)


def update(folder: Path, case: str, e2: float, server_base: Path) -> dict[str, Any]:
    """What `modetune update --json` tells of a case with this e2, with a store of its own."""
    settings = [*THESIS, f"update.e2={e2}", f"store={folder / case}", f"name={case}"]
    ended = subprocess.run(
        [sys.executable, "-m", "modetune", "update", "part.yaml", "--json"]
        + [item for setting in settings for item in ("--set", setting)],
        cwd=folder,
        capture_output=True,
        text=True,
        env={
            **os.environ,
            prefect_server.HOME_VARIABLE: str(server_base),
            "MODETUNE_NO_PREFECT": "0",
        },
        timeout=200,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    told: dict[str, Any] = json.loads(ended.stdout)
    return told


@needs_mystran
def test_both_cases_of_the_thesis_end_alike_on_mystran_and_skips_are_shown(
    tmp_path: Path, server_base: Path
) -> None:
    nodes = tuple(node for node in SENSORS if node <= 17 or node > 100)
    folder = campaign_file(tmp_path / "part", frame(), FOUR, nodes, 8).parent
    always = update(folder, "case-2", 0.0, server_base)
    skipping = update(folder, "case-1", 0.05, server_base)
    assert always["sensitivity_skipped"] == 0 < skipping["sensitivity_skipped"]
    # Four differences a sensitivity: what is counted as skipped was spared.
    runs = [told["solver_runs"]["sensitivity"] for told in (skipping, always)]
    assert runs[0] < runs[1]
    assert runs[0] % len(FOUR) == runs[1] % len(FOUR) == 0
    for told in (always, skipping):
        found = [item["updated"] for item in told["parameters"]]
        np.testing.assert_allclose(found, [value for *_, value in FOUR.values()], rtol=1e-3)
    run = folder / skipping["run_dir"]
    with h5py.File(run / "campaign.h5") as file:
        marks = [bool(item.attrs["sensitivity_skipped"]) for item in file["iterations"].values()]
    assert sum(marks) == skipping["sensitivity_skipped"]
    assert (run / "report.html").read_text().count("new one skipped (e2)") == sum(marks)
    shown = skipped_tasks(server_base, "case-1")
    # A task a column that was spared, with the slope and what it is held against.
    assert len(shown) == len(FOUR) * sum(marks)
    assert all("sensitivity E_" in name for name in shown)
    assert all(
        said.startswith("e2: slope 0.0") and "at most 0.05" in said for said in shown.values()
    )


def skipped_tasks(server_base: Path, campaign: str) -> dict[str, str]:
    """Name to message of a campaign's tasks that the server of a home shows as Skipped."""
    asked = {"limit": 200, "flow_runs": {"name": {"any_": [campaign]}}}
    home = prefect_server.machine_home(server_base)
    found: dict[str, str] = {}
    for _ in range(50):  # the server writes task runs in batches
        runs = api_of(home).post("/task_runs/filter", asked)
        now = {r["name"]: r["state"]["message"] for r in runs if r["state_name"] == "Skipped"}
        if now and now == found:
            return found
        found = now
        time.sleep(0.2)
    return found


@pytest.mark.parametrize("family", ["chain", "assembly", "polar_masses"])
def test_broydens_matrix_with_energies_ends_where_new_ones_do(family: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    structure = FAMILIES[family](rng)
    truth = {item["name"]: float(rng.uniform(0.85, 1.2)) for item in structure.parameters}
    modes, places = truth_of(structure, truth, tmp_path)
    test = measured(modes, places, structure, "exact", rng, tmp_path)
    file = campaign_of(structure, test, tmp_path).file
    ways = ("model.eigensolver=solver", "sensitivity.method=finite_difference", "update.starts=1")
    ended = {}
    for way, e2 in (("always", 0.0), ("skipping", 0.2)):
        settings = [*ways, f"update.e2={e2}", f"store={tmp_path / way}"]
        ended[way] = modetune.update(modetune.load(file, settings), tmp_path / way).record
        assert ended[way].status == "converged", ended[way].reason
        # e1 is 1e-7; moduli that a test tells a thousand times less are as sure as this.
        np.testing.assert_allclose(ended[way].updated, list(truth.values()), rtol=1e-3)
    always, skipping = ended["always"], ended["skipping"]
    assert skipping.runs.sensitivity < always.runs.sensitivity
    old = [item for item in skipping.iterations if item.sensitivity_age]
    assert old
    for item in old:
        # Parts of matrices are proportional to their factors: energies tell frequencies exactly.
        assert set(item.sensitivity_methods) == {"finite_difference+strain_energy"}
