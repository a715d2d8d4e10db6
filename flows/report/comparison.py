"""The comparison of a campaign's model before and after updating, from its record."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modetune.core.correlation.correlation import comac
from modetune.core.correlation.pairing import mac_or_zero
from modetune.core.correlation.sensor_errors import sensor_errors
from modetune.core.errors import ModesError
from modetune.core.modes import COMPONENTS, Floats, Integers, common_dofs
from modetune.core.storage.campaign_record import CampaignRecord, IterationRecord
from modetune.flows.report.mode_tables import mode_rows
from modetune.flows.report.parameter_tables import parameter_rows

#: Correlation of two estimated parameters from which the test can hardly distinguish them.
ENTANGLED = 0.95
#: A MAC that needs a look, and a share of the value that a standard error should stay below.
DOUBTFUL_MAC, DOUBTFUL_ERROR = 0.8, 0.2
#: By how much a MAC may fall before it is remarked.
FALLEN_MAC = 0.05


@dataclass(frozen=True, slots=True)
class SensorAgreement:
    """Coordinate MAC of each sensor, (n_sensors,), over the paired modes.

    nodes, components: as the test names them.
    """

    nodes: Integers
    components: Integers
    before: Floats
    after: Floats

    @property
    def labels(self) -> tuple[str, ...]:
        names = zip(self.nodes.tolist(), self.components.tolist(), strict=True)
        return tuple(f"{node}.{COMPONENTS[part - 1]}" for node, part in names)

    @property
    def scale_foot(self) -> float:
        """Where the scale of a COMAC starts: below the least, at 0.8 at most."""
        return min(0.8, float(np.floor(10 * min(self.before.min(), self.after.min())) / 10))

    def least_of_points(self, nodes: Integers, values: Floats) -> list[float]:
        """The least of each test point's sensors; values: those of before or of after."""
        least = dict.fromkeys(nodes.tolist(), 1.0)
        for node, value in zip(self.nodes.tolist(), values.tolist(), strict=True):
            least[node] = min(least.get(node, 1.0), value)
        return [least[node] for node in nodes.tolist()]


def mac_table(record: CampaignRecord, item: IterationRecord) -> Floats:
    """MAC (n_computed, n_measured) up to the last computed mode that is paired in the campaign.

    Zero where a shape is zero at all sensors. Empty without measured shapes.
    """
    rows_c, rows_m = common_dofs(item.computed, record.test.modes)
    if rows_c.size == 0:
        return np.zeros((0, 0))
    n = 1 + max(int(one.pairing.computed.max()) for one in (record.iterations[0], record.best))
    computed = item.computed.mode_shapes[rows_c, :n]
    measured = record.test.modes.mode_shapes[rows_m]
    return mac_or_zero(computed, measured)


def sensor_agreement(record: CampaignRecord) -> SensorAgreement | None:
    """COMAC before and after, None without measured shapes or where a pair has no common scale."""
    rows_m, _ = common_dofs(record.test.modes, record.best.computed)
    if rows_m.size == 0:
        return None
    try:
        before, after = (_comac(record, item) for item in (record.iterations[0], record.best))
    except ModesError:
        return None
    modes = record.test.modes
    return SensorAgreement(modes.nodes[rows_m], modes.components[rows_m], before, after)


def _comac(record: CampaignRecord, item: IterationRecord) -> Floats:
    rows_m, rows_c = common_dofs(record.test.modes, item.computed)
    measured = record.test.modes.mode_shapes[rows_m][:, item.pairing.measured]
    return comac(measured, item.computed.mode_shapes[rows_c][:, item.pairing.computed])


def fresh_matrices(record: CampaignRecord) -> tuple[tuple[int, Floats], ...]:
    """Normalised frequency sensitivities at the first and the last set that a matrix was had at.

    Of each: the set's iteration and (df/f) / (dp/p), (n_modes, n_parameters). The residual holds
    (d lambda / dp) / lambda_test, so with lambda = (2 pi f)^2 it is half of that times p, times
    (f_test / f)^2.
    """
    found: dict[int, Floats] = {}
    for item in record.iterations[1:]:
        if item.sensitivity_age or item.sensitivity.shape[0] == 0:
            continue
        start = [one for one in record.iterations if one.accepted and one.number < item.number][-1]
        n = start.residual.rows("frequencies").stop
        ratio = 1.0 / (1.0 + start.frequency_errors) ** 2
        values = 0.5 * item.sensitivity[:n] * start.parameters * ratio[:, None]
        found.setdefault(start.number, values)
    ends = sorted(found)
    return tuple((number, found[number]) for number in dict.fromkeys((*ends[:1], *ends[-1:])))


def residual_norm(item: IterationRecord) -> float:
    """Length of that part of the residual that takes part in updating."""
    return float(np.linalg.norm(item.residual.values[item.residual.weights > 0.0]))


def scaled_test(record: CampaignRecord, item: IterationRecord) -> tuple[Floats, Floats]:
    """Paired shapes at the common sensors, test and model, (n_sensors, n_pairs) each.

    The test's shape has length one and its own sign; the model's has the scale in which it is
    nearest to the test's (the modal scale factor), so that both can be laid over each other.
    """
    rows_m, rows_c = common_dofs(record.test.modes, item.computed)
    test = np.real(record.test.modes.mode_shapes[rows_m][:, item.pairing.measured])
    model = np.real(item.computed.mode_shapes[rows_c][:, item.pairing.computed])
    return _unit(test), model * model_scales(record, item)


def model_scales(record: CampaignRecord, item: IterationRecord) -> Floats:
    """What brings each computed shape nearest to the measured one of length one, (n_pairs,)."""
    rows_m, rows_c = common_dofs(record.test.modes, item.computed)
    test = _unit(np.real(record.test.modes.mode_shapes[rows_m][:, item.pairing.measured]))
    model = np.real(item.computed.mode_shapes[rows_c][:, item.pairing.computed])
    squares = np.sum(model**2, axis=0)
    safe = np.where(squares > 0.0, squares, 1.0)
    signs = np.where(np.sum(test * model, axis=0) < 0.0, -1.0, 1.0)
    # Of a shape with nothing in common the nearest scale is zero: it keeps its own length then.
    return np.asarray(
        signs * np.fmax(np.abs(np.sum(test * model, axis=0)) / safe, 0.1 / np.sqrt(safe))
    )


def remarks(record: CampaignRecord) -> tuple[str, ...]:
    """What a careful engineer would look at before handing the model on, a sentence each."""
    found = [*_mode_remarks(record), *_sensor_remarks(record)]
    at_bounds = record.parameters.at_bounds(record.updated)
    if at_bounds:
        found.append(
            f"On a bound: {', '.join(at_bounds)}. The test would take the value further than the "
            "campaign allows; see whether the bound or something else of the model is wrong."
        )
    for row in parameter_rows(record):
        if row.value_error > DOUBTFUL_ERROR * abs(row.updated_value) > 0.0:
            share = row.value_error / abs(row.updated_value)
            found.append(
                f"{row.name} is known to ±{100 * share:.0f} % only: these modes hardly depend on "
                "it."
            )
    found += [
        f"{one} and {other} are entangled (correlation {value:+.2f}): the test tells their "
        "combined effect, not each alone."
        for one, other, value in entangled(record)
    ]
    return tuple(found)


def _mode_remarks(record: CampaignRecord) -> list[str]:
    found = []
    for row in mode_rows(record):
        if abs(row.error_updated) > record.e1_frequency:
            found.append(
                f"Mode {row.label} is {100 * row.error_updated:+.2f} % off in frequency, beyond "
                f"the campaign's {100 * record.e1_frequency:g} %."
            )
        elif abs(row.error_updated) > abs(row.error_initial) + 1e-3:
            found.append(
                f"Mode {row.label} was nearer to the test before "
                f"({100 * row.error_initial:+.2f} %, now {100 * row.error_updated:+.2f} %)."
            )
        if row.mac_updated < DOUBTFUL_MAC:
            found.append(
                f"Mode {row.label} has a MAC of {row.mac_updated:.2f} only: {row.pairing}."
            )
        if row.mac_updated < row.mac_initial - FALLEN_MAC:
            found.append(
                f"Mode {row.label} was nearer before in shape: its MAC fell from "
                f"{row.mac_initial:.3f} to {row.mac_updated:.3f}."
            )
        if row.elastic_mode_initial != row.elastic_mode:
            found.append(
                f"Test mode {row.label} is the model's elastic mode {row.elastic_mode} now; it "
                f"was mode {row.elastic_mode_initial} before."
            )
    return found


def _sensor_remarks(record: CampaignRecord) -> list[str]:
    """Sensors that stand out of what the others scatter by, turned round or exchanged."""
    agreement, item = sensor_agreement(record), record.best
    if agreement is None:
        return []
    rows_m, rows_c = common_dofs(record.test.modes, item.computed)
    measured = record.test.modes.mode_shapes[rows_m][:, item.pairing.measured]
    computed = item.computed.mode_shapes[rows_c]
    spaces = [computed[:, [place]] for place in item.pairing.computed.tolist()]
    errors = sensor_errors(measured, spaces, computed)
    found = [
        f"Sensors {' and '.join(agreement.labels[row] for row in error.rows)} move as each other "
        f"in the model ({error.score:.0f} times the scatter of the others): swapped?"
        for error in errors
        if len(error.rows) == 2
    ]
    turned = [
        f"{agreement.labels[error.rows[0]]} ({error.score:.0f} times the scatter of the others)"
        for error in errors
        if len(error.rows) == 1
    ]
    if turned:
        one = len(turned) == 1
        found.append(
            f"Sensor{'' if one else 's'} {', '.join(turned)} move{'s' if one else ''} against the "
            "model: turned round?"
        )
    return found


def entangled(record: CampaignRecord) -> list[tuple[str, str, float]]:
    """Pairs of parameters whose estimates are nearly one, and their correlation."""
    names, table = record.parameters.names, record.correlation
    rows, columns = np.nonzero(np.triu(np.abs(np.nan_to_num(table)) > ENTANGLED, 1))
    return [
        (names[row], names[column], float(table[row, column]))
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True)
    ]


def _unit(shapes: Floats) -> Floats:
    lengths = np.linalg.norm(shapes, axis=0)
    return np.asarray(shapes / np.where(lengths > 0.0, lengths, 1.0))
