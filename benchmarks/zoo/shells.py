"""Families of shells: a tube, a laminate, a plate with a stiffener."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from benchmarks.zoo.structure import (
    TWO_MODULI,
    Generator,
    Structure,
    elements,
    material,
    rows,
    spread,
)


def quads(nx: int, ny: int, closed: bool) -> tuple[dict[tuple[int, int], int], list[list[int]]]:
    """Numbers of nodes (i, j) and eight-node quadrilaterals; closed: round in the second."""
    ids: dict[tuple[int, int], int] = {}
    last = 2 * ny if closed else 2 * ny + 1
    for i in range(2 * nx + 1):
        for j in range(last):
            if not (i % 2 and j % 2):
                ids[i, j] = len(ids) + 1
    local = [(0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1)]
    table = [
        [ids[2 * a + i, (2 * b + j) % (2 * ny) if closed else 2 * b + j] for i, j in local]
        for a in range(nx)
        for b in range(ny)
    ]
    return ids, table


def shell_deck(
    nodes: Sequence[Sequence[object]],
    table: Sequence[Sequence[int]],
    sections: str,
    rng: Generator,
    more: str = "",
) -> str:
    half = len(table) // 2
    return (
        f"*NODE, NSET=NALL\n{rows(nodes)}"
        + elements("S8R", "LOWER", range(1, half + 1), table)
        + elements("S8R", "UPPER", range(half + 1, len(table) + 1), table)
        + material("LOWER", rng)
        + material("UPPER", rng)
        + sections
        + more
    )


def plain_shells(thickness: float) -> str:
    return "".join(
        f"*SHELL SECTION, ELSET={name}, MATERIAL={name}\n{thickness:.6g}\n"
        for name in ("LOWER", "UPPER")
    )


def tube(rng: Generator) -> Structure:
    """A clamped tube of shells: bending and ovalising in doublets."""
    length, radius = rng.uniform(300, 600), rng.uniform(40, 90)
    ids, table = quads(6, 8, closed=True)
    nodes = [
        (
            node,
            length * i / 12,
            radius * float(np.cos(np.pi * j / 8)),
            radius * float(np.sin(np.pi * j / 8)),
        )
        for (i, j), node in ids.items()
    ]
    held = rows((node, 1, 6) for (i, _), node in ids.items() if i == 0)
    deck = shell_deck(nodes, table, plain_shells(rng.uniform(1.5, 4)), rng, f"*BOUNDARY\n{held}")
    free = [node for (i, _), node in ids.items() if i]
    return Structure("tube", deck, TWO_MODULI, spread(rng, free, 24), 5)


def laminate(rng: Generator) -> Structure:
    """A square plate on two edges, of two plies of one material between two of another."""
    size, n = rng.uniform(200, 400), 5
    ids, table = quads(n, n, closed=False)
    nodes = [(node, size * i / (2 * n), size * j / (2 * n), 0.0) for (i, j), node in ids.items()]
    ply = rng.uniform(0.3, 0.6)
    sections = "".join(
        f"*SHELL SECTION, ELSET={name}, COMPOSITE\n"
        + "".join(f"{ply:.6g}, , {one}\n" for one in ("LOWER", "UPPER", "UPPER", "LOWER"))
        for name in ("LOWER", "UPPER")
    )
    held = rows((node, 1, 3) for (i, j), node in ids.items() if i == 0 or j == 0)
    deck = shell_deck(nodes, table, sections, rng, f"*BOUNDARY\n{held}")
    free = [node for (i, j), node in ids.items() if i and j]
    return Structure("laminate", deck, TWO_MODULI, spread(rng, free, 20), 5)


def stiffened_plate(rng: Generator) -> Structure:
    """A free plate with a blade across it, shells that meet at a right angle."""
    size, height = rng.uniform(250, 500), rng.uniform(20, 50)
    n = 6
    ids, table = quads(n, n, closed=False)
    nodes: list[Sequence[object]] = [
        (node, size * i / (2 * n), size * j / (2 * n), 0.0) for (i, j), node in ids.items()
    ]
    blade: dict[tuple[int, int], int] = {(i, 0): ids[i, n] for i in range(2 * n + 1)}
    for i in range(2 * n + 1):
        for k in (1, 2):
            if not (i % 2 and k % 2):
                blade[i, k] = len(nodes) + 1
                nodes.append((blade[i, k], size * i / (2 * n), size / 2, height * k / 2))
    local = [(0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1)]
    blades = [[blade[2 * a + i, k] for i, k in local] for a in range(n)]
    numbers = range(len(table) + 1, len(table) + n + 1)
    deck = (
        f"*NODE, NSET=NALL\n{rows(nodes)}"
        + elements("S8R", "LOWER", range(1, len(table) + 1), table)
        + elements("S8R", "UPPER", numbers, table + blades)
        + material("LOWER", rng)
        + material("UPPER", rng)
        + plain_shells(rng.uniform(1.5, 4))
    )
    return Structure("stiffened_plate", deck, TWO_MODULI, spread(rng, list(ids.values()), 24), 5)
