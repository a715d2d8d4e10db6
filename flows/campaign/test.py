"""The test of a campaign: read, reduced to the used modes, and mapped to the model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from modetune.adapters.solver import Solver
from modetune.adapters.test_files.environment_csv import seconds_of
from modetune.adapters.test_files.measurements import read_measurement
from modetune.adapters.yaml_file import YamlFile
from modetune.core.errors import CampaignError, ModesError
from modetune.core.measurement.measurement import MeasuredFrfs, Measurement
from modetune.core.measurement.repeated_tests import check_alike, mean_of_tests
from modetune.core.measurement.response_functions import Complexes
from modetune.core.measurement.sensor_corrections import correct_sensors
from modetune.core.measurement.sensor_map import SensorMap
from modetune.core.mesh import Mesh
from modetune.core.modes import MeasuredModes, ModeSet, mode_set
from modetune.core.storage.store import Store
from modetune.flows.campaign.mapping import Mapping, map_sensors
from modetune.flows.campaign.schema import NO_TEST, CampaignFile, OpenFile, TestSection
from modetune.flows.campaign.units import LENGTH_METRES, METRES
from modetune.flows.responses.residuals import kept_sensors, weight_problems

#: Number of nodes whose shapes identify modes where the test has no sensors.
TRACKING_NODES = 200
#: Their places follow multiples of the golden ratio, which no regular numbering of a mesh repeats.
GOLDEN = (5.0**0.5 - 1.0) / 2.0


def read_test(source: YamlFile, file: CampaignFile, problems: list[str]) -> Measurement | None:
    """Return the test, or None with problems where it lacks modes that the campaign names."""
    if isinstance(file, OpenFile) and file.test.modes == NO_TEST:
        return Measurement(MeasuredModes((), mode_set([])))
    names = (file.test.modes,) if isinstance(file.test.modes, str) else file.test.modes
    metres = None if file.test.length is None else LENGTH_METRES[file.test.length]
    try:
        measurement = read_measurement(
            [source.path.parent / name for name in names], metres, file.test.axes
        )
    except CampaignError as error:
        where = source.where(("test", "modes"))
        lacking = [name for name in names if not (source.path.parent / name).exists()]
        remedies = [_remedy(source, name) for name in lacking]
        problems += [f"{problem} (named in {where})" for problem in error.problems]
        problems += [
            f"{name}: {text}" for name, text in zip(lacking, remedies, strict=True) if text
        ]
        return None
    try:
        measurement = _corrected(measurement, file)
    except ModesError as error:
        problems.append(f"{source.where(('test', 'sensors'))}: {error}")
        return None
    text = ", ".join(names)
    if file.test.repeats:
        again = _with_repeats(source, file, measurement, problems)
        if again is None:
            return None
        measurement = again
    measurement = _with_conditions(measurement, file.test)
    test = measurement.modes
    if test is None:
        problems.append(f"{source.where(('test', 'modes'))}: {text} holds no modes")
        return None
    has = ", ".join(map(str, test.numbers))
    wrong = [*_unknown_modes(source, file, test, text), *_pair_problems(source, file, test)]
    problems += wrong
    if wrong:
        return None
    if not used_numbers(file, test):
        problems.append(
            f"{source.where(('test', 'hold_out'))}: all modes of {text} ({has}) are "
            "held out, so nothing is left to update with"
        )
        return None
    if file.residuals.with_shapes and not test.has_shapes:
        problems.append(
            f"{source.where(('residuals', 'shape_weight'))}: shapes are to be compared, but "
            f"{text} holds frequencies only"
        )
    used, held_out = used_numbers(file, test), file.test.hold_out
    step = file.update.step
    problems += weight_problems(source, file.residuals, step, measurement, used, held_out)
    return measurement


def _with_conditions(measurement: Measurement, section: TestSection) -> Measurement:
    """Return the test with what the campaign says of its environment and its time."""
    at = section.measured_at
    return replace(
        measurement,
        environment={**measurement.environment, **section.environment},
        measured_at=measurement.measured_at if at is None else seconds_of(at),
    )


def _unknown_modes(
    source: YamlFile, file: CampaignFile, test: MeasuredModes, text: str
) -> list[str]:
    """Return problems of modes that the campaign names and the test's files (text) lack."""
    has, problems = ", ".join(map(str, test.numbers)), []
    for key, wanted in (("use", file.test.use or ()), ("hold_out", file.test.hold_out)):
        missing = [str(number) for number in wanted if number not in test.numbers]
        if missing:
            asked = "asked for" if key == "use" else "to be held out"
            problems.append(
                f"{source.where(('test', key))}: mode {', '.join(missing)} is {asked}, but {text} "
                f"has modes {has}"
            )
    return problems


def _corrected(measurement: Measurement, file: CampaignFile) -> Measurement:
    sensors = file.test.sensors
    return correct_sensors(measurement, sensors.reverse, sensors.exchange, sensors.drop)


def _remedy(source: YamlFile, name: str) -> str:
    """Return what writes a missing file of an example; empty for other campaigns."""
    if not source.path.is_file():
        return ""
    from modetune.configs.cases import writing_command

    return writing_command(source.path, name)


def _with_repeats(
    source: YamlFile, file: CampaignFile, measurement: Measurement, problems: list[str]
) -> Measurement | None:
    """Return the mean of a test and its repetitions, with deviations from their scatter."""
    where = source.where(("test", "repeats"))
    own = file.test.modes if isinstance(file.test.modes, str) else ", ".join(file.test.modes)
    if measurement.modes is None or measurement.deviations is not None:
        lacks = "no modes" if measurement.modes is None else "its own"
        problems.append(f"{where}: `repeats` give standard deviations, but the test has {lacks}")
        return None
    first = measurement.modes
    tests = [first]
    for name in file.test.repeats:
        try:
            found = _corrected(read_measurement([source.path.parent / name]), file)
            if found.modes is None:
                raise CampaignError(f"{name} holds no modes")
            check_alike(first, found.modes)
            tests.append(found.modes)
        except CampaignError as error:
            problems += [f"{problem} (named in {where})" for problem in error.problems]
        except ModesError as error:
            problems.append(f"{where}: {name} does not repeat the test: {error}")
    if len(tests) <= len(file.test.repeats):
        return None
    try:
        mean = mean_of_tests(tests, [own, *file.test.repeats])
    except ModesError as error:
        problems.append(f"{where}: {error}")
        return None
    return replace(
        mean,
        geometry=measurement.geometry,
        frfs=measurement.frfs,
        environment=measurement.environment,
        measured_at=measurement.measured_at,
        notes=(*measurement.notes, *mean.notes),
    )


def _pair_problems(source: YamlFile, file: CampaignFile, test: MeasuredModes) -> list[str]:
    """Return problems of `test.pairs`: unused modes, and two test modes with one computed mode."""
    used, problems = used_numbers(file, test), []
    taken: dict[int, int] = {}
    for number, mode in file.test.pairs.items():
        where = source.where(("test", "pairs", str(number)))
        if number not in used:
            nearest = min(used, key=lambda other: (abs(other - number), other), default=None)
            kind = "the campaign does not use" if number in test.numbers else "is not in the test"
            near = "" if nearest is None else f"; the nearest used mode is {nearest}"
            problems.append(
                f"{where}: `pairs` names test mode {number}, which {kind}{near} (used: "
                f"{', '.join(map(str, used))})"
            )
        elif mode in taken:
            problems.append(
                f"{where}: `pairs` gives test modes {taken[mode]} and {number} the same elastic "
                f"mode {mode}; pair it with one of them"
            )
        taken.setdefault(mode, number)
    return problems


def used_numbers(file: CampaignFile, test: MeasuredModes) -> tuple[int, ...]:
    """Return the numbers of the modes that the campaign uses."""
    if file.test.use is not None:
        return file.test.use
    return tuple(number for number in test.numbers if number not in file.test.hold_out)


def used_modes(file: CampaignFile, measurement: Measurement) -> MeasuredModes:
    """Return the modes that the campaign uses, at the sensors that it uses."""
    assert measurement.modes is not None
    test = kept_sensors(file.residuals, measurement.modes)
    return test.use(used_numbers(file, test))


def held_out_modes(file: CampaignFile, measurement: Measurement) -> MeasuredModes | None:
    """Return the held-out modes, None where there are none."""
    assert measurement.modes is not None
    if not file.test.hold_out:
        return None
    return kept_sensors(file.residuals, measurement.modes).use(file.test.hold_out)


def map_test(
    source: YamlFile,
    file: CampaignFile,
    measurement: Measurement,
    solver: Solver,
    problems: list[str],
    store: Store,
    modes: ModeSet | None = None,
) -> Mapping | None:
    """Return the test's sensors on the model, None with problems where this fails.

    store: keeps a pose that was found. modes: modes at other sensors, such as those of response
    functions.
    """
    mesh, geometry = solver.deck.mesh(), measurement.geometry
    if mesh.nodes.size == 0:  # matrices alone have no places
        nodes = np.array(sorted(solver.deck.summary.node_ids), dtype=np.int64)
        mesh, geometry = Mesh(nodes, np.zeros((nodes.size, 3)), ()), None
    try:
        return map_sensors(
            modes or used_modes(file, measurement).modes,
            geometry,
            mesh,
            file.test.sensors,
            METRES[file.model.units],
            solver.deck.summary.components,
            store,
            solver.deck.fixed(),
        )
    except CampaignError as error:
        where = source.where(("test",))
        problems += [f"{problem} (named in {where})" for problem in error.problems]
        return None


def complex_shapes(measurement: Measurement, test: MeasuredModes) -> Complexes | None:
    """Return complex shapes (n_dof, n_modes) of these modes at these sensors; None if real."""
    whole, found = measurement.modes, measurement.complex_shapes
    if whole is None or found is None:
        return None
    named = zip(whole.modes.nodes.tolist(), whole.modes.components.tolist(), strict=True)
    rows = {dof: row for row, dof in enumerate(named)}
    wanted = zip(test.modes.nodes.tolist(), test.modes.components.tolist(), strict=True)
    columns = [whole.numbers.index(number) for number in test.numbers]
    return np.asarray(found[np.ix_([rows[dof] for dof in wanted], columns)])


def frfs_on_model(
    source: YamlFile,
    file: CampaignFile,
    measurement: Measurement,
    solver: Solver,
    problems: list[str],
    store: Store,
) -> tuple[MeasuredFrfs | None, SensorMap | None]:
    """Return response functions of used sensors, and their sensors and forces on the model."""
    frfs = measurement.frfs
    if frfs is None or not file.residuals.functions:
        return None, None
    ends = np.hstack(
        [[frfs.nodes, frfs.components], [frfs.reference_nodes, frfs.reference_components]]
    )
    nodes, components = np.unique(ends, axis=1)
    modes = mode_set([1.0], np.ones((nodes.size, 1)), nodes, components)
    mapping = map_test(source, file, measurement, solver, problems, store, modes)
    used = kept_sensors(file.residuals, MeasuredModes((1,), modes)).modes
    names = set(zip(used.nodes.tolist(), used.components.tolist(), strict=True))
    outputs = zip(frfs.nodes.tolist(), frfs.components.tolist(), strict=True)
    seen = np.array([dof in names for dof in outputs])
    return frfs.of(seen), None if mapping is None else mapping.sensors


def pairing_nodes(
    test: MeasuredModes, sensors: SensorMap, solver: Solver, gauged: tuple[int, ...] = ()
) -> tuple[int, ...]:
    """Return the nodes of sensors and gauges; without sensors a spread of nodes to track modes."""
    if test.has_shapes:
        nodes = sensors.seen_nodes.tolist()
    else:
        nodes = list(tracking_nodes(solver.deck.summary.node_ids))
    return tuple(sorted({*nodes, *gauged}))


def tracking_nodes(node_ids: frozenset[int]) -> tuple[int, ...]:
    """Return a spread of nodes whose shapes identify modes."""
    nodes = np.array(sorted(node_ids))
    if nodes.size > TRACKING_NODES:
        nodes = nodes[(nodes.size * (GOLDEN * np.arange(TRACKING_NODES) % 1.0)).astype(np.int64)]
    return tuple(np.unique(nodes).tolist())
