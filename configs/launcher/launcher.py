"""A launcher of a guided missile like that of the thesis's chapter 5.2, in any size.

What is published of the launcher is its kinds of elements (bricks of eight nodes, tetrahedra of
ten, shells of four and three), 964,396 nodes, ten subparts with a Young's modulus each, 26 sensors
and one material; its shape is in a picture only. This one is a design of our own: a base plate,
bolted down at its corners, carries two arms on feet, with gussets at their sides, before and behind
them; a fitting between the arms holds a box beam of 2.4 m with flanges, ribs and a sloped nose; on
top of it are two guides with stops. A cable duct on its right side alone couples sway and pitch. A
control unit lies across the guides on soft mounts: a point mass, with a spring along each axis to
either guide, whose local modes lie among those of the launcher.

All parts share the nodes where they touch. A shell that ends on a solid's face would turn there as
on a hinge, so shells lie on the solids that they belong to over several rows of nodes: feet on the
base, arms and the beam's bottom on the fitting, the beam's top under the guides. The fitting
is of tetrahedra with midside nodes. It meets shells alone, and shares its corner nodes with them;
the midside nodes between, which a linear shell does not have, are free. No equations tie parts.

x runs along the beam, y across, z up, z = 0 below the base; units mm, t, s (MPa). Nodes 1 to 26 are
the sensors in every size. CalculiX has S4 and S3 for QUAD4 and TRIA3, C3D8I for HEX8, and C3D10.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np

from modetune.configs.launcher.lattice import Floats, Integers, Lattice, LatticePart, Place, lattice

YOUNGS_MODULUS = 71_000.0
POISSONS_RATIO = 0.3
DENSITY = 2.81e-9
#: Thickness of each group of shells, mm; the other groups are solids.
THICKNESSES = {
    "ARMS": 10.0, "GUSSETS": 8.0, "RAIL_BOTTOM": 5.0, "RAIL_WEB": 4.0, "RAIL_TOP": 6.0,
    "RIBS": 4.0, "DUCT": 3.0,
}  # fmt: skip
GROUPS = (
    "BASE", "ARMS", "GUSSETS", "FITTING", "RAIL_BOTTOM", "RAIL_WEB", "RAIL_TOP", "RIBS", "DUCT",
    "GUIDES",
)  # fmt: skip
#: CalculiX's element by the number of its nodes.
KINDS = {8: "C3D8I", 10: "C3D10", 4: "S4", 3: "S3"}

X_STATIONS = (
    -1200.0, -1150.0, -1100.0, -900.0, -600.0, -300.0, -250.0, -150.0, -100.0, 0.0, 100.0, 150.0,
    250.0, 300.0, 600.0, 700.0, 750.0, 900.0, 1100.0, 1200.0,
)  # fmt: skip
Y_STATIONS = (
    -220.0, -180.0, -80.0, -60.0, -40.0, 0.0, 40.0, 60.0, 80.0, 180.0, 220.0,
)  # fmt: skip
Z_STATIONS = (0.0, 20.0, 120.0, 200.0, 300.0, 400.0, 415.0, 440.0)
RIBS_X = (-1200.0, -900.0, -600.0, -300.0, -150.0, 150.0, 300.0, 600.0, 900.0, 1100.0)
#: Bolted down: the base's lower face within so far of both edges of each corner, mm.
BOLTED = (50.0, 40.0)
BASE_LOW, BASE_HIGH = (-300.0, -220.0, 0.0), (300.0, 220.0, 20.0)

SENSORS: tuple[Place, ...] = (
    *((x, 0.0, 400.0) for x in (-1200.0, -900.0, -600.0, -300.0, 0.0, 300.0, 600.0, 900.0, 1200.0)),
    *((x, y, 300.0) for x in (-1200.0, -600.0, 600.0, 1100.0) for y in (-40.0, 60.0)),
    *((x, side * 80.0, 415.0) for x in (-1200.0, 1200.0) for side in (-1.0, 1.0)),
    *((x, side * 80.0, 300.0) for x in (-150.0, 150.0) for side in (-1.0, 1.0)),
    (0.0, 0.0, 20.0),
)

#: The control unit's mass, t, and where it is held: the guides' upper outer edges.
UNIT_MASS = 0.00029
UNIT_MOUNTS = ((600.0, -80.0, 415.0), (600.0, 80.0, 415.0))
#: Its frequencies along x, y and z on guides that do not move, Hz.
UNIT_HZ = (86.5, 57.32, 79.29)

#: Degrees of freedom at six a node, as Nastran counts them, that the generator was tried between.
LEAST_DOF, MOST_DOF = 18_000, 5_900_000


@dataclass(frozen=True, slots=True)
class LauncherMesh:
    """Length that the elements' edges have at most about, mm."""

    size: float


#: 3,653 nodes, 21,918 degrees of freedom, for tests.
COARSE = LauncherMesh(39.0)
#: 16,267 nodes, 97,602 degrees of freedom, for campaigns.
FINE = LauncherMesh(15.4)
MESHES = {"coarse": COARSE, "fine": FINE}


@dataclass(frozen=True, slots=True)
class LauncherModel:
    """nodes: (n_nodes, 3), mm, numbered from 1, the sensors first; elements: node numbers of each
    group's elements, an array (n, nodes an element) a kind; bolted: (n,) node numbers."""

    nodes: Floats
    elements: dict[str, list[Integers]]
    bolted: Integers

    @property
    def n_elements(self) -> int:
        """How many elements the groups have."""
        return sum(len(rows) for kinds in self.elements.values() for rows in kinds)


def _sided(group: str, low: Place, high: Place, corner: Place | None = None) -> list[LatticePart]:
    """A part and its mirror image about the plane y = 0."""

    def mirrored(place: Place) -> Place:
        return (place[0], -place[1], place[2])

    other = LatticePart(
        group,
        (low[0], -high[1], low[2]),
        (high[0], -low[1], high[2]),
        square_corner=None if corner is None else mirrored(corner),
    )
    return [LatticePart(group, low, high, square_corner=corner), other]


def parts() -> list[LatticePart]:
    """The launcher's parts."""
    found = [
        LatticePart("BASE", BASE_LOW, BASE_HIGH),
        *_sided("ARMS", (-150.0, 80.0, 20.0), (150.0, 80.0, 300.0)),
        *_sided("ARMS", (-250.0, 40.0, 20.0), (250.0, 180.0, 20.0)),
        LatticePart("FITTING", (-100.0, -80.0, 200.0), (100.0, 80.0, 300.0), tetrahedra=True),
        LatticePart("RAIL_BOTTOM", (-1200.0, -40.0, 300.0), (1100.0, 60.0, 300.0)),
        *_sided("RAIL_WEB", (-1200.0, 40.0, 300.0), (1100.0, 40.0, 400.0)),
        *_sided("RAIL_WEB", (1100.0, 40.0, 300.0), (1200.0, 40.0, 400.0), (1100.0, 40.0, 400.0)),
        LatticePart("RAIL_TOP", (-1200.0, -80.0, 400.0), (1200.0, 80.0, 400.0)),
        *(LatticePart("RIBS", (x, -40.0, 300.0), (x, 40.0, 400.0)) for x in RIBS_X),
        LatticePart("DUCT", (-900.0, 60.0, 300.0), (900.0, 60.0, 400.0)),
        *_sided("GUIDES", (-1200.0, 60.0, 400.0), (1200.0, 80.0, 415.0)),
        *_sided("GUIDES", (-1150.0, 60.0, 415.0), (-1100.0, 80.0, 440.0)),
        *_sided("GUIDES", (700.0, 60.0, 415.0), (750.0, 80.0, 440.0)),
    ]
    for x in (-100.0, 100.0):
        found += _sided("GUSSETS", (x, 80.0, 20.0), (x, 180.0, 120.0), (x, 80.0, 20.0))
    for low, high, corner in ((-250.0, -150.0, -150.0), (150.0, 250.0, 150.0)):
        found += _sided("GUSSETS", (low, 80.0, 20.0), (high, 80.0, 120.0), (corner, 80.0, 20.0))
    return found


def _lattice(mesh: LauncherMesh) -> Lattice:
    return lattice((X_STATIONS, Y_STATIONS, Z_STATIONS), mesh.size)


def count_nodes(mesh: LauncherMesh) -> int:
    """How many nodes the launcher has, without its elements."""
    points = _lattice(mesh)
    return int(np.unique(np.concatenate([points.nodes(part) for part in parts()])).size)


def mesh_of(degrees_of_freedom: int) -> LauncherMesh:
    """The mesh whose degrees of freedom, six a node, are next to the wanted number.

    Raises ValueError outside of LEAST_DOF to MOST_DOF.
    """
    if not LEAST_DOF <= degrees_of_freedom <= MOST_DOF:
        raise ValueError(
            f"{degrees_of_freedom} degrees of freedom are wanted; the launcher is made with "
            f"{LEAST_DOF} to {MOST_DOF}"
        )
    wanted = degrees_of_freedom / 6
    fine, coarse = 2.0, 60.0
    while coarse - fine > 1e-3 * fine:
        middle = (fine * coarse) ** 0.5
        fine, coarse = (
            (middle, coarse) if count_nodes(LauncherMesh(middle)) > wanted else (fine, middle)
        )
    nearest = min(fine, coarse, key=lambda size: abs(count_nodes(LauncherMesh(size)) - wanted))
    return LauncherMesh(nearest)


def launcher(mesh: LauncherMesh) -> LauncherModel:
    """The launcher's nodes and elements."""
    return assembled([(parts(), _lattice(mesh))])


def assembled(bodies: Sequence[tuple[Sequence[LatticePart], Lattice]]) -> LauncherModel:
    """Return nodes and elements of bodies, each on its own lattice, which share no nodes.

    A sensor is on the first body that has a node there.
    """
    places: list[Floats] = []
    named = [part.group for body, _ in bodies for part in body]
    known = [group for group in GROUPS if group in named]
    by_group: dict[str, list[Integers]] = {group: [] for group in dict.fromkeys([*known, *named])}
    count = 0
    for body, points in bodies:
        found = [(part.group, points.elements(part)) for part in body]
        used = np.unique(np.concatenate([rows.ravel() for _, kinds in found for rows in kinds]))
        for group, kinds in found:
            at = [np.searchsorted(used, rows) + count for rows in kinds]
            by_group[group] = by_group.get(group, []) + at
        places.append(points.coordinates(used).round(6))
        count += used.size
    nodes = np.concatenate(places)
    first = np.array([node_at(nodes, place) for place in SENSORS]) - 1
    order = np.concatenate([first, np.setdiff1d(np.arange(count), first)])
    numbers = np.empty(count, dtype=np.int64)
    numbers[order] = np.arange(1, count + 1)
    nodes = nodes[order]
    elements = {
        group: [numbers[rows] for rows in _joined(kinds)] for group, kinds in by_group.items()
    }
    at_edges = [
        np.abs(nodes[:, axis]) >= BASE_HIGH[axis] - BOLTED[axis] - 1e-6 for axis in range(2)
    ]
    bolted = np.flatnonzero((nodes[:, 2] == 0.0) & at_edges[0] & at_edges[1]) + 1
    return LauncherModel(nodes, elements, bolted)


def _joined(arrays: list[Integers]) -> list[Integers]:
    """One array a kind of element."""
    widths = sorted({array.shape[1] for array in arrays}, reverse=True)
    return [np.concatenate([a for a in arrays if a.shape[1] == width]) for width in widths]


def write_deck(file: BinaryIO, mesh: LauncherMesh, unit: bool = True) -> None:
    """Write the launcher as a complete CalculiX deck, bolted down, first 13 modes.

    unit: whether the control unit lies on it.
    """
    model = launcher(mesh)
    more = _control_unit(model) if unit else []
    write_model(file, model, dict.fromkeys(GROUPS, 1.0), THICKNESSES, more)


def _control_unit(model: LauncherModel) -> list[str]:
    """The control unit's node, the last one, its mass, and its springs."""
    guides = [node_at(model.nodes, place) for place in UNIT_MOUNTS]
    own, element = len(model.nodes) + 1, model.n_elements + 1
    middle = np.mean(UNIT_MOUNTS, axis=0)
    lines = ["*NODE", ", ".join(map(str, [own, *middle.tolist()]))]
    lines += ["*ELEMENT, TYPE=MASS, ELSET=UNIT", f"{element}, {own}", "*MASS, ELSET=UNIT"]
    lines.append(f"{UNIT_MASS}")
    for axis, hz in enumerate(UNIT_HZ, 1):
        stiffness = UNIT_MASS * (2.0 * np.pi * hz) ** 2 / len(guides)
        name = f"MOUNTS_{axis}"
        lines.append(f"*ELEMENT, TYPE=SPRING2, ELSET={name}")
        lines += [f"{element + 2 * axis + k - 1}, {own}, {node}" for k, node in enumerate(guides)]
        lines += [f"*SPRING, ELSET={name}", f"{axis}, {axis}", f"{stiffness:.6f}"]
    return lines


def write_model(
    file: BinaryIO,
    model: LauncherModel,
    factors: Mapping[str, float],
    thicknesses: Mapping[str, float],
    more: Sequence[str],
) -> None:
    """Write a complete deck.

    factors: of each group, its modulus over YOUNGS_MODULUS; thicknesses: of those of shells, mm;
    more: lines below the elements.
    """
    file.write(b"*HEADING\nLauncher of a guided missile; units mm, t, s, MPa\n*NODE, NSET=NALL\n")
    _write_rows(file, np.arange(1, len(model.nodes) + 1), model.nodes)
    first = 1
    for group, arrays in model.elements.items():
        for rows in arrays:
            file.write(f"*ELEMENT, TYPE={KINDS[rows.shape[1]]}, ELSET={group}\n".encode())
            _write_rows(file, np.arange(first, first + len(rows)), rows)
            first += len(rows)
    file.write(b"*NSET, NSET=BOLTED\n")
    _write_rows(file, model.bolted, np.empty((model.bolted.size, 0)))
    file.write("\n".join([*more, *_properties(factors, thicknesses)]).encode())


def node_at(nodes: Floats, place: Place) -> int:
    """Number of the node next to a place."""
    return int(np.argmin(np.abs(nodes - place).sum(axis=1))) + 1


def _write_rows(file: BinaryIO, numbers: Integers, columns: Floats | Integers) -> None:
    """Lines of a number and what belongs to it, some hundred thousand at a time."""
    import polars  # a quarter of the time in which another case starts

    for start in range(0, numbers.size, 200_000):
        part = slice(start, start + 200_000)
        table = [numbers[part], *columns[part].T]
        frame = polars.DataFrame({str(i): np.ascontiguousarray(c) for i, c in enumerate(table)})
        frame.write_csv(file, include_header=False)


def _properties(factors: Mapping[str, float], thicknesses: Mapping[str, float]) -> Iterator[str]:
    """Lines of materials, sections, supports and the step."""
    for group, factor in factors.items():
        modulus = YOUNGS_MODULUS * factor
        yield from (f"*MATERIAL, NAME={group}", "*ELASTIC", f"{modulus}, {POISSONS_RATIO}")
        yield from ("*DENSITY", f"{DENSITY}")
        if group in thicknesses:
            yield f"*SHELL SECTION, ELSET={group}, MATERIAL={group}"
            yield f"{thicknesses[group]}"
        else:
            yield f"*SOLID SECTION, ELSET={group}, MATERIAL={group}"
    yield from ("*BOUNDARY", "BOLTED, 1, 3")
    yield from ("*STEP", "*FREQUENCY", "13", "*NODE FILE", "U", "*END STEP", "")


def calculix_deck(mesh: LauncherMesh) -> str:
    """The launcher as a complete CalculiX deck."""
    file = BytesIO()
    write_deck(file, mesh)
    return file.getvalue().decode()


def write_decks(folder: Path) -> None:
    """Write launcher_coarse.inp and launcher_fine.inp."""
    for name, mesh in MESHES.items():
        with (folder / f"launcher_{name}.inp").open("wb") as file:
            write_deck(file, mesh)


if __name__ == "__main__":
    with Path(sys.argv[1]).open("wb") as target:
        write_deck(target, mesh_of(int(sys.argv[2])))
