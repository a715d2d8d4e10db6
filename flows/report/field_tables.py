"""Fields of a record: the zones that changed most, the map of a field, and its JSON."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modetune.core.modes import Floats, Integers
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.storage.keys import Json
from modetune.core.updating.parameter_fields import FieldAnswer
from modetune.flows.report.tables import json_object

#: Zones of a field that a table of parameters shows, those that changed most.
SHOWN = 6


@dataclass(frozen=True, slots=True)
class FieldMap:
    """A field on the elements of its part.

    elements (n,) are their numbers; values and errors (n,) those of their zones, relative to the
    deck; centres (n, 3) are in global axes.
    """

    name: str
    elements: Integers
    values: Floats
    errors: Floats
    centres: Floats


def field_map(record: CampaignRecord, found: FieldAnswer) -> FieldMap:
    """Return the map of one field of a record."""
    field = found.field
    columns = field.columns[field.owners]
    values, errors = record.updated[columns], record.standard_errors[columns]
    return FieldMap(field.name, field.elements, values, errors, field.centres)


def brief_record(record: CampaignRecord) -> CampaignRecord:
    """Return the record with only those zones of each field that changed most, for tables and
    charts of single parameters."""
    if not record.fields:
        return record
    places, n = _shown_columns(record), len(record.parameters)
    own = record.parameters.only(places)
    kept = [record.parameters.dependents.index(item) + n for item in own.dependents]
    trust = record.trust
    return replace(
        record,
        parameters=own,
        deck_values=record.deck_values[[*places, *kept]],
        updated=record.updated[places],
        standard_errors=record.standard_errors[places],
        repeatability=record.repeatability[places],
        correlation=record.correlation[np.ix_(places, places)],
        splits=(*record.splits[:SHOWN], *_more(len(record.splits) - SHOWN)),
        trust=trust and replace(trust, parameters=tuple(trust.parameters[n] for n in places)),
        iterations=tuple(
            replace(
                item,
                parameters=item.parameters[places],
                step=item.step[places] if item.step.size else item.step,
                sensitivity=item.sensitivity[:, places]
                if item.sensitivity.size
                else item.sensitivity,
            )
            for item in record.iterations
        ),
    )


def _more(count: int) -> tuple[str, ...]:
    return (f"and {count} more cards, each with a comment in the updated deck",) * (count > 0)


def _shown_columns(record: CampaignRecord) -> list[int]:
    """Columns of parameters outside fields and of the zones that changed most, in order."""
    zones: set[int] = set()
    kept: set[int] = set()
    changes = np.abs(record.updated - record.parameters.initial)
    for item in record.fields:
        own = item.field.columns
        zones |= set(own.tolist())
        kept |= set(own[np.argsort(-changes[own], kind="stable")[:SHOWN]].tolist())
    return [n for n in range(len(record.parameters)) if n not in zones or n in kept]


def fields_json(record: CampaignRecord) -> list[Json]:
    """Return the key `fields` of `modetune update --json`: each zone with elements, value, error,
    and the fit of that zone alone."""
    return [_field_json(record, item) for item in record.fields]


def _field_json(record: CampaignRecord, found: FieldAnswer) -> Json:
    field, names = found.field, record.parameters.names
    columns = field.columns.tolist()
    zones = [
        {
            "name": names[column],
            "elements": field.elements[field.owners == zone],
            "updated": record.updated[column],
            "standard_error": record.standard_errors[column],
            "seen": found.strengths[zone],
            "alone_change": found.changes[zone],
            "alone_chi_square": found.alone[zone],
        }
        for zone, column in enumerate(columns)
    ]
    places = [[names[columns[zone]] for zone in place.tolist()] for place in found.places]
    return json_object(
        found,
        "left started doubts sentences",
        name=field.name,
        smoothing=field.smoothing,
        zones=zones,
        places=places,
    )
