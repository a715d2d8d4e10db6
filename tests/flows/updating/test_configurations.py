"""Several configurations of one structure, updated at once with shared parameters."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.core.errors import CampaignError, SolverCrashed
from modetune.core.modes import MeasuredModes, mode_name
from modetune.core.parameters import ParameterSet, Values
from modetune.core.storage.campaign_record import CampaignRecord, read_record
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.campaign.case import Case, node_base, whole_test
from modetune.flows.campaign.schema import SensitivitySection
from modetune.flows.jobs.execution import Execution
from modetune.flows.report.comparison import mac_table
from modetune.flows.report.form_verdict import record_verdict
from modetune.flows.report.page import page
from modetune.flows.server import artifacts
from modetune.flows.studies.validate.validation import leave_one_out, leave_out
from modetune.flows.updating.baseline import Band, check_deck
from modetune.flows.updating.display import pairing_lines
from modetune.flows.updating.dry_run import dry_run
from modetune.flows.updating.evaluator import evaluator_of
from modetune.flows.updating.record import summary
from modetune.flows.updating.update import update_campaign
from tests.command_line import run_command as modetune
from tests.flows.conftest import ChainDeck, recased

TRUTH = {"k1": 1.2, "m1": 0.9}
KINDS = {"k1": "spring_stiffness", "m1": "mass"}
#: A payload on the third mass.
LOADED = (("m3", 2.5),)


@dataclass(frozen=True)
class Part:
    """A configuration of the chain, and the campaign it would make alone."""

    campaign: Campaign
    case: Case


def part(
    bench: Any,
    name: str,
    added: tuple[tuple[str, float], ...] = (),
    truth: Values = TRUTH,
    kinds: dict[str, str] = KINDS,
    columns: tuple[int, ...] | None = None,
    weight: float = 1.0,
    aside: bool = False,
    **more: Any,
) -> Part:
    """A configuration of the chain: its test is of the true chain with what is added."""
    modes = more.pop("modes", (1,))
    campaign = bench.campaign({**truth, **dict(added)}, modes, parameters=kinds, **more)
    campaign = recased(campaign, solver=replace(bench.solver(), deck=ChainDeck(added)))
    case = replace(campaign.case, name=name, columns=columns, weight=weight, aside=aside)
    return Part(campaign, case)


def joined(parts: tuple[Part, ...], parameters: ParameterSet) -> Campaign:
    """The campaign of several configurations, by the first one's settings."""
    cases = tuple(item.case for item in parts)
    return replace(parts[0].campaign, cases=cases, parameters=parameters)


def both(bench: Any, **more: Any) -> Campaign:
    """The empty chain and the loaded one, updated at once."""
    parts = part(bench, "empty", **more), part(bench, "loaded", LOADED, **more)
    return joined(parts, parts[0].campaign.parameters)


def run(bench: Any, watcher: Any, campaign: Campaign, name: str = "run") -> CampaignRecord:
    return update_campaign(campaign, bench.folder / name, watcher).record


@pytest.mark.parametrize("shapes", [False, True])
def test_two_configurations_find_what_one_cannot(bench: Any, watcher: Any, shapes: bool) -> None:
    if not shapes:
        # One frequency cannot tell a spring from a mass: many pairs agree with it.
        one = run(bench, watcher, part(bench, "empty").campaign, "one")
        assert one.status == "converged"
        assert abs(one.updated[0] - TRUTH["k1"]) > 0.01
    record = run(bench, watcher, both(bench, shapes=shapes), "both")
    assert record.status == "converged"
    np.testing.assert_allclose(record.updated, list(TRUTH.values()), rtol=1e-6)
    assert record.test.numbers == (1, 1)
    assert record.configurations == ("empty", "loaded")


def test_the_mac_of_modes_of_different_configurations_is_zero(bench: Any, watcher: Any) -> None:
    record = run(bench, watcher, both(bench, modes=(1, 2), shapes=True))
    table = mac_table(record, record.best)
    for place, row in enumerate(record.best.pairing.computed.tolist()):
        assert table[row, place] == pytest.approx(1.0)
    # Two modes of each configuration: each rests at the sensors of the other.
    paired = table[record.best.pairing.computed]
    np.testing.assert_array_equal(paired[:2, 2:], 0.0)
    np.testing.assert_array_equal(paired[2:, :2], 0.0)
    assert artifacts.mac_picture(record).startswith(b"\x89PNG")


def test_a_joint_residual_and_sensitivity_are_those_of_the_parts_in_their_order(
    bench: Any,
) -> None:
    campaign = both(bench, modes=(1, 2), shapes=True)
    engine = bench.engine(campaign)
    evaluator = evaluator_of(campaign, engine)
    evaluation, matrix = evaluator.evaluate(0, campaign.start, None, alone=False)
    assert matrix is not None
    # Two frequencies and two shapes at six sensors in each configuration; frequencies go first.
    first, second = evaluation.parts
    z = evaluation.residual.values
    assert evaluation.residual.rows("frequencies") == slice(0, 4)
    np.testing.assert_array_equal(z[:2], first.residual.values[:2])
    np.testing.assert_array_equal(z[2:4], second.residual.values[:2])
    np.testing.assert_array_equal(z[4:16], first.residual.values[2:])
    np.testing.assert_array_equal(z[16:], second.residual.values[2:])
    # Central differences of the whole residual agree with the sensitivity that was put together.
    for column in range(2):
        ends = []
        for step in (1e-4, -1e-4):
            theta = campaign.start.copy()
            theta[column] += step
            ends.append(evaluator.evaluate(1, theta, evaluation, alone=True)[0].residual.values)
        slope = (ends[1] - ends[0]) / 2e-4
        np.testing.assert_allclose(matrix.values[:4, column], slope[:4], rtol=1e-6)
        # Of shapes the residual is cos u_m - u_c: its sensitivity leaves out the part along u_m,
        # which the residual loses as well.
        np.testing.assert_allclose(matrix.values[4:, column], slope[4:], atol=1e-5)


def test_the_jobs_of_all_configurations_go_side_by_side_and_are_counted(
    bench: Any, watcher: Any
) -> None:
    asked: list[list[str]] = []

    class Watched(Execution):
        def _together(self, iteration: str, works: Any) -> Any:
            asked.append([item.name for item in works])
            return super()._together(iteration, works)

    campaign = both(bench)
    engine = bench.engine(campaign)
    evaluator = evaluator_of(campaign, engine, execution=Watched(engine))
    evaluator.evaluate(0, campaign.start, None, alone=False)
    # Until a job has succeeded only those of the first kind, then all else in one go for both.
    assert asked[0] == ["modal of empty", "modal of loaded"]
    assert len(asked) == 2
    assert not any(name.startswith("modal") for name in asked[1])
    assert evaluator.runs.modal == 2
    assert bench.runs() == evaluator.runs.modal + evaluator.runs.sensitivity
    record = run(bench, watcher, campaign)
    assert bench.runs("modal") == record.runs.modal + 2  # those above are in the store
    again = run(bench, watcher, campaign, "again")
    assert (again.runs.modal, again.runs.sensitivity) == (0, 0)
    np.testing.assert_array_equal(again.updated, record.updated)


def test_finite_differences_of_all_configurations_give_the_same_answer(
    bench: Any, watcher: Any
) -> None:
    differences = SensitivitySection(method="finite_difference", difference="central", step=1e-3)
    record = run(bench, watcher, both(bench, sensitivity=differences))
    np.testing.assert_allclose(record.updated, list(TRUTH.values()), rtol=1e-6)
    # Two parameters, two ends each, two configurations in each iteration with a matrix.
    assert record.iterations[0].runs.sensitivity == 8


def test_each_configuration_has_matrices_of_its_own(bench: Any, watcher: Any) -> None:
    matrices = SensitivitySection(method="semi_analytic")
    record = run(bench, watcher, both(bench, sensitivity=matrices))
    np.testing.assert_allclose(record.updated, list(TRUTH.values()), rtol=1e-6)
    # Of each the model, and one job for the spring and the mass, once and for all.
    assert bench.runs("matrices") == record.runs.sensitivity == 4


def test_a_parameter_may_belong_to_one_configuration(bench: Any, watcher: Any) -> None:
    # k1 in both; m3 is the payload's own, known to the loaded one alone.
    payload = {"k1": "spring_stiffness", "m3": "mass"}
    true = {"k1": 1.2, "m3": 1.5}
    empty = part(
        bench,
        "empty",
        truth={"k1": 1.2},
        kinds={"k1": "spring_stiffness"},
        columns=(0,),
        modes=(1, 2),
    )
    loaded = part(bench, "loaded", truth=true, kinds=payload, columns=(0, 1), modes=(1, 2))
    record = run(bench, watcher, joined((empty, loaded), loaded.campaign.parameters))
    np.testing.assert_allclose(record.updated, list(true.values()), rtol=1e-6)
    matrix = record.iterations[-1].sensitivity
    np.testing.assert_array_equal(matrix[:2, 1], 0.0)  # m3 changes nothing in the empty one
    assert (matrix[2:, 1] != 0.0).all()


def test_weights_decide_between_configurations_that_contradict(bench: Any, watcher: Any) -> None:
    # One parameter, two tests of different truths: the heavier one wins.
    kinds = {"k1": "spring_stiffness"}
    ends = []
    for weights in ((1.0, 1e6), (1e6, 1.0)):
        parts = [
            part(bench, f"c{place}", truth={"k1": truth}, kinds=kinds, weight=weight)
            for place, (truth, weight) in enumerate(zip((0.9, 1.2), weights, strict=True), start=1)
        ]
        campaign = joined((parts[0], parts[1]), parts[0].campaign.parameters)
        ends.append(run(bench, watcher, campaign, f"run{weights[0]:g}"))
    assert [record.status for record in ends] == [
        "stationary"
    ] * 2  # e1 holds in both or not at all
    np.testing.assert_allclose([record.updated[0] for record in ends], [1.2, 0.9], atol=1e-4)


def test_e1_must_hold_in_every_configuration(bench: Any) -> None:
    campaign = both(bench)
    engine = bench.engine(campaign)
    evaluator = evaluator_of(campaign, engine)
    evaluation, _ = evaluator.evaluate(0, np.array(list(TRUTH.values())), None, alone=True)
    assert evaluation.agrees(campaign.tolerances)
    # A set on the line of pairs that the empty configuration alone agrees with.
    spoiled = replace(evaluation, errors=evaluation.errors + np.array([0.0, 0.1]))
    assert not spoiled.agrees(campaign.tolerances)


def test_configurations_may_have_other_sensors_and_other_numbers_of_modes(
    bench: Any, watcher: Any
) -> None:
    empty = part(bench, "empty", shapes=True, modes=(1, 2))
    few = empty.case.test.modes.rows([0, 2, 3, 5])
    empty = replace(empty, case=replace(empty.case, test=MeasuredModes((1, 2), few)))
    loaded = part(bench, "loaded", LOADED, shapes=True)
    record = run(bench, watcher, joined((empty, loaded), empty.campaign.parameters))
    np.testing.assert_allclose(record.updated, list(TRUTH.values()), rtol=1e-6)
    # Three frequencies, two shapes at four sensors, one at six.
    assert record.best.residual.values.size == 3 + 2 * 4 + 6
    assert record.best.pairing.mac.min() > 1.0 - 1e-9
    verdict = record_verdict(record)
    assert verdict is not None
    # Of 17 entries two parameters take one each, and each of the three shapes its scale.
    assert verdict.form.dof == 17 - 2 - 3


def test_a_configuration_that_is_held_out_is_judged_and_changes_nothing(
    bench: Any, watcher: Any
) -> None:
    pair = part(bench, "empty"), part(bench, "loaded", LOADED)
    aside = part(bench, "heavy", (("m5", 3.0),), modes=(1, 2), aside=True)
    parameters = pair[0].campaign.parameters
    plain = run(bench, watcher, joined(pair, parameters), "plain")
    before = bench.runs("modal")
    record = run(bench, watcher, joined((*pair, aside), parameters), "with")
    np.testing.assert_array_equal(record.updated, plain.updated)  # bit for bit
    assert bench.runs("modal") == before + 2  # the held-out one before and after, no more
    held = record.held_out
    assert held is not None
    assert held.names == ("mode 1 of heavy", "mode 2 of heavy")
    np.testing.assert_allclose(held.error_updated, 0.0, atol=1e-7)
    assert not held.any_worse
    assert {row["configuration"] for row in summary(record, Path("runs"))["held_out"]} == {"heavy"}  # type: ignore[union-attr,index,call-overload]
    assert record.runs.modal == 2  # the others' are in the store


def test_a_held_out_configuration_that_fails_harms_no_campaign(
    bench: Any, watcher: Any, caplog: pytest.LogCaptureFixture
) -> None:
    pair = part(bench, "empty"), part(bench, "loaded", LOADED)
    parameters = pair[0].campaign.parameters
    plain = run(bench, watcher, joined(pair, parameters), "plain")
    aside = part(bench, "heavy", (("m5", 3.0),), aside=True)
    bench.script({bench.runs() + 2: "short"})  # its run at the updated values
    record = run(bench, watcher, joined((*pair, aside), parameters), "with")
    assert record.status == plain.status == "converged"
    assert "held-out configuration heavy" in caplog.text
    assert record.held_out is not None
    assert np.isnan(record.held_out.updated_hz).all()
    assert record.held_out.any_worse


def test_held_out_modes_of_configurations_keep_their_numbers(bench: Any, watcher: Any) -> None:
    campaign = both(bench, modes=(1, 2))
    record = run(bench, watcher, leave_out(campaign, 2, "loaded"))
    assert record.held_out is not None
    assert record.held_out.names == ("mode 2 of loaded",)
    np.testing.assert_allclose(record.held_out.error_updated, 0.0, atol=1e-7)


def test_leave_one_out_goes_through_the_modes_of_all_configurations(bench: Any) -> None:
    found = leave_one_out(both(bench, modes=(1, 2)), lambda text: None)
    assert [(fold.number, fold.configuration) for fold in found.folds] == [
        (1, "empty"), (2, "empty"), (1, "loaded"), (2, "loaded"),
    ]  # fmt: skip
    assert all(
        fold.held_out is not None
        and fold.held_out.names == (mode_name(fold.number, fold.configuration),)
        for fold in found.folds
    )
    assert found.status == "good"
    assert bench.runs() == found.runs.modal + found.runs.sensitivity
    assert found.folds[-1].name == "without mode 2 of loaded"


def test_the_only_mode_of_a_configuration_leaves_it_out_whole(bench: Any) -> None:
    left = leave_out(both(bench), 1, "loaded")
    assert [item.aside for item in left.cases] == [False, True]
    assert (left.test.numbers, left.used[0].name) == ((1,), "empty")
    with pytest.raises(CampaignError, match="only one"):
        leave_out(left, 1, "empty")


def test_a_failed_run_of_one_configuration_shortens_the_step(bench: Any, watcher: Any) -> None:
    first = run(bench, watcher, both(bench), "first")
    (bench.folder / "store").rename(bench.folder / "old")
    start = sum(item.runs.modal + item.runs.sensitivity for item in first.iterations[:1])
    bench.script({bench.runs() + start + 1: "short"})
    record = run(bench, watcher, both(bench), "second")
    assert record.status == "converged"
    np.testing.assert_allclose(record.updated, list(TRUTH.values()), rtol=1e-6)


def test_a_first_run_that_fails_ends_the_campaign(bench: Any, watcher: Any) -> None:
    # Which of the first runs comes second depends on the machine; here each of them fails.
    bench.script(dict.fromkeys(range(1, 20), "short"))
    with pytest.raises(SolverCrashed):
        run(bench, watcher, both(bench))


def test_the_record_summary_and_report_of_configurations(bench: Any, watcher: Any) -> None:
    record = run(bench, watcher, both(bench, shapes=True, modes=(1, 2)))
    again = read_record(bench.folder / "run" / "campaign.h5")
    assert again.configurations == ("empty", "empty", "loaded", "loaded")
    np.testing.assert_array_equal(again.test.modes.nodes, [*range(1001, 1007), *range(2001, 2007)])
    told: Any = summary(again, Path("runs"))
    assert [(row["configuration"], row["mode"]) for row in told["modes"]] == [
        ("empty", 1), ("empty", 2), ("loaded", 1), ("loaded", 2),
    ]  # fmt: skip
    assert all(row["mac_updated"] > 0.999 for row in told["modes"])
    assert "highest MAC, 1.000 (loaded)" in page(again)
    assert pairing_lines(again) == []
    assert sorted(path.name for path in (bench.folder / "run" / "updated").iterdir()) == [
        "empty",
        "loaded",
    ]
    assert record.solver == "scripted"


def test_a_dry_run_names_the_jobs_of_every_configuration(bench: Any) -> None:
    planned = dry_run(both(bench), bench.folder / "run")
    assert {item.name for item in planned.runs if item.name.startswith("modal")} == {
        "modal of empty",
        "modal of loaded",
    }
    assert bench.runs() == 0


def test_a_baseline_of_configurations_is_checked(bench: Any, watcher: Any) -> None:
    campaign = both(bench)
    run(bench, watcher, campaign)
    found = check_deck(campaign, bench.folder / "run" / "campaign.h5", "initial", Band(0.01, 0.05))
    assert found.within
    assert found.runs.modal == 0


# how parts are made one


def test_modes_side_by_side_have_their_own_sensors_and_numbers(bench: Any) -> None:
    test = MeasuredModes((1, 4), bench.measured({}, (1, 4)))
    case = replace(bench.campaign({}).case, test=test)
    whole = whole_test([case, replace(case, aside=True), case])
    assert whole.numbers == (1, 4, 1, 4)
    assert whole.modes.nodes.tolist() == [*range(1001, 1007), *range(2001, 2007)]
    np.testing.assert_array_equal(whole.modes.mode_shapes[:6, :2], test.modes.mode_shapes)
    np.testing.assert_array_equal(whole.modes.mode_shapes[6:, 2:], test.modes.mode_shapes)
    np.testing.assert_array_equal(whole.modes.mode_shapes[6:, :2], 0.0)
    np.testing.assert_array_equal(whole.modes.mode_shapes[:6, 2:], 0.0)


@pytest.mark.parametrize(
    ("largest", "base"), [(6, 1000), (999, 1000), (1000, 10000), (123456, 10**6)]
)
def test_nodes_of_configurations_cannot_meet(bench: Any, largest: int, base: int) -> None:
    modes = bench.measured({}, (1,)).rows([0])
    test = MeasuredModes((1,), replace(modes, nodes=np.array([largest])))
    assert node_base([test]) == base


def test_a_mode_is_named_by_its_number_and_configuration() -> None:
    assert mode_name(17) == "mode 17"
    assert mode_name(17, "loaded") == "mode 17 of loaded"


# from files: one mass on a spring, with and without a payload M. Measured f1, f2 give both:
#   w1^2 = k / m,  w2^2 = k / (m + M)   =>   m = M w2^2 / (w1^2 - w2^2),  k = m w1^2

STIFFNESS, MASS, PAYLOAD = 1300.0, 1.7, 2.0
CAMPAIGN = """\
name: payload
configurations:
  - name: empty
    model: {deck: empty.yaml, solver: matrices, units: m-kg-s}
    test: {modes: empty.csv}
  - name: loaded
    model: {deck: loaded.yaml, solver: matrices, units: m-kg-s}
    test: {modes: loaded.csv}
parameters:
  - {name: k, quantity: matrix_factor, part: k, bounds: [0.2, 5.0]}
  - {name: m, quantity: matrix_factor, part: m, bounds: [0.2, 5.0]}
update: {step: weighted_least_squares, e1: {frequency: 1.0e-9}, step_limit: 0.5}
report: {page: false}
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    matrix = "%%MatrixMarket matrix coordinate real general\n1 1 1\n1 1 {}\n"
    for name, value in (("k", 1000.0), ("m", 1.5), ("all", 1.5 + PAYLOAD), ("M", PAYLOAD)):
        (tmp_path / f"{name}.mtx").write_text(matrix.format(value))
    for name, mass in (("empty", "m"), ("loaded", "all")):
        parts = "{k: {stiffness: k.mtx}, m: {mass: m.mtx}"
        more = ", payload: {mass: M.mtx}}" if name == "loaded" else "}"
        (tmp_path / f"{name}.yaml").write_text(
            f"stiffness: k.mtx\nmass: {mass}.mtx\nparts: {parts}{more}\n"
        )
    for name, true in (("empty", MASS), ("loaded", MASS + PAYLOAD)):
        frequency = np.sqrt(STIFFNESS / true) / 2 / np.pi
        (tmp_path / f"{name}.csv").write_text(f"mode, 1\nfrequency_hz, {float(frequency)!r}\n")
    (tmp_path / "campaign.yaml").write_text(CAMPAIGN)
    return tmp_path


def closed_form(folder: Path) -> tuple[float, float]:
    """Spring and mass from the two measured frequencies."""
    squares = [
        (2 * np.pi * float((folder / f"{name}.csv").read_text().split()[-1])) ** 2
        for name in ("empty", "loaded")
    ]
    mass = PAYLOAD * squares[1] / (squares[0] - squares[1])
    return float(mass * squares[0]), float(mass)


def test_a_payload_tells_the_mass_from_the_spring_as_the_closed_form_does(folder: Path) -> None:
    done = modetune(folder, "update", "campaign.yaml", "--no-prefect", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    factors = np.array([row["updated"] for row in told["parameters"]])
    found = factors * (1000.0, 1.5)  # the decks' values
    np.testing.assert_allclose(found, closed_form(folder), rtol=1e-7)
    np.testing.assert_allclose(found, (STIFFNESS, MASS), rtol=1e-7)
    assert [(row["mode"], row["configuration"]) for row in told["modes"]] == [
        (1, "empty"),
        (1, "loaded"),
    ]
    for name, mass in (("empty", MASS), ("loaded", MASS + PAYLOAD)):
        text = (folder / "runs" / "payload" / "updated" / name / f"{name}.yaml").read_text()
        written = text.split("mass: ")[1].split()[0]
        matrix = folder / "runs" / "payload" / "updated" / name / written
        np.testing.assert_allclose(float(matrix.read_text().split()[-1]), mass, rtol=1e-7)


def test_the_campaigns_own_model_is_one_configuration_more(folder: Path) -> None:
    (folder / "campaign.yaml").write_text(
        "name: payload\nmodel: {deck: empty.yaml, solver: matrices, units: m-kg-s}\n"
        "test: {modes: empty.csv}\n"
        + CAMPAIGN.replace("name: payload\n", "").replace(
            CAMPAIGN[CAMPAIGN.index("  - name: empty") : CAMPAIGN.index("  - name: loaded")], ""
        )
    )
    campaign = load_campaign(folder / "campaign.yaml")
    assert [item.name for item in campaign.cases] == ["base", "loaded"]
    assert campaign.test.numbers == (1, 1)
    assert campaign.configurations == ("base", "loaded")
    assert campaign.name == "payload"


def test_parameters_go_to_the_configurations_whose_deck_knows_them(folder: Path) -> None:
    (folder / "campaign.yaml").write_text(
        CAMPAIGN.replace(
            "update:", "  - {name: M, quantity: matrix_factor, part: payload}\nupdate:"
        )
    )
    campaign = load_campaign(folder / "campaign.yaml")
    empty, loaded = campaign.cases
    assert campaign.alone(empty).parameters.names == ("k", "m")
    assert campaign.alone(loaded).parameters.names == ("k", "m", "M")
    assert loaded.columns == (0, 1, 2)


def test_a_parameter_may_name_its_configurations(folder: Path) -> None:
    (folder / "campaign.yaml").write_text(
        CAMPAIGN.replace("part: m, bounds", "part: m, configurations: [empty], bounds")
    )
    campaign = load_campaign(folder / "campaign.yaml")
    empty, loaded = campaign.cases
    assert campaign.alone(empty).parameters.names == ("k", "m")
    assert loaded.columns == (0,)


def test_a_campaign_of_one_configuration_is_what_it_was(folder: Path) -> None:
    single = (
        CAMPAIGN[: CAMPAIGN.index("configurations:")]
        + ("model: {deck: empty.yaml, solver: matrices, units: m-kg-s}\ntest: {modes: empty.csv}\n")
        + CAMPAIGN[CAMPAIGN.index("parameters:") :]
    )
    several = load_campaign(folder / "campaign.yaml")
    whole = several.alone(several.cases[0])
    (folder / "campaign.yaml").write_text(single)
    alone = load_campaign(folder / "campaign.yaml")
    assert [item.name for item in alone.cases] == [""]
    assert alone.test.numbers == (1,)
    # Its jobs have the same keys whether it is alone or one of several.
    from modetune.flows.updating.mode_source import campaign_analysis

    contents = [
        item.case.solver.render(item.parameters.values(item.start), campaign_analysis(item)).content
        for item in (alone, whole)
    ]
    assert contents[0] == contents[1]


BAD: list[tuple[str, str, int, str]] = [
    ("name: loaded\n", "name: empty\n", 6, "the name empty is given twice"),
    (
        "test: {modes: loaded.csv}",
        "test: {modes: loaded.csv}\n    weight: 0.0",
        9,
        "greater than 0",
    ),
    (
        "test: {modes: loaded.csv}",
        "test: {modes: loaded.csv, use: [4]}",
        8,
        "mode 4 is asked for, but loaded.csv has modes 1",
    ),
    ("deck: loaded.yaml", "deck: nothing.yaml", 7, "nothing.yaml"),
    (
        "part: m,",
        "part: wheel,",
        11,
        "no deck of a used configuration has the target of m (part wheel)",
    ),
    ("part: m,", "part: m, configurations: [full],", 11, "there is no configuration full"),
    ("part: m,", "part: payload, configurations: [empty],", 11, "payload"),
    ("update: {", "update: {start: last, ", 12, "needs a single configuration"),
    ("report:", "run: {engine: dask}\nreport:", 13, "`engine: local` or `slurm`"),
    ("name: payload\n", "name: payload\ntest: {modes: empty.csv}\n", 1, "both `model` and `test`"),
]


@pytest.mark.parametrize(("old", "new", "line", "said"), BAD)
def test_what_is_wrong_with_configurations_is_told_with_its_line(
    folder: Path, old: str, new: str, line: int, said: str
) -> None:
    assert old in CAMPAIGN
    (folder / "campaign.yaml").write_text(CAMPAIGN.replace(old, new, 1))
    with pytest.raises(CampaignError) as caught:
        load_campaign(folder / "campaign.yaml")
    told = [problem for problem in caught.value.problems if said in problem]
    assert told, caught.value
    assert f"line {line}: " in told[-1] or f"line {line})" in told[-1], told


def test_problems_of_all_configurations_come_at_once(folder: Path) -> None:
    text = CAMPAIGN.replace("empty.csv", "none.csv").replace("deck: loaded.yaml", "deck: none.yaml")
    (folder / "campaign.yaml").write_text(text)
    with pytest.raises(CampaignError) as caught:
        load_campaign(folder / "campaign.yaml")
    said = str(caught.value)
    assert "line 5" in said  # none.csv
    assert "line 7" in said  # none.yaml


def test_configurations_that_are_all_held_out_leave_nothing(folder: Path) -> None:
    text = CAMPAIGN.replace(".csv}\n", ".csv}\n    hold_out: true\n")
    (folder / "campaign.yaml").write_text(text)
    with pytest.raises(CampaignError, match="all configurations are held out"):
        load_campaign(folder / "campaign.yaml")


def test_modes_of_configurations_may_have_any_number(folder: Path) -> None:
    test = (folder / "loaded.csv").read_text()
    (folder / "loaded.csv").write_text(test.replace("mode, 1", "mode, 1200"))
    campaign = load_campaign(folder / "campaign.yaml")
    assert campaign.test.numbers == (1, 1200)


def test_a_parameter_names_configurations_only_where_there_are_some(folder: Path) -> None:
    single = CAMPAIGN[: CAMPAIGN.index("configurations:")] + (
        "model: {deck: empty.yaml, solver: matrices, units: m-kg-s}\ntest: {modes: empty.csv}\n"
        "parameters:\n"
        "  - {name: k, quantity: matrix_factor, part: k, configurations: [empty]}\n"
    )
    (folder / "campaign.yaml").write_text(single)
    with pytest.raises(CampaignError, match="the campaign has none"):
        load_campaign(folder / "campaign.yaml")


def test_a_command_for_one_model_says_so(folder: Path) -> None:
    done = modetune(folder, "modes", "campaign.yaml")
    assert done.returncode == 2
    assert "this command works on one model" in done.stderr
    assert "empty, loaded" in done.stderr
