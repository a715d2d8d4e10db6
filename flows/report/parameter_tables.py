"""The tables of parameters: before and after, how far each can be trusted, where starts ended."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from modetune.core.storage.record import CampaignRecord
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
        "inertia_12": f"{length}⁴",
        "torsion_constant": f"{length}⁴",
        "dimension": length,
        "mass": mass,
        "rotary_inertia": f"{mass} {length}²",
        "ply_angle": "°",
        "offset": length,
    }.get(quantity, "")
