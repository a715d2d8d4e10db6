"""CONTRIBUTING says what to add where: each kind is added to a copy of the sources, and it runs.

The additions are in `docs/examples/additions`, below the folders that they belong to. A line in a
table makes each known.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from tests.test_removal import succeeds
from tests.test_structure import ROOT, copy_of_sources

ADDITIONS = ROOT / "docs" / "examples" / "additions"
#: The table that each addition needs a line in: its file, the line before, and the new line.
LINES = (
    (
        "flows/responses/residuals.py",
        '    "frf:FrfSection",\n',
        '    "mean_frequency:MeanFrequencySection",\n',
    ),
    (
        "flows/studies/catalogue.py",
        '    "modes": ("modes", STUDY),\n',
        '    "spacing": ("spacing", STUDY),\n',
    ),
    (
        "adapters/calculix/cards.py",
        '    Keyword("*GAP", "elset", massless=True),\n',
        '    Keyword("*CONNECTOR ELASTICITY", "elset", "K", {\n'
        '        "spring_stiffness": KeywordNumbers(_first, (1,), energy=True),\n'
        "    }, massless=True),\n",
    ),
)
#: A deck with the card whose row is added, and a program that doubles its stiffness.
DECK = """\
*NODE
1, 0., 0., 0.
2, 1., 0., 0.
*ELEMENT, TYPE=SPRING2, ELSET=MOUNT
1, 1, 2
*ELEMENT, TYPE=MASS, ELSET=BODY
2, 2
*CONNECTOR ELASTICITY, ELSET=MOUNT
70.
*MASS, ELSET=BODY
1.
*STEP
*FREQUENCY
1
*END STEP
"""
DOUBLE = """
from pathlib import Path
from modetune.adapters.calculix.solver import calculix_solver
from modetune.core.parameters import Parameter

k = Parameter("k", "spring_stiffness", "elset", ("MOUNT",), 0.5, 2.0, 0.1)
deck = calculix_solver(Path("mount.inp"), (k,)).deck
print(deck.write_updated({"k": 2.0}, Path("updated")).read_text())
"""


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the sources with all additions."""
    folder = tmp_path_factory.mktemp("house")
    copy_of_sources(folder)
    ignore = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ADDITIONS, folder, dirs_exist_ok=True, ignore=ignore)
    for name, before, line in LINES:
        text = (folder / name).read_text(encoding="utf-8")
        assert text.count(before) == 1
        (folder / name).write_text(text.replace(before, before + line), encoding="utf-8")
    return folder


def test_a_response_takes_two_files_and_a_line(house: Path) -> None:
    campaign = house / "configs" / "six_mass" / "campaign.yaml"
    command = ("update", str(campaign), "--runs", str(house / "runs"), "--no-prefect", "--json")
    settings = (f"store={house / 'store'}", "residuals.mean_frequency={n: 2, deviation: 1e-4}")
    options = (word for setting in settings for word in ("--set", setting))
    ended = json.loads(succeeds(house, "-m", "modetune", *command, *options))
    assert ended["status"] == "converged"
    (row,) = (row for row in ended["responses"] if row["kind"] == "mean_frequency")
    # The error of the mean is that of the two frequencies.
    modes = ended["modes"][:2]
    means = [np.mean([mode[key] for mode in modes]) for key in ("test_hz", "updated_hz")]
    assert row["measured"] - row["updated"] == pytest.approx(means[0] - means[1], abs=1e-9)


def test_a_study_takes_a_file_and_a_line(house: Path) -> None:
    """Two equal springs and masses in a row, held at one end: frequencies in the golden ratio's
    square, (3 + sqrt(5)) / 2."""
    model = house / "chain.yaml"
    model.write_text(
        "masses: {m1: 1.0, m2: 1.0}\nsprings:\n"
        "  k1: {between: [ground, m1], stiffness: 100.0}\n"
        "  k2: {between: [m1, m2], stiffness: 100.0}\n",
        encoding="utf-8",
    )
    options = ("--solver", "matrices", "--units", "m-kg-s", "--no-prefect", "--json")
    found = json.loads(succeeds(house, "-m", "modetune", "spacing", str(model), *options))
    assert found["modes"] == [1, 2]
    assert found["gap"] == pytest.approx(1.0 - 2.0 / (3.0 + np.sqrt(5.0)))


def test_a_card_takes_a_row(house: Path) -> None:
    (house / "mount.inp").write_text(DECK, encoding="utf-8")
    (house / "updated").mkdir()
    assert succeeds(house, "-c", DOUBLE).strip() == DECK.replace("70.", "140.0").strip()
