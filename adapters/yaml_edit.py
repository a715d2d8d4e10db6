"""Values of a YAML file set by hand of a program: its text stays what it is around them.

Comments, order, quotes, indentation and line ends are kept, since nothing but the value that
changes is written. What came out is read again, and refused where it is not what was meant.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import yaml

from modetune.adapters.yaml_file import Place, YamlFile
from modetune.core.errors import CampaignError


def edited(source: YamlFile, changes: Mapping[Place, object]) -> str:
    """The text of a file with values of mappings set, or removed where they are None.

    Lists may lead to the mappings.

    A mapping takes the place of what stands there entry by entry, so comments beside entries that
    stay are kept. Raises CampaignError where the text cannot be changed so.
    """
    text, wanted, found = source.text, source.data, None
    with suppress(yaml.YAMLError, AttributeError):  # what leads there may not be a mapping
        for place, value in changes.items():
            wanted = _put(wanted, place, value)
            text = _set(text, place, value)
        found = yaml.safe_load(text)
    if found != wanted:
        asked = "; ".join(
            f"{'.'.join(map(str, place))}: {'(removed)' if value is None else _flow(value)}"
            for place, value in changes.items()
        )
        raise CampaignError(
            f"{source.path} is written in a way that cannot be changed here (repeated parts or "
            f"several lines); write it there by hand: {asked}"
        )
    return text


def _put(data: Any, place: Place, value: object) -> Any:
    """The data with one value set or removed, nothing else of it touched."""
    if not place:
        return value
    if data is None and value is None:
        return None
    if isinstance(data, list):
        return [
            _put(item, place[1:], value) if at == place[0] else item for at, item in enumerate(data)
        ]
    inner = _put((data or {}).get(place[0]), place[1:], value)
    rest = {key: value for key, value in (data or {}).items() if key != place[0]}
    return rest if inner is None else {**rest, place[0]: inner}


def _set(text: str, place: Place, value: object) -> str:
    """The text with one value set or removed; what leads to it is made where it is missing."""
    node: Any = yaml.compose(text, Loader=yaml.SafeLoader)
    parents: list[tuple[yaml.MappingNode, int]] = []
    for depth, key in enumerate(place):
        if isinstance(node, yaml.SequenceNode) and isinstance(key, int):
            node = node.value[key]
            continue
        at = _entry(node, key)
        if at is None:
            if value is None:
                return text
            for missing in reversed(place[depth + 1 :]):
                value = {missing: value}
            if node.value:
                return _inserted(text, node, key, value)
            return _replaced(text, node, node.start_mark.index, {key: value})
        parents.append((node, at))
        node = node.value[at][1]
    if value is None:
        return _without(text, *parents[-1])
    if isinstance(value, dict) and value and isinstance(node, yaml.MappingNode) and node.value:
        entries = dict.fromkeys((yaml.safe_load(key.value) for key, _ in node.value), None) | value
        for key, inner in sorted(entries.items(), key=lambda item: item[1] is None):
            text = _set(text, (*place, key), inner)  # what goes goes last: none is ever empty
        return text
    name = parents[-1][0].value[parents[-1][1]][0]
    is_block = isinstance(node, yaml.CollectionNode) and not node.flow_style
    start = text.index(":", name.end_mark.index) + 1 if is_block else node.start_mark.index
    return _replaced(text, node, start, value)


def _entry(node: Any, key: str | int) -> int | None:
    """The position of a key in a mapping, or in nothing, which becomes one."""
    if node.tag == "tag:yaml.org,2002:null":
        node.value = []
    elif not isinstance(node, yaml.MappingNode):
        raise AttributeError(f"not a mapping: {node.tag}")
    return next((at for at, (name, _) in enumerate(node.value) if name.value == str(key)), None)


def _replaced(text: str, node: yaml.Node, start: int, value: object) -> str:
    end = _end(text, node)
    before = " " if start and text[start - 1] == ":" else ""
    return f"{text[:start]}{before}{_flow(value)}{text[end:]}"


def _inserted(text: str, node: yaml.MappingNode, key: str | int, value: object) -> str:
    """A new entry behind the last one of a mapping, in its style."""
    end, entry = _end(text, node.value[-1][1]), f"{_flow(key)}: {_flow(value)}"
    if node.flow_style:
        return f"{text[:end]}, {entry}{text[end:]}"
    line_end = "\r\n" if "\r\n" in text else "\n"
    indent = " " * node.value[0][0].start_mark.column
    rest = re.compile(r"[^\r\n]*").match(text, end)  # a comment behind the last entry
    at = rest.end() if rest else end
    return f"{text[:at]}{line_end}{indent}{entry}{text[at:]}"


def _without(text: str, node: yaml.MappingNode, at: int) -> str:
    """The text without an entry of a mapping."""
    start, end = node.value[at][0].start_mark.index, _end(text, node.value[at][1])
    if node.flow_style:
        if at:
            start = _end(text, node.value[at - 1][1])
        elif len(node.value) > 1:
            end = node.value[1][0].start_mark.index
        return text[:start] + text[end:]
    if len(node.value) == 1:
        return f"{text[:start]}{{}}{text[end:]}"
    start = text.rfind("\n", 0, start) + 1
    line = text.find("\n", end)
    return text[:start] + (text[line + 1 :] if line >= 0 else "")


def _end(text: str, node: yaml.Node) -> int:
    """Where a value ends: PyYAML's end of a block is where the next thing begins."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(text, last[1] if isinstance(last, tuple) else last)
    return node.start_mark.index + len(text[node.start_mark.index : node.end_mark.index].rstrip())


def _flow(value: object) -> str:
    """A value in one line, as people write it."""
    told = yaml.safe_dump(
        value, default_flow_style=True, sort_keys=False, width=1_000_000, allow_unicode=True
    )
    return told.removesuffix("...\n").strip()
