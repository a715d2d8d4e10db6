"""Small CalculiX decks of every kind of element and tie, and what is asked of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

MATERIAL = "*MATERIAL, NAME=A\n*ELASTIC\n70000., 0.3\n*DENSITY\n2.7e-9\n"
#: The first section of the bar below.
ROOT = "*BOUNDARY\n1,1,3\n2,1,2\n3,1,3\n4,1,1\n"
#: Three points of the plate below: statically determinate.
PINNED = "*BOUNDARY\n{0},1,3\n{1},2,3\n{2},3,3\n"
#: A brick (number, then eight nodes) as six tetrahedra round its diagonal, and their edges.
TETRAHEDRA = ((1, 2, 3, 7), (1, 3, 4, 7), (1, 4, 8, 7), (1, 8, 5, 7), (1, 5, 6, 7), (1, 6, 2, 7))
EDGES = ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))


def _lines(rows: Iterable[Sequence[object]]) -> str:
    return "".join(", ".join(map(str, row)) + "\n" for row in rows)


def plate(kind: str, thickness: float = 2.0, section: str = "", held: str = PINNED) -> str:
    """A plate of 3 x 2 shells of 10 x 10; of four nodes: 1..12 row by row, 4 along x."""
    refined = 2 if kind[1] in "68" else 1
    ids: dict[tuple[int, int], int] = {}
    for j in range(2 * refined + 1):
        for i in range(3 * refined + 1):
            if not (kind[1] == "8" and i % 2 and j % 2):
                ids[i, j] = len(ids) + 1
    elements: list[tuple[object, ...]] = []
    for j in range(2):
        for i in range(3):
            at = _corner(ids, refined * i, refined * j)
            number = len(elements) + 1
            if kind[1] == "4":
                elements.append((number, at(0, 0), at(1, 0), at(1, 1), at(0, 1)))
            elif kind[1] == "8":
                elements.append(
                    (
                        number,
                        at(0, 0),
                        at(2, 0),
                        at(2, 2),
                        at(0, 2),
                        at(1, 0),
                        at(2, 1),
                        at(1, 2),
                        at(0, 1),
                    )
                )
            else:
                elements.append(
                    (number, at(0, 0), at(2, 0), at(2, 2), at(1, 0), at(2, 1), at(1, 1))
                )
                elements.append(
                    (number + 1, at(0, 0), at(2, 2), at(0, 2), at(1, 1), at(1, 2), at(0, 1))
                )
    nodes = [(n, 10.0 * i / refined, 10.0 * j / refined, 0.0) for (i, j), n in ids.items()]
    corners = ids[0, 0], ids[3 * refined, 0], ids[0, 2 * refined]
    return (
        f"*NODE, NSET=NALL\n{_lines(nodes)}*ELEMENT, TYPE={kind}, ELSET=P\n{_lines(elements)}"
        + MATERIAL
        + (section or f"*SHELL SECTION, ELSET=P, MATERIAL=A\n{thickness}\n")
        + held.format(*corners)
    )


def _corner(ids: dict[tuple[int, int], int], i: int, j: int) -> Callable[[int, int], int]:
    return lambda a, b: ids[i + a, j + b]


def wall(foot: tuple[int, int, int], x: float, thickness: float = 1.5) -> str:
    """2 x 2 shells that stand on three nodes of the plate, across it."""
    rows = [foot, (100, 101, 102), (110, 111, 112)]
    nodes = [(100 + 10 * k + j, x, 10.0 * j, 10.0 * (k + 1)) for k in (0, 1) for j in range(3)]
    shells = [
        (101 + 2 * k + j, rows[k][j], rows[k][j + 1], rows[k + 1][j + 1], rows[k + 1][j])
        for k in (0, 1)
        for j in (0, 1)
    ]
    return (
        f"*NODE\n{_lines(nodes)}*ELEMENT, TYPE=S4, ELSET=U\n{_lines(shells)}"
        f"*SHELL SECTION, ELSET=U, MATERIAL=A\n{thickness}\n"
    )


def strip(thickness: float) -> str:
    """Two more shells in the plate's plane, at its end x = 30."""
    nodes = [(100 + j, 40.0, 10.0 * j, 0.0) for j in range(3)]
    return (
        f"*NODE\n{_lines(nodes)}*ELEMENT, TYPE=S4, ELSET=U\n"
        "101, 4, 100, 101, 8\n102, 8, 101, 102, 12\n"
        f"*SHELL SECTION, ELSET=U, MATERIAL=A\n{thickness}\n"
    )


def block(kind: str) -> str:
    """Two solids below the shells that would stand at x = 30 .. 40, sharing nodes 4, 8, 12."""
    nodes = [row for j in range(3) for row in (
        (100 + j, 40.0, 10.0 * j, 0.0), (110 + j, 30.0, 10.0 * j, -10.0),
        (120 + j, 40.0, 10.0 * j, -10.0))]  # fmt: skip
    return (
        f"*NODE\n{_lines(nodes)}*ELEMENT, TYPE={kind}, ELSET=V\n"
        "301, 110, 120, 121, 111, 4, 100, 101, 8\n302, 111, 121, 122, 112, 8, 101, 102, 12\n"
        "*SOLID SECTION, ELSET=V, MATERIAL=A\n"
    )


def bar(kind: str, held: str = ROOT, bricks: int = 3) -> str:
    """Bricks in a row, 10 x 10 x 8 each, or tetrahedra in them; nodes 1..16, four a section."""
    corners = [
        (4 * i + 2 * y + z + 1, 10.0 * i, 10.0 * y, 8.0 * z)
        for i in range(bricks + 1)
        for y in (0, 1)
        for z in (0, 1)
    ]
    boxes: list[tuple[int, ...]] = []
    for i in range(bricks):
        a, b = 4 * i + 1, 4 * i + 5
        boxes.append((i + 1, a, b, b + 2, a + 2, a + 1, b + 1, b + 3, a + 3))
    if kind.startswith("C3D8"):
        return _solid(kind, corners, boxes) + held
    places = {row[0]: row[1:] for row in corners}
    nodes: list[tuple[object, ...]] = list(corners)
    rows: list[tuple[object, ...]] = []
    middles: dict[frozenset[int], int] = {}
    for tet in (tuple(brick[k] for k in four) for brick in boxes for four in TETRAHEDRA):
        for edge in (frozenset({tet[i], tet[j]}) for i, j in EDGES if kind == "C3D10"):
            if edge not in middles:
                middles[edge] = 100 + len(middles)
                first, last = (places[end] for end in edge)
                mean = [(p + q) / 2.0 for p, q in zip(first, last, strict=True)]
                nodes.append((middles[edge], *mean))
        between = [middles[frozenset({tet[i], tet[j]})] for i, j in EDGES if middles]
        rows.append((len(rows) + 1, *tet, *between))
    return _solid(kind, nodes, rows) + held


def _solid(
    kind: str, nodes: Iterable[Sequence[object]], elements: Iterable[Sequence[object]]
) -> str:
    return (
        f"*NODE, NSET=NALL\n{_lines(nodes)}*ELEMENT, TYPE={kind}, ELSET=V\n{_lines(elements)}"
        f"{MATERIAL}*SOLID SECTION, ELSET=V, MATERIAL=A\n"
    )


def beams(kind: str, elements: str) -> str:
    """Beams from node 4 of the plate, not in one line."""
    return (
        "*NODE\n301, 40., 0., 0.\n302, 50., 0., 0.\n303, 60., 0., 5.\n"
        f"*ELEMENT, TYPE={kind}, ELSET=B\n{elements}\n"
        "*BEAM SECTION, ELSET=B, MATERIAL=A, SECTION=RECT\n2., 3.\n0., 1., 0.\n"
    )


def attached(node: int, other: int) -> str:
    """A spring to the ground and a mass at two nodes."""
    return (
        f"*ELEMENT, TYPE=SPRING1, ELSET=K\n200, {node}\n*SPRING, ELSET=K\n3\n100.\n"
        f"*ELEMENT, TYPE=MASS, ELSET=M\n201, {other}\n*MASS, ELSET=M\n1e-6\n"
    )


def body(reference: str, card: str = "") -> str:
    """A rigid body of the bar's end with a mass beside it."""
    return (
        f"*NODE\n{reference}*NSET, NSET=RBN\n13, 14, 15, 16\n"
        f"*RIGID BODY, NSET=RBN, REF NODE=50{card}\n"
        "*ELEMENT, TYPE=MASS, ELSET=M\n99, 50\n*MASS, ELSET=M\n1e-5\n"
    )
