"""Numbers of decks that parameters move, and why some cannot be moved."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from modetune.core.errors import ModelError
from modetune.core.parameters import Parameter, reached


@dataclass(frozen=True, slots=True)
class Number:
    """A number of a deck that a parameter moves.

    place: identifies it in the deck; where: names the place in messages. along: whether it only
    keeps its ratio to the number before it.
    """

    place: Any
    value: float
    where: str
    along: bool = False


def moved_numbers(
    parameter: Parameter, numbers: Iterable[Number], value: float
) -> list[tuple[Number, float]]:
    """Return numbers of a deck with what they are at a value.

    Raises ModelError where one cannot be so.
    """
    found: list[tuple[Number, float]] = []
    ratio = 1.0
    for number in numbers:
        if number.along:
            found.append((number, number.value * ratio))
            continue
        there = parameter.number(number.value, value)
        refusal = parameter.refusal(there)
        if refusal:
            remedy = "correct the expression" if parameter.expression else "correct its bounds"
            raise ModelError(f"{number.where}: parameter {parameter.name}: {refusal}; {remedy}")
        # A factor is taken as it is: value / number would lose its last digit.
        factor = parameter.shown(value)
        if parameter.values != "relative":
            factor = there / number.value if number.value else 1.0
        ratio = factor
        found.append((number, there))
    return found


def refusals(
    numbers_of: Callable[[Parameter], list[Number]], parameters: tuple[Parameter, ...]
) -> list[str]:
    """Return why parameters cannot move the numbers of a deck, a sentence each; empty if fine."""
    found = []
    owners: dict[Any, str] = {}
    for parameter in parameters:
        try:
            numbers = numbers_of(parameter)
            for number in numbers[:1]:
                what = f"{number.where}: {parameter.quantity}"
                check_moved(parameter, what, (item.value for item in numbers))
            for there in reached(parameter, parameters):
                moved_numbers(parameter, numbers, there)
        except ModelError as error:
            own = f"parameter {parameter.name}: "
            found.append(own + str(error).removeprefix(own))
            continue
        for number in numbers:
            first = owners.setdefault(number.place, parameter.name)
            if first != parameter.name:
                found.append(
                    f"{number.where}: both {first} and {parameter.name} change this number"
                )
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
