"""The cost of a point before CalculiX starts on a Nastran deck: edited or translated again.

    python -m benchmarks.translation [GRIDS]

The model is a curved panel of shells with a lump, with about GRIDS grid points. Translated again:
the updated deck is read, translated and parsed, as formerly for every point. Edited: only the
numbers of the first translation change. Both give the same text. Times are processor seconds, the
lower of two.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from modetune.adapters.solver import ModalAnalysis
from modetune.adapters.translation.solver import TranslatedDeck, translated_solver
from modetune.core.parameters import Parameter

PARAMETERS = (
    Parameter("E", "youngs_modulus", "material", ("1",), 0.5, 2.0, 0.2),
    Parameter("t", "thickness", "property", ("2",), 0.5, 2.0, 0.2),
    Parameter("nu", "poissons_ratio", "material", ("3",), 0.5, 2.0, 0.2),
)
ANALYSIS = ModalAnalysis(8, (5, 50))
TIMES = 2


def write_panel(path: Path, grids: int) -> None:
    """A panel of four properties, twice as long as wide, clamped at one end."""
    wide = max(4, round((grids / 2.0) ** 0.5))
    long = 2 * wide
    lines = ["SOL 103", "CEND", "METHOD = 1", "SPC = 1", "BEGIN BULK", "EIGRL,1,,,8"]
    lines += [
        f"GRID,{i * (wide + 1) + j + 1},,{0.025 * i:.4f},{0.025 * j:.4f},{6e-5 * i * i:.6f}"
        for i in range(long + 1)
        for j in range(wide + 1)
    ]
    for i in range(long):
        for j in range(wide):
            first = i * (wide + 1) + j + 1
            corners = (first, first + wide + 1, first + wide + 2, first + 1)
            part = 1 + 4 * i // long
            lines.append(f"CQUAD4,{i * wide + j + 1},{part},{','.join(map(str, corners))}")
    for part in range(1, 5):
        lines.append(f"PSHELL,{part},{part},.004,{part},,{part}")
        lines.append(f"MAT1,{part},7.E10,,.3,2700.")
    lines.append(f"CONM2,900001,{(long + 1) * (wide + 1)},,2.5")
    lines += [f"SPC1,1,123456,{j + 1}" for j in range(wide + 1)]
    path.write_text("\n".join([*lines, "ENDDATA"]) + "\n")


def least(what: Callable[[int], object]) -> float:
    """The least of some times, seconds of the processor; what: gets the number of the try."""
    found = []
    for number in range(TIMES):
        started = time.process_time()
        what(number)
        found.append(time.process_time() - started)
    return min(found)


def main(grids: int) -> None:
    """Print both times and their ratio."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_panel(folder / "panel.bdf", grids)
        solver = translated_solver(folder / "panel.bdf", PARAMETERS)
        deck = solver.deck
        assert isinstance(deck, TranslatedDeck)

        def values(number: int) -> dict[str, float]:
            return {item.name: 1.1 + 0.01 * number for item in PARAMETERS}

        def anew(number: int) -> object:
            updated = deck.write_updated(values(number), folder / f"anew{number}")
            return translated_solver(updated, PARAMETERS).render({}, ANALYSIS).content

        before = least(anew)
        after = least(lambda number: solver.render(values(number), ANALYSIS))
        assert solver.render(values(0), ANALYSIS).content == anew(0)
    sys.stdout.write(
        f"{len(deck.bulk.nodes)} grid points: again {before:.2f} s, edited {after:.2f} s, "
        f"{before / after:.1f} times faster; the same text\n"
    )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3200)
