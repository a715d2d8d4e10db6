"""How often, and how accurately, a test in its own axes is aligned with its model.

    python -m benchmarks.alignment [--poses 30] [--only bracket]

The structures are a bracket with a rib (tetrahedra by gmsh), a plate with ribs (shells), a frame
(beams) and the GARTEUR aircraft (shells), each with 24, 60 and 150 sensors in random poses, test
lengths in metres and a known scale. Sensors are at nodes, anywhere on the surface, or measured by
tape (within 1 % of the structure's size). A pose is right if all sensor positions are: within 1e-3
of their spacing if exact, within 3 % of the size by tape. The command prints a Markdown table:
"asked" counts fits that reported several poses, "slide" those whose positions are off by no more
than the reported uncertainty. Wrong fits are listed on standard error.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from benchmarks.mesher import gmsh_model
from numpy.random import Generator
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from modetune.configs.garteur.shell import shell_model
from modetune.core.measurement.closest_points import SurfacePoints
from modetune.core.measurement.registration import Registration, register
from modetune.core.mesh import CellKind, Cells, Mesh
from modetune.core.modes import Floats, Integers
from modetune.core.surface import facets

COUNTS = (24, 60, 150)


def mesh_of(places: Floats, *blocks: tuple[CellKind, Integers]) -> Mesh:
    """A mesh of places (n, 3) and cells by rows of them."""
    cells, first = [], 1
    for kind, rows in blocks:
        cells.append(Cells(kind, np.arange(first, first + len(rows)), np.asarray(rows) + 1))
        first += len(rows)
    return Mesh(np.arange(1, len(places) + 1), places, tuple(cells))


def bracket() -> Mesh:
    """An angle of two plates with a rib to one side of its middle and two holes, mm."""
    with gmsh_model() as gmsh:
        shape = gmsh.model.occ
        parts = [
            (3, shape.addBox(0, 0, 0, 120, 80, 8)),
            (3, shape.addBox(0, 0, 0, 8, 80, 90)),
        ]
        corners = [shape.addPoint(x, 25, z) for x, z in ((8, 8), (70, 8), (8, 60))]
        sides = [shape.addLine(corners[i], corners[(i + 1) % 3]) for i in range(3)]
        face = shape.addPlaneSurface([shape.addCurveLoop(sides)])
        parts += [item for item in shape.extrude([(2, face)], 0, 6, 0) if item[0] == 3]
        body, _ = shape.fuse(parts[:1], parts[1:])
        holes = [(3, shape.addCylinder(x, y, -1, 0, 0, 10, 6)) for x, y in ((95, 20), (95, 60))]
        shape.cut(body, holes)
        shape.synchronize()
        gmsh.option.setNumber("Mesh.MeshSizeMax", 9.0)
        gmsh.model.mesh.generate(3)
        gmsh.model.mesh.setOrder(2)
        numbers, places, _ = gmsh.model.mesh.getNodes()
        row = {int(number): place for place, number in enumerate(numbers)}
        table = np.reshape(gmsh.model.mesh.getElements(3)[2][0], (-1, 10)).astype(int)
    table = np.vectorize(row.__getitem__)(table)[:, [0, 1, 2, 3, 4, 5, 6, 7, 9, 8]]
    return mesh_of(np.reshape(places, (-1, 3)), ("tetra10", table))


def sheet(
    x: Floats, y: Floats, corner: Floats, along: Floats, across: Floats
) -> tuple[Floats, Integers]:
    """Places and quadrilaterals of a flat sheet."""
    a, b = (axis.ravel() for axis in np.meshgrid(x, y, indexing="ij"))
    number = np.arange(a.size).reshape(len(x), len(y))
    quads = [number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]]
    places = corner + a[:, None] * along + b[:, None] * across
    return places, np.stack([part.ravel() for part in quads], axis=1)


def merged(pieces: list[tuple[Floats, Integers]], kind: CellKind) -> Mesh:
    """Pieces as one mesh, nodes in one place joined."""
    places = np.concatenate([piece[0] for piece in pieces])
    shifts = np.cumsum([0, *(len(piece[0]) for piece in pieces[:-1])])
    cells = np.concatenate([piece[1] + shift for piece, shift in zip(pieces, shifts, strict=True)])
    _, first, back = np.unique(np.round(places, 6), axis=0, return_index=True, return_inverse=True)
    return mesh_of(places[first], (kind, back.reshape(-1)[cells]))


def ribbed_plate() -> Mesh:
    """A plate with two ribs along it and one across, none in the middle, mm."""
    ex, ey, ez = np.eye(3)
    x, y, z = np.linspace(0, 600, 31), np.linspace(0, 400, 21), np.linspace(0, 40, 3)
    zero = np.zeros(3)
    return merged(
        [
            sheet(x, y, zero, ex, ey),
            sheet(x, z, 80.0 * ey, ex, ez),
            sheet(x, z, 300.0 * ey, ex, ez),
            sheet(y, z, 180.0 * ex, ey, ez),
        ],
        "quad",
    )


def frame() -> Mesh:
    """A frame of two storeys with a lean-to and one diagonal, beams of 12 elements, mm."""
    places = {
        (i, j, k): np.array([900.0 * i, 600.0 * j, (0.0, 800.0, 1400.0)[k]])
        for i in range(2)
        for j in range(2)
        for k in range(3)
    }
    ends = [
        (places[i, j, k], places[i, j, k + 1]) for i in range(2) for j in range(2) for k in (0, 1)
    ]
    for k in (1, 2):
        corners = [places[i, j, k] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))]
        ends += [(corners[n], corners[(n + 1) % 4]) for n in range(4)]
    ends += [(places[0, 0, 0], places[1, 0, 1]), (places[1, 1, 1], np.array([1400.0, 600.0, 0.0]))]
    beams = np.column_stack([np.arange(12), np.arange(1, 13)])
    pieces = [(a + np.linspace(0, 1, 13)[:, None] * (b - a), beams) for a, b in ends]
    return merged(pieces, "line")


def garteur() -> Mesh:
    """The GARTEUR SM-AG19 aircraft of shells, mm."""
    model = shell_model()
    return mesh_of(model.nodes, ("quad", model.quads))


STRUCTURES: dict[str, Callable[[], Mesh]] = {
    "bracket": bracket, "ribbed plate": ribbed_plate, "frame": frame, "aircraft": garteur,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Trial:
    """A pose that was looked for. error: largest error of a sensor's place, in their spacings."""

    error: float
    size_error: float
    seconds: float
    found: Registration


def on_surface(corners: Floats, count: int, rng: Generator) -> Floats:
    """Random points of triangles, or of beams, evenly over their area or length."""
    sides = corners[:, 1:] - corners[:, :1]
    areas = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    areas = areas if areas.sum() > 0 else np.linalg.norm(sides[:, 0], axis=1)
    rows = rng.choice(len(corners), count, p=areas / areas.sum())
    u, v = rng.random((2, count))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    along = u[:, None] * sides[rows, 0] + v[:, None] * sides[rows, 1]
    return np.asarray(corners[rows, 0] + along)


def sensors(mesh: Mesh, corners: Floats, kind: str, count: int, rng: Generator) -> Floats:
    """Places of sensors in the model, mm."""
    if kind == "surface":
        return on_surface(corners, count, rng)
    outside = np.unique(corners.reshape(-1, 3), axis=0)
    chosen = outside[rng.choice(len(outside), min(count, len(outside)), replace=False)]
    return np.asarray(chosen)


def trial(
    mesh: Mesh, surface: SurfacePoints, places: Floats, deviation: float, rng: Generator
) -> Trial:
    """A random pose of sensors at places (n, 3), seen with errors."""
    rotation = Rotation.random(random_state=int(rng.integers(2**31))).as_matrix()
    size = float(np.linalg.norm(np.ptp(mesh.coordinates, axis=0)))
    seen = places + rng.normal(0.0, deviation * size / np.sqrt(3.0), places.shape)
    test = (seen - rng.uniform(-5e3, 5e3, 3)) @ rotation / 1000.0
    begin = time.process_time()
    found = register(test, surface, mesh.coordinates, 1000.0)
    seconds = time.process_time() - begin
    away = np.linalg.norm(found.best.apply(test) - seen, axis=1).max()
    spacing = float(np.median(KDTree(places).query(places, k=[2])[0]))
    return Trial(float(away / spacing), float(away / size), seconds, found)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.alignment")
    parser.add_argument("--poses", type=int, default=30)
    parser.add_argument("--only", choices=list(STRUCTURES))
    chosen = parser.parse_args()
    heads = ["structure", "places", *(f"{count} sensors" for count in COUNTS), "CPU s a pose"]
    sys.stdout.write(f"| {' | '.join(heads)} |\n|{' --- |' * len(heads)}\n")
    for name, make in STRUCTURES.items():
        if chosen.only not in (None, name):
            continue
        mesh = make()
        corners = facets(mesh)
        surface = SurfacePoints.of(corners)
        size = float(np.linalg.norm(np.ptp(mesh.coordinates, axis=0)))
        for kind, deviation in (("nodes", 0.0), ("surface", 0.0), ("tape", 0.01)):
            cells, seconds = [], []
            for count in COUNTS:
                right = asked = slid = 0
                for seed in range(chosen.poses):
                    rng = np.random.default_rng(1000 * count + seed)
                    places = sensors(mesh, corners, kind, count, rng)
                    one = trial(mesh, surface, places, deviation, rng)
                    good = one.size_error < 0.03 if deviation else one.error < 1e-3
                    certain = not one.found.others
                    told = one.size_error * size <= one.found.slides
                    right += good and certain
                    asked += not certain
                    slid += certain and not good and told
                    seconds.append(one.seconds)
                    if not (good and certain):
                        sys.stderr.write(
                            f"{name}, {kind}, {count} sensors, seed {seed}: places off by "
                            f"{one.error:.2g} spacings, {one.size_error:.2g} of the size; "
                            f"{len(one.found.others)} others, slides {one.found.slides:.3g}, "
                            f"left {one.found.best.rms:.3g}\n"
                        )
                wrong = chosen.poses - right - asked - slid
                cells.append(
                    f"{right} of {chosen.poses}"
                    + (f", {asked} asked" if asked else "")
                    + (f", {slid} slide" if slid else "")
                    + (f", {wrong} wrong" if wrong else "")
                )
            middle = f"{np.median(seconds):.1f}"
            sys.stdout.write(f"| {name} | {kind} | {' | '.join(cells)} | {middle} |\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
