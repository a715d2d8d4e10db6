"""A shaft line with discs for `solver: command`: a deck, and a program that nobody has an adapter
for, which finds its torsional modes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from modetune.core.modes import Floats

#: Springs between discs, Nm/rad, and their inertias, kg m^2: engine, flywheel, gear, two shafts,
#: propeller; the engine's end is held by its governor.
SPRINGS = (4.0e6, 2.2e6, 1.5e6, 0.8e6, 0.6e6, 0.9e6)
DISCS = (60.0, 240.0, 35.0, 20.0, 18.0, 150.0)
DECK = """shaft line, torsion
springs {k_engine=4.0E+6:.9E} 2.2E6 1.5E6 {k_shaft=0.8E+6:.9E} 0.6E6 0.9E6
discs   60. 240. 35. 20. 18. {propeller=150.:10.4f}
modes {n_modes}
"""
NODES = "node,x,y,z\n" + "".join(f"{node},{2.5 * node},0,0\n" for node in range(1, 7))
#: Notes each run; `refuse`, `denied` or `silent` in the deck's first line make it fail so.
PROGRAM = '''"""python shaft.py DECK"""
import pathlib, sys
import numpy as np
lines = pathlib.Path(sys.argv[1]).read_text().splitlines()
with open({log!r}, "a") as log:
    log.write(lines[0] + "\\n")
if "denied" in lines[0]:
    sys.exit("TOKEN POOL EMPTY")
if "refuse" in lines[0]:
    print("line 1: E-1001 unknown keyword")
    sys.exit(0)
numbers = {{words[0]: np.array(words[1:], float) for words in map(str.split, lines[1:])}}
k, m, n = numbers["springs"], numbers["discs"], int(numbers["modes"][0])
stiffness = np.diag(k + np.append(k[1:], 0.0)) - np.diag(k[1:], 1) - np.diag(k[1:], -1)
values, shapes = np.linalg.eigh(stiffness / np.sqrt(np.outer(m, m)))
n = min(n, m.size)
shapes = shapes / np.sqrt(m)[:, None]
if "silent" not in lines[0]:
    rows = ["mode," + ",".join(str(mode + 1) for mode in range(n))]
    rows.append("frequency_hz," + ",".join("%.12g" % f for f in np.sqrt(values[:n]) / 2 / np.pi))
    for row, shape in enumerate(shapes[:, :n], start=1):
        rows.append("%d.rx," % row + ",".join("%.12g" % value for value in shape))
    pathlib.Path("twist.csv").write_text("\\n".join(rows) + "\\n")
print("END OF SHAFT 2.5.1")
'''


def shaft_frequencies(
    k_engine: float = 1.0, k_shaft: float = 1.0, propeller: float = 1.0
) -> Floats:
    """All natural frequencies in Hz, (6,), with these relative values."""
    k = np.array(SPRINGS) * [k_engine, 1.0, 1.0, k_shaft, 1.0, 1.0]
    m = np.array(DISCS) * [1.0, 1.0, 1.0, 1.0, 1.0, propeller]
    stiffness = np.diag(k + np.append(k[1:], 0.0)) - np.diag(k[1:], 1) - np.diag(k[1:], -1)
    values = np.linalg.eigvalsh(stiffness / np.sqrt(np.outer(m, m)))
    return np.asarray(np.sqrt(values) / (2.0 * np.pi))


def write_shaft(folder: Path, deck: str = DECK) -> Path:
    """Deck, nodes and program in a folder; the program notes its runs in runs.log there."""
    (folder / "nodes.csv").write_text(NODES)
    (folder / "shaft.py").write_text(PROGRAM.format(log=str(folder / "runs.log")))
    (folder / "shaft.txt").write_text(deck)
    return folder / "shaft.txt"
