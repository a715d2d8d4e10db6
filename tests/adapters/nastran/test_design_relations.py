"""Relations in SOL 200: DVPREL2 cards whose equations pyNastran reads and evaluates."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from pyNastran.bdf.bdf import BDF

from modetune.adapters.nastran.deck import read_deck
from modetune.adapters.nastran.design_relations import equation_card, in_fortran
from modetune.adapters.nastran.dialect import DIALECTS
from modetune.adapters.nastran.job import job_text
from modetune.adapters.nastran.model import understand
from modetune.adapters.solver import SensitivityAnalysis
from modetune.core.expressions import degree, evaluate, names_of
from modetune.core.parameters import Parameter, counted_from

DECK = """\
SOL 103
CEND
METHOD = 1
SPC = 1
BEGIN BULK
EIGRL,1,,,4
GRID,1,,0.,0.,0.
GRID,2,,1.,0.,0.
CBAR,1,1,1,2,0.,0.,1.
PBAR,1,1,6.-4,1.8-8,4.5-8,4.2-8
CELAS2,5,0.,2,3
MAT1,1,7.+10,,.3,2700.
SPC1,1,123456,1
ENDDATA
"""


def dependent(name: str, quantity: str, expression: str, values: str) -> Parameter:
    own = (name, quantity, "property", ("1",), 0.0, 0.0, 0.0)
    return Parameter(*own, values=values, expression=expression)  # type: ignore[arg-type]


ORIGIN, SCALE = counted_from("absolute", 0.0, 0.0, 2e4)
PARAMETERS = (
    Parameter("w", "variable", "placeholder", ("w",), 0.5, 2.0, 0.2, values="absolute", scale=0.02),
    Parameter("h", "variable", "placeholder", ("h",), 0.5, 2.0, 0.2),
    Parameter(
        "k", "spring_stiffness", "element", ("5",), 1.0, 2.0, 0.2, 1.0, 0, "absolute", ORIGIN, SCALE
    ),
    dependent("A", "area", "w * 0.03 * h", "absolute"),
    dependent("I", "inertia_1", "w**3 * (-0.5 + 1.5) / sqrt(h**2) / 444.4", "absolute"),
    dependent("J", "torsion_constant", "1.2 * h", "relative"),
)


@pytest.mark.parametrize("values", [{}, {"w": 1.2, "h": 0.9, "k": 1.25}])
def test_the_design_model_says_what_the_edited_deck_says(
    tmp_path: Path, values: dict[str, float]
) -> None:
    (tmp_path / "bar.dat").write_text(DECK)
    model = understand(read_deck(tmp_path / "bar.dat"), PARAMETERS)
    values = values or dict.fromkeys("whk", 1.0)
    changed = model.changed(values)
    asked = SensitivityAnalysis(2, ("w", "h", "k"))
    text = job_text(model, changed, asked, DIALECTS["msc"], values)
    (tmp_path / "job.dat").write_text(text)
    bdf = BDF(debug=None)
    bdf.read_bdf(tmp_path / "job.dat", xref=False)
    assert {card.xinit for card in bdf.desvars.values()} == {1.0}
    bar = bdf.properties[1]
    numbers = {"A": bar.A, "I1": bar.i1, "J": bar.j}
    there = model.bulk_at(model.changed({**values, "w": 1.01 * values["w"]})).properties[1]
    moved = {"A": there.A, "I1": there.i1, "J": there.j}
    found = {card.pname_fid: card for card in bdf.dvprels.values()}
    assert found.keys() == numbers.keys()
    for name, card in found.items():
        assert card.type == "DVPREL2"
        equation = bdf.dequations[card.dequation]
        equation.cross_reference(bdf)
        # Numbers of the deck have eight columns, and so have those beside.
        assert equation.evaluate(*[1.0] * len(card.dvids)) == pytest.approx(numbers[name], rel=1e-5)
        at = [1.01 if number == 1 else 1.0 for number in card.dvids]
        assert equation.evaluate(*at) == pytest.approx(moved[name], rel=1e-5)
    (spring,) = bdf.dvcrels.values()
    assert spring.coeffs == [pytest.approx(SCALE * values["k"], rel=1e-9)]
    assert spring.c0 + spring.coeffs[0] == pytest.approx(ORIGIN + SCALE * values["k"], abs=1e-3)


@pytest.mark.parametrize(
    ("expression", "at", "expected", "power"),
    [
        ("2 * a + b / 4 - 1", {"a": 3.0, "b": 8.0}, 7.0, 1),
        ("-a ** 2 + min(a, b, 2)", {"a": 3.0, "b": 8.0}, -7.0, 2),
        ("a * pi / pi", {"a": 3.0}, 3.0, 1),
        ("sqrt(abs(-16)) + exp(0) + log10(1e3)", {}, 8.0, 0),
        ("a / b", {"a": 3.0, "b": 2.0}, 1.5, 2),
    ],
)
def test_expressions_are_arithmetic_here_and_in_nastran(
    expression: str, at: dict[str, float], expected: float, power: int
) -> None:
    assert evaluate(expression, at) == pytest.approx(expected, rel=1e-15)
    assert set(names_of(expression)) == set(at)
    assert degree(expression) == power
    arguments = [f"X{n}" for n in range(1, len(at) + 1)] or ["X1"]
    text = in_fortran(expression, dict(zip(names_of(expression), arguments, strict=False)))
    lines = equation_card(7, arguments, f"{text}+0.0*X1")
    assert max(map(len, lines)) <= 72
    bdf = BDF(debug=None)
    bdf.add_card_lax(lines, "DEQATN", is_list=False, has_none=False)
    bdf.dequations[7].cross_reference(bdf)
    found = bdf.dequations[7].evaluate(*[at[name] for name in names_of(expression)] or [1.0])
    assert found == pytest.approx(expected, rel=1e-12)


def test_a_long_equation_goes_on_in_further_lines() -> None:
    expression = " + ".join(f"{n}.5 * long_name_of_a_width ** {n}" for n in range(1, 12))
    text = in_fortran(expression, {"long_name_of_a_width": "(0.0+0.02*X1)"})
    lines = equation_card(7, ["X1"], text)
    assert len(lines) > 3
    assert max(map(len, lines)) <= 72
    assert "".join(line[16 if n == 0 else 8 :] for n, line in enumerate(lines)) == f"F(X1)={text}"


def test_parameters_stay_what_they_are_without_relations() -> None:
    plain = Parameter("E", "youngs_modulus", "material", ("1",), 0.5, 2.0, 0.2)
    assert plain.proportional
    assert not replace(plain, values="additive").proportional
    assert plain.number(7e10, 1.1) == 7e10 * 1.1
