"""What is measured of a structure: exactly, with noise, with the faults of tests, of another model.

exact     the model with the true values
far       the same, where each true value is 30 to 60 % off
noisy     0.1 % on frequencies, 3 % of their rms on shapes
missing   a mode, but the first, was not found
swapped   the modes stand in another order
turned    each sensor is mounted at an angle of its own, which the test's geometry tells
reversed  a sensor is mounted the wrong way round, which nothing tells
other     the true structure carries a mass that the model lacks
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from benchmarks.zoo.structure import Generator, Structure
from scipy.spatial.transform import Rotation

from modetune.adapters.test_files.geometry_csv import write_geometry_csv
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.configs.measuring import noisy
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.modes import COMPONENTS, Floats, ModeSet, mode_set

Kind = Literal["exact", "far", "noisy", "missing", "swapped", "turned", "reversed", "other"]
KINDS: tuple[Kind, ...] = get_args(Kind)
#: Kinds in which neither test nor model has a fault.
SOUND = {"exact", "far", "noisy", "missing", "swapped", "turned"}
FREQUENCY_NOISE, SHAPE_NOISE = 0.001, 0.03
#: What the model lacks, of the mass of the whole or, by matrices, of one unknown.
LACKING = 0.05, 0.3
MILLIMETRE = 0.001


def lacking_mass(structure: Structure, mass: float, rng: Generator) -> Structure:
    """The structure with a mass more at one of its points. mass: of the model, if not matrices."""
    if isinstance(structure.deck, dict):
        unknowns = np.array(structure.deck["mass"], dtype=np.float64)
        place = int(rng.integers(len(unknowns)))
        unknowns[place, place] *= 1.0 + LACKING[1]
        return replace(structure, deck={**structure.deck, "mass": unknowns})
    node, lacking = int(rng.choice(structure.sensors)), LACKING[0] * mass
    if structure.deck.startswith("SOL"):
        card = f"CONM2,999999,{node},,{lacking:.6g}\nENDDATA"
        return replace(structure, deck=structure.deck.replace("ENDDATA", card))
    if "COMPOSITE" in structure.deck:  # CalculiX takes no mass at the nodes of composite shells
        head, name, rest = structure.deck.partition("*DENSITY\n")
        density, _, rest = rest.partition("\n")
        heavier = f"{float(density) * (1.0 + 2.0 * LACKING[0]):.6g}"
        return replace(structure, deck=f"{head}{name}{heavier}\n{rest}")
    point = f"*ELEMENT, TYPE=MASS, ELSET=LACKING\n999999, {node}\n"
    point += f"*MASS, ELSET=LACKING\n{lacking:.6g}\n"
    before, step, after = structure.deck.partition("*STEP")
    return replace(structure, deck=before + point + step + after)


def measured(
    modes: ModeSet, places: Floats, structure: Structure, kind: Kind, rng: Generator, folder: Path
) -> dict[str, Any]:
    """The test of a kind, as a campaign has it.

    modes: of the true structure at its sensors; places: (n_sensors, 3), where these are.
    """
    n = modes.n_modes
    if kind == "noisy":
        modes = noisy(modes, FREQUENCY_NOISE, SHAPE_NOISE, int(rng.integers(2**31)))
    elif kind == "missing" and n > 2:
        modes = modes.select(np.delete(np.arange(n), int(rng.integers(1, n - 1))))
    elif kind == "swapped":
        modes = modes.select(rng.permutation(n))
    elif kind == "reversed":
        shapes = modes.mode_shapes.copy()
        shapes[modes.nodes == rng.choice(structure.sensors)] *= -1.0
        modes = replace(modes, mode_shapes=shapes)
    elif kind == "turned" and structure.solver != "matrices":
        return _turned(modes, places, structure, rng, folder)
    names = zip(modes.nodes.tolist(), modes.components.tolist(), strict=True)
    if not structure.with_shapes:
        return {"frequencies_hz": modes.frequencies_hz}
    return {
        "frequencies_hz": modes.frequencies_hz,
        "mode_shapes": modes.mode_shapes,
        "dofs": [f"{node}.{COMPONENTS[component - 1]}" for node, component in names],
    }


def _turned(
    modes: ModeSet, places: Floats, structure: Structure, rng: Generator, folder: Path
) -> dict[str, Any]:
    """Motions along each sensor's own axes, and the geometry that tells them."""
    nodes = np.array(structure.sensors)
    frames = Rotation.random(nodes.size, rng=rng).as_matrix()
    shapes = np.zeros((nodes.size, 3, modes.n_modes))
    rows = np.searchsorted(nodes, modes.nodes)
    shapes[rows, modes.components - 1] = modes.mode_shapes
    local = np.einsum("nij,njm->nim", frames, shapes).reshape(-1, modes.n_modes)
    there = np.repeat(nodes, 3), np.tile([1, 2, 3], nodes.size)
    write_modes_csv(
        folder / "modes.csv",
        range(1, modes.n_modes + 1),
        mode_set(modes.frequencies_hz, local, *there),
    )
    empty = np.zeros((0, 2), dtype=np.int64), np.zeros((0, 3), dtype=np.int64)
    geometry = TestGeometry(nodes, places, frames, *empty, MILLIMETRE)
    write_geometry_csv(folder / "points.csv", geometry)
    return {"modes": [str(folder / "modes.csv"), str(folder / "points.csv")]}
