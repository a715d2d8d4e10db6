"""YAML files: their values, the line of each, and new values written into the same text.

Only plain data: no tag builds an object. An edit writes nothing but the values that change, so
comments, order, quotes, indentation and line ends stay. The new text is read again, and refused
where it does not mean what was intended.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from modetune.adapters.regular_file import read_regular
from modetune.core.errors import CampaignError

#: The place of a value: the keys and list positions that lead to it.
Place = tuple[str | int, ...]
#: Repetitions (`*name`) of repetitions can make a short file endless.
MOST_VALUES = 200_000
#: Bytes for which PyYAML takes five seconds: ten thousand springs. Larger systems are matrices.
MOST_BYTES = 600_000


@dataclass(frozen=True, slots=True)
class YamlFile:
    """A mapping read from a file, its text, the line of each of its values, and the words.

    words: where in the text each value of one word begins and ends.
    """

    path: Path
    text: str
    data: dict[str, object]
    lines: dict[Place, int]
    words: dict[Place, tuple[int, int]]

    def where(self, place: Place) -> str:
        """Return file and line of a value, or of the nearest thing around it.

        What is no file has none.
        """
        if not self.lines:
            return str(self.path)
        while place and place not in self.lines:
            place = place[:-1]
        return f"{self.path}, line {self.lines.get(place, 1)}"

    def at(self, place: Place) -> object:
        """Return the value at a place of mappings and lists; None where there is none."""
        found: object = self.data
        for key in place:
            if isinstance(found, list) and isinstance(key, int) and key < len(found):
                found = found[key]
            else:
                found = found.get(key) if isinstance(found, dict) else None
        return found

    def entries(self, place: Place, problems: list[str]) -> dict[str, object]:
        """Return the mapping at a place; a problem and nothing where there is none."""
        found = self.at(place)
        if not isinstance(found, dict) or not all(isinstance(key, str) for key in found):
            problems.append(f"{self.where(place)}: `{place[-1]}` must be a mapping of names")
            return {}
        return found

    def word(self, place: Place) -> str:
        """Return a value as it is written; empty where it is not one word."""
        start, end = self.words.get(place, (0, 0))
        return self.text[start:end]

    def replaced(self, words: Mapping[Place, str]) -> str:
        """Return the text with other words at these places."""
        text = self.text
        for place in sorted(words, key=lambda place: self.words[place], reverse=True):
            start, end = self.words[place]
            text = f"{text[:start]}{words[place]}{text[end:]}"
        return text


#: What decks are called, which are no YAML.
DECK_SUFFIXES = (".inp", ".bdf", ".nas", ".fem")


class _Loader(yaml.SafeLoader):
    """Plain YAML data only: no tags that build objects."""


def read_yaml(path: Path, kind: str) -> YamlFile:
    """Read a file that holds one mapping; kind: what the file is, for messages.

    Raises CampaignError with file and line.
    """
    if path.suffix.lower() in DECK_SUFFIXES:
        raise CampaignError(
            f"{path} is a deck by its name, not {kind}; `modetune init {path.name}` writes a "
            "campaign for it"
        )
    try:
        text = read_regular(path, MOST_BYTES).decode(
            "utf-8"
        )  # line ends as they are, to be written back
    except OSError as error:
        raise CampaignError(f"{path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise CampaignError(f"{path} is not a text file: {error.reason}") from error
    return parse_yaml(path, text, kind)


def parse_yaml(path: Path, text: str, kind: str) -> YamlFile:
    """Return the YamlFile of a text. Raises CampaignError with file and line."""
    loader = None
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        if not isinstance(node, yaml.MappingNode):
            raise CampaignError(f"{path}: {kind} is a mapping of keys, a `key: value` a line")
        lines: dict[Place, int] = {}
        words: dict[Place, tuple[int, int]] = {}
        _locate(node, (), path, lines, words)
        data = loader.construct_document(node)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or getattr(error, "reason", None) or "no YAML"
        raise CampaignError(f"{path}{line}: not readable as YAML: {problem}") from error
    except (ValueError, TypeError, RecursionError) as error:
        # A date that is none, a key that is a list, a thing within itself.
        raise CampaignError(f"{path}: not readable as YAML: {error}") from error
    finally:
        if loader is not None:
            loader.dispose()
    return YamlFile(path, text, data, lines, words)


def _locate(
    node: yaml.Node,
    place: Place,
    path: Path,
    lines: dict[Place, int],
    words: dict[Place, tuple[int, int]],
) -> None:
    if len(lines) > MOST_VALUES:
        raise CampaignError(f"{path}: more than {MOST_VALUES} values, repeated ones counted")
    lines.setdefault(place, node.start_mark.line + 1)
    if isinstance(node, yaml.MappingNode):
        seen: set[Hashable] = set()
        for key, value in node.value:
            line = key.start_mark.line + 1
            if key.value in seen:
                raise CampaignError(f"{path}, line {line}: the key `{key.value}` occurs twice")
            seen.add(key.value)
            lines[(*place, str(key.value))] = line
            _locate(value, (*place, str(key.value)), path, lines, words)
    elif isinstance(node, yaml.SequenceNode):
        for position, value in enumerate(node.value):
            _locate(value, (*place, position), path, lines, words)
    else:
        words[place] = (node.start_mark.index, node.end_mark.index)


def edited(source: YamlFile, changes: Mapping[Place, object]) -> str:
    """Return the text of a file with values of mappings set, or removed where they are None.

    Lists may lead to the mappings, and may lose an item. A mapping replaces the present one entry
    by entry, so entries that stay keep their comments. Raises CampaignError where the text cannot
    be changed so.
    """
    text, wanted, found = source.text, source.data, None
    with suppress(yaml.YAMLError, AttributeError):  # what leads there may not be a mapping
        for place, value in changes.items():
            wanted = _put(wanted, place, value)
            text = _set(text, place, value)
        found = yaml.safe_load(text)
    if found != wanted:
        asked = "; ".join(
            f"{'.'.join(map(str, place))}: {'(removed)' if value is None else flow_text(value)}"
            for place, value in changes.items()
        )
        raise CampaignError(
            f"{source.path} is written in a way that cannot be changed here (repeated parts or "
            f"several lines); write it there by hand: {asked}"
        )
    return text


def _put(data: Any, place: Place, value: object) -> Any:
    """Return the data with one value set or removed, nothing else of it touched."""
    if not place:
        return value
    if data is None and value is None:
        return None
    if isinstance(data, list):
        gone = value is None and len(place) == 1
        return [
            _put(item, place[1:], value) if at == place[0] else item
            for at, item in enumerate(data)
            if not (gone and at == place[0])
        ]
    inner = _put((data or {}).get(place[0]), place[1:], value)
    rest = {key: value for key, value in (data or {}).items() if key != place[0]}
    return rest if inner is None else {**rest, place[0]: inner}


def _set(text: str, place: Place, value: object) -> str:
    """Return the text with one value set or removed.

    What leads to it is made where it is missing.
    """
    node: Any = yaml.compose(text, Loader=yaml.SafeLoader)
    parents: list[tuple[yaml.MappingNode, int]] = []
    for depth, key in enumerate(place):
        if isinstance(node, yaml.SequenceNode) and isinstance(key, int):
            if value is None and depth == len(place) - 1:
                return _without(text, node, key)
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
    """Return the position of a key in a mapping, or in nothing, which becomes one."""
    if node.tag == "tag:yaml.org,2002:null":
        node.value = []
    elif not isinstance(node, yaml.MappingNode):
        raise AttributeError(f"not a mapping: {node.tag}")
    return next((at for at, (name, _) in enumerate(node.value) if name.value == str(key)), None)


def _replaced(text: str, node: yaml.Node, start: int, value: object) -> str:
    end = _end(text, node)
    before = " " if start and text[start - 1] == ":" else ""
    return f"{text[:start]}{before}{flow_text(value)}{text[end:]}"


def _inserted(text: str, node: yaml.MappingNode, key: str | int, value: object) -> str:
    """Return a new entry behind the last one of a mapping, in its style."""
    end, entry = _end(text, node.value[-1][1]), f"{flow_text(key)}: {flow_text(value)}"
    if node.flow_style:
        return f"{text[:end]}, {entry}{text[end:]}"
    line_end = "\r\n" if "\r\n" in text else "\n"
    indent = " " * node.value[0][0].start_mark.column
    rest = re.compile(r"[^\r\n]*").match(text, end)  # a comment behind the last entry
    at = rest.end() if rest else end
    return f"{text[:at]}{line_end}{indent}{entry}{text[at:]}"


def _without(text: str, node: yaml.CollectionNode, at: int) -> str:
    """Return the text without an entry of a mapping or an item of a list."""
    # Each entry begins with the first and ends with the last node.
    spans = [entry if isinstance(entry, tuple) else (entry, entry) for entry in node.value]
    start, end = spans[at][0].start_mark.index, _end(text, spans[at][1])
    if node.flow_style:
        if at:
            start = _end(text, spans[at - 1][1])
        elif len(spans) > 1:
            end = spans[1][0].start_mark.index
        return text[:start] + text[end:]
    if len(spans) == 1:
        if isinstance(node, yaml.MappingNode):
            return f"{text[:start]}{{}}{text[end:]}"
        return f"{text[: text.rindex(':', 0, start) + 1]} []{text[end:]}"
    start = text.rfind("\n", 0, start) + 1
    line = text.find("\n", end)
    return text[:start] + (text[line + 1 :] if line >= 0 else "")


def _end(text: str, node: yaml.Node) -> int:
    """Return where a value ends: PyYAML's end of a block is where the next thing begins."""
    if isinstance(node, yaml.CollectionNode) and not node.flow_style and node.value:
        last = node.value[-1]
        return _end(text, last[1] if isinstance(last, tuple) else last)
    return node.start_mark.index + len(text[node.start_mark.index : node.end_mark.index].rstrip())


def flow_text(value: object) -> str:
    """Return a value as YAML in one line, as people write it."""
    told = yaml.safe_dump(
        value, default_flow_style=True, sort_keys=False, width=1_000_000, allow_unicode=True
    )
    return told.removesuffix("...\n").strip()
