"""The tables of parameters: before and after, how far each can be trusted, where starts ended."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from modetune.core.storage.campaign_record import CampaignRecord
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
class ParameterRow:
    """A parameter before and after, as its values mean (`values`) and in the deck's units
    (deck_value, updated_value, value_error).

    standard_error: of its values; value_error: of the deck's number; test_share: 1 is the test
    alone, 0 the prior alone, None where it was not judged, as of what an expression gives, whose
    bounds are infinite.
    """

    name: Annotated[str, Column("parameter")]
    quantity: str
    meaning: Annotated[str, Column("what it is")]
    deck_value: Annotated[float, Column("deck", form=".6g")]
    updated_value: Annotated[float, Column("updated", form=".6g")]
    unit: Annotated[str, Column("unit")]
    values: Annotated[str, Column("values are")]
    initial: Annotated[float, Column("parameter at start", form=".4g")]
    updated: Annotated[float, Column("parameter now", form=".5g")]
    change: Annotated[float, Column("change", "%", "+.2f")]
    standard_error: Annotated[float, Column("standard error, of deck", "%", ".2f", "not known")]
    value_error: Annotated[float, Column("standard error", "", ".3g", "not known")]
    test_share: Annotated[float | None, Column("told by the test", "%", ".0f")]
    bounds: Annotated[tuple[float, float], Column("bounds", form="g")]
    on_bound: Annotated[bool, Column("on a bound")]


#: What a terminal and a page show of parameters (a page tells the test's share where it tells how
#: far all this can be trusted).
BRIEF_PARAMETERS = (
    "name deck_value updated_value unit change standard_error test_share bounds on_bound"
)


LONG_PARAMETERS = (
    "name meaning deck_value updated_value unit initial updated change standard_error bounds "
    "on_bound"
)


#: What a parameter's trust shows.
TRUST = (
    Column("parameter", words=True, name="name"),
    Column("share of the test", "%", ".0f", name="test_share"),
    Column("standard error, of deck", "%", ".2g", "not known", name="standard_error"),
    Column("what is to be said", words=True, name="sentence"),
)


def parameter_rows(record: CampaignRecord) -> tuple[ParameterRow, ...]:
    """Every parameter, in the campaign's order, then what expressions give."""
    stuck, trust = record.parameters.at_bounds(record.updated), record.trust
    first = record.iterations[0].parameters
    starts, ends = (dict(record.parameters.assigned(theta)) for theta in (first, record.updated))
    errors = (*record.standard_errors, *_dependent_errors(record))
    rows = []
    for place, (item, start) in enumerate(starts.items()):
        deck, error = float(record.deck_values[place]), float(errors[place])
        before, after = (item.number(deck, value) for value in (start, ends[item]))
        factor = deck if item.values == "relative" else 1.0
        words = item.quantity.replace("_", " ")
        words = words.replace("youngs", "Young's").replace("poissons", "Poisson's")
        rows.append(
            ParameterRow(
                name=item.name,
                quantity=item.quantity,
                meaning=" of ".join([words, *([", ".join(item.targets)] * bool(item.targets))]),
                deck_value=deck,
                updated_value=after,
                unit=unit_of(record.units, item.quantity),
                values=item.values,
                initial=item.shown(start),
                updated=item.shown(ends[item]),
                change=after / before - 1.0 if before else np.nan,
                standard_error=item.scale * error,
                value_error=abs(factor) * item.scale * error,
                test_share=None
                if trust is None or item.expression
                else trust.parameters[place].test_share,
                bounds=(item.shown(item.lower), item.shown(item.upper)),
                on_bound=item.name in stuck,
            )
        )
    return tuple(rows)


def _dependent_errors(record: CampaignRecord) -> list[float]:
    """Standard errors of what expressions give, by their slopes at the updated values."""
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
    """Values, bounds and standard errors; units and the test's shares where they are known."""
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
    outside = [(place, "on_bound") for place, row in enumerate(rows) if row.on_bound]
    return table_of("Parameters", rows, ParameterRow, " ".join(known), outside=outside)


def trust_table(trust: Trust) -> Table:
    """Return how far each parameter can be trusted; a doubtful share of the test is outside."""
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
        *(
            Column(item.name, form=".4f" if item.values == "relative" else ".5g")
            for item in record.parameters.parameters
        ),
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
                *record.parameters.shown(spread.updated[start]),
                outcome,
            )
            for start, outcome in enumerate(spread.outcomes)
        )
    )
    return Table("", columns, rows)


def unit_of(units: str, quantity: str) -> str:
    """The unit of a parameter's quantity; empty where it has none, or the units are not known.

    A dimension of a section is a length; a spring may rotate, so its unit is unknown.
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
