"""Tables of parameters: values before and after, trust in each, results of several starts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from modetune.core.parameters import Parameter
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.updating.trust import Trust
from modetune.flows.report.tables import Column, Table, columns_of, table_of

#: Length, mass and stress of each system of consistent units.
SYSTEMS: dict[str, tuple[str, str, str]] = {
    "m-kg-s": ("m", "kg", "Pa"),
    "m-t-s": ("m", "t", "kPa"),
    "mm-t-s": ("mm", "t", "MPa"),
    "mm-kg-s": ("mm", "kg", "kPa"),
    "mm-g-s": ("mm", "g", "Pa"),
    "cm-g-s": ("cm", "g", "Ba"),
    "in-slinch-s": ("in", "slinch", "psi"),
    "ft-slug-s": ("ft", "slug", "psf"),
}


@dataclass(frozen=True, slots=True)
class ParameterRow:
    """A parameter before and after, in its own values and in the deck's units.

    initial, updated, standard_error, repeatability and bounds are in the kind of `values`;
    deck_value, updated_value and value_error in the deck's units. repeatability is the effect of
    test noise alone, and standard_error includes the model's own error. Errors are None on a
    bound, where the value does not scatter. test_share is 1 if the test alone determines the value,
    0 if only the prior does, None if unknown or if an expression gives the value, which then has
    infinite bounds.
    """

    name: Annotated[str, Column("parameter")]
    quantity: str
    meaning: Annotated[str, Column("meaning")]
    deck_value: Annotated[float, Column("deck", form=".6g")]
    updated_value: Annotated[float, Column("updated", form=".6g")]
    unit: Annotated[str, Column("unit")]
    values: Annotated[str, Column("kind of values")]
    initial: Annotated[float, Column("parameter at start", form=".4g")]
    updated: Annotated[float, Column("parameter updated", form=".5g")]
    change: Annotated[float, Column("change", "%", "+.2f")]
    standard_error: Annotated[
        float | None, Column("standard error, of deck", "%", ".2f", "unknown")
    ]
    value_error: Annotated[float | None, Column("standard error", "", ".3g", "unknown")]
    repeatability: Annotated[float | None, Column("repeatability, of deck", "%", ".2f", "unknown")]
    test_share: Annotated[float | None, Column("from the test", "%", ".0f")]
    bounds: Annotated[tuple[float, float], Column("bounds", form="g")]
    on_bound: Annotated[bool, Column("on a bound")]


#: Columns on a terminal, and on a page, which shows the test's share with the trust.
BRIEF_PARAMETERS = (
    "name deck_value updated_value unit change standard_error test_share bounds on_bound"
)


LONG_PARAMETERS = (
    "name meaning deck_value updated_value unit initial updated change standard_error bounds "
    "on_bound"
)


#: Columns of the trust in parameters.
TRUST = (
    Column("parameter", words=True, name="name"),
    Column("from the test", "%", ".0f", name="test_share"),
    Column("standard error, of deck", "%", ".2g", "unknown", name="error"),
    Column("remark", words=True, name="sentence"),
)


def _meaning(item: Parameter) -> str:
    """Return quantity and target of a parameter; numbers are of a kind: property 1."""
    words = item.quantity.replace("_", " ")
    words = words.replace("youngs", "Young's").replace("poissons", "Poisson's")
    kind = [item.by] if item.targets and item.targets[0][:1].isdecimal() else []
    return " of ".join(
        [words, *([" ".join([*kind, ", ".join(item.targets)])] * bool(item.targets))]
    )


def parameter_rows(record: CampaignRecord) -> tuple[ParameterRow, ...]:
    """Return a row for each parameter in the campaign's order, then for each expression."""
    stuck, trust = record.parameters.at_bounds(record.updated), record.trust
    first = record.iterations[0].parameters
    starts, ends = (dict(record.parameters.assigned(theta)) for theta in (first, record.updated))
    errors = (*record.standard_errors, *_dependent_errors(record))
    noise = (*record.repeatability, *[np.nan] * len(record.parameters.dependents))
    rows = []
    for place, (item, start) in enumerate(starts.items()):
        deck, error = float(record.deck_values[place]), float(errors[place])
        before, after = (item.number(deck, value) for value in (start, ends[item]))
        factor = deck if item.values == "relative" else 1.0
        rows.append(
            ParameterRow(
                name=item.name,
                quantity=item.quantity,
                meaning=_meaning(item),
                deck_value=deck,
                updated_value=after,
                unit=unit_of(record.units, item.quantity),
                values=item.values,
                initial=item.shown(start),
                updated=item.shown(ends[item]),
                change=after / before - 1.0 if before else np.nan,
                standard_error=item.scale * error or None,
                value_error=abs(factor) * item.scale * error or None,
                repeatability=item.scale * float(noise[place]) or None,
                test_share=None
                if trust is None or item.expression
                else trust.parameters[place].test_share,
                bounds=(item.shown(item.lower), item.shown(item.upper)),
                on_bound=item.name in stuck,
            )
        )
    return tuple(rows)


def _dependent_errors(record: CampaignRecord) -> list[float]:
    """Standard errors of expressions, from their derivatives at the updated values."""
    parameters, errors = record.parameters, record.standard_errors
    if not parameters.dependents or not np.isfinite(errors).all():
        return [np.nan] * len(parameters.dependents)
    steps = 1e-4 * np.eye(len(parameters))
    ends = [
        [
            np.array([v for p, v in parameters.assigned(record.updated + way) if p.expression])
            for way in (step, -step)
        ]
        for step in steps
    ]
    slopes = np.array([(high - low) / 2e-4 for high, low in ends])
    covariance = record.correlation * np.outer(errors, errors)
    return [float(np.sqrt(slope @ covariance @ slope)) for slope in slopes.T]


def parameter_table(record: CampaignRecord, only: str = "") -> Table:
    """Return the table of parameters, with units and shares of the test if known."""
    rows = parameter_rows(record)
    names = only.split() or [column.name for column in columns_of(ParameterRow)]
    if any(row.values != "relative" for row in rows):  # no one unit of all errors
        names = ["value_error" if name == "standard_error" else name for name in names]
        at = names.index("bounds") if "bounds" in names else len(names)
        names.insert(at, "values")
    known = [
        name
        for name in names
        if name not in ("unit", "test_share") or any(getattr(row, name) for row in rows)
    ]
    judged = () if record.trust is None else record.trust.parameters
    outside = [(place, "on_bound") for place, row in enumerate(rows) if row.on_bound]
    outside += [(place, "test_share") for place, item in enumerate(judged) if item.doubtful]
    table = table_of("Parameters", rows, ParameterRow, " ".join(known), outside=outside)
    return _withheld(table, record.trust)


def _withheld(table: Table, trust: Trust | None) -> Table:
    """Return the table, in which withheld errors are not called unknown."""
    if trust is None or not trust.withheld:
        return table
    errors = ("standard_error", "value_error", "error")
    columns = (
        replace(item, unknown="withheld") if item.name in errors else item for item in table.columns
    )
    return replace(table, columns=tuple(columns))


def trust_table(trust: Trust) -> Table:
    """Return the table of trust in each parameter; shares of doubtful ones are highlighted."""
    outside = [
        (place, "test_share") for place, item in enumerate(trust.parameters) if item.doubtful
    ]
    return _withheld(table_of("", trust.parameters, TRUST, outside=outside), trust)


def start_table(record: CampaignRecord) -> Table:
    """Return the results of updates from several starts; empty after a single start."""
    spread = None if record.trust is None else record.trust.spread
    columns = (
        Column("start", words=True),
        Column("minimum"),
        Column("weighted misfit", form=".4g"),
        *(
            Column(item.name, form=".4f" if item.values == "relative" else ".5g")
            for item in record.parameters.parameters
        ),
        Column("status", words=True),
    )
    rows = (
        ()
        if spread is None
        else tuple(
            (
                f"{start + 1 if start < spread.n_starts else '-'}"
                f"{' (reported)' if start == spread.chosen else ''}",
                int(spread.minima[start]) + 1 or None,
                spread.misfits[start],
                *record.parameters.shown(spread.updated[start]),
                outcome,
            )
            for start, outcome in enumerate(spread.outcomes)
        )
    )
    return Table("", columns, rows)


def unit_of(units: str, quantity: str) -> str:
    """Return the unit of a parameter's quantity; "" if it has none or is unknown.

    A dimension of a section is a length; the unit of a spring is unknown, because it may be a
    rotational one.
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
        "inertia_12": f"{length}⁴",
        "torsion_constant": f"{length}⁴",
        "dimension": length,
        "mass": mass,
        "rotary_inertia": f"{mass} {length}²",
        "ply_angle": "°",
        "offset": length,
    }.get(quantity, "")
