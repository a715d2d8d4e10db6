"""The parameters of a campaign as a design model, for users who continue in SOL 200.

A parameter is a DESVAR x with the value and bounds that the campaign gives it. Each number of the
deck that it moves is p = C0 + c x: for a relative parameter c is the deck's number, for an absolute
one 1, and for an additive one C0 is the deck's number too. DLINK ties a parameter whose expression
is a sum to those in it; other expressions are equations (DEQATN with DVPREL2, DVMREL2, DVCREL2).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import count

from modetune.adapters.nastran.deck import NastranDeck
from modetune.adapters.nastran.design_relations import (
    WIDTH,
    equation_card,
    in_fortran,
    large_card,
    real,
    relation_head,
    relation_kind,
    tied_numbers,
)
from modetune.adapters.nastran.fields import format_number, read_number
from modetune.adapters.nastran.places import ValuePlace
from modetune.core.errors import ModelError
from modetune.core.expressions import degree, evaluate, names_of
from modetune.core.parameters import Parameter, Values

#: Characters of a DESVAR's label.
LABEL = 8
#: Cards of a design model.
DESIGN = ("DESVAR", "DLINK", "DVPREL1", "DVPREL2", "DVMREL1", "DVMREL2", "DVCREL1", "DVCREL2")

#: A number that a parameter moves: factor and constant of its value, and its place.
Line = tuple[str, str, ValuePlace]


def design_text(
    deck: NastranDeck,
    parameters: Sequence[Parameter],
    places_of: Callable[[Parameter], Sequence[ValuePlace]],
    values: Values,
) -> str:
    """Return the bulk data of the design model at these values.

    deck: the one that is not updated. A comment names what no card can express. Raises ModelError
    where an expression has no value.
    """
    free = [item for item in parameters if not item.expression and item.name in values]
    shown = {item.name: item.shown(values[item.name]) for item in free}
    own = sorted({card.name for card in deck.named(*DESIGN)})
    lines = [
        "$ Updated parameters as a design model for SOL 200:",
        f"$ include this file in the bulk data of {deck.file.name}",
        *([f"$ and remove the deck's own {', '.join(own)} cards"] if own else []),
    ]
    numbers = {item.name: number for number, item in enumerate(free, 1)}
    others = [card.text(1) for card in deck.named(*DESIGN, "DEQATN")]
    last = max((int(text) for text in others if text.isdecimal()), default=0)
    relations, links = count(last + 1), count(1)
    for item in parameters:
        names = names_of(item.expression) if item.expression else (item.name,)
        if not set(names) <= shown.keys():
            continue
        try:
            tied = list(_lines(deck, item, places_of(item)))
        except ModelError as error:
            lines.append(f"$ {item.name} has no relation: {str(error).splitlines()[0]}")
            tied = []
        if item.expression and degree(item.expression) > 1:
            lines += _by_equation(item, tied, numbers, relations)
            continue
        if item.expression:
            numbers[item.name] = len(numbers) + 1
            limits = [evaluate(item.expression, shown)]
        else:
            limits = [shown[item.name], item.shown(item.lower), item.shown(item.upper)]
        number = numbers[item.name]
        lines += _variable(item.name, number, limits)
        if item.expression:
            lines += large_card("DLINK", _link(item.expression, next(links), number, numbers))
        for factor, constant, place in tied:
            head = relation_head(next(relations), place)
            fields = (*head, "", constant, "", str(number), factor)
            lines += large_card(relation_kind(place, 1), fields)
    return "\n".join([*lines, ""])


def _variable(name: str, number: int, limits: Sequence[float]) -> list[str]:
    """Return a DESVAR, below a comment with the parameter's name where that is no label.

    limits: its value, and bounds where it has any.
    """
    fits = len(name) <= LABEL and re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII)
    tail = f"_{number}"
    plain = re.sub(r"\W|_", "", name, flags=re.ASCII).lstrip("0123456789") or "X"
    label = name if fits else plain[: LABEL - len(tail)] + tail
    fields = [str(number), label, *(format_number(value, WIDTH) for value in limits)]
    return [*([] if fits else [f"$ {label}: {name}"]), *large_card("DESVAR", fields)]


def _link(expression: str, link: int, number: int, numbers: Mapping[str, int]) -> list[str]:
    """Return the fields of a DLINK for an expression of degree 0 or 1."""
    names = names_of(expression)
    zero = dict.fromkeys(names, 0.0)
    constant = evaluate(expression, zero)
    fields = [str(link), str(number), format_number(constant, WIDTH), "1."]
    for name in names:
        slope = evaluate(expression, {**zero, name: 1.0}) - constant
        fields += [str(numbers[name]), format_number(slope, WIDTH)]
    return fields


def _lines(deck: NastranDeck, parameter: Parameter, places: Sequence[ValuePlace]) -> Iterator[Line]:
    """Yield factor, constant and place of each number. Raises ModelError."""
    cards, first = {card.lines[0]: card for card in deck.cards}, 1.0
    for _, place, text in tied_numbers(deck, cards, parameter, places):
        first = first if place.along else place.value
        ratio = format_number(place.value / first if place.along else 1.0, WIDTH)
        own = format_number(place.value, WIDTH)
        if parameter.values == "relative":
            yield text, "", place
        else:
            yield ratio, own if parameter.values == "additive" else "", place


def _by_equation(
    item: Parameter, tied: Sequence[Line], numbers: Mapping[str, int], relations: Iterator[int]
) -> Iterator[str]:
    """Yield an equation and a relation for each number that an expression gives."""
    names = names_of(item.expression)
    arguments = [f"X{place}" for place in range(1, len(names) + 1)]
    text = in_fortran(item.expression, dict(zip(names, arguments, strict=True)))
    for factor, constant, place in tied:
        number = next(relations)
        terms = [real(read_number(part)) for part in (constant, factor) if part]
        whole = f"{terms[-1]}*{text}" if len(terms) == 1 else f"{terms[0]}+{terms[1]}*{text}"
        yield from equation_card(number, arguments, whole)
        fields = [*relation_head(number, place), "", str(number), "", "DESVAR"]
        fields += [str(numbers[name]) for name in names]
        yield from large_card(relation_kind(place, 2), fields)
