"""Families of beams: a tower, a grillage, and a wing of bars as a Nastran deck."""

from __future__ import annotations

from collections.abc import Sequence

from benchmarks.zoo.structure import Generator, Structure, material, modulus, rows, spread


def beams(
    family: str,
    nodes: Sequence[Sequence[object]],
    bars: dict[str, list[tuple[int, int]]],
    held: Sequence[int],
    rng: Generator,
    normal: Sequence[float],
    n_modes: int,
    more: str = "",
) -> Structure:
    """A frame of B31 beams, each group with a section and a material of its own."""
    text, number, parameters = f"*NODE, NSET=NALL\n{rows(nodes)}", 1, []
    for name, pairs in bars.items():
        table = [(number + place, *pair) for place, pair in enumerate(pairs)]
        number += len(pairs)
        a, b = rng.uniform(8, 20), rng.uniform(8, 20)
        text += f"*ELEMENT, TYPE=B31, ELSET={name}\n{rows(table)}{material(name, rng)}"
        text += f"*BEAM SECTION, ELSET={name}, MATERIAL={name}, SECTION=RECT\n{a:.6g}, {b:.6g}\n"
        text += ", ".join(f"{value:g}" for value in normal) + "\n"
        parameters.append(modulus(name))
    text += more + (f"*BOUNDARY\n{rows((node, 1, 6) for node in held)}" if held else "")
    free = [int(str(node[0])) for node in nodes if node[0] not in held]
    return Structure(family, text, tuple(parameters), spread(rng, free, 20), n_modes)


def tower(rng: Generator) -> Structure:
    """A square tower of four legs and rings: every sway comes twice."""
    side, height, n = rng.uniform(200, 400), rng.uniform(200, 400), 4
    corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
    nodes = [
        (4 * level + place + 1, side * x, side * y, height * level)
        for level in range(n + 1)
        for place, (x, y) in enumerate(corners)
    ]
    legs = [(4 * level + p + 1, 4 * level + p + 5) for level in range(n) for p in range(4)]
    rings = [
        (4 * level + p + 1, 4 * level + (p + 1) % 4 + 1)
        for level in range(1, n + 1)
        for p in range(4)
    ]
    return beams(
        "tower", nodes, {"LEGS": legs, "RINGS": rings}, [1, 2, 3, 4], rng, (0.6, 0.8, 0.1), 5
    )


def grillage(rng: Generator) -> Structure:
    """Beams crossing in a plane, held at the corners."""
    size, n = rng.uniform(400, 900), 4
    ids = {(i, j): i * (n + 1) + j + 1 for i in range(n + 1) for j in range(n + 1)}
    nodes = [(node, size * i / n, size * 0.8 * j / n, 0.0) for (i, j), node in ids.items()]
    along = [(ids[i, j], ids[i + 1, j]) for i in range(n) for j in range(n + 1)]
    across = [(ids[i, j], ids[i, j + 1]) for i in range(n + 1) for j in range(n)]
    held = [ids[0, 0], ids[n, 0], ids[0, n], ids[n, n]]
    return beams("grillage", nodes, {"ALONG": along, "ACROSS": across}, held, rng, (0, 0, 1), 5)


def stick(rng: Generator) -> Structure:
    """A wing of bars with masses off the axis, as a Nastran deck."""
    n, span = 16, rng.uniform(1500, 4000)
    text = "SOL 103\nCEND\nMETHOD = 1\nSPC = 1\nBEGIN BULK\nEIGRL,1,,,20\nPARAM,GRDPNT,0\n"
    for place in range(n + 1):
        text += f"GRID,{place + 1},,{span * place / n:.2f},0.,0.\n"
    for place in range(n):
        text += f"CBAR,{place + 1},{1 + (place >= n // 2)},{place + 1},{place + 2},0.,0.,1.\n"
        offset, mass = rng.uniform(20, 120), rng.uniform(0.0005, 0.002)
        text += f"CONM2,{100 + place},{place + 2},,{mass:.6f},0.,{offset:.2f},0.\n"
        text += f",{mass * 2000:.4f},,{mass * 3000:.4f},,,{mass * 3000:.4f}\n"
    for number in (1, 2):
        area = rng.uniform(400, 900)
        text += f"PBAR,{number},{number},{area:.2f},{area * 90:.1f},{area * 400:.1f},"
        text += f"{area * 200:.1f}\nMAT1,{number},{rng.uniform(65e3, 75e3):.1f},,.33,2.7-9\n"
    text += "SPC1,1,123456,1\nENDDATA\n"
    parameters = tuple(
        {"name": f"E_{place}", "quantity": "youngs_modulus", "material": place} for place in (1, 2)
    )
    return Structure("stick", text, parameters, tuple(range(2, n + 2)), 5)
