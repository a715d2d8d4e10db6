"""A deck is translated once: at other values its numbers are edited, to the text of a fresh one."""

from __future__ import annotations

from pathlib import Path

import pytest

from modetune.adapters.calculix.structure import CalculixStructure, understand
from modetune.adapters.nastran import bulk as nastran_bulk
from modetune.adapters.nastran.bulk import read_bulk
from modetune.adapters.solver import ModalAnalysis, Solver
from modetune.adapters.translation import solver as translation
from modetune.adapters.translation.solver import TranslatedDeck, translated_solver
from modetune.core.parameters import Parameter, Quantity, TargetKind

#: A gutter of two plates with a rib of bars, a laminated lid, a lump, springs to ground: the cards
#: of all quantities that the translation has.
DECK = """SOL 103
CEND
METHOD = 1
SPC = 1
BEGIN BULK
EIGRL,1,,,6
{grids}
{shells}
CBAR,91,10,1,2,0.,0.,1.
CBAR,92,10,2,3,0.,0.,1.
CROD,93,11,4,6
CONROD,94,5,3,1,2.E-5
CONM2,95,6,,0.4,0.01,0.,0.02
CELAS2,96,2.E5,6,3
CELAS1,97,12,4,3
CBUSH,98,13,5,,,,,0
PBAR,10,1,1.E-4,2.E-8,1.E-8,1.5E-8,.3
PROD,11,2,3.E-5
PELAS,12,1.E5
PBUSH,13,K,3.E6,2.E6,1.E6,40.,50.,60.
PSHELL,1,1,.003,1,,1,,.2
PSHELL,2,1,.002,1,,1
PCOMP,3,,,,,,,SYM
,4,.0005,45.,,4,.0004,0.
MAT1,1,7.E10,,.3,2700.
MAT1,2,2.1E11,,.3,7850.
MAT8,4,1.3E11,9.E9,.3,5.E9,4.E9,3.E9,1600.
SPC1,1,123456,1,4
SPC1,1,123,7
ENDDATA
"""


def write_deck(folder: Path) -> Path:
    grids = [f"GRID,{3 * j + i + 1},,{0.2 * i},{0.15 * j},{0.05 * j * j}" for j in range(4)
             for i in range(3)]  # fmt: skip
    cells = [(i, j) for j in range(3) for i in range(2)]
    shells = [
        f"CQUAD4,{n},{1 + j},{3 * j + i + 1},{3 * j + i + 2},{3 * j + i + 5},{3 * j + i + 4}"
        for n, (i, j) in enumerate(cells, 1)
    ]
    path = folder / "gutter.bdf"
    path.write_text(DECK.format(grids="\n".join(grids), shells="\n".join(shells)))
    return path


def parameter(quantity: Quantity, by: TargetKind, *targets: str, item: int = 0) -> Parameter:
    name = f"{quantity}_{'_'.join(targets)}_{item}"
    return Parameter(name, quantity, by, targets, 0.1, 10.0, 0.2, 1.0, item)


PARAMETERS = (
    parameter("youngs_modulus", "material", "1"),
    parameter("youngs_modulus", "material", "2"),
    parameter("youngs_modulus", "material", "4"),
    parameter("youngs_modulus", "material", "4", item=2),
    parameter("shear_modulus", "material", "4"),
    parameter("poissons_ratio", "material", "1"),
    parameter("density", "material", "1", "4"),
    parameter("thickness", "property", "1"),
    parameter("thickness", "property", "2"),
    parameter("thickness", "property", "3", item=1),
    parameter("ply_angle", "property", "3", item=1),
    parameter("nonstructural_mass", "property", "1"),
    parameter("area", "property", "10"),
    parameter("inertia_1", "property", "10"),
    parameter("inertia_2", "property", "10"),
    parameter("torsion_constant", "property", "10"),
    parameter("area", "property", "11"),
    parameter("area", "element", "94"),
    parameter("spring_stiffness", "element", "96"),
    parameter("spring_stiffness", "property", "12"),
    parameter("spring_stiffness", "property", "13"),
    parameter("mass", "element", "95"),
    parameter("offset", "element", "95"),
)
ANALYSIS = ModalAnalysis(3, (2, 9))


def job(solver: Solver, folder: Path, **values: float) -> str:
    folder.mkdir(exist_ok=True)
    solver.render(values, ANALYSIS).write(folder)
    return (folder / "job.inp").read_text()


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Solver:
    folder = tmp_path_factory.mktemp("gutter")
    deck = write_deck(folder)
    known = translated_solver(deck, ()).deck
    # What this deck has not of all kinds is for the other tests of the translation.
    alive = tuple(item for item in PARAMETERS if not known.problems((item,)))
    assert len(alive) > 15
    return translated_solver(deck, alive)


def fresh(solver: Solver, folder: Path, values: dict[str, float]) -> str:
    """The job of the updated deck, read and translated from its file."""
    deck = solver.deck
    assert isinstance(deck, TranslatedDeck)
    updated = deck.write_updated(values, folder / "deck")
    return job(translated_solver(updated, deck.parameters), folder)


def test_every_parameter_gives_the_text_of_a_fresh_translation(
    shown: Solver, tmp_path: Path
) -> None:
    nominal = job(shown, tmp_path / "nominal")
    differ = set()
    for place, item in enumerate(shown.deck.parameters):  # type: ignore[attr-defined]
        values = {item.name: 1.17}
        text = job(shown, tmp_path / "job", **values)
        assert text == fresh(shown, tmp_path / f"fresh{place}", values), item.name
        differ |= {item.name} if text != nominal else set()
        assert job(shown, tmp_path / "again") == nominal, f"{item.name} left something behind"
    assert len(differ) > 15


def test_all_parameters_at_once_give_it_too(shown: Solver, tmp_path: Path) -> None:
    names = [item.name for item in shown.deck.parameters]  # type: ignore[attr-defined]
    values = {name: 0.8 + 0.02 * place for place, name in enumerate(names)}
    assert job(shown, tmp_path / "job", **values) == fresh(shown, tmp_path / "fresh", values)


def test_a_deck_is_read_and_understood_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read, understood = [], []

    def counted_read(deck: object) -> object:
        read.append(deck)
        return read_bulk(deck)  # type: ignore[arg-type]

    def counted_understand(deck: object) -> CalculixStructure:
        understood.append(deck)
        return understand(deck)  # type: ignore[arg-type]

    monkeypatch.setattr(nastran_bulk, "read_bulk", counted_read)
    monkeypatch.setattr(translation, "read_bulk", counted_read)
    monkeypatch.setattr(translation, "understand", counted_understand)
    wanted = [item for item in PARAMETERS if item.quantity in ("thickness", "mass")]
    solver = translated_solver(write_deck(tmp_path), tuple(wanted))
    for step in range(4):
        for item in wanted:
            job(solver, tmp_path / "job", **{item.name: 1.1 + 0.1 * step})
    # A model of its own to be edited, and the nominal translation. (What moves nodes or what is
    # tied, as sections of bars do, is understood anew.)
    assert len(read) == 1
    assert len(understood) == 1


def test_what_parameters_affect_is_found_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    moduli = [item for item in PARAMETERS if item.quantity == "youngs_modulus"]
    solver = translated_solver(write_deck(tmp_path), tuple(PARAMETERS))
    first = [solver.deck.affected_elements(item) for item in moduli]

    def refused(*arguments: object) -> None:
        raise AssertionError("the deck is translated again")

    monkeypatch.setattr(TranslatedDeck, "_translate", refused)
    assert [solver.deck.affected_elements(item) for item in moduli] == first


def test_a_deck_of_copied_cards_is_read_again(tmp_path: Path) -> None:
    path = write_deck(tmp_path)
    text = path.read_text().replace("CELAS2,96,2.E5,6,3\n", "CELAS2,96,2.E5,6,3\n=,*(10),==\n")
    path.write_text(text)
    item = parameter("spring_stiffness", "element", "96")
    solver = translated_solver(path, (item,))
    values = {item.name: 1.3}
    assert job(solver, tmp_path / "job", **values) == fresh(solver, tmp_path / "fresh", values)
