"""Absolute and additive parameters and relations between them, in whole campaigns."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from modetune.core.errors import CampaignError
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.report.parameter_tables import parameter_rows
from modetune.flows.updating.mode_source import model_modes, parse_values
from modetune.flows.updating.record import summary
from modetune.flows.updating.update import update_campaign

MYSTRAN = shutil.which(os.environ.get("MODETUNE_MYSTRAN", "mystran"))
needs_mystran = pytest.mark.skipif(MYSTRAN is None, reason="MYSTRAN is not here (tools/mystran.sh)")

E, RHO, LENGTH, HEIGHT, TIP = 7e10, 2700.0, 1.0, 0.03, 0.4
N = 20


def stick(width: float) -> str:
    """A cantilever of rectangular section with a mass at its tip; bending in plane 2 alone."""
    area, flat = width * HEIGHT, HEIGHT * width**3 / 12
    high, twist = width * HEIGHT**3 / 12, 0.229 * HEIGHT * width**3
    grids = [f"GRID,{i + 1},,{i * LENGTH / N:.6f},0.,0.,,345" for i in range(N + 1)]
    bars = [f"CBAR,{i},1,{i},{i + 1},0.,0.,1." for i in range(1, N + 1)]
    return "\n".join([
        "SOL 103", "CEND", "METHOD = 1", "SPC = 1", "BEGIN BULK", "EIGRL,1,,,3", *grids, *bars,
        f"PBAR*,1,1,{area:.10g},{high:.9e}", f"*,{flat:.9e},{twist:.9e}",
        f"MAT1,1,{E:.3e},,.3,{RHO}".replace("e+", "+"), f"CONM2,99,{N + 1},,{TIP}",
        "SPC1,1,123456,1", "ENDDATA\n",
    ])  # fmt: skip


def closed_form_hz(width: float, n: int = 2) -> list[float]:
    """Bending of a uniform cantilever with a mass at its tip (Euler and Bernoulli).

    1 + cos b cosh b = r b (sin b cosh b - cos b sinh b), r the tip's mass over the beam's.
    """
    area, inertia = width * HEIGHT, HEIGHT * width**3 / 12
    ratio = TIP / (RHO * area * LENGTH)

    def residual(b: float) -> float:
        moved = np.sin(b) * np.cosh(b) - np.cos(b) * np.sinh(b)
        return float(1.0 + np.cos(b) * np.cosh(b) - ratio * b * moved)

    grid = np.linspace(0.3, 12.0, 400)
    signs = [residual(b) for b in grid]
    roots = [
        brentq(residual, grid[i], grid[i + 1])
        for i in range(len(grid) - 1)
        if signs[i] * signs[i + 1] < 0.0
    ][:n]
    speed = np.sqrt(E * inertia / (RHO * area)) / LENGTH**2
    return [float(b**2 * speed / 2 / np.pi) for b in roots]


WIDTH = """\
  - {name: width, quantity: variable, values: absolute, initial: 0.02, bounds: [0.01, 0.04], deviation: 0.006}
  - {name: A, quantity: area, property: 1, values: absolute, expression: width * 0.03}
  - {name: I2, quantity: inertia_2, property: 1, values: absolute, expression: 0.03 * width**3 / 12}
  - {name: I1, quantity: inertia_1, property: 1, expression: width / 0.02}
  - {name: J, quantity: torsion_constant, property: 1, expression: (width / 0.02)**3}
"""  # noqa: E501  # a line a parameter, as people write them


def campaign(
    folder: Path, deck: str, hz: list[float], parameters: str, solver: str = "mystran", *more: str
) -> Path:
    name = "model.inp" if deck.startswith("*") else "model.dat"
    (folder / name).write_text(deck)
    modes = ", ".join(str(n) for n in range(1, len(hz) + 1))
    found = ", ".join(f"{value:.9g}" for value in hz)
    (folder / "test.csv").write_text(f"mode, {modes}\nfrequency_hz, {found}\n")
    (folder / "campaign.yaml").write_text(
        f"name: twin\nmodel: {{deck: {name}, solver: {solver}, units: m-kg-s}}\n"
        f"test: {{modes: test.csv}}\nparameters:\n{parameters}"
        "update: {e1: {frequency: 0.00001}}\n" + "".join(f"{line}\n" for line in more)
    )
    return folder / "campaign.yaml"


def updated(path: Path) -> CampaignRecord:
    silent: Any = SimpleNamespace(working=lambda text: None, iteration=lambda record: None)
    return update_campaign(load_campaign(path), path.parent / "run", silent).record


def problems(path: Path) -> str:
    with pytest.raises(CampaignError) as caught:
        load_campaign(path)
    return str(caught.value)


@needs_mystran
def test_one_width_drives_a_section_and_is_found_from_its_closed_form(tmp_path: Path) -> None:
    truth = 0.023
    path = campaign(tmp_path, stick(0.02), closed_form_hz(truth), WIDTH)
    record = updated(path)
    width, area, inertia, *_ = rows = parameter_rows(record)
    # 20 bars of lumped mass miss the closed form by less than 0.3 % in the second mode, and
    # frequencies go with the width, or a power above 1 of it.
    assert width.updated == pytest.approx(truth, rel=3e-3)
    assert area.updated == pytest.approx(0.03 * width.updated, rel=1e-12)
    assert inertia.updated_value == pytest.approx(0.03 * width.updated**3 / 12, rel=1e-12)
    assert [row.name for row in rows] == ["width", "A", "I2", "I1", "J"]
    # dA/A = dw/w and dI/I = 3 dw/w.
    assert width.value_error is not None
    share = width.value_error / width.updated_value
    assert area.value_error == pytest.approx(share * area.updated_value, rel=1e-6)
    assert inertia.value_error == pytest.approx(3 * share * inertia.updated_value, rel=1e-3)
    lines = (tmp_path / "run" / "updated" / "model.dat").read_text().splitlines()
    before = stick(0.02).splitlines()
    assert [n for n, (a, b) in enumerate(zip(before, lines, strict=True)) if a != b] == [
        n for n, line in enumerate(before) if line.startswith(("PBAR*", "*,"))
    ]
    told: Any = summary(record, tmp_path)["parameters"]
    assert json.loads(json.dumps(told))[0]["values"] == "absolute"


FRAME = """\
*NODE
{nodes}
*NODE
201, 0, 0, -0.1
202, 0.4, 0, -0.1
*ELEMENT, TYPE=B31, ELSET=BEAM
{bars}
*ELEMENT, TYPE=SPRING2, ELSET=LEFT
101, 201, 1
*ELEMENT, TYPE=SPRING2, ELSET=RIGHT
102, 202, 5
*MATERIAL, NAME=STEEL
*ELASTIC
2.1e11, .3
*DENSITY
7850.
*BEAM SECTION, ELSET=BEAM, MATERIAL=STEEL, SECTION=RECT
.02, .03
0., 1., 0.
*SPRING, ELSET=LEFT
3, 3
{left}
*SPRING, ELSET=RIGHT
3, 3
{right}
*BOUNDARY
201, 1, 3
202, 1, 3
1, 1, 2
1, 4, 4
1, 6, 6
9, 2, 3
"""
FRAME_NODES = "\n".join(f"{i}, {0.1 * (i - 1):.1f}, 0, 0" for i in range(1, 10))
FRAME_BARS = "\n".join(f"{i}, {i}, {i + 1}" for i in range(1, 9))


def frame(left: float, right: float) -> str:
    return FRAME.format(nodes=FRAME_NODES, bars=FRAME_BARS, left=left, right=right)


def modes_of(path: Path) -> list[float]:
    return elastic_hz(load_campaign(path), "right=1.7e5")


def modes_at(known: Campaign, mount: float) -> list[float]:
    return elastic_hz(known, f"mount={mount}")


def elastic_hz(known: Campaign, setting: str) -> list[float]:
    result = model_modes(known, parse_values(known, [setting]))
    return [float(hz) for hz in np.sqrt(result.elastic.eigenvalues) / 2 / np.pi]


MOUNTS = """\
  - {name: left, quantity: spring_stiffness, elset: LEFT, bounds: [0.5, 2.0]}
  - {name: right, quantity: spring_stiffness, elset: RIGHT, values: additive, bounds: [0, 5.0e5], deviation: 1.0e5}
"""  # noqa: E501


def test_a_mount_that_starts_from_nothing_is_found(tmp_path: Path) -> None:
    """A beam on two springs and a bearing, of which the deck gives one no stiffness."""
    (tmp_path / "truth").mkdir()
    truth = campaign(tmp_path / "truth", frame(2.4e5, 0.0), [10.0, 50.0, 90.0], MOUNTS, "calculix")
    hz = modes_of(truth)[:3]
    record = updated(campaign(tmp_path, frame(2e5, 0.0), hz, MOUNTS, "calculix"))
    left, right = parameter_rows(record)
    assert right.initial == 0.0
    assert left.updated_value == pytest.approx(2.4e5, rel=1e-3)
    assert right.updated_value == pytest.approx(1.7e5, rel=1e-3)
    assert np.isnan(right.change)
    assert set(record.iterations[1].sensitivity_methods) <= {"strain_energy", "semi_analytic"}


PAIR = """\
  - {name: mount, quantity: variable, values: absolute, initial: 2.0e5, bounds: [1.0e5, 4.0e5], deviation: 4.0e4}
  - {name: left, quantity: spring_stiffness, elset: LEFT, values: absolute, expression: mount}
  - {name: right, quantity: spring_stiffness, elset: RIGHT, values: absolute, expression: 3.0e5 - mount / 2}
"""  # noqa: E501


def test_two_springs_that_follow_one_number_have_its_exact_derivative(tmp_path: Path) -> None:
    (tmp_path / "truth").mkdir()
    truth = campaign(tmp_path / "truth", frame(1.0, 2.0), [10.0, 50.0, 90.0], PAIR, "calculix")
    known = load_campaign(truth)
    at = {k: np.array(modes_at(known, k)[:3]) for k in (1.98e5, 2.0e5, 2.02e5, 2.6e5)}
    record = updated(campaign(tmp_path, frame(2e5, 0.0), at[2.6e5].tolist(), PAIR, "calculix"))
    mount, left, right = parameter_rows(record)
    assert mount.updated == pytest.approx(2.6e5, rel=1e-4)
    assert (left.updated, right.updated) == pytest.approx((2.6e5, 1.7e5), rel=1e-4)
    step = record.iterations[1]
    assert step.sensitivity_methods == ("semi_analytic",)
    # The residual is (test - model) / test of eigenvalues; ccx prints seven digits of them.
    slopes = (at[2.02e5] ** 2 - at[1.98e5] ** 2) / 4e3 / at[2.6e5] ** 2
    (item,) = record.parameters.parameters
    assert step.sensitivity[:, 0] / item.scale == pytest.approx(slopes, rel=1e-3)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("values: absolute, initial: 0.02, bounds", "values: absolute, bounds", "need `initial`"),
        (", deviation: 0.006", "", "absolute values need `deviation`"),
        ("width * 0.03", "__import__('os').system('x')", "is not arithmetic"),
        ("width * 0.03", "height * 0.03", "names height; it may name the free parameters"),
        ("width * 0.03", "width * 0.03, initial: 2.0", "`expression` defines the value"),
        ("width * 0.03", "0.03 / (width - 0.02)", "divides by zero at width = 0.02"),
        ("width * 0.03", "0.03 * (width - 0.015)", "area would be -0.00015, it is above zero"),
        ("width * 0.03", "sqrt(width - 0.015)", "has no finite value at width = 0.01"),
    ],
)
def test_relations_that_cannot_be_are_refused_in_one_line(
    tmp_path: Path, old: str, new: str, said: str
) -> None:
    assert old in WIDTH
    path = campaign(tmp_path, stick(0.02), [15.0], WIDTH.replace(old, new), "nastran")
    told = problems(path)
    assert said in told
    assert "campaign.yaml, line" in told


def test_a_variable_that_nothing_names_is_refused(tmp_path: Path) -> None:
    own = "  - {name: E, quantity: youngs_modulus, material: 1}\n"
    path = campaign(tmp_path, stick(0.02), [15.0], own + WIDTH.splitlines()[0] + "\n", "nastran")
    assert "the variable width is not used" in problems(path)
