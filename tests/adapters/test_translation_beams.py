"""Bars, beams and rods translated from Nastran to CalculiX, against closed forms."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyNastran.bdf.bdf import BDF
from scipy import integrate

from modetune.adapters.calculix.deck import parse_deck
from modetune.adapters.calculix.model import CalculixModel
from modetune.adapters.calculix.solver import calculix_program
from modetune.adapters.calculix.structure import understand
from modetune.adapters.nastran.cross_sections import shape_of
from modetune.adapters.process import run_process
from modetune.adapters.solver import ModalAnalysis, Solver
from modetune.adapters.translation.translation import translate
from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from modetune.core.updating.job_results import ModalResult
from tests.adapters.solved import needs_ccx

E, G, RHO = 70e9, 70e9 / 2.6, 2700.0
AREA, I1, I2, J = 1e-3, 1e-7, 2e-7, 1.5e-7
MATERIAL = "MAT1,1,70.E9,,.3,2700."
#: Too light to matter beside a mass, heavy enough for every unknown to have some.
LIGHT = "MAT1,2,70.E9,,.3,1.E-3"
PBAR = "PBAR,1,1,1.E-3,1.E-7,2.E-7,1.5E-7"
#: beta L of a free-free and a clamped-free beam (Blevins 1979, table 8-1).
FREE = np.array([4.730041, 7.853205])
CLAMPED = np.array([1.875104, 4.694091])


def read_bulk(*cards: str) -> Any:
    """Cards in free field, continuation lines (eight fields each) after a line end."""
    bulk = BDF(debug=None)
    for card in cards:
        fields: list[str] = []
        for line in card.split("\n"):
            parts = [part.strip() for part in line.split(",")]
            fields += [*parts, *[""] * (9 - len(parts))][1 if fields else 0 :]
        while not fields[-1]:
            fields.pop()
        bulk.add_card(fields, fields[0])
    bulk.cross_reference()
    return bulk


def text(value: float) -> str:
    """A number within the 16 characters of a Nastran field."""
    return f"{value:.8e}"


def line_of_bars(count: int, *cards: str, length: float = 1.0, frame: str = "") -> Any:
    """A straight model along x, of bars 1..count between grid points 1..count+1."""
    grids = [f"GRID,{i + 1},,{text(i * length / count)},0.,0.,{frame}" for i in range(count + 1)]
    bars = [f"CBAR,{i},1,{i},{i + 1},0.,0.,1." for i in range(1, count + 1)]
    own = {",".join(card.split(",")[:2]) for card in cards}
    bars = [bar for bar in bars if ",".join(bar.split(",")[:2]) not in own]
    return read_bulk(MATERIAL, *grids, *bars, *cards)


def problems_of(bulk: Any) -> list[str]:
    """What a refusal says, a line each."""
    with pytest.raises(ModelError) as refused:
        translate(bulk, "model.dat", spc=0, mpc=0)
    return str(refused.value).split("\n")[1:]


def solve(
    bulk: Any, folder: Path, n_modes: int, spc: int = 0, sets: Sequence[str] = ()
) -> ModalResult:
    factor = bulk.params["WTMASS"].values[0] if "WTMASS" in bulk.params else 1.0
    translation = translate(bulk, "model.dat", frozenset(), spc=spc, mpc=0, wtmass=factor)
    deck = parse_deck(Path("model.dat (translated)"), translation.text)
    solver = Solver(CalculixModel(understand(deck), ()), calculix_program())
    analysis = ModalAnalysis(n_modes, translation.grids, tuple((name, (name,)) for name in sets))
    solver.render({}, analysis).write(folder)
    finished = run_process(solver.program.command(1), folder, 60.0, threading.Event())
    result = solver.read({}, analysis, folder, finished.return_code)
    assert isinstance(result, ModalResult)
    return result


def elastic_hz(result: ModalResult, rigid: int) -> Floats:
    frequencies = result.modes.frequencies_hz
    # Rounding of eigenvalues up to 1e6 times those of elastic modes; a bar's spin has next to no
    # inertia (BAR_TORSION), and so the most of it.
    assert frequencies[:rigid].max(initial=0.0) < 5e-2
    return np.asarray(frequencies[rigid:])


def bending_hz(roots: Floats, inertia: float, length: float = 1.0) -> Floats:
    """Euler and Bernoulli."""
    return np.asarray((roots / length) ** 2 / 2 / np.pi * np.sqrt(E * inertia / RHO / AREA))


def nearest(found: Floats, wanted: Floats) -> Floats:
    """Relative differences of each wanted frequency from the found one nearest to it."""
    wanted = np.atleast_1d(wanted)
    return np.asarray([np.abs(found / value - 1.0).min() for value in wanted])


@needs_ccx
def test_a_free_bar_has_the_modes_of_the_closed_forms(tmp_path: Path) -> None:
    result = solve(line_of_bars(20, PBAR), tmp_path, 14)
    found = elastic_hz(result, 6)
    # Rotary inertia (r = 10 and 14 mm) lowers bending by up to 1.1 % in mode 2, which the
    # Euler-Bernoulli formula lacks.
    assert nearest(found, bending_hz(FREE, I1)).max() < 0.008
    assert nearest(found, bending_hz(FREE, I2)).max() < 0.011
    # Nastran's CBAR has no torsional inertia, so there is no torsion among these modes.
    torsion = np.sqrt(G * J / RHO / (I1 + I2)) / 2
    assert nearest(found, torsion).min() > 0.05
    assert result.mass == pytest.approx(RHO * AREA * 1.0, rel=1e-6)


@needs_ccx
def test_a_free_beam_twists_as_the_closed_form_says(tmp_path: Path) -> None:
    beams = [f"CBEAM,{i},1,{i},{i + 1},0.,0.,1." for i in range(1, 21)]
    card = f"PBEAM,1,1,{text(AREA)},{text(I1)},{text(I2)},,{text(J)}"
    grids = [f"GRID,{i + 1},,{text(i / 20)},0.,0." for i in range(21)]
    result = solve(read_bulk(MATERIAL, card, *grids, *beams), tmp_path, 14)
    # sqrt(G J / rho (I1 + I2)) / 2 L, in 20 linear elements.
    assert nearest(elastic_hz(result, 6), np.sqrt(G * J / RHO / (I1 + I2)) / 2).max() < 0.002


@needs_ccx
def test_rotary_inertia_of_beams_is_that_of_rayleighs_beam(tmp_path: Path) -> None:
    beams = [f"CBEAM,{i},1,{i},{i + 1},0.,0.,1." for i in range(1, 21)]
    grids = [f"GRID,{i + 1},,{text(i / 20)},0.,0." for i in range(21)]
    stiff = "PBEAM,1,1,1.E-3,1.E-7,2.E-7,,1.5E-7\n\n,0.,0."  # in shear
    result = solve(read_bulk(MATERIAL, stiff, *grids, *beams), tmp_path, 8)
    # First order in r^2: lambda falls by r^2 int phi'^2 / int phi^2, phi the first
    # free-free mode, whose closed form is integrated here.
    beta, x = 4.730040744862704, np.linspace(0.0, 1.0, 20001)
    sigma = (np.cosh(beta) - np.cos(beta)) / (np.sinh(beta) - np.sin(beta))
    shape = np.cosh(beta * x) + np.cos(beta * x) - sigma * (np.sinh(beta * x) + np.sin(beta * x))
    slope = beta * (np.sinh(beta * x) - np.sin(beta * x))
    slope -= beta * sigma * (np.cosh(beta * x) + np.cos(beta * x))
    ratio = integrate.trapezoid(slope**2, x) / integrate.trapezoid(shape**2, x)
    wanted = bending_hz(FREE[:1], I1) / np.sqrt(1.0 + I1 / AREA * ratio)
    # The first-order formula itself is good to (r^2 ratio)^2 = 2.5e-5.
    assert nearest(elastic_hz(result, 6), wanted).max() < 1e-4


@needs_ccx
def test_strain_energy_is_complete_and_the_propertys_own(tmp_path: Path) -> None:
    result = solve(line_of_bars(6, PBAR), tmp_path, 8, sets=("P1",))
    elastic = slice(6, None)
    whole = 2.0 * result.total_strain_energy[elastic] / result.eigenvalues[elastic]
    assert whole == pytest.approx(1.0, abs=1e-5)  # printed with seven digits
    assert result.strain_energies[0][elastic] == pytest.approx(
        result.total_strain_energy[elastic], rel=1e-5
    )


@needs_ccx
def test_a_cantilever_needs_few_bars(tmp_path: Path) -> None:
    found = elastic_hz(solve(line_of_bars(4, PBAR, "SPC1,1,123456,1"), tmp_path, 4, spc=1), 0)
    # Four cubic elements and rotary inertia: 0.5 % covers both in the first two modes.
    assert nearest(found, bending_hz(CLAMPED, I1)).max() < 0.005
    assert nearest(found, bending_hz(CLAMPED, I2)).max() < 0.007


@needs_ccx
def test_released_ends_make_a_pinned_beam_of_a_clamped_one(tmp_path: Path) -> None:
    bulk = line_of_bars(
        8, PBAR, "CBAR,1,1,1,2,0.,0.,1.\n,56", "CBAR,8,1,8,9,0.,0.,1.\n,,56", "SPC1,1,123456,1,9"
    )
    found = elastic_hz(solve(bulk, tmp_path, 4, spc=1), 0)
    roots = np.pi * np.array([1.0, 2.0])  # beta L = n pi; rotary inertia up to 0.4 %
    assert nearest(found, bending_hz(roots, I1)).max() < 0.003
    assert nearest(found, bending_hz(roots, I2)).max() < 0.005


@needs_ccx
def test_shear_strain_is_timoshenkos(tmp_path: Path) -> None:
    length = 0.1
    cards = [
        LIGHT,
        "PBAR,1,2,1.E-3,1.E-7,2.E-7,1.5E-7\n,,,,,,,,\n,.5,.25",
        "CONM2,9,7,,10.",
        "CONM2,8,1,,10.",
        "SPC1,1,1456,7",
        "SPC1,1,123456,1",
        *(f"GRID,{i + 1},,{text(i * length / 6)},0.,0." for i in range(7)),
        *(f"CBAR,{i},1,{i},{i + 1},0.,0.,1." for i in range(1, 7)),
    ]
    found = elastic_hz(solve(read_bulk(*cards), tmp_path, 2, spc=1), 0)
    # A tip kept from rotating has the stiffness 1 / (L^3 / 12 E I + L / K A G). K1 goes with I1.
    wanted = [
        np.sqrt(1.0 / (length**3 / 12 / E / inertia + length / factor / AREA / G) / 10.0)
        for inertia, factor in ((I1, 0.5), (I2, 0.25))
    ]
    # The light bars weigh 1e-8 of the mass; ccx prints eight digits.
    assert found * 2 * np.pi == pytest.approx(sorted(wanted), rel=1e-6)


@needs_ccx
def test_an_offset_moves_the_axis_and_changes_no_free_mode(tmp_path: Path) -> None:
    bars = [f"CBAR,{i},1,{i},{i + 1},0.,0.,1.\n,,,0.,.03,.02,0.,.03,.02" for i in range(1, 9)]
    (tmp_path / "plain").mkdir()
    (tmp_path / "offset").mkdir()
    plain = solve(line_of_bars(8, PBAR), tmp_path / "plain", 10)
    moved = solve(line_of_bars(8, PBAR, *bars), tmp_path / "offset", 10)
    # A free beam does not know where its grid points are; ccx prints eigenvalues to 8 digits.
    assert elastic_hz(moved, 6) == pytest.approx(elastic_hz(plain, 6), rel=1e-5)


@needs_ccx
def test_offsets_and_orientation_follow_the_output_frame(tmp_path: Path) -> None:
    frame = "CORD2R,5,,0.,0.,0.,0.,1.,0.\n,1.,0.,1."
    bulk = line_of_bars(4, PBAR, frame, "SPC1,1,123456,1", frame="5")
    bars = bulk.elements.values()
    axes = np.asarray(bulk.coords[5].beta())
    for bar in bars:
        bar.x = list(axes @ np.array([0.0, 0.0, 1.0]))
    found = elastic_hz(solve(bulk, tmp_path, 4, spc=1), 0)
    assert nearest(found, bending_hz(CLAMPED[:1], I1)).max() < 0.003
    assert nearest(found, bending_hz(CLAMPED[:1], I2)).max() < 0.003


@needs_ccx
def test_a_corner_carries_bending_over_into_torsion(tmp_path: Path) -> None:
    bulk = read_bulk(
        LIGHT,
        "PBAR,1,2,1.E-3,1.E-7,2.E-7,1.5E-7",
        "CONM2,9,5,,3.",
        "SPC1,1,123456,1",
        "GRID,1,,0.,0.,0.",
        "GRID,2,,.3,0.,0.",
        "GRID,3,,.6,0.,0.",
        "GRID,4,,.6,.2,0.",
        "GRID,5,,.6,.4,0.",
        "CBAR,1,1,1,2,0.,0.,1.",
        "CBAR,2,1,2,3,0.,0.,1.",
        "CBAR,3,1,3,4,0.,0.,1.",
        "CBAR,4,1,4,5,0.,0.,1.",
    )
    found = elastic_hz(solve(bulk, tmp_path, 3, spc=1), 0)
    a, b = 0.6, 0.4
    # Tip force out of the plane: both legs bend (I1: plane 1 holds z) and the first one twists.
    flexibility = (a**3 + b**3) / 3 / E / I1 + a * b**2 / G / J
    # The light bars weigh 3e-7 of the mass; ccx prints eight digits.
    assert nearest(found, np.sqrt(1 / flexibility / 3.0) / 2 / np.pi).max() < 1e-6


@needs_ccx
def test_a_bar_stands_on_a_shell_with_its_rotations(tmp_path: Path) -> None:
    grids = [
        f"GRID,{100 + 3 * i + j},,{text(0.1 * i - 0.1)},{text(0.1 * j - 0.1)},0."
        for i in range(3)
        for j in range(3)
    ]
    corners = [
        (100, 103, 104, 101),
        (101, 104, 105, 102),
        (103, 106, 107, 104),
        (104, 107, 108, 105),
    ]
    plates = [f"CQUAD4,{i},2,{','.join(map(str, four))}" for i, four in enumerate(corners, 50)]
    posts = [
        "GRID,1,,0.,0.,.5",
        "GRID,2,,0.,0.,1.",
        "CBAR,1,1,104,1,1.,0.,0.",
        "CBAR,2,1,1,2,1.,0.,0.",
    ]
    edge = "SPC1,1,123456,100,101,102,103,105,106\n,107,108"
    bulk = read_bulk(
        MATERIAL,
        "MAT1,2,70.E12,,.3,2700.",
        "PSHELL,2,2,.1,2,,2",
        PBAR,
        *grids,
        *plates,
        *posts,
        edge,
    )
    found = elastic_hz(solve(bulk, tmp_path, 6, spc=1), 0)
    # The plate is a thousand times as stiff: the post is a cantilever. A hinge would give 0 Hz.
    assert nearest(found, bending_hz(CLAMPED[:1], I1)).max() < 0.01
    assert nearest(found, bending_hz(CLAMPED[:1], I2)).max() < 0.01


@needs_ccx
def test_a_bar_on_a_solid_is_hinged_there_as_nastran_has_it(tmp_path: Path) -> None:
    corners = [(x, y, z) for z in (0.0, 0.1) for x, y in ((0, 0), (0.1, 0), (0.1, 0.1), (0, 0.1))]
    grids = [
        f"GRID,{100 + i},,{text(x)},{text(y)},{text(z)}" for i, (x, y, z) in enumerate(corners)
    ]
    solid = "CHEXA,50,2,100,101,102,103,104,105\n,106,107"
    bars = [f"GRID,{i + 1},,{text(1.1 - i * 0.125)},0.,0." for i in range(8)]
    bars += [f"CBAR,{i},1,{i},{i + 1},0.,0.,1." for i in range(1, 8)]
    bulk = read_bulk(
        MATERIAL,
        "MAT1,2,70.E12,,.3,2700.",
        "PSOLID,2,2",
        PBAR,
        *grids,
        solid,
        *bars,
        "CBAR,8,1,8,101,0.,0.,1.",
        "SPC1,1,123456,1",
        "SPC1,1,123,100,103,104,107",
        "SPC1,1,4,8",
    )
    found = elastic_hz(solve(bulk, tmp_path, 4, spc=1), 0)
    # Clamped and pinned: beta L = 3.926602 (Blevins 1979, table 8-1), length 1.
    assert nearest(found, bending_hz(np.array([3.926602]), I1)).max() < 0.01
    assert nearest(found, bending_hz(np.array([3.926602]), I2)).max() < 0.01


@needs_ccx
def test_a_product_of_inertia_turns_the_principal_axes(tmp_path: Path) -> None:
    half, quarter = (I1 + I2) / 2, (I2 - I1) / 2
    turned = f"PBAR,1,1,1.E-3,{text(half)},{text(half)},1.5E-7\n,,,,,,,,\n,,,{text(quarter)}"
    found = elastic_hz(solve(line_of_bars(6, turned, "SPC1,1,123456,1"), tmp_path, 4, spc=1), 0)
    # Mohr's circle: I = half +- I12 are the 1e-7 and 2e-7 of the plain section.
    assert nearest(found, bending_hz(CLAMPED[:1], I1)).max() < 0.003
    assert nearest(found, bending_hz(CLAMPED[:1], I2)).max() < 0.003


@needs_ccx
@pytest.mark.parametrize("kind", ["CROD", "CONROD", "CTUBE"])
def test_rods_stretch_as_the_closed_form(kind: str, tmp_path: Path) -> None:
    section = {"CROD": "PROD,1,1,1.E-3", "CTUBE": "PTUBE,1,1,.04,.005", "CONROD": "PROD,1,1,1."}
    tail = ",1,.001" if kind == "CONROD" else ""
    lead = "" if kind == "CONROD" else "1,"
    rods = [f"{kind},{i},{lead}{i},{i + 1}{tail}" for i in range(1, 21)]
    grids = [f"GRID,{i + 1},,{text(i / 20)},0.,0." for i in range(21)]
    fixed = "SPC1,1,23456,1,THRU,21"
    bulk = read_bulk(MATERIAL, section[kind], *grids, *rods, fixed)
    result = solve(bulk, tmp_path, 3, spc=1)
    # sqrt(E / rho) n / 2 L; linear elements are high by (pi n / 20)^2 / 24.
    wanted = np.sqrt(E / RHO) / 2 * np.array([1.0, 2.0])
    assert elastic_hz(result, 1) == pytest.approx(wanted, rel=0.005)
    area = np.pi * (0.02**2 - 0.015**2) if kind == "CTUBE" else AREA
    assert result.mass == pytest.approx(RHO * area, rel=1e-6)


@needs_ccx
def test_nonstructural_mass_counts_without_rotary_inertia(tmp_path: Path) -> None:
    heavy = "PBAR,1,1,1.E-3,1.E-7,2.E-7,1.5E-7,2.7"
    result = solve(line_of_bars(8, heavy, "SPC1,1,123456,1"), tmp_path, 3, spc=1)
    assert result.mass == pytest.approx(2 * RHO * AREA, rel=1e-6)  # 2.7 kg/m once more
    wanted = bending_hz(CLAMPED[:1], I1) / np.sqrt(2.0)
    assert nearest(elastic_hz(result, 0), wanted).max() < 0.003


@needs_ccx
@pytest.mark.parametrize("name", ["cbar_pbar", "cbar_pbarl", "cbar_off", "cord_cd"])
def test_free_bars_agree_with_mystran(name: str, shared_data: Path, tmp_path: Path) -> None:
    bulk = BDF(debug=None)
    bulk.read_bdf(shared_data / "nastran" / "mystran_probes" / f"{name}.dat")
    found = elastic_hz(solve(bulk, tmp_path, 10), 6)
    # First bending modes from expected.json; MYSTRAN lumps the mass at 21 points (0.8 % low at the
    # free ends) and has no rotary inertia (0.3 % high).
    wanted = [179.9168, 254.4408] if name == "cbar_pbar" else [155.5911, 258.6663]
    assert nearest(found, np.array(wanted)).max() < 0.008


def test_the_torsion_constant_of_a_bar_is_mystrans() -> None:
    # K(4,4) L / G of the probe cbar_pbarl: 2.8173708e-07 for 50 x 30 mm.
    assert shape_of("BAR", (0.05, 0.03)).torsion == pytest.approx(2.8173708e-07, rel=1e-7)


@pytest.mark.parametrize(
    ("kind", "dimensions", "area", "inertia_1", "inertia_2"),
    [
        # Differences of solid rectangles and discs, by hand.
        ("BOX", [0.05, 0.04, 0.004, 0.003], 0.05 * 0.04 - 0.044 * 0.032,
         (0.05 * 0.04**3 - 0.044 * 0.032**3) / 12, (0.04 * 0.05**3 - 0.032 * 0.044**3) / 12),
        ("I1", [0.04, 0.004, 0.09, 0.1], 0.044 * 0.1 - 0.04 * 0.09,
         (0.044 * 0.1**3 - 0.04 * 0.09**3) / 12, (2 * 0.005 * 0.044**3 + 0.09 * 0.004**3) / 12),
        ("H", [0.04, 0.01, 0.06, 0.005], 0.01 * 0.06 + 0.04 * 0.005,
         (0.01 * 0.06**3 + 0.04 * 0.005**3) / 12,
         (0.06 * 0.05**3 - 0.055 * 0.04**3) / 12),
        ("CROSS", [0.04, 0.005, 0.06, 0.004], 0.005 * 0.06 + 0.04 * 0.004,
         (0.005 * 0.06**3 + 0.04 * 0.004**3) / 12,
         (0.004 * 0.045**3 + 0.056 * 0.005**3) / 12),
        ("TUBE", [0.02, 0.015], np.pi * (0.02**2 - 0.015**2),
         np.pi / 4 * (0.02**4 - 0.015**4), np.pi / 4 * (0.02**4 - 0.015**4)),
    ],
)  # fmt: skip
def test_shapes_have_the_moments_of_their_parts(
    kind: str, dimensions: list[float], area: float, inertia_1: float, inertia_2: float
) -> None:
    shape = shape_of(kind, tuple(dimensions))
    found = (shape.area, shape.inertia_1, shape.inertia_2)
    assert found == pytest.approx((area, inertia_1, inertia_2), rel=1e-9)


def test_symmetric_shapes_have_no_product_of_inertia_and_an_angle_has() -> None:
    assert shape_of("CHAN", (0.05, 0.1, 0.004, 0.005)).inertia_12 == 0.0
    # By hand: legs of 0.06 x 0.004 and 0.005 x 0.046 about their common centroid.
    a, b = 0.06 * 0.004, 0.005 * 0.046
    wanted = -a * b / (a + b) * (0.05 / 2) * (0.055 / 2)
    assert shape_of("L", (0.06, 0.05, 0.004, 0.005)).inertia_12 == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize(
    ("cards", "reason"),
    [
        (["PBARL,1,1,,HAT\n,.05,.0,.03,.02,"], "CBAR 1: cross-section HAT with"),
        ([PBAR, "CBAR,1,1,1,2,1.,0.,0."], "CBAR 1: its orientation vector is along its axis"),
        ([PBAR, "CBAR,1,1,1,2,0.,0.,1.,EOO\n,,,0.,.01,0.,0.,.01,0."], "OFFT=OOO is not one of"),
        ([PBAR, "CBAR,1,1,1,2,0.,0.,1.\n,4,4"], "CBAR 1: its pin flags leave it a mechanism"),
        ([PBAR, "MAT8,2,1.E9,1.E9,.3,1.E9", "CBAR,1,7,1,2,0.,0.,1.",
          "PBAR,7,2,1.E-3,1.E-7,1.E-7"], "CBAR 1: its material is not a MAT1"),
    ],
)  # fmt: skip
def test_what_cannot_be_translated_is_named(cards: list[str], reason: str) -> None:
    problems = problems_of(line_of_bars(1, *cards))
    assert len(problems) == 1
    assert reason in problems[0]


def test_all_problems_come_at_once() -> None:
    bars = [f"CBAR,{i},1,{i},{i + 1},1.,0.,0." for i in (1, 2, 3)]
    found = problems_of(line_of_bars(3, PBAR, *bars))
    assert found == ["- CBAR 1, 2, 3 (3 of them): its orientation vector is along its axis"]


@needs_ccx
@pytest.mark.parametrize("section", ["PBEAM", "PBEAML"])
def test_a_beam_is_a_bar_with_shear_strain(section: str, tmp_path: Path) -> None:
    properties = {
        "PBEAM": "PBEAM,1,1,1.E-3,1.E-7,2.E-7,,1.5E-7",
        "PBEAML": "PBEAML,1,1,,BAR\n,.02,.05",  # along z, along y: A = 1e-3
    }
    beams = [f"CBEAM,{i},1,{i},{i + 1},0.,0.,1." for i in range(1, 9)]
    grids = [f"GRID,{i + 1},,{text(i / 8)},0.,0." for i in range(9)]
    bulk = read_bulk(MATERIAL, properties[section], *grids, *beams, "SPC1,1,123456,1")
    found = elastic_hz(solve(bulk, tmp_path, 4, spc=1), 0)
    moments = (I1, I2) if section == "PBEAM" else (1e-3 * 0.05**2 / 12, 1e-3 * 0.02**2 / 12)
    # Shear strain takes 0.1 % of the first mode of this slender beam, rotary inertia as much.
    wanted = np.concatenate([bending_hz(CLAMPED[:1], inertia) for inertia in moments])
    assert nearest(found, wanted).max() < 0.004


@needs_ccx
def test_a_frame_of_beams_agrees_with_msc_nastran(shared_data: Path, tmp_path: Path) -> None:
    bulk = BDF(debug=None)
    bulk.read_bdf(shared_data / "nastran" / "yeti_gpwg1" / "rdop2gpwg_1.dat")
    bulk.thermal_materials.clear()  # MAT4, which a translation refuses
    del bulk.card_count["MAT4"]
    found = solve(bulk, tmp_path, 12).modes.frequencies_hz
    # MSC's LAMA in expected.json; heavy bodies on beams whose own mass is a thousandth.
    wanted = [22.273466, 24.674192, 27.884527, 44.261189]
    assert found[6:10] == pytest.approx(wanted, rel=1e-4)
    assert found[:6].max() < 1e-2
