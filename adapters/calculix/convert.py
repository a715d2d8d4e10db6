"""The program that runs ccx2paraview: the modes of a .frd file as MODE.vtu in this folder.

ccx2paraview 3.2 writes each step in a separate thread while it puts the next step's data into
the same grid: in small models files held the shape of the mode after theirs. Here it gets one file
a mode, which it has written when it returns. Started as `python -m`, with the .frd file.
"""

from __future__ import annotations

import sys
from pathlib import Path

#: The line that ends a block of nodes, elements or results.
END = b" -3"
CLOSING = b" 9999\n"
#: Bytes copied at a time.
CHUNK = 1 << 20


def block_ends(frd: Path) -> list[int]:
    """Positions in the file behind each block: nodes, elements, and a block a mode."""
    places, place = [], 0
    with frd.open("rb") as source:
        for line in source:
            place += len(line)
            if line.rstrip() == END:
                places.append(place)
    return places


def convert(frd: Path, folder: Path) -> None:
    """Write 1.vtu, 2.vtu, ... of the modes of a .frd file."""
    from ccx2paraview.common import Converter

    _, mesh, *modes = block_ends(frd)
    for mode, (start, stop) in enumerate(zip([mesh, *modes], modes, strict=False), start=1):
        single = folder / f"{mode}.frd"
        with frd.open("rb") as source, single.open("wb") as target:
            for first, last in ((0, mesh), (start, stop)):
                source.seek(first)
                while first < last:
                    first += target.write(source.read(min(CHUNK, last - first)))
            target.write(CLOSING)
        Converter(str(single), ["vtu"]).run()
        single.unlink()


if __name__ == "__main__":
    convert(Path(sys.argv[1]), Path())
