"""Sensors off the axis of stick models: a glider, a crane boom and a ladder of bars.

The tests' shapes come from other decks, in which each sensor is a grid point of its own on a rigid
element, and bars are cut where these begin. All mass is at the nodes that both decks have, so that
the cubic between the ends of a bar is exact and only the digits that MYSTRAN prints remain.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

import modetune
from modetune.core.errors import CampaignError
from modetune.core.modes import Floats
from tests.adapters.solved import needs_mystran
from tests.command_line import run_command

Place = tuple[float, float, float]


#: Axes of an output system, as rows.
TURNED = np.array([[0.0, 1.0, 0.0], [-0.8, 0.0, 0.6], [0.6, 0.0, 0.8]])


@dataclass
class Sticks:
    """Bars between nodes, by property 1, 2, ...; masses in kg; sensors on arms from the bars.

    sensors: of each the bar, the part of its length where the arm begins, and the arm, of which
    what is along the bar is left out.
    """

    nodes: dict[int, Place]
    bars: list[tuple[int, int, int]]
    towards: dict[int, Place]
    sections: dict[int, tuple[float, float, float, float]]
    masses: dict[int, float]
    fixed: tuple[int, ...]
    sensors: list[tuple[int, float, Place]] = field(default_factory=list)

    def places(self) -> Floats:
        found = []
        for bar, part, arm in self.sensors:
            _, first, second = self.bars[bar]
            a, b = np.array(self.nodes[first]), np.array(self.nodes[second])
            x = (b - a) / np.linalg.norm(b - a)
            found.append(a + part * (b - a) + arm - x * np.dot(arm, x))
        return np.array(found)

    def deck(self, with_sensors: bool, frame: str = "") -> str:
        """The deck; frame: output system of its nodes, in which bars have their orientation."""
        rows = [f"GRID,{n},,{x:.6f},{y:.6f},{z:.6f},{frame}" for n, (x, y, z) in self.nodes.items()]
        rows += [f"CONM2,{500 + n},{n},,{m}" for n, m in self.masses.items()]
        rows += [f"PBAR,{p},1,{','.join(map(str, own))}" for p, own in self.sections.items()]
        rows += ["MAT1,1,7.+10,,.3,0."]
        rows += [f"SPC1,1,123456,{','.join(map(str, self.fixed))}"] * bool(self.fixed)
        number, turned = 0, TURNED if frame else np.eye(3)
        for bar, (group, first, second) in enumerate(self.bars):
            ends: list[tuple[float, int]] = [(0.0, first), (1.0, second)]
            for sensor, (on, part, _) in enumerate(self.sensors if with_sensors else []):
                if on == bar and part not in (end[0] for end in ends):
                    a, b = np.array(self.nodes[first]), np.array(self.nodes[second])
                    x, y, z = a + part * (b - a)
                    rows.append(f"GRID,{200 + sensor},,{x:.6f},{y:.6f},{z:.6f}")
                    ends.append((part, 200 + sensor))
            for sensor, (on, part, _) in enumerate(self.sensors if with_sensors else []):
                if on == bar:
                    x, y, z = self.places()[sensor]
                    rows.append(f"GRID,{101 + sensor},,{x:.6f},{y:.6f},{z:.6f}")
                    rows.append(f"RBE2,{900 + sensor},{dict(ends)[part]},123456,{101 + sensor}")
            ends.sort()
            for (_, one), (_, other) in pairwise(ends):
                number += 1
                x, y, z = (turned @ self.towards[group]).round(9).tolist()
                rows.append(f"CBAR,{number},{group},{one},{other},{x},{y},{z}")
        rows += [f"CORD2R,{frame},,0.,0.,0.,0.6,0.,0.8", "+,0.,1.,0."] if frame else []
        case = ["SOL 103", "CEND", *["SPC = 1"] * bool(self.fixed), "METHOD = 1", "BEGIN BULK"]
        return "\n".join([*case, "EIGRL,1,,,20", *rows, "ENDDATA", ""])


def glider() -> Sticks:
    """A T-tail glider, free: wing, fuselage, fin and tailplane; 0.1 m of chord off the axes."""
    nodes: dict[int, Place] = {1: (0.0, 0.0, 0.0)}
    bars: list[tuple[int, int, int]] = []
    for side, first in ((1.0, 10), (-1.0, 20)):
        line = [1, *range(first, first + 4)]
        nodes |= {n: (0.0, side * 0.9 * at, 0.02 * at) for at, n in enumerate(line) if at}
        bars += [(1, a, b) for a, b in pairwise(line)]
    nodes |= {30: (0.8, 0.0, 0.0), 31: (1.6, 0.0, 0.0), 32: (2.4, 0.0, 0.0), 40: (-0.7, 0.0, 0.0)}
    nodes |= {33: (2.6, 0.0, 0.5), 34: (2.6, 0.45, 0.5), 35: (2.6, -0.45, 0.5)}
    bars += [(2, 40, 1), (2, 1, 30), (2, 30, 31), (2, 31, 32), (3, 32, 33), (4, 33, 34)]
    bars += [(4, 33, 35)]
    sensors = [
        (bar, part, (chord, 0.0, 0.015))
        for bar in range(8)
        for part, chord in ((1.0, -0.2), (0.35, 0.3))
    ]
    sensors += [(9, 0.5, (0.0, 0.15, 0.1)), (11, 0.7, (0.0, -0.12, 0.1)), (8, 0.0, (0.0, 0.1, 0.1))]
    sensors += [
        (12, 0.4, (0.2, 0.0, 0.0)),
        (13, 1.0, (-0.15, 0.0, 0.0)),
        (14, 1.0, (0.2, 0.0, 0.0)),
    ]
    masses = dict.fromkeys(nodes, 1.2) | {1: 9.0, 40: 5.0, 34: 0.3, 35: 0.4, 13: 0.6, 23: 0.5}
    inertia = {1: (1.1e-3, 9e-8, 4e-6, 7e-8), 2: (9e-4, 1e-6, 1.3e-6, 8e-7)}
    inertia |= {3: (7e-4, 5e-8, 2e-7, 6e-8), 4: (4e-4, 2e-8, 3e-7, 2e-8)}
    towards: dict[int, Place] = {1: (0, 0, 1), 2: (0, 0, 1), 3: (0, 1, 0), 4: (0, 0, 1)}
    # Unlike masses at the ends of arms give torsion: off the axis, on a bar of their own.
    for at, n in enumerate((11, 13, 21, 23, 34, 35)):
        x, y, z = nodes[n]
        nodes[50 + at] = (x + 0.12, y, z)
        bars.append((5, n, 50 + at))
        masses[50 + at] = 0.35
    return Sticks(
        nodes, bars, towards | {5: (0, 0, 1)}, inertia | {5: (1e-3, 5e-7, 5e-7, 5e-7)}, masses, (),
        sensors,
    )  # fmt: skip


def boom() -> Sticks:
    """A crane boom in space, clamped, with a load at its bent tip; sensors on its outer skin."""
    nodes: dict[int, Place] = {
        n: (1.5 * n, 0.2 * n, 0.9 * n - 0.02 * n**2) for n in range(1, 8)
    } | {20: (11.2, 2.4, 5.0)}
    bars = [(1, n, n + 1) for n in range(1, 7)] + [(2, 7, 20)]
    sensors = [
        (bar, part, (-0.3 * up, 0.35 * side, 0.5 * up))
        for bar, part, up, side in (
            (0, 0.6, 1.0, 1.0), (1, 0.3, 1.0, -1.0), (2, 1.0, -1.0, 1.0), (3, 0.8, 1.0, 1.0),
            (4, 0.15, -1.0, -1.0), (5, 0.5, 1.0, 1.0), (6, 0.0, 1.0, -1.0), (6, 1.0, 0.0, 1.0),
        )
    ]  # fmt: skip
    sections = {1: (8e-3, 3e-5, 5e-5, 4e-6), 2: (5e-3, 1e-5, 2e-5, 2e-6)}
    masses = dict.fromkeys(nodes, 40.0) | {20: 150.0}
    return Sticks(nodes, bars, {1: (0, 1, 0), 2: (0, 0, 1)}, sections, masses, (1,), sensors)


def ladder() -> Sticks:
    """A ladder of bars, its feet clamped, with sensors on brackets out of its plane."""
    left = {n: (0.0, 0.0, 0.35 * n) for n in range(1, 7)}
    right = {10 + n: (0.45, 0.0, 0.35 * n) for n in range(1, 7)}
    bars = [(1, n, n + 1) for n in (*range(1, 6), *range(11, 16))]
    bars += [(2, n, 10 + n) for n in range(2, 7)]
    sensors = [
        (bar, part, (0.0, 0.18 * side, 0.0))
        for bar, part, side in (
            (1, 0.5, 1.0), (3, 0.2, -1.0), (4, 1.0, 1.0), (6, 0.5, 1.0), (8, 0.9, -1.0),
            (11, 0.5, 1.0), (14, 0.25, -1.0), (14, 0.8, 1.0),
        )
    ]  # fmt: skip
    masses = dict.fromkeys(left | right, 0.4) | {6: 0.9, 13: 0.7}
    sections = {1: (3e-4, 2e-8, 6e-8, 3e-8), 2: (2e-4, 8e-9, 8e-9, 1e-8)}
    towards: dict[int, Place] = {1: (0, 1, 0), 2: (0, 1, 0)}
    return Sticks(left | right, bars, towards, sections, masses, (1, 11), sensors)


def write_campaign(folder: Path, sticks: Sticks, frame: str = "", **sensors: str) -> Path:
    """The model without sensors, and as test the modes of the deck that has them."""
    (folder / "model.bdf").write_text(sticks.deck(False, frame))
    (folder / "test.bdf").write_text(sticks.deck(True))
    found = modetune.modes(folder / "test.bdf", solver="mystran", units="m-kg-s").elastic
    where = {
        dof: row
        for row, dof in enumerate(zip(found.nodes.tolist(), found.components.tolist(), strict=True))
    }
    count = min(8, found.n_modes)
    names = [(101 + n, c) for n in range(len(sticks.sensors)) for c in (1, 2, 3)]
    shapes = found.mode_shapes[[where[name] for name in names], :count].real
    rows = [f"mode,frequency_hz,{','.join(f'{n}.{chr(119 + c)}' for n, c in names)}"]
    rows += [
        f"{mode},{hz:.9g},{','.join(f'{value:.9g}' for value in column)}"
        for mode, (hz, column) in enumerate(
            zip(found.frequencies_hz[:count], shapes.T, strict=True), 1
        )
    ]
    (folder / "modes.csv").write_text("\n".join(rows) + "\n")
    points = [",".join(map(str, (101 + n, *at))) for n, at in enumerate(sticks.places().tolist())]
    (folder / "points.csv").write_text("\n".join(["node,x,y,z", *points]) + "\n")
    keys = "".join(f", {key}: {value}" for key, value in sensors.items())
    (folder / "campaign.yaml").write_text(
        "name: sticks\nmodel: {deck: model.bdf, solver: mystran, units: m-kg-s}\n"
        f"test: {{modes: [modes.csv, points.csv], length: m, sensors: {{align: none{keys}}}}}\n"
        "parameters:\n"
        "  - {name: E, quantity: youngs_modulus, material: 1, bounds: [0.8, 1.2]}\n"
    )
    return folder / "campaign.yaml"


#: With the largest error of a MAC. Where bars meet at an angle, the section next to a sensor may be
#: one of the other bar, some percent of an arm away. The ladder has only the digits of MYSTRAN.
STRUCTURES = {"glider": (glider, 1e-8), "boom": (boom, 1e-5), "ladder": (ladder, 1e-12)}


@needs_mystran
@pytest.mark.parametrize("name", STRUCTURES)
def test_sensors_off_the_axis_move_with_the_section_next_to_them(name: str, tmp_path: Path) -> None:
    make, error = STRUCTURES[name]
    sticks = make()
    path = write_campaign(tmp_path, sticks)
    mapping = modetune.load(path).case.mapping
    assert not mapping.left_out
    assert mapping.sensors.on_bars.all()
    (note,) = [text for text in mapping.notes if "attached rigidly" in text]
    assert note.startswith(
        f"{len(sticks.sensors)} test points are attached rigidly to the nearest bar, up to"
    )
    compared = modetune.correlate(path)
    n_modes = len(compared.pairs)
    assert [pair.second for pair in compared.pairs] == list(range(n_modes))
    assert min(pair.mac for pair in compared.pairs) > 1.0 - error
    # Read at the nearest node at any distance the same modes look unlike.
    plain = write_campaign(tmp_path, sticks, attach="false", tolerance="1.3")
    nodes = modetune.correlate(plain)
    assert min(pair.mac for pair in nodes.pairs) < 0.98


@needs_mystran
def test_sensors_on_bars_follow_output_frames(tmp_path: Path) -> None:
    path = write_campaign(tmp_path, boom(), frame="7")
    assert min(pair.mac for pair in modetune.correlate(path).pairs) > 1.0 - STRUCTURES["boom"][1]


@needs_mystran
def test_sensors_farther_than_any_skin_are_refused_with_the_remedy(tmp_path: Path) -> None:
    sticks = ladder()
    sticks.sensors[2] = (4, 1.0, (0.0, 0.9, 0.0))  # half the ladder's height
    path = write_campaign(tmp_path, sticks)
    with pytest.raises(CampaignError, match=r"1 sensor is .*sensor 103: .*`attach: true` attaches"):
        modetune.load(path)
    path = write_campaign(tmp_path, sticks, attach="true")
    assert min(pair.mac for pair in modetune.correlate(path).pairs) > 1.0 - STRUCTURES["ladder"][1]


@needs_mystran
def test_a_flat_model_with_a_bar_attaches_only_if_asked(tmp_path: Path) -> None:
    sticks = ladder()
    rows = sticks.deck(False).replace("ENDDATA", "")
    panels = [f"CQUAD4,{800 + n},9,{n},{n + 1},{n + 11},{n + 10}" for n in range(1, 6)]
    more = [f"CQUAD4,{810 + n},9,{n},{n + 1},{n + 11},{n + 10}" for n in (1, 2, 3, 4, 5)]
    more += [f"CQUAD4,{820 + n},9,{n},{n + 1},{n + 11},{n + 10}" for n in (1, 2, 3, 4, 5)]
    path = write_campaign(tmp_path, sticks)
    shells = [*panels, *more, "PSHELL,9,1,.001"]
    (tmp_path / "model.bdf").write_text(rows + "\n".join([*shells, "ENDDATA", ""]))
    with pytest.raises(CampaignError, match="`attach: true` attaches them rigidly to bars"):
        modetune.load(path)


@needs_mystran
def test_an_update_finds_stiffness_from_sensors_off_the_axis(tmp_path: Path) -> None:
    path = write_campaign(tmp_path, boom())
    deck = (tmp_path / "model.bdf").read_text()
    (tmp_path / "model.bdf").write_text(deck.replace("7.+10", "6.3+10"))
    found = modetune.update(path, tmp_path / "runs")
    # The test's E is 7e10 and the deck's 6.3e10.
    assert found.record.updated[0] == pytest.approx(7.0 / 6.3, rel=1e-4)


@needs_mystran
def test_a_solver_without_rotations_says_who_has_them(tmp_path: Path) -> None:
    path = write_campaign(tmp_path, glider())
    told = run_command(tmp_path, "sensors", "campaign.yaml", "--set", "model.solver=calculix")
    assert told.returncode == 2
    assert "results of this solver have no rotations" in " ".join(told.stderr.split())
    told = run_command(tmp_path, "sensors", path.name)
    assert told.returncode == 0
    assert "66 sensors: 66 good, 0 doubtful, 0 left out" in told.stdout
