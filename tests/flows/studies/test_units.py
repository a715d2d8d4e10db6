"""Units are judged by the materials of most of the mass, and a doubt is accepted by its name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.nastran.solver import mystran_solver
from modetune.core.errors import CampaignError
from modetune.core.mesh import Cells, Mesh, cell_sizes
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.campaign.units import KILOGRAMS, guessed_units, unit_doubt
from modetune.flows.studies.check.pre_check import check_campaign

#: A steel plate of 100 x 100 x 2 mm with a film of 0.01 mm whose modulus is a dummy.
PLATE = """\
*NODE
1, 0., 0., 0.
2, 100., 0., 0.
3, 100., 100., 0.
4, 0., 100., 0.
*ELEMENT, TYPE=S4, ELSET=PLATE
1, 1, 2, 3, 4
*ELEMENT, TYPE=S4, ELSET=FILM
2, 1, 2, 3, 4
*MATERIAL, NAME=STEEL
*ELASTIC
210000., 0.3
*DENSITY
7.8e-9
*MATERIAL, NAME=DUMMY
*ELASTIC
1e-6, 0.3
*DENSITY
7.8e-9
*SHELL SECTION, ELSET=PLATE, MATERIAL=STEEL
2.
*SHELL SECTION, ELSET=FILM, MATERIAL=DUMMY
0.01
"""
NASTRAN = """\
SOL 103
CEND
METHOD = 1
BEGIN BULK
EIGRL,1,,,5
GRID,1,,0.,0.,0.
GRID,2,,100.,0.,0.
GRID,3,,100.,100.,0.
GRID,4,,0.,100.,0.
CQUAD4,1,1,1,2,3,4
CQUAD4,2,2,1,2,3,4
PSHELL,1,1,2.
PSHELL,2,2,.01
MAT1,1,210000.,,.3,7.8-9
MAT1,2,1.-6,,.3,7.8-9
ENDDATA
"""


@pytest.mark.parametrize("kind", ["inp", "bdf"])
def test_a_dummy_film_raises_no_doubt_and_wrong_units_do(tmp_path: Path, kind: str) -> None:
    file = tmp_path / f"plate.{kind}"
    file.write_text(PLATE if kind == "inp" else NASTRAN)
    solver = calculix_solver(file, ()) if kind == "inp" else mystran_solver(file, ())
    masses = sorted(solver.deck.material_masses().values())
    assert masses == pytest.approx([1e4 * 0.01 * 7.8e-9, 1e4 * 2.0 * 7.8e-9])
    assert unit_doubt("mm-t-s", solver) == ""
    doubt = unit_doubt("m-kg-s", solver)
    # sqrt(210000 / 7.8e-9) = 5.19e6 of the deck's length a second.
    assert "has a speed of sound of 5.19e+06 m/s" in doubt
    assert "with most of the mass" in doubt
    assert doubt.endswith("; mm-t-s would fit")


def test_sizes_of_cells_are_those_of_boxes_and_near_those_of_others() -> None:
    places = np.array(
        [[x, y, z] for x in (0.0, 2.0) for y in (0.0, 3.0) for z in (0.0, 5.0)], dtype=np.float64
    )
    mesh = Mesh(
        np.arange(1, 9),
        places,
        (
            Cells("hexahedron", np.array([1]), np.array([[1, 5, 7, 3, 2, 6, 8, 4]])),
            Cells("quad", np.array([2]), np.array([[1, 5, 7, 3]])),
            Cells("line", np.array([3]), np.array([[1, 8]])),
            Cells("triangle", np.array([4]), np.array([[1, 5, 7]])),
            Cells("vertex", np.array([5]), np.array([[1]])),
        ),
    )
    sizes = cell_sizes(mesh)
    assert sizes[1] == pytest.approx(30.0)
    assert sizes[2] == pytest.approx(6.0)
    assert sizes[3] == pytest.approx(38.0**0.5)
    assert sizes[4] == pytest.approx(3.0, rel=0.02)
    assert sizes[5] == 0.0


def test_a_doubt_about_units_is_no_error_is_told_and_is_accepted_by_its_name(
    tmp_path: Path,
) -> None:
    (tmp_path / "plate.inp").write_text(PLATE)
    (tmp_path / "test.csv").write_text("mode,1,2\nfrequency_hz,10,20\n")
    text = (
        "name: small\nmodel: {deck: plate.inp, solver: calculix, units: m-kg-s}\n"
        "test: {modes: test.csv}\nparameters:\n"
        "  - {name: E, quantity: youngs_modulus, material: STEEL}\n"
    )
    file = tmp_path / "campaign.yaml"
    file.write_text(text)
    settings = [f"store={tmp_path / 'store'}"]
    found = check_campaign(load_campaign(file, settings), run=False).findings
    doubts = [item for item in found if "speed of sound" in item.what]
    assert [(item.level, item.where) for item in doubts] == [("doubtful", "model.units")]
    assert "`model.checks: [units]`" in doubts[0].remedy
    file.write_text(text.replace("m-kg-s}", "m-kg-s, checks: [units, size]}"))
    found = check_campaign(load_campaign(file, settings), run=False).findings
    levels = {item.level for item in found if item.subject == "model"}
    assert levels == {"good"}
    file.write_text(text.replace("m-kg-s}", "m-kg-s, checks: [unit]}"))
    with pytest.raises(CampaignError, match=r"line 2: model\.checks"):
        load_campaign(file, settings)


@pytest.mark.parametrize(
    ("young", "density", "units"),
    [
        ("2.1e11", "7850.", "m-kg-s"),
        ("210000.", "7.85e-9", "mm-t-s"),
        ("2.96e7", "7.3e-4", "in-slinch-s"),
        ("4.2e9", "15.2", "ft-slug-s"),
        ("2.1e8", "7.85e-6", "mm-kg-s"),  # millinewtons, kPa
        ("2.1e8", "7.85", None),  # m-t-s, or a light metal in ft-slug-s
        ("7.e10", "2.7e-3", "mm-g-s"),
        ("7.e11", "2.7", "cm-g-s"),
        ("7.e10", "2700.", "m-kg-s"),
        ("3.e9", "1100.", "m-kg-s"),  # a plastic
        ("1.35e5", "1.6e-9", "mm-t-s"),  # fibres in resin
        ("1.", "1.", None),  # a model without units
        ("3.e7", ".28", None),  # psi beside pounds an inch cubed, without WTMASS
    ],
)
def test_units_are_guessed_where_one_system_makes_a_real_material(
    young: str, density: str, units: str | None, tmp_path: Path
) -> None:
    deck = tmp_path / "plate.inp"
    text = PLATE.replace("210000.", young).replace("7.8e-9", density)
    deck.write_text(text, encoding="utf-8")
    found, why = guessed_units(calculix_solver(deck, ()))
    assert found == units
    assert f"E {float(young):g}" in why  # the reason is told, whatever follows from it


#: A pipe in millinewtons, millimetres and kilograms, as Simcenter writes it.
PIPE = """\
SOL 103
CEND
METHOD = 1
BEGIN BULK
{units}
EIGRL,1,,,3
GRID,1,,0.,0.,0.,,123456
GRID,2,,300.,0.,0.
CBAR,1,1,1,2,0.,1.,0.
PBAR,1,1,100.,800.,800.,1600.
MAT1,1,{young},,.3,{density}
ENDDATA
"""


@pytest.mark.parametrize(
    ("stated", "units"),
    [
        ("PARAM    UNITSYS   MN-MM", "mm-kg-s"),
        ("PARAM,UNITSYS,N-MM", "mm-t-s"),
        ("PARAM,UNITSYS,M-N", "m-kg-s"),
        ("PARAM,UNITSYS,LBF-IN", "in-slinch-s"),
        ("PARAM,UNITSYS,LBF-FT", "ft-slug-s"),
        ("$*  Units: mm (milli-newton) (deg Celsius)", "mm-kg-s"),
        ("$*                UNITS: inch (pound f)", "in-slinch-s"),
        ("PARAM,UNITSYS,KN-M", "m-t-s"),
        ("PARAM,UNITSYS,KGF-CM", None),
    ],
)
def test_units_that_a_deck_states_go_before_a_guess(
    stated: str, units: str | None, tmp_path: Path
) -> None:
    deck = tmp_path / "pipe.bdf"
    deck.write_text(PIPE.format(units=stated, young="2.1e8", density="7.85-6"))
    solver = mystran_solver(deck, ())
    found, why = guessed_units(solver)
    if units is None:  # KGF is not read, so that the material decides
        assert found == "mm-kg-s"
        return
    assert found == units
    assert "pipe.bdf, line 5" in why
    assert (unit_doubt("mm-kg-s", solver) == "") == (units == "mm-kg-s")
    # Tonnes have the same speed of sound: only the statement can contradict them.
    assert ("units are mm-t-s, but" in unit_doubt("mm-t-s", solver)) == (units != "mm-t-s")


def test_a_rigid_material_without_mass_does_not_vote_on_units(tmp_path: Path) -> None:
    deck = tmp_path / "wing.bdf"
    text = PIPE.format(units="CONM2,9,2,,11.33", young="4.e9", density="")
    deck.write_text(text)
    assert guessed_units(mystran_solver(deck, ()))[0] is None
    rigid = "GRID,3,,400.,0.,0.\nCBAR,2,2,2,3,0.,1.,0.\nPBAR,2,2,1.,1.,1.,1.\nMAT1,2,4.e9,,.3"
    deck.write_text(PIPE.format(units=rigid, young="210000.", density="7.85-9"))
    assert guessed_units(mystran_solver(deck, ()))[0] == "mm-t-s"


def test_masses_of_a_model_in_millinewtons_are_in_kilograms(tmp_path: Path) -> None:
    deck = tmp_path / "pipe.bdf"
    deck.write_text(PIPE.format(units="PARAM,UNITSYS,MN-MM", young="2.1e8", density="7.85-6"))
    mass = sum(mystran_solver(deck, ()).deck.material_masses().values())
    assert mass * KILOGRAMS["mm-kg-s"] == pytest.approx(7850.0 * 0.3 * 100e-6)


def test_masses_of_a_model_in_pounds_count_the_mass_factor(tmp_path: Path) -> None:
    deck = tmp_path / "pipe.bdf"
    pounds = PIPE.format(units="PARAM,WTMASS,.00259", young="3.e7", density=".283")
    deck.write_text(pounds)
    mass = sum(mystran_solver(deck, ()).deck.material_masses().values())
    deck.write_text(PIPE.format(units="", young="3.e7", density=f"{0.283 * 0.00259:.6e}"))
    same = sum(mystran_solver(deck, ()).deck.material_masses().values())
    assert mass == pytest.approx(same, rel=1e-5)


@pytest.mark.parametrize(
    ("head", "units"),
    [
        ("*HEADING\nHash: xf2VM4mZ, Date: 05/19/2026, Unit system: M_KG_S_C\n", "m-kg-s"),
        ("*Heading\nHash: xf2VM4mZ, Date: 05/19/2026, Unit system: MM_TON_S_C\n", "mm-t-s"),
        ("*HEADING\nUnit system: M_TON_S_C\n", "m-t-s"),
        ("*HEADING\nUnit system: IN_LB_S_F\n", "in-slinch-s"),
        ("** Unit system: cm, g, s, dyn\n", "cm-g-s"),
        ("** A bracket; units = N mm\n", "mm-t-s"),
        ("** Units: see the drawing\n", None),
        ("*HEADING\nUnit system: UNIT_LESS\n", None),
    ],
)
def test_units_in_the_heading_of_a_calculix_deck_go_before_a_guess(
    head: str, units: str | None, tmp_path: Path
) -> None:
    deck = tmp_path / "plate.inp"
    deck.write_text(head + PLATE.replace("210000.", "7.e10").replace("7.8e-9", "2.7e-3"))
    solver = calculix_solver(deck, ())
    found, why = guessed_units(solver)
    assert found == (units or "mm-g-s")  # else the material decides
    assert ("plate.inp, line" in why) == (units is not None)
    assert ("units are mm-g-s, but" in unit_doubt("mm-g-s", solver)) == (units is not None)
