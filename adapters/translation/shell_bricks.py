"""Shells with any membrane, bending, coupling and shear stiffness, as degenerated solids.

ccx expands its own shells to solids of one material and the shell's thickness, has no laminates
beside masses and springs, and no shell whose bending is not its membrane's. So the solids are
written here, and the motion of their nodes is tied to displacement u and rotation theta of the
shell's nodes (Ahmad, Irons and Zienkiewicz 1970). With n the element's normal and z along it,

    membrane brick: u + c theta x n            (the same for all z, strains e + c k)
    bending brick:  n (n . u) + z theta x n    (strains z k, transverse shear g)

of height h and in-plane laws A / h and 12 D / h^3 with shear H / h: their energies are those of a
unit of area of the shell, whatever h is. Coupling takes two membrane bricks, at c and -c, of
A / 2 + B / 2 c and A / 2 - B / 2 c, and c^2 A less in bending. Offsets are in c. The bricks are
C3D20R and C3D15, as ccx takes them for S8R and S6.

Each brick stands on the mean plane of its element, and nodes beside that plane carry it on arms:
rigid motion is exact for warped elements too. The mass moves with a membrane brick: as Nastran's
shells it has no inertia against rotation.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from modetune.adapters.translation.assembly import Assembly
from modetune.adapters.translation.bricks import (
    Brick,
    WrittenShells,
    bricks_of,
    law_key,
    material_lines,
    shape_of,
)
from modetune.adapters.translation.calculix_text import CalculixText, number_list
from modetune.adapters.translation.freedoms import Freedoms
from modetune.adapters.translation.masses import Shares
from modetune.adapters.translation.shell_rotations import hold_rest
from modetune.adapters.translation.shells import Edges, Shell
from modetune.core.modes import Floats, Integers

#: Height of the bricks as a share of the usual edge: what the comparison of masses sees of it, in
#: the inertia of a single element, is its square.
HEIGHT = 0.01
#: Digits that tell normals, levers and directions apart.
DIGITS = 9


def write_shells(
    model: Assembly,
    shells: Sequence[Shell],
    edges: Edges,
    held: set[int],
    groups: dict[str, Shares],
    densities: dict[Hashable, float],
) -> WrittenShells:
    """Add all shells of the model; after all else that is tied to their nodes.

    held: grid points that something besides shells holds. groups: of lumped masses, with densities
    of their sources.
    """
    height = HEIGHT * _usual_edge(shells, model.builder) if shells else 0.0
    size, lumped = model.builder.size, model.lumped_properties
    written = WrittenShells(height, size, model.wtmass, lumped, {}, groups, densities)
    if not shells:
        return written
    turned = frozenset(model.freedoms.turn_nodes)
    writer = BrickWriter(model.builder, height, model.wtmass)
    bricks: dict[Hashable, list[Brick]] = {}
    for shell in shells:
        key, pid = law_key(shell.element), shell.element.pid
        if key not in bricks:
            parts = bricks[key] = bricks_of(shell, height, pid in lumped)
            names = tuple(writer.material(pid, brick) for brick in parts)
            written.laws[key] = (shell, names, shape_of(shell, parts))
        for brick, name in zip(bricks[key], written.laws[key][1], strict=True):
            writer.add(shell, brick, name, model.sets_of(shell.element))
    writer.write(model.freedoms)
    hold_rest(shells, edges, model.freedoms, turned, held)
    return written


def _usual_edge(shells: Sequence[Shell], builder: CalculixText) -> float:
    edges = [builder.coordinates[s.nodes[1]] - builder.coordinates[s.nodes[0]] for s in shells]
    return float(np.median(np.linalg.norm(edges, axis=1)))


class BrickWriter:
    """Writes bricks; those of one plane share nodes, those of one law and direction a section."""

    def __init__(self, builder: CalculixText, height: float, wtmass: float) -> None:
        self._builder = builder
        self.height = height
        self._wtmass = wtmass
        self._bricks: list[tuple[Shell, float, str, Sequence[str]]] = []
        self._materials: dict[tuple[int, tuple[str, ...]], str] = {}
        self._sections: dict[tuple[object, ...], str] = {}

    def material(self, pid: int, brick: Brick) -> str:
        """The name of a brick's material; of each property its own, whose numbers may change."""
        lines = material_lines(brick, self._wtmass)
        key = (pid, lines)
        if key not in self._materials:
            self._materials[key] = f"L{len(self._materials) + 1}"
            self._builder.material(self._materials[key], lines)
        return self._materials[key]

    def add(self, shell: Shell, brick: Brick, material: str, sets: Sequence[str]) -> None:
        """Note one brick of a shell, of these sets."""
        lever = np.nan if brick.lever is None else brick.lever
        self._bricks.append((shell, lever, material, sets))

    def write(self, freedoms: Freedoms) -> None:
        """Write all bricks, and the equations of their nodes."""
        by_corners = [[b for b in self._bricks if len(b[0].nodes) == 2 * n] for n in (4, 3)]
        there = [bricks for bricks in by_corners if bricks]
        corners = _joined([self._corners(bricks) for bricks in there])
        numbers = self._numbers(corners, freedoms)
        stop = 0
        for bricks in there:
            kind, count = ("C3D20R", 20) if len(bricks[0][0].nodes) == 8 else ("C3D15", 15)
            start, stop = stop, stop + count * len(bricks)
            sections = self._named_sections(bricks)
            nodes = numbers[start:stop].reshape(-1, count).tolist()
            for brick, row, section in zip(bricks, nodes, sections, strict=True):
                self._builder.new_element(kind, row, (*brick[3], section))

    def _corners(self, bricks: Sequence[tuple[Shell, float, str, Sequence[str]]]) -> BrickPoints:
        """The corners and edge points of bricks on shells of equally many nodes."""
        nodes = np.array([shell.nodes for shell, *_ in bricks])
        count = nodes.shape[1] // 2
        normals = np.array([shell.normal for shell, *_ in bricks])
        beside = np.array([[self._builder.coordinates[n] for n in row] for row in nodes.tolist()])
        beside -= beside[:, :count].mean(axis=1, keepdims=True)
        down = -np.einsum("snx,sx->sn", beside, normals)
        down[np.abs(down) < 1e-9 * self._builder.size] = 0.0
        low, high = -self.height / 2.0, self.height / 2.0
        rows = [(low, 0), (high, 0), (low, 1), (high, 1), (0.0, 0)]
        places = [p for _, m in rows for p in range(m * count, (m + 1) * count)]
        heights = np.repeat([z for z, _ in rows], count)
        levers = np.array([lever for _, lever, *_ in bricks])
        return BrickPoints(
            nodes[:, places].ravel(),
            np.repeat(np.round(normals, DIGITS) + 0.0, len(places), axis=0),
            np.round(down, 12)[:, places].ravel() + 0.0,
            np.tile(heights, len(bricks)),
            np.repeat(levers, len(places)),
        )

    def _numbers(self, corners: BrickPoints, freedoms: Freedoms) -> Integers:
        """Make and tie the bricks' nodes, one for all corners that are alike; returns theirs."""
        first, same = corners.alike()
        corners = corners.taken(first)
        coordinates = self._builder.coordinates
        places = np.array([coordinates[node] for node in corners.nodes.tolist()])
        away = corners.down + corners.heights + np.nan_to_num(corners.levers)
        arms = corners.arms
        turning = np.zeros(len(places), dtype=np.int64)
        for row in np.flatnonzero(arms).tolist():
            rotations = freedoms.rotations(int(corners.nodes[row]))
            turning[row] = rotations[0][0] if rotations else 0
        numbers = self._builder.new_nodes(places + away[:, None] * corners.normals)
        # Factors of the node itself, then of displacements and rotations: (nodes, axes, 7).
        factors = np.zeros((len(places), 3, 7))
        factors[:, :, 0] = 1.0
        bends = np.isnan(corners.levers)
        whole = np.einsum("ni,nj->nij", corners.normals, corners.normals)
        factors[:, :, 1:4] = -np.where(bends[:, None, None], whole, np.eye(3))
        # Displacement along each basic axis: of theta x n it is theta . (n x axis).
        x, y, z = (arms * (turning > 0))[None, :] * corners.normals.T
        factors[:, 0, 5], factors[:, 0, 6] = -z, y
        factors[:, 1, 4], factors[:, 1, 6] = z, -x
        factors[:, 2, 4], factors[:, 2, 5] = -y, x
        owners = np.stack([numbers, *3 * [corners.nodes], *3 * [turning]], axis=1)
        self._builder.equations(owners, factors)
        return numbers[same]

    def _named_sections(
        self, bricks: Sequence[tuple[Shell, float, str, Sequence[str]]]
    ) -> list[str]:
        """The sections of bricks, by material and direction; those that are new are written."""
        first = np.array([shell.axis for shell, *_ in bricks])
        normals = np.round([shell.normal for shell, *_ in bricks], DIGITS) + 0.0
        axes = np.round(np.hstack([first, np.cross(normals, first)]), DIGITS) + 0.0
        keys = [(brick[2], *row) for brick, row in zip(bricks, axes.tolist(), strict=True)]
        for key in keys:
            if key not in self._sections:
                name = self._sections[key] = f"S{len(self._sections) + 1}"
                head = f"*ORIENTATION, NAME=O{name}, SYSTEM=RECTANGULAR"
                self._builder.card([head, number_list(key[1:])])
                self._builder.section(
                    [f"*SOLID SECTION, ELSET={name}, MATERIAL={key[0]}, ORIENTATION=O{name}"]
                )
        return [self._sections[key] for key in keys]


@dataclass(frozen=True, slots=True)
class BrickPoints:
    """BrickPoints and edge points of bricks, (n,) each, normals (n, 3).

    down: from the shell's node to the mean plane; heights: over it; levers: NaN of bending bricks.
    """

    nodes: Integers
    normals: Floats
    down: Floats
    heights: Floats
    levers: Floats

    @property
    def arms(self) -> Floats:
        """What rotations are multiplied with."""
        bends = np.isnan(self.levers)
        return np.where(bends, self.heights, np.round(self.down + self.levers, 12)) + 0.0

    def columns(self) -> tuple[Integers, Floats, Floats, Floats, Floats]:
        return self.nodes, self.normals, self.down, self.heights, self.levers

    def taken(self, rows: Integers) -> BrickPoints:
        own = (self.normals, self.down, self.heights, self.levers)
        return BrickPoints(self.nodes[rows], *(column[rows] for column in own))

    def alike(self) -> tuple[Integers, Integers]:
        """The first rows of those that are alike, ascending, and the place there of each row."""
        bends = np.isnan(self.levers)
        key = np.zeros(len(self.nodes), dtype=np.int64)
        for column in (self.nodes, *self.normals.T, self.down, self.heights, self.arms, bends):
            values, ids = np.unique(column, return_inverse=True)
            key = np.unique(key * len(values) + ids, return_inverse=True)[1]
        _, first, same = np.unique(key, return_index=True, return_inverse=True)
        order = np.argsort(first)
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        return first[order], rank[same]


def _joined(parts: Sequence[BrickPoints]) -> BrickPoints:
    columns = zip(*(part.columns() for part in parts), strict=True)
    return BrickPoints(*map(np.concatenate, columns))
