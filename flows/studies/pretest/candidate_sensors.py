"""Where sensors could sit on a model, and which way they could look."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from modetune.adapters.regular_file import read_regular
from modetune.adapters.solver import Solver
from modetune.core.errors import CampaignError
from modetune.core.mesh import Mesh, global_shapes
from modetune.core.modes import COMPONENTS, Floats, Integers, ModeSet
from modetune.core.planning.sensor_placement import Bools, Spacing
from modetune.core.surface import display_surface
from modetune.flows.studies.pretest.request import Directions

#: Candidates on the surface at most; a finer mesh is thinned evenly.
SURFACE_NODES = 4000


@dataclass(frozen=True, slots=True)
class CandidateSensors:
    """Places and directions at which sensors could be.

    nodes: (n,), a node may occur once for each direction; coordinates: (n, 3), the deck's length.
    directions: (n, n_directions, 3), unit vectors in global axes; three where three directions
    count as one sensor. labels: x, y, z, normal or xyz.
    """

    nodes: Integers
    coordinates: Floats
    directions: Floats
    labels: tuple[str, ...]

    @property
    def n(self) -> int:
        return self.nodes.size

    def take(self, chosen: Integers | Bools) -> CandidateSensors:
        """These candidates only, in their order."""
        rows = np.arange(self.n)[chosen]
        labels = tuple(self.labels[row] for row in rows.tolist())
        return CandidateSensors(
            self.nodes[rows], self.coordinates[rows], self.directions[rows], labels
        )

    def spacing(self, distance: float) -> Spacing:
        return Spacing(self.nodes, self.coordinates, distance)

    def rows(self, modes: ModeSet, mesh: Mesh) -> Floats:
        """Shapes along the candidates' directions, (n, n_directions, n_modes).

        modes: real, in the axes of the mesh's results; zero where a node has no result.
        """
        shapes = global_shapes(mesh, modes)[:, mesh.rows(self.nodes)]
        return np.asarray(np.einsum("knd,nrd->nrk", shapes, self.directions))

    def motion(self, modes: ModeSet, mesh: Mesh) -> tuple[Integers, Floats, Floats]:
        """Nodes (m,), each once, their coordinates, and lengths of motion (m, n_modes) there."""
        nodes, first = np.unique(self.nodes, return_index=True)
        shapes = global_shapes(mesh, modes)[:, mesh.rows(nodes)]
        return nodes, self.coordinates[first], np.linalg.norm(shapes, axis=2).T


def placed_mesh(solver: Solver) -> Mesh:
    """The model's mesh; of matrices, which have no places, nodes that all lie at the origin."""
    mesh = solver.deck.mesh()
    if mesh.nodes.size:
        return mesh
    nodes = np.array(sorted(solver.deck.summary.node_ids), dtype=np.int64)
    return Mesh(nodes, np.zeros((nodes.size, 3)), ())


def candidates_of(
    solver: Solver, asked: str, directions: Directions, triaxial: bool
) -> CandidateSensors:
    """The candidates of a model. Raises CampaignError.

    asked: surface, all, or the path of a file with a node number in front of each line.
    """
    mesh = placed_mesh(solver)
    nodes = _nodes(mesh, asked)
    if directions == "normal":
        if triaxial:
            raise CampaignError("--triaxial means all three directions; leave out --directions")
        return _along_normals(mesh, nodes)
    axes = [axis for axis in range(3) if axis + 1 in solver.deck.summary.components]
    if not axes:
        raise CampaignError("the model's results hold no translations, which sensors measure")
    if triaxial:
        frames = np.tile(np.eye(3)[axes], (nodes.size, 1, 1))
        label = "".join(COMPONENTS[axis] for axis in axes)
        return CandidateSensors(
            nodes, mesh.coordinates[mesh.rows(nodes)], frames, (label,) * nodes.size
        )
    many = np.repeat(nodes, len(axes))
    single = np.tile(np.eye(3)[axes], (nodes.size, 1))[:, None, :]
    labels = tuple(COMPONENTS[axis] for axis in axes) * nodes.size
    return CandidateSensors(many, mesh.coordinates[mesh.rows(many)], single, labels)


def _nodes(mesh: Mesh, asked: str) -> Integers:
    if asked == "all":
        return mesh.nodes
    if asked == "surface":
        return display_surface(mesh, SURFACE_NODES).nodes if mesh.cells else mesh.nodes
    return _listed_nodes(Path(asked), mesh)


def _listed_nodes(path: Path, mesh: Mesh) -> Integers:
    """Node numbers in the first column of a file. Raises CampaignError with all problems."""
    try:
        lines = read_regular(path).decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CampaignError(
            f"--candidates {path}: expected surface, all, or a file of node numbers, and there is "
            "no such file that can be read"
        ) from error
    known, found, problems = set(mesh.nodes.tolist()), [], []
    for number, line in enumerate(lines, start=1):
        name = line.split(",")[0].strip()
        if not name or name.startswith("#") or name in ("node", "metres", "line", "face"):
            continue
        if not (name.isascii() and name.isdecimal()):
            problems.append(f"{path}, line {number}: {name!r} where a node number must be")
        elif int(name) not in known:
            problems.append(f"{path}, line {number}: the model has no node {name} with results")
        else:
            found.append(int(name))
    if not found and not problems:
        problems.append(f"{path}: no node number in it")
    if problems:
        raise CampaignError(problems)
    return np.unique(np.array(found, dtype=np.int64))


def _along_normals(mesh: Mesh, nodes: Integers) -> CandidateSensors:
    """One direction at each node: out of the surface. Nodes within faces only have one."""
    skin = display_surface(mesh, max(mesh.nodes.size, 1))
    corners = skin.coordinates[skin.triangles]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros((skin.nodes.size, 3))
    for corner in range(3):
        np.add.at(normals, skin.triangles[:, corner], areas)
    lengths = np.linalg.norm(normals, axis=1)
    # Both sides of a sheet that is meshed twice cancel: no direction is left.
    good = lengths > 1e-6 * lengths.max(initial=0.0)
    inside = np.isin(skin.nodes, nodes) & good
    if not inside.any():
        raise CampaignError(
            "none of the candidates lies on a face of the model, so there is no normal to measure "
            "along; use --directions xyz"
        )
    units = normals[inside] / lengths[inside, None]
    found = skin.nodes[inside]
    return CandidateSensors(
        found, mesh.coordinates[mesh.rows(found)], units[:, None, :], ("normal",) * found.size
    )


def moving(candidates: CandidateSensors, rows: Floats) -> CandidateSensors:
    """Those that move in any mode at all. Raises CampaignError where none does."""
    size = np.abs(rows).max(axis=(1, 2))
    held = size > 1e-9 * size.max(initial=0.0)
    if not held.any():
        raise CampaignError("the model's results are zero at all candidates for sensors")
    return candidates if held.all() else replace(candidates.take(held))
