"""Sections of a campaign file: their keys are their fields, and unknown keys are refused."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Annotated, Any, get_args

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from modetune.adapters.yaml_file import YamlFile
from modetune.core.near_names import suggestion

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]


#: The name of all modes that a key does not list.
OTHERS = "others"


def by_name(given: object) -> object:
    """Return a mapping with its names as text, as the file's lines have them."""
    return {str(key): value for key, value in given.items()} if isinstance(given, dict) else given


def by_mode(given: object) -> object:
    """Return a mapping by modes; a single value is for all modes."""
    return by_name(given) if isinstance(given, dict) else {OTHERS: given}


#: One value, or values by the number of a mode and for the `others`.
Weights = Annotated[
    dict[str, NotNegative],
    BeforeValidator(by_mode, json_schema_input_type=NotNegative | dict[str, NotNegative]),
]
Deviations = Annotated[
    dict[str, Positive],
    BeforeValidator(by_mode, json_schema_input_type=Positive | dict[str, Positive]),
]


class Section(BaseModel):
    """A mapping of the campaign file; the docstring below a field is the meaning of its key."""

    model_config = ConfigDict(extra="forbid", frozen=True, defer_build=True)


def section_problems(
    error: ValidationError, file: YamlFile, section: type[Section], name: str
) -> list[str]:
    """Return the problems of a file that is a section, each with file and line.

    name: of the file, for problems of the whole.
    """
    errors = error.errors()
    places = [item["loc"] for item in errors]
    found = []
    for item in errors:
        place = item["loc"]
        if any(len(other) > len(place) and other[: len(place)] == place for other in places):
            continue  # a problem inside it also causes this one
        text, given = item["msg"].removeprefix("Value error, "), item["input"]
        if item["type"] == "extra_forbidden":
            near = suggestion(str(place[-1]), _keys(section, place[:-1]))
            text = f"unknown key `{place[-1]}`{near}"
        elif item["type"] == "missing":
            text = f"the key `{place[-1]}` is missing"
        elif item["type"] == "literal_error":
            known = re.findall(r"'([^']*)'", item["ctx"]["expected"])
            text = f"unknown value `{given}`{suggestion(str(given), known)}"
        elif not isinstance(given, dict | list):
            text = f"{text}; found {given!r}"
        key = ".".join(map(str, place)) or name
        found.append(f"{file.where(place)}: {key}: {text}")
    return found


def _keys(section: type[Section], place: tuple[str | int, ...]) -> list[str]:
    """Return the keys that are allowed at a place of a section."""
    inside = [section]
    for key in place:
        named = [item.model_fields[str(key)] for item in inside if str(key) in item.model_fields]
        # A position in a list, or a choice among several sections, has no keys.
        inside = [kind for field in named for kind in _sections(field.annotation)] or inside
    return list(dict.fromkeys(key for kind in inside for key in kind.model_fields))


def _sections(annotation: Any) -> Iterator[type[Section]]:
    """Return the sections within a field's type."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        yield annotation
    for inner in get_args(annotation):
        yield from _sections(inner)
