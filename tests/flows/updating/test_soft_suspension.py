"""Stored matrices of structures on soft springs, and of models whose matrices lack a spring."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.adapters.calculix.model import EditedCalculix
from modetune.adapters.calculix.solver import JOB, CalculixProgram, calculix_solver
from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.solver import Analysis, MatrixAnalysis, ModalAnalysis, Rendered
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.core.parameters import Parameter
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.updating.sensitivities import UnlikeMatrices
from modetune.flows.updating.update import update_campaign
from tests.adapters.ccx_decks import bar
from tests.adapters.mystran_decks import plate
from tests.adapters.solved import Binder, needs_ccx, needs_mystran
from tests.adapters.test_solver_contract import run
from tests.flows.conftest import recased

BRICKS = 30
CORNERS = (1, 2, 4 * BRICKS + 3, 4 * BRICKS + 4)
#: Bounce at 1 Hz and bending at 600 Hz: eigenvalues 4e5 apart, and stiffnesses 1e8.
SOFT = 1e-3


def suspended_bar() -> str:
    """A free bar of bricks on springs at four corners, in three directions each."""
    text = bar("C3D8", held="", bricks=BRICKS)
    for direction in (1, 2, 3):
        rows = "".join(f"{1000 * direction + node}, {node}\n" for node in CORNERS)
        text += f"*ELEMENT, TYPE=SPRING1, ELSET=S{direction}\n{rows}"
        text += f"*SPRING, ELSET=S{direction}\n{direction}\n{SOFT}\n"
    return text


def suspended_plate() -> str:
    """The stepped plate on a spring at each corner in place of its supports."""
    text = plate().replace("SPC = 10\n", "")
    springs = [
        f"CELAS2,{900 + 10 * place + c},{k},{node},{c}"
        for place, node in enumerate((10, 14, 70, 74))
        for c, k in ((1, "1.-2"), (2, "1.-2"), (3, "1.-2"))
    ]
    return text.replace("ENDDATA", "\n".join([*springs, "ENDDATA"]))


def updated(
    folder: Path, deck: str, binder: Binder, watcher: Any, program: CalculixProgram | None = None
) -> CampaignRecord:
    """Update a modulus by stored matrices; the test is the solver's own run at 0.9 of it."""
    calculix = binder is calculix_solver
    name, units, material = ("part.inp", "mm-t-s", "A") if calculix else ("part.bdf", "m-kg-s", "1")
    (folder / name).write_text(deck)
    solver = binder(
        folder / name,
        (Parameter("E", "youngs_modulus", "material", (material,), 0.5, 2.0, 0.2),),
    )
    nodes = tuple(sorted(solver.deck.summary.node_ids))[:4]
    (folder / "truth").mkdir()
    result = run(solver, {"E": 0.9}, ModalAnalysis(10, nodes), folder / "truth")
    assert isinstance(result, ModalResult)
    assert result.n_rigid == 0
    write_modes_csv(folder / "part.csv", range(1, 11), result.modes)
    (folder / "part.yaml").write_text(
        f"name: part\nmodel: {{deck: {name}, solver: {solver.program.name}, units: {units}, "
        "eigensolver: solver}\n"
        "test: {modes: part.csv}\nparameters:\n"
        f"  - {{name: E, quantity: youngs_modulus, material: {material}, bounds: [0.5, 2.0]}}\n"
        "residuals: {frequency_weight: 1.0, shape_weight: 0.0}\n"
        "sensitivity: {method: semi_analytic}\n"
        "update:\n  e1: {frequency: 1.0e-3, mac: 0.0}\nreport: {page: false}\n"
    )
    campaign = load_campaign(folder / "part.yaml", [f"store={folder / 'store'}"])
    if program is not None:
        campaign = recased(campaign, solver=replace(campaign.case.solver, program=program))
    return update_campaign(campaign, folder / "run", watcher).record


@pytest.mark.parametrize(
    ("deck", "binder"),
    [
        pytest.param(suspended_bar(), calculix_solver, marks=needs_ccx, id="calculix"),
        pytest.param(suspended_plate(), mystran_solver, marks=needs_mystran, id="mystran"),
    ],
)
def test_rounding_of_soft_modes_is_no_missing_part(
    deck: str, binder: Binder, tmp_path: Path, watcher: Any
) -> None:
    record = updated(tmp_path, deck, binder, watcher)
    assert record.status == "converged", record.reason
    # e1 lets frequencies be 1e-3 off, so the modulus twice that.
    np.testing.assert_allclose(record.updated, (0.9,), rtol=2e-3)
    assert set(record.iterations[1].sensitivity_methods) == {"semi_analytic"}


@dataclass(frozen=True)
class OtherSprings(CalculixProgram):
    """CalculiX whose matrix jobs, and they alone, have other springs in one direction."""

    stiffness: float = SOFT

    def render(self, deck: EditedCalculix, analysis: Analysis) -> Rendered:
        rendered = super().render(deck, analysis)

        def write(folder: Path) -> None:
            rendered.write(folder)
            if isinstance(analysis, MatrixAnalysis):
                job = folder / f"{JOB}.inp"
                text = job.read_text()
                own = f"*SPRING, ELSET=S3\n3\n{SOFT}"
                assert own in text
                job.write_text(text.replace(own, f"*SPRING, ELSET=S3\n3\n{self.stiffness:.6e}"))

        return replace(rendered, write=write)


@needs_ccx
@pytest.mark.parametrize("share", [1e-6, 0.5, 1.5])
def test_matrices_without_some_of_a_soft_spring_are_refused(
    share: float, tmp_path: Path, watcher: Any
) -> None:
    program = OtherSprings("ccx", stiffness=share * SOFT)
    with pytest.raises(UnlikeMatrices, match="has parts that matrices do not hold"):
        updated(tmp_path, suspended_bar(), calculix_solver, watcher, program)
