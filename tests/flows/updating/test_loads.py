"""Loads that decks spread over elements: structures with closed forms, through the command line."""

from __future__ import annotations

import json
import shutil
from math import cos, pi, sin
from pathlib import Path

import pytest

from tests.command_line import run_command

ccx = pytest.mark.skipif(shutil.which("ccx") is None, reason="ccx is not installed")
mystran = pytest.mark.skipif(shutil.which("mystran") is None, reason="MYSTRAN is not installed")
CAMPAIGN = """name: part
model: {{deck: {deck}, solver: {solver}, units: {units}}}
test: {{modes: test.csv, pairs: {{1: 1}}}}
parameters:
{parameters}
residuals:
  frequency_weight: 0
  static:
    cases:
{cases}
update: {{starts: 1}}
report: {{page: false}}
"""


def updated(folder: Path, text: str, **fields: str) -> list[float]:
    (folder / fields["deck"]).write_text(text)
    (folder / "test.csv").write_text("mode,1\nfrequency_hz,100\n")
    (folder / "part.yaml").write_text(CAMPAIGN.format(**fields))
    ended = run_command(folder, "update", "part.yaml", "--json")
    assert ended.returncode == 0, ended.stderr
    return [item["updated"] for item in json.loads(ended.stdout)["parameters"]]


@ccx
def test_a_cylinder_under_internal_pressure_widens_as_lame_says(tmp_path: Path) -> None:
    """A quarter of a ring, 100 to 150 mm, of quadratic bricks held in its plane and along z:
    u(a) = p a (1 + nu) ((1 - 2 nu) a^2 + b^2) / (E (b^2 - a^2)) in plane strain."""
    a, b, radial, around = 100.0, 150.0, 3, 6
    ids: dict[tuple[int, int, int], int] = {}
    for i in range(2 * radial + 1):
        for j in range(2 * around + 1):
            for k in range(3):
                if (i % 2) + (j % 2) + (k % 2) < 2:
                    ids[i, j, k] = len(ids) + 1

    def at(i: int, j: int) -> tuple[float, float]:
        r, t = a + (b - a) * i / (2 * radial), pi / 4 * j / around
        # Twelve decimals: ccx reads 20 characters, and 6.1e-15 of cos(pi/2) as 0.61.
        return round(r * cos(t), 12), round(r * sin(t), 12)

    nodes = [(n, *at(i, j), 5.0 * k) for (i, j, k), n in ids.items()]
    corners = ((0, 0), (2, 0), (2, 2), (0, 2))
    sides = ((1, 0), (2, 1), (1, 2), (0, 1))
    bricks: list[tuple[int, ...]] = []
    for i in range(0, 2 * radial, 2):
        for j in range(0, 2 * around, 2):
            order = [(x, y, z) for z in (0, 2) for x, y in corners]
            order += [(x, y, z) for z in (0, 2) for x, y in sides]
            order += [(x, y, 1) for x, y in corners]
            bricks.append((len(bricks) + 1, *(ids[i + x, j + y, z] for x, y, z in order)))
    rows = "".join(", ".join(map(str, row)) + "\n" for row in nodes)
    held = "".join(
        f"{n}, {c}\n" for (_, j, k), n in ids.items()
        for c, on in ((2, j == 0), (1, j == 2 * around), (3, k in (0, 2))) if on
    )  # fmt: skip
    inner = [number for number, *_ in bricks if number <= around]
    deck = (
        f"*NODE\n{rows}*ELEMENT, TYPE=C3D20, ELSET=V\n"
        + "".join(", ".join(map(str, r[:11])) + ",\n" + ", ".join(map(str, r[11:])) + "\n"
                  for r in bricks)
        + "*MATERIAL, NAME=A\n*ELASTIC\n200000., 0.3\n*DENSITY\n7.85e-9\n"
        f"*SOLID SECTION, ELSET=V, MATERIAL=A\n*BOUNDARY\n{held}"
        "*STEP\n*STATIC\n*DLOAD\n" + "".join(f"{n}, P6, 50.\n" for n in inner)
        + "*END STEP\n*STEP\n*FREQUENCY\n4\n*END STEP\n"
    )  # fmt: skip
    young = 170000.0
    wide = 50.0 * a * 1.3 * (0.4 * a**2 + b**2) / (young * (b**2 - a**2))
    (value,) = updated(
        tmp_path, deck, deck="ring.inp", solver="calculix", units="mm-t-s",
        parameters="  - {name: E, quantity: youngs_modulus, material: A, bounds: [0.5, 2.0]}",
        cases=f"      - {{load: 1, displacements: {{{ids[0, 0, 1]}.x: {wide:.8g}}}, "
        "tolerance: 1.0e-4}",
    )  # fmt: skip
    # Bricks of 16.7 mm by 15 degrees are stiffer by 5e-6; ccx's own run of its *DLOAD is the same.
    assert value * 200000.0 == pytest.approx(young, rel=1e-4)


@mystran
def test_a_stick_with_a_mass_beside_it_sags_by_both_its_weights(tmp_path: Path) -> None:
    """A horizontal cantilever, L = 2 m, with a mass at its end that is offset along and across:
    w = q L^4 / 8 EI + m g L^3 / 3 EI + m g d L^2 / 2 EI and a twist m g e L / GJ."""
    count, length, area, inertia, torsion = 20, 2.0, 6e-4, 4.5e-8, 5e-8
    grids = "".join(f"GRID,{k + 1},,{length * k / count:.3f},0.,0.\n" for k in range(count + 1))
    bars = "".join(f"CBAR,{k},1,{k},{k + 1},0.,0.,1.\n" for k in range(1, count + 1))
    deck = (
        "SOL 103\nCEND\nMETHOD=1\nSPC=1\nBEGIN BULK\nEIGRL,1,,,3\n"
        f"{grids}{bars}PBAR,1,1,6.-4,4.5-8,4.5-8,5.-8\n"
        f"MAT1,1,2.+11,8.+10,,7800.\nCONM2,99,{count + 1},,3.,.1,.2,0.\nSPC1,1,123456,1\n"
        "LOAD,7,1.,2.,8\nGRAV,8,,4.905,0.,0.,-1.\nENDDATA\n"
    )
    g, bending, density, mass, along, across = 9.81, 2e11 * inertia, 7800.0 * 1.2, 2.4, 0.1, 0.2
    end = f"{count + 1}"
    q, pull = density * area * g, mass * g
    down = q * length**4 / 8 + pull * length**3 / 3 + pull * along * length**2 / 2
    twist = pull * across * length / (8e10 * torsion)
    found = updated(
        tmp_path, deck, deck="stick.bdf", solver="mystran", units="m-kg-s",
        parameters="  - {name: rho, quantity: density, material: 1, bounds: [0.5, 2.0]}\n"
        "  - {name: m, quantity: mass, element: 99, bounds: [0.5, 2.0]}",
        cases=f"      - {{load: 7, displacements: {{{end}.z: {-down / bending:.8g}}}, "
        "tolerance: 1.0e-4}\n"
        f"      - {{load: 7, displacements: {{{end}.rx: {-twist:.8g}}}, tolerance: 1.0e-4}}",
    )  # fmt: skip
    # Lumping twenty bars' weight at their ends adds L^2 h^2 q / 24 EI and less: 0.2 %.
    assert found == pytest.approx([1.2, 0.8], rel=5e-3)
