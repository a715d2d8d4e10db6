"""Write a proposed change: new cards in a copy of the deck, a parameter in a copy of the campaign.

The copies stand next to their originals, and nothing else of either file changes. `modetune update`
continues from them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import yaml

from modetune.adapters.solver import AddedCards, Addition, Deck
from modetune.core.errors import CampaignError, ModelError
from modetune.core.parameters import Quantity, TargetKind
from modetune.core.storage.files import writing
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.studies.localise.changes import ModelChange
from modetune.flows.studies.localise.proposals import Proposal

#: Bounds and deviation of the new parameter, relative to the proposed value.
BOUNDS, DEVIATION = (0.1, 10.0), 0.5
#: Names of new parameters.
NAMES: dict[Quantity, str] = {
    "mass": "m_added",
    "rotary_inertia": "j_added",
    "spring_stiffness": "k_added",
}


@dataclass(frozen=True, slots=True)
class Applied:
    """The files that a change was written to, and the cards in them; `decks` has no entry where the
    change needs no cards."""

    campaign: Path
    decks: tuple[Path, ...]
    cards: tuple[str, ...]


def check_place(campaign: Campaign, out: Path) -> None:
    """Raise CampaignError where a new campaign cannot be written."""
    if out.resolve().parent != campaign.file.resolve().parent:
        raise CampaignError(
            f"{out}: the new campaign file must be in the folder of {campaign.file}, as its paths "
            "are relative to it"
        )
    if out.exists():
        raise CampaignError(f"{out} exists already; name a new campaign file")


def applied(campaign: Campaign, proposal: Proposal, out: Path) -> Applied:
    """Write a change into copies of the deck and of the campaign.

    out: the new campaign file, in the folder of the campaign's own. Raises CampaignError,
    ModelError.
    """
    check_place(campaign, out)
    change, decks = proposal.change, dict[Path, AddedCards]()
    if change.kind == "group":
        if change.quantity is None:
            raise CampaignError(f"{change.label} has no key in a campaign file")
        own = change.quantity
        number = proposal.amplitudes[0], own.quantity, own.by, own.targets, own.item
        entries = [_entry(campaign, number, relative=True)]
    else:
        added = addition(change, proposal.amplitudes.tolist())
        for case in campaign.cases:
            model = case.solver.deck.summary
            if model.file is None:
                raise ModelError(f"{model.name} has no deck to add cards to")
            if _has_place(case.solver.deck, added):
                decks.setdefault(model.file.resolve(), case.solver.deck.with_cards(added))
        if not decks:
            raise ModelError(f"no deck of {campaign.file} has the place of {change.label}")
        numbers = next(iter(decks.values())).numbers
        entries = [_entry(campaign, (value, q, by, names, 0)) for q, by, names, value in numbers]
    files = {file: file.with_name(f"{out.stem}_{file.name}") for file in decks}
    for file in files.values():
        if file.exists():
            raise CampaignError(f"{file} exists already; choose another name than {out.name}")
    text = _with_entries(campaign, entries, files, out.stem)
    for file, cards in decks.items():
        with writing(files[file]) as part:
            part.write_bytes(cards.text.encode("utf-8", "surrogateescape"))
    with writing(out) as part:
        part.write_text(text, encoding="utf-8")
    lines = next((cards.lines for cards in decks.values()), ())
    return Applied(out, tuple(files.values()), lines)


def _has_place(deck: Deck, added: Addition) -> bool:
    """Return whether a configuration's deck has what changes."""
    if added.kind == "support":
        return not deck.fixed().keys().isdisjoint(added.nodes)
    return deck.summary.node_ids.issuperset(added.nodes)


def addition(change: ModelChange, values: list[float]) -> Addition:
    """Return a change as an addition to a deck. Raises ModelError for one that has no cards."""
    if change.kind in ("point mass", "sensor masses"):
        return Addition("mass", change.nodes, 0, tuple(values))
    if change.kind == "inertia":
        return Addition("inertia", change.nodes, 0, tuple(values))
    if change.kind == "absorber":
        return Addition("absorber", change.nodes, change.component, tuple(values))
    if "spring" in change.kind:
        return Addition("spring", change.nodes, change.component, tuple(values))
    if change.kind == "yielding support":
        return Addition("support", change.nodes, change.component, tuple(values))
    if change.kind == "yielding link":
        return Addition("link", change.nodes, change.component, tuple(values))
    raise ModelError(f"modetune adds no cards for {change.label}: add them by hand")


def _entry(
    campaign: Campaign,
    number: tuple[float, Quantity, TargetKind, tuple[str, ...], int],
    relative: bool = False,
) -> str:
    """Return the line of a new parameter, relative to what the new deck has."""
    value, quantity, by, targets, item = number
    name, taken = NAMES.get(quantity, quantity), set(campaign.parameters.names)
    name = next(n for n in (name, *(f"{name}_{k}" for k in range(2, 1000))) if n not in taken)
    named = targets[0] if len(targets) == 1 else f"[{', '.join(targets)}]"
    text = f"{{name: {name}, quantity: {quantity}, {by}: {named}"
    text += f", item: {item}" if item else ""
    low, high = BOUNDS
    if relative:
        low, high = _rounded(min(0.5, 0.5 * value)), _rounded(max(2.0, 2.0 * value))
        text += f", initial: {value:.4g}"
    return f"{text}, bounds: [{low:g}, {high:g}], deviation: {DEVIATION:g}}}"


def _rounded(value: float) -> float:
    digits = 1 - math.floor(math.log10(value))
    return round(value, digits)


def _with_entries(
    campaign: Campaign, entries: list[str], decks: dict[Path, Path], stem: str
) -> str:
    """Return the campaign's text with more parameters, other decks and another name."""
    text, root = campaign.text, yaml.compose(campaign.text, Loader=yaml.SafeLoader)
    if not isinstance(root, yaml.MappingNode):
        raise CampaignError(f"{campaign.file}: the campaign was not read from a file")
    given = {key.value: value for key, value in root.value}
    parameters = given.get("parameters")
    if not isinstance(parameters, yaml.SequenceNode) or not parameters.value:
        raise CampaignError(f"{campaign.file}: no list of parameters to add one to")
    last = parameters.value[-1]
    if parameters.flow_style:
        more = "".join(f", {entry}" for entry in entries)
    else:
        indent = " " * parameters.start_mark.column
        more = "".join(f"\n{indent}- {entry}" for entry in entries)
    at = _end_of(text, last)
    if not parameters.flow_style and "\n" in text[at:]:
        at += text[at:].index("\n")  # behind a comment on the same line
    edits = [(at, at, more)]
    if name := given.get("name"):  # it names the run folder too
        edits.append((name.start_mark.index, name.end_mark.index, yaml_text(stem)))
    for node in _decks(root):
        file = (campaign.file.parent / node.value).resolve()
        if file in decks:
            new = str(Path(node.value).with_name(decks[file].name))
            edits.append((node.start_mark.index, node.end_mark.index, yaml_text(new)))
    for start, stop, new in sorted(edits, reverse=True):
        text = text[:start] + new + text[stop:]
    return text


def yaml_text(value: str) -> str:
    """Return a text as a YAML scalar in one line."""
    return yaml.safe_dump(value, default_style=None, width=10_000).removesuffix("\n...\n").strip()


def _end_of(text: str, node: yaml.Node) -> int:
    """Return the position behind a node, without the blank lines that a block ends with."""
    end = node.end_mark.index
    return len(text[:end].rstrip())


def _decks(node: yaml.Node) -> Iterator[yaml.ScalarNode]:
    """Yield the values of all `deck` keys."""
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            if key.value == "deck" and isinstance(value, yaml.ScalarNode):
                yield value
            else:
                yield from _decks(value)
    elif isinstance(node, yaml.SequenceNode):
        for value in node.value:
            yield from _decks(value)
