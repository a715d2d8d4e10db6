"""The design variables of a SOL 200 deck as parameters of a campaign.

A variable that gives one number as it is becomes an absolute parameter of that quantity. Others
become variables, and each number that they give a parameter with an expression. What parameters
cannot represent is listed with its reason.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from modetune.adapters.solver import DesignRelation, DesignVariable, Solver
from modetune.core.errors import ModelError
from modetune.core.expressions import names_of
from modetune.core.parameters import Parameter

#: Limits further than this factor from the initial value only keep an optimiser from zero.
FAR = 1e3
#: Limits of a variable that starts at zero, from which its size follows, are less than this.
UNLIMITED = 1e6
#: Factor of the bounds that replace such limits.
NEAR = 10.0
#: Prior standard deviation of a variable, relative to its initial value.
DEVIATION = 0.1
#: Half the width of the bounds, relative to the initial value, that are tried where the model is
#: impossible within the deck's limits; None: the deck's.
REACHES = (None, 0.5, 0.1)


@dataclass(frozen=True, slots=True)
class DesignParameter:
    """A parameter that represents a variable or a relation. note: what the user should know."""

    variable: DesignVariable | None
    relation: DesignRelation | None
    bounds: tuple[float, float] = (0.0, 0.0)
    deviation: float = 0.0
    note: str = ""

    @property
    def name(self) -> str:
        if self.variable is not None:
            return self.variable.name
        assert self.relation is not None
        return self.relation.name


@dataclass(frozen=True, slots=True)
class DesignDraft:
    """The parameters of a design model, and a sentence for each card that they do not represent."""

    parameters: tuple[DesignParameter, ...] = ()
    refused: tuple[str, ...] = ()


def design_parameters(solver: Solver, reach: float | None) -> DesignDraft:
    """Return the parameters of a deck's own design model, empty where it has none.

    reach: of the bounds, relative to the initial values; None: the deck's own limits.
    """
    design = solver.deck.design()
    refused = list(design.refused)
    relations: list[DesignRelation] = []
    for item in design.relations:
        problems = _problems(solver, item)
        if any((item.quantity, item.targets, item.item) == (
            other.quantity, other.targets, other.item) for other in relations):  # fmt: skip
            problems = ["another relation gives the same number"]
        refused += [f"{item.where}: {item.name}: {problem}" for problem in problems]
        relations += [] if problems else [item]
    uses = Counter(name for item in relations for name in names_of(item.expression))
    direct = {item.expression: item for item in relations if uses[item.expression] == 1}
    found = []
    for variable in design.variables:
        if not uses[variable.name]:
            refused.append(f"{variable.where}: DESVAR {variable.name}: its relations are left out")
            continue
        bounds, note = _bounds(variable, reach)
        deviation = DEVIATION * (abs(variable.initial) or (bounds[1] - bounds[0]))
        texts = "; ".join(filter(None, (variable.note, note)))
        found.append(DesignParameter(variable, direct.get(variable.name), bounds, deviation, texts))
    found += [DesignParameter(None, item) for item in relations if item.expression not in direct]
    return DesignDraft(tuple(found), tuple(refused))


def _problems(solver: Solver, item: DesignRelation) -> list[str]:
    """Return why the deck refuses a relation's quantity; empty if it does not."""
    parameter = Parameter(
        item.name, item.quantity, item.by, item.targets, 0.5, 2.0, DEVIATION, item=item.item,
        values="absolute",
    )  # fmt: skip
    try:
        solver.deck.numbers(parameter)
    except ModelError as error:
        return [str(error)]
    return list(solver.deck.problems((parameter,)))


def _bounds(variable: DesignVariable, reach: float | None) -> tuple[tuple[float, float], str]:
    """Return the bounds of a variable, and why they are not the deck's limits."""
    start, lower, upper = variable.initial, variable.lower, variable.upper
    limits = f"the deck's limits are {lower:g} and {upper:g}"
    size = abs(start)
    if not size:
        share = 1.0 if reach is None else reach
        if max(abs(lower), abs(upper)) < UNLIMITED:
            why = f"{limits}, where the model is impossible" if reach else ""
            return (share * lower, share * upper), why
        return (-share, share), f"PLEASE CHECK the bounds: {limits}, and it starts at 0"
    if reach is not None:
        own = max(lower, start - reach * size), min(upper, start + reach * size)
        return own, f"{limits}, where the model is impossible"
    low, high = sorted((start / NEAR, start * NEAR))
    far_low = lower < start - FAR * size or (start > 0.0 and abs(lower) < size / FAR)
    far_high = upper > start + FAR * size or (start < 0.0 and abs(upper) < size / FAR)
    bounds = (low if far_low else lower, high if far_high else upper)
    return bounds, limits if far_low or far_high else ""
