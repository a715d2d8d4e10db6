"""Orthotropic materials, laminates and beam sections of CalculiX decks: edited, and solved."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.calculix.cards import CARDS
from modetune.adapters.calculix.places import edited_lines, find_fields, find_numbers
from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.solver import ModalAnalysis
from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from modetune.core.parameters import (
    DAMPING,
    QUANTITIES,
    Parameter,
    Quantity,
    ValueKind,
    counted_from,
)
from modetune.core.updating.job_results import ModalResult
from tests.adapters.calculix.test_affected_elements import D_MATRIX, LAMINATE, ORTHOTROPIC
from tests.adapters.calculix.test_model import model_of, parameter
from tests.adapters.ccx_decks import MATERIAL, attached, beams
from tests.adapters.solved import needs_ccx
from tests.adapters.test_solver_contract import run

FRAME = beams("B31", "301, 301, 302\n302, 302, 303") + MATERIAL + attached(301, 303)
SHARED = LAMINATE.replace(".5, , A, O2", ".5, , A, O1")
#: Deck, quantity, target and item; the lines that a factor of 2 writes.
EDITS: list[tuple[str, Quantity, str, int, list[str]]] = [
    (ORTHOTROPIC, "youngs_modulus", "A", 0,
     ["260000.0, 18000.0, 19000.0, .3, .28, .4, 10000.0, 9600.0", "6600.0"]),
    (ORTHOTROPIC, "youngs_modulus", "A", 2,
     ["130000., 18000.0, 9500., .3, .28, .4, 5000., 4800."]),
    (ORTHOTROPIC, "shear_modulus", "A", 23, ["6600.0"]),
    (ORTHOTROPIC, "poissons_ratio", "A", 13,
     ["130000., 9000., 9500., .3, 0.56, .4, 5000., 4800."]),
    (D_MATRIX, "youngs_modulus", "A", 1212,
     ["700., 40000.0, 600., 500., 400., 300., 21000., 200."]),
    (D_MATRIX, "youngs_modulus", "A", 2323, ["100., 90., 80., 70., 44000.0"]),
    (LAMINATE, "thickness", "P", 0, ["2.0, , A, O1", "1.0, , A, O2"]),
    (LAMINATE, "thickness", "P", 2, ["1.0, , A, O2"]),
    (LAMINATE, "ply_angle", "P", 0, ["3, 60.0", "3, -90.0"]),
    (LAMINATE, "ply_angle", "P", 2, ["3, -90.0"]),
    (FRAME, "dimension", "B", 2, ["2., 6.0"]),
]  # fmt: skip


@pytest.mark.parametrize(("text", "quantity", "target", "item", "lines"), EDITS)
def test_an_item_is_edited_and_nothing_else(
    tmp_path: Path, text: str, quantity: Quantity, target: str, item: int, lines: list[str]
) -> None:
    wanted = replace(parameter(quantity, target), item=item)
    assert list(edited_lines(model_of(tmp_path, text), [(wanted, 2.0)]).values()) == lines


def test_constants_at_several_temperatures_change_together(tmp_path: Path) -> None:
    rows = "130000., 9000., 9500., .3, .28, .4, 5000., 4800.\n3300.\n"
    text = ORTHOTROPIC.replace(rows, rows.replace("3300.", "3300., 20.") + rows)
    wanted = replace(parameter("shear_modulus", "A"), item=23)
    changed = edited_lines(model_of(tmp_path, text), [(wanted, 2.0)])
    assert list(changed.values()) == ["6600.0, 20.", "6600.0"]


@pytest.mark.parametrize(
    ("text", "quantity", "target", "item", "reason"),
    [
        (ORTHOTROPIC, "youngs_modulus", "A", 4, "no item 4 of youngs_modulus; it has 1, 2, 3"),
        (D_MATRIX, "shear_modulus", "A", 0, "an *ELASTIC card of TYPE=ANISO has no shear_modulus"),
        (FRAME, "dimension", "B", 0, "several dimensions: give the item"),
        (FRAME, "dimension", "B", 3, "no item 3 of dimension; it has 1, 2"),
        (SHARED, "ply_angle", "P", 1, "orientation O1 is that of several layers or sections"),
        (LAMINATE.replace("3, 30.\n", ""), "ply_angle", "P", 1, "no item 1 of ply_angle; it has 2"),
        (LAMINATE.replace("3, 30.\n", "").replace("3, -45.\n", ""), "ply_angle", "P", 0,
         "no layer of P has an *ORIENTATION with an angle"),
    ],
)  # fmt: skip
def test_what_is_not_there_is_said_with_what_is(
    tmp_path: Path, text: str, quantity: Quantity, target: str, item: int, reason: str
) -> None:
    with pytest.raises(ModelError, match=re.escape(reason)):
        find_fields(model_of(tmp_path, text), replace(parameter(quantity, target), item=item))


def eigenvalues(
    folder: Path, text: str, wanted: Parameter | None = None, value: float = 1.0
) -> Floats:
    path = folder / "model.inp"
    path.write_text(text)
    solver = calculix_solver(path, (wanted,) if wanted else ())
    node = min(solver.deck.summary.node_ids)
    result = run(solver, {"p": value} if wanted else {}, ModalAnalysis(8, (node,)), folder)
    assert isinstance(result, ModalResult)
    return result.eigenvalues[result.n_rigid :]


@needs_ccx
def test_twice_the_angle_is_that_of_axes_turned_by_hand(tmp_path: Path) -> None:
    wanted = replace(parameter("ply_angle", "P"), item=2)
    turned = eigenvalues(tmp_path, LAMINATE, wanted, 2.0)
    # -90 degrees: the fibres along -y, by the points that give the axes.
    axes = "*ORIENTATION, NAME=O2\n0., -1., 0., 1., 0., 0.\n"
    by_axes = LAMINATE.replace(LAMINATE[LAMINATE.index("*ORIENTATION, NAME=O2") :
                                        LAMINATE.index("*SHELL")], axes)  # fmt: skip
    np.testing.assert_allclose(turned, eigenvalues(tmp_path, by_axes), rtol=1e-6)
    assert np.abs(turned / eigenvalues(tmp_path, LAMINATE) - 1.0).max() > 0.01


FLAT = LAMINATE.replace("3, -45.\n", "3, 0.\n")


@pytest.mark.parametrize(
    ("text", "quantity", "target", "item", "line"),
    [
        (FLAT, "ply_angle", "P", 2, "3, 0."),
        (FRAME.replace("\n100.\n", "\n0.\n"), "spring_stiffness", "K", 0, "0."),
        (FRAME.replace("1e-6", "0.0"), "mass", "M", 0, "0.0"),
        (FRAME.replace("2.7e-9", "0"), "density", "A", 0, "0"),
    ],
)
def test_a_number_that_is_zero_is_refused_with_what_changes_it(
    tmp_path: Path, text: str, quantity: Quantity, target: str, item: int, line: str
) -> None:
    wanted = replace(parameter(quantity, target), item=item)
    with pytest.raises(ModelError) as caught:
        find_numbers(model_of(tmp_path, text), wanted)
    assert str(caught.value) == (
        f"{tmp_path / 'main.inp'}, line {text.splitlines().index(line) + 1}: {quantity} of "
        f"{target} is zero, which no factor changes; give the parameter `values: absolute` or "
        "`additive`, with bounds and a deviation"
    )


@needs_ccx
@pytest.mark.parametrize("kind", ["absolute", "additive"])
def test_a_ply_turns_from_zero_as_in_a_deck_edited_by_hand(tmp_path: Path, kind: ValueKind) -> None:
    origin, scale = counted_from(kind, 0.0, -60.0, 10.0)
    wanted = replace(parameter("ply_angle", "P"), item=2, values=kind, origin=origin, scale=scale)
    turned = eigenvalues(tmp_path, FLAT, wanted, wanted.counted(25.0))
    by_hand = eigenvalues(tmp_path, FLAT.replace("3, 0.\n", "3, 25.\n"))
    np.testing.assert_allclose(turned, by_hand, rtol=1e-6)
    assert np.abs(turned / eigenvalues(tmp_path, FLAT) - 1.0).max() > 0.01


@needs_ccx
def test_engineering_constants_are_those_of_an_isotropic_material(tmp_path: Path) -> None:
    # All moduli go with Young's: nine constants of an isotropic material and two are one.
    nine = ORTHOTROPIC.replace(
        "130000., 9000., 9500., .3, .28, .4, 5000., 4800.\n3300.",
        f"2600., 2600., 2600., .3, .3, .3, 1000., 1000.\n{1000.0}",
    )
    two = nine.replace(
        "*ELASTIC, TYPE=ENGINEERING CONSTANTS\n2600., 2600., 2600., .3, .3, .3, 1000., 1000.\n"
        f"{1000.0}",
        "*ELASTIC\n5200., .3",
    )
    scaled = eigenvalues(tmp_path, nine, parameter("youngs_modulus", "A"), 2.0)
    np.testing.assert_allclose(scaled, eigenvalues(tmp_path, two), rtol=1e-6)


@pytest.mark.parametrize("keyword", CARDS)
def test_a_card_has_quantities_that_parameters_name_by_its_owner(keyword: str) -> None:
    row = CARDS[keyword]
    assert all(row.owner in QUANTITIES[quantity].targets for quantity in row.numbers)
    assert row.moves or set(row.numbers) <= DAMPING
