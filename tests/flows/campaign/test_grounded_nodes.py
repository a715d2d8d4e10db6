"""Sensors next to grounded ends of springs and other nodes that cannot move.

Three structures on springs, whose tests come from another mesh and solver or from numpy. A sensor
under a spring's upper end is nearer to its lower one, which is fixed in the deck.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import eigh

import modetune
from modetune.core.modes import Floats
from tests.adapters.solved import needs_ccx, needs_mystran
from tests.section_frames import RHO, E, Frame, in_plane

WIDE, DEEP = 0.6, 0.4
#: Below the plate: where sensors are, and where the feet end.
SENSORS_Z, GROUND_Z = -0.006, -0.010


@dataclass(frozen=True)
class Test:
    """Modes at places (n, 3), each along some components: shapes (n_sensors, n_modes)."""

    hz: Floats
    names: tuple[str, ...]
    shapes: Floats
    places: Floats

    __test__ = False

    def write(self, folder: Path, deck: str, solver: str) -> Path:
        rows = [f"mode,frequency_hz,{','.join(self.names)}"]
        rows += [
            f"{mode},{hz:.9g},{','.join(f'{value:.9g}' for value in column)}"
            for mode, (hz, column) in enumerate(zip(self.hz, self.shapes.T, strict=True), 1)
        ]
        (folder / "modes.csv").write_text("\n".join(rows) + "\n")
        points = [",".join(map(str, (101 + n, *xyz))) for n, xyz in enumerate(self.places.tolist())]
        (folder / "points.csv").write_text("\n".join(["node,x,y,z", *points]) + "\n")
        (folder / "campaign.yaml").write_text(
            f"name: feet\nmodel: {{deck: {deck}, solver: {solver}, units: m-kg-s}}\n"
            "test: {modes: [modes.csv, points.csv], length: m}\n"
            "parameters:\n"
            "  - {name: E, quantity: youngs_modulus, material: 1, bounds: [0.8, 1.2]}\n"
        )
        return folder / "campaign.yaml"


def plate_on_bushes(n: int, m: int) -> str:
    """A plate of n x m quads, 4 mm thick, on a bush under each corner; one corner is thicker."""
    ids = {(i, j): 1 + i * (m + 1) + j for i in range(n + 1) for j in range(m + 1)}
    rows = [f"GRID,{at},,{WIDE * i / n:.6f},{DEEP * j / m:.6f},0." for (i, j), at in ids.items()]
    for i in range(n):
        for j in range(m):
            part = 2 if i < n / 2 and j < m / 2 else 1
            corners = [ids[i, j], ids[i + 1, j], ids[i + 1, j + 1], ids[i, j + 1]]
            rows.append(f"CQUAD4,{i * m + j + 1},{part},{','.join(map(str, corners))}")
    for foot, (i, j) in enumerate([(0, 0), (n, 0), (0, m), (n, m)], 1):
        place = f"{WIDE * i / n:.6f},{DEEP * j / m:.6f},{GROUND_Z}"
        held = ",,123456" if foot == 1 else ""  # by PS; the others by the SPC set
        rows.append(f"GRID,{9000 + foot},,{place}{held}")
        rows.append(f"CBUSH,{9000 + foot},9,{9000 + foot},{ids[i, j]},,,,0")
    rows += ["SPC1,1,123456,9002,THRU,9004", "PBUSH,9,K,3.+4,2.5+4,2.+4,60.,60.,60."]
    rows += ["PSHELL,1,1,.004,1,,1", "PSHELL,2,1,.007,1,,1", "MAT1,1,7.+10,,.3,2700."]
    return "\n".join(["SOL 103", "CEND", "SPC = 1", "METHOD = 1", "BEGIN BULK",
                      "EIGRL,1,,,10", *rows, "ENDDATA", ""])  # fmt: skip


def plate_test(folder: Path) -> Test:
    """The plate's modes by CalculiX from a mesh twice as fine, at its corners and eight points."""
    (folder / "fine.bdf").write_text(plate_on_bushes(12, 8))
    found = modetune.modes(folder / "fine.bdf", solver="calculix", units="m-kg-s").elastic
    at = [(i, j) for i in (0, 4, 8, 12) for j in (0, 4, 8)]
    dofs = zip(found.nodes.tolist(), found.components.tolist(), strict=True)
    where = {dof: row for row, dof in enumerate(dofs)}
    rows = [where[1 + i * 9 + j, c] for i, j in at for c in (1, 2, 3)]
    names = tuple(f"{101 + n}.{'xyz'[c]}" for n in range(len(at)) for c in range(3))
    places = np.array([[WIDE * i / 12, DEEP * j / 8, SENSORS_Z] for i, j in at])
    return Test(found.frequencies_hz[:8], names, found.mode_shapes[rows, :8].real, places)


@needs_ccx
@needs_mystran
def test_a_plate_on_bush_feet_is_read_at_the_plate(tmp_path: Path) -> None:
    (tmp_path / "plate.bdf").write_text(plate_on_bushes(6, 4))
    path = plate_test(tmp_path).write(tmp_path, "plate.bdf", "mystran")
    mapping = modetune.load(path).case.mapping
    assert not set(mapping.sensors.model_nodes.tolist()) & {9001, 9002, 9003, 9004}
    moved = [row for row in mapping.table if "is fixed in this direction" in row.reason]
    assert {row.test_node for row in moved} == {101, 103, 110, 112}
    assert len(moved) == 12
    assert [row.verdict for row in moved] == ["good"] * 12
    (note,) = [text for text in mapping.notes if "next node that can move" in text]
    assert note.startswith("12 sensors are read at the next node that can move, because the")
    assert "101.x (1 instead of 9001)" in note
    compared = modetune.correlate(path)
    assert [pair.second for pair in compared.pairs] == list(range(8))
    # Meshes of 6 x 4 and 12 x 8 shells by two programs, which mix the modes at 37.6 and 39.4 Hz.
    # With the feet read at the ground the largest MAC is 0.87, and mode 8 has no pair.
    assert min(pair.mac for pair in compared.pairs) > 0.9
    assert np.abs(compared.shapes[1]).max(axis=1).min() > 0.0
    chosen = modetune.pretest(path, candidates="all", sensors=12)
    assert not {item.node for item in chosen.sensors} & {9001, 9002, 9003, 9004}


def beam_on_springs() -> str:
    """A beam of 1.2 m on three springs; their grounded ends are 6 mm under its axis."""
    feet = {1: 9001, 9: 9002, 19: 9003}
    nodes = [f"{n},{0.05 * (n - 1):.3f},0.,0." for n in range(1, 26)]
    ground = [f"{g},{0.05 * (n - 1):.3f},0.,{SENSORS_Z}" for n, g in feet.items()]
    rows = ["*NODE, NSET=BEAM", *nodes, "*NODE, NSET=GROUND", *ground]
    rows += ["*ELEMENT, TYPE=B32, ELSET=B"]
    rows += [f"{n},{2 * n - 1},{2 * n},{2 * n + 1}" for n in range(1, 13)]
    rows += ["*ELEMENT, TYPE=SPRING2, ELSET=K"]
    rows += [f"{100 + at},{g},{n}" for at, (n, g) in enumerate(feet.items())]
    rows += ["*MATERIAL, NAME=1", "*ELASTIC", f"{E},0.", "*DENSITY", f"{RHO}"]
    rows += ["*BEAM SECTION, ELSET=B, MATERIAL=1, SECTION=RECT", "0.01,0.03", "0.,0.,1."]
    rows += ["*SPRING, ELSET=K", "3,3", f"{SPRING}"]
    rows += ["*BOUNDARY", "GROUND,1,3", "BEAM,1,2", "1,4,4", "1,6,6"]
    return "\n".join([*rows, "*STEP", "*FREQUENCY", "10", "*END STEP", ""])


SPRING = 9e3


def with_springs(frame: Frame, stiffness: dict[tuple[int, int], float]) -> tuple[Floats, Floats]:
    """Frequencies and shapes (n_dof, 5) of a frame of 10 x 30 mm on springs to ground."""
    k, m = frame.at(3e-4, 0.03 * 0.01**3 / 12.0)
    for dof, value in stiffness.items():
        k[frame.dofs.index(dof), frame.dofs.index(dof)] += value
    values, shapes = eigh(k, m)
    return np.sqrt(values[:5]) / 2.0 / np.pi, shapes[:, :5]


@needs_ccx
def test_a_beam_on_springs_is_read_at_the_beam(tmp_path: Path) -> None:
    (tmp_path / "beam.inp").write_text(beam_on_springs())
    line = np.column_stack([0.05 * np.arange(25), np.zeros(25)])
    held = {(n, 1) for n in range(1, 26)}
    frame = in_plane(line, [(n, n + 1) for n in range(1, 25)], held)
    hz, shapes = with_springs(frame, {(n, 2): SPRING for n in (1, 9, 19)})
    at = [1, 5, 9, 13, 16, 19, 22, 25]
    rows = [frame.dofs.index((n, 2)) for n in at]
    names = tuple(f"{101 + n}.z" for n in range(len(at)))
    places = np.array([[0.05 * (n - 1), 0.0, 0.8 * SENSORS_Z] for n in at])
    test = Test(hz, names, shapes[rows], places)
    path = test.write(tmp_path, "beam.inp", "calculix")
    mapping = modetune.load(path).case.mapping
    assert mapping.sensors.model_nodes.tolist() == at
    (note,) = [text for text in mapping.notes if "next node that can move" in text]
    assert note.endswith(": 101.z (1 instead of 9001), 103.z (9 instead of 9002), 106.z "
                         "(19 instead of 9003)")  # fmt: skip
    compared = modetune.correlate(path)
    assert [pair.second for pair in compared.pairs] == list(range(5))
    # Euler's beam against the bricks that ccx makes of a B32, which bend 1 to 5 % too stiffly.
    assert min(pair.mac for pair in compared.pairs) > 0.999
    np.testing.assert_allclose(compared.second.modes.frequencies_hz[:5], hz, rtol=0.03)


#: A portal of unequal legs, its feet on springs in its plane.
PORTAL = np.array([[0.0, 0.0], [0.0, 0.4], [0.1, 0.8], [0.5, 0.8], [0.9, 0.7], [1.0, 0.3],
                   [1.0, -0.1]])  # fmt: skip
FEET = {(n, c): {1: 4e4, 2: 6e4, 6: 40.0}[c] for n in (1, 7) for c in (1, 2, 6)}


def portal_deck() -> str:
    """The portal of bars; the grounded ends of its springs are where it is, a grid point that only
    orients a bar is 5 mm from its beam."""
    points = [(n, *xy) for n, xy in enumerate(PORTAL.tolist(), 1)]
    rows = [f"GRID,{n},,{x},{y},0.,,345" for n, x, y in points]
    rows += [f"GRID,{50 + n},,{x},{y},0.,,123456" for n, x, y in points if n in (1, 7)]
    rows += ["GRID,60,,.5,.805,0."]
    rows += [f"CBAR,{n},1,{n},{n + 1},{'60' if n == 1 else '0.,0.,1.'}" for n in range(1, 7)]
    for at, ((n, c), value) in enumerate(FEET.items(), 100):
        rows.append(f"CELAS2,{at},{value},{n},{c},{50 + n},{c}")
    inertia = f"{0.03 * 0.01**3 / 12.0:.6E}"
    rows += [f"PBAR,1,1,3.-4,{inertia},{inertia},5.-9", f"MAT1,1,{E:.1E},,.3,{RHO}"]
    rows += ["PARAM,COUPMASS,1"]
    return "\n".join(["SOL 103", "CEND", "METHOD = 1", "BEGIN BULK", "EIGRL,1,,,8", *rows,
                      "ENDDATA", ""])  # fmt: skip


@needs_ccx
def test_a_frame_is_read_at_its_bars(tmp_path: Path) -> None:
    (tmp_path / "portal.bdf").write_text(portal_deck())
    frame = in_plane(PORTAL, [(n, n + 1) for n in range(1, 7)], set())
    hz, shapes = with_springs(frame, FEET)
    at = [(n, c) for n in range(1, 8) for c in (1, 2)]
    names = tuple(f"{100 + n}.{'xy'[c - 1]}" for n, c in at)
    places = np.column_stack([PORTAL, np.zeros(7)])
    places[3, 1] += 0.003
    test = Test(hz, names, shapes[[frame.dofs.index(dof) for dof in at]], places)
    path = test.write(tmp_path, "portal.bdf", "calculix")
    mapping = modetune.load(path).case.mapping
    assert mapping.sensors.model_nodes.tolist() == [n for n, _ in at]
    assert "104.x (4 instead of 60), 104.y (4 instead of 60)" in " ".join(mapping.notes)
    compared = modetune.correlate(path)
    assert [pair.second for pair in compared.pairs] == list(range(5))
    assert min(pair.mac for pair in compared.pairs) > 0.99


def test_the_feet_spoil_the_pairs_where_nothing_is_known_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That is what the three tests above would find without the deck's constraints."""
    from modetune.adapters.calculix.model import CalculixModel

    monkeypatch.setattr(CalculixModel, "fixed", lambda self: {})
    (tmp_path / "beam.inp").write_text(beam_on_springs())
    places = np.array([[0.05 * (n - 1), 0.0, 0.8 * SENSORS_Z] for n in (1, 9, 19)])
    test = Test(np.array([10.0]), ("101.z", "102.z", "103.z"), np.ones((3, 1)), places)
    mapping = modetune.load(test.write(tmp_path, "beam.inp", "calculix")).case.mapping
    assert mapping.sensors.model_nodes.tolist() == [9001, 9002, 9003]
