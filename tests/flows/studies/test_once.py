"""A campaign's solver runs are made once, whichever of its commands comes first."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import pytest

from modetune.core.errors import CampaignError
from modetune.core.parameters import Quantity
from modetune.core.storage.campaign_record import RunCounts
from modetune.flows.campaign.campaign import Campaign, load_campaign, load_model
from modetune.flows.studies.check.pre_check import PreCheckReport, check_campaign
from modetune.flows.studies.pretest.plan import Pretest, run_pretest
from modetune.flows.studies.pretest.request import PretestSettings
from modetune.flows.updating.update import update_campaign
from tests.adapters.solved import needs_ccx
from tests.flows.updating.test_stored_matrices import NAMED, OWN, STORED, Case, written

pytestmark = needs_ccx

#: Jobs that leave their folders, so that each run of the solver can be counted.
KEPT = "run.keep_jobs=true"
SENSORS = PretestSettings(modes=(1, 2, 3), sensors=4)


def rows(items: Iterable[Sequence[object]]) -> str:
    return "".join(", ".join(map(str, item)) + "\n" for item in items)


def moduli(*materials: str) -> tuple[tuple[str, Quantity, str], ...]:
    return tuple((f"E_{name}", "youngs_modulus", f"material: {name}") for name in materials)


def tuning_fork() -> Case:
    """A fork of bricks held at its foot: stem, a yoke three bricks wide, tines of other metal."""
    cells = [(1, j) for j in range(3)] + [(i, 3) for i in range(3)]
    cells += [(i, j) for i in (0, 2) for j in range(4, 9)]
    ids: dict[tuple[int, int, int], int] = {}

    def node(i: int, j: int, k: int) -> int:
        return ids.setdefault((i, j, k), len(ids) + 1)

    bricks = []
    for i, j in cells:
        round_it = ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))
        bricks.append([node(*at, k) for k in (0, 1) for at in round_it])
    nodes = rows((n, 4.0 * i, 10.0 * j, 5.0 * k) for (i, j, k), n in ids.items())
    stem, tines = (
        rows((n, *of) for n, of in enumerate(bricks, start=1) if (n > 6) is tine)
        for tine in (False, True)
    )
    deck = f"*NODE, NSET=NALL\n{nodes}"
    for name, elements in (("STEM", stem), ("TINES", tines)):
        deck += f"*ELEMENT, TYPE=C3D8I, ELSET={name}\n{elements}{NAMED.format(name)}"
        deck += f"*SOLID SECTION, ELSET={name}, MATERIAL={name}\n"
    deck += "*BOUNDARY\n" + rows((n, 1, 3) for (_, j, _), n in ids.items() if j == 0)
    free = tuple(n for (_, j, _), n in ids.items() if j)
    return Case(deck, moduli("STEM", "TINES"), (0.93, 1.06), free, n_modes=5)


def cymbal() -> Case:
    """A conical disc of shells, held round its hole, its bell of other metal."""
    nodes: list[Sequence[object]] = []
    shells: list[Sequence[object]] = []
    for ring in range(4):
        for place in range(12):
            radius, angle = 15.0 + 25.0 * ring, math.pi * place / 6.0
            at = (
                round(radius * math.cos(angle), 9),
                round(radius * math.sin(angle), 9),
                4.0 * ring,
            )
            nodes.append((12 * ring + place + 1, *at))
            if ring:
                inner, after = 12 * (ring - 1), (place + 1) % 12
                own = (inner + place, inner + 12 + place, inner + 12 + after, inner + after)
                shells.append((len(shells) + 1, *(number + 1 for number in own)))
    deck = f"*NODE, NSET=NALL\n{rows(nodes)}"
    for name, part in (("BELL", shells[:12]), ("BOW", shells[12:])):
        deck += f"*ELEMENT, TYPE=S4, ELSET={name}\n{rows(part)}{NAMED.format(name)}"
        deck += f"*SHELL SECTION, ELSET={name}, MATERIAL={name}\n1.5\n"
    deck += "*BOUNDARY\n" + rows((number, 1, 6) for number in range(1, 13))
    return Case(deck, moduli("BELL", "BOW"), (1.08, 0.95), tuple(range(13, 49)), n_modes=6)


def ladder() -> Case:
    """A leaning ladder of beams, its rungs of wood, pinned at the feet and the top."""
    nodes = [(10 * j + i, 400.0 * i, 100.0 * j, 260.0 * j) for j in range(7) for i in (1, 2)]
    rails = [(10 * j + i, 10 * j + i, 10 * j + 10 + i) for j in range(6) for i in (1, 2)]
    rungs = [(100 + j, 10 * j + 1, 10 * j + 2) for j in range(1, 6)]
    deck = f"*NODE, NSET=NALL\n{rows(nodes)}"
    for name, beams, size in (("RAILS", rails, "25., 60."), ("RUNGS", rungs, "30., 30.")):
        deck += f"*ELEMENT, TYPE=B31, ELSET={name}\n{rows(beams)}{NAMED.format(name)}"
        deck += f"*BEAM SECTION, ELSET={name}, MATERIAL={name}, SECTION=RECT\n"
        deck += f"{size}\n0.1, 1., -.5\n"
    deck += "*BOUNDARY\n" + rows((number, 1, 3) for number in (1, 2, 61, 62))
    return Case(deck, moduli("RAILS", "RUNGS"), (1.1, 0.9), tuple(n for n, *_ in nodes), n_modes=4)


def made(runs: RunCounts) -> int:
    return runs.modal + runs.sensitivity


class Desk:
    """The commands of one campaign, one after another."""

    def __init__(self, file: Path, folder: Path, watcher: Any, *settings: str) -> None:
        self.folder, self.watcher = folder, watcher
        self.file, self.settings = file, [f"store={folder / 'store'}", KEPT, *settings]

    @property
    def campaign(self) -> Campaign:
        return load_campaign(self.file, self.settings)

    def jobs(self) -> list[str]:
        """Keys of the jobs that the solver ran."""
        folder = self.folder / "store" / "jobs"
        return sorted(item.name for item in folder.iterdir()) if folder.exists() else []

    def check(self) -> PreCheckReport:
        return check_campaign(self.campaign)

    def pretest(self) -> Pretest:
        return run_pretest(load_model(self.file, self.settings), SENSORS)

    def update(self) -> RunCounts:
        run = update_campaign(self.campaign, self.folder / "run", self.watcher)
        assert run.record.status == "converged", run.record.reason
        return run.record.runs


@pytest.mark.parametrize(
    ("case", "way", "first"),
    # By matrices: the model's and those of one modulus, the other's are what is left of it; by the
    # solver's own modes the one modal run.
    [(tuning_fork, STORED, 2), (cymbal, STORED, 2), (ladder, OWN, 1), (tuning_fork, OWN, 1)],
    ids=["fork-by-matrices", "cymbal-by-matrices", "ladder", "fork"],
)
def test_check_pretest_and_update_run_each_job_once(
    case: Any, way: str, first: int, tmp_path: Path, watcher: Any
) -> None:
    file = written(case(), tmp_path / "part")
    desk = Desk(file, tmp_path / "one", watcher, way)
    report = desk.check()
    assert (report.level == "wrong", made(report.runs), len(desk.jobs())) == (False, first, first)
    assert {item.parameter for item in report.shares} >= {desk.campaign.parameters.names[0]}
    assert made(desk.pretest().runs) == 0
    checked = desk.jobs()
    ran = made(desk.update())
    assert len(desk.jobs()) == first + ran  # nothing was run anew
    # After updating nothing is run, and what is found is the same.
    again = desk.check()
    assert (made(again.runs), made(desk.pretest().runs)) == (0, 0)
    assert again.shares[0].shares.tolist() == report.shares[0].shares.tolist()
    assert len(desk.jobs()) == first + ran
    # Updating alone takes the same jobs: those of the pre-check are all needed.
    alone = Desk(file, tmp_path / "other", watcher, way)
    alone.update()
    assert alone.jobs() == desk.jobs()
    assert set(checked) <= set(desk.jobs())
    assert (made(alone.check().runs), made(alone.pretest().runs)) == (0, 0)


@pytest.mark.parametrize("case", [tuning_fork, ladder])
def test_left_to_itself_the_pre_check_goes_the_way_that_updating_goes(
    case: Any, tmp_path: Path, watcher: Any
) -> None:
    desk = Desk(written(case(), tmp_path / "part"), tmp_path / "one", watcher)
    checked = made(desk.check().runs)
    assert made(desk.pretest().runs) == 0
    assert len(desk.jobs()) == checked
    ran = made(desk.update())
    assert len(desk.jobs()) == checked + ran
    assert (made(desk.check().runs), made(desk.pretest().runs)) == (0, 0)


def test_shares_of_strain_energy_are_those_that_the_solver_prints(
    tmp_path: Path, watcher: Any
) -> None:
    file = written(tuning_fork(), tmp_path / "part")
    by_matrices, own = (
        Desk(file, tmp_path / way, watcher, f"model.eigensolver={way}").check().shares
        for way in ("pardiso", "solver")
    )
    for one, other in zip(by_matrices, own, strict=True):
        assert one.parameter == other.parameter
        # Energies are printed with seven digits, of a free model's modes by ARPACK.
        assert one.shares == pytest.approx(other.shares, abs=1e-5)
    assert sum(item.shares for item in own) == pytest.approx(1.0, abs=1e-5)


def test_a_mass_that_no_run_tells_is_that_of_the_materials(tmp_path: Path, watcher: Any) -> None:
    desk = Desk(written(tuning_fork(), tmp_path / "part"), tmp_path / "one", watcher, STORED)
    facts = desk.check().facts
    assert facts is not None
    assert facts.mass_by == "materials"  # held: no rigid-body modes
    assert facts.mass_kg == pytest.approx(16 * 4.0 * 10.0 * 5.0 * 2.7e-6)  # sixteen bricks


def test_a_test_that_cannot_be_read_does_not_keep_from_a_pretest(
    tmp_path: Path, watcher: Any
) -> None:
    desk = Desk(written(ladder(), tmp_path / "part"), tmp_path / "one", watcher)
    (tmp_path / "part" / "part.csv").write_text("not a test\n")
    with pytest.raises(CampaignError):
        desk.check()
    assert made(desk.pretest().runs) == 1
