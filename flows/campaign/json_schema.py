"""The campaign file's JSON schema, for editors and other programs.

What pydantic derives from `schema.py`, and what only validators there know: which keys exclude
each other, and which targets belong to which quantity. An editor that reads it (VS Code through
the first line of a campaign, `# yaml-language-server: $schema=campaign.schema.json`) completes
keys and shows mistakes while they are typed; `modetune check` stays the judge.
"""

from __future__ import annotations

import json
from typing import Any

from modetune.core.parameters import TARGETS
from modetune.flows.campaign.schema import TARGET_KEYS, CampaignFile

DIALECT = "https://json-schema.org/draft/2020-12/schema"
#: A name, not an address: the file is wherever it was put.
IDENTIFIER = "urn:modetune:campaign"


def campaign_schema() -> dict[str, Any]:
    """The JSON schema of a campaign file, draft 2020-12."""
    schema = CampaignFile.model_json_schema()
    sections = schema["$defs"]
    for section in (schema, *sections.values()):
        section.pop("title", None)
        for key in section.get("properties", {}).values():
            key.pop("title", None)  # only the key's name again
    _add_rules(sections)
    for key in ("model", "test"):
        del schema["properties"][key]["default"]
    schema["anyOf"] = [{"required": ["model", "test"]}, {"required": ["configurations"]}]
    schema["dependentRequired"] = {"model": ["test"], "test": ["model"]}
    return {"$schema": DIALECT, "$id": IDENTIFIER, "title": "modetune campaign", **schema}


def schema_text() -> str:
    """The schema as it is published, with an end of line."""
    return json.dumps(campaign_schema(), indent=2, ensure_ascii=False) + "\n"


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
            "then": {"anyOf": [*_one_of(targets), none]},
        }
        for quantity, targets in TARGETS.items()
        if targets
    ]


def _one_of(keys: tuple[str, ...]) -> list[dict[str, Any]]:
    return [{"required": [key]} for key in keys]
