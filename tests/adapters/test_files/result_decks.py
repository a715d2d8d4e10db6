"""Small decks whose result files serve as tests: a bracket of bricks and a ladder of bars."""

from __future__ import annotations

N_ARM = 5


def bracket() -> str:
    """An L of C3D8I bricks, clamped at one end, for CalculiX; lengths in mm, tonnes, seconds."""
    spine = [(0.0, 0.0, 10.0 * k) for k in range(N_ARM + 1)]
    spine += [(10.0 * k, 0.0, 10.0 * N_ARM + 4.0 * k) for k in range(1, N_ARM)]
    lines = ["*NODE, NSET=ALL"]
    for place, (x, y, z) in enumerate(spine):
        upright = place < N_ARM
        for corner, (across, through) in enumerate(((0, 0), (1, 0), (1, 1), (0, 1))):
            dx, dz = (-3.0 * through, 0.0) if upright else (0.0, 3.0 * through)
            node = 4 * place + corner + 1
            lines.append(f"{node}, {x + dx}, {y + 8.0 * across}, {z + dz}")
    lines.append("*ELEMENT, TYPE=C3D8I, ELSET=BODY")
    for place in range(len(spine) - 1):
        low = [4 * place + corner for corner in (1, 2, 3, 4)]
        lines.append(f"{place + 1}, {', '.join(map(str, [*low, *(node + 4 for node in low)]))}")
    lines += ["*MATERIAL, NAME=STEEL", "*ELASTIC", "210000., 0.3", "*DENSITY", "7.85e-9"]
    lines += ["*SOLID SECTION, ELSET=BODY, MATERIAL=STEEL", "*BOUNDARY"]
    lines += [f"{node}, 1, 3" for node in (1, 2, 3, 4)]
    lines += ["*STEP", "*FREQUENCY", "4", "*NODE FILE", "U", "*END STEP", ""]
    return "\n".join(lines)


def ladder() -> str:
    """A free ladder of CBARs for MYSTRAN, with shapes in every file that it writes; SI."""
    lines = ["SOL 103", "CEND", "METHOD = 1", "DISP(PRINT,PLOT) = ALL", "BEGIN BULK"]
    lines += ["EIGRL,1,,,12,,,-1000.,MASS", "PARAM,POST,-1", "MAT1,1,7.+10,,.3,2700."]
    lines += ["PBAR,1,1,4.-4,2.-8,3.-8,4.-8", "PBAR,2,1,1.-4,1.-9,1.-9,2.-9"]
    for rung in range(5):
        for side in (0, 1):
            lines.append(f"GRID,{2 * rung + side + 1},,{0.4 * rung:.1f},{0.3 * side:.1f},0.")
        lines.append(f"CBAR,{100 + rung},2,{2 * rung + 1},{2 * rung + 2},0.,0.,1.")
        for side in (0, 1) if rung < 4 else ():
            first = 2 * rung + side + 1
            lines.append(f"CBAR,{1 + first},1,{first},{first + 2},0.,0.,1.")
    return "\n".join([*lines, "ENDDATA", ""])
