"""Cyclic symmetry: a sector of a disc has the modes of the whole disc."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.calculix.job import check_frequency_step
from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.solver import MatrixAnalysis, ModalAnalysis
from modetune.core.errors import ModelError
from modetune.core.modes import Floats
from modetune.core.updating.job_results import ModalResult
from tests.adapters.calculix.test_model import model_of, parameter
from tests.adapters.solved import needs_ccx
from tests.adapters.test_solver_contract import run

SECTORS = 6
STEP = (
    "*STEP\n*FREQUENCY\n4\n*SELECT CYCLIC SYMMETRY MODES, NMIN={}, NMAX={}\n"
    "*NODE FILE\nU\n*END STEP\n"
)
Places = dict[int, tuple[float, float, float]]
#: Corners and middles of a brick of twenty nodes, in half steps along radius, angle and height.
BRICK = (
    (0, 0, 0), (2, 0, 0), (2, 2, 0), (0, 2, 0), (0, 0, 2), (2, 0, 2), (2, 2, 2), (0, 2, 2),
    (1, 0, 0), (2, 1, 0), (1, 2, 0), (0, 1, 0), (1, 0, 2), (2, 1, 2), (1, 2, 2), (0, 1, 2),
    (0, 0, 1), (2, 0, 1), (2, 2, 1), (0, 2, 1),
)  # fmt: skip


def _rows(words: Iterable[object]) -> str:
    texts = list(map(str, words))
    return "".join(", ".join(texts[i : i + 8]) + ",\n" for i in range(0, len(texts), 8))


def disc(whole: bool) -> tuple[str, Places]:
    """A disc held at its bore, or one of six sectors of it: four bricks outwards, two across.

    Its rim is heavier and softer than the rest. Deck, and the places of its nodes.
    """
    across, outward = 2 * (SECTORS if whole else 1), 4
    ids: dict[tuple[int, int, int], int] = {}
    places: Places = {}

    def node(i: int, j: int, k: int) -> int:
        at = (i, j % (2 * across) if whole else j, k)
        if at not in ids:
            ids[at] = len(ids) + 1
            radius, angle = 20.0 + 10.0 * i, math.pi / SECTORS / 2.0 * j
            places[ids[at]] = (radius * math.cos(angle), radius * math.sin(angle), 2.5 * k)
        return ids[at]

    elements: dict[str, list[str]] = {"WEB": [], "RIM": []}
    for e in range(outward):
        for f in range(across):
            for g in range(2):
                corners = [node(2 * e + a, 2 * f + b, 2 * g + c) for a, b, c in BRICK]
                number = 1 + g + 2 * f + 2 * across * e
                row = f"{number}, {', '.join(map(str, corners[:10]))},\n"
                row += ", ".join(map(str, corners[10:])) + "\n"
                elements["RIM" if e == outward - 1 else "WEB"].append(row)
    ends = [[n for (_, j, _), n in ids.items() if j == side] for side in (0, 2 * across)]
    bore = [n for (i, j, _), n in ids.items() if i == 0 and (whole or j > 0)]
    text = "*NODE\n" + "".join(f"{n}, {x:.9f}, {y:.9f}, {z}\n" for n, (x, y, z) in places.items())
    for name, rows in elements.items():
        text += f"*ELEMENT, TYPE=C3D20R, ELSET={name}\n{''.join(rows)}"
        modulus, density = (210000.0, 7.8e-9) if name == "WEB" else (70000.0, 9.1e-9)
        text += f"*MATERIAL, NAME={name}\n*ELASTIC\n{modulus}, 0.3\n*DENSITY\n{density}\n"
        text += f"*SOLID SECTION, ELSET={name}, MATERIAL={name}\n"
    text += f"*NSET, NSET=BORE\n{_rows(bore)}*BOUNDARY\nBORE, 1, 3\n"
    if not whole:
        for name, side in zip("LR", ends, strict=True):
            text += f"*NSET, NSET={name}\n{_rows(side)}*SURFACE, NAME=S{name}, TYPE=NODE\n{name}\n"
        text += "*TIE, POSITION TOLERANCE=0.1, CYCLIC SYMMETRY, NAME=CUT\nSL, SR\n"
        text += f"*CYCLIC SYMMETRY MODEL, N={SECTORS}, NGRAPH=1, TIE=CUT\n0.,0.,0.,0.,0.,1.\n"
    return text, places


def solved(
    folder: Path, whole: bool, first: int = 0, last: int = 3, n_modes: int = 10
) -> tuple[ModalResult, Floats]:
    """The lowest modes, and their shapes within the sector in the order of places."""
    text, places = disc(whole)
    path = folder / f"disc{whole}.inp"
    path.write_text(text if whole else text + STEP.format(first, last))
    solver = calculix_solver(path, ())
    inside = {
        node: place
        for node, place in places.items()
        if math.hypot(*place[:2]) > 60.0 and 0.1 < math.atan2(place[1], place[0]) < 1.0
    }
    groups = (("web", ("WEB",)), ("rim", ("RIM",)))
    result = run(solver, {}, ModalAnalysis(n_modes, tuple(inside), groups), folder)
    assert isinstance(result, ModalResult)
    order = sorted(
        range(result.modes.n_dof),
        key=lambda row: (
            *(round(x, 6) for x in places[int(result.modes.nodes[row])]),
            int(result.modes.components[row]),
        ),
    )
    return result, np.real(result.modes.mode_shapes)[order]


@needs_ccx
def test_a_sector_has_the_modes_of_the_whole_disc(tmp_path: Path) -> None:
    # The other way is the whole disc by the usual solver. Its eigenvalues 3 and 8 are single.
    (whole, shapes), (sector, own) = solved(tmp_path, True), solved(tmp_path, False)
    np.testing.assert_allclose(sector.eigenvalues, whole.eigenvalues, rtol=1e-6)  # seven digits
    assert sector.mass == pytest.approx(whole.mass, rel=1e-6)
    np.testing.assert_allclose(sector.energy_balance, 1.0, rtol=2e-6)
    clusters = np.split(
        np.arange(10), np.flatnonzero(np.diff(whole.eigenvalues) > 1e-5 * whole.eigenvalues[1:]) + 1
    )
    assert sorted(map(len, clusters))[-1] == 2
    for rows in clusters:
        # The same modes, mass-normalised over the whole, but for a turn within the cluster.
        turn = np.linalg.lstsq(shapes[:, rows], own[:, rows], rcond=None)[0]
        np.testing.assert_allclose(turn @ turn.T, np.eye(rows.size), rtol=0.0, atol=1e-5)
        np.testing.assert_allclose(
            shapes[:, rows] @ turn, own[:, rows], rtol=0.0, atol=1e-5 * np.abs(own[:, rows]).max()
        )
        mine, others = (r.strain_energies[:, rows].sum(axis=1) for r in (sector, whole))
        np.testing.assert_allclose(mine, others, rtol=1e-5)


@needs_ccx
def test_selected_nodal_diameters_have_their_modes_alone(tmp_path: Path) -> None:
    every, some = solved(tmp_path, False)[0], solved(tmp_path, False, 2, 2, 9)[0]
    doublets = some.eigenvalues[0::2][:4]
    np.testing.assert_allclose(doublets, some.eigenvalues[1::2][:4], rtol=1e-5)
    assert np.isclose(every.eigenvalues[:, None], doublets[:2], rtol=1e-5).sum() == 4


@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("*SELECT CYCLIC SYMMETRY MODES, NMIN=0, NMAX=3\n", "", "requires *SELECT CYCLIC SYMMETRY"),
        ("NMAX=3", "NMAX=4", "nodal diameters of 6 sectors go from 0 to 3, NMIN first; found 0 to"),
        ("NMIN=0, NMAX=3", "NMIN=3, NMAX=2", "found 3 to 2"),
        ("N=6", "N=six", "requires one number N of sectors"),
    ],
)
def test_what_a_sector_lacks_is_said(tmp_path: Path, old: str, new: str, reason: str) -> None:
    text = (disc(False)[0] + STEP.format(0, 3)).replace(old, new)
    with pytest.raises(ModelError, match=r"main\.inp, line \d+: .*" + re.escape(reason)):
        check_frequency_step(model_of(tmp_path, text))


def test_a_sector_has_no_matrices_and_no_parameter_is_sampled_by_them(tmp_path: Path) -> None:
    path = tmp_path / "disc.inp"
    path.write_text(disc(False)[0] + STEP.format(0, 3))
    solver = calculix_solver(path, ())
    with pytest.raises(ModelError, match="matrices of a sector"):
        solver.render({}, MatrixAnalysis())
    assert not solver.offers.matrices
    assert not solver.offers.matrix_modes
    assert solver.deck.energy_sets(parameter("youngs_modulus", "RIM")) == ("RIM",)
    assert not solver.deck.summary.matrix_shapes
