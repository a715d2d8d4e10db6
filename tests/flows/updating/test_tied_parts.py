"""Parts that *TIE joins on unlike meshes, with sensors on the slave surface, by their matrices."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import modetune
from tests.adapters.calculix.test_ties import Block, deck
from tests.adapters.solved import needs_ccx

MASTER = Block("C3D10", (3, 2, 1), 0.0, 0)
SLAVE = Block("C3D8I", (4, 3, 2), 30.0, 1000)
MATERIAL = "*MATERIAL, NAME={}\n*ELASTIC\n{}, 0.3\n*DENSITY\n2700.\n"


def campaign(folder: Path, name: str, moduli: tuple[float, float], **test: Any) -> dict[str, Any]:
    text = deck(MASTER, SLAVE)
    own = "".join(MATERIAL.format(n, 7e10 * e) for n, e in zip("AB", moduli, strict=True))
    text = text.replace(MATERIAL.format("M", "7e10"), own)
    for part, material in (("E0", "A"), ("E1000", "B")):
        text = text.replace(f"ELSET={part}, MATERIAL=M", f"ELSET={part}, MATERIAL={material}")
    (folder / f"{name}.inp").write_text(text)
    return {
        "name": name,
        "model": {"deck": str(folder / f"{name}.inp"), "units": "m-kg-s", "eigensolver": "pardiso"},
        "test": {"frequencies_hz": [1.0]} | test,
        "parameters": [
            {"name": n, "quantity": "youngs_modulus", "material": n, "bounds": [0.5, 2.0]}
            for n in "AB"
        ],
        "residuals": {"shape_weight": 1.0 if test else 0.0},
        "report": {"page": False},
        "store": str(folder / "store"),
    }


@needs_ccx
def test_moduli_of_tied_parts_are_found_from_matrices(tmp_path: Path) -> None:
    truth = modetune.load(campaign(tmp_path, "truth", (1.1, 0.85)), folder=tmp_path)
    modes = modetune.modes(truth).elastic
    seen = [*sorted(SLAVE.start)[:6], *sorted(SLAVE.end)[:4]]
    rows = np.flatnonzero(np.isin(modes.nodes, seen))
    names = zip(modes.nodes[rows].tolist(), modes.components[rows].tolist(), strict=True)
    given = campaign(
        tmp_path, "model", (1.0, 1.0),
        frequencies_hz=modes.frequencies_hz[:5],
        mode_shapes=np.real(modes.mode_shapes[rows, :5]),
        dofs=[f"{node}.{' xyz'[component]}" for node, component in names],
    )  # fmt: skip
    run = modetune.update(given, runs=tmp_path / "runs")
    assert run.record.runs.modal == 1  # the one that confirms
    # Exact, but for the seven digits of ccx's shapes.
    assert run.parameters["updated"].to_numpy() == pytest.approx([1.1, 0.85], rel=1e-4)
