"""Bars of ten-node tetrahedra on meshes that are far too coarse, and on one that is not."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from benchmarks.referees import CORNERS, TETRAHEDRA

import modetune
from modetune.core.mesh import Cells, Mesh, edge_differences
from modetune.core.modes import mode_set
from tests.adapters.solved import needs_ccx
from tests.command_line import run_command

LENGTH, WIDTH = 10.0, 1.0
SIDES = ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))


def bar(along: int, across: int) -> str:
    """A clamped bar of 10 x 1 x 1 m."""
    numbers: dict[tuple[float, ...], int] = {}
    elements = []
    for base in np.ndindex(along, across, across):
        for part in TETRAHEDRA:
            places = [np.add(base, CORNERS[corner]) for corner in part]
            places += [(places[a] + places[b]) / 2.0 for a, b in SIDES]
            keys = [tuple(map(float, place)) for place in places]
            elements.append([numbers.setdefault(key, len(numbers) + 1) for key in keys])
    rows = ["*NODE"]
    rows += [
        f"{n},{x * LENGTH / along},{y * WIDTH / across},{z * WIDTH / across}"
        for (x, y, z), n in numbers.items()
    ]
    rows += ["*ELEMENT,TYPE=C3D10,ELSET=A"]
    rows += [f"{n},{','.join(map(str, nodes))}" for n, nodes in enumerate(elements, 1)]
    rows += ["*MATERIAL,NAME=S", "*ELASTIC", "2.1e11,0.3", "*DENSITY", "7850."]
    rows += ["*SOLID SECTION,ELSET=A,MATERIAL=S", "*BOUNDARY"]
    rows += [f"{n},1,3" for place, n in numbers.items() if place[0] == 0.0]
    return "\n".join([*rows, "*STEP", "*FREQUENCY", "6", "*END STEP", ""])


#: Euler and Bernoulli, Hz; shear lowers it by 0.7 % and the clamped end raises it by 0.4 %.
CLOSED_HZ = 1.875104**2 / LENGTH**2 * np.sqrt(2.1e11 * WIDTH**2 / 12.0 / 7850.0) / (2.0 * np.pi)


def checked(folder: Path, along: int, across: int, *options: str) -> tuple[float, list[str]]:
    """Return the error of the lowest frequency, and the doubts about the mesh."""
    (folder / "bar.inp").write_text(bar(along, across))
    found = modetune.modes(folder / "bar.inp", solver="calculix", units="m-kg-s")
    hz = float(found.modes.frequencies_hz[0])
    (folder / "modes.csv").write_text(f"mode,frequency_hz\n1,{hz:.6g}\n")
    (folder / "bar.yaml").write_text(
        "name: bar\nmodel: {deck: bar.inp, solver: calculix, units: m-kg-s}\n"
        "test: {modes: modes.csv}\nparameters:\n"
        "  - {name: E, quantity: youngs_modulus, material: S, bounds: [0.8, 1.2]}\n"
    )
    told = json.loads(run_command(folder, "check", "bar.yaml", "--json", *options).stdout)
    texts = [f"{item['level']}: {item['what']}" for item in told["findings"]]
    return hz / CLOSED_HZ - 1.0, [text for text in texts if "tetrahedra" in text]


@needs_ccx
def test_tetrahedra_that_are_too_large_for_a_mode_are_doubtful(tmp_path: Path) -> None:
    error, doubts = checked(tmp_path, 2, 1)
    assert error > 0.05
    (doubt,) = doubts
    assert doubt.startswith("doubtful: ten-node tetrahedra are too large for the modes at ")
    assert doubt.endswith("with which bars had frequencies 1 to 120 % too high")
    _, accepted = checked(tmp_path, 2, 1, "--set", "model.checks=[mesh]")
    assert accepted[0].startswith("good: ")
    assert accepted[0].endswith("(accepted)")


@needs_ccx
def test_a_mesh_of_three_elements_is_doubtful(tmp_path: Path) -> None:
    error, doubts = checked(tmp_path, 3, 1)
    assert error > 0.04
    assert doubts[0].startswith("doubtful: ")


@needs_ccx
def test_a_finer_mesh_within_one_per_cent_is_good_with_its_error(tmp_path: Path) -> None:
    error, texts = checked(tmp_path, 12, 2)
    assert abs(error) < 0.01
    (text,) = texts
    assert text.startswith("good: ten-node tetrahedra: neighbouring corners differ by at most ")
    assert error < float(text.split("up to ")[1].split(" %")[0]) / 100.0 < 0.03


def test_the_differences_of_a_wave_are_its_wave_number_times_an_edge() -> None:
    # Tetrahedra with all edges of length h in planes across x are small in k h.
    h, k = 0.01, 2.0
    corners = h * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    places = np.concatenate([corners + np.array([h * n, 0.0, 0.0]) for n in range(628)])
    nodes = np.arange(1, places.shape[0] + 1)
    cells = Cells("tetra10", np.arange(1, 629), np.pad(nodes.reshape(-1, 4), ((0, 0), (0, 6))))
    mesh = Mesh(nodes, places, (cells,))
    wave = np.sin(k * places[:, 0])
    shapes = np.column_stack([wave, np.ones_like(wave)])
    modes = mode_set([1.0, 2.0], shapes, nodes, np.full(nodes.size, 3))
    found = edge_differences(mesh, modes, "tetra10")
    assert found is not None
    # Of the six edges three span h along x, three none.
    assert found[0] == pytest.approx(k * h * np.sqrt(0.5), rel=1e-3)
    assert found[1] == 0.0
    few = mode_set([1.0], np.ones((2, 1)), nodes[:2], np.full(2, 3))
    assert edge_differences(mesh, few, "tetra10") is None
    assert edge_differences(mesh, modes, "tetra") is None
