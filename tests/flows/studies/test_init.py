"""A campaign for a deck that has none: three structures of other kinds, and decks of the world."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import modetune
from modetune.adapters.test_files.geometry_csv import write_geometry_csv
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.core.errors import CampaignError, ModelError, ModetuneError
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.modes import mode_set
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.campaign.schema import OpenFile
from modetune.flows.campaign.sketch import is_deck, open_model, sketch_deck
from modetune.flows.studies.init.draft import Draft, init_campaign
from tests.adapters.solved import needs_mystran
from tests.command_line import run_command


def bracket() -> str:
    """An L of nine bricks in metres: steel foot, aluminium web, a plastic pad, and a spring."""
    cells = [(x, 0) for x in range(4)] + [(0, z) for z in range(1, 5)]
    corners = sorted({(x + a, y, z + b) for x, z in cells for a in (0, 1) for b in (0, 1)
                      for y in (0, 1)})  # fmt: skip
    number = {place: n for n, place in enumerate(corners, start=1)}
    lines = ["*NODE"]
    lines += [f"{n}, {0.03 * x}, {0.04 * y}, {0.03 * z}" for (x, y, z), n in number.items()]
    lines += ["*ELEMENT, TYPE=C3D8I"]
    ring = [(0, 0), (1, 0), (1, 1), (0, 1)]
    for n, (x, z) in enumerate(cells, start=1):
        nodes = [number[x + a, b, z + c] for c in (0, 1) for a, b in ring]
        lines.append(f"{n}, {', '.join(map(str, nodes))}")
    lines += ["*ELSET, ELSET=FOOT", "2, 3", "*ELSET, ELSET=WEB", "1, 5, 6, 7, 8"]
    lines += ["*ELSET, ELSET=PAD", "4", "*ELEMENT, TYPE=SPRING1, ELSET=MOUNT"]
    lines += [f"20, {number[4, 0, 0]}"]
    for name, young, density in (
        ("STEEL", 2.1e11, 7850.0),
        ("ALU", 7.1e10, 2710.0),
        ("PA-66", 2.5e9, 1140.0),
    ):
        lines += [f"*MATERIAL, NAME={name}", "*ELASTIC", f"{young}, 0.3", "*DENSITY", f"{density}"]
    for elset, name in (("FOOT", "STEEL"), ("WEB", "ALU"), ("PAD", "PA-66")):
        lines.append(f"*SOLID SECTION, ELSET={elset}, MATERIAL={name}")
    return "\n".join([*lines, "*SPRING, ELSET=MOUNT", "3", "1.e6", ""])


#: A mast in inches with a mass on an arm, a bush below and a spring to the ground at its middle.
STICK = """\
SOL 103
CEND
METHOD = 1
SPC = 7
BEGIN BULK
EIGRL,1,,,6
GRID,1,,0.,0.,0.
GRID,2,,0.,0.,40.
GRID,3,,0.,0.,80.
GRID,9,,0.,0.,0.
SPC1,7,123456,9
CBUSH,11,20,9,1,,,,0
$ foot bolts
PBUSH,20,K,1.+7,1.+7,1.+7,1.+8,1.+8,1.+8
CBAR,1,10,1,2,1.,0.,0.
CBAR,2,10,2,3,1.,0.,0.
$ Femap Property 10 : mast tube
PBAR,10,5,4.2,20.,20.,40.
MAT1,5,1.+7,,.33,2.5-4
$ lamp
CONM2,30,3,,.05,4.,0.,2.
CELAS2,40,5000.,2,1,9,1
ENDDATA
"""

#: A plate of four plies, simply held at two edges; millimetres and tonnes.
LAMINATE = """\
SOL 103
CEND
METHOD = 1
SPC = 1
BEGIN BULK
EIGRL,1,,,8
""" + "".join(
    f"GRID,{1 + i + 5 * j},,{50.0 * i},{50.0 * j},0.\n" for j in range(5) for i in range(5)
) + "".join(
    f"CQUAD4,{1 + i + 4 * j},3,{1 + i + 5 * j},{2 + i + 5 * j},{7 + i + 5 * j},{6 + i + 5 * j}\n"
    for j in range(4) for i in range(4)
) + """\
SPC1,1,123456,1,6,11,16,21
PCOMP,3,,,,,,,SYM,+P
+P,8,.25,0.,YES,8,.25,90.,YES
MAT8,8,135000.,9500.,.3,5000.,4000.,3000.,1.6-9
ENDDATA
"""  # fmt: skip


def written(folder: Path, text: str, name: str = "model.bdf") -> Path:
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def comments(path: Path) -> str:
    """A campaign's text with its comments in one piece."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return " ".join(line.strip("# ") for line in lines)


def names(draft: Draft, free: bool) -> list[str]:
    return [item.parameter.name for item in draft.candidates if item.free == free]


def test_a_bracket_of_three_materials_gets_a_campaign_that_is_accepted(tmp_path: Path) -> None:
    deck = written(tmp_path, bracket(), "bracket.inp")
    draft = init_campaign(deck)
    assert names(draft, free=True) == ["E_STEEL", "E_ALU", "E_PA-66", "k_MOUNT"]
    assert names(draft, free=False) == ["rho_STEEL", "rho_ALU", "rho_PA-66"]
    assert (draft.sketch.name, draft.sketch.units) == ("calculix", "m-kg-s")
    said = run_command(tmp_path, "check", "campaign.yaml")
    assert said.returncode == 0, said.stderr
    assert "no test, 4 parameters" in said.stdout
    # Whoever wants the others takes the # away, and nothing else.
    text = (tmp_path / "campaign.yaml").read_text(encoding="utf-8")
    (tmp_path / "all.yaml").write_text(text.replace("  # - {", "  - {"), encoding="utf-8")
    assert len(load_campaign(tmp_path / "all.yaml", [], OpenFile).parameters) == 7


def test_what_cannot_be_known_is_told_where_it_stands(tmp_path: Path) -> None:
    init_campaign(written(tmp_path, bracket(), "bracket.inp"))
    path = tmp_path / "campaign.yaml"
    before = comments(path).split("units: m-kg-s")[0]
    assert "PLEASE CHECK, a guess: E 2.1e+11 and density 7850 of STEEL" in before
    text = path.read_text(encoding="utf-8")
    assert max(map(len, text.splitlines())) < 160


@needs_mystran
def test_a_stick_of_bars_offers_springs_bushes_and_masses(tmp_path: Path) -> None:
    draft = init_campaign(written(tmp_path, STICK))
    # Numbers that a comment names are called by it; what it does not name keeps its number.
    assert names(draft, free=True) == ["E_5", "k_foot_bolts", "k_40"]
    of_tube = {f"{letter}_mast_tube" for letter in ("A", "I1", "I2", "J")}
    assert set(names(draft, free=False)) >= {"rho_5", "m_lamp", *of_tube}
    assert draft.sketch.units == "in-slinch-s"
    titles = {item.parameter.name: item.target.title for item in draft.candidates}
    assert titles["k_foot_bolts"] == "foot bolts"
    assert titles["E_5"] == ""  # the comment above its material is that of property 10
    found = modetune.modes(str(draft.path), number=3)
    assert found.modes.n_modes == 3
    assert found.n_rigid == 0


@pytest.mark.parametrize("solver", ["calculix", pytest.param("mystran", marks=needs_mystran)])
def test_a_laminate_offers_its_plies(solver: str, tmp_path: Path) -> None:
    draft = init_campaign(written(tmp_path, LAMINATE), (), [f"model.solver={solver}"])
    assert names(draft, free=True) == ["E_8"]
    assert names(draft, free=False) == ["rho_8", "t_3"]
    assert draft.sketch.units == "mm-t-s"
    assert not draft.sketch.by_solver  # it was named
    load_campaign(draft.path, [], OpenFile)


def test_a_test_in_millimetres_with_its_own_axes_is_laid_over_the_model(tmp_path: Path) -> None:
    """Measured is what the model itself computes, told in millimetres along turned axes."""
    deck = written(tmp_path, bracket(), "bracket.inp")
    campaign = open_model(deck)
    found = modetune.modes(str(deck), number=10).elastic
    mesh = campaign.case.solver.deck.mesh()
    rows = [row for row, node in enumerate(found.nodes.tolist()) if node in set(range(1, 36, 3))]
    seen = found.rows(np.array(rows))
    points = np.unique(seen.nodes)
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    places = 1000.0 * mesh.coordinates[mesh.rows(points)]
    frames = np.tile(turn, (points.size, 1, 1))  # what it calls x is the model's y
    shapes = seen.mode_shapes[:, :3].reshape(points.size, 3, 3).transpose(0, 2, 1) @ turn.T
    shapes = shapes.transpose(0, 2, 1).reshape(-1, 3)
    test = mode_set(seen.frequencies_hz[:3], shapes, seen.nodes, seen.components)
    write_modes_csv(tmp_path / "modes.csv", (1, 2, 3), test, [])
    none = np.zeros((0, 2), dtype=np.int64)
    write_geometry_csv(
        tmp_path / "points.csv",
        TestGeometry(points, places, frames, none, np.zeros((0, 3), dtype=np.int64), 1e-3),
    )
    draft = init_campaign(deck, [tmp_path / "modes.csv", tmp_path / "points.csv"])
    assert draft.test is not None
    assert draft.test.sensors == {}  # it fits as it lies
    assert "from their nodes" in comments(draft.path)
    report = modetune.check(str(draft.path))
    assert report.exit_code == 0
    # Only the digits of the files are between both; the spring's mount leaves no mode alike.
    assert min(mode.mac for mode in report.modes) > 0.9999
    beside = modetune.correlate(str(deck), f"{tmp_path / 'modes.csv'},{tmp_path / 'points.csv'}")
    assert [pair.first for pair in beside.pairs] == [0, 1, 2]


def test_files_that_are_there_stay(tmp_path: Path) -> None:
    deck = written(tmp_path, bracket(), "bracket.inp")
    (tmp_path / "campaign.yaml").write_text("mine", encoding="utf-8")
    said = run_command(tmp_path, "init", "bracket.inp")
    assert said.returncode == 2
    assert "campaign.yaml exists already" in said.stderr
    assert (tmp_path / "campaign.yaml").read_text(encoding="utf-8") == "mine"
    said = run_command(tmp_path, "init", "bracket.inp", "--force", "--json")
    told = json.loads(said.stdout)
    assert told["units"] == "m-kg-s"
    assert told["parameters"] == ["E_STEEL", "E_ALU", "E_PA-66", "k_MOUNT"]
    assert deck.read_text(encoding="utf-8") == bracket()


def test_the_command_says_what_to_run_next_and_that_runs(tmp_path: Path) -> None:
    written(tmp_path, bracket(), "bracket.inp")
    said = run_command(tmp_path, "init", "bracket.inp", "--out", "mine.yaml")
    commands = [line.split("  ")[1] for line in said.stdout.splitlines() if line.startswith("  ")]
    assert commands == [f"modetune {verb} mine.yaml" for verb in ("check", "modes", "pretest")]
    again = run_command(tmp_path, *commands[1].split()[1:])
    assert again.returncode == 0, again.stderr
    assert " Hz" in again.stdout


def test_a_spring_mass_system_runs_on_matrices_with_its_springs_free(tmp_path: Path) -> None:
    (tmp_path / "frame.yaml").write_text(
        "masses: {m1: 1.0, m2: 2.0}\nsprings:\n"
        "  k1: {between: [ground, m1], stiffness: 900.0}\n"
        "  k2: {between: [m1, m2], stiffness: 500.0}\n"
        "dampers: {c1: {between: [m1, m2], viscous: 0.1}}\n"
    )
    (tmp_path / "lab.csv").write_text("mode,frequency_hz\n1,1.8\n2,6.1\n")
    files, out = [tmp_path / "lab.csv"], tmp_path / "c.yaml"
    draft = init_campaign(tmp_path / "frame.yaml", files, ["model.units=m-kg-s"], out)
    assert draft.sketch.name == "matrices"
    campaign = load_campaign(tmp_path / "c.yaml")
    # Masses can be weighed, and modes do not depend on dampers.
    assert campaign.parameters.names == ("k_k1", "k_k2")
    assert "# - {name: m_m1, quantity: mass, elset: m1" in (tmp_path / "c.yaml").read_text()
    assert campaign.case.solver.deck.numbers(campaign.parameters.parameters[1])[0].value == 500.0


def test_a_deck_with_nothing_to_update_is_refused_in_words(tmp_path: Path) -> None:
    deck = written(tmp_path, "*NODE\n1, 0., 0., 0.\n2, 1., 0., 0.\n", "empty.inp")
    with pytest.raises(ModetuneError) as caught:
        init_campaign(deck)
    assert "empty.inp" in str(caught.value)
    assert not (tmp_path / "campaign.yaml").exists()
    with pytest.raises(CampaignError, match=r"lost\.inp"):
        open_model(tmp_path / "lost.inp")


def test_solver_and_units_that_are_unknown_are_told_beside_what_there_is(tmp_path: Path) -> None:
    deck = written(tmp_path, bracket(), "bracket.inp")
    with pytest.raises(CampaignError, match=r"the command line: units: unknown value `mm-t`"):
        open_model(deck, ["model.units=mm-t"])
    with pytest.raises(ModelError, match="did you mean mystran"):
        open_model(deck, ["model.solver=mystrann"])


@needs_mystran
def test_a_nastran_deck_runs_on_the_first_program_that_takes_it(tmp_path: Path) -> None:
    sketch = sketch_deck(written(tmp_path, STICK, "stick.txt"))
    assert is_deck(tmp_path / "stick.txt")
    assert sketch.name == "mystran"
    said = run_command(tmp_path, "modes", "stick.txt", "--solver", "calculix", "--number", "2")
    assert said.returncode == 0, said.stderr
    assert "solver:" not in said.stderr  # what was named needs no telling
    assert "units: assumed in-slinch-s, because E 1e+07" in said.stderr


def test_only_what_looks_like_a_deck_is_one(tmp_path: Path) -> None:
    for name, text, deck in (
        ("a.dat", "$ comment\nBEGIN BULK\nGRID,1,,0.,0.,0.\n", True),
        ("b.txt", "** comment\n*NODE\n1,0,0,0\n", True),
        ("c.csv", "mode,frequency_hz\n1,10.0\n", False),
        ("d.unv", "    -1\n   151\n", False),
        ("e.yaml", "name: x\n", False),
    ):
        assert is_deck(written(tmp_path, text, name)) is deck, name


#: Decks of the public corpus that are small, and of many kinds and dialects.
CORPUS = ("sol_101_elements", "unit", "mystran", "bugs", "nx/laminate", "msc", "ogs", "freq_sine")


@pytest.mark.parametrize("folder", CORPUS)
def test_public_decks_get_a_campaign_or_the_reason_why_not(
    folder: str, shared_data: Path, tmp_path: Path
) -> None:
    decks = [
        path
        for path in sorted((shared_data / "nastran" / "corpus" / folder).rglob("*"))
        if path.suffix in (".bdf", ".dat")
    ]
    assert decks
    for number, deck in enumerate(decks):
        try:
            draft = init_campaign(deck, (), (), tmp_path / f"{number}.yaml")
        except (CampaignError, ModelError) as error:
            assert deck.stem in str(error)  # noqa: PT017 (either end is right)
            continue
        assert draft.names
