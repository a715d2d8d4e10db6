"""Where parameters stand in a CalculiX deck, and what is said where they do not."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from modetune.adapters.calculix.deck import read_deck, read_number
from modetune.adapters.calculix.model import CalculixModel, point_mass
from modetune.adapters.calculix.places import edited_lines, energy_sets, find_fields
from modetune.adapters.calculix.structure import CalculixStructure, understand
from modetune.core.errors import ModelError
from modetune.core.parameters import QUANTITIES, Parameter, Quantity
from tests.adapters.ccx_decks import bar
from tests.adapters.solved import needs_ccx

# A block of two hexahedra, a shell beside it, a spring to ground and a mass.
DECK = """\
*NODE, NSET=NALL
1, 0, 0, 0
2, 1, 0, 0
3, 2, 0, 0
4, 0, 1, 0
5, 1, 1, 0
6, 2, 1, 0
7, 0, 0, 1
8, 1, 0, 1
9, 2, 0, 1
10, 0, 1, 1
11, 1, 1, 1
12, 2, 1, 1
13, 3, 0, 1
14, 3, 1, 1
99, 9, 9, 9
*ELEMENT, TYPE=C3D8I, ELSET=BLOCK
1, 1, 2, 5, 4, 7, 8, 11, 10
2, 2, 3, 6, 5, 8, 9, 12, 11
*ELEMENT, TYPE=S4, ELSET=PLATE
3, 9, 13, 14, 12
*ELEMENT, TYPE=SPRING1, ELSET=GROUND
4, 1
*ELEMENT, TYPE=SPRINGA, ELSET=STRUT
5, 3, 13
*ELEMENT, TYPE=MASS, ELSET=BALLAST
6, 14
7, 13
*MATERIAL, NAME=AL
*ELASTIC
71000., 0.3
*DENSITY
2.8e-9
*MATERIAL, NAME=Skin Al
*ELASTIC
70000., 0.31, 20.
60000., 0.32, 100.
*DENSITY
2.7D-9
*MATERIAL, NAME=SPARE
*ELASTIC
1., 0.
*SOLID SECTION, ELSET=BLOCK, MATERIAL=AL
*SHELL SECTION, ELSET=PLATE, MATERIAL=SkinAl
 1.5 , 0
*SPRING, ELSET=GROUND
2

5.E3
*SPRING, ELSET=STRUT

250.
*MASS, ELSET=BALLAST
1.d-3,
"""


def model_of(folder: Path, text: str = DECK) -> CalculixStructure:
    path = folder / "main.inp"
    path.write_text(text)
    return understand(read_deck(path))


def parameter(quantity: Quantity, *targets: str, name: str = "p") -> Parameter:
    return Parameter(name, quantity, QUANTITIES[quantity].targets[0], targets, 0.5, 2.0, 0.1)


def line_of(text: str, deck: str = DECK) -> int:
    """Number of the one line that is this text."""
    lines = deck.splitlines()
    assert lines.count(text) == 1
    return lines.index(text) + 1


@pytest.mark.parametrize(
    ("quantity", "target", "values", "edited"),
    [  # values as they stand in DECK, edited lines with the value doubled
        ("youngs_modulus", "AL", [71000.0], {"71000., 0.3": "142000.0, 0.3"}),
        (
            "youngs_modulus",
            "Skin Al",
            [70000.0, 60000.0],
            {
                "70000., 0.31, 20.": "140000.0, 0.31, 20.",
                "60000., 0.32, 100.": "120000.0, 0.32, 100.",
            },
        ),
        ("poissons_ratio", "al", [0.3], {"71000., 0.3": "71000., 0.6"}),
        ("density", "AL", [2.8e-9], {"2.8e-9": "5.6e-09"}),
        ("density", "SKINAL", [2.7e-9], {"2.7D-9": "5.4e-09"}),
        ("thickness", "plate", [1.5], {" 1.5 , 0": " 3.0 , 0"}),
        ("spring_stiffness", "GROUND", [5000.0], {"5.E3": "10000.0"}),
        ("spring_stiffness", "STRUT", [250.0], {"250.": "500.0"}),
        ("mass", "BALLAST", [1e-3], {"1.d-3,": "0.002,"}),
    ],
)
def test_every_quantity_is_found_and_edited(
    tmp_path: Path, quantity: Quantity, target: str, values: list[float], edited: dict[str, str]
) -> None:
    model = model_of(tmp_path)
    wanted = parameter(quantity, target)
    assert [field.value for field in find_fields(model, wanted)] == values
    changed = {
        model.deck.lines[p].text: new for p, new in edited_lines(model, [(wanted, 2.0)]).items()
    }
    assert changed == edited


def test_a_value_of_one_changes_nothing(tmp_path: Path) -> None:
    assert edited_lines(model_of(tmp_path), [(parameter("youngs_modulus", "AL"), 1.0)]) == {}


def test_two_parameters_on_one_line_are_both_edited(tmp_path: Path) -> None:
    model = model_of(tmp_path)
    changed = edited_lines(
        model, [(parameter("youngs_modulus", "AL"), 1.1), (parameter("poissons_ratio", "AL"), 0.5)]
    )
    # 71000 * 1.1 in floating point, shortest text that reads back
    assert list(changed.values()) == ["78100.0, 0.15"]


def test_two_parameters_on_one_number_are_refused(tmp_path: Path) -> None:
    deck = CalculixModel(model_of(tmp_path), ())
    both = parameter("youngs_modulus", "AL", "SKIN AL", name="E_all")
    one = parameter("youngs_modulus", "AL", name="E_al")
    assert deck.problems((both, one)) == [
        f"{tmp_path / 'main.inp'}, line {line_of('71000., 0.3')}: both E_all and E_al change this "
        "number"
    ]
    assert deck.problems((parameter("youngs_modulus", "AL", "AL"),)) == []


@pytest.mark.parametrize(
    ("quantity", "target", "message"),
    [
        ("youngs_modulus", "SKINAI", "the deck has no material SKINAI; did you mean SKINAL?"),
        ("density", "XYZ", "the deck has no material XYZ (there are AL, SKINAL, SPARE)"),
        ("thickness", "PLATES", "the deck has no *SHELL SECTION for PLATES; did you mean PLATE?"),
        ("spring_stiffness", "GRUND", "no *SPRING for GRUND; did you mean GROUND?"),
        ("mass", "BLOCK", "the deck has no *MASS for BLOCK (there are BALLAST)"),
        ("youngs_modulus", "SPARE", "no element uses material SPARE"),
    ],
)
def test_what_the_deck_lacks_is_said_with_what_it_has(
    tmp_path: Path, quantity: Quantity, target: str, message: str
) -> None:
    with pytest.raises(ModelError, match=re.escape(message)):
        find_fields(model_of(tmp_path), parameter(quantity, target))


@pytest.mark.parametrize(
    ("old", "new", "quantity", "target", "line", "message"),
    [
        ("*ELASTIC\n71000., 0.3", "*ELASTIC, TYPE=ORTHO\n1., 2., 3., .1, .1, .1, 4., 5.\n6.",
         "poissons_ratio", "AL", "*ELASTIC, TYPE=ORTHO",
         "an *ELASTIC card of TYPE=ORTHO has no poissons_ratio"),
        ("*ELASTIC\n71000., 0.3", "*ELASTIC, TYPE=LAMINA\n1., 2.", "youngs_modulus", "AL",
         "*ELASTIC, TYPE=LAMINA", "an *ELASTIC card of TYPE=LAMINA has no youngs_modulus"),
        ("71000., 0.3", "71o00., 0.3", "youngs_modulus", "AL", "71o00., 0.3",
         "'71o00.' is not a number"),
        ("71000., 0.3", "71000.", "poissons_ratio", "AL", "71000.", "'' is not a number"),
        ("71000., 0.3", "NaN, 0.3", "youngs_modulus", "AL", "NaN, 0.3", "'NaN' is not a number"),
        ("PLATE, MATERIAL=SkinAl\n 1.5 , 0", "PLATE, MATERIAL=SkinAl, NODAL THICKNESS\n1.",
         "thickness", "PLATE", "*SHELL SECTION, ELSET=PLATE, MATERIAL=SkinAl, NODAL THICKNESS",
         "the section of PLATE is NODALTHICKNESS"),
        ("*SPRING, ELSET=STRUT\n", "*SPRING, ELSET=STRUT, NONLINEAR\n", "spring_stiffness",
         "STRUT", "*SPRING, ELSET=STRUT, NONLINEAR", "a nonlinear spring has no one stiffness"),
        ("*SPRING, ELSET=STRUT\n\n", "*SPRING, ELSET=STRUT\n", "spring_stiffness", "STRUT",
         "*SPRING, ELSET=STRUT", "ccx requires a blank line before the constant of a SPRINGA"),
        ("2\n\n5.E3\n", "2\n", "spring_stiffness", "GROUND", "*SPRING, ELSET=GROUND",
         "the card has no value"),
        ("1.d-3,\n", "", "mass", "BALLAST", "*MASS, ELSET=BALLAST", "the card has no value"),
    ],
)  # fmt: skip
def test_what_cannot_be_updated_names_file_and_line(
    tmp_path: Path, old: str, new: str, quantity: Quantity, target: str, line: str, message: str
) -> None:
    assert DECK.count(old) == 1
    text = DECK.replace(old, new)
    where = f"{tmp_path / 'main.inp'}, line {line_of(line, text)}: {message}"
    with pytest.raises(ModelError, match=re.escape(where)):
        find_fields(model_of(tmp_path, text), parameter(quantity, target))


def test_a_material_without_the_card_or_its_data_is_said(tmp_path: Path) -> None:
    text = DECK.replace("*ELASTIC\n71000., 0.3\n", "*ELASTIC\n")
    with pytest.raises(ModelError, match="material AL has no \\*ELASTIC card with data"):
        find_fields(model_of(tmp_path, text), parameter("youngs_modulus", "AL"))


def test_a_section_whose_set_has_no_elements_is_refused(tmp_path: Path) -> None:
    text = DECK + "*SHELL SECTION, ELSET=EMPTY, MATERIAL=AL\n1.\n"
    with pytest.raises(ModelError, match="element set EMPTY has no elements"):
        find_fields(model_of(tmp_path, text), parameter("thickness", "EMPTY"))


def test_all_sections_of_one_set_are_edited(tmp_path: Path) -> None:
    # ccx takes the last of them.
    text = DECK + "*SHELL SECTION, ELSET=PLATE, MATERIAL=AL\n2.\n"
    fields = find_fields(model_of(tmp_path, text), parameter("thickness", "PLATE"))
    assert [field.value for field in fields] == [1.5, 2.0]


def test_all_temperatures_of_a_spring_are_edited(tmp_path: Path) -> None:
    text = DECK.replace("5.E3\n", "5.E3,,0.\n4.E3,,100.\n").replace("250.\n", "250.\n240.,,9.\n")
    model = model_of(tmp_path, text)
    ground = find_fields(model, parameter("spring_stiffness", "GROUND"))
    strut = find_fields(model, parameter("spring_stiffness", "STRUT"))
    assert [field.value for field in ground] == [5000.0, 4000.0]
    assert [field.value for field in strut] == [250.0, 240.0]


def test_element_sets_are_generated_and_nested(tmp_path: Path) -> None:
    sets = (
        "*ELSET, ELSET=ODD, GENERATE\n1, 7, 2\n*Elset, Elset=Some\n2, odd,\n4\n"
        "*ELSET, ELSET=ODD, GENERATE\n6, 6\n*ELSET, ELSET=MORE\nSOME, 6\n"
    )
    members = model_of(tmp_path, DECK + sets).mesh.element_sets
    assert members["ODD"] == {1, 3, 5, 7, 6}
    assert members["SOME"] == {1, 3, 5, 7, 2, 4}  # nested sets count as they stand at that line
    assert members["MORE"] == {1, 3, 5, 7, 2, 4, 6}


@pytest.mark.parametrize("row", ["1", "1, 7, 0", "1, 2, 3, 4"])
def test_a_bad_generated_set_names_file_and_line(tmp_path: Path, row: str) -> None:
    text = DECK + f"*ELSET, ELSET=ODD, GENERATE\n{row}\n"
    where = f"{tmp_path / 'main.inp'}, line {len(text.splitlines())}: GENERATE requires"
    with pytest.raises(ModelError, match=re.escape(where)):
        model_of(tmp_path, text)


def test_a_set_name_with_blanks_in_quotes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="element set names with blanks are not supported"):
        model_of(tmp_path, DECK + '*ELSET, ELSET="MY SET"\n1\n')


@pytest.mark.parametrize(
    "rows",
    [
        "1, 1, 2, 5, 4,\n7, 8, 11, 10\n2, 2, 3, 6, 5,\n8, 9, 12, 11\n",
        "1, 1, 2, 5, 4\n7, 8, 11, 10\n2, 2, 3, 6, 5, 8, 9, 12, 11\n",  # ccx counts nodes
        "1, 1, 2, 5, 4, 7, 8, 11, 10,\n** between\n2, 2, 3, 6, 5, 8, 9, 12, 11,\n",
    ],
)
def test_elements_are_read_until_they_have_their_nodes(tmp_path: Path, rows: str) -> None:
    old = "1, 1, 2, 5, 4, 7, 8, 11, 10\n2, 2, 3, 6, 5, 8, 9, 12, 11\n"
    model = model_of(tmp_path, DECK.replace(old, rows))
    assert model.mesh.element_sets["BLOCK"] == {1, 2}
    assert model.summary.n_elements == 7


def test_elements_of_unknown_types_go_on_after_trailing_commas(tmp_path: Path) -> None:
    user = "*ELEMENT, TYPE=U7, ELSET=USER\n50, 1, 2,\n3\n51, 2, 3\n"
    assert model_of(tmp_path, DECK + user).mesh.element_sets["USER"] == {50, 51}


@pytest.mark.parametrize(
    ("kind", "n_nodes"),
    [  # the element types' numbers of nodes, from the CalculiX manual's chapter on elements
        ("C3D4", 4), ("C3D10T", 10), ("C3D20R", 20), ("S8R", 8), ("M3D3", 3), ("CAX6", 6),
        ("B31R", 2), ("B32", 3), ("T3D2", 2), ("T3D3", 3), ("SPRING2", 2), ("DASHPOTA", 2),
    ],
)  # fmt: skip
def test_an_element_short_of_nodes_names_its_line(tmp_path: Path, kind: str, n_nodes: int) -> None:
    nodes = ", ".join(str(1 + i % 14) for i in range(n_nodes))
    head = f"{DECK}*ELEMENT, TYPE={kind}\n50, {nodes}\n"
    assert model_of(tmp_path, head).summary.n_elements == 8
    where = f"{tmp_path / 'main.inp'}, line {len(head.splitlines()) + 1}"
    message = f"{where}: element 51 has 0 nodes, a {kind} has {n_nodes}"
    with pytest.raises(ModelError, match=re.escape(message)):
        model_of(tmp_path, head + "51\n")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("3, 9, 13, 14, 12", "3, 9, 13, 77, 12", "element 3 has node 77, which is not there"),
        ("4, 1", "4, x", "whole numbers expected, found '4, x'"),
        ("99, 9, 9, 9", "9o, 9, 9, 9", "whole numbers expected, found '9o, 9, 9, 9'"),
    ],
)
def test_a_bad_mesh_names_file_and_line(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = DECK.replace(f"\n{old}\n", f"\n{new}\n")
    where = f"{tmp_path / 'main.inp'}, line {line_of(new, text)}: {message}"
    with pytest.raises(ModelError, match=re.escape(where)):
        model_of(tmp_path, text)


def test_a_node_may_be_there_twice_only_at_one_place(tmp_path: Path) -> None:
    twice = model_of(tmp_path, DECK + "*NODE\n14, 3., 1.0, 1\n")
    assert twice.summary.node_ids == set(range(1, 15))
    deck = tmp_path / "main.inp"
    message = (
        f"{deck}, line 15 and {deck}, line {len(DECK.splitlines()) + 2}: node 14 is there twice"
    )
    with pytest.raises(ModelError, match=re.escape(message)):
        model_of(tmp_path, DECK + "*NODE\n14, 3, 1, 2\n")


def test_a_deck_without_a_mesh_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="has 1 nodes and 0 elements"):
        model_of(tmp_path, "*NODE\n1, 0, 0, 0\n")


def test_nodes_of_no_element_carry_no_results(tmp_path: Path) -> None:
    # ccx prints zeros for them, which would pass for a measured zero.
    assert model_of(tmp_path).summary.node_ids == set(range(1, 15))
    tied = model_of(tmp_path, DECK + "*RIGID BODY, NSET=NALL, REF NODE=99\n").summary
    assert 99 in tied.node_ids


def test_shapes_follow_from_matrices_for_free_solids_only(tmp_path: Path) -> None:
    nodes = DECK[: DECK.index("*ELEMENT, TYPE=S4")]
    assert model_of(tmp_path, nodes).summary.solid_shapes
    assert not model_of(tmp_path, DECK).summary.solid_shapes
    assert not model_of(tmp_path, nodes + "*EQUATION\n1\n").summary.solid_shapes
    assert not model_of(tmp_path, nodes + "*TRANSFORM, NSET=NALL\n").summary.solid_shapes


def test_elastic_constants_are_those_of_materials_that_elements_use(tmp_path: Path) -> None:
    found = CalculixModel(model_of(tmp_path), ()).elastic_constants()
    assert found == {  # SPARE is used by no element and has no density
        "AL": (71000.0, 2.8e-9),
        "SKINAL": (70000.0, 2.7e-9),
    }


def test_point_mass_counts_each_element_and_follows_edits(tmp_path: Path) -> None:
    model = model_of(tmp_path)
    assert point_mass(model, {}) == 2 * 1e-3
    assert (
        point_mass(model, edited_lines(model, [(parameter("mass", "BALLAST"), 1.5)])) == 2 * 1.5e-3
    )


def test_energy_sets_are_those_a_stiffness_parameter_scales(tmp_path: Path) -> None:
    model = model_of(tmp_path)
    assert energy_sets(model, parameter("youngs_modulus", "Skin Al", "al")) == ("BLOCK", "PLATE")
    assert energy_sets(model, parameter("spring_stiffness", "ground")) == ("GROUND",)
    assert energy_sets(model, parameter("density", "AL")) == ()
    assert energy_sets(model, parameter("thickness", "PLATE")) == ()


def test_a_laminate_or_an_overlap_has_no_energy_of_its_own(tmp_path: Path) -> None:
    section = "PLATE, MATERIAL=SkinAl\n 1.5 , 0"
    laminate = DECK.replace(section, "PLATE, COMPOSITE\n.5,,AL\n.5,,SkinAl")
    model = model_of(tmp_path, laminate)
    assert energy_sets(model, parameter("youngs_modulus", "AL")) == ()
    assert (
        len(find_fields(model, parameter("youngs_modulus", "Skin Al"))) == 2
    )  # in use all the same
    overlap = "*ELSET, ELSET=HALF\n2\n*SOLID SECTION, ELSET=HALF, MATERIAL=SKINAL\n"
    model = model_of(tmp_path, DECK + overlap)
    assert energy_sets(model, parameter("youngs_modulus", "AL")) == ()
    assert energy_sets(model, parameter("spring_stiffness", "GROUND")) == ("GROUND",)


def test_elements_without_whole_energies_have_no_energy_sets(tmp_path: Path) -> None:
    # SPRINGA: test_solver_contract.py shows it; S4R, C3D8R: the hourglass part is left out.
    assert energy_sets(model_of(tmp_path), parameter("spring_stiffness", "STRUT")) == ()
    for full, reduced in (("C3D8I", "C3D8R"), ("S4", "S4R")):
        model = model_of(tmp_path, DECK.replace(f"TYPE={full}", f"TYPE={reduced}"))
        assert energy_sets(model, parameter("youngs_modulus", "AL", "SKINAL")) == ()


@pytest.mark.parametrize("text", ["7.1E4", "7.1e+04", "7.1d4", "7.1D+4", "7.1+4", " 71000 "])
def test_numbers_are_read_as_fortran_reads_them(text: str) -> None:
    assert read_number(text) == 71000.0


@pytest.mark.parametrize("text", ["", "x", "nan", "INF", "7.1e", "1 2"])
def test_what_is_no_finite_number_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"not finite|could not convert"):
        read_number(text)


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ("11, 1, 1, 1\n", "11, 1, 1, 6.123233995736766e-15\n", 12),
        ("11, 1, 1, 1\n", "11, 1, -1.2345678901234567e-05, 1\n", 12),
    ],
)
def test_a_coordinate_that_ccx_would_cut_is_refused(
    old: str, new: str, line: int, tmp_path: Path
) -> None:
    assert old in DECK
    with pytest.raises(ModelError, match=rf"line {line}: of .* ccx reads 20 characters alone"):
        model_of(tmp_path, DECK.replace(old, new))


def test_digits_that_nobody_misses_may_be_cut(tmp_path: Path) -> None:
    model_of(tmp_path, DECK.replace("11, 1, 1, 1\n", f"11, 1, 1.{'0' * 25}1,{' ' * 30}1\n"))


def test_a_modulus_that_ccx_would_cut_is_refused(tmp_path: Path) -> None:
    model = model_of(tmp_path, DECK.replace("71000., 0.3", "7.100000000000000e+04, 0.3"))
    with pytest.raises(ModelError, match="write it with fewer digits"):
        find_fields(model, parameter("youngs_modulus", "AL"))


@needs_ccx
def test_ccx_reads_twenty_characters_of_a_number(tmp_path: Path) -> None:
    """7.000000000000000e+04 is 7.0 to it: frequencies are a hundredth of those of 70000."""
    lowest = []
    for name, modulus in (("whole", "70000."), ("cut", "7.000000000000000e+04")):
        text = bar("C3D8I", bricks=2).replace("70000., 0.3", f"{modulus}, 0.3")
        assert f"{modulus}, 0.3" in text
        (tmp_path / f"{name}.inp").write_text(f"{text}*STEP\n*FREQUENCY\n2\n*END STEP\n")
        subprocess.run(["ccx", name], cwd=tmp_path, check=True, capture_output=True)
        table = (tmp_path / f"{name}.dat").read_text().split("E I G E N V A L U E")[1]
        rows = [line.split() for line in table.splitlines()]
        lowest.append(next(float(row[3]) for row in rows if len(row) == 5 and row[0] == "1"))
    assert lowest[1] == pytest.approx(lowest[0] / 100.0, rel=1e-5)  # seven digits printed
