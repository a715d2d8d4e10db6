"""Beams in MYSTRAN jobs and in CalculiX translations, against closed forms and each other."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.nastran.dialect import MYSTRAN
from modetune.adapters.nastran.fields import read_number
from modetune.adapters.nastran.job import job_text
from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.process import run_process
from modetune.adapters.solver import ModalAnalysis
from modetune.adapters.translation.solver import translated_solver
from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from modetune.core.parameters import Parameter
from modetune.core.updating.job_results import ModalResult

E, G = 70e9, 70e9 / 2.6
FREE = "SOL 103\nCEND\nMETHOD = 1\nBEGIN BULK\nEIGRL,1,,,10\n"
HEAD = FREE.replace("BEGIN", "SPC = 1\nBEGIN")
ALUMINIUM = "MAT1,1,70.E9,,.3,2700.\n"
#: Too light to matter beside a mass, heavy enough for every unknown to have some.
LIGHT = "MAT1,1,70.E9,,.3,1.E-4\n"
CLAMPED = "SPC1,1,123456,1\n"
needs_solvers = pytest.mark.skipif(
    shutil.which("mystran") is None or shutil.which("ccx") is None,
    reason="MYSTRAN or CalculiX is not here (tools/mystran.sh)",
)


def solve(text: str, folder: Path, n_modes: int = 8, head: str = HEAD) -> dict[str, ModalResult]:
    """Modes of a deck by both solvers, shapes at all grid points of the deck."""
    path = folder / "model.bdf"
    path.write_text(head + text)
    found = {}
    for name, made in (("mystran", mystran_solver), ("calculix", translated_solver)):
        solver = made(path, ())
        nodes = tuple(sorted(solver.deck.summary.node_ids))
        analysis = ModalAnalysis(n_modes, nodes)
        job = folder / name
        job.mkdir()
        solver.render({}, analysis).write(job)
        run = run_process(solver.program.command(1), job, 60.0, threading.Event())
        result = solver.read({}, analysis, job, run.return_code)
        assert isinstance(result, ModalResult)
        found[name] = result
    return found


def hz(results: dict[str, ModalResult], name: str, count: int) -> Floats:
    return np.asarray(results[name].modes.frequencies_hz[:count])


def grids(places: Sequence[Sequence[float]], tail: str = "") -> str:
    return "".join(
        f"GRID,{number},,{x:.6f},{y:.6f},{z:.6f}{tail}\n"
        for number, (x, y, z) in enumerate(places, start=1)
    )


def line(count: int, length: float, tail: str = "") -> str:
    return grids([(i * length / count, 0.0, 0.0) for i in range(count + 1)], tail)


def beams(count: int, orientation: str = "0.,1.,0.", kind: str = "CBEAM") -> str:
    return "".join(f"{kind},{i},1,{i},{i + 1},{orientation}\n" for i in range(1, count + 1))


@needs_solvers
def test_a_neutral_axis_off_the_shear_centre_bends_what_is_pulled(tmp_path: Path) -> None:
    length, area, i1, n1, mass = 1.0, 1e-3, 1e-7, 0.04, 10.0
    card = f"PBEAM,1,1,{area},{i1},2.E-7,,1.5E-7\n,,,,,,,,\n,0.,0.\n,,,,,{n1},,{n1}\n"
    tip = f"CONM2,9,5,,{mass}\nSPC1,1,345,5\n"
    found = solve(LIGHT + CLAMPED + line(4, length) + card + beams(4) + tip, tmp_path, 2)
    # Flexibilities of the grid point (the shear centre) along x and y: a pull bends as well.
    bend = length**2 / 2 / E / i1 * n1
    flexible = np.array([[length / E / area + n1**2 * length / E / i1, bend],
                         [bend, length**3 / 3 / E / i1]])  # fmt: skip
    wanted = np.sort(1 / np.sqrt(np.linalg.eigvalsh(flexible) * mass)) / 2 / np.pi
    for name in found:
        # The beam weighs 1e-8 of the tip.
        assert hz(found, name, 2) == pytest.approx(wanted, rel=1e-5)


@needs_solvers
def test_a_mass_beside_the_shear_centre_twists_the_beam(tmp_path: Path) -> None:
    length, i1, torsion, z, mass = 1.0, 1e-7, 1.5e-7, 0.1, 10.0
    # A channel's: the mass sits on the neutral axis, to which the grid points are offset (W3).
    card = f"PBEAM,1,1,1.E-3,{i1},2.E-7,,{torsion}\n,,,,,,,,\n,0.,0.\n,,,,,,{z},,{z}\n"
    beam = f"CBEAM,1,1,1,2,0.,1.,0.\n,,,0.,0.,{-z},0.,0.,{-z}\n"
    tip = f"CONM2,9,2,,{mass}\nSPC1,1,3,2\n"
    found = solve(LIGHT + CLAMPED + line(1, length) + card + beam + tip, tmp_path, 1)
    flexible = length**3 / 3 / E / i1 + z**2 * length / G / torsion
    for name in found:
        first = hz(found, name, 1)
        assert first == pytest.approx(1 / np.sqrt(flexible * mass) / 2 / np.pi, rel=1e-5)


@needs_solvers
def test_one_tapered_element_bends_as_the_integral_says(tmp_path: Path) -> None:
    length, mass = 2.0, 20.0
    root, tip = 4e-7, 1e-7  # of I1; I2 is constant
    card = f"PBEAM,1,1,2.E-3,{root},9.E-6,,1.5E-7\n,,,,,,,,\n,YES,1.,1.E-3,{tip},9.E-6,,1.5E-7\n"
    card += ",,,,,,,,\n,0.,0.\n"
    deck = LIGHT + CLAMPED + line(1, length) + card + beams(1) + f"CONM2,9,2,,{mass}\n"
    found = solve(deck + "SPC1,1,345,2\n", tmp_path, 1)
    x = np.linspace(0.0, length, 200001)
    moments = (length - x) ** 2 / (E * (root + (tip - root) * x / length))
    flexible = float(np.sum((moments[1:] + moments[:-1]) / 2) * (x[1] - x[0]))
    wanted = 1 / np.sqrt(flexible * mass) / 2 / np.pi
    assert hz(found, "calculix", 1) == pytest.approx(wanted, rel=1e-5)
    # MYSTRAN gets twelve uniform pieces.
    assert hz(found, "mystran", 1) == pytest.approx(wanted, rel=2e-3)


@needs_solvers
def test_a_wing_of_beams_off_their_neutral_axis_is_that_of_bars_there(tmp_path: Path) -> None:
    """A swept wing, stores below and before it: their inertia is what twists it."""
    count = 10
    places = [(0.3 * i, 0.05 * i, 0.0) for i in range(count + 1)]
    stores = "CONM2,51,11,,4.,.1,,-.05\n,.2,,.3,,,.3\nCONM2,52,6,,3.,.2\n,.1,,.1,,,.1\n"
    sections = {
        "CBEAM": "PBEAM,1,1,2.E-3,8.E-6,2.E-5,,6.E-6\n,,,,,,,,\n,.8,.8\n,,,,,.01,.03,.01,.03\n",
        "CBAR": "PBAR,1,1,2.E-3,8.E-6,2.E-5,6.E-6\n,,,,,,,,\n,.8,.8\n",
    }
    found = {}
    for kind, section in sections.items():
        # Offsets in the elements' own axes: WA of a beam leads to its shear centre.
        w = (0.0, 0.02, -0.03) if kind == "CBEAM" else (0.0, 0.03, 0.0)
        offset = ",".join(map(str, (*w, *w)))
        deck = "MAT1,1,70.E9,,.3,100.\n" + CLAMPED + grids(places) + section + stores
        for i in range(1, count + 1):
            deck += f"{kind},{i},1,{i},{i + 1},0.,0.,1.,GOO\n,,,{offset}\n"
        (tmp_path / kind).mkdir()
        found[kind] = solve(deck, tmp_path / kind, 6)
    wanted = hz(found["CBAR"], "mystran", 6)
    # The bars twist about the neutral axis, 0.03 beside the beams' shear centre, and have no
    # torsional inertia of their own.
    for kind in sections:
        for name in found[kind]:
            assert hz(found[kind], name, 6) == pytest.approx(wanted, rel=0.02)
        masses = [result.mass for result in found[kind].values()]
        assert masses == pytest.approx(masses[:1] * 2, rel=1e-5)


@needs_solvers
def test_beams_and_their_orientation_follow_cylindrical_output_frames(tmp_path: Path) -> None:
    """A ring of channels: the orientation vector is radial in the grid points' own frames."""
    count, radius = 36, 1.0
    angles = 2 * np.pi * np.arange(count) / count
    places = [(radius * np.cos(a), radius * np.sin(a), 0.0) for a in angles]
    ring = grids(places, tail=",7") + "CORD2C,7,,0.,0.,0.,0.,0.,1.\n,1.,0.,0.\nSPC1,1,123456,1\n"
    ring += "PBEAML,1,1,,CHAN\n,.06,.08,.004,.005\nCONM2,99,7,,.5\n"
    ring += "".join(
        f"CBEAM,{i},1,{i},{i % count + 1},-1.,0.,0.\n,,,.01,0.,0.,.01,0.,0.\n"
        for i in range(1, count + 1)
    )
    found = solve(ALUMINIUM + ring, tmp_path, 6)
    # MYSTRAN's lumped masses against consistent ones, ten degrees of the circle each.
    assert hz(found, "mystran", 6) == pytest.approx(hz(found, "calculix", 6), rel=0.02)


@needs_solvers
def test_a_tapered_mast_with_a_tip_mass_agrees(tmp_path: Path) -> None:
    """Round tubes from 200 to 60 mm by PBEAML, station by station, six elements."""
    count, length = 6, 9.0
    radii = np.linspace(0.1, 0.03, count + 1)
    deck = ALUMINIUM + CLAMPED + grids([(0.0, 0.0, i * length / count) for i in range(count + 1)])
    for i in range(1, count + 1):
        a, b = radii[i - 1], radii[i]
        deck += f"PBEAML,{i},1,,TUBE\n,{a:.5f},{a - 0.004:.5f},,YES,1.,{b:.5f},{b - 0.004:.5f}\n"
        deck += f"CBEAM,{i},{i},{i},{i + 1},1.,0.,0.\n"
    deck += f"CONM2,90,{count + 1},,15.\n,.5,,.5,,,.8\n"
    found = solve(deck, tmp_path, 9)
    # In pairs of bending, by lumped and consistent masses: 1 % below the fourth pair.
    assert hz(found, "mystran", 7) == pytest.approx(hz(found, "calculix", 7), rel=0.015)
    mass, other = (result.mass for result in found.values())
    assert mass == pytest.approx(other, rel=1e-4)
    # The mean of A(x) from closed form: pi (r^2 - (r - t)^2) is linear in r.
    area = np.pi * ((0.065) ** 2 - (0.061) ** 2)
    assert other == pytest.approx(2700.0 * area * length + 15.0, rel=1e-5)


@needs_solvers
def test_a_ladder_frame_of_hats_and_angles_agrees(tmp_path: Path) -> None:
    """Free: rails of HAT and HAT1 sections, rungs of L, Z and DBOX, eight elements a member."""
    deck = "PBEAML,1,1,,HAT\n,.06,.004,.05,.03\nPBEAML,2,1,,HAT1\n,.1,.06,.05,.004,.005\n"
    deck += "PBEAML,3,1,,L\n,.06,.05,.005,.005\nPBARL,4,1,,Z\n,.03,.004,.05,.06\n"
    deck += "PBEAML,5,1,,DBOX\n,.1,.05,.04,.003,.002,.003,.004,.004\n,.002,.002\n"
    corners = [(0.5 * i, y) for y in (0.0, 0.6) for i in range(3)]
    members = [(0, 1, 1), (1, 2, 1), (3, 4, 2), (4, 5, 2), (0, 3, 3), (1, 4, 4), (2, 5, 5)]
    count, places, number = 8, [(*corner, 0.0) for corner in corners], 0
    for first, second, pid in members:
        a, b = np.array(corners[first]), np.array(corners[second])
        inner = [(*(a + (b - a) * i / count), 0.0) for i in range(1, count)]
        nodes = [first + 1, *range(len(places) + 1, len(places) + count), second + 1]
        places += inner
        for i in range(count):
            number += 1
            kind = "CBAR" if pid == 4 else "CBEAM"
            deck += f"{kind},{number},{pid},{nodes[i]},{nodes[i + 1]},0.,0.,1.\n"
    found = solve(ALUMINIUM + grids(places) + deck, tmp_path, 11, FREE)
    assert [result.n_rigid for result in found.values()] == [6, 6]
    # MYSTRAN lumps the mass: 2.3 to 5.4 % with four elements a member, a quarter of it with eight.
    assert hz(found, "mystran", 11)[6:] == pytest.approx(hz(found, "calculix", 11)[6:], rel=0.015)
    mass, other = (result.mass for result in found.values())
    assert mass == pytest.approx(other, rel=1e-5)


@needs_solvers
def test_bodies_keep_offset_and_products_of_inertia_in_any_frame(tmp_path: Path) -> None:
    body = "CONM2,9,4,8,10.,.1,.12,.05\n,.4,.02,.5,.03,.04,.6\n"
    frames = "CORD2C,7,,.3,.2,0.,.3,.2,1.\n,1.,.5,0.\nCORD2R,8,,0.,0.,0.,.3,.4,1.\n,1.,.5,0.\n"
    card = "PBAR,1,1,1.E-3,1.E-7,2.E-7,1.5E-7\n"
    found = {}
    for tail in ("", ",7"):
        folder = tmp_path / (tail or "basic")
        folder.mkdir()
        nodes = grids([(0.2 * i, 0.0, 0.1 * i) for i in range(4)], tail)
        bars = "".join(f"CBAR,{i},1,{i},{i + 1},0.,1.,0.,BGG\n" for i in range(1, 4))
        found[tail] = solve(LIGHT + CLAMPED + nodes + frames + card + bars + body, folder, 5)
        assert hz(found[tail], "mystran", 5) == pytest.approx(
            hz(found[tail], "calculix", 5), rel=1e-5
        )
    assert hz(found[""], "mystran", 5) == pytest.approx(hz(found[",7"], "mystran", 5), rel=1e-6)


@needs_solvers
def test_a_bar_and_beam_of_rods_agree_with_msc_nastran(shared_data: Path, tmp_path: Path) -> None:
    path = shared_data / "nastran" / "pn_beam_modes" / "beam_modes.dat"
    solver = mystran_solver(path, ())
    analysis = ModalAnalysis(10, (1, 11))
    solver.render({}, analysis).write(tmp_path)
    run = run_process(solver.program.command(1), tmp_path, 60.0, threading.Event())
    result = solver.read({}, analysis, tmp_path, run.return_code)
    assert isinstance(result, ModalResult)
    # MSC's LAMA: both lump the mass; torsion is that of a CBEAM's inertia at the tip. The OP2 file
    # has seven digits.
    wanted = [456.66034, 456.66034, 2674.5874, 2674.5874, 3554.9229, 4507.4873, 6626.104, 6626.104]
    assert result.modes.frequencies_hz[:8] == pytest.approx(wanted, rel=2e-6)


@needs_solvers
def test_offsets_in_the_elements_axes_are_those_in_the_basic_ones(tmp_path: Path) -> None:
    deck = ALUMINIUM + CLAMPED + line(4, 1.0) + "PBAR,1,1,1.E-3,1.E-7,2.E-7,1.5E-7\n"
    deck += "CONM2,9,5,,1.\n"
    # x along the bar, y up, z across: (0, 0.02, 0.03) of the element is (0, 0.02, 0.03) here too,
    # turned by an orientation vector along -z: y = -z, z = y.
    own = "0.,.02,.03,0.,.02,.03"
    basic = "0.,.03,-.02,0.,.03,-.02"
    found = {}
    for kind, offset in (("GGG", basic), ("BOO", own), ("GGO", None)):
        (tmp_path / kind).mkdir()
        mixed = "0.,.03,-.02,0.,.02,.03"
        text = "".join(
            f"CBAR,{i},1,{i},{i + 1},0.,0.,-1.,{kind}\n,,,{offset or mixed}\n" for i in range(1, 5)
        )
        found[kind] = solve(deck + text, tmp_path / kind, 5)
    for kind in ("BOO", "GGO"):
        for name in ("mystran", "calculix"):
            assert hz(found[kind], name, 5) == pytest.approx(hz(found["GGG"], name, 5), rel=1e-6)


def test_a_parameter_of_a_beams_section_stands_in_the_bars_of_mystran(tmp_path: Path) -> None:
    path = tmp_path / "model.bdf"
    section = "PBEAML,1,1,,HAT\n,.06,.004,.05,.03\n"
    path.write_text(HEAD + ALUMINIUM + line(1, 1.0) + section + beams(1))
    wall = Parameter("t", "dimension", "property", ("1",), 0.5, 2.0, 0.1, item=2)
    solver = mystran_solver(path, (wall,))
    edited = solver.deck.edited({"t": 1.5})
    text = job_text(edited.model, edited.changed, ModalAnalysis(1, ()), MYSTRAN)
    # By hand: crown 0.05, webs 2 x (0.06 - t), brims 2 x 0.03, all of 0.006; webs overlap no brim.
    area = 0.006 * (0.05 + 2 * (0.06 - 0.006) + 2 * 0.03)
    axial = next(line for line in text.splitlines() if line.startswith("PBAR*"))
    assert read_number(axial[40:56]) == pytest.approx(area, rel=1e-9)


@pytest.mark.parametrize(
    ("cards", "reason"),
    [
        ("PBEAM,1,1,1.E-3,1.E-7,2.E-7,,1.E-7\n,,,,,,,,\n,,\n,,,,,.01,,.01\n"
         "CBEAM,1,1,1,2,0.,1.,0.\n,5\n", "no pin flags for a neutral axis off the shear centre"),
        ("PBEAML,1,7,,HAT\n,.06,.004,.05,.03\nCBEAM,1,1,1,2,0.,1.,0.\nMAT8,7,1.E9,1.E9,.3,1.E9,,,9.\n",
         "its material is not a MAT1"),
        ("PTUBE,1,1,.1,.01,,.08\nCTUBE,1,1,1,2\n", "no tapered tubes"),
    ],
)  # fmt: skip
def test_what_mystran_cannot_be_given_is_refused_with_its_line(
    cards: str, reason: str, tmp_path: Path
) -> None:
    path = tmp_path / "model.bdf"
    path.write_text(HEAD + ALUMINIUM + line(1, 1.0) + cards)
    with pytest.raises(ModelError, match=rf"model\.bdf, line \d+: .*{reason}"):
        mystran_solver(path, ())
