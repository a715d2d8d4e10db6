"""A case in a folder of one's own: its campaigns, test data and decks, to be run as they are.

    python -m modetune.configs.cases garteur FOLDER

and so bracket, fixture, four_storey, frame, launcher, mast, six_mass. Decks are written, not kept:
for campaigns of this repository to run in place, FOLDER is the case's own (configs/garteur).
"""

from __future__ import annotations

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


if __name__ == "__main__":
    write_case(sys.argv[1], Path(sys.argv[2]))
