"""The design variables of a SOL 200 deck, as values and expressions of them.

A DESVAR is a value x_i. DVPREL1, DVMREL1 and DVCREL1 give a number of a property, a material or an
element as p = C0 + sum c_i x_i, the cards with a 2 in their names by an equation (DEQATN) of x_i
and constants (DTABLE). DLINK gives one variable as C0 + CMULT sum c_i x_i of others. These numbers
replace those of the analysis model. (MSC and Simcenter Nastran, Quick Reference Guides.)
"""

from __future__ import annotations

import keyword
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

from modetune.adapters.nastran.cards import CARDS, fields_of
from modetune.adapters.nastran.deck import NastranDeck
from modetune.adapters.nastran.fields import NastranCard, read_number
from modetune.adapters.nastran.structure import Structure
from modetune.adapters.solver import DesignModel, DesignRelation, DesignVariable
from modetune.core.errors import ModelError
from modetune.core.expressions import FUNCTIONS, names_of
from modetune.core.parameters import Quantity, TargetKind

#: Cards of relations, and what they call their owner: linear ones, and those by an equation.
LINEAR: dict[str, TargetKind] = {
    "DVPREL1": "property", "DVMREL1": "material", "DVCREL1": "element",
}  # fmt: skip
BY_EQUATION: dict[str, TargetKind] = {
    "DVPREL2": "property", "DVMREL2": "material", "DVCREL2": "element",
}  # fmt: skip
#: Design cards that no parameter represents, and why.
OTHERS = {
    "DVGRID": "it moves grid points", "DVSHAP": "it moves grid points",
    "DVBSHAP": "it moves grid points", "TOPVAR": "it is a variable of topology optimisation",
    "DVTREL1": "it is a variable of topology optimisation", "DVSET": "sets are not read",
}  # fmt: skip
#: Nastran's default limits of a variable.
UNLIMITED = 1e20
#: Columns of a line of an equation.
LAST = 72
EQUATION = re.compile(r"DEQATN\*?[\s,]*(\d+)[\s,]*(.*)", re.IGNORECASE | re.DOTALL)
STATEMENT = re.compile(r"\s*(\w+)\s*(?:\(([^()]*)\))?\s*=(.*)", re.DOTALL)
#: A number of Fortran, or a name.
NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[ED][+-]?\d+)?"
TOKEN = re.compile(rf"(?P<number>{NUMBER})|(?P<name>[A-Z_]\w*)(?P<call>\s*\()?", re.IGNORECASE)


@dataclass(frozen=True)
class Variables:
    """The names of variables by number, and expressions of those that DLINK cards give."""

    names: Mapping[int, str]
    linked: dict[int, str] = field(default_factory=dict)

    def text(self, number: int) -> str:
        """A variable in an expression. Raises ModelError."""
        if number in self.linked:
            return f"({self.linked[number]})"
        if number not in self.names:
            raise ModelError(f"DESVAR {number} is not there")
        return self.names[number]


def read_design(structure: Structure) -> DesignModel:
    """Return the design model of a deck, with a sentence for each card that it cannot hold."""
    deck = structure.deck
    refused = [
        f"{deck.where(card)}: {card.name} {card.text(1)}: {why}"
        for name, why in OTHERS.items()
        for card in deck.named(name)
    ]

    def read_each(names: Sequence[str], read: Callable[[NastranCard], None]) -> None:
        for card in deck.named(*names):
            try:
                read(card)
            except (ModelError, ValueError) as error:
                refused.append(f"{deck.where(card)}: {card.name} {card.text(1)}: {error}")

    found: dict[int, DesignVariable] = {}
    variables = Variables({})
    taken: set[str] = set()

    def variable(card: NastranCard) -> None:
        number, label = int(card.text(1)), _label(card, taken)
        discrete = f"discrete values by DDVAL {card.text(7)} are not kept" if card.text(7) else ""
        found[number] = DesignVariable(
            label,
            _number(card, 3, 0.0),
            _number(card, 4, -UNLIMITED),
            _number(card, 5, UNLIMITED),
            deck.where(card),
            discrete,
        )

    read_each(["DESVAR"], variable)
    variables = Variables({number: item.name for number, item in found.items()})

    def link(card: NastranCard) -> None:
        number = int(card.text(2))
        factor = _number(card, 4, 1.0)
        terms = [(n, factor * c) for n, c in _terms(card, 5)]
        variables.linked[number] = _sum(_number(card, 3, 0.0), terms, variables)

    read_each(["DLINK"], link)
    relations: list[DesignRelation] = []

    def linear(card: NastranCard) -> None:
        text = _sum(_number(card, 7, 0.0), list(_terms(card, 9)), variables)
        relations.append(_relation(structure, card, LINEAR[card.name], text))

    def by_equation(card: NastranCard) -> None:
        text = equation_text(deck, int(card.text(7)), _arguments(deck, card, variables))
        relations.append(_relation(structure, card, BY_EQUATION[card.name], text))

    read_each(list(LINEAR), linear)
    read_each(list(BY_EQUATION), by_equation)
    used = {name for item in relations for name in names_of(item.expression)}
    for number, item in found.items():
        if number not in variables.linked and item.name not in used:
            refused.append(f"{item.where}: DESVAR {number}: no relation that is read here uses it")
    free = tuple(item for item in found.values() if item.name in used)
    return DesignModel(free, tuple(relations), tuple(refused))


def _label(card: NastranCard, taken: set[str]) -> str:
    """Return a variable's label as a name in expressions, unique also without regard to case."""
    written = card.fields[2].text if len(card.fields) > 2 and card.fields[2] else ""
    name = re.sub(r"\W+", "_", written) or f"x_{card.text(1)}"
    if name[0].isdigit() or keyword.iskeyword(name) or name.lower() in (*FUNCTIONS, "pi"):
        name = f"x_{name}"
    if name.lower() in taken:
        name = f"{name}_{card.text(1)}"
    taken.add(name.lower())
    return name


def _number(card: NastranCard, place: int, blank: float) -> float:
    return read_number(card.text(place)) if card.text(place) else blank


def _terms(card: NastranCard, start: int) -> Iterator[tuple[int, float]]:
    """Yield pairs of a variable and its coefficient."""
    for place in range(start, len(card.fields), 2):
        if card.text(place) == "PVAL":
            raise ModelError("the coefficient PVAL is not read")
        if card.text(place):
            yield int(card.text(place)), _number(card, place + 1, 1.0)


def _sum(constant: float, terms: Sequence[tuple[int, float]], variables: Variables) -> str:
    """Return C0 + sum c_i x_i as an expression."""
    if not terms:
        raise ModelError("it names no variable")
    texts = [repr(constant)] if constant else []
    for number, coefficient in terms:
        name = variables.text(number)
        texts.append(name if coefficient == 1.0 else f"{coefficient!r}*{name}")
    return " + ".join(texts)


def _relation(
    structure: Structure, card: NastranCard, by: TargetKind, expression: str
) -> DesignRelation:
    """Return the quantity that a relation gives. Raises ModelError where no parameter has it."""
    kind, ident, symbol = card.text(2), int(card.text(3)), card.text(4)
    owner = _owner(structure, by, kind, ident)
    for quantity in CARDS[kind].numbers:
        try:
            fields = fields_of(structure.deck, quantity, owner, ident)
        except ModelError:
            continue
        for item, place, name in fields:
            if symbol not in (name, str(_field_number(place))) or item < 0:
                continue
            along = [name for other, at, name in fields if other < 0 and owner.text(at)]
            if along:
                raise ModelError(
                    f"{', '.join(along)} of {kind} {ident} would keep its value, and a parameter "
                    f"changes it along with {symbol}; leave {', '.join(along)} blank"
                )
            picked = item if sum(other >= 0 for other, _, _ in fields) > 1 else 0
            return DesignRelation(
                _relation_name(quantity, kind, ident, picked), quantity, by, (str(ident),), picked,
                expression, structure.deck.where(card),
            )  # fmt: skip
    raise ModelError(f"no quantity of a parameter is {symbol or 'a blank field'} of {kind}")


def _owner(structure: Structure, by: TargetKind, kind: str, ident: int) -> NastranCard:
    """Return the card that holds the number. Raises ModelError."""
    owners = structure.owners
    families = {
        "property": (owners.properties,),
        "material": (owners.materials,),
        "element": (owners.elements, owners.masses),
    }[by]
    cards = [card for family in families for card in family.get(ident, ()) if card.name == kind]
    if not cards:
        raise ModelError(f"{kind} {ident} is not there")
    if kind not in CARDS:
        raise ModelError(f"parameters change no number of {kind}")
    return cards[0]


def _field_number(place: int) -> int:
    """The number of a field as relations count it: ten a line, names and tags among them."""
    return place + 1 + 2 * ((place - 1) // 8)


def _relation_name(quantity: Quantity, kind: str, ident: int, item: int) -> str:
    return f"{quantity}_{kind}_{ident}{f'_{item}' if item else ''}"


def _arguments(deck: NastranDeck, card: NastranCard, variables: Variables) -> list[str]:
    """Return the arguments of a relation's equation, variables then constants."""
    table = _table(deck)
    found: list[str] = []
    mode = ""
    for place in range(9, len(card.fields)):
        text = card.text(place)
        if not text:
            continue
        if not text.isdecimal() and (place - 9) % 8 == 0:
            mode = text
        elif mode == "DESVAR":
            found.append(variables.text(int(text)))
        elif mode == "DTABLE":
            if text not in table:
                raise ModelError(f"DTABLE has no constant {text}")
            found.append(f"({table[text]!r})")
        else:
            raise ModelError(f"arguments of the kind {mode or text} are not read")
    return found


def _table(deck: NastranDeck) -> dict[str, float]:
    """Return the constants of DTABLE cards by label."""
    found: dict[str, float] = {}
    for card in deck.named("DTABLE"):
        for place in range(1, len(card.fields), 2):
            if card.text(place) and card.text(place + 1):
                found[card.text(place)] = read_number(card.text(place + 1))
    return found


def equation_text(deck: NastranDeck, number: int, arguments: Sequence[str]) -> str:
    """Return a DEQATN at these arguments as an expression. Raises ModelError."""
    for card in deck.named("DEQATN"):
        lines = [deck.lines[line].text.partition("$")[0][:LAST] for line in card.lines]
        whole = " ".join([lines[0], *(line[8:] for line in lines[1:])])
        matched = EQUATION.match(whole)
        if matched and int(matched[1]) == number:
            return _evaluated(number, matched[2], arguments)
    raise ModelError(f"DEQATN {number} is not there")


def _evaluated(number: int, text: str, arguments: Sequence[str]) -> str:
    """The last statement of an equation with all names replaced. Raises ModelError."""
    values: dict[str, str] = {}
    last = ""
    for count, part in enumerate(item for item in text.split(";") if item.strip()):
        statement = STATEMENT.fullmatch(part)
        if statement is None or (count == 0) != (statement[2] is not None):
            raise ModelError(f"DEQATN {number} has no statement in {part.strip()[:40]!r}")
        if count == 0:
            names = [name.strip().upper() for name in statement[2].split(",")]
            if len(names) != len(arguments):
                raise ModelError(
                    f"DEQATN {number} has {len(names)} arguments, the relation {len(arguments)}"
                )
            values = dict(zip(names, arguments, strict=True))
        translated = partial(_translated, values)
        last = re.sub(r"\s+", "", TOKEN.sub(translated, statement[3]))
        values[statement[1].upper()] = f"({last})"
    names_of(last)  # raises where it is not arithmetic
    return last


def _translated(values: Mapping[str, str], token: re.Match[str]) -> str:
    """A number, a function or a name of Fortran in an expression."""
    if token["number"]:
        return token["number"].upper().replace("D", "E")
    name = token["name"].upper()
    if token["call"]:
        return "pi*(" if name == "PI" else f"{name.lower()}("
    if name not in values:
        raise ModelError(f"{name} is no argument of the equation")
    return values[name]
