"""Fields of a campaign: a parameter that has one becomes a parameter for each element or zone.

The deck says which elements the parameter scales, and its mesh which of them are neighbours. What
zones share with others, a material or a section, is copied for them as for any elements that
parameters name.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from modetune.adapters.solver import Solver
from modetune.adapters.yaml_file import YamlFile
from modetune.core.errors import ModelError
from modetune.core.modes import Integers
from modetune.core.updating.fields import MOST_ZONES, Field, element_graph, joined, zones_of
from modetune.flows.campaign.configurations import moved
from modetune.flows.campaign.parameter_section import TARGET_KEYS, FieldSection, ParameterSection
from modetune.flows.campaign.schema import CampaignFile
from modetune.flows.campaign.solvers import bind_solver


def with_fields(
    source: YamlFile, file: CampaignFile, problems: list[str]
) -> tuple[YamlFile, CampaignFile, tuple[Field, ...]]:
    """The file with a parameter for each zone, its lines as the parameters now stand, the fields.

    What is wrong with the deck or the parameters themselves is told where they are read.
    """
    if not any(item.field for item in file.parameters):
        return source, file, ()
    base = tuple(item.parameter() for item in file.parameters)
    try:
        solver = bind_solver(file.model, source.path.parent / file.model.deck, base)
    except ModelError:
        return source, file, ()
    sections: list[ParameterSection] = []
    places: list[int] = []
    fields: list[Field] = []
    for place, item in enumerate(file.parameters):
        found = [item]
        if item.field is not None and not solver.deck.problems((item.parameter(),)):
            try:
                field, found = _expanded(item, item.field, solver)
            except ModelError as error:
                where = source.where(("parameters", place, "field"))
                problems.append(f"{where}: parameters.{place}.field: {item.name}: {error}")
            else:
                start = sum(section.expression is None for section in sections)
                fields.append(replace(field, columns=field.columns + start))
        sections += found
        places += [place] * len(found)
    names = [item.name for item in sections]
    problems += [
        f"{source.where(('parameters', place))}: the name {name} is that of a field's zone too"
        for place, name in zip(places, names, strict=True)
        if names.count(name) > 1 and file.parameters[place].field is None
    ]
    own = file.model_copy(update={"parameters": tuple(sections)})
    return moved(source, places), own, tuple(fields)


def _expanded(
    item: ParameterSection, asked: FieldSection, solver: Solver
) -> tuple[Field, list[ParameterSection]]:
    """A field, its columns counted from 0, and its parameters. Raises ModelError."""
    affected = solver.deck.affected_elements(item.parameter())
    if affected is None:
        raise ModelError(
            f"{solver.program.name} does not tell which elements {item.quantity} scales here"
        )
    elements, centres, pairs = element_graph(solver.deck.mesh(), affected.elements)
    each = asked.zones == "elements"
    owners = np.arange(elements.size) if each else zones_of(centres, pairs, int(asked.zones))
    n = int(owners.max()) + 1
    if n > MOST_ZONES:
        raise ModelError(
            f"{n:,} elements, and a field may have {MOST_ZONES:,} values; ask for `zones: 200`"
        )
    if n < 2:
        raise ModelError("a field has two zones or more; leave `field` out")
    field = Field(
        item.name,
        np.arange(n),
        joined(pairs, owners),
        elements,
        owners,
        centres,
        asked.smoothing,
        asked.length,
    )
    nothing: dict[str, object] = dict.fromkeys(TARGET_KEYS)
    sections = [
        item.model_copy(
            update={
                **nothing,
                "name": f"{item.name}.{own[0]}" if each else f"{item.name}.zone{zone + 1}",
                "element": _ranges(own),
            }
        )
        for zone in range(n)
        for own in [np.sort(elements[owners == zone])]
    ]
    return field, sections


def _ranges(numbers: Integers) -> tuple[str, ...]:
    """Element numbers as ranges, in ascending order."""
    runs: Sequence[Integers] = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
    return tuple(f"{run[0]}-{run[-1]}" if run.size > 1 else str(run[0]) for run in runs)
