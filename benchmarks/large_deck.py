"""A large Nastran deck: processor time and memory to read it, and to write the decks of its jobs.

    python -m benchmarks.large_deck 12500 100000

The deck is a clamped plate of CQUAD4 with five materials, whose Young's moduli are parameters; jobs
are written for MYSTRAN. The last line of the output is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import math
import resource
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.solver import ModalAnalysis
from modetune.core.parameters import Parameter

#: Materials of the plate, one for each strip across it.
STRIPS = 5
#: Its length and width, mm; four times as many elements along it as across.
LENGTH, WIDTH = 4000.0, 1000.0
N_MODES = 10


def plate(n_grids: int) -> tuple[str, int]:
    """Return the deck of a plate with about so many grid points, and their number."""
    across = max(2, round(math.sqrt(n_grids / 4.0)) - 1)
    along = 4 * across
    lines = ["SOL 103", "CEND", "METHOD=1", "SPC=1", "BEGIN BULK", f"EIGRL,1,,,{N_MODES}"]
    for strip in range(1, STRIPS + 1):
        lines += [f"MAT1,{strip},7{strip}000.,,.3,2.7-9", f"PSHELL,{strip},{strip},10.,{strip}"]

    def grid(i: int, j: int) -> int:
        return 1 + i * (across + 1) + j

    for i in range(along + 1):
        for j in range(across + 1):
            x, y = LENGTH * i / along, WIDTH * j / across
            lines.append(f"GRID    {grid(i, j):>8}        {x:8.2f}{y:8.2f}      0.")
    for i in range(along):
        for j in range(across):
            corners = (grid(i, j), grid(i + 1, j), grid(i + 1, j + 1), grid(i, j + 1))
            number, strip = 1 + i * across + j, 1 + i * STRIPS // along
            lines.append(f"CQUAD4  {number:>8}{strip:>8}" + "".join(f"{n:>8}" for n in corners))
    lines += [f"SPC1,1,123456,{grid(0, j)}" for j in range(across + 1)]
    return "\n".join([*lines, "ENDDATA", ""]), (along + 1) * (across + 1)


def measure(n_grids: int) -> dict[str, float]:
    """Return seconds of processor time, and the peak memory, of one size."""
    text, n_grids = plate(n_grids)
    names = [str(strip) for strip in range(1, STRIPS + 1)]
    parameters = tuple(
        Parameter(f"E{name}", "youngs_modulus", "material", (name,), 0.7, 1.3, 0.2)
        for name in names
    )
    with tempfile.TemporaryDirectory(prefix="modetune-bench-") as folder:
        path = Path(folder) / "plate.bdf"
        path.write_text(text)
        started = time.process_time()
        solver = mystran_solver(path, parameters)
        read_s = time.process_time() - started
        started = time.process_time()
        edited = solver.deck.edited({item.name: 1.01 for item in parameters})
        solver.program.render(edited, ModalAnalysis(N_MODES, (1,)))
        write_s = time.process_time() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {"grids": n_grids, "read_s": read_s, "write_s": write_s, "peak_bytes": peak}


def main(arguments: list[str] | None = None) -> None:
    """Measure the requested sizes, each in a separate process."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("grids", nargs="+", type=int, help="grid points of the plate")
    results = []
    for n_grids in parser.parse_args(arguments).grids:
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            found = pool.submit(measure, n_grids).result()
        sys.stdout.write(
            f"{found['grids']:,} grids: read in {found['read_s']:.1f} s, a job's deck written in "
            f"{found['write_s']:.2f} s, {found['peak_bytes'] / 1e9:.2f} GB\n"
        )
        results.append(found)
    sys.stdout.write(json.dumps(results) + "\n")


if __name__ == "__main__":
    main()
