"""The proposed parameters as a campaign file that is ready to run.

The user's file stays as it is: candidates that were left out become comments with their reason
above them, so that one hash brings a candidate back; only the name gets an ending, so that
both campaigns keep their own run folders, and paths follow where the file goes elsewhere. What
was written is read again and must be the same campaign with the chosen parameters; where the text
does not allow that (a list in one line, anchors), the file is written again without its comments.

A field stays whole if one of its zones was chosen. An expression stays with the parameters that it
names if one of them was chosen, and so do variables of responses: without them the file would not
be a campaign.
"""

from __future__ import annotations

import functools
import os
import textwrap
from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from modetune.adapters.yaml_file import Place, YamlFile, read_yaml
from modetune.core.errors import CampaignError
from modetune.core.expressions import names_of
from modetune.core.storage.files import writing
from modetune.flows.campaign.campaign import campaign_form
from modetune.flows.campaign.schema import STORE_VARIABLE, OpenFile
from modetune.flows.studies.screen.choice import ParameterVerdict
from modetune.flows.studies.screen.record import Screening

ENDING = "-screened"
#: Longest name of a campaign.
NAME_LENGTH = 64
#: Keys whose values are paths relative to the campaign file.
PATH_KEYS = ("deck", "modes", "repeats", "store")


def write_proposal(campaign_file: Path, screening: Screening, out: Path) -> Path:
    """Write the campaign with the chosen parameters alone. Raises CampaignError, StoreError."""
    if not screening.choice.chosen:
        raise CampaignError(
            "the screening rejected all parameters, so there is no campaign to write; the table of "
            "candidates gives the reasons"
        )
    check_out(campaign_file, out)
    source = read_yaml(campaign_file, "a campaign")
    text = proposed_text(source, screening, out)
    with writing(out) as part:
        part.write_bytes(text.encode("utf-8"))
    return out


def check_out(campaign_file: Path, out: Path) -> None:
    """A proposal never replaces the campaign. Raises CampaignError."""
    if out.exists() and out.resolve() == campaign_file.resolve():
        raise CampaignError(f"--out {out} is the campaign itself; name another file")
    if out.is_dir():
        raise CampaignError(f"--out {out} is a folder; name a file")


def proposed_text(source: YamlFile, screening: Screening, out: Path) -> str:
    """Return the text of the proposed campaign for the file `out`."""
    kept, left_out = _kept(source, screening)
    wanted = _wanted(source, kept, out)
    heading = _heading(screening, kept)
    text = _edited(source, heading, left_out, wanted)
    try:
        if text is not None and yaml.safe_load(text) == wanted:
            return text
    except yaml.YAMLError:
        pass  # the text does not allow it
    shown = yaml.safe_dump(wanted, sort_keys=False, allow_unicode=True, width=100)
    return "".join(f"# {line}\n" for line in heading) + shown


def _kept(source: YamlFile, screening: Screening) -> tuple[set[str], dict[str, str]]:
    """Return the names of the parameters that stay, and the reasons why others do not."""
    file, chosen = campaign_form(source, None, OpenFile), set(screening.choice.chosen)
    fields = {item.name for item in file.parameters if item.field}
    zones = {name for name in fields if any(zone.startswith(f"{name}.") for zone in chosen)}
    needed = [
        {item.name, *names_of(item.expression)} for item in file.parameters if item.expression
    ]
    kept = zones | file.variables_of_responses()
    kept |= chosen & {item.name for item in file.parameters}
    while more := [names for names in needed if names & kept and not names <= kept]:
        kept = kept.union(*more)
    reasons = {item.name: item.reason for item in screening.choice.verdicts}
    reasons |= dict.fromkeys(fields, "no zone of this field was chosen")
    without = "its expression names only parameters that were left out"
    return kept, {
        item.name: reasons.get(item.name, without)
        for item in file.parameters
        if item.name not in kept
    }


def _heading(screening: Screening, kept: set[str]) -> list[str]:
    chosen, design = screening.choice.chosen, screening.design
    method = {
        "local": "sensitivities at the deck's values", "morris": "Morris", "sobol": "Sobol",
        "lhs": "a Latin hypercube",
    }[design.method]  # fmt: skip
    points = f", {len(design.points)} points" if len(design.points) else ""
    line = (
        f"Proposed by modetune screen ({method}{points}): {len(chosen)} of "
        f"{len(screening.names)} parameters. "
    )
    reasons = [f"{item.name}: {item.reason}." for item in _by_rank(screening)]
    if further := sorted(name for name in kept.difference(chosen) if name in screening.names):
        reasons.append(f"Not chosen, but needed by expressions or responses: {', '.join(further)}.")
    return [part for text in (line, *reasons) for part in textwrap.wrap(text, 96)]


def _by_rank(screening: Screening) -> list[ParameterVerdict]:
    chosen = [item for item in screening.choice.verdicts if item.chosen]
    return sorted(chosen, key=lambda item: item.rank)


def _wanted(source: YamlFile, kept: set[str], out: Path) -> dict[str, object]:
    """The data of the proposed campaign."""
    data = yaml.safe_load(source.text)
    data["parameters"] = [item for item in data["parameters"] if str(item["name"]) in kept]
    for place, path in _paths(source, out).items():
        target = data
        for key in place[:-1]:
            target = target[key]
        target[place[-1]] = path
    data["name"] = proposed_name(str(data["name"]))
    elsewhere = out.resolve().parent != source.path.resolve().parent
    if elsewhere and "store" not in data and not os.environ.get(STORE_VARIABLE):
        store = source.path.resolve().parent / ".modetune" / "store"
        data["store"] = os.path.relpath(store, out.resolve().parent)
    return dict(data)


def proposed_name(name: str) -> str:
    """The name of a proposed campaign."""
    return name if name.endswith(ENDING) else f"{name[: NAME_LENGTH - len(ENDING)]}{ENDING}"


def _paths(source: YamlFile, out: Path) -> dict[Place, str]:
    """Return the paths that change because the file goes to another folder."""
    here, there = source.path.resolve().parent, out.resolve().parent
    if here == there:
        return {}
    found = {}
    for place in source.words:
        keys = [key for key in place if isinstance(key, str)]
        if keys and keys[-1] in PATH_KEYS and keys[0] != "parameters":
            value = yaml.safe_load(source.word(place))
            if isinstance(value, str) and not Path(value).is_absolute():
                found[place] = os.path.relpath(here / value, there)
    return found


def _edited(
    source: YamlFile, heading: list[str], reasons: dict[str, str], wanted: dict[str, object]
) -> str | None:
    """The user's text with candidates left out commented away; None where it has no such form."""
    words: dict[Place, str] = {("name",): _scalar(wanted["name"])}
    for place in source.words:
        if place[0] == "parameters" or place == ("name",):
            continue
        value = functools.reduce(_item, place, wanted)
        if value != yaml.safe_load(source.word(place) or "null"):
            words[place] = _scalar(value)
    spans = _item_lines(source)
    if spans is None or any(place not in source.words for place in words):
        return None
    # No word moves to another line, so the lines of items stay theirs.
    ends = "\r\n" if "\r\n" in source.text else "\n"
    lines = source.replaced(words).splitlines(keepends=True)
    names = [str(item["name"]) for item in source.data["parameters"]]  # type: ignore[attr-defined]
    for (first, last), name in reversed(list(zip(spans, names, strict=True))):
        if name not in reasons:
            continue
        body = lines[first : last + 1]
        indent = body[0][: len(body[0]) - len(body[0].lstrip())]
        width = max(40, 96 - len(indent))
        texts = [
            f"{indent}# {line}{ends}" for line in textwrap.wrap(f"left out: {reasons[name]}", width)
        ]
        cut = [
            f"{indent}# {line[len(indent) :]}" if line.startswith(indent) else f"{indent}# {line}"
            for line in body
        ]
        lines[first : last + 1] = texts + cut
    if "store" in wanted and "store" not in source.data:
        if lines and not lines[-1].endswith("\n"):
            lines[-1] += ends
        lines.append(f"store: {_scalar(wanted['store'])}{ends}")
    top = next((n for n, line in enumerate(lines) if not line.startswith("# yaml-language")), 0)
    lines[top:top] = [f"# {line}{ends}" for line in heading]
    return "".join(lines)


def _item(value: Any, key: str | int) -> Any:
    """An item of a list or mapping; places name each key of a mapping by its text."""
    if isinstance(value, Mapping):
        return next(item for name, item in value.items() if str(name) == str(key))
    return value[key]


def _scalar(value: object) -> str:
    """A word of YAML in one line."""
    return yaml.safe_dump(value, default_flow_style=True, width=10_000).split("\n")[0]


def _item_lines(source: YamlFile) -> list[tuple[int, int]] | None:
    """First and last line (from 0) of each parameter of a list that has a dash a line."""
    node = yaml.compose(source.text, Loader=yaml.SafeLoader)
    assert isinstance(node, yaml.MappingNode)
    items = next(value for key, value in node.value if key.value == "parameters")
    if items.flow_style:
        return None
    spans = []
    for item in items.value:
        dash = source.text.rfind("-", 0, item.start_mark.index)
        first = source.text.count("\n", 0, dash)
        spans.append((first, _last_line(item)))
    apart = all(before[1] < after[0] for before, after in pairwise(spans))
    return spans if apart else None


def _last_line(node: yaml.Node) -> int:
    """The last line (from 0) that holds something of a node: the end of a block is the next one."""
    if not isinstance(node, yaml.CollectionNode) or node.flow_style:
        end = node.end_mark
        return int(end.line if end.column or end.line == node.start_mark.line else end.line - 1)
    last = node.value[-1]
    return _last_line(last[1] if isinstance(last, tuple) else last)
