"""The rows of a campaign's tables: modes, parameters, held-out modes, iterations and their pairs.

Each follows from the record; where it stands (terminal, JSON, page, Prefect) is `tables`' matter.
"initial" is the model before updating, "updated" the model after it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from modetune.core.correlation.held_out import HeldOut
from modetune.core.modes import mode_name
from modetune.core.storage.record import CampaignRecord, IterationRecord
from modetune.core.updating.trust import Trust
from modetune.flows.report.tables import Column, Table, columns_of, table_of

#: Length, mass and stress of each system of consistent units.
SYSTEMS: dict[str, tuple[str, str, str]] = {
    "m-kg-s": ("m", "kg", "Pa"),
    "mm-t-s": ("mm", "t", "MPa"),
    "in-slinch-s": ("in", "slinch", "psi"),
    "ft-slug-s": ("ft", "slug", "psf"),
}


@dataclass(frozen=True, slots=True)
class ModeRow:
    """A measured mode and its partner before and after; errors are relative, a MAC may be NaN.

    label: what people call it behind the word "mode"; elastic_mode: of the model, from 1;
    frequency_weight, frequency_deviation: of the measured frequency, 0 leaves it out.
    """

    mode: int
    configuration: str | None
    label: Annotated[str, Column("test mode")]
    test_hz: Annotated[float, Column("test", "Hz")]
    initial_hz: Annotated[float, Column("before", "Hz")]
    error_initial: Annotated[float, Column("error before", "%", "+.2f")]
    updated_hz: Annotated[float, Column("after", "Hz")]
    error_updated: Annotated[float, Column("error after", "%", "+.2f")]
    mac_initial: Annotated[float, Column("MAC before", form=".3f")]
    mac_updated: Annotated[float, Column("MAC after", form=".3f")]
    elastic_mode_initial: int
    elastic_mode: Annotated[int, Column("model's elastic mode")]
    pairing: str
    frequency_weight: Annotated[float, Column("weight", form="g")]
    frequency_deviation: Annotated[float, Column("deviation", "%", ".3g")]


@dataclass(frozen=True, slots=True)
class ParameterRow:
    """A parameter before and after, relative to the deck and (deck_value, updated_value) not.

    standard_error: relative to the deck; test_share: 1 is the test alone, 0 the prior alone, None
    where it was not judged.
    """

    name: Annotated[str, Column("parameter")]
    quantity: str
    meaning: Annotated[str, Column("what it is")]
    deck_value: Annotated[float, Column("deck", form=".6g")]
    updated_value: Annotated[float, Column("updated", form=".6g")]
    unit: Annotated[str, Column("unit")]
    initial: Annotated[float, Column("start, relative", form=".4f")]
    updated: Annotated[float, Column("updated, relative", form=".4f")]
    change: Annotated[float, Column("change", "%", "+.2f")]
    standard_error: Annotated[float, Column("standard error, of deck", "%", ".2f", "not known")]
    test_share: Annotated[float | None, Column("told by the test", "%", ".0f")]
    bounds: Annotated[tuple[float, float], Column("bounds, relative", form="g")]
    on_bound: Annotated[bool, Column("on a bound")]


@dataclass(frozen=True, slots=True)
class HeldOutRow:
    """A mode that took no part in updating, before and after; NaN where it was not found."""

    test: int
    configuration: str | None
    label: Annotated[str, Column("test")]
    test_hz: Annotated[float, Column("test", "Hz")]
    initial_hz: Annotated[float, Column("before", "Hz")]
    error_initial: Annotated[float, Column("error before", "%", "+.2f")]
    updated_hz: Annotated[float, Column("after", "Hz")]
    error_updated: Annotated[float, Column("error after", "%", "+.2f")]
    mac_initial: Annotated[float, Column("MAC before", form=".3f")]
    mac_updated: Annotated[float, Column("MAC after", form=".3f")]
    worse: Annotated[bool, Column("got worse")]


@dataclass(frozen=True, slots=True)
class IterationRow:
    """An evaluated parameter set: how near the test it is, what was decided, and what it cost.

    sensitivity: by what method and how old that of the step to it was, and whether e2 skipped a
    new one here.
    """

    iteration: Annotated[int, Column("iteration")]
    largest_error: Annotated[float, Column("largest error", "%", ".2f")]
    mean_error: Annotated[float, Column("mean error", "%", ".2f")]
    least_mac: Annotated[float, Column("least MAC", form=".3f")]
    misfit: Annotated[float, Column("weighted residual", form=".3g")]
    slope: Annotated[float, Column("slope", form=".2g")]
    sensitivity: Annotated[str, Column("sensitivity of the step here")]
    kept: Annotated[bool, Column("kept")]
    decision: Annotated[str, Column("decision")]
    modal_runs: Annotated[int, Column("modal runs")]
    sensitivity_runs: Annotated[int, Column("sensitivity runs")]
    reused: Annotated[int, Column("answered by the store")]
    core_minutes: Annotated[float, Column("core-minutes", form=".3g")]
    licence_minutes: Annotated[float, Column("licence-minutes", form=".3g")]
    wall_s: Annotated[float, Column("time", "s", ".1f")]


@dataclass(frozen=True, slots=True)
class PairRow:
    """A measured mode and its partner in one iteration; subspace_mac: with all close modes."""

    label: Annotated[str, Column("test mode")]
    elastic_mode: Annotated[int, Column("elastic mode")]
    test_hz: Annotated[float, Column("test", "Hz")]
    computed_hz: Annotated[float, Column("model", "Hz")]
    error: Annotated[float, Column("error", "%", "+.2f")]
    mac: Annotated[float, Column("MAC", form=".3f")]
    subspace_mac: Annotated[float, Column("MAC with close modes", form=".3f")]
    reason: Annotated[str, Column("why")]


#: What a terminal and a page show of parameters (a page tells the test's share where it tells how
#: far all this can be trusted), and of iterations: how they went, and what they cost.
BRIEF_PARAMETERS = (
    "name deck_value updated_value unit change standard_error test_share bounds on_bound"
)
LONG_PARAMETERS = (
    "name meaning deck_value updated_value unit initial updated change standard_error bounds "
    "on_bound"
)
PROGRESS = "iteration largest_error mean_error least_mac misfit slope sensitivity kept decision"
COSTS = "iteration modal_runs sensitivity_runs reused core_minutes licence_minutes wall_s"
#: What a parameter's trust shows.
TRUST = (
    Column("parameter", words=True, name="name"),
    Column("share of the test", "%", ".0f", name="test_share"),
    Column("standard error, of deck", "%", ".2g", "not known", name="standard_error"),
    Column("what is to be said", words=True, name="sentence"),
)


def mode_label(record: CampaignRecord, place: int) -> str:
    """What the test's mode at a place is called behind the word "mode": 3, or 3 of fuelled."""
    of = record.configurations[place] if record.configurations else ""
    return mode_name(record.test.numbers[place], of).removeprefix("mode ")


def mode_labels(record: CampaignRecord) -> list[str]:
    """What the test's modes are called, in its order."""
    return [mode_label(record, place) for place in range(len(record.test.numbers))]


def unmatched_modes(record: CampaignRecord) -> tuple[int, ...]:
    """Places of the test's modes that were left out, as no computed mode answers them."""
    paired = record.iterations[0].pairing.measured
    return tuple(np.setdiff1d(np.arange(len(record.test.numbers)), paired).tolist())


def unmatched_sentence(record: CampaignRecord) -> str:
    """That modes were left out; empty where none was."""
    names = [mode_label(record, place) for place in unmatched_modes(record)]
    if not names:
        return ""
    said = "mode " + names[0] if len(names) == 1 else "modes " + ", ".join(names)
    return f"No computed mode answers {said} of the test: nothing was compared with it."


def mode_rows(record: CampaignRecord) -> tuple[ModeRow, ...]:
    """Every measured mode, in the order of the pairs."""
    first, last, rows = record.iterations[0], record.best, []
    variances = first.residual.variances  # of eigenvalues: twice the frequency's deviation
    for pair, measured in enumerate(first.pairing.measured.tolist()):
        before, after = int(first.pairing.computed[pair]), int(last.pairing.computed[pair])
        rows.append(
            ModeRow(
                mode=record.test.numbers[measured],
                configuration=record.configurations[measured] if record.configurations else None,
                label=mode_label(record, measured),
                test_hz=float(record.test.modes.frequencies_hz[measured]),
                initial_hz=float(first.computed.frequencies_hz[before]),
                error_initial=float(first.frequency_errors[pair]),
                updated_hz=float(last.computed.frequencies_hz[after]),
                error_updated=float(last.frequency_errors[pair]),
                mac_initial=float(first.pairing.mac[pair]),
                mac_updated=float(last.pairing.mac[pair]),
                elastic_mode_initial=before + 1,
                elastic_mode=after + 1,
                pairing=last.pairing.reasons[pair],
                frequency_weight=float(first.residual.weights[pair] * variances[pair]),
                frequency_deviation=0.5 * float(np.sqrt(variances[pair])),
            )
        )
    return tuple(rows)


def mode_table(record: CampaignRecord) -> Table:
    """Frequencies, errors and MAC before and after; what e1 does not allow is outside.

    Weights and deviations are shown where they differ.
    """
    rows = mode_rows(record)
    alike = [
        name
        for name in ("frequency_weight", "frequency_deviation")
        if np.ptp([getattr(row, name) for row in rows]) <= 1e-9 * getattr(rows[0], name)
    ]
    columns = [column for column in columns_of(ModeRow) if column.name not in alike]
    outside = [
        (place, "error_updated")
        for place, row in enumerate(rows)
        if row.frequency_weight > 0.0 and abs(row.error_updated) > record.e1_frequency
    ]
    outside += [
        (place, "mac_updated") for place, row in enumerate(rows) if row.mac_updated < record.e1_mac
    ]
    means = [
        f"{100 * np.mean([abs(getattr(row, name)) for row in rows]):.2f}"
        for name in ("error_initial", "error_updated")
    ]
    foot = ("mean |error|", "", "", means[0], "", means[1], *[""] * (len(columns) - 6))
    return table_of("Modes", rows, columns, foot=[foot], outside=outside)


def parameter_rows(record: CampaignRecord) -> tuple[ParameterRow, ...]:
    """Every parameter, in the campaign's order."""
    stuck, trust = record.parameters.at_bounds(record.updated), record.trust
    rows = []
    for place, item in enumerate(record.parameters.parameters):
        start, updated = float(record.iterations[0].parameters[place]), float(record.updated[place])
        words = item.quantity.replace("_", " ")
        words = words.replace("youngs", "Young's").replace("poissons", "Poisson's")
        rows.append(
            ParameterRow(
                name=item.name,
                quantity=item.quantity,
                meaning=" of ".join([words, *([", ".join(item.targets)] * bool(item.targets))]),
                deck_value=float(record.deck_values[place]),
                updated_value=float(record.deck_values[place]) * updated,
                unit=unit_of(record.units, item.quantity),
                initial=start,
                updated=updated,
                change=updated / start - 1.0,
                standard_error=float(record.standard_errors[place]),
                test_share=None if trust is None else trust.parameters[place].test_share,
                bounds=(item.lower, item.upper),
                on_bound=item.name in stuck,
            )
        )
    return tuple(rows)


def parameter_table(record: CampaignRecord, only: str = "") -> Table:
    """Values, bounds and standard errors; units and the test's shares where they are known."""
    rows = parameter_rows(record)
    names = only.split() or [column.name for column in columns_of(ParameterRow)]
    known = [
        name
        for name in names
        if name not in ("unit", "test_share") or any(getattr(row, name) for row in rows)
    ]
    outside = [(place, "on_bound") for place, row in enumerate(rows) if row.on_bound]
    return table_of("Parameters", rows, ParameterRow, " ".join(known), outside=outside)


def held_out_rows(held: HeldOut | None) -> tuple[HeldOutRow, ...]:
    """Every mode that was held out; none where nothing was."""
    if held is None:
        return ()
    return tuple(
        HeldOutRow(
            test=number,
            configuration=held.configurations[mode] if held.configurations else None,
            label=held.names[mode],
            test_hz=float(held.test_hz[mode]),
            initial_hz=float(held.initial_hz[mode]),
            error_initial=float(held.error_initial[mode]),
            updated_hz=float(held.updated_hz[mode]),
            error_updated=float(held.error_updated[mode]),
            mac_initial=float(held.mac_initial[mode]),
            mac_updated=float(held.mac_updated[mode]),
            worse=bool(held.worse[mode]),
        )
        for mode, number in enumerate(held.numbers.tolist())
    )


def held_out_table(held: HeldOut | None) -> Table:
    """Modes that were held out, before and after; those that got worse are outside."""
    rows = held_out_rows(held)
    worse = [(place, "") for place, row in enumerate(rows) if row.worse]
    return table_of("Held out: not used for updating", rows, HeldOutRow, outside=worse)


def held_out_lines(held: HeldOut | None) -> list[str]:
    """A sentence for each held-out mode that got worse."""
    return (
        []
        if held is None
        else [
            f"{name}, held out, got worse: it {held.reason(mode)}"
            for mode, name in enumerate(held.names)
            if held.worse[mode]
        ]
    )


def iteration_row(item: IterationRecord) -> IterationRow:
    errors, macs, runs = np.abs(item.frequency_errors), item.pairing.mac, item.runs
    return IterationRow(
        iteration=item.number,
        largest_error=float(errors.max()),
        mean_error=float(errors.mean()),
        least_mac=float(macs.min()),
        misfit=item.residual.misfit,
        slope=item.slope,
        sensitivity=_sensitivity(item),
        kept=item.accepted,
        decision=item.decision,
        modal_runs=runs.modal,
        sensitivity_runs=runs.sensitivity,
        reused=runs.reused,
        core_minutes=runs.core_s / 60.0,
        licence_minutes=runs.licence_s / 60.0,
        wall_s=item.wall_s,
    )


def iteration_table(iterations: Sequence[IterationRecord]) -> Table:
    """A line an evaluated parameter set, with what was decided there."""
    rows = [iteration_row(item) for item in iterations]
    return table_of("Iterations", rows, IterationRow, PROGRESS)


def run_table(record: CampaignRecord) -> Table:
    """Solver runs of each iteration and what they cost, failed ones counted too."""
    runs = record.runs
    total = (
        "all",
        runs.modal,
        runs.sensitivity,
        runs.reused,
        runs.core_s / 60.0,
        runs.licence_s / 60.0,
        record.wall_s,
    )
    rows = [iteration_row(item) for item in record.iterations]
    return table_of("Solver runs", rows, IterationRow, COSTS, foot=[total])


def pair_table(record: CampaignRecord, item: IterationRecord) -> Table:
    """The pairs of an iteration with their reasons."""
    pairing = item.pairing
    rows = [
        PairRow(
            label=mode_label(record, measured),
            elastic_mode=computed + 1,
            test_hz=float(record.test.modes.frequencies_hz[measured]),
            computed_hz=float(item.computed.frequencies_hz[computed]),
            error=float(item.frequency_errors[pair]),
            mac=float(pairing.mac[pair]),
            subspace_mac=float(pairing.subspace_mac[pair]),
            reason=pairing.reasons[pair],
        )
        for pair, (measured, computed) in enumerate(
            zip(pairing.measured.tolist(), pairing.computed.tolist(), strict=True)
        )
    ]
    kept = "" if item.accepted else " (not kept)"
    title = f"Iteration {item.number}{kept}: largest error {100 * item.worst_error:.2f} %"
    return table_of(title, rows, PairRow)


def key_table(record: CampaignRecord) -> Table:
    """Keys of all solver jobs, as they stand in the store."""
    columns = (Column("iteration"), Column("job", words=True), Column("key", words=True))
    rows = [
        (item.number, job, key)
        for item in record.iterations
        for job, keys in (("modal", (item.modal_key,)), ("sensitivity", item.sensitivity_keys))
        for key in dict.fromkeys(keys)
    ]
    return Table("", columns, tuple(rows))


def trust_table(trust: Trust) -> Table:
    """What is to be said of each parameter; a share of the test in doubt is outside."""
    outside = [
        (place, "test_share") for place, item in enumerate(trust.parameters) if item.doubtful
    ]
    return table_of("", trust.parameters, TRUST, outside=outside)


def start_table(record: CampaignRecord) -> Table:
    """Where the updates from several starts ended; empty where there was one."""
    spread = None if record.trust is None else record.trust.spread
    columns = (
        Column("start", words=True),
        Column("place"),
        Column("weighted misfit", form=".4g"),
        *(Column(name, form=".4f") for name in record.parameters.names),
        Column("how it ended", words=True),
    )
    rows = (
        ()
        if spread is None
        else tuple(
            (
                f"{start + 1}{' (the answer)' if start == spread.chosen else ''}",
                int(spread.minima[start]) + 1 or None,
                spread.misfits[start],
                *spread.updated[start],
                outcome,
            )
            for start, outcome in enumerate(spread.outcomes)
        )
    )
    return Table("", columns, rows)


def unit_of(units: str, quantity: str) -> str:
    """The unit of a parameter's quantity; empty where it has none, or the units are not known.

    A dimension of a section is a length; a spring may turn, so that its unit is not told.
    """
    if units not in SYSTEMS:
        return ""
    length, mass, stress = SYSTEMS[units]
    return {
        "youngs_modulus": stress,
        "shear_modulus": stress,
        "density": f"{mass}/{length}³",
        "thickness": length,
        "area": f"{length}²",
        "inertia_1": f"{length}⁴",
        "inertia_2": f"{length}⁴",
        "torsion_constant": f"{length}⁴",
        "dimension": length,
        "mass": mass,
    }.get(quantity, "")


def _sensitivity(item: IterationRecord) -> str:
    if not item.sensitivity_methods:
        return ""
    methods = ", ".join(dict.fromkeys(name.replace("_", " ") for name in item.sensitivity_methods))
    age = f", {item.sensitivity_age} old" if item.sensitivity_age else ""
    skipped = "; no new one here (e2)" if item.sensitivity_skipped else ""
    return f"{methods}{age}{skipped}"
