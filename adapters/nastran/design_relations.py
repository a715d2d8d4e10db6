"""Relations between design variables and numbers of a deck, in Nastran's form.

A relation names a card, its number and the name of a field (DVPREL, DVMREL, DVCREL). Nastran's
equations (DEQATN) are Fortran's: upper case, real numbers with a point, lines of 56 columns behind
the number and of 64 columns after it.
"""

from __future__ import annotations

import ast
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

from modetune.adapters.nastran.cards import CARDS, station_rows
from modetune.adapters.nastran.deck import NastranDeck
from modetune.adapters.nastran.fields import NastranCard, format_number, read_number
from modetune.adapters.nastran.places import ValuePlace
from modetune.core.errors import ModelError
from modetune.core.expressions import parts, read
from modetune.core.parameters import Parameter

#: Offsets of a PBEAM's neutral axis.
OFFSETS = ("N1", "N2")
#: Characters of a field in large-field cards.
WIDTH = 16


def tied_numbers(
    deck: NastranDeck,
    edited: Mapping[int, NastranCard],
    parameter: Parameter,
    places: Sequence[ValuePlace],
) -> Iterator[tuple[int, ValuePlace, str]]:
    """Yield the numbers that a parameter moves: position among its places, place, and text.

    edited: cards by their first line. Blank ones of a beam's stations follow that of end A. Raises
    ModelError for one that no relation can follow.
    """
    named = {(place.card.lines, place.symbol) for place in places}
    for count, place in enumerate(places):
        card = edited[place.card.lines[0]]
        text = _coefficient(card.text(place.field) or repr(place.value))  # blank: its default
        yield count, place, text
        for symbol, coefficient in _following(card, place, parameter).items():
            if (place.card.lines, symbol) in named:
                continue
            if coefficient != text and not parameter.proportional:
                raise ModelError(
                    f"{deck.where(place.card)}: {card.name} {place.ident} has a blank "
                    f"{symbol} between others, which solver sensitivities to {parameter.name} need "
                    "written out"
                )
            yield count, replace(place, symbol=symbol), coefficient


def _following(card: NastranCard, place: ValuePlace, parameter: Parameter) -> dict[str, str]:
    """Blank numbers of a beam's stations, which follow end A, by their names.

    Nastran fills them in as it reads the card; a design variable of end A alone would leave them.
    Raises ModelError for a blank one between ends of which the parameter scales one.
    """
    name = place.symbol.removesuffix("(A)")
    at_a = card.text(place.field)
    if name == place.symbol or not at_a:
        return {}
    if card.name == "PBEAM" and name in OFFSETS:  # N1(A), N2(A), N1(B), N2(B) are consecutive
        return {} if card.text(place.field + 2) else {f"{name}(B)": _coefficient(at_a)}
    if card.name != "PBEAM":
        return {f"{name}(B)": _coefficient(at_a)}
    offset, rows = place.field - 1, station_rows(card)
    where = {row: read_number(card.text(row + 1) or "1.") for row in rows}
    at_b = next((card.text(row + offset) for row in rows if where[row] == 1.0), "")
    found = {} if at_b else {f"{name}(B)": _coefficient(at_a)}
    a, b = read_number(at_a), read_number(at_b or at_a)
    for station, row in enumerate(rows, start=1):
        if where[row] != 1.0 and not card.text(row + offset):
            if parameter.item and at_b:
                raise ModelError(
                    f"PBEAM {place.ident}: station {station} has a blank {name}, which solver "
                    f"sensitivities to {parameter.name} need written out"
                )
            found[f"{name}({station})"] = format_number(a + (b - a) * where[row], WIDTH)
    return found


def _coefficient(text: str) -> str:
    """Return a number as written in the deck, or as much of it as a large field holds."""
    return text if len(text) <= WIDTH else format_number(read_number(text), WIDTH)


def relation_kind(place: ValuePlace, relation: int) -> str:
    """The card that ties one number of the model to design variables."""
    kinds = {"material": "DVMREL", "property": "DVPREL"}
    return f"{kinds.get(CARDS[place.card.name].owner, 'DVCREL')}{relation}"


def relation_head(number: int, place: ValuePlace) -> tuple[str, str, str, str, str]:
    return str(number), place.card.name, str(place.ident), place.symbol, ""


def large_card(name: str, fields: Sequence[str]) -> list[str]:
    """A card in large field, four fields a line."""
    rows = [fields[start : start + 4] for start in range(0, len(fields), 4)]
    heads = [f"{name}*", *("*" for _ in rows[1:])]
    return [
        f"{head:<8}{''.join(f'{field:>{WIDTH}}' for field in row)}".rstrip()
        for head, row in zip(heads, rows, strict=True)
    ]


OPERATORS: dict[type[ast.operator], str] = {
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**",
}  # fmt: skip
#: Columns of the equation in its first line, and in the others.
FIRST, REST = 56, 64
#: What a line is not broken within: a number, a name, a power, or one other character.
TOKEN = re.compile(r"\d+\.\d*(?:E[+-]?\d+)?|\w+|\*\*|.")


def in_fortran(expression: str, names: Mapping[str, str]) -> str:
    """Return an expression in Nastran's syntax; names: the name of each parameter there."""
    return _text(read(expression), names)


def real(value: float) -> str:
    """A number that Nastran takes for a real one."""
    text = repr(float(value)).upper()
    if "." not in text:
        text = text.replace("E", ".0E") if "E" in text else f"{text}.0"
    return f"({text})" if value < 0.0 else text


def equation_card(number: int, arguments: list[str], text: str) -> list[str]:
    """A DEQATN card."""
    rows = [""]
    for token in TOKEN.findall(f"F({','.join(arguments)})={text}"):
        if len(rows[-1]) + len(token) > (FIRST if len(rows) == 1 else REST):
            rows.append("")
        rows[-1] += token
    heads = [f"{'DEQATN':<8}{number:<8}", *[" " * 8] * (len(rows) - 1)]
    return [f"{head}{row}" for head, row in zip(heads, rows, strict=True)]


def _text(node: ast.expr, names: Mapping[str, str]) -> str:
    given = [_text(part, names) for part in parts(node)]
    match node:
        case ast.BinOp(op=op):
            return f"({given[0]}{OPERATORS[type(op)]}{given[1]})"
        case ast.UnaryOp(op=op):
            return f"(-{given[0]})" if isinstance(op, ast.USub) else given[0]
        case ast.Call(func=ast.Name(id=name)):
            return f"{name.upper()}({','.join(given)})"
        case ast.Name(id=name):
            return real(math.pi) if name == "pi" else names[name]
        case ast.Constant(value=int() | float() as value):
            return real(float(value))
    raise AssertionError(ast.dump(node))
