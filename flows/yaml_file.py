"""YAML files with the line of every key, so that a problem can be shown where it stands."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from pathlib import Path

import yaml

from modetune.core.errors import CampaignError

#: Where a value stands: the keys and list positions that lead to it.
Place = tuple[str | int, ...]


@dataclass(frozen=True, slots=True)
class YamlFile:
    """A mapping read from a file, its text, and the line of each of its values."""

    path: Path
    text: str
    data: dict[str, object]
    lines: dict[Place, int]

    def where(self, place: Place) -> str:
        """File and line of a value, or of the nearest thing around it."""
        while place and place not in self.lines:
            place = place[:-1]
        return f"{self.path}, line {self.lines.get(place, 1)}"


class _Loader(yaml.SafeLoader):
    """Plain YAML data only: no tags that build objects."""


def read_yaml(path: Path) -> YamlFile:
    """Read a file that holds one mapping. Raises CampaignError with file and line."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise CampaignError(f"{path} cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise CampaignError(f"{path} is not a text file: {error.reason}") from error
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        if not isinstance(node, yaml.MappingNode):
            raise CampaignError(f"{path}: a campaign is a mapping of keys, such as `name: garteur`")
        lines: dict[Place, int] = {}
        _locate(node, (), lines, path)
        data = loader.construct_document(node)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "no YAML"
        raise CampaignError(f"{path}{line}: not readable as YAML: {problem}") from error
    finally:
        loader.dispose()
    return YamlFile(path, text, data, lines)


def _locate(node: yaml.Node, place: Place, lines: dict[Place, int], path: Path) -> None:
    lines.setdefault(place, node.start_mark.line + 1)
    if isinstance(node, yaml.MappingNode):
        seen: set[Hashable] = set()
        for key, value in node.value:
            line = key.start_mark.line + 1
            if key.value in seen:
                raise CampaignError(f"{path}, line {line}: the key `{key.value}` stands twice")
            seen.add(key.value)
            lines[(*place, str(key.value))] = line
            _locate(value, (*place, str(key.value)), lines, path)
    elif isinstance(node, yaml.SequenceNode):
        for position, value in enumerate(node.value):
            _locate(value, (*place, position), lines, path)


def override(file: YamlFile, settings: list[str]) -> dict[str, object]:
    """The file's data with `key.key=value` settings applied, values read as YAML.

    Raises CampaignError where a setting has no such form or leads through a value.
    """
    data = yaml.safe_load(file.text)
    for setting in settings:
        path, separator, text = setting.partition("=")
        *outer, last = path.strip().split(".")
        target = data
        for key in outer:
            target = target.setdefault(key, {}) if isinstance(target, dict) else None
        if not separator or not last or not isinstance(target, dict):
            raise CampaignError(f"--set {setting!r}: expected KEY.KEY=VALUE, e.g. update.e2=0.002")
        try:
            target[last] = yaml.safe_load(text)
        except yaml.YAMLError as error:
            raise CampaignError(f"--set {setting!r}: the value is no YAML") from error
    return dict(data)
