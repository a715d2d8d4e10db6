"""A case in a folder of one's own: its campaigns, test data and decks, to be run as they are.

    python -m modetune.configs.cases garteur FOLDER

and so bracket, fixture, four_storey, frame, launcher, mast, six_mass. Decks are written, not kept.
A campaign of a clone that is run in place (configs/garteur/twin.yaml) writes its decks itself;
other campaigns whose files are missing name the command that writes them.
"""

from __future__ import annotations

import os
import shutil
import sys
from importlib import import_module
from pathlib import Path

#: What writes the decks of each case into a folder, and the bracket's test: modules and functions,
#: of which only the case's own are imported.
DECKS: dict[str, tuple[tuple[str, str], ...]] = {
    "garteur": (("garteur.aircraft", "write_decks"), ("garteur.shell", "write_decks")),
    "bracket": (("bracket.bracket", "write_decks"), ("bracket.lab", "write_lab")),
    "fixture": (("fixture.fixture", "write_decks"),),
    "launcher": (("launcher.launcher", "write_decks"),),
    "mast": (("mast.mast", "write_decks"),),
    # Models that are campaign data are in the campaign's folder.
    "four_storey": (),
    "frame": (),
    "six_mass": (),
}


def write_case(case: str, folder: Path) -> None:
    """Copy a case's campaigns and test data to a folder, and write its decks there."""
    source = Path(__file__).parent / case
    folder.mkdir(parents=True, exist_ok=True)
    if folder.resolve() != source.resolve():
        for file in sorted(source.iterdir()):
            if file.suffix in (".yaml", ".csv", ".opensees"):
                shutil.copyfile(file, folder / file.name)
    for module, write in DECKS[case]:
        getattr(import_module(f"modetune.configs.{module}"), write)(folder)


def case_of(campaign: Path) -> str:
    """Return the case that a campaign file is of, or an unchanged copy of; empty without one."""
    for case in DECKS:
        own = Path(__file__).parent / case / campaign.name
        if own.is_file() and own.read_bytes() == campaign.read_bytes():
            return case
    return ""


def write_own_decks(campaign: Path) -> bool:
    """Write the decks of a campaign that lies in this clone; return whether it does.

    A case whose test is made by a solver run is left alone. Raises OSError.
    """
    root, case = Path(__file__).resolve().parent, campaign.resolve().parent.name
    known = case in DECKS and all(write == "write_decks" for _, write in DECKS[case])
    if campaign.resolve().parent != root / case or not known or not (root.parent / ".git").exists():
        return False
    write_case(case, campaign.resolve().parent)
    return True


def writing_command(campaign: Path, missing: str) -> str:
    """Return what writes a missing file of a case's campaign, in a sentence; empty if unknown."""
    case = case_of(campaign)
    if not case:
        return ""
    folder = os.path.relpath(campaign.parent)
    if missing == "modes.csv":
        return f"the first lines of {campaign.name} say how modetune identify makes it from lab.unv"
    program = "garteur.lab" if (case, missing) == ("garteur", "lab.unv") else f"cases {case}"
    return f"`python -m modetune.configs.{program} {folder}` writes it"


if __name__ == "__main__":
    write_case(sys.argv[1], Path(sys.argv[2]))
