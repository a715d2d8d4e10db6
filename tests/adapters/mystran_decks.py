"""Small Nastran decks that MYSTRAN takes: a frame on soft mounts, a plate with MPC, a bracket."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise, product

HEAD = "SOL 103\nCEND\n{0}METHOD = 1\nBEGIN BULK\nEIGRL,1,,,10\n"
#: Grid points of the frame on a rigid arm, two of them, and on an average of three others.
CARRIED, PINNED, AVERAGED = 101, 102, 103
#: What is added to the number of a grid point for its mount.
MOUNT = 200


def frame(members: int = 4, values: Sequence[float] = ()) -> str:
    """A zigzag of tubes, a property and material each, on a soft mount at every other corner.

    Units hang beside it: one on a rigid arm, one on an average of three grid points; some have axes
    of a turned and of a cylindrical frame. values: relative moduli of the first members.
    """
    corners = [(0.7 * m, 0.2 * (m % 3), 0.9 * (m % 2) + 0.03 * m) for m in range(members + 1)]
    factors = [*values, *([1.0] * (members - len(values)))]
    lines = [
        "CORD2R,1,,0.,0.,0.,.3,.1,1.",
        ",1.,.2,0.",
        "CORD2C,2,,.2,.1,0.,.2,.1,1.",
        ",1.2,.1,0.",
        _grid(4 * members + 1, corners[-1]),
    ]
    number = 0
    for member, (first, last) in enumerate(pairwise(corners)):
        for step in range(4):
            number += 1
            place = [a + (b - a) * step / 4 for a, b in zip(first, last, strict=True)]
            lines.append(_grid(number, place, ("", "1", "2", "")[number % 4]))
            lines.append(f"CBAR,{number},{member + 1},{number},{number + 1},.3,1.,.2")
        lines.append(f"PBAR,{member + 1},{member + 1},{3.0 + 0.4 * member:.1f}-4,2.-8,3.-8,4.-8")
        modulus, density = 2.0 * factors[member], 7800.0 - 300.0 * member
        lines.append(f"MAT1,{member + 1},{modulus:.6f}+11,,.3,{density}")
    for corner in range(0, members + 1, 2):
        x, y, z = corners[corner]
        node = 4 * corner + 1
        ground = MOUNT + node
        lines.append(_grid(ground, (x, y, z - 0.1)) + ",123456")
        lines.append(f"CBUSH,{ground},{ground},{node},{ground},,,,0")
        lines.append(f"PBUSH,{ground},K,4000.,6000.,9000.,30.,30.,30.")
    lines += [_grid(CARRIED, (1.0, 0.4, 1.3)), "CONM2,301,101,,3.,,.02,.01,.03", ",.02,,.03,,,.01"]
    lines += ["RBE2,401,9,123456,101", _grid(PINNED, (1.7, 0.2, 1.5), "1"), "RBE2,402,9,123,102"]
    lines += [_grid(AVERAGED, (1.1, 0.5, 0.4)), "CONM2,302,103,,2.", ",.01,,.02,,,.02"]
    lines.append("RBE3,403,,103,123456,1.,123,3,7\n,12,15")
    return HEAD.format("") + "\n".join(lines) + "\nENDDATA\n"


def _grid(number: int, place: tuple[float, ...] | list[float], frame: str = "") -> str:
    x, y, z = (f"{value:.6f}" for value in place)
    return f"GRID,{number},,{x},{y},{z},{frame}"


def plate() -> str:
    """A stepped plate of 6 x 4 shells on an edge and a hinge, two strips of it coupled by MPC."""
    lines = []
    for i, j in product(range(7), range(5)):
        held = "6" if i else ""
        lines.append(_grid(_at(i, j), (0.1 * i, 0.08 * j, 0.02 * (i > 4))) + f",{held}")
    number = 0
    for i, j in product(range(6), range(4)):
        number += 1
        corners = _at(i, j), _at(i + 1, j), _at(i + 1, j + 1), _at(i, j + 1)
        if (i, j) == (5, 3):
            lines.append("CTRIA3,{4},{5},{0},{1},{2}".format(*corners, number, 1 + i // 2))
            number += 1
            lines.append(f"CTRIA3,{number},{1 + i // 2},{corners[0]},{corners[2]},{corners[3]}")
        else:
            lines.append("CQUAD4,{4},{5},{0},{1},{2},{3}".format(*corners, number, 1 + i // 2))
    for part in (1, 2, 3):
        lines.append(f"PSHELL,{part},{part},{0.002 + 0.0005 * part},{part},,{part},,{0.2 * part}")
        lines.append(f"MAT1,{part},7.+10,,.33,2700.")
    lines += [f"SPC1,11,123456,{_at(0, 0)},THRU,{_at(0, 4)}", f"SPC1,12,3,{_at(6, 0)}"]
    lines += ["SPCADD,10,11,12", f"MPC,20,{_at(6, 4)},3,1.,{_at(5, 4)},3,-.7"]
    lines += [f",,{_at(5, 3)},3,-.3", f"CONM2,91,{_at(4, 2)},,.15"]
    return HEAD.format("SPC = 10\nMPC = 20\n") + "\n".join(lines) + "\nENDDATA\n"


def _at(i: int, j: int) -> int:
    """The grid point of the plate in column i and row j."""
    return 10 * (i + 1) + j


def bracket(parts: int = 2) -> str:
    """A free L of bricks, 5 x 2 and 2 x 2 beside each other, of so many materials along it."""
    cells = [(i, j, 0) for i, j in product(range(6), range(2))]
    cells += [(5, j, k) for j, k in product(range(2), range(1, 4))]
    corners = list(product((0, 1), repeat=3))
    order = [corners.index(c) for c in ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0))]
    order += [corners.index(c) for c in ((0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))]
    numbers: dict[tuple[int, ...], int] = {}
    elements = []
    for cell in cells:
        nodes = [tuple(a + b for a, b in zip(cell, corner, strict=True)) for corner in corners]
        elements.append([numbers.setdefault(node, len(numbers) + 1) for node in nodes])
    lines = [
        _grid(number, (0.03 * x, 0.02 * y, 0.025 * z)) for (x, y, z), number in numbers.items()
    ]
    for place, eight in enumerate(elements):
        part = 1 + place * parts // len(elements)
        names = [str(eight[at]) for at in order]
        lines.append(f"CHEXA,{place + 1},{part}," + ",".join(names[:6]))
        lines.append("," + ",".join(names[6:]))
    for part in range(1, parts + 1):
        lines += [f"PSOLID,{part},{part}", f"MAT1,{part},7.+10,,.3,{2700.0 + 100.0 * part}"]
    return HEAD.format("") + "\n".join(lines) + "\nENDDATA\n"
