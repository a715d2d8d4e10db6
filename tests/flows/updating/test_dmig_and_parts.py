"""Whole campaigns, from init to a known truth, of decks with DMIG and of decks in parts."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import eigh

import modetune
from modetune.core.modes import Floats
from modetune.core.storage.campaign_record import read_record
from tests.adapters.nastran.test_parts import PLATE
from tests.adapters.solved import needs_ccx, needs_mystran
from tests.adapters.test_added_matrices import BAR, HEAD, bars, cbars, dmig, line, six
from tests.command_line import run_command


def write_test(
    folder: Path, hz: Floats, shapes: Floats, places: Sequence[tuple[float, ...]]
) -> None:
    """Modes and their points; shapes: (n_places, n_modes) along z; places: node, x, y, z."""
    rows = [f"mode,frequency_hz,{','.join(f'{place[0]}.z' for place in places)}"]
    rows += [
        f"{mode},{value:.9g},{','.join(f'{item:.9g}' for item in shape)}"
        for mode, (value, shape) in enumerate(zip(hz, shapes.T, strict=True), 1)
    ]
    (folder / "modes.csv").write_text("\n".join(rows) + "\n")
    points = [",".join(map(str, place)) for place in places]
    (folder / "points.csv").write_text("\n".join(["metres,1", "node,x,y,z", *points]) + "\n")


def updated(folder: Path, deck: str, solver: str) -> dict[str, float]:
    """Draft a campaign, update its model, and return the parameters' relative values by name."""
    drafted = run_command(
        folder, "init", deck, "modes.csv", "points.csv", "--solver", solver, "--units", "m-kg-s"
    )
    assert drafted.returncode == 0, drafted.stderr
    told = run_command(folder, "update", "campaign.yaml", "--json", MODETUNE_NO_PREFECT="1")
    assert told.returncode == 0, told.stdout + told.stderr
    assert json.loads(told.stdout)["status"] == "converged"
    (run,) = (folder / "runs").iterdir()
    record = read_record(run / "campaign.h5")
    return dict(zip(record.parameters.names, record.updated.tolist(), strict=True))


@needs_ccx
def test_the_mesh_beside_a_component_of_matrices_is_updated(tmp_path: Path) -> None:
    # A cantilever of six bars: the deck has three of them and the others as K2GG and M2GG. In the
    # test the first three are 12 % stiffer than in the deck.
    own, own_mass = bars(3, 0.4)
    text = line(7) + BAR + "SPC1,1,123456,1\n" + cbars(range(1, 4))
    (tmp_path / "half.bdf").write_text(
        HEAD + text + dmig(own, own_mass, six(range(4, 8))) + "ENDDATA\n"
    )
    stiffness, mass = bars(6, 0.4)
    stiffness[:24, :24] += 0.12 * own
    heavy = np.array([row for row in range(6, 42) if row % 6 < 3])
    light = np.array([row for row in range(6, 42) if row % 6 >= 3])
    rest = np.linalg.solve(stiffness[np.ix_(light, light)], stiffness[np.ix_(light, heavy)])
    reduced = stiffness[np.ix_(heavy, heavy)] - stiffness[np.ix_(heavy, light)] @ rest
    values, shapes = eigh(reduced, mass[np.ix_(heavy, heavy)])
    # Bending along z; sensors at all free points.
    moves = shapes[2::3]
    along = [
        mode for mode in range(8)
        if np.abs(moves[:, mode]).max() > 0.9 * np.abs(shapes[:, mode]).max()
    ][:3]  # fmt: skip
    places = [(n, 0.4 * (n - 1), 0, 0) for n in range(2, 8)]
    write_test(tmp_path, np.sqrt(values[along]) / 2.0 / np.pi, moves[:, along], places)
    found = updated(tmp_path, "half.bdf", "calculix")
    (stiff,) = (value for name, value in found.items() if name.startswith("E"))
    # ccx prints modes with seven digits; e1 asks for far less.
    assert stiff == pytest.approx(1.12, rel=2e-3)


@needs_mystran
def test_a_deck_in_parts_is_updated_to_the_modes_of_the_deck_in_one(tmp_path: Path) -> None:
    # The truth is another deck: of the whole plate, whose steel is 10 % softer.
    whole, parts = PLATE
    (tmp_path / "whole.bdf").write_text(whole.replace("2.1+11", "1.89+11") + "ENDDATA\n")
    (tmp_path / "parts.bdf").write_text(parts + "ENDDATA\n")
    truth = modetune.modes(tmp_path / "whole.bdf", solver="mystran", units="m-kg-s").modes
    rows = {
        dof: row
        for row, dof in enumerate(zip(truth.nodes.tolist(), truth.components.tolist(), strict=True))
    }
    nodes = [10, 20, 30, 40, 50, 26, 36, 46, 38, 48]
    places = [(n, 0.1 * ((n - 1) // 5), 0.1 * ((n - 1) % 5), 0) for n in nodes]
    shapes = truth.mode_shapes[[rows[n, 3] for n in nodes], :4].real
    write_test(tmp_path, truth.frequencies_hz[:4], shapes, places)
    found = updated(tmp_path, "parts.bdf", "mystran")
    # Each part has its own steel. MYSTRAN's modes have seven digits.
    assert len(found) == 2
    assert list(found.values()) == pytest.approx([0.9, 0.9], rel=1e-4)
