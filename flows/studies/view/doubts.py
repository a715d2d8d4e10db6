"""Doubts about a campaign, each with the keys that resolve it and a value for each key."""

from __future__ import annotations

import threading
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args, get_origin

import yaml

from modetune.adapters.yaml_file import Place, YamlFile, flow_text
from modetune.core.errors import CampaignError, NotStored
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.storage.keys import Json
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.schema import CampaignFile
from modetune.flows.diagnosis.findings import ORDER, PARAMETERS, Finding, Setting, of_parameter
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.report.tables import json_object
from modetune.flows.studies.check.pre_check import PreCheckReport, check_campaign
from modetune.flows.studies.view.campaign_changes import Change, Part

#: Sections that each configuration has; all other keys are the campaign's.
OWN_SECTIONS = ("model", "test")


@dataclass(frozen=True, slots=True)
class Control:
    """A key of a campaign file, by its place in it, and its new value as YAML.

    text: empty where the user gives the value. choices: all values there are, if few. removes: the
    key goes.
    """

    place: Place
    key: str
    text: str = ""
    choices: tuple[str, ...] = ()
    removes: bool = False


@dataclass(frozen=True, slots=True)
class Doubts:
    """What the pre-check doubts, each with its controls; n_good: findings without a doubt.

    unsolved: what needs the model's modes is missing.
    """

    doubts: tuple[tuple[Finding, tuple[Control, ...]], ...]
    n_good: int
    unsolved: bool

    @property
    def places(self) -> set[Place]:
        """The places that a change may name."""
        return {control.place for _, controls in self.doubts for control in controls}

    def to_json(self) -> dict[str, Json]:
        found = [
            json_object(item, "level subject text", controls=controls)
            for item, controls in self.doubts
        ]
        return {"doubts": list(found), "good": self.n_good, "unsolved": self.unsolved}


def find_doubts(
    campaign: Campaign,
    part: Part,
    record: CampaignRecord | None,
    solve: bool,
    cancelled: threading.Event,
) -> Doubts:
    """Return what the pre-check doubts, the worst first, with the controls of each doubt.

    record: of the newest update, None before one. solve: by the solver where the store lacks the
    model's modes; otherwise only what needs none. Raises CampaignError, SolverError, StoreError.
    """
    case = next((case for case in campaign.cases if case.name == part.name), campaign.cases[0])
    report, unsolved = _report(campaign.alone(case), solve, cancelled)
    found = [item for item in report.findings if item.level != "good"]
    found += [] if record is None else _bound_findings(record)
    found.sort(key=lambda item: -ORDER[item.level])
    return Doubts(
        tuple((item, _controls_of(item, part, case.measured.numbers)) for item in found),
        sum(item.level == "good" for item in report.findings),
        unsolved,
    )


def _report(
    campaign: Campaign, solve: bool, cancelled: threading.Event
) -> tuple[PreCheckReport, bool]:
    """Return the pre-check, and whether it lacks what needs the model's modes."""
    engine = replace(job_engine(campaign), may_run=solve, cancelled=cancelled)
    try:
        return check_campaign(campaign, engine=engine), False
    except NotStored:
        return check_campaign(campaign, run=False), True


def _bound_findings(record: CampaignRecord) -> Iterator[Finding]:
    """Report the parameters that an update moved onto a bound, with wider bounds."""
    on_bound = record.parameters.at_bounds(record.updated)
    for item, value in zip(record.parameters.parameters, record.updated.tolist(), strict=True):
        if item.name not in on_bound:
            continue
        reach = 0.5 * (item.upper - item.lower)
        below = value - item.lower < item.upper - value
        ends = (item.lower - reach * below, item.upper + reach * (not below))
        if item.values == "relative":
            ends = (max(ends[0], 0.5 * item.lower), ends[1])  # stiffness and mass stay above zero
        yield PARAMETERS.doubtful(
            f"the last update ended on its bound ({item.shown(value):.4g})",
            f"parameter {item.name}",
            "widen the bound if values beyond it are physically possible, or look for what the "
            "model lacks (`modetune localise`)",
            of_parameter(item.name, "bounds", [float(f"{item.shown(end):.4g}") for end in ends]),
        )


def _controls_of(found: Finding, part: Part, modes: Sequence[int]) -> tuple[Control, ...]:
    return tuple(control for item in found.settings for control in _controls(item, part, modes))


def _controls(setting: Setting, part: Part, modes: Sequence[int]) -> Iterator[Control]:
    """Yield the control of a setting; none for a parameter that the file does not list."""
    place = _located(part.source, setting.place)
    if place is None:
        return
    key, removes = ".".join(setting.place), setting.how == "remove"
    value = None if removes else _value(setting, _owner(part, place).at(*place), modes)
    text = "" if value is None else flow_text(value)
    yield Control(place, key, text, () if removes else _choices(place), removes)


def _located(source: YamlFile, place: tuple[str, ...]) -> Place | None:
    """Return a place with the position of a parameter in its list for its name."""
    if place[0] != "parameters":
        return place
    listed = source.at(("parameters",))
    names = [item.get("name") for item in listed if isinstance(item, dict)] if isinstance(
        listed, list
    ) else []  # fmt: skip
    return ("parameters", names.index(place[1]), *place[2:]) if place[1] in names else None


def _owner(part: Part, place: Place) -> Part:
    """Return the part that a key belongs to: a configuration, or the campaign."""
    return part if place[0] in OWN_SECTIONS else replace(part, place=())


def _value(setting: Setting, present: object, modes: Sequence[int]) -> object:
    """Return the key's whole new value; None where the user has to give it."""
    value: Any = setting.value
    if value is None:
        return None
    plain = yaml.safe_load(flow_text(value))  # tuples are lists there
    if setting.how == "add" and isinstance(plain, dict):
        return {**(present if isinstance(present, dict) else {}), **plain}
    if setting.how == "add":
        before = present if isinstance(present, list) else []
        return [*before, *(item for item in plain if item not in before)]
    if setting.how == "leave_out":
        used = present if isinstance(present, list) else list(modes)
        return [item for item in used if item not in plain] or None
    return plain


def _choices(place: Place) -> tuple[str, ...]:
    """Return all values of a key that has only a few words; empty for any other key."""
    found: Any = CampaignFile
    for key in place:
        fields = getattr(found, "model_fields", {})
        if key not in fields:
            return ()
        found = fields[key].annotation
    kinds = [one for one in (get_args(found) or ()) if one is not type(None)]
    words = found if get_origin(found) is Literal else kinds[0] if len(kinds) == 1 else None
    return tuple(map(str, get_args(words))) if get_origin(words) is Literal else ()


def doubt_change(part: Part, place: Place, text: str | None, offered: Collection[Place]) -> Change:
    """Set one key that a doubt offers to a value in YAML, or remove it without a value.

    Only keys that were offered: others name commands to run. Raises CampaignError.
    """
    key = ".".join(map(str, place))
    if place not in offered:
        raise CampaignError(f"no doubt offers to change `{key}`; reload the doubts")
    if text is None:
        return _owner(part, place).change({place: None})
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise CampaignError(f"`{key}`: {text!r} is not readable as YAML") from error
    if value is None:
        raise CampaignError(f"give a value for `{key}`")
    return _owner(part, place).change({place: value})
