"""Springs and bushes translated from Nastran to CalculiX, against closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pyNastran.bdf.bdf import BDF

from tests.adapters.solved import needs_ccx
from tests.adapters.test_translation_beams import problems_of, read_bulk, solve

#: Mass 2, moments of inertia 0.1, 0.2, 0.3 about x, y, z.
BODY = "CONM2,{eid},{node},,2.\n,.1,,.2,,,.3"


def bodies(count: int) -> list[str]:
    """Rigid bodies far apart, enough of them for ccx to have more unknowns than modes."""
    grids = [f"GRID,{i},,{i}.,0.,0." for i in range(1, count + 1)]
    return [*grids, *(BODY.format(eid=200 + i, node=i) for i in range(1, count + 1))]


@needs_ccx
def test_a_grounded_bush_has_six_frequencies(tmp_path: Path) -> None:
    bush = "PBUSH,7,K,1.E5,2.E5,3.E5,1.E3,4.E3,9.E3"
    bushes = [f"CBUSH,{100 + i},7,{i},,,,,0" for i in range(1, 9)]
    result = solve(read_bulk(*bodies(8), bush, *bushes), tmp_path, 9, sets=("P7",))
    # sqrt(k / I): 1e3 / 0.1, 4e3 / 0.2 and 9e3 / 0.3, each below sqrt(1e5 / 2); eight alike.
    assert result.eigenvalues[:8] == pytest.approx(1e4, rel=1e-5)
    assert result.eigenvalues[8:] == pytest.approx(2e4, rel=1e-5)
    assert 2.0 * result.strain_energies[0] == pytest.approx(result.eigenvalues, rel=1e-5)


@needs_ccx
@pytest.mark.parametrize("component", [1, 2, 3, 4, 5, 6])
def test_each_stiffness_of_a_bush_acts_along_its_own_axis(component: int, tmp_path: Path) -> None:
    values = ["1.E8"] * 6
    values[component - 1] = "1.E3"
    # Local x, y, z are basic z, x, y.
    frame = "CORD2R,5,,0.,0.,0.,1.,0.,0.\n,0.,1.,0."
    system = read_bulk(frame).coords[5].beta()
    turned = np.abs(system[(component - 1) % 3]).round() @ [0.1, 0.2, 0.3]
    inertia = 2.0 if component <= 3 else turned
    bushes = [f"CBUSH,{100 + i},7,{i},,,,,5" for i in range(1, 5)]
    bulk = read_bulk(*bodies(4), frame, f"PBUSH,7,K,{','.join(values)}", *bushes)
    result = solve(bulk, tmp_path, 4)
    assert result.eigenvalues == pytest.approx(1e3 / inertia, rel=1e-5)


@needs_ccx
def test_a_bush_between_grid_points_knows_where_it_is(tmp_path: Path) -> None:
    pairs = []
    for i in (1, 3, 5):
        pairs += [f"GRID,{i},,{i}.,0.,0.", f"GRID,{i + 1},,{i}.,.4,0.,,123456"]
        pairs += [BODY.format(eid=200 + i, node=i), f"CBUSH,{i},7,{i},{i + 1},0.,0.,1.\n,.25"]
    stiff = "PBUSH,7,K,1.E8,1.E3,1.E8,1.E8,1.E8,1.E8"
    result = solve(read_bulk(*pairs, stiff), tmp_path, 3)
    # x of the bush is basic y, its y is z-cross: basic z. Only that is soft, at a quarter of the
    # way, where the stiff rotations keep the body from turning: sqrt(k / m).
    assert result.eigenvalues == pytest.approx(1e3 / 2.0, rel=1e-4)


@needs_ccx
def test_a_bush_away_from_its_grid_point_turns_it(tmp_path: Path) -> None:
    cards = []
    for i in range(1, 41, 2):
        cards += [f"GRID,{i},,{i}.,0.,0.,,12345", f"GRID,{i + 1},,{i}.4,0.,0.,,123456"]
        cards += [BODY.format(eid=200 + i, node=i), f"CBUSH,{i},7,{i},{i + 1},0.,1.,0.\n,.5"]
    # Free to turn about z alone, the lever to the middle is 0.2: k r^2 / Izz.
    result = solve(read_bulk(*cards, "PBUSH,7,K,1.E3,1.E3"), tmp_path, 2)
    assert result.eigenvalues == pytest.approx(1e3 * 0.2**2 / 0.3, rel=1e-5)


@needs_ccx
def test_scalar_springs_follow_the_output_frames(tmp_path: Path) -> None:
    frame = "CORD2R,5,,0.,0.,0.,1.,1.,0.\n,0.,0.,1."
    cards = [frame, "PELAS,7,1.E3"]
    for i in range(1, 9):
        cards += [f"GRID,{i},,{i}.,0.,0.,5", BODY.format(eid=200 + i, node=i)]
        cards += [f"CELAS1,{10 * i},7,{i},1", f"CELAS2,{10 * i + 1},4.E3,{i},2"]
        cards += [f"CELAS2,{10 * i + 2},9.E3,{i},3"]
        cards += [f"CELAS2,{10 * i + c},1.E6,{i},{c}" for c in (4, 5, 6)]
    result = solve(read_bulk(*cards), tmp_path, 9, sets=("P7",))
    # sqrt(k / m) along the axes of system 5, whatever they are in the basic system.
    assert result.eigenvalues[:8] == pytest.approx(500.0, rel=1e-5)
    assert result.eigenvalues[8] == pytest.approx(2000.0, rel=1e-5)
    assert 2.0 * result.strain_energies[0][:8] == pytest.approx(500.0, rel=1e-5)
    assert result.strain_energies[0][8] == pytest.approx(0.0, abs=1e-6)


@needs_ccx
def test_springs_between_grid_points_make_a_chain(tmp_path: Path) -> None:
    count = 30
    cards = []
    for i in range(1, count + 1):
        cards += [f"GRID,{i},,{i}.,0.,0.,,23456", f"CONM2,{200 + i},{i},,2."]
    cards += [f"CELAS2,{i},1.E3,{i},1,{i + 1},1" for i in range(1, count)]
    result = solve(read_bulk(*cards), tmp_path, 3)
    # Free chain: lambda_n = 4 k / m sin^2(pi n / 2 N).
    wanted = 4 * 1e3 / 2 * np.sin(np.pi * np.arange(3) / 2 / count) ** 2
    assert result.eigenvalues == pytest.approx(wanted, rel=1e-5, abs=1e-6)


@needs_ccx
@pytest.mark.parametrize(
    ("name", "wanted"),
    [  # The springs' own modes in expected.json, where lumping the bar's mass matters little.
        ("celas1", [9.4237, 23.5123]),
        ("cbush", [4.2196, 4.2584, 25.0048, 47.1390, 49.2391]),
    ],
)
def test_sprung_bars_agree_with_mystran(
    name: str, wanted: list[float], shared_data: Path, tmp_path: Path
) -> None:
    bulk = BDF(debug=None)
    bulk.read_bdf(shared_data / "nastran" / "mystran_probes" / f"{name}.dat")
    frequencies = solve(bulk, tmp_path, 10).modes.frequencies_hz
    elastic = frequencies[frequencies > 1.0][: len(wanted)]
    # MYSTRAN lumps the mass of the bar at 21 points; 23.5 Hz is the least alike, 0.20 %.
    assert elastic == pytest.approx(wanted, rel=0.003)


@pytest.mark.parametrize(
    ("card", "reason"),
    [
        ("CBUSH,101,7,1,2", "CBUSH 101: its ends coincide or one is grounded: it needs a CID"),
        ("CBUSH,101,7,1,3", "CBUSH 101: it has no orientation vector, and stiffness across"),
        ("CBUSH,101,7,1,3,1.,0.,0.", "CBUSH 101: its orientation vector is along its axis"),
        ("CBUSH,101,8,1,,,,,0", "CBUSH 101: the mass of its PBUSH with one end on the ground"),
        ("CELAS2,101,1.,1", "CELAS2 101: its component at point 1 is blank"),
    ],
)
def test_what_cannot_be_translated_is_named(card: str, reason: str) -> None:
    bulk = read_bulk(
        "GRID,1,,0.,0.,0.",
        "GRID,2,,0.,0.,0.",
        "GRID,3,,1.,0.,0.",
        "PBUSH,7,K,1.E3,1.E3",
        "PBUSH,8,K,1.E3,1.E3\n,,M,1.",
        card,
    )
    assert any(reason in problem for problem in problems_of(bulk))


@needs_ccx
def test_a_stiffness_below_zero_is_one_beside_others(tmp_path: Path) -> None:
    cards = bodies(8)
    for i in range(1, 9):
        cards += [f"CELAS2,{10 * i + c},1.E4,{i},{c}" for c in range(1, 7)]
        cards += [f"CELAS2,{100 * i},-9.E3,{i},1"]
    result = solve(read_bulk(*cards), tmp_path, 8)
    assert result.eigenvalues == pytest.approx((1e4 - 9e3) / 2.0, rel=1e-5)


@needs_ccx
def test_springs_stand_beside_composite_shells(tmp_path: Path) -> None:
    grids = [
        f"GRID,{100 + 3 * i + j},,{0.1 * i:.4f},{0.1 * j:.4f},0."
        for i in range(3)
        for j in range(3)
    ]
    corners = (
        (100, 103, 104, 101),
        (101, 104, 105, 102),
        (103, 106, 107, 104),
        (104, 107, 108, 105),
    )
    plates = [f"CQUAD4,{50 + i},2,{','.join(map(str, four))}" for i, four in enumerate(corners)]
    layers = "PCOMP,2\n,1,.001,0.,YES,1,.001,90.,YES"
    springs = [f"CELAS2,{10 * n + c},1.,{n},{c}" for n in (100, 106, 108) for c in (1, 2, 3)]
    bulk = read_bulk("MAT1,1,70.E9,,.3,2700.", *grids, *plates, layers, *springs)
    result = solve(bulk, tmp_path, 3)
    # Soft springs at three corners: the plate moves as a rigid body, and the lowest frequencies
    # are far below its own (about 100 Hz for 0.2 m of 2 mm aluminium).
    assert 0.1 < result.modes.frequencies_hz[0] < 5.0
