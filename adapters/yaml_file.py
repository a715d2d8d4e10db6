"""YAML files with the place of every value, so that a problem can be shown where it stands.

Plain data only: no tag builds an object. A value that is one word of the text can also be replaced
in it, and everything else stays as it was written.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from pathlib import Path

import yaml

from modetune.adapters.regular_file import read_regular
from modetune.core.errors import CampaignError

#: Where a value stands: the keys and list positions that lead to it.
Place = tuple[str | int, ...]
#: Repetitions (`*name`) of repetitions can make a short file endless.
MOST_VALUES = 200_000
#: Larger than any campaign or spring-mass system, bytes: PyYAML takes a minute for it.
MOST_BYTES = 8 << 20


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
        """File and line of a value, or of the nearest thing around it; what is no file has none."""
        if not self.lines:
            return str(self.path)
        while place and place not in self.lines:
            place = place[:-1]
        return f"{self.path}, line {self.lines.get(place, 1)}"

    def at(self, place: Place) -> object:
        """The value at a place of mappings and lists; None where there is none."""
        found: object = self.data
        for key in place:
            if isinstance(found, list) and isinstance(key, int) and key < len(found):
                found = found[key]
            else:
                found = found.get(key) if isinstance(found, dict) else None
        return found

    def entries(self, place: Place, problems: list[str]) -> dict[str, object]:
        """The mapping at a place; a problem and nothing where there is none."""
        found = self.at(place)
        if not isinstance(found, dict) or not all(isinstance(key, str) for key in found):
            problems.append(f"{self.where(place)}: `{place[-1]}` must be a mapping of names")
            return {}
        return found

    def word(self, place: Place) -> str:
        """A value as it is written; empty where it is not one word."""
        start, end = self.words.get(place, (0, 0))
        return self.text[start:end]

    def replaced(self, words: Mapping[Place, str]) -> str:
        """The text with other words at these places."""
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
    """What `read_yaml` gives of a file with this text. Raises CampaignError with file and line."""
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
                raise CampaignError(f"{path}, line {line}: the key `{key.value}` stands twice")
            seen.add(key.value)
            lines[(*place, str(key.value))] = line
            _locate(value, (*place, str(key.value)), path, lines, words)
    elif isinstance(node, yaml.SequenceNode):
        for position, value in enumerate(node.value):
            _locate(value, (*place, position), path, lines, words)
    else:
        words[place] = (node.start_mark.index, node.end_mark.index)
