"""Updated campaigns as design models: read back by `modetune init` and by pyNastran."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from pyNastran.bdf.bdf import BDF

from modetune.adapters.nastran.deck import read_deck
from modetune.adapters.nastran.design_export import DESIGN
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.campaign.schema import OpenFile
from tests.adapters.solved import needs_mystran
from tests.flows.studies.test_init_design import BEAM, PLATE, drafted, limits

pytestmark = needs_mystran


def plain(deck: str) -> str:
    """A deck of the tests of `init` without its design model."""
    kept, inside = [], False
    for line in deck.splitlines():
        inside = line.startswith("DEQATN") or line[:7].startswith((*DESIGN, "DTABLE")) or (
            inside and line.startswith((",", " "))
        )  # fmt: skip
        kept += [] if inside else [line]
    return "\n".join([*kept, ""])


def campaign_of(folder: Path, deck: str, parameters: str) -> Campaign:
    (folder / "model.bdf").write_text(deck)
    (folder / "campaign.yaml").write_text(
        "name: export\nmodel: {deck: model.bdf, solver: mystran, units: m-kg-s}\n"
        f"parameters:\n{parameters}"
    )
    return load_campaign(folder / "campaign.yaml", [], OpenFile)


def exported(campaign: Campaign, folder: Path, **shown: float) -> tuple[BDF, Campaign]:
    """Pynastran's model of the updated deck with its design model, and the campaign of `init`."""
    free = {item.name: item for item in campaign.parameters.parameters}
    theta = [free[name].counted(shown[name]) for name in campaign.parameters.names]
    values = campaign.parameters.values(campaign.start * 0.0 + theta)
    deck = campaign.write_updated(values, folder / "updated")
    text = plain(deck.read_text()).replace("ENDDATA", f"INCLUDE '{deck.stem}_design.bdf'\nENDDATA")
    deck.write_text(text)
    model = BDF(debug=None)
    model.read_bdf(deck)
    again = folder / "again"
    again.mkdir()
    (again / f"{deck.stem}_design.bdf").write_text(
        (deck.parent / f"{deck.stem}_design.bdf").read_text()
    )
    return model, drafted(again, text)[0]


def relation(model: BDF, card: Any) -> float:
    """C0 + sum c x of a linear relation."""
    variables = [model.desvars[number].xinit for number in card.desvar_ids]
    return float(card.c0 + sum(c * x for c, x in zip(card.coeffs, variables, strict=True)))


def test_values_and_bounds_of_a_plate_come_back(tmp_path: Path) -> None:
    campaign = campaign_of(
        tmp_path,
        plain(PLATE),
        "  - {name: E, quantity: youngs_modulus, material: 1, bounds: [0.7, 1.3]}\n"
        "  - {name: t_inner, quantity: thickness, property: 21, values: absolute, initial: 0.004, "
        "bounds: [0.002, 0.008], deviation: 0.001}\n"
        "  - {name: t_outer, quantity: thickness, property: 22, values: absolute, "
        "expression: 0.002 + 0.5 * t_inner}\n"
        "  - {name: extra_density, quantity: density, material: 1, values: additive, initial: 0., "
        "bounds: [-200., 300.], deviation: 50.}\n",
    )
    model, again = exported(campaign, tmp_path, E=1.0625, t_inner=0.005, extra_density=-75.0)
    labels = {number: item.label.lower() for number, item in model.desvars.items()}
    assert labels == {1: "e", 2: "t_inner", 3: "extrad_3", 4: "t_outer"}
    assert limits(again) == {
        "E": pytest.approx((1.0625, 0.7, 1.3)),
        "t_inner": pytest.approx((0.005, 0.002, 0.008)),
        "extrad_3": pytest.approx((-75.0, -200.0, 300.0)),
    }
    sections = {card.pid: relation(model, card) for card in model.dvprels.values()}
    assert sections == pytest.approx({21: 0.005, 22: 0.002 + 0.5 * 0.005})
    assert {card.mp_name: relation(model, card) for card in model.dvmrels.values()} == (
        pytest.approx({"E": 1.0625 * 7e10, "RHO": 2700.0 - 75.0})
    )
    (link,) = model.dlinks.values()
    assert (link.c0, link.cmult, link.coeffs) == (0.002, 1.0, [0.5])
    # The updated deck holds the same numbers, to the digits of a field of eight columns.
    assert model.materials[1].e == pytest.approx(1.0625 * 7e10, rel=1e-4)
    assert model.properties[22].t == pytest.approx(0.0045)


def test_an_expression_becomes_an_equation(tmp_path: Path) -> None:
    tube = "(w**2 - (w - 0.004)**2)"
    campaign = campaign_of(
        tmp_path,
        plain(BEAM),
        "  - {name: w, quantity: variable, initial: 0.04, bounds: [0.03, 0.05], deviation: 0.004, "
        "values: absolute}\n"
        "  - {name: area, quantity: area, property: 31, values: absolute, "
        f"expression: '{tube}'}}\n"
        "  - {name: stiff, quantity: inertia_1, property: 31, expression: '(w / 0.04)**4'}\n",
    )
    model, again = exported(campaign, tmp_path, w=0.045)
    assert limits(again) == {"w": pytest.approx((0.045, 0.03, 0.05))}
    assert sorted(card.type for card in model.dvprels.values()) == ["DVPREL2", "DVPREL2"]
    for name, value in (("A", 0.045**2 - 0.041**2), ("I1", 6e-8 * (0.045 / 0.04) ** 4)):
        (card,) = [item for item in model.dvprels.values() if item.pname_fid == name]
        equation = model.dequations[card.dequation]
        equation.cross_reference(model)
        assert equation.func(0.045) == pytest.approx(value)


def test_a_public_deck_of_sol_200_comes_back(shared_data: Path, tmp_path: Path) -> None:
    source = shared_data / "nastran" / "pn_goland_sol200_dscm2" / "goland_final_test.bdf"
    campaign, _ = drafted(tmp_path, source.read_text())
    start = limits(campaign)
    moved = {name: min(1.02 * value, upper) for name, (value, _, upper) in start.items()}
    _, again = exported(campaign, tmp_path, **moved)
    expected = {name: (moved[name], *bounds) for name, (_, *bounds) in start.items()}
    found = limits(again)
    assert len(found) == len(expected) == 2
    for name, own in expected.items():
        assert found[re.sub(r"\W", "_", name)] == pytest.approx(own)
    assert len(read_deck(tmp_path / "updated" / "model.bdf").named(*DESIGN)) > 2 * len(found) - 1


def test_names_that_are_no_labels_stay_in_comments(tmp_path: Path) -> None:
    campaign = campaign_of(
        tmp_path,
        plain(PLATE),
        "  - {name: wing-root.E, quantity: youngs_modulus, material: 1, bounds: [0.7, 1.3]}\n"
        "  - {name: 1st, quantity: density, material: 1, bounds: [0.7, 1.3]}\n",
    )
    values = dict.fromkeys(("wing-root.E", "1st"), 1.1)
    deck = campaign.case.solver.deck.write_updated(values, tmp_path / "updated")
    text = deck.with_name("model_design.bdf").read_text()
    assert "$ wingro_1: wing-root.E\nDESVAR*" in text
    assert "$ st_2: 1st\nDESVAR*" in text
