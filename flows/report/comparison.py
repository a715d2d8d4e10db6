"""The comparison of a campaign's model before and after updating, from its record."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
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

#: Correlation from which the test can hardly distinguish two parameters.
CORRELATED = 0.95
#: A MAC below, and a relative standard error above these values is remarked on.
DOUBTFUL_MAC, DOUBTFUL_ERROR = 0.8, 0.2
#: A larger decrease of MAC is remarked on.
FALLEN_MAC = 0.05
#: More remarks of one kind are one sentence.
MOST_ALIKE = 3
#: A remark: what many of its kind have in common, the sentence, and its part of a common one.
Remark = tuple[str, str, str]


@dataclass(frozen=True, slots=True)
class SensorAgreement:
    """Coordinate MAC of each sensor, (n_sensors,), with the test's nodes and components."""

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
        """Lower end of a COMAC scale: below the minimum, at most 0.8."""
        return min(0.8, float(np.floor(10 * min(self.before.min(), self.after.min())) / 10))

    def least_of_points(self, nodes: Integers, values: Floats) -> list[float]:
        """Return the minimum over the sensors of each test point; values is before or after."""
        least = dict.fromkeys(nodes.tolist(), 1.0)
        for node, value in zip(self.nodes.tolist(), values.tolist(), strict=True):
            least[node] = min(least.get(node, 1.0), value)
        return [least[node] for node in nodes.tolist()]


def mac_table(record: CampaignRecord, item: IterationRecord) -> Floats:
    """Return the MAC (n_computed, n_measured) up to the last paired computed mode.

    It is zero for a shape that vanishes at all sensors, and empty without measured shapes.
    """
    rows_c, rows_m = common_dofs(item.computed, record.test.modes)
    if rows_c.size == 0:
        return np.zeros((0, 0))
    n = 1 + max(int(one.pairing.computed.max()) for one in (record.iterations[0], record.best))
    computed = item.computed.mode_shapes[rows_c, :n]
    measured = record.test.modes.mode_shapes[rows_m]
    return mac_or_zero(computed, measured)


def sensor_agreement(record: CampaignRecord) -> SensorAgreement | None:
    """Return COMAC before and after; None without shapes or if a pair has no common scale."""
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
    """Return normalised frequency sensitivities at the first and last points that have them.

    Each is an iteration and (df/f) / (dp/p), (n_modes, n_parameters). The matrix of the residual is
    (d lambda / dp) / lambda_test with lambda = (2 pi f)^2, so the result is half of that times p
    times (f_test / f)^2.
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
    """Return the norm of the residuals used in updating."""
    return float(np.linalg.norm(item.residual.values[item.residual.weights > 0.0]))


def scaled_test(record: CampaignRecord, item: IterationRecord) -> tuple[Floats, Floats]:
    """Return paired shapes of test and model at common sensors, (n_sensors, n_pairs) each.

    The test's shapes have unit length; the model's are scaled by the modal scale factor, so that
    both can be plotted over each other.
    """
    rows_m, rows_c = common_dofs(record.test.modes, item.computed)
    test = np.real(record.test.modes.mode_shapes[rows_m][:, item.pairing.measured])
    model = np.real(item.computed.mode_shapes[rows_c][:, item.pairing.computed])
    return _unit(test), model * model_scales(record, item)


def model_scales(record: CampaignRecord, item: IterationRecord) -> Floats:
    """Return the factors that scale computed shapes to measured ones of unit length, (n_pairs,)."""
    rows_m, rows_c = common_dofs(record.test.modes, item.computed)
    test = _unit(np.real(record.test.modes.mode_shapes[rows_m][:, item.pairing.measured]))
    model = np.real(item.computed.mode_shapes[rows_c][:, item.pairing.computed])
    squares = np.sum(model**2, axis=0)
    safe = np.where(squares > 0.0, squares, 1.0)
    signs = np.where(np.sum(test * model, axis=0) < 0.0, -1.0, 1.0)
    # The modal scale factor of uncorrelated shapes is zero: use at least a tenth of unit length.
    return np.asarray(
        signs * np.fmax(np.abs(np.sum(test * model, axis=0)) / safe, 0.1 / np.sqrt(safe))
    )


def remarks(record: CampaignRecord) -> tuple[str, ...]:
    """Return what an engineer should check before using the model, one sentence each.

    More than three of one kind are one sentence.
    """
    found = [*_grouped(_mode_remarks(record)), *_sensor_remarks(record)]
    at_bounds = record.parameters.at_bounds(record.updated)
    if at_bounds:
        found.append(
            f"On a bound: {', '.join(at_bounds)}. A better fit lies outside the bounds; check "
            "whether the bound or another part of the model is wrong."
        )
    return (*found, *_grouped(_parameter_remarks(record)))


def _grouped(found: Iterable[Remark]) -> list[str]:
    """Return the sentences of remarks, with one for all of a kind if there are many."""
    kinds: dict[str, list[Remark]] = {}
    for remark in found:
        kinds.setdefault(remark[0], []).append(remark)
    texts = []
    for plural, of_kind in kinds.items():
        if len(of_kind) > MOST_ALIKE:
            texts.append(f"{len(of_kind)} {plural}: {', '.join(short for *_, short in of_kind)}.")
        else:
            texts += [sentence for _, sentence, _ in of_kind]
    return texts


def _parameter_remarks(record: CampaignRecord) -> Iterator[Remark]:
    for row in parameter_rows(record):
        error = row.value_error or 0.0
        if error > DOUBTFUL_ERROR * abs(row.updated_value) > 0.0:
            text = f"±{100 * error / abs(row.updated_value):.0f} %"
            yield (
                "parameters are uncertain, because these modes hardly depend on them",
                f"{row.name} is uncertain by {text}: these modes hardly depend on it.",
                f"{row.name} ({text})",
            )
    for one, other, value in correlated_pairs(record):
        yield (
            "pairs of parameters are correlated, and the test determines their combined effect, "
            "but not each value",
            f"{one} and {other} are correlated ({value:+.2f}): the test determines their combined "
            "effect, but not each value.",
            f"{one} and {other} ({value:+.2f})",
        )


def _mode_remarks(record: CampaignRecord) -> list[Remark]:
    found: list[Remark] = []
    for row in mode_rows(record):
        error, before = (f"{100 * e:+.2f} %" for e in (row.error_updated, row.error_initial))
        if abs(row.error_updated) > record.e1_frequency:
            limit = f"above the tolerance of {100 * record.e1_frequency:g} %"
            found.append(
                (
                    f"modes have a frequency error {limit}",
                    f"Mode {row.label} has a frequency error of {error}, {limit}.",
                    f"{row.label} ({error})",
                )
            )
        elif abs(row.error_updated) > abs(row.error_initial) + 1e-3:
            found.append(
                (
                    "modes have a larger frequency error than before",
                    f"The frequency error of mode {row.label} grew from {before} to {error}.",
                    f"{row.label} ({error}, before {before})",
                )
            )
        if row.mac_updated < DOUBTFUL_MAC:
            found.append(
                (
                    f"modes have a MAC below {DOUBTFUL_MAC:g}",
                    f"Mode {row.label} has a MAC of only {row.mac_updated:.2f}: {row.pairing}.",
                    f"{row.label} ({row.mac_updated:.2f})",
                )
            )
        if row.mac_updated < row.mac_initial - FALLEN_MAC:
            fell = f"{row.mac_initial:.3f} to {row.mac_updated:.3f}"
            found.append(
                (
                    "modes have a lower MAC than before",
                    f"The MAC of mode {row.label} fell from {fell}.",
                    f"{row.label} ({fell})",
                )
            )
        if row.elastic_mode_initial != row.elastic_mode:
            now, then = row.elastic_mode, row.elastic_mode_initial
            found.append(
                (
                    "test modes are paired with other elastic modes than before",
                    f"Test mode {row.label} is now paired with elastic mode {now}, before "
                    f"updating with mode {then}.",
                    f"{row.label} (now {now}, before {then})",
                )
            )
    return found


def _sensor_remarks(record: CampaignRecord) -> list[str]:
    """Sensors with differences far above the scatter of the others: reversed or exchanged?"""
    agreement, item = sensor_agreement(record), record.best
    if agreement is None:
        return []
    rows_m, rows_c = common_dofs(record.test.modes, item.computed)
    measured = record.test.modes.mode_shapes[rows_m][:, item.pairing.measured]
    computed = item.computed.mode_shapes[rows_c]
    spaces = [computed[:, [place]] for place in item.pairing.computed.tolist()]
    errors = sensor_errors(measured, spaces, computed)
    found = [
        f"Sensors {' and '.join(agreement.labels[row] for row in error.rows)} fit the model better "
        f"when exchanged ({error.score:.0f} times the scatter of the others): check their channels."
        for error in errors
        if len(error.rows) == 2
    ]
    reversed_signs = [
        f"{agreement.labels[error.rows[0]]} ({error.score:.0f} times the scatter of the others)"
        for error in errors
        if len(error.rows) == 1
    ]
    if reversed_signs:
        one = len(reversed_signs) == 1
        found.append(
            f"Sensor{'' if one else 's'} {', '.join(reversed_signs)} move{'s' if one else ''} "
            f"opposite to the model: check {'its' if one else 'their'} sign."
        )
    return found


def correlated_pairs(record: CampaignRecord) -> list[tuple[str, str, float]]:
    """Return pairs of parameters that the test hardly distinguishes, with their correlation."""
    names, table = record.parameters.names, record.correlation
    rows, columns = np.nonzero(np.triu(np.abs(np.nan_to_num(table)) > CORRELATED, 1))
    return [
        (names[row], names[column], float(table[row, column]))
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True)
    ]


def _unit(shapes: Floats) -> Floats:
    lengths = np.linalg.norm(shapes, axis=0)
    return np.asarray(shapes / np.where(lengths > 0.0, lengths, 1.0))
