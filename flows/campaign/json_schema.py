"""The campaign file's JSON schema, for editors and other programs.

What pydantic derives from `schema.py`, and what only validators there know: which keys exclude
each other, and which targets belong to which quantity. An editor that reads it (VS Code through
the first line of a campaign, `# yaml-language-server: $schema=campaign.schema.json`) completes
keys and shows mistakes while they are typed; `modetune check` stays the judge.
"""

from __future__ import annotations

import ast
import inspect
import json
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

from modetune.core.parameters import QUANTITIES
from modetune.flows.campaign.parameter_section import TARGET_KEYS
from modetune.flows.campaign.schema import CampaignFile
from modetune.flows.responses.section import Section

DIALECT = "https://json-schema.org/draft/2020-12/schema"
#: A name, not an address: the file is wherever it was put.
IDENTIFIER = "urn:modetune:campaign"


def campaign_schema() -> dict[str, Any]:
    """The JSON schema of a campaign file, draft 2020-12."""
    schema = CampaignFile.model_json_schema()
    sections = schema["$defs"]
    meanings = {kind.__name__: _meanings(kind) for kind in _kinds(Section)}
    for name, section in ((CampaignFile.__name__, schema), *sections.items()):
        section.pop("title", None)
        for key, told in section.get("properties", {}).items():
            told.pop("title", None)  # only the key's name again
            told["description"] = meanings[name][key]
            section["properties"][key] = dict(sorted(told.items()))
    _add_rules(sections)
    for key in ("model", "test"):
        del schema["properties"][key]["default"]
    schema["anyOf"] = [{"required": ["model", "test"]}, {"required": ["configurations"]}]
    schema["dependentRequired"] = {"model": ["test"], "test": ["model"]}
    return {"$schema": DIALECT, "$id": IDENTIFIER, "title": "modetune campaign", **schema}


def schema_text() -> str:
    """The schema as it is published, with an end of line."""
    return json.dumps(campaign_schema(), indent=2, ensure_ascii=False) + "\n"


def _kinds(section: type[Section]) -> Iterator[type[Section]]:
    """All sections that are of a kind."""
    for kind in section.__subclasses__():
        yield kind
        yield from _kinds(kind)


def _meanings(section: type[Section]) -> dict[str, str]:
    """What the docstrings below a section's fields say of its keys.

    Pydantic would read them whenever a campaign is loaded, for a third of the time of its imports.
    """
    (body,) = ast.parse(inspect.getsource(section)).body
    assert isinstance(body, ast.ClassDef)
    (above,) = section.__bases__
    told = _meanings(above) if issubclass(above, Section) else {}
    return told | {
        field.target.id: inspect.cleandoc(text.value.value)
        for field, text in pairwise(body.body)
        if isinstance(field, ast.AnnAssign) and isinstance(field.target, ast.Name)
        if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
        if isinstance(text.value.value, str)
    }


def _add_rules(sections: dict[str, Any]) -> None:
    """What validators of the sections ask beyond types."""
    retries = sections["RunSection"]["properties"]["retries"]
    one_number = sections["RetriesSection"]["properties"]["stopped"]
    retries["anyOf"] = [
        {"$ref": retries.pop("$ref")},
        {key: one_number[key] for key in ("type", "minimum", "maximum")},
    ]
    parameter = sections["ParameterSection"]
    none = {"not": {"anyOf": _one_of(TARGET_KEYS)}}  # a placeholder of `solver: command`
    parameter["oneOf"] = [*_one_of(TARGET_KEYS), none]
    parameter["allOf"] = [
        {
            "if": {"properties": {"quantity": {"const": quantity}}, "required": ["quantity"]},
            "then": {"anyOf": [*_one_of(facts.targets), none]},
        }
        for quantity, facts in QUANTITIES.items()
        if facts.targets
    ]


def _one_of(keys: tuple[str, ...]) -> list[dict[str, Any]]:
    return [{"required": [key]} for key in keys]
