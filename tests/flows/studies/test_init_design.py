"""Design variables of SOL 200 decks as parameters: three decks, read back by pyNastran."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pyNastran.bdf.bdf import BDF

from modetune.adapters.nastran.deck import read_deck
from modetune.adapters.nastran.design_variables import equation_text
from modetune.core.errors import ModelError
from modetune.core.expressions import evaluate
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.campaign.schema import OpenFile
from modetune.flows.studies.init.draft import init_campaign
from tests.adapters.solved import needs_mystran
from tests.command_line import run_command

pytestmark = needs_mystran
HEAD = "SOL 200\nCEND\nANALYSIS = MODES\nMETHOD = 1\nSPC = 1\nBEGIN BULK\nEIGRL,1,,,4\n"
MATERIAL = "MAT1,1,7.+10,,.33,2700.\n"

#: Three rods to the tip of a tripod; areas by two variables, and one number that is no parameter.
TRUSS = (
    HEAD
    + "GRID,1,,0.,0.,0.\nGRID,2,,1.,0.,0.\nGRID,3,,0.,1.,0.\nGRID,4,,.4,.4,1.,,456\n"
    + "SPC1,1,123456,1,2,3\nCROD,1,11,1,4\nCROD,2,12,2,4\nCROD,3,13,3,4\n"
    + "".join(f"PROD,{n},1,2.-4\n" for n in (11, 12, 13))
    + MATERIAL
    + "CONM2,9,4,,5.\n"
    + "DESVAR,1,AREA,2.-4,1.-4,4.-4\nDESVAR,2,EXTRA,0.,-1.-4,1.-4\nDESVAR,3,STRESS,1.,.5,2.\n"
    + "DVPREL1,1,PROD,11,A\n,1,1.\n"
    + "DVPREL1,2,PROD,12,4,,,1.-5\n,1,.9,2,.4\n"
    + "DVPREL1,3,PROD,13,5\n,3,1.\nDVPREL1,4,PROD,13,C\n,3,1.\n"
    + "DVGRID,1,4,,1.,1.,0.,0.\nENDDATA\n"
)

#: A plate of two thicknesses, the second one linked to the first, and a density.
PLATE = (
    HEAD
    + "".join(f"GRID,{10 * j + i + 1},,{0.2 * i:.1f},{0.2 * j:.1f},0.\n"
              for j in range(2) for i in range(3))
    + "SPC1,1,123456,1,11\nCQUAD4,1,21,1,2,12,11\nCQUAD4,2,22,2,3,13,12\n"
    + "PSHELL,21,1,.004,1,,1\nPSHELL,22,1,.006,1,,1\n"
    + MATERIAL
    + "DESVAR,5,T-INNER,.004,.002,.008\nDESVAR,6,T-OUTER,.006\nDESVAR,7,RHO,2700.,2000.,3000.\n"
    + "DLINK,1,6,.002,.5,5,2.\n"
    + "DVPREL1,1,PSHELL,21,T\n,5,1.\nDVPREL1,2,PSHELL,22,T\n,6,1.\n"
    + "DVMREL1,1,MAT1,1,RHO\n,7,1.\nENDDATA\n"
)  # fmt: skip

#: A cantilever of a square tube: width and wall give area and inertias by equations.
BEAM = (
    HEAD
    + "".join(f"GRID,{i + 1},,{0.25 * i:.2f},0.,0.\n" for i in range(5))
    + "SPC1,1,123456,1\n"
    + "".join(f"CBAR,{i},31,{i},{i + 1},0.,1.,0.\n" for i in range(1, 5))
    + "PBAR,31,1,3.04-4,6.-8,6.-8,1.-7\n"
    + MATERIAL
    + "DESVAR,1,WIDTH,.04,.03,.05\nDESVAR,2,WALL,.002,.001,.003\nDTABLE,TWELVE,12.\n"
    + "DEQATN  40      A(W,T) = W**2 - (W - 2.*T)**2\n"
    + "DEQATN  41      I(W,T,N) = W**4; INNER = (W - 2.D0*T)**4;\n"
    + "        BOTH = (W**4 - INNER)\n"
    + "        /N\n"
    + "DVPREL2,1,PBAR,31,A,,,40\n,DESVAR,1,2\n"
    + "DVPREL2,2,PBAR,31,I1,,,41\n,DESVAR,1,2\n,DTABLE,TWELVE\n"
    + "DVPREL2,3,PBAR,31,I2,,,41\n,DESVAR,1,2\n,DTABLE,TWELVE\n"
    + "DVPREL2,4,PBAR,31,J,,,99\n,DESVAR,1,2\nENDDATA\n"
)


def drafted(folder: Path, deck: str) -> tuple[Campaign, str]:
    """The campaign of a deck as init drafts it, and its text."""
    path = folder / "model.bdf"
    path.write_text(deck)
    draft = init_campaign(path, settings=["model.units=m-kg-s", "model.solver=mystran"])
    return load_campaign(draft.path, [], OpenFile), draft.path.read_text()


def updated(campaign: Campaign, folder: Path, **shown: float) -> Any:
    """Pynastran's model of the deck that is updated to these values of parameters."""
    free = {item.name: item for item in campaign.parameters.parameters}
    values = {name: item.counted(shown[name]) for name, item in free.items()}
    theta = [values[name] for name in campaign.parameters.names]
    own = campaign.parameters.values(campaign.start * 0.0 + theta)
    model = BDF(debug=None)
    model.disable_cards({"DVPREL1"})  # one of the truss's is no relation of pyNastran's either
    model.read_bdf(campaign.write_updated(own, folder / "updated"), xref=False)
    return model


def limits(campaign: Campaign) -> dict[str, tuple[float, float, float]]:
    """Initial value and bounds of the free parameters, as users give them."""
    return {
        item.name: (item.shown(item.initial), item.shown(item.lower), item.shown(item.upper))
        for item in campaign.parameters.parameters
    }


def test_areas_of_a_truss_follow_its_variables(tmp_path: Path) -> None:
    campaign, text = drafted(tmp_path, TRUSS)
    found = limits(campaign)
    assert found["AREA"] == pytest.approx((2e-4, 1e-4, 4e-4))
    assert found["EXTRA"] == pytest.approx((0.0, -1e-4, 1e-4))
    model = updated(campaign, tmp_path, AREA=3e-4, EXTRA=5e-5)
    assert model.properties[11].A == pytest.approx(3e-4)
    assert model.properties[12].A == pytest.approx(1e-5 + 0.9 * 3e-4 + 0.4 * 5e-5)
    assert model.properties[13].A == pytest.approx(2e-4)
    said = " ".join(text.replace("#", " ").split())
    for reason in ("DVGRID 1: it moves grid points", "DVPREL1 4: no quantity of a parameter is C",
                   "J is blank"):  # fmt: skip
        assert reason in said
    assert "STRESS" not in found


def test_limits_that_make_an_area_negative_are_narrowed(tmp_path: Path) -> None:
    campaign, text = drafted(tmp_path, TRUSS.replace("2,.4\n", "2,2.\n"))
    # 1e-5 + 0.9 AREA + 2 EXTRA is 0 at half the limits, and above zero at a tenth.
    found = limits(campaign)
    assert found["AREA"] == pytest.approx((2e-4, 1.8e-4, 2.2e-4))
    assert found["EXTRA"] == pytest.approx((0.0, -1e-5, 1e-5))
    assert "the deck's limits are 0.0001 and 0.0004, where the model is impossible" in text


def test_a_linked_thickness_follows_its_variable(tmp_path: Path) -> None:
    campaign, _ = drafted(tmp_path, PLATE)
    assert limits(campaign) == {
        "T_INNER": pytest.approx((0.004, 0.002, 0.008)),
        "RHO": pytest.approx((2700.0, 2000.0, 3000.0)),
    }
    model = updated(campaign, tmp_path, T_INNER=0.005, RHO=2600.0)
    assert model.properties[21].t == pytest.approx(0.005)
    assert model.properties[22].t == pytest.approx(0.002 + 0.5 * 2.0 * 0.005)
    assert model.materials[1].rho == pytest.approx(2600.0)


def test_a_section_follows_its_equations(tmp_path: Path) -> None:
    campaign, text = drafted(tmp_path, BEAM)
    assert limits(campaign) == {
        "WIDTH": pytest.approx((0.04, 0.03, 0.05)),
        "WALL": pytest.approx((0.002, 0.001, 0.003)),
    }
    model = updated(campaign, tmp_path, WIDTH=0.045, WALL=0.0025)
    section = model.properties[31]  # fields of eight columns hold five digits
    assert section.A == pytest.approx(0.045**2 - 0.04**2, rel=1e-4)
    assert section.i1 == pytest.approx((0.045**4 - 0.04**4) / 12.0, rel=1e-4)
    assert section.i2 == pytest.approx(section.i1)
    assert section.j == pytest.approx(1e-7)
    assert "DEQATN 99 is not there" in " ".join(text.replace("#", " ").split())


def test_the_cards_that_are_read_are_those_of_pynastran(tmp_path: Path) -> None:
    (tmp_path / "model.bdf").write_text(PLATE)
    model = BDF(debug=None)
    model.read_bdf(tmp_path / "model.bdf", xref=False)
    campaign, _ = drafted(tmp_path, PLATE)
    found = limits(campaign)
    for card, name in ((model.desvars[5], "T_INNER"), (model.desvars[7], "RHO")):
        assert found[name] == pytest.approx((card.xinit, card.xlb, card.xub))


def test_an_equation_is_an_expression_with_the_same_value(tmp_path: Path) -> None:
    path = tmp_path / "model.bdf"
    path.write_text(
        HEAD
        + "GRID,1\nDEQATN  1       F(A,B)=SQRT(A*B)+PI(2.)*1.5E-1-MAX(A,\n"
        + "        B)\nDEQATN  2       F(A)=SSQ(A)\nENDDATA\n"
    )
    deck = read_deck(path)
    text = equation_text(deck, 1, ["x", "y"])
    # sqrt(2 * 8) + 2 pi 0.15 - 8
    assert evaluate(text, {"x": 2.0, "y": 8.0}) == pytest.approx(-4.0 + 0.3 * 3.141592653589793)
    with pytest.raises(ModelError, match="ssq"):
        equation_text(deck, 2, ["x"])
    with pytest.raises(ModelError, match="2 arguments, the relation 1"):
        equation_text(deck, 1, ["x"])


def test_the_command_names_the_design_variables(tmp_path: Path) -> None:
    (tmp_path / "model.bdf").write_text(BEAM)
    done = run_command(tmp_path, "init", "model.bdf", "--solver", "mystran", "--units", "m-kg-s")
    assert done.returncode == 0, done.stderr
    assert "free     the deck's 2 design variables: WIDTH, WALL" in done.stdout
