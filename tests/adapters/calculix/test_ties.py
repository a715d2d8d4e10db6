"""Nodes of slave surfaces move as the master face's shape functions say: as ccx prints them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.calculix.constraints import read_constraints
from modetune.adapters.calculix.model import CalculixModel
from modetune.adapters.calculix.solver import calculix_solver
from tests.adapters.calculix.test_observation import N_MODES, both, solved
from tests.adapters.solved import needs_ccx

#: Places of a brick's nodes in a lattice with points in the middle of edges, in ccx's order.
BRICK = [(0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0), (0, 0, 2), (2, 0, 2), (2, 2, 2), (0, 2, 2)]
EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6),
         (3, 7)]  # fmt: skip
#: Six tetrahedra of a brick that meet those of its neighbours, and their edges.
TETRAHEDRA = [(0, 1, 2, 6), (0, 2, 3, 6), (0, 3, 7, 6), (0, 7, 4, 6), (0, 4, 5, 6), (0, 5, 1, 6)]
TETRA_EDGES = [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)]
#: Both blocks have this section, mm.
WIDTH, HEIGHT = 12.0, 8.0


class Block:
    """Solids in a lattice. cuts: along x, y, z; first: of its nodes and elements."""

    def __init__(self, kind: str, cuts: tuple[int, int, int], x: float, first: int) -> None:
        self.kind, self.first, self.numbers = kind, first, dict[tuple[int, int, int], int]()
        self.rows, self.faces = list[str](), {"S_LOW": list[str](), "S_HIGH": list[str]()}
        size = np.array([30.0, WIDTH, HEIGHT]) / cuts
        elements = 0
        for i, j, k in np.ndindex(*cuts):
            corners = [(2 * i + a, 2 * j + b, 2 * k + c) for a, b, c in BRICK]
            for part, edges in self._parts():
                own = [corners[n] for n in part]
                if kind.endswith(("20", "10")):
                    own += [self._middle(own[a], own[b]) for a, b in edges]
                elements += 1
                number = first + elements
                fields = [str(number), *(str(self._node(at)) for at in own)]
                lines = [", ".join(fields[n : n + 15]) for n in range(0, len(fields), 15)]
                self.rows.append(",\n".join(lines))
                self._note_faces(number, [corners[n] for n in part], 2 * cuts[0])
        self.places = {
            n: (x + 0.5 * a * size[0], 0.5 * b * size[1], 0.5 * c * size[2])
            for (a, b, c), n in self.numbers.items()
        }
        self.end = {n for (a, _, _), n in self.numbers.items() if a == 2 * cuts[0]}
        self.start = {n for (a, _, _), n in self.numbers.items() if a == 0}

    def _parts(self) -> list[tuple[tuple[int, ...], list[tuple[int, int]]]]:
        if self.kind.startswith(("C3D10", "C3D4")):
            return [(part, TETRA_EDGES) for part in TETRAHEDRA]
        return [(tuple(range(8)), EDGES)]

    @staticmethod
    def _middle(one: tuple[int, ...], other: tuple[int, ...]) -> tuple[int, int, int]:
        a, b, c = ((p + q) // 2 for p, q in zip(one, other, strict=True))
        return a, b, c

    def _node(self, at: tuple[int, int, int]) -> int:
        return self.numbers.setdefault(at, self.first + len(self.numbers) + 1)

    def _note_faces(self, number: int, corners: list[tuple[int, int, int]], end: int) -> None:
        faces = {4: ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)),
                 8: ((0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3),
                     (3, 7, 4, 0))}[len(corners)]  # fmt: skip
        for label, face in enumerate(faces, start=1):
            ends = {corners[n][0] for n in face}
            for name, place in (("S_LOW", 0), ("S_HIGH", end)):
                if ends == {place}:
                    self.faces[name].append(f"{number}, S{label}")

    @property
    def text(self) -> str:
        nodes = "".join(f"{n}, {x}, {y}, {z}\n" for n, (x, y, z) in self.places.items())
        rows = "\n".join(self.rows)
        return f"*NODE\n{nodes}*ELEMENT, TYPE={self.kind}, ELSET=E{self.first}\n{rows}\n"


def deck(master: Block, slave: Block, tie: str = "*TIE, NAME=T\nSLAVE, MASTER\n") -> str:
    sections = "".join(
        f"*SOLID SECTION, ELSET=E{block.first}, MATERIAL=M\n" for block in (master, slave)
    )
    surfaces = "*SURFACE, NAME=Master\n" + "\n".join(master.faces["S_HIGH"])
    surfaces += "\n*SURFACE, NAME=SLAVE\n" + "\n".join(slave.faces["S_LOW"]) + "\n"
    held = "".join(f"{node}, 1, 3\n" for node in sorted(master.start))
    return (
        f"{master.text}{slave.text}*MATERIAL, NAME=M\n*ELASTIC\n7e10, 0.3\n*DENSITY\n2700.\n"
        f"{sections}{surfaces}{tie}*BOUNDARY\n{held}*STEP\n*FREQUENCY\n{N_MODES}\n*END STEP\n"
    )


PAIRS = {
    "bricks on larger bricks": ("C3D8I", (3, 2, 1), "C3D8I", (3, 3, 2)),
    "bricks on tetrahedra": ("C3D10", (3, 2, 1), "C3D8I", (3, 3, 2)),
    "tetrahedra on quadratic bricks": ("C3D20", (2, 1, 1), "C3D10", (3, 2, 1)),
    "quadratic bricks on linear tetrahedra": ("C3D4", (3, 2, 2), "C3D20", (2, 3, 2)),
}


@needs_ccx
@pytest.mark.parametrize("name", PAIRS)
def test_slave_nodes_move_as_ccx_prints_them(name: str, tmp_path: Path) -> None:
    kind, cuts, other, finer = PAIRS[name]
    master, slave = Block(kind, cuts, 0.0, 0), Block(other, finer, 30.0, 1000)
    solver, modal, matrices, seen = both(deck(master, slave), tmp_path)
    assert solver.deck.summary.matrix_shapes
    assert not seen.unknown.any()
    eigenvalues, shapes = solved(matrices, N_MODES)
    np.testing.assert_allclose(eigenvalues, modal.eigenvalues, rtol=1e-6)
    tied = np.isin(modal.modes.nodes, list(slave.start))
    found, native = (seen.matrix @ shapes)[tied], np.real(modal.modes.mode_shapes)[tied]
    assert tied.sum() >= 3 * 12
    gaps = np.diff(eigenvalues) / eigenvalues[1:] > 1e-3
    alone = np.concatenate([[True], gaps]) & np.concatenate([gaps, [False]])
    assert alone.sum() >= 3
    for mode in np.flatnonzero(alone):
        mine, his = found[:, mode], native[:, mode]
        mine = mine * np.sign(mine @ his)
        # Seven printed digits of the largest motion.
        np.testing.assert_allclose(mine, his, rtol=0.0, atol=2e-6 * np.abs(his).max())


def read(tmp_path: Path, text: str) -> CalculixModel:
    (tmp_path / "deck.inp").write_text(text)
    model = calculix_solver(tmp_path / "deck.inp", ()).deck
    assert isinstance(model, CalculixModel)
    return model


def test_weights_reproduce_linear_fields(tmp_path: Path) -> None:
    """Whatever the face: a slave node is at the sum of its master nodes' places."""
    master, slave = Block("C3D20", (2, 2, 1), 0.0, 0), Block("C3D10", (2, 3, 2), 30.0, 1000)
    ties = read_constraints(read(tmp_path, deck(master, slave)).structure)
    assert ties.followed
    assert {node for node, _ in ties.dependent} == slave.start
    for node in slave.start:
        terms = ties.dependent[node, 2]
        assert sum(terms.values()) == pytest.approx(1.0, abs=1e-12)
        place = sum(f * np.array(master.places[n]) for (n, _), f in terms.items())
        assert place == pytest.approx(np.array(slave.places[node]), abs=1e-9)


@pytest.mark.parametrize(
    ("tie", "gap", "followed"),
    [
        ("*TIE, NAME=T\nSLAVE, MASTER\n", 0.5, False),  # ccx's own tolerance decides
        ("*TIE, NAME=T, POSITION TOLERANCE=1.\nSLAVE, MASTER\n", 0.5, True),
        ("*TIE, NAME=T, POSITION TOLERANCE=0.51\nSLAVE, MASTER\n", 0.5, False),  # too near to say
        ("*TIE, NAME=T, CYCLIC SYMMETRY\nSLAVE, MASTER\n", 0.0, False),
        ("*TIE, NAME=T\nSLAVE, NOWHERE\n", 0.0, False),
    ],
)
def test_what_is_not_surely_tied_is_not_followed(
    tie: str, gap: float, followed: bool, tmp_path: Path
) -> None:
    blocks = Block("C3D8I", (2, 2, 1), 0.0, 0), Block("C3D8I", (2, 1, 1), 30.0 + gap, 1000)
    model = read(tmp_path, deck(*blocks, tie))
    assert read_constraints(model.structure).followed == followed
    assert model.summary.matrix_shapes == followed
