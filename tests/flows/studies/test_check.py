"""The pre-check: each finding is provoked, sound campaigns pass, one run is reused."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

from modetune.adapters.deck_numbers import Number
from modetune.adapters.solver import ModelSummary
from modetune.configs.cases import write_case
from modetune.core.algebra.rigid_modes import RigidByHand
from modetune.core.correlation.correlation import rigid_body_shapes
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import Measurement
from modetune.core.measurement.registration import Alignment
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats, MeasuredModes, mode_set
from modetune.core.parameters import Quantity
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.mapping import SensorRow
from modetune.flows.campaign.schema import SensitivitySection, UpdateSection
from modetune.flows.cli.command import command_of
from modetune.flows.diagnosis.findings import Finding, worst
from modetune.flows.diagnosis.measured_modes import data_findings
from modetune.flows.diagnosis.missing_modes import unmeasured
from modetune.flows.diagnosis.pairing import preview
from modetune.flows.studies.catalogue import find_study
from modetune.flows.studies.check.pre_check import NO_RUN, PreCheckReport, check_campaign, judged
from modetune.flows.studies.check.study import check_summary
from modetune.flows.updating.update import update_campaign
from tests.flows.conftest import ChainDeck, ScriptedProgram, recased
from tests.node_sensors import by_number

TRUTH = {"k1": 1.2, "k2": 0.8}
N_SENSORS = 8


def sound_test(n_modes: int = 3) -> MeasuredModes:
    """Modes of a string at eight sensors, 10, 20, 30 Hz, with 1 % damping."""
    places = np.arange(1, N_SENSORS + 1) / (N_SENSORS + 1.7)
    shapes = np.stack([np.sin(np.pi * (n + 1) * places) for n in range(n_modes)], axis=1)
    modes = mode_set(
        10.0 * np.arange(1, n_modes + 1),
        shapes,
        np.arange(1, N_SENSORS + 1),
        np.full(N_SENSORS, 3),
        np.full(n_modes, 0.01),
    )
    return MeasuredModes(tuple(range(1, n_modes + 1)), modes)


def changed(edit: Callable[[Any], None], n_modes: int = 3) -> MeasuredModes:
    """The sound test with its shapes edited in place."""
    test = sound_test(n_modes)
    shapes = test.modes.mode_shapes.copy()
    edit(shapes)
    return replace(test, modes=replace(test.modes, mode_shapes=shapes))


def at(level: str, findings: Iterable[Finding]) -> list[str]:
    return [f"{item.where}: {item.what}" for item in findings if item.level == level]


def only(level: str, findings: Iterable[Finding]) -> str:
    """The one finding above good, which must be of this level."""
    findings = list(findings)
    assert [item.level for item in findings if item.level != "good"] == [level]
    return at(level, findings)[0]


# the test's data


def test_a_sound_test_passes_without_a_word() -> None:
    assert list(data_findings(sound_test())) == []


def test_frequencies_alone_pass_too() -> None:
    modes = mode_set([1.0, 2.0])
    assert list(data_findings(MeasuredModes((1, 2), modes))) == []


def test_frequencies_out_of_order_are_told() -> None:
    test = sound_test()
    modes = replace(test.modes, frequencies_hz=np.array([10.0, 30.0, 20.0]))
    said = only("doubtful", data_findings(replace(test, modes=modes)))
    assert said == "test mode 3: the frequencies are not in ascending order"


def test_rigid_body_modes_in_the_test_are_wrong() -> None:
    test = sound_test()
    modes = replace(test.modes, frequencies_hz=np.array([0.0, 10.0, 20.0]))
    said = only("wrong", data_findings(replace(test, modes=modes)))
    assert said == "test mode 1: the frequency is not above zero"


def test_a_frequency_that_stands_twice_is_told() -> None:
    test = sound_test()
    modes = replace(test.modes, frequencies_hz=np.array([10.0, 20.0, 20.0]))
    said = only("doubtful", data_findings(replace(test, modes=modes)))
    assert said == "test modes 2 and 3: two modes have the same frequency, 20 Hz"


def test_damping_in_percent_is_told_with_the_remedy() -> None:
    test = sound_test()
    modes = replace(test.modes, damping_ratios=np.array([0.5, 1.1, 0.3]))
    (found,) = data_findings(replace(test, modes=modes))
    assert found.level == "doubtful"
    assert "divide by 100" in found.remedy


def test_negative_damping_is_told() -> None:
    test = sound_test()
    modes = replace(test.modes, damping_ratios=np.array([0.01, -0.002, 0.01]))
    assert only("doubtful", data_findings(replace(test, modes=modes))).startswith("test mode 2")


def test_a_shape_of_zeros_is_wrong() -> None:
    def erase(shapes: Floats) -> None:
        shapes[:, 1] = 0.0

    said = only("wrong", data_findings(changed(erase)))
    assert said == "test mode 2: the shape is zero at every sensor"


@pytest.mark.parametrize("factor", [1.0, -2.5])
def test_a_copied_shape_is_wrong_whatever_its_scale(factor: float) -> None:
    def copy(shapes: Floats) -> None:
        shapes[:, 2] = factor * shapes[:, 0]

    said = only("wrong", data_findings(changed(copy)))
    assert said == "test modes 1 and 3: two modes have the same shape"


def test_modes_that_the_sensors_hardly_tell_apart_are_named() -> None:
    def approach(shapes: Floats) -> None:
        shapes[:, 2] = shapes[:, 0] + 0.3 * shapes[:, 2]

    said = only("doubtful", data_findings(changed(approach)))
    # By hand: of nearly orthogonal shapes of one length, MAC = 1 / (1 + 0.3^2) = 0.92.
    assert said.startswith("test modes 1 and 3: the sensors can hardly distinguish two modes")


def test_fewer_sensors_than_modes_are_told() -> None:
    test = sound_test(3)
    few = replace(test, modes=test.modes.rows([0, 5]))
    said = at("doubtful", data_findings(few))
    assert ": 2 sensors cannot distinguish 3 modes" in said


def test_a_sensor_that_no_mode_moves_is_named() -> None:
    def silence(shapes: Floats) -> None:
        shapes[4] = 0.0

    assert only("doubtful", data_findings(changed(silence))) == "5.z: no mode moves 1 sensor"


def test_a_channel_that_stands_twice_is_named() -> None:
    def copy(shapes: Floats) -> None:
        shapes[6] = -shapes[2]

    said = only("doubtful", data_findings(changed(copy)))
    assert said == "3.z = 7.z: sensors have identical values in all modes"


def test_a_sensor_with_a_wrong_gain_is_named_with_its_modes() -> None:
    def amplify(shapes: Floats) -> None:
        shapes[3] = 50.0 * shapes[3] + 30.0 * np.array([1.0, -0.3, 0.5])

    findings = list(data_findings(changed(amplify)))
    said = [text for text in at("doubtful", findings) if "times as much" in text]
    assert len(said) == 1
    assert said[0].startswith("sensor 4.z in test mode 1")


# model, modes and pairs


def free_result(
    masses: Sequence[float] = (1.0, 2.0, 3.0, 4.0),
    rigid: Sequence[float] = (-1e-6, 0.0, 1e-7, 1e-7, 2e-7, 1e-6),
) -> tuple[ModalResult, Mesh]:
    """Four masses in space with six rigid modes and four made-up elastic ones at 1, 2, 3, 4 Hz."""
    places = np.array([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]])
    components, nodes = np.tile(np.arange(1, 4), 4), np.repeat(np.arange(1, 5), 3)
    motions = rigid_body_shapes(np.repeat(places, 3, axis=0), components)
    weights = np.repeat(masses, 3)[:, None]
    six = motions @ np.linalg.inv(np.linalg.cholesky(motions.T @ (weights * motions))).T
    full = np.hstack([six, np.random.default_rng(3).standard_normal((12, 4))])
    basis, _ = np.linalg.qr(np.sqrt(weights) * full)
    shapes = np.hstack([six, basis[:, 6:] / np.sqrt(weights)])
    eigenvalues = np.array([*rigid, *(2 * np.pi * np.arange(1.0, 5.0)) ** 2])
    result = ModalResult(
        eigenvalues=eigenvalues,
        modes=mode_set(
            np.sqrt(np.maximum(eigenvalues, 0.0)) / 2 / np.pi,
            shapes,
            nodes,
            components,
            normalisation="mass",
        ),
        groups=(),
        strain_energies=np.zeros((0, 10)),
        total_strain_energy=np.where(np.abs(eigenvalues) < 1e-3, 0.0, 0.5 * eigenvalues),
        mass=float(np.sum(masses)),
        n_rigid=int(np.argmax(np.abs(eigenvalues) >= 1e-3)),
    )
    return result, Mesh(np.arange(1, 5), places, ())


@dataclass(frozen=True)
class Solid(ChainDeck):
    """The chain with another mesh, in three directions."""

    solid: Mesh | None = None

    @property
    def summary(self) -> ModelSummary:
        return replace(super().summary, components=frozenset({1, 2, 3}))

    def mesh(self) -> Mesh:
        return self.solid or super().mesh()


def solid_campaign(bench: Any, result: ModalResult, mesh: Mesh, modes: Sequence[int]) -> Any:
    """A campaign whose test measured these elastic modes (from 1) of a result, without error."""
    campaign = bench.campaign(TRUTH, modes=tuple(modes), shapes=True)
    measured = result.elastic.select(np.array(modes) - 1)
    mapping = replace(campaign.case.mapping, sensors=by_number(measured.nodes, measured.components))
    return recased(
        campaign,
        solver=replace(bench.solver(), deck=Solid(solid=mesh)),
        mapping=mapping,
        test=MeasuredModes(tuple(modes), measured),
    )


def judge(
    bench: Any, result: ModalResult, mesh: Mesh, modes: Sequence[int] = (1, 2)
) -> PreCheckReport:
    return judged(solid_campaign(bench, result, mesh, modes), result, (), 10, NO_RUN)


def test_a_free_model_tells_mass_centre_and_inertia_from_its_modes(bench: Any) -> None:
    report = judge(bench, *free_result())
    assert report.level == "good"
    assert report.facts is not None
    body = report.facts.body
    assert body is not None
    # By hand: masses 1, 2, 3, 4 at the origin and 1, 2, 3 along x, y, z.
    assert body.mass == pytest.approx(10.0)
    assert body.centre == pytest.approx([0.2, 0.6, 1.2])
    assert body.inertia[0, 0] == pytest.approx(3 * 4 + 4 * 9 - 10 * (0.36 + 1.44))
    # About y and z alike: 2 + 36 - 10 (0.04 + 1.44), 2 + 12 - 10 (0.04 + 0.36).
    assert (
        ": centre of gravity (0.2, 0.6, 1.2) m, moments of inertia about it (30, 23.2, 10) kg m^2"
    ) in at("good", report.findings)
    assert any("free: 6 rigid-body modes" in text for text in at("good", report.findings))


def test_mass_that_the_modes_do_not_move_is_told(bench: Any) -> None:
    result, mesh = free_result()
    report = judge(bench, replace(result, mass=12.0), mesh)
    assert "rigid-body modes give a mass of 10" in only("doubtful", report.findings)


def test_a_mass_of_some_directions_only_is_told(bench: Any) -> None:
    result, mesh = free_result()
    shapes = result.modes.mode_shapes.copy()
    shapes[:, 0] *= 1.01  # the first is the motion along x alone, so m_x is 1.01^2 too small
    report = judge(bench, replace(result, modes=replace(result.modes, mode_shapes=shapes)), mesh)
    assert "differs by 2 % between directions" in at("doubtful", report.findings)[0]


def test_a_mass_that_cannot_be_is_told_with_the_units(bench: Any) -> None:
    result, mesh = free_result(masses=[1e7] * 4)
    assert "in units m-kg-s the mass is 4e+07 kg" in only(
        "doubtful", judge(bench, result, mesh).findings
    )
    # The box's diagonal is sqrt(14) m here: 52 m3 of osmium are 1.2e6 kg.
    result, mesh = free_result(masses=[5e5] * 4)
    assert "in a model 3.74 m across" in only("doubtful", judge(bench, result, mesh).findings)


def test_a_mass_that_is_not_known_is_said_to_be_so(bench: Any) -> None:
    result, mesh = free_result()
    report = judge(bench, replace(result, mass=float("nan")), mesh)
    assert report.level == "good"
    assert ": the mass is 10 kg" in at("good", report.findings)  # from the rigid-body modes
    nowhere = Mesh(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), ())
    report = judge(bench, replace(result, mass=float("nan")), nowhere)
    assert any("the mass is unknown" in text for text in at("good", report.findings))


def test_a_model_of_a_strange_size_is_told(bench: Any) -> None:
    result, mesh = free_result()
    huge = replace(mesh, coordinates=1e4 * mesh.coordinates)
    campaign = solid_campaign(bench, result, huge, (1, 2))
    report = check_campaign(campaign, run=False)
    assert "the model is 3.74e+04 m across" in only("doubtful", report.findings)


def test_a_seventh_mode_without_strain_energy_is_a_mechanism_unless_it_is_named(
    bench: Any,
) -> None:
    result, mesh = free_result()
    seven = replace(result, n_rigid=7)
    (said,) = [
        text for text in at("doubtful", judge(bench, seven, mesh).findings) if "mechan" in text
    ]
    assert "7 modes have no strain energy, a free structure has 6" in said
    campaign = solid_campaign(bench, result, mesh, (2, 3))
    meant = replace(campaign.case.solver, rigid_modes=RigidByHand(7, "x.yaml:3"))
    report = judged(recased(campaign, solver=meant), seven, (), 10, NO_RUN)
    assert any(
        "7 rigid modes, as `rigid_modes` says" in text for text in at("good", report.findings)
    )


def test_a_negative_elastic_eigenvalue_is_wrong(bench: Any) -> None:
    result, mesh = free_result(rigid=[-500.0, 20.0, 25.0, 26.0, 28.0, 30.0])
    report = judge(bench, result, mesh)
    assert any("not above zero (-500 (rad/s)^2)" in text for text in at("wrong", report.findings))


def test_a_half_held_model_is_named(bench: Any) -> None:
    result, mesh = free_result(rigid=[1e-7, 2e-7, 9.0, 10.0, 11.0, 12.0])
    report = judge(bench, result, mesh, modes=(5, 6))
    assert any(
        "half held: 2 modes have no strain energy" in text
        for text in at("doubtful", report.findings)
    )


def test_rigid_modes_that_are_not_near_zero_are_told(bench: Any) -> None:
    # By hand: 2e-3 of 1 Hz, so (2e-3 * 2 pi)^2 = 1.58e-4.
    result, mesh = free_result(rigid=[1e-7, 1e-7, 1e-7, 1e-7, 1e-7, 1.58e-4])
    assert "at most 0.002 of the first elastic" in only(
        "doubtful", judge(bench, result, mesh).findings
    )


def test_all_modes_at_zero_are_wrong(bench: Any) -> None:
    result, mesh = free_result()
    campaign = solid_campaign(bench, result, mesh, (1, 2))
    seven = replace(
        result,
        eigenvalues=result.eigenvalues[:6],
        modes=result.modes.select(range(6)),
        strain_energies=np.zeros((0, 6)),
        total_strain_energy=np.zeros(6),
        n_rigid=6,
    )
    report = judged(campaign, seven, (), 6, NO_RUN)
    assert only("wrong", report.findings).startswith(": all 6 computed modes are rigid")


def shifted(test: MeasuredModes, factors: Sequence[float]) -> MeasuredModes:
    modes = test.modes
    return replace(test, modes=replace(modes, frequencies_hz=modes.frequencies_hz * factors))


def judge_changed(
    bench: Any, edit: Callable[[MeasuredModes], MeasuredModes], modes: Sequence[int] = (1, 2)
) -> PreCheckReport:
    result, mesh = free_result()
    campaign = solid_campaign(bench, result, mesh, modes)
    return judged(recased(campaign, test=edit(campaign.test)), result, (), 10, NO_RUN)


def test_a_test_in_rad_per_second_is_recognised(bench: Any) -> None:
    report = judge_changed(bench, lambda test: shifted(test, [6.1, 6.5]))
    assert any("as with frequencies in rad/s" in text for text in at("wrong", report.findings))


def test_a_large_frequency_error_is_told(bench: Any) -> None:
    report = judge_changed(bench, lambda test: shifted(test, [1.0, 0.5]))
    assert only("doubtful", report.findings).endswith("2 Hz computed, 1 Hz measured: +100 %")


def test_a_test_near_the_end_of_the_computed_range_is_told(bench: Any) -> None:
    report = judge_changed(bench, lambda test: test, modes=(1, 2, 3, 4))
    assert "the margin is less than 10 %" in only("doubtful", report.findings)


def test_a_model_with_no_further_modes_has_margin_enough(bench: Any) -> None:
    result, mesh = free_result()
    campaign = solid_campaign(bench, result, mesh, (1, 2, 3, 4))
    assert judged(campaign, result, (), 12, NO_RUN).level == "good"


def test_a_computed_mode_that_the_test_lacks_is_told(bench: Any) -> None:
    report = judge_changed(bench, lambda test: test, modes=(1, 3))
    (found,) = [item for item in report.findings if item.level != "good"]
    assert (found.level, found.remedy) == (
        "doubtful",
        "check whether it was excited and identified",
    )
    assert found.what == "the test has no mode for the model's 2 (2 Hz) within its band"


def test_modes_that_the_campaign_leaves_out_are_said_and_no_fault(bench: Any) -> None:
    result, mesh = free_result()
    campaign = solid_campaign(bench, result, mesh, (1, 2, 3))
    some = recased(campaign, measurement=Measurement(campaign.test), test=campaign.test.use((1, 3)))
    report = judged(some, result, (), 10, NO_RUN)
    assert report.level == "good"
    assert ": elastic mode 2 (2 Hz) is paired with no test mode" in at("good", report.findings)


def test_a_computed_mode_that_the_sensors_hardly_see_is_no_fault(bench: Any) -> None:
    result, mesh = free_result()
    shapes = result.modes.mode_shapes.copy()
    shapes[:, 7] *= 0.05  # elastic mode 2
    quiet = replace(result, modes=replace(result.modes, mode_shapes=shapes))
    campaign = solid_campaign(bench, quiet, mesh, (1, 3))
    found = unmeasured(
        campaign.test,
        campaign.case.sensors.observe(quiet.elastic),
        preview(campaign.test, quiet.elastic),
        False,
    )
    assert [item.level for item in found] == ["good"]


def test_computed_modes_that_the_sensors_cannot_tell_apart_are_no_fault(bench: Any) -> None:
    result, mesh = free_result()
    shapes = result.modes.mode_shapes.copy()
    # By hand: MAC with elastic mode 1 is 1 / (1 + 0.3^2) = 0.92 for shapes at right angles.
    units = shapes / np.linalg.norm(shapes, axis=0)
    shapes[:, 7] = units[:, 6] + 0.3 * units[:, 7]
    alike = replace(result, modes=replace(result.modes, mode_shapes=shapes))
    campaign = solid_campaign(bench, alike, mesh, (1, 3))
    found = unmeasured(
        campaign.test,
        campaign.case.sensors.observe(alike.elastic),
        preview(campaign.test, alike.elastic),
        False,
    )
    assert [item.level for item in found] == ["good"]


def test_a_sensor_upside_down_is_named_with_what_turning_it_gives(bench: Any) -> None:
    def turn(test: MeasuredModes) -> MeasuredModes:
        shapes = test.modes.mode_shapes.copy()
        shapes[8] *= -1.0  # node 3, z
        return replace(test, modes=replace(test.modes, mode_shapes=shapes))

    result, mesh = free_result()
    campaign = solid_campaign(bench, result, mesh, (1, 2, 3))
    report = judged(recased(campaign, test=turn(campaign.test)), result, (), 10, NO_RUN)
    # By hand: with share s of a shape's squared length at the sensor, the MAC is (1 - 2 s)^2.
    shapes = campaign.test.modes.mode_shapes
    macs = (1.0 - 2.0 * shapes[8] ** 2 / np.sum(shapes**2, axis=0)) ** 2
    worst_mode = int(np.argmin(macs))
    assert only("doubtful", report.findings).startswith(
        f"sensor 3.z: reversed? With the other sign the MAC of mode {worst_mode + 1} would be 1.00 "
        f"instead of {macs[worst_mode]:.2f}; its misfit is "
    )
    (remedy,) = [item.remedy for item in report.findings if "reversed?" in item.what]
    assert remedy.endswith("set `test.sensors.reverse: [3.z]`")


def test_axes_that_are_wrong_for_all_sensors_are_named_as_one_fault(bench: Any) -> None:
    result, mesh = free_result()
    campaign = solid_campaign(bench, result, mesh, (1, 2, 3))
    sensors = campaign.case.sensors
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = replace(sensors, directions=sensors.directions @ quarter.T)
    seen = turned.observe(result.elastic).select([0, 1, 2])
    report = judged(
        recased(campaign, test=replace(campaign.test, modes=seen)), result, (), 10, NO_RUN
    )
    (said,) = [text for text in at("doubtful", report.findings) if "all axes" in text]
    assert "all axes turned by 90 degrees about z: mean MAC 1.00 instead of 0." in said


def test_swapped_sensors_are_named(bench: Any) -> None:
    result, mesh = free_result()
    campaign = solid_campaign(bench, result, mesh, (1, 2, 3))
    shapes = campaign.test.modes.mode_shapes.copy()
    shapes[[4, 8]] = shapes[[8, 4]]
    modes = replace(campaign.test.modes, mode_shapes=shapes)
    report = judged(
        recased(campaign, test=replace(campaign.test, modes=modes)), result, (), 10, NO_RUN
    )
    said = [text for text in at("doubtful", report.findings) if "exchanged?" in text]
    assert len(said) == 1
    assert said[0].startswith("sensors 2.y and 3.z: exchanged? With each other's channel the MAC")
    (remedy,) = [item.remedy for item in report.findings if "exchanged?" in item.what]
    assert remedy.endswith("set `test.sensors.exchange: [[2.y, 3.z]]`")


def mixed(test: MeasuredModes, column: int, shape: Any) -> MeasuredModes:
    shapes = test.modes.mode_shapes.copy()
    shapes[:, column] = shape
    return replace(test, modes=replace(test.modes, mode_shapes=shapes))


def test_a_measured_mode_that_nothing_answers_is_wrong(bench: Any) -> None:
    result, _ = free_result()
    apart = np.linalg.svd(result.elastic.mode_shapes)[0][:, -1]  # at right angles to all
    report = judge_changed(bench, lambda test: mixed(test, 1, apart))
    assert only("wrong", report.findings).startswith("test mode 2: no computed mode matches it")


def test_one_that_may_lie_above_the_computed_range_is_doubtful(bench: Any) -> None:
    result, _ = free_result()
    apart = np.linalg.svd(result.elastic.mode_shapes)[0][:, -1]
    report = judge_changed(bench, lambda test: mixed(test, 1, apart), modes=(1, 4))
    said = at("doubtful", report.findings)
    assert any(text.startswith("test mode 4: no computed mode matches it") for text in said)
    assert report.exit_code == 0


def test_a_weak_pair_is_told(bench: Any) -> None:
    result, _ = free_result()
    wanted = result.elastic.mode_shapes[:, 1]
    apart = np.linalg.svd(result.elastic.mode_shapes)[0][:, -1]
    # By hand: MAC = 1 / (1 + 1) for a part of equal length at right angles.
    half = wanted / np.linalg.norm(wanted) + apart
    report = judge_changed(bench, lambda test: mixed(test, 1, half))
    assert "test mode 2: best MAC is 0.50 (elastic mode 2)" in at("doubtful", report.findings)


def test_an_ambiguous_pair_is_named_with_its_rival(bench: Any) -> None:
    result, _ = free_result()
    a, b = (result.elastic.mode_shapes[:, n] for n in (1, 3))
    both = a / np.linalg.norm(a) + 0.98 * b / np.linalg.norm(b)
    report = judge_changed(bench, lambda test: mixed(test, 1, both))
    said = [text for text in at("doubtful", report.findings) if "ambiguous" in text]
    assert said[0].startswith("test mode 2: ambiguous: elastic mode 2 has MAC")
    assert ", mode 4 has" in said[0]


def test_close_modes_that_turn_within_their_space_are_no_fault(bench: Any) -> None:
    result, mesh = free_result()
    campaign = solid_campaign(bench, result, mesh, (2, 3))
    shapes = campaign.test.modes.mode_shapes
    turned = shapes @ np.array([[0.8, -0.6], [0.6, 0.8]])
    modes = replace(campaign.test.modes, mode_shapes=turned, frequencies_hz=np.array([2.50, 2.51]))
    near = recased(campaign, test=replace(campaign.test, modes=modes))
    report = judged(near, result, (), 10, NO_RUN)
    assert report.level == "good"
    assert [mode.subspace_mac for mode in report.modes] == pytest.approx([1.0, 1.0])


def test_more_measured_than_computed_modes_are_wrong(bench: Any) -> None:
    result, mesh = free_result()
    campaign = solid_campaign(bench, result, mesh, (1, 2))
    report = judged(recased(campaign, test=sound_test(5)), result, (), 10, NO_RUN)
    assert any("cannot be paired one-to-one" in text for text in at("wrong", report.findings))


# parameters


def parameters(bench: Any, **changes: Any) -> list[Finding]:
    """Findings on the first of two parameters, changed so."""
    campaign = bench.campaign(TRUTH, shapes=True)
    first, second = campaign.parameters.parameters
    edited = replace(campaign.parameters, parameters=(replace(first, **changes), second))
    return list(check_campaign(replace(campaign, parameters=edited), run=False).findings)


@pytest.mark.parametrize(
    ("changes", "level", "said"),
    [
        (
            {"lower": 1.1, "upper": 2.0, "initial": 1.5},
            "doubtful",
            "exclude the deck's own value",
        ),
        ({"lower": 0.01}, "doubtful", "too wide to limit anything"),
        ({"lower": 0.995, "upper": 1.005}, "doubtful", "are too narrow"),
        ({"lower": 1.0}, "doubtful", "it starts on a bound (1)"),
        ({"quantity": "structural_damping"}, "doubtful", "structural damping does not change freq"),
    ],
)
def test_bounds_that_make_no_sense_are_told(
    bench: Any, changes: dict[str, float], level: str, said: str
) -> None:
    assert said in only(level, parameters(bench, **changes))


def test_poissons_ratio_may_not_reach_a_half(bench: Any) -> None:
    class Steel(ChainDeck):
        def numbers(self, parameter: Any) -> list[Number]:
            return [Number("nu", 0.3, "nu")]

    campaign = bench.campaign({"nu": 1.0}, parameters={"nu": "poissons_ratio"}, bounds=(0.5, 1.7))
    campaign = recased(campaign, solver=replace(bench.solver(), deck=Steel()))
    report = check_campaign(campaign, run=False)
    assert "let Poisson's ratio reach 0.51" in only("wrong", report.findings)  # 0.3 * 1.7
    assert report.exit_code == 2


def test_more_parameters_than_data_are_told_unless_the_step_is_regularised(bench: Any) -> None:
    campaign = bench.campaign(TRUTH, modes=(1,))
    said = only("doubtful", check_campaign(campaign, run=False).findings)
    assert "2 parameters from 1 measured numbers by weighted_least_squares" in said
    exactly = check_campaign(bench.campaign(TRUTH, modes=(1, 2)), run=False)
    assert "can match any test" in only("doubtful", exactly.findings)
    calm = replace(campaign, update=UpdateSection(step="regularised"))
    assert check_campaign(calm, run=False).level == "good"


def test_a_dead_parameter_is_named(bench: Any) -> None:
    class Dead(ScriptedProgram):
        def read(self, *arguments: Any) -> Any:
            result: Any = super().read(*arguments)
            energies = result.strain_energies.copy()
            energies[0] = 0.0009 * result.total_strain_energy
            return replace(result, strain_energies=energies)

    campaign = bench.campaign(TRUTH, shapes=True)
    campaign = recased(campaign, solver=replace(bench.solver(), program=Dead(bench.folder)))
    said = at("doubtful", check_campaign(campaign).findings)
    # Half of 0.0009 a relative change, 1.5 from 0.5 to 2: 0.07 % of five frequencies' 0.2 %.
    assert (
        "parameter k1: dead: at most 0.09 % of the strain energy of any used mode; over its bounds "
        "it moves their frequencies by 1 standard deviations of the test"
    ) in said


def test_parameters_without_energies_are_said_not_to_be_judged(bench: Any) -> None:
    kinds: dict[str, Quantity] = {"k1": "spring_stiffness", "m2": "mass"}
    campaign = bench.campaign({"k1": 1.1, "m2": 1.1}, shapes=True, parameters=kinds)
    report = check_campaign(campaign)
    assert report.level == "good"
    assert any(
        text.startswith("parameter m2: strain energies cannot show its effect")
        for text in at("good", report.findings)
    )


def test_energies_that_do_not_add_up_are_wrong_where_they_are_asked_for(bench: Any) -> None:
    class Reduced(ScriptedProgram):
        def read(self, *arguments: Any) -> Any:
            result: Any = super().read(*arguments)
            return replace(result, total_strain_energy=0.9 * result.total_strain_energy)

    campaign = bench.campaign(TRUTH, sensitivity=SensitivitySection(method="strain_energy"))
    campaign = recased(campaign, solver=replace(bench.solver(), program=Reduced(bench.folder)))
    report = check_campaign(campaign)
    assert "strain energies are 0.9 to 0.9" in only("wrong", report.findings)
    calm = replace(campaign, sensitivity=SensitivitySection())
    assert check_campaign(calm).level == "good"


# sensors


def remapped(campaign: Any, **changes: Any) -> Any:
    return recased(campaign, mapping=replace(campaign.case.mapping, **changes))


def test_two_sensors_on_one_node_and_direction_are_named(bench: Any) -> None:
    campaign = bench.campaign(TRUTH, shapes=True)
    moved = campaign.case.sensors.model_nodes.copy()
    moved[2] = 2
    crowded = remapped(campaign, sensors=replace(campaign.case.sensors, model_nodes=moved))
    said = only("doubtful", check_campaign(crowded, run=False).findings)
    assert said == "sensors 2.x and 3.x: they measure the same direction at the same node"


def test_doubtful_sensors_and_those_left_out_are_named_by_their_reason(bench: Any) -> None:
    campaign = bench.campaign(TRUTH, shapes=True)
    far = [SensorRow(n, "x", n, 9.0, (1.0, 0.0, 0.0), "doubtful", "9 mm away") for n in (4, 5)]
    gone = SensorRow(77, "z", 0, float("nan"), (0.0, 0.0, 1.0), "left out", "no node near")
    report = check_campaign(
        remapped(campaign, table=(*far, gone), notes=("fitted to 2 mm",)), run=False
    )
    assert at("doubtful", report.findings) == [
        "sensor 4.x, 5.x: 9 mm away",
        "sensor 77.z: left out: no node near",
    ]
    assert ": fitted to 2 mm" in at("good", report.findings)


def test_an_alignment_that_is_not_certain_is_doubted_with_what_helps(bench: Any) -> None:
    campaign = remapped(bench.campaign(TRUTH, shapes=True), doubts=("points may slide",))
    (found,) = (
        item for item in check_campaign(campaign, run=False).findings if "slide" in item.what
    )
    assert found.level == "doubtful"
    assert "landmarks in `match`" in found.remedy


def test_a_note_that_begins_with_doubt_is_filed_so(bench: Any) -> None:
    campaign = bench.campaign(TRUTH, shapes=True)
    notes = ("doubtful: modes 2 are far from real", "12 rows were read")
    read = recased(campaign, measurement=replace(campaign.case.measurement, notes=notes))
    found = check_campaign(read, run=False).findings
    assert only("doubtful", found) == ": modes 2 are far from real"
    assert ": 12 rows were read" in at("good", found)


def test_distances_are_said_where_sensors_were_placed(bench: Any) -> None:
    campaign = bench.campaign(TRUTH, shapes=True)
    sensors = replace(campaign.case.sensors, distances=np.array([0.0, 0.0, 3.5, 0.0, 0.0, 0.0]))
    here = Alignment(1.0, np.eye(3), np.zeros(3), np.zeros(6))
    report = check_campaign(remapped(campaign, sensors=sensors, alignment=here), run=False)
    assert any(
        "6 sensors on 6 nodes, at most 3.5 m away" in said for said in at("good", report.findings)
    )


def test_the_model_is_judged_as_the_sensors_see_it(bench: Any) -> None:
    campaign = bench.campaign(TRUTH, shapes=True)
    backwards = campaign.case.sensors.model_nodes[::-1].copy()
    straight = check_campaign(campaign)
    turned = remapped(campaign, sensors=replace(campaign.case.sensors, model_nodes=backwards))
    mapped = check_campaign(turned)
    assert min(mode.mac for mode in straight.modes) > 0.9
    assert min(mode.mac for mode in mapped.modes) < 0.9  # the chain is not symmetric


# cost, and the command


def test_the_pre_check_costs_one_run_and_updating_begins_with_it(bench: Any, watcher: Any) -> None:
    campaign = bench.campaign(TRUTH, shapes=True)
    report = check_campaign(campaign)
    assert (report.level, report.runs.modal, bench.runs()) == ("good", 1, 1)
    again = check_campaign(campaign)
    assert (again.runs.modal, again.runs.reused, bench.runs()) == (0, 1, 1)
    run = update_campaign(campaign, bench.folder / "run", watcher)
    # Every modal run of the record but its first is a new one.
    assert run.record.runs.modal == len(run.record.iterations) - 1
    assert run.record.iterations[0].runs.reused >= 1
    assert bench.runs("modal") == len(run.record.iterations)


def test_without_a_run_nothing_is_started(bench: Any) -> None:
    report = check_campaign(bench.campaign(TRUTH, shapes=True), run=False)
    assert (report.level, report.facts, bench.runs()) == ("good", None, 0)


def test_a_solver_that_fails_is_told_with_all_the_rest(bench: Any) -> None:
    bench.script({1: "rejected"})
    campaign = bench.campaign(TRUTH, bounds=(0.01, 3.0))
    report = check_campaign(campaign)
    assert report.exit_code == 4
    assert "the scripted solver refused its input" in at("wrong", report.findings)[0]
    assert any("too wide to limit anything" in text for text in at("doubtful", report.findings))


def command(monkeypatch: pytest.MonkeyPatch, campaign: Any, *options: str) -> Any:
    app = typer.Typer()
    app.command()(command_of(find_study("check")))
    monkeypatch.setattr("modetune.flows.campaign.sketch.open_model", lambda *_: campaign)
    return CliRunner().invoke(app, ["c.yaml", *options])


def test_the_command_ends_with_zero_and_tells_one_object(
    bench: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = bench.campaign(TRUTH, shapes=True)
    ended = command(monkeypatch, campaign, "--json")
    assert ended.exit_code == 0
    found = json.loads(ended.stdout)
    assert found["status"] == "good"
    assert (found["solver_runs"]["modal"], found["solver_runs"]["reused"]) == (1, 0)
    assert [mode["elastic_mode"] for mode in found["modes"]] == [1, 2, 3, 4, 5]
    assert found["facts"]["mass_kg"] == pytest.approx(9.0)  # the chain's masses added up
    again = check_summary(campaign, check_campaign(campaign))
    ran, answered = found.pop("solver_runs"), again.pop("solver_runs")
    assert isinstance(answered, dict)
    assert set(ran) == set(answered)
    assert (answered["modal"], answered["reused"]) == (0, 1)  # by the store now
    assert found == again


def test_the_command_ends_with_two_where_something_is_wrong(
    bench: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = bench.campaign(TRUTH, shapes=True)
    factor = MeasuredModes(campaign.test.numbers, shifted(campaign.test, [6.28] * 5).modes)
    ended = command(monkeypatch, recased(campaign, test=factor))
    assert ended.exit_code == 2
    assert "as with frequencies in rad/s" in ended.stdout
    assert "Modes before updating" in ended.stdout
    assert ended.stdout.splitlines()[-1].startswith("wrong: 1 wrong")


def test_long_findings_go_on_under_their_own_beginning(
    bench: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = bench.campaign(TRUTH, shapes=True)
    note = "doubtful: " + " ".join(["twelve words"] * 12)
    campaign = recased(campaign, measurement=replace(campaign.case.measurement, notes=(note,)))
    said = StringIO()
    wide = Console(file=said, force_terminal=True, width=60, color_system=None)
    spare = Console(file=StringIO())
    monkeypatch.setattr(
        "modetune.flows.report.terminal.terminal", lambda stderr=False: spare if stderr else wide
    )
    command(monkeypatch, campaign, "--no-run")
    lines = said.getvalue().splitlines()
    first = next(n for n, line in enumerate(lines) if line.startswith("doubtful sensors    twelve"))
    assert lines[first + 1].startswith(20 * " " + "t")  # the width of level and subject
    assert max(map(len, lines[first : first + 4])) <= 60


def test_the_command_without_a_run_says_so(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    ended = command(monkeypatch, bench.campaign(TRUTH, shapes=True), "--no-run")
    assert ended.exit_code == 0
    assert ended.stdout.splitlines()[-1].endswith("; no solver run")
    assert bench.runs() == 0


def test_a_baseline_without_a_run_is_refused(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    ended = command(monkeypatch, bench.campaign(TRUTH), "--no-run", "--against", "base.h5")
    assert isinstance(ended.exception, CampaignError)


def test_no_finding_is_good() -> None:
    assert worst([]) == "good"


# real solvers


def test_the_garteur_twin_passes_without_a_doubt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from modetune.flows.campaign.campaign import load_campaign

    monkeypatch.setenv("MODETUNE_STORE", str(tmp_path / "store"))
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    write_case("garteur", tmp_path)
    report = check_campaign(load_campaign(tmp_path / "twin.yaml"))
    assert (report.level, report.exit_code) == ("good", 0)
    assert report.facts is not None
    assert report.facts.n_rigid == 6
    body = report.facts.body
    assert body is not None
    # The solver's own total of element masses, by another way than the modes.
    assert body.mass == pytest.approx(report.facts.mass, rel=1e-5)
    assert body.centre[1] == pytest.approx(0.0, abs=1e-3)  # the aircraft is symmetric
    # twin.py makes its test with another wing: 8.4 % in the first mode, sqrt(1 / 0.85) - 1.
    assert report.modes[0].error == pytest.approx(0.0847, abs=2e-3)
