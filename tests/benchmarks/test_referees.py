"""Element cards on three solvers against closed forms, and the fine mesh nearer than the coarse."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from benchmarks.referees import CARDS, Card, error

from tests.adapters.solved import needs_ccx, needs_mystran

#: Largest error on the fine mesh in per cent; bars and plates by default. Solids bend with two
#: elements across: linear tetrahedra and wedges lock, and a clamped end is stiffer than a beam's.
DEFAULT = 1.0
LIMITS = {
    ("CHEXA 8", "mystran"): 2.5, ("CHEXA 8", "nastran95"): 8.0,
    ("CPENTA 6", "mystran"): 6.0, ("CPENTA 6", "calculix"): 4.5, ("CPENTA 6", "nastran95"): 45.0,
    ("CPENTA 15", "mystran"): 2.0,
    ("CTETRA 4", "mystran"): 31.0, ("CTETRA 4", "calculix"): 31.0, ("CTETRA 4", "nastran95"): 31.0,
}  # fmt: skip
#: The folder of NASTRAN-95, with bin/nastrn and rf.
FOLDER = os.environ.get("NASTRAN95", "")
SOLVERS = [
    pytest.param("mystran", marks=needs_mystran),
    pytest.param("calculix", marks=needs_ccx),
    pytest.param("nastran95", marks=pytest.mark.skipif(not FOLDER, reason="NASTRAN95 is not set")),
]


@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("lumped", [True, False], ids=["lumped", "coupled"])
@pytest.mark.parametrize("card", CARDS, ids=[card.name for card in CARDS])
def test_a_finer_mesh_is_nearer_to_the_closed_form(card: Card, lumped: bool, solver: str) -> None:
    program = Path(FOLDER) / "bin" / "nastrn"
    if solver == "nastran95" and not card.old:
        pytest.skip("NASTRAN-95 has no such card")
    coarse, fine = (error(solver, card, lumped, mesh, program) for mesh in (1, 2))
    assert isinstance(coarse, float), coarse
    assert isinstance(fine, float), fine
    assert abs(fine) < LIMITS.get((card.name, solver), DEFAULT)
    assert abs(fine) < abs(coarse) or abs(coarse) < DEFAULT
