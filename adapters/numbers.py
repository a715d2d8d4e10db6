"""Numbers of decks that parameters move, and why some cannot be moved."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from modetune.core.errors import ModelError
from modetune.core.parameters import Parameter


@dataclass(frozen=True, slots=True)
class Number:
    """A number of a deck that a parameter moves.

    place: tells it from all others of the deck; where: says so in a message. along: whether it only
    keeps its ratio to the number before it.
    """

    place: Any
    value: float
    where: str
    along: bool = False


def moved_numbers(
    parameter: Parameter, numbers: Iterable[Number], value: float
) -> list[tuple[Number, float]]:
    """Numbers of a deck with what they are at a value. Raises ModelError where one cannot be so."""
    found: list[tuple[Number, float]] = []
    ratio = 1.0
    for number in numbers:
        if number.along:
            found.append((number, number.value * ratio))
            continue
        there = parameter.number(number.value, value)
        refusal = parameter.refusal(there)
        if refusal:
            remedy = "mend the expression" if parameter.expression else "mend its bounds"
            raise ModelError(f"{number.where}: parameter {parameter.name}: {refusal}; {remedy}")
        # A factor is taken as it is: value / number would lose its last digit.
        factor = parameter.shown(value)
        if parameter.values != "relative":
            factor = there / number.value if number.value else 1.0
        ratio = factor
        found.append((number, there))
    return found


#: How a number that is zero can be updated.
FROM_ZERO = "give the parameter `values: absolute` or `additive`, with bounds and a deviation"


def check_moved(parameter: Parameter, what: str, values: Iterable[float]) -> None:
    """Refuse factors on what is all zero; what: its place and name. Raises ModelError."""
    found = list(values)
    if found and parameter.values == "relative" and not any(found):
        raise ModelError(f"{what} is zero, which no factor changes; {FROM_ZERO}")


def check_one(parameter: Parameter, where: str, items: Iterable[int]) -> None:
    """Refuse an absolute or additive parameter of several numbers, by their items.

    Raises ModelError.
    """
    several = sorted({item for item in items if item > 0})
    if parameter.values != "relative" and len(several) > 1:
        raise ModelError(
            f"{where} has several numbers of {parameter.quantity}: give the {parameter.values} "
            f"parameter an item of {', '.join(map(str, several))}"
        )
