"""Updates by what a structure weighs: closed forms on a chain, a density with a CONM2."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.adapters.nastran.dialect import MYSTRAN
from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import CampaignError
from modetune.core.parameters import Parameter
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.updating.update import update_campaign
from tests.adapters.ccx_decks import plate as shells
from tests.adapters.ccx_decks import strip
from tests.adapters.mystran_decks import frame
from tests.adapters.test_solver_contract import run
from tests.command_line import run_command
from tests.flows.updating.test_mystran_matrices import SENSORS, campaign_file

#: Three masses on springs; kg and N/m.
CHAIN = """masses: {m1: 1.0, m2: 2.0, m3: 1.5}
springs:
  k1: {between: [ground, m1], stiffness: 4.0e4}
  k2: {between: [m1, m2], stiffness: 3.0e4}
  k3: {between: [m2, m3], stiffness: 2.0e4}
"""
#: What all masses and all springs truly are; the model's mass is 4.5 kg.
TRUE_MASS, TRUE_SPRING = 1.1, 0.9
CAMPAIGN = """name: chain
model: {{deck: model.yaml, solver: matrices, units: m-kg-s}}
test: {{modes: measured.csv}}
parameters:
  - {{name: m, quantity: mass, elset: [m1, m2, m3], bounds: [0.5, 2.0]}}
  - {{name: k, quantity: spring_stiffness, elset: [k1, k2, k3], bounds: [0.5, 2.0]}}
residuals:
  mass_properties:
    mass: {mass}
update: {{step: {step}, e1: {{frequency: 1.0e-6, mac: 0.9}}, e2: 0.0, step_limit: 0.3}}
report: {{page: false}}
"""


def chain_file(folder: Path, mass: str, step: str = "trust_region") -> Path:
    (folder / "model.yaml").write_text(CHAIN)
    (folder / "chain.yaml").write_text(CAMPAIGN.format(mass=mass, step=step))
    m = TRUE_MASS * np.array([1.0, 2.0, 1.5])
    a, b, c = TRUE_SPRING * np.array([4e4, 3e4, 2e4])
    k = np.array([[a + b, -b, 0.0], [-b, b + c, -c], [0.0, -c, c]])
    lam = np.linalg.eigvalsh(k / np.sqrt(np.outer(m, m)))
    rows = "".join(f",{np.sqrt(value) / 2 / np.pi:.12f}" for value in lam)
    (folder / "measured.csv").write_text(f"mode,1,2,3\nfrequency{rows}\n")
    return folder / "chain.yaml"


def updated(folder: Path, mass: str, watcher: Any, step: str = "trust_region") -> CampaignRecord:
    campaign = load_campaign(chain_file(folder, mass, step), [f"store={folder / 'store'}"])
    return update_campaign(campaign, folder / "runs", watcher).record


def masses(record: CampaignRecord) -> list[float]:
    return [4.5 * float(item.parameters[0]) for item in record.iterations]


@pytest.mark.parametrize("step", ["trust_region", "weighted_least_squares"])
def test_frequencies_tell_a_ratio_and_the_mass_the_rest(
    tmp_path: Path, watcher: Any, step: str
) -> None:
    record = updated(tmp_path, "{target: 4.95, deviation: 0.001}", watcher, step)
    assert record.status == "converged"
    # m = 4.95 / 4.5, and k / m is what frequencies say.
    np.testing.assert_allclose(record.updated, [TRUE_MASS, TRUE_SPRING], rtol=2e-4)
    block = record.best.residual.blocks[-1]
    assert (block.kind, block.names) == ("mass_properties", ("mass",))
    assert block.measured - record.best.residual.values[-1] == pytest.approx(4.95, rel=2e-4)


@pytest.mark.parametrize("step", ["trust_region", "weighted_least_squares"])
def test_no_step_breaks_a_limit(tmp_path: Path, watcher: Any, step: str) -> None:
    # What was weighed lies on the limit's far side: 4.95 kg would need more than 4.7.
    mass = "{limits: [4.3, 4.7]}"
    record = updated(tmp_path, mass, watcher, step)
    assert record.status == "converged"
    assert all(4.3 <= value <= 4.7 for value in masses(record))
    ratio = record.updated[1] / record.updated[0]
    assert ratio == pytest.approx(TRUE_SPRING / TRUE_MASS, rel=1e-5)


def test_a_limit_between_start_and_truth_is_where_updating_ends(
    tmp_path: Path, watcher: Any
) -> None:
    file = chain_file(tmp_path, "{limits: [null, 4.7]}")
    # With the springs known, the frequencies ask for 4.95 kg (truth: k 1, m 1.1 / 0.9).
    text = file.read_text().replace(
        "  - {name: k, quantity: spring_stiffness, elset: [k1, k2, k3], bounds: [0.5, 2.0]}\n", ""
    )
    file.write_text(text)
    campaign = load_campaign(file, [f"store={tmp_path / 'store'}"])
    record = update_campaign(campaign, tmp_path / "runs", watcher).record
    assert record.status == "stationary"
    assert all(value <= 4.7 for value in masses(record))
    # As far inside as INSIDE of the last changes leaves it.
    assert masses(record)[-1] == pytest.approx(4.7, rel=1e-4)
    # The limit alone decides the one parameter: nothing is left that could scatter.
    assert record.standard_errors[0] < 1e-3
    assert record.trust is not None
    assert record.trust.verdict != "trusted"
    assert any("more than the limit of mass allows" in said for said in record.trust.concerns)
    assert "not met: the limit" not in record.reason


def test_a_start_beyond_a_limit_comes_back_into_it(tmp_path: Path, watcher: Any) -> None:
    record = updated(tmp_path, "{limits: [4.8, 5.5]}", watcher)
    assert record.status == "converged"
    assert masses(record)[0] == 4.5
    assert 4.8 <= masses(record)[-1] <= 5.5


@pytest.mark.parametrize(
    ("mass", "said"),
    [
        ("{target: 4.95}", "`target` and `deviation` belong together"),
        ("{target: 5.2, deviation: 0.1, limits: [4.0, 5.0]}", "outside the limits"),
        ("{limits: [5.0, 4.0]}", "must be below the upper"),
        ("{weight: 2}", "give a `target`"),
        ("{target: -1.0, deviation: 0.1}", "must be above zero"),
        ("{target: 1.0, deviation: 0.1, limit: 3}", "unknown key `limit`"),
    ],
)
def test_what_cannot_be_is_told_with_file_and_line(tmp_path: Path, mass: str, said: str) -> None:
    with pytest.raises(CampaignError, match=said) as told:
        load_campaign(chain_file(tmp_path, mass))
    assert "chain.yaml, line" in str(told.value)


def test_a_centre_of_matrices_is_refused_with_its_line(tmp_path: Path) -> None:
    file = chain_file(tmp_path, "{limits: [4.3, 4.7]}\n    centre_x: {limits: [0, 1]}")
    with pytest.raises(
        CampaignError, match=r"chain.yaml, line 10.*no coordinates, and so only a mass"
    ):
        load_campaign(file)


@pytest.mark.skipif(
    shutil.which(os.environ.get(MYSTRAN.variable, MYSTRAN.program)) is None,
    reason="MYSTRAN is not here (tools/mystran.sh)",
)
@pytest.mark.parametrize("eigensolver", ["solver", "pardiso"])
def test_a_density_and_a_conm2_are_told_apart_by_the_mass_that_mystran_prints(
    tmp_path: Path, watcher: Any, eigensolver: str
) -> None:
    truth: dict[str, Any] = {
        "rho_2": ("density", "material: 2", 1.08),
        "m_unit": ("mass", "element: 301", 0.9),
    }
    nodes = SENSORS[:4]
    file = campaign_file(tmp_path / "frame", frame(), truth, nodes, 5)
    known = (
        Parameter("rho_2", "density", "material", ("2",), 0.6, 1.6, 0.1),
        Parameter("m_unit", "mass", "element", ("301",), 0.6, 1.6, 0.1),
    )
    solver = mystran_solver(file.parent / "part.bdf", known)
    values = {name: value for name, (_, _, value) in truth.items()}
    (tmp_path / "again").mkdir()
    printed = run(solver, values, ModalAnalysis(1, nodes), tmp_path / "again")
    assert isinstance(printed, ModalResult)
    target = f"{{mass: {{target: {printed.mass}, deviation: 1.0e-5}}}}"
    settings = [
        f"store={tmp_path / 'store'}",
        f"model.eigensolver={eigensolver}",
        f"residuals.mass_properties={target}",
        "residuals.shape_weight=0",
        "update.e1.frequency=1e-5",
    ]
    record = update_campaign(load_campaign(file, settings), tmp_path / "runs", watcher).record
    assert record.status == "converged"
    np.testing.assert_allclose(record.updated, [1.08, 0.9], rtol=1e-4)
    computed = printed.mass - record.best.residual.values[-1]
    assert computed == pytest.approx(printed.mass, abs=2e-5)


SHELLS = """name: part
model: {deck: part.inp, solver: calculix, units: mm-t-s}
test: {modes: test.csv, unmatched: drop}
parameters:
  - {name: t_plate, quantity: thickness, elset: P, bounds: [0.5, 2.0]}
  - {name: t_strip, quantity: thickness, elset: U, bounds: [0.5, 2.0]}
residuals:
  frequency_weight: 0
  mass_properties:
    mass: {target: 5.0e-6, deviation: 1.0e-9}
    centre_x: {target: 21.5, deviation: 1.0e-4}
update: {starts: 1}
report: {page: false}
"""


@pytest.mark.skipif(shutil.which("ccx") is None, reason="ccx is not installed")
@pytest.mark.parametrize("held", [False, True])
def test_a_weighing_tells_thicknesses_of_shells_by_calculix(tmp_path: Path, held: bool) -> None:
    """A plate of 30 x 20 with a strip of 10 x 20 at its end, of 2.7e-9."""
    mounts = "".join(
        f"*ELEMENT, TYPE=SPRING1, ELSET=K{n}{c}\n{1000 + 10 * n + c}, {n}\n"
        f"*SPRING, ELSET=K{n}{c}\n{c}\n10.\n"
        for n in (1, 9, 102)
        for c in (1, 2, 3)
    )
    edge = "*BOUNDARY\n1, 1, 6\n5, 1, 6\n9, 1, 6\n" if held else mounts
    (tmp_path / "part.inp").write_text(shells("S4", held="") + strip(3.0) + edge)
    (tmp_path / "test.csv").write_text("mode,1,2\nfrequency_hz,100,200\n")
    (tmp_path / "part.yaml").write_text(SHELLS)
    ended = run_command(tmp_path, "update", "part.yaml", "--json")
    if held:
        assert ended.returncode != 0
        assert "supports hold the remaining mass" in " ".join(ended.stderr.split())
        return
    assert ended.returncode == 0, ended.stderr
    updated = [item["updated"] for item in json.loads(ended.stdout)["parameters"]]
    volume = 5.0e-6 / 2.7e-9
    # V_p + V_u = V and 15 V_p + 35 V_u = 21.5 V; of each as much as its deck's has.
    shares = np.linalg.solve([[1.0, 1.0], [15.0, 35.0]], [volume, 21.5 * volume])
    # Two deviations of the mass, 4e-4, are within e1.
    np.testing.assert_allclose(updated, shares / [1200.0, 600.0], rtol=1e-3)
