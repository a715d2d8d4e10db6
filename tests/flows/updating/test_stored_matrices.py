"""Updating by stored matrices against updating by ccx's own modes, on small decks, for real."""

from __future__ import annotations

import json
import re
import shutil
import weakref
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from modetune.adapters.calculix.model import EditedCalculix
from modetune.adapters.calculix.solver import JOB, CalculixProgram, calculix_solver
from modetune.adapters.solver import Analysis, MatrixAnalysis, ModalAnalysis, Rendered
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.core.algebra import vector_room
from modetune.core.algebra.eigen import ModeSolver
from modetune.core.errors import CampaignError, SolverExhausted
from modetune.core.parameters import Parameter, Quantity, Values
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.storage.store import Store
from modetune.core.updating.job_results import ModalResult
from modetune.core.updating.parameter_matrices import ParameterMatrices
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.execution import solve_jobs
from modetune.flows.updating import solutions
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.mode_source import Demand, by_solver, modes_forecast, modes_source
from modetune.flows.updating.solutions import MatrixModes
from modetune.flows.updating.update import is_unchanged, read_earlier, update_campaign
from tests.adapters.ccx_decks import bar, plate, wall
from tests.adapters.solved import needs_ccx
from tests.adapters.test_solver_contract import run
from tests.command_line import run_command
from tests.flows.conftest import recased

pytestmark = needs_ccx

STORED = "model.eigensolver=pardiso"
OWN = "model.eigensolver=solver"
#: No noise: the truth can be met to the digits that ccx prints (eigenvalues: seven).
E1 = 1e-6
DENSITY = "2.7e-9"
NAMED = "*MATERIAL, NAME={0}\n*ELASTIC\n70000., 0.3\n*DENSITY\n2.7e-9\n"
CLAMPED = "*BOUNDARY\n{0},1,6\n{2},1,6\n"


@dataclass(frozen=True)
class Case:
    """A deck, what of it is updated (name, quantity, target) and the true relative values."""

    deck: str
    parameters: tuple[tuple[str, Quantity, str], ...]
    truth: tuple[float, ...]
    nodes: tuple[int, ...]
    shape_weight: float = 0.0
    n_modes: int = 6

    @property
    def values(self) -> Values:
        return {item[0]: value for item, value in zip(self.parameters, self.truth, strict=True)}


def row_of_materials(bricks: int = 9) -> str:
    """C3D8I bricks in a row, a third of each of three materials; held at one end."""
    text = bar("C3D8I", bricks=bricks).replace("NAME=A\n", "NAME=A1\n")
    text = text.replace("*SOLID SECTION, ELSET=V, MATERIAL=A\n", "")
    third = bricks // 3
    for place in (1, 2, 3):
        text += NAMED.format(f"A{place}") if place > 1 else ""
        text += f"*ELSET, ELSET=V{place}, GENERATE\n{(place - 1) * third + 1}, {place * third}\n"
        text += f"*SOLID SECTION, ELSET=V{place}, MATERIAL=A{place}\n"
    return text


def joint() -> str:
    """Two plates of S4 that meet at a right angle in nodes 4, 8, 12, each of its own material."""
    upright = wall((4, 8, 12), 30.0).replace("MATERIAL=A", "MATERIAL=B")
    return plate("S4", held=CLAMPED) + NAMED.format("B") + upright


MODULI: tuple[tuple[str, Quantity, str], ...] = tuple(
    (f"E_{place}", "youngs_modulus", f"material: A{place}") for place in (1, 2, 3)
)
BAR = Case(row_of_materials(), MODULI, (1.15, 0.9, 1.1), tuple(range(5, 41)))
JOINT = Case(
    joint(),
    (("E_A", "youngs_modulus", "material: A"), ("E_B", "youngs_modulus", "material: B")),
    (1.1, 0.88),
    (2, 3, 4, 6, 7, 8, 10, 11, 12, 100, 101, 102, 110, 111, 112),
    shape_weight=1.0,
    n_modes=5,
)
THICKNESS = replace(
    JOINT,
    parameters=(("E_A", "youngs_modulus", "material: A"), ("t_U", "thickness", "elset: U")),
    truth=(1.08, 0.93),
    shape_weight=0.0,
)
#: The same with shells of the wall that are not rectangles.
SKEW = THICKNESS.deck.replace("101, 30.0, 10.0, 10.0", "101, 30.5, 11.0, 9.0").replace(
    "111, 30.0, 10.0, 20.0", "111, 29.5, 8.5, 21.0"
)


def written(case: Case, folder: Path) -> Path:
    """The campaign file of a case, with what a test of the true model would give."""
    folder.mkdir(parents=True)
    (folder / "part.inp").write_text(case.deck)
    parameters = tuple(
        Parameter(
            name,
            quantity,
            "elset" if quantity == "thickness" else "material",
            (target.split(": ")[1],),
            0.5,
            2.0,
            0.2,
        )
        for name, quantity, target in case.parameters
    )
    jobs = folder / "truth"
    jobs.mkdir()
    solver = calculix_solver(folder / "part.inp", parameters)
    result = run(solver, case.values, ModalAnalysis(case.n_modes, case.nodes), jobs)
    assert isinstance(result, ModalResult)
    write_modes_csv(folder / "part.csv", range(1, case.n_modes + 1), result.modes)
    items = "".join(
        f"  - {{name: {name}, quantity: {quantity}, {target}}}\n"
        for name, quantity, target in case.parameters
    )
    (folder / "part.yaml").write_text(
        "name: part\nmodel: {deck: part.inp, solver: calculix, units: mm-t-s}\n"
        f"test: {{modes: part.csv}}\nparameters:\n{items}"
        f"residuals: {{frequency_weight: 1.0, shape_weight: {case.shape_weight}}}\n"
        "update:\n  step: weighted_least_squares\n"
        f"  e1: {{frequency: {E1}, mac: 0.99}}\n  e2: 0.0\n"
        "  max_iterations: 12\n  step_limit: 0.5\nreport: {page: false}\n"
    )
    return folder / "part.yaml"


@pytest.fixture(scope="module")
def bar_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(BAR, tmp_path_factory.mktemp("stored") / "bar")


@pytest.fixture(scope="module")
def joint_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(JOINT, tmp_path_factory.mktemp("stored") / "joint")


@pytest.fixture(autouse=True)
def own_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))  # limits of this test alone


def update(file: Path, place: Path, watcher: Any, *settings: str) -> CampaignRecord:
    """The campaign's record; its store is in `place`."""
    campaign = load_campaign(file, [f"store={place / 'store'}", *settings])
    return updated(campaign, place, watcher)


def updated(campaign: Campaign, place: Path, watcher: Any) -> CampaignRecord:
    runs = len(list(place.glob("run*")))
    return update_campaign(campaign, place / f"run{runs}", watcher).record


def apart(record: CampaignRecord) -> float:
    """What the record says of how far the matrices' frequencies were from the solver's own."""
    (found,) = re.findall(
        r"confirmed by calculix.*: frequencies within (\S+)", record.best.decision
    )
    return float(found)


def check_ways_agree(
    case: Case, stored: CampaignRecord, own: CampaignRecord, jobs: int, tolerance: float
) -> None:
    """Both end at the truth; the stored way ran so many matrix jobs and one modal job."""
    assert stored.status == own.status == "converged", (stored.reason, own.reason)
    np.testing.assert_allclose(own.updated, case.truth, rtol=tolerance)
    np.testing.assert_allclose(stored.updated, case.truth, rtol=tolerance)
    assert (stored.runs.sensitivity, stored.runs.modal) == (jobs, 1)
    assert stored.best.solved_by == "calculix"
    assert all(item.solved_by == "stored matrices" for item in stored.iterations[:-1])
    # Both have the digits of one ccx: eigenvalues are printed with seven, matrices with more.
    assert apart(stored) < 1e-6


@pytest.fixture(scope="module")
def bar_stored(bar_file: Path) -> CampaignRecord:
    """The bar's campaign by stored matrices; its store is beside the campaign's file."""
    silent = SimpleNamespace(working=lambda text: None, iteration=lambda record: None)
    return update(bar_file, bar_file.parent, silent, STORED)


def test_three_moduli_end_where_the_solver_takes_them(
    bar_file: Path, bar_stored: CampaignRecord, tmp_path: Path, watcher: Any
) -> None:
    own = update(bar_file, tmp_path, watcher, OWN)
    # Two matrix jobs: the base and the middle part; the outer ones are what these leave.
    # e1 lets frequencies be 1e-6 off, moduli twice that, times a condition of a few.
    check_ways_agree(BAR, bar_stored, own, jobs=2, tolerance=1e-5)


def test_the_last_record_has_the_solvers_own_numbers(
    bar_file: Path, bar_stored: CampaignRecord
) -> None:
    entry = Store(bar_file.parent / "store").get(bar_stored.best.modal_key)
    assert entry is not None
    assert entry.solver == "calculix"
    assert isinstance(entry.result, ModalResult)
    frequencies = entry.result.elastic.frequencies_hz
    np.testing.assert_array_equal(bar_stored.best.computed.frequencies_hz, frequencies)


def test_the_same_campaign_again_runs_nothing_and_ends_on_the_same_bits(
    bar_file: Path, bar_stored: CampaignRecord, watcher: Any
) -> None:
    again = update(bar_file, bar_file.parent, watcher, STORED)
    assert (again.runs.modal, again.runs.sensitivity) == (0, 0)
    assert np.array_equal(again.updated, bar_stored.updated)
    assert np.array_equal(again.best.frequency_errors, bar_stored.best.frequency_errors)
    assert [item.decision for item in again.iterations] == [
        item.decision for item in bar_stored.iterations
    ]


def test_a_campaign_by_matrices_that_did_not_change_starts_where_it_did(
    bar_file: Path, tmp_path: Path, watcher: Any
) -> None:
    settings = [f"store={tmp_path / 'store'}", STORED, "update.start=last"]
    campaign = load_campaign(bar_file, [*settings, "update.max_iterations=1"])
    first = update_campaign(campaign, tmp_path / "run", watcher).record
    earlier = read_earlier(tmp_path / "run")
    assert earlier is not None
    assert is_unchanged(campaign, job_engine(campaign), earlier)
    again = update_campaign(campaign, tmp_path / "run", watcher).record
    assert (again.runs.modal, again.runs.sensitivity) == (0, 0)
    np.testing.assert_array_equal(again.iterations[0].parameters, first.iterations[0].parameters)
    deck = bar_file.parent / "part.inp"
    other = tmp_path / "other"
    shutil.copytree(bar_file.parent, other, ignore=shutil.ignore_patterns("store", "run*"))
    (other / deck.name).write_text(deck.read_text().replace("70000.", "71000."))
    changed = replace(load_campaign(other / bar_file.name, settings), settings=campaign.settings)
    assert not is_unchanged(changed, job_engine(changed), earlier)


def test_a_short_last_step_goes_to_the_solver_without_another_solution(
    bar_file: Path, tmp_path: Path, watcher: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    solved: list[int] = []
    real = ModeSolver.solve

    def counting(self: ModeSolver, *given: Any) -> Any:
        solved.append(1)
        return real(self, *given)

    monkeypatch.setattr(ModeSolver, "solve", counting)
    record = update(bar_file, tmp_path, watcher, STORED)
    assert record.status == "converged"
    assert len(record.iterations) == len(solved) + 1
    assert record.best.solved_by == "calculix"
    assert record.runs.modal == 1
    assert apart(record) < 1e-6


def test_factors_have_left_memory_when_the_solver_has_the_last_word(
    bar_file: Path, tmp_path: Path, watcher: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    held: list[weakref.ref[MatrixModes]] = []
    left: list[bool] = []
    begin, confirm = MatrixModes.__init__, Evaluator._confirmed

    def begun(self: MatrixModes, *given: Any) -> None:
        begin(self, *given)
        held.append(weakref.ref(self))

    def confirmed(self: Evaluator, *given: Any) -> Any:
        left.append(all(each() is None for each in held))
        return confirm(self, *given)

    monkeypatch.setattr(MatrixModes, "__init__", begun)
    monkeypatch.setattr(Evaluator, "_confirmed", confirmed)
    assert update(bar_file, tmp_path, watcher, STORED).status == "converged"
    assert (len(held), left) == (1, [True])


def test_matrices_of_the_jobs_do_not_stay_beside_what_was_made_of_them(
    bar_file: Path, bar_stored: CampaignRecord, tmp_path: Path
) -> None:
    fresh, store = (
        load_campaign(bar_file, [f"store={folder / 'store'}", STORED])
        for folder in (tmp_path, bar_file.parent)
    )
    source, kept = (
        modes_source(item, by_solver(item, job_engine(item))) for item in (fresh, store)
    )
    assert source is not None
    assert kept is not None
    start, columns = fresh.start, range(3)
    jobs = source.jobs(start, columns)
    assert len(jobs) == 2
    assert kept.key(start, columns) in store.store
    assert kept.jobs(start, columns) == ()
    assert not any(kept.engine.key(job) in store.store for job in jobs)


def test_a_spring_beside_the_bricks_is_none_of_their_parts(tmp_path: Path, watcher: Any) -> None:
    # It takes part of the stiffness, so what one modulus leaves is not the others' alone.
    spring = "*ELEMENT, TYPE=SPRING1, ELSET=K\n200, 40\n*SPRING, ELSET=K\n3\n1000.\n"
    case = replace(BAR, deck=BAR.deck + spring)
    file = written(case, tmp_path / "case")
    stored = update(file, tmp_path / "stored", watcher, STORED)
    own = update(file, tmp_path / "own", watcher, OWN)
    check_ways_agree(case, stored, own, jobs=3, tolerance=1e-5)


def test_modulus_and_density_share_their_job(tmp_path: Path, watcher: Any) -> None:
    density: tuple[str, Quantity, str] = ("rho_3", "density", "material: A3")
    case = replace(BAR, parameters=(MODULI[2], density), truth=(0.9, 1.1))
    file = written(case, tmp_path / "case")
    stored = update(file, tmp_path / "stored", watcher, STORED)
    own = update(file, tmp_path / "own", watcher, OWN)
    # The base, and one job for both.
    check_ways_agree(case, stored, own, jobs=2, tolerance=1e-5)


def test_shells_with_sensors_in_the_corner_end_where_the_solver_takes_them(
    joint_file: Path, tmp_path: Path, watcher: Any
) -> None:
    stored = update(joint_file, tmp_path / "stored", watcher, STORED)
    # Shapes of shells go by finite differences there, which do not know the matrices at all.
    own = update(joint_file, tmp_path / "own", watcher, OWN)
    # The plates share the corner's nodes; their moduli make up the model.
    check_ways_agree(JOINT, stored, own, jobs=2, tolerance=1e-5)
    seen = set(stored.best.computed.nodes.tolist())
    assert {4, 8, 12} <= seen
    # Shapes as ccx prints them: seven digits.
    assert stored.best.pairing.mac.min() > 1.0 - 1e-6


@pytest.mark.parametrize(
    "deck",
    [
        pytest.param(
            THICKNESS.deck,
            id="rectangles",
        ),
        pytest.param(SKEW, id="skew"),
    ],
)
def test_a_thickness_beside_a_modulus_ends_where_the_solver_takes_it(
    deck: str, tmp_path: Path, watcher: Any
) -> None:
    case = replace(THICKNESS, deck=deck)
    file = written(case, tmp_path / "case")
    stored = update(file, tmp_path / "stored", watcher, STORED)
    own = update(file, tmp_path / "own", watcher, OWN)
    # The base, a modulus, four powers of the thickness.
    check_ways_agree(case, stored, own, jobs=6, tolerance=1e-5)


def test_auto_takes_the_solver_for_a_small_model_without_a_word(
    bar_file: Path, tmp_path: Path, watcher: Any, caplog: pytest.LogCaptureFixture
) -> None:
    record = update(bar_file, tmp_path, watcher)
    assert record.status == "converged"
    assert {item.solved_by for item in record.iterations} == {"calculix"}
    # One modal job a set; its strain energies are all that moduli need.
    assert (record.runs.modal, record.runs.sensitivity) == (len(record.iterations), 0)
    assert not [entry for entry in caplog.records if entry.levelname == "WARNING"]


def test_the_way_that_takes_less_is_taken_told_and_kept(
    bar_file: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    campaign = load_campaign(bar_file, [f"store={tmp_path / 'store'}"])
    own = by_solver(campaign, job_engine(campaign))
    caplog.set_level("INFO")
    assert modes_source(campaign, own) is None
    few = "by the solver's own runs: 2 matrix jobs, about [0-9.]+ s in all, against 4 runs, about"
    assert re.search(few, caplog.text)
    assert "judged by the number of elements" in caplog.text
    (outcome,) = solve_jobs(own.source.engine, [own.job(campaign.start, ModalAnalysis(6, ()))])
    entry, holding = campaign.store.get(outcome.key), campaign.store.holding(outcome.key)
    assert entry is not None
    assert holding is not None
    # A run that took half a minute makes matrices worth their while, but not where it was chosen.
    campaign.store.put(replace(entry, wall_s=30.0), holding.asked, holding.note)
    assert modes_source(campaign, own) is None
    once = Demand(1, 2)
    assert modes_source(campaign, own, once) is not None
    assert re.search(r"by matrices: 2 matrix jobs.* against 3 runs.*30 s, as measured", caplog.text)
    assert modes_forecast(campaign, own, once) == modes_forecast(campaign, own, once)


def test_a_choice_that_nothing_may_be_kept_of_is_made_all_the_same(
    bar_file: Path, tmp_path: Path
) -> None:
    campaign = load_campaign(bar_file, [f"store={tmp_path / 'store'}"])
    engine = replace(job_engine(campaign), may_run=False)
    assert modes_source(campaign, by_solver(campaign, engine)) is None
    assert not (tmp_path / "store").exists()


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        (
            "parameters=[{name: nu, quantity: poissons_ratio, material: A1}]",
            "the stiffness is not a polynomial in nu",
        ),
        (
            "sensitivity.method=finite_difference",
            "sensitivity.method is finite_difference",
        ),
    ],
    ids=["Poisson's ratio", "finite differences"],
)
def test_stored_matrices_that_cannot_be_had_are_refused_in_one_sentence(
    bar_file: Path, tmp_path: Path, setting: str, said: str
) -> None:
    store = f"store={tmp_path / 'store'}"
    with pytest.raises(CampaignError) as caught:
        load_campaign(bar_file, [store, STORED, setting])
    (problem,) = str(caught.value).splitlines()
    assert said in problem
    assert "use `auto`" in problem
    assert "part.yaml" in problem
    # The same campaign is fine by `auto`, which takes the solver.
    campaign = load_campaign(bar_file, [store, setting])
    assert modes_source(campaign, by_solver(campaign, job_engine(campaign))) is None


@dataclass(frozen=True)
class HeavyMatrices(CalculixProgram):
    """CalculiX whose matrix jobs, and they alone, have materials that are 1 % heavier."""

    def render(self, deck: EditedCalculix, analysis: Analysis) -> Rendered:
        rendered = super().render(deck, analysis)

        def write(folder: Path) -> None:
            rendered.write(folder)
            if isinstance(analysis, MatrixAnalysis):
                job = folder / f"{JOB}.inp"
                text = job.read_text()
                assert DENSITY in text
                job.write_text(text.replace(DENSITY, "2.727e-9"))

        return replace(rendered, write=write)


def test_matrices_of_another_model_are_found_out_and_the_solver_goes_on(
    bar_file: Path, tmp_path: Path, watcher: Any, caplog: pytest.LogCaptureFixture
) -> None:
    campaign = load_campaign(bar_file, [f"store={tmp_path / 'store'}", STORED])
    solver = campaign.case.solver
    heavy = replace(solver, program=HeavyMatrices("ccx"))
    record = updated(recased(campaign, solver=heavy), tmp_path, watcher)
    warnings = [entry.getMessage() for entry in caplog.records if entry.levelname == "WARNING"]
    # Frequencies go with the root of the density: 1.01^0.5 = 1.00499.
    assert warnings == [
        "the solver's own frequencies differ by 5.0e-03: modes are the solver's own from now on"
    ]
    assert record.status == "converged"
    np.testing.assert_allclose(record.updated, BAR.truth, rtol=1e-4)
    makers = [item.solved_by for item in record.iterations]
    turn = makers.index("calculix")
    assert 0 < turn < len(makers) - 1
    assert set(makers[:turn]) <= {"stored matrices", "reduced_model"}
    assert set(makers[turn:]) == {"calculix"}
    # Moduli that fit the heavy model are those of the truth, 1 % higher.
    there = record.iterations[turn].parameters
    np.testing.assert_allclose(there, 1.01 * np.array(BAR.truth), rtol=1e-4)
    # The confirming run had no strain energies, which the solver's own sensitivities are made of.
    assert record.runs.modal == len(makers) - turn + 1


def test_a_dry_run_tells_the_matrix_jobs_of_a_fresh_store(bar_file: Path, tmp_path: Path) -> None:
    told = told_dry_run(bar_file, tmp_path / "store")
    assert told["status"] == "would run"
    assert [item["name"] for item in told["jobs"]] == ["matrices 1 of 2", "matrices 2 of 2"]
    assert not any(item["stored"] for item in told["jobs"])
    assert told["runs"] == 2
    assert not (tmp_path / "store").exists()


def test_a_dry_run_after_the_campaign_has_nothing_to_run(
    bar_file: Path, bar_stored: CampaignRecord
) -> None:
    told = told_dry_run(bar_file, bar_file.parent / "store")
    assert (told["status"], told["runs"], told["jobs"]) == ("complete", 0, [])
    assert told["reason"] == bar_stored.reason


def told_dry_run(file: Path, store: Path) -> Any:
    """What `modetune update --dry-run --json` prints."""
    done = run_command(
        file.parent,
        "update",
        str(file),
        "--dry-run",
        "--json",
        "--runs",
        str(file.parent / "none"),
        "--set",
        f"store={store}",
        "--set",
        STORED,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def side_by_side(folder: Path, eigensolver: str) -> Path:
    """A campaign of the bar as it is and on a spring, with one set of moduli."""
    spring = "*ELEMENT, TYPE=SPRING1, ELSET=K\n200, 40\n*SPRING, ELSET=K\n3\n1000.\n"
    decks = {"plain": BAR.deck, "sprung": BAR.deck + spring}
    for name, deck in decks.items():
        written(replace(BAR, deck=deck), folder / name)
    model = f"solver: calculix, units: mm-t-s, eigensolver: {eigensolver}"
    items = "".join(
        f"  - name: {name}\n    model: {{deck: {name}/part.inp, {model}}}\n"
        f"    test: {{modes: {name}/part.csv}}\n"
        for name in decks
    )
    text = (folder / "plain" / "part.yaml").read_text()
    one = "model: {deck: part.inp, solver: calculix, units: mm-t-s}\ntest: {modes: part.csv}\n"
    assert one in text
    file = folder / "both.yaml"
    file.write_text(text.replace(one, f"configurations:\n{items}"))
    return file


def test_each_configuration_has_matrices_of_its_own(tmp_path: Path, watcher: Any) -> None:
    stored = update(side_by_side(tmp_path / "a", "pardiso"), tmp_path / "stored", watcher)
    own = update(side_by_side(tmp_path / "b", "solver"), tmp_path / "own", watcher)
    assert stored.status == own.status == "converged", (stored.reason, own.reason)
    np.testing.assert_allclose(own.updated, BAR.truth, rtol=1e-5)
    np.testing.assert_allclose(stored.updated, BAR.truth, rtol=1e-5)
    # Matrix jobs of the plain bar (2) and of the sprung one (3), and each solver's last word.
    assert (stored.runs.sensitivity, stored.runs.modal) == (2 + 3, 2)
    assert stored.best.solved_by == "calculix"
    assert all(item.solved_by == "stored matrices" for item in stored.iterations[:-1])
    assert apart(stored) < 1e-6
    # The solver's way runs both models at every set, and takes moduli from their energies.
    assert (own.runs.sensitivity, own.runs.modal) == (0, 2 * len(own.iterations))


@pytest.mark.parametrize("eigensolver", [STORED, OWN])
def test_a_limit_of_memory_holds_whoever_finds_the_modes(
    tmp_path: Path, watcher: Any, caplog: pytest.LogCaptureFixture, eigensolver: str
) -> None:
    """A megabyte: no factors, and solver runs that are told to be larger."""
    file = written(replace(BAR, deck=row_of_materials(60)), tmp_path / "long")
    limit = ["run.memory_gb=0.001", eigensolver, "update.max_iterations=1"]
    if eigensolver == STORED:
        with pytest.raises(SolverExhausted, match=r"1263 equations.* raise `run\.memory_gb`"):
            update(file, tmp_path, watcher, *limit)
    else:
        assert update(file, tmp_path, watcher, *limit).iterations
    assert "more than the available 0.001 GB (`run.memory_gb`" in caplog.text
    assert not list((tmp_path / "store").glob("jobs/factors-*"))


def test_matrices_and_bases_in_files_lead_to_the_same_bits(
    bar_file: Path,
    bar_stored: CampaignRecord,
    tmp_path: Path,
    watcher: Any,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(solutions, "IN_MEMORY", 0.0)
    put, real = list[Path](), ParameterMatrices.in_files

    def in_files(self: ParameterMatrices, folder: Path) -> ParameterMatrices:
        put.append(folder)
        return real(self, folder)

    bases = list[tuple[int, ...]]()

    def put_in_file(folder: Path, array: Any) -> Any:
        bases.append(array.shape)
        return vector_room.put_in_file(folder, array)

    monkeypatch.setattr(ParameterMatrices, "in_files", in_files)
    monkeypatch.setattr(solutions, "put_in_file", put_in_file)
    record = update(bar_file, tmp_path, watcher, STORED)
    assert bases  # those of reduced models too
    assert len(put) == 1  # once a campaign, in a folder of the store
    assert put[0].parent == tmp_path / "store" / "jobs"
    assert not put[0].exists()
    np.testing.assert_array_equal(record.updated, bar_stored.updated)


def test_factors_in_single_precision_lead_to_the_same_answer(tmp_path: Path, watcher: Any) -> None:
    file = written(replace(BAR, deck=row_of_materials(60)), tmp_path / "long")
    mixed, double = (
        update(file, tmp_path / way, watcher, f"model.eigensolver={way}", "update.confirm=matrices")
        for way in ("mixed_precision", "pardiso")
    )
    makers = [item.solved_by for item in mixed.iterations[:-1]]
    assert set(makers) == {"stored matrices, factors in single precision"}
    # Signs of pivots in single precision prove nothing.
    assert re.fullmatch(r"calculix's matrices, \d+ modes not counted", mixed.best.solved_by)
    assert re.fullmatch(r"calculix's matrices, \d+ modes counted", double.best.solved_by)
    assert mixed.status == double.status == "converged"
    for way in (mixed, double):
        assert (way.runs.sensitivity, way.runs.modal) == (3, 0)
    np.testing.assert_allclose(mixed.updated, double.updated, rtol=1e-6)
    # A store that has the results has their provenance: a second run computes nothing.
    place, setting = tmp_path / "mixed_precision", "model.eigensolver=mixed_precision"
    again = update(file, place, watcher, setting, "update.confirm=matrices")
    assert (again.runs.sensitivity, again.runs.modal) == (0, 0)
    assert [item.solved_by for item in again.iterations] == [i.solved_by for i in mixed.iterations]


def test_its_own_matrices_at_the_end_confirm_as_its_modes_do(
    bar_file: Path, bar_stored: CampaignRecord, tmp_path: Path, watcher: Any
) -> None:
    record = update(bar_file, tmp_path, watcher, STORED, "update.confirm=matrices")
    assert record.status == "converged"
    # Two jobs for the matrices of all values, one at the final ones; no modal job.
    assert (record.runs.sensitivity, record.runs.modal) == (3, 0)
    assert re.fullmatch(r"calculix's matrices, \d+ modes counted", record.best.solved_by)
    # The last set was foreseen by a reduced model, which is believed to a tenth of e1.
    assert apart(record) < 0.1 * E1
    np.testing.assert_array_equal(record.updated, bar_stored.updated)
    # CalculiX prints eigenvalues with seven digits.
    np.testing.assert_allclose(
        record.best.computed.frequencies_hz, bar_stored.best.computed.frequencies_hz, rtol=1e-6
    )
    assert record.best.pairing.mac.min() > 1.0 - 1e-6
    again = update(bar_file, tmp_path, watcher, STORED, "update.confirm=matrices")
    assert (again.runs.sensitivity, again.runs.modal) == (0, 0)
    np.testing.assert_array_equal(
        again.best.computed.frequencies_hz, record.best.computed.frequencies_hz
    )
    # Nor do its matrices stay beside what was made of them.
    store = Store(tmp_path / "store")
    makers = [
        entry.solver
        for file in store.entries()
        if (entry := store.get(file.name.partition(".")[0]))
    ]
    assert set(makers) == {"modetune"}


def test_confirming_by_matrices_where_modes_are_the_solvers_own_is_refused_or_told(
    bar_file: Path, tmp_path: Path, watcher: Any, caplog: pytest.LogCaptureFixture
) -> None:
    by = "update.confirm=matrices"
    with pytest.raises(CampaignError, match=r"line \d+: `update\.confirm: matrices` needs modes"):
        load_campaign(bar_file, [by, "model.eigensolver=solver"])
    settings = (by, "model.eigensolver=auto", "update.max_iterations=0")
    update(bar_file, tmp_path, watcher, *settings)  # of so few elements, by itself
    assert (
        "`update.confirm: matrices` has nothing to confirm: by the solver's own runs: 2"
        in caplog.text
    )


@dataclass(frozen=True)
class HeavyAtLast(HeavyMatrices):
    """Only the matrices after the two that those for all values are made of are heavier."""

    jobs: list[Path] = field(default_factory=list)

    def render(self, deck: EditedCalculix, analysis: Analysis) -> Rendered:
        heavy = super().render(deck, analysis)
        rendered = CalculixProgram.render(self, deck, analysis)

        def write(folder: Path) -> None:
            if isinstance(analysis, MatrixAnalysis):
                self.jobs.append(folder)
            (heavy if len(self.jobs) > 2 else rendered).write(folder)

        return replace(rendered, write=write)


def test_matrices_at_the_end_that_are_others_are_found_out(
    bar_file: Path, tmp_path: Path, watcher: Any, caplog: pytest.LogCaptureFixture
) -> None:
    settings = [f"store={tmp_path / 'store'}", STORED, "update.confirm=matrices"]
    campaign = load_campaign(bar_file, settings)
    late = HeavyAtLast("ccx")
    changed = recased(campaign, solver=replace(campaign.case.solver, program=late))
    record = updated(changed, tmp_path, watcher)
    assert len(late.jobs) == 3
    warnings = [entry.getMessage() for entry in caplog.records if entry.levelname == "WARNING"]
    assert warnings == [
        "frequencies by calculix's matrices differ by 5.0e-03: using its own modes instead"
    ]
    # These agree with the matrices of all values.
    assert record.status == "converged"
    assert record.best.solved_by == "calculix"
    assert record.runs.modal == 1
    np.testing.assert_allclose(record.updated, BAR.truth, rtol=1e-5)
