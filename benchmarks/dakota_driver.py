"""What Dakota starts for each point: a job of the solver, and its residual.

    python dakota_driver.py SPEC PARAMETERS RESULTS

It stands alone, as a user of Dakota would write it: nothing of modetune is imported, and numpy only
for shapes. SPEC is JSON (`dakota.py` writes it). The deck is a template with @NAME@ where a value
goes. The first point on target is left in `met` of SPEC, and ends Dakota and all that it started.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

#: Of a job: frequencies, Hz, and by mode the displacement of each node.
Found = tuple[list[float], list[dict[int, list[float]]]]


def number(value: float, most: int) -> str:
    """A number in at most so many characters; in all its digits for 0."""
    if not most:
        return repr(value)
    text = f"{value:#.{most - 2}g}"
    if len(text) > most:
        raise ValueError(f"{value} does not fit in {most} characters")
    return text


def calculix(file: Path) -> Found:
    """What a .dat file has."""
    hz: list[float] = []
    shapes: list[dict[int, list[float]]] = []
    table = False
    with file.open() as lines:
        for line in lines:
            words = line.split()
            if line.startswith("     E I G E N V A L U E   O U T P U T"):
                table = True
            elif "P A R T I C I P A T I O N" in line:
                table = False
            elif table and len(words) == 5 and words[0].isdigit():
                hz.append(math.sqrt(max(float(words[1]), 0.0)) / (2.0 * math.pi))
            elif line.startswith(" displacements"):
                shapes.append({})
            elif shapes and len(words) == 4 and words[0].isdigit():
                shapes[-1][int(words[0])] = [float(word) for word in words[1:]]
    return hz, shapes


def mystran(file: Path) -> Found:
    """What an F06 file has, without shapes."""
    hz: list[float] = []
    table = False
    with file.open() as lines:
        for line in lines:
            words = line.split()
            table = table or "R E A L   E I G E N V A L U E S" in line
            if table and len(words) == 7 and words[0].isdigit() and words[1].isdigit():
                hz.append(float(words[4]))
    return hz, []


READERS = {"calculix": calculix, "mystran": mystran}


def residual(spec: dict[str, Any], found: Found) -> tuple[list[float], bool]:
    """The residual over its deviations, and whether the point is on target.

    Both are those of `problem.agreement`.
    """
    first, measured = spec["n_rigid"], spec["hz"]
    hz = found[0][first:]
    if not spec["shapes"]:
        errors = [one / other - 1.0 for one, other in zip(hz, measured, strict=False)]
        met = max(map(abs, errors)) <= spec["target"]
        return [error / spec["frequency_deviation"] for error in errors], met
    import numpy as np
    from scipy.optimize import linear_sum_assignment

    nodes, computed = spec["nodes"], found[1][first:]
    models = np.array([[value for node in nodes for value in one[node]] for one in computed])
    tests, models = (
        one.T / np.linalg.norm(one, axis=1) for one in (np.array(spec["shapes"]), models)
    )
    cosines = tests.T @ models
    rows, columns = linear_sum_assignment(-(cosines**2))
    cosines = cosines[rows, columns]
    apart = np.array(hz)[columns] / measured - 1.0
    entry = spec["shape_deviation"] / math.sqrt(spec["shape_weight"] * tests.shape[0])
    shapes = np.sign(cosines) * (cosines * tests - models[:, columns]) / entry
    met = bool(np.abs(apart).max() <= spec["target"] and (cosines**2).min() >= spec["least_mac"])
    return [*(apart / spec["frequency_deviation"]).tolist(), *shapes.ravel().tolist()], met


def main() -> None:
    """Run the job of one point."""
    files = [Path(name) for name in sys.argv[1:]]
    spec = json.loads(files[0].read_text())
    count, *lines = files[1].read_text().splitlines()
    rows = [line.split() for line in lines[: int(count.split()[0])]]
    values = {name: float(value) for value, name in rows}
    template = Path(spec["template"])
    deck = template.read_text()
    for name, (base, most, width) in spec["values"].items():
        deck = deck.replace(f"@{name}@", number(base * values[name], most).ljust(width))
    folder = Path(tempfile.mkdtemp(dir=template.parent, prefix="run-"))
    try:
        (folder / spec["deck"]).write_text(deck)
        subprocess.run(
            spec["command"],
            cwd=folder,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
            stdout=subprocess.DEVNULL,
            check=True,
        )
        found, met = residual(spec, READERS[spec["solver"]](folder / spec["results"]))
    finally:
        shutil.rmtree(folder)
    files[2].write_text("\n".join(map(repr, found)) + "\n")
    if met:
        part = Path(f"{spec['met']}.{os.getpid()}")
        part.write_text(json.dumps(values))
        part.replace(spec["met"])
        os.killpg(0, signal.SIGTERM)


if __name__ == "__main__":
    main()
