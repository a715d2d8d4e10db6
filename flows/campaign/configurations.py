"""Campaign files with several configurations: a separate campaign file for each.

A configuration has its own `model` and `test` and shares the other keys. Problems are reported with
the line of the configuration's keys in the one campaign file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from modetune.adapters.yaml_file import Place, YamlFile
from modetune.core.errors import ModelError
from modetune.core.expressions import names_of
from modetune.core.near_names import suggestion
from modetune.flows.campaign.parameters import select_parameters
from modetune.flows.campaign.schema import CampaignFile, ConfigurationSection
from modetune.flows.campaign.solvers import bind_solver

#: The name of the configuration that consists of the campaign's own `model` and `test`.
BASE = "base"
#: Keys that each configuration has.
OWN = ("model", "test")


@dataclass(frozen=True, slots=True)
class ConfigurationFile:
    """The campaign file of one configuration alone.

    source: the file, with the lines of the configuration's keys. columns: positions of its
    parameters among the free ones of the campaign. place: location of its keys in the campaign
    file.
    """

    section: ConfigurationSection
    source: YamlFile
    file: CampaignFile
    columns: tuple[int, ...]
    place: Place


def configuration_files(
    source: YamlFile, file: CampaignFile, problems: list[str]
) -> list[ConfigurationFile]:
    """Return a campaign file for each configuration.

    Problems between configurations are added to `problems`.
    """
    sections: list[tuple[Place, ConfigurationSection]] = [
        (("configurations", place), item) for place, item in enumerate(file.configurations)
    ]
    if file.model is not None:
        base = ConfigurationSection(name=BASE, model=file.model, test=file.test)
        sections.insert(0, ((), base))
    problems += _joint_problems(source, file, [item for _, item in sections])
    found = []
    free = [place for place, item in enumerate(file.parameters) if item.expression is None]
    used = set[int]()
    for place, section in sections:
        view = _view(source, place)
        places = _known_parameters(view, file, section)
        if not places:
            problems.append(
                f"{view.where(('model',))}: configurations: {section.name} has none of the "
                "campaign's parameters; every configuration needs one"
            )
        own = file.model_copy(
            update={
                "model": section.model,
                "test": section.test,
                "residuals": section.residuals or file.residuals,
                "configurations": (),
                "parameters": tuple(file.parameters[place] for place in places),
            }
        )
        columns = tuple(free.index(place) for place in places if place in free)
        found.append(
            ConfigurationFile(section, select_parameters(view, places), own, columns, place)
        )
        used |= set() if section.hold_out else set(places)
    for column, parameter in enumerate(file.parameters):
        if column not in used and parameter.configurations is None:
            problems.append(
                f"{source.where(('parameters', column))}: no deck of a used configuration has the "
                f"target of {parameter.name} ({parameter.by()} {', '.join(parameter.targets())})"
            )
    return found


def _joint_problems(
    source: YamlFile, file: CampaignFile, sections: Sequence[ConfigurationSection]
) -> list[str]:
    found: list[str] = []

    def add(place: Place, problem: str) -> None:
        found.append(f"{source.where(place)}: {problem}")

    names = [section.name for section in sections]
    used = [section.name for section in sections if not section.hold_out]
    for place, item in enumerate(file.configurations):
        if names.count(item.name) > 1:
            other = " (it is that of the campaign's own model and test)" * (item.name == BASE)
            text = f"configurations: the name {item.name} is given twice{other}"
            add(("configurations", place, "name"), text)
    if not used:
        text = "all configurations are held out; updating needs at least one"
        add(("configurations",), text)
    for place, parameter in enumerate(file.parameters):
        own, at = set(parameter.configurations or ()), ("parameters", place, "configurations")
        unknown = sorted(own - set(names))
        if unknown:
            near = suggestion(unknown[0], names)
            add(at, f"{parameter.name}: there is no configuration {unknown[0]}{near}")
        if own.isdisjoint(used) and parameter.configurations is not None:
            text = f"{parameter.name} is in none of the used configurations "
            add(at, text + ", ".join(used))
    if file.update.start == "last":
        text = "`start: last` needs a single configuration; leave it out"
        add(("update", "start"), text)
    if file.run.engine == "dask":
        text = "several configurations need `engine: local` or `slurm`"
        add(("run", "engine"), text)
    return found


def _known_parameters(
    source: YamlFile, file: CampaignFile, section: ConfigurationSection
) -> tuple[int, ...]:
    """Return the positions of a configuration's parameters.

    They are those that name it, and those that name none and whose targets are in its deck."""
    named = [
        column
        for column, item in enumerate(file.parameters)
        if item.configurations is not None and section.name in item.configurations
    ]
    free = [column for column, item in enumerate(file.parameters) if item.configurations is None]
    try:
        parameters = tuple(item.parameter() for item in file.parameters)
        solver = bind_solver(section.model, source.path.parent / section.model.deck, parameters)
    except ModelError:
        return tuple(sorted((*named, *free)))  # reported where the model is read
    alive = [
        column
        for column in free
        if file.parameters[column].quantity != "variable"
        and not solver.deck.problems((parameters[column],))
    ]
    # Parameters in expressions come with these.
    own = {file.parameters[column].expression or "0" for column in (*named, *alive)}
    asked = {name for expression in own for name in names_of(expression)}
    asked |= (section.residuals or file.residuals).variables
    alive += [
        column
        for column, item in enumerate(file.parameters)
        if item.name in asked and column not in (*named, *alive)
    ]
    return tuple(sorted((*named, *alive)))


def _view(source: YamlFile, place: Place) -> YamlFile:
    """Return the file with the lines of a configuration's keys moved to the top level."""
    if not place:
        return source
    depth = len(place)
    own = {
        key[depth:]: line
        for key, line in source.lines.items()
        if len(key) > depth and key[:depth] == place and key[depth] in (*OWN, "residuals")
    }
    instead = {*OWN, *(key[0] for key in own)}
    lines = {key: line for key, line in source.lines.items() if not key or key[0] not in instead}
    lines |= own
    return replace(source, lines=lines)
