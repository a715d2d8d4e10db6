"""The GARTEUR SM-AG19 testbed as shells: a Nastran deck from its published dimensions.

The aluminium aircraft of `aircraft.py` (Balmes and Wright 1997), here with all that was bolted or
bonded to it: every part is the mid-plane of its plate, plates meet in common nodes.

    fuselage    1500 x 150 mm, 50 mm thick, in the plane y = 0
    plate       steel, 140 (along x) x 70 x 16 mm, between fuselage and wing; 26 mm with the wing
    pylon       joins the fuselage's top (z = 75) to the wing's mid-plane (z = 96)
    wing        2000 x 100 x 10 mm, its middle 600 mm from the nose
    layer       aluminium, 1.1 mm, on 1.1 mm of viscoelastic tape, on the rear 76.2 mm of the chord
                over 1700 mm of the span: a property of wing and layer together
    drums       400 x 100 x 10 mm along the tips, drawn in the wing's plane
    drum joint  where drum and wing are bolted together, 20 mm
    fin         300 x 100 x 10 mm;  tailplane 400 x 100 x 10 mm
    masses      0.2 kg at the inner front of each drum, 0.5 kg where fin and tailplane meet

x runs from nose to tail, y to starboard, z up, z = 0 on the fuselage's axis; units mm, t, s (MPa).
Every property has its own material, of the same number, so that each can be updated alone.
Grid points of sensors keep their numbers (SENSORS) whatever the mesh.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

ALUMINIUM = 72_000.0
POISSONS_RATIO = 0.33
#: Published: 2700 kg/m3 and a nominal mass of 44 kg, which only 2800 give (bolts and screws).
DENSITY = 2.8e-9
STEEL = 210_000.0
#: Steel (16 mm) and aluminium (10 mm) side by side, in proportion to their thickness.
PLATE_AND_WING = (16.0 * STEEL + 10.0 * ALUMINIUM) / 26.0
#: Material axis of an orthotropic property: spanwise, where an element's first side is chordwise.
SPANWISE = 90.0


@dataclass(frozen=True, slots=True)
class Property:
    """A PSHELL and the material of the same number. thickness: mm; modulus: MPa; density: t/mm3.

    across: chordwise modulus and shear modulus, relative to an isotropic material's; where it is
    not 1 the material is a MAT8 with its first axis spanwise.
    """

    number: int
    name: str
    thickness: float
    modulus: float = ALUMINIUM
    density: float = DENSITY
    across: float = 1.0


FUSELAGE = Property(1, "FUSELAGE", 50.0)
WING = Property(2, "WING", 10.0)
#: 28.0 + 3.1 + 1.1 kg/m2 of wing, layer and tape (1000 kg/m3). The stretching stiffness of wing and
#: layer is that of 11.1 mm. In bending these 11.1 mm lie between a layer that slides (as 10.0 mm)
#: and a bonded one (11.5 mm), for the tape couples over the length of the wing. Over the width of
#: the layer it does not: torsion is the bare wing's, of 10.0 mm.
WING_WITH_LAYER = Property(3, "WING WITH LAYER", 11.1, density=2.9e-9, across=(10.0 / 11.1) ** 3)
DRUMS = Property(4, "DRUMS", 10.0)
DRUM_JOINT = Property(5, "DRUM JOINT", 20.0)
FIN = Property(6, "FIN", 10.0)
TAILPLANE = Property(7, "TAILPLANE", 10.0)
#: The pylon represents a third of the plate and weighs 0.41 kg, which is left out here.
ROOT = Property(8, "WING ON STEEL PLATE", 26.0, PLATE_AND_WING, 3.62e-9)
PLATE = Property(9, "STEEL PLATE", 16.0, STEEL, 7.8e-9)
PYLON = Property(10, "PYLON", 50.0)
PROPERTIES = (
    FUSELAGE,
    WING,
    WING_WITH_LAYER,
    DRUMS,
    DRUM_JOINT,
    FIN,
    TAILPLANE,
    ROOT,
    PLATE,
    PYLON,
)

WING_PLANE = 96.0
#: Element number, place (mm) and mass (t) of the added masses: drums, tail.
MASSES = (
    (9001, (420.0, -925.0, WING_PLANE), 2.0e-4),
    (9002, (420.0, 925.0, WING_PLANE), 2.0e-4),
    (9003, (1450.0, 0.0, 375.0), 5.0e-4),
)


#: Grid points at the sensors of the published shapes: their numbers and places, mm.
SENSORS = (
    (101, (400.0, -950.0, WING_PLANE)),  # port drum, front end
    (102, (800.0, -950.0, WING_PLANE)),  # port drum, rear end
    (103, (600.0, -600.0, WING_PLANE)),
    (104, (600.0, -300.0, WING_PLANE)),
    (105, (600.0, 0.0, WING_PLANE)),
    (106, (600.0, 300.0, WING_PLANE)),
    (107, (600.0, 600.0, WING_PLANE)),
    (108, (400.0, 950.0, WING_PLANE)),  # starboard drum
    (109, (800.0, 950.0, WING_PLANE)),
    (110, (0.0, 0.0, 0.0)),  # nose
    (111, (1450.0, 0.0, 0.0)),  # fuselage below the fin
    (112, (1450.0, 0.0, 375.0)),  # top of the fin
    (113, (1450.0, -200.0, 375.0)),  # tailplane's tips
    (114, (1450.0, 200.0, 375.0)),
)
#: Number of the first grid point that is not a sensor.
FIRST_NODE = 1001


@dataclass(frozen=True, slots=True)
class Patch:
    """A plane rectangle of one property: grid lines of its elements; one of the axes has one."""

    property: Property
    x: Floats
    y: Floats
    z: Floats


@dataclass(frozen=True, slots=True)
class ShellModel:
    """nodes: (n_nodes, 3), mm; numbers: (n_nodes,), of the grid points.

    quads: (n_quads, 4), rows of nodes; properties: (n_quads,), numbers.
    """

    nodes: Floats
    numbers: Integers
    quads: Integers
    properties: Integers


def _lines(*stations: float, size: float) -> Floats:
    """Grid lines through all stations, evenly spaced at about `size` between them."""
    pieces = [np.array(stations[:1])]
    for start, end in pairwise(stations):
        count = max(1, round((end - start) / size))
        pieces.append(np.linspace(start, end, count + 1)[1:])
    return np.asarray(np.concatenate(pieces))


def patches() -> list[Patch]:
    """All parts; grid lines of neighbours coincide where they meet."""
    chord = np.array([550.0, 573.8, 600.0, 625.0, 650.0])
    over_plate = np.array([530.0, *chord, 670.0])
    tail_x = _lines(1400.0, 1500.0, size=50.0)
    top, wing_z, tail_z = np.array([75.0]), np.array([WING_PLANE]), np.array([375.0])
    middle = np.array([0.0])
    before, behind = _lines(0.0, 530.0, size=53.0), _lines(670.0, 1400.0, size=52.0)
    fuselage_x = np.concatenate([before, over_plate[1:-1], behind, tail_x[1:]])
    root_y = np.array([-35.0, 0.0, 35.0])
    found = [
        Patch(FUSELAGE, fuselage_x, middle, _lines(-75.0, 75.0, size=37.5)),
        Patch(PYLON, over_plate, middle, np.concatenate([top, wing_z])),
        Patch(ROOT, chord, root_y, wing_z),
        Patch(PLATE, over_plate[:2], root_y, wing_z),
        Patch(PLATE, over_plate[-2:], root_y, wing_z),
        Patch(FIN, tail_x, middle, _lines(75.0, 375.0, size=50.0)),
        Patch(TAILPLANE, tail_x, _lines(-200.0, 0.0, 200.0, size=50.0), tail_z),
    ]
    inner, outer = _lines(35.0, 300.0, 600.0, 850.0, size=50.0), np.array([850.0, 900.0])
    tip = np.array([900.0, 925.0, 950.0, 1000.0])
    front = np.array([400.0, 420.0, 460.0, 505.0, 550.0])
    for y in (inner, outer, tip):
        for span in (y, -y[::-1]):
            if y is tip:
                found += [
                    Patch(DRUM_JOINT, chord, span, wing_z),
                    Patch(DRUMS, front, span, wing_z),
                    Patch(DRUMS, 1200.0 - front[::-1], span, wing_z),
                ]
            elif y is outer:
                found.append(Patch(WING, chord, span, wing_z))
            else:
                found += [
                    Patch(WING, chord[:2], span, wing_z),
                    Patch(WING_WITH_LAYER, chord[1:], span, wing_z),
                ]
    return found


def shell_model() -> ShellModel:
    """Nodes and quadrilaterals; nodes at one place are one node."""
    points, quads, owners = [], [], []
    offset = 0
    for patch in patches():
        lines = [patch.x, patch.y, patch.z]
        grid = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
        numbers = offset + np.arange(grid[..., 0].size).reshape(grid.shape[:3]).squeeze()
        corners = (numbers[:-1, :-1], numbers[1:, :-1], numbers[1:, 1:], numbers[:-1, 1:])
        points.append(grid.reshape(-1, 3))
        quads.append(np.stack([corner.ravel() for corner in corners], axis=1))
        owners.append(np.full(len(quads[-1]), patch.property.number))
        offset += numbers.size
    nodes, merged = np.unique(np.round(np.concatenate(points), 6), axis=0, return_inverse=True)
    numbers = np.arange(FIRST_NODE, FIRST_NODE + len(nodes))
    for number, place in SENSORS:
        numbers[_row_at(nodes, place)] = number
    rows = merged.ravel()[np.concatenate(quads)]
    return ShellModel(nodes, numbers, rows, np.concatenate(owners))


def _row_at(nodes: Floats, place: tuple[float, float, float]) -> int:
    """Row of the node at this place, mm. Raises ValueError where there is none."""
    distances = np.linalg.norm(nodes - np.array(place), axis=1)
    if distances.min() > 1e-6:
        raise ValueError(f"no node at {place}, the nearest is {distances.min():g} mm away")
    return int(np.argmin(distances))


def node_at(model: ShellModel, place: tuple[float, float, float]) -> int:
    """Number of the grid point at this place, mm. Raises ValueError where there is none."""
    return int(model.numbers[_row_at(model.nodes, place)])


def nastran_deck() -> str:
    """The aircraft as a complete Nastran deck, free-free, SOL 103, modes up to 80 Hz."""
    model = shell_model()
    return "\n".join([
        "$ GARTEUR SM-AG19 testbed, shells; units mm, t, s, MPa",
        "SOL 103",
        "CEND",
        "TITLE = GARTEUR SM-AG19 testbed",
        "METHOD = 1",
        "DISPLACEMENT(PLOT) = ALL",
        "BEGIN BULK",
        "EIGRL,1,,80.",
        "PARAM,COUPMASS,1",
        *_properties(),
        *_mesh(model),
        "ENDDATA",
        "",
    ])  # fmt: skip


def write_decks(folder: Path) -> None:
    """Write garteur_shell.bdf."""
    (folder / "garteur_shell.bdf").write_text(nastran_deck(), encoding="utf-8")


def _properties() -> Iterable[str]:
    for item in PROPERTIES:
        yield f"$ {item.name}"
        yield _material(item)
        # The same material for stretching, bending and transverse shear.
        yield f"PSHELL,{item.number},{item.number},{item.thickness},{item.number},,{item.number}"


def _material(item: Property) -> str:
    fields = f"{item.number},{item.modulus:.1f}"
    if item.across == 1.0:
        return f"MAT1,{fields},,{POISSONS_RATIO},{item.density:.3g}"
    across = item.modulus * item.across
    shear = across / 2.0 / (1.0 + POISSONS_RATIO)
    through = item.modulus / 2.0 / (1.0 + POISSONS_RATIO)  # transverse shear is the metal's own
    shears = f"{shear:.1f},{through:.1f},{through:.1f}"
    return f"MAT8,{fields},{across:.1f},{POISSONS_RATIO},{shears},{item.density:.3g}"


def _mesh(model: ShellModel) -> Iterable[str]:
    oriented = {item.number for item in PROPERTIES if item.across != 1.0}
    for number, (x, y, z) in zip(model.numbers.tolist(), model.nodes.tolist(), strict=True):
        yield f"GRID,{number},,{x:.1f},{y:.1f},{z:.1f}"
    for number, (owner, corners) in enumerate(
        zip(model.properties.tolist(), model.numbers[model.quads].tolist(), strict=True), start=1
    ):
        angle = f",{SPANWISE}" if owner in oriented else ""
        yield f"CQUAD4,{number},{owner},{','.join(map(str, corners))}{angle}"
    for number, place, mass in MASSES:
        yield f"CONM2,{number},{node_at(model, place)},,{mass:.1e}"
