"""The load cases of a CalculiX deck: concentrated and distributed loads of its *STATIC steps.

A case has the number of its step among the static ones. Loads go on from step to step until
OP=NEW; within one step those of a degree of freedom add up, and the first one there takes the
place of an earlier step's (seen in reactions of ccx 2.20). A distributed load that stands twice on
one element is refused.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from modetune.adapters.calculix.constraints import node_sets, read_constraints, set_members
from modetune.adapters.calculix.deck import KeywordCard
from modetune.adapters.calculix.element_loads import ON_MASS, SUPPORTED, SpreadLoad, spread_forces
from modetune.adapters.calculix.model import CalculixModel
from modetune.core.errors import ModelError
from modetune.core.mesh import Mesh
from modetune.core.updating.static import LoadCase

#: What a load case cannot have here: other loads and supports than the matrices' own.
OTHER_LOADS = (
    "*DSLOAD", "*TEMPERATURE", "*CFLUX", "*DFLUX", "*FILM", "*RADIATE", "*MODEL CHANGE",
    "*CHANGE FRICTION",
)  # fmt: skip


def load_case(model: CalculixModel, mesh: Mesh, number: int) -> LoadCase:
    """The forces of a static step. Raises ModelError where the deck has none, or other loads."""
    deck = model.deck
    steps = list(_steps(model))
    static = [step for step in steps if any(card.is_one_of("*STATIC") for card in step)]
    if not 0 < number <= len(static):
        at = ", ".join(deck.where(step[0]) for step in static)
        has = (
            f"{len(static)} *STATIC step{'s' * (len(static) > 1)} ({at})"
            if static
            else "no *STATIC step"
        )
        raise ModelError(f"{deck.file}: the deck has no load case {number}; it has {has}")
    if model.preload():
        raise ModelError(
            f"{model.preload()}: the stiffness depends on a state, and static displacements are "
            "of the linear model: take it out of the deck"
        )
    sets, forces = node_sets(model), dict[tuple[int, int], tuple[float, str]]()
    spread: list[SpreadLoad] = []
    turned = read_constraints(model).turned
    wanted = static[number - 1]
    for step in steps[: steps.index(wanted) + 1]:
        named, before = set[tuple[int, int]](), spread
        for card in step:
            _refuse(model, card, step is wanted)
            if card.is_one_of("*DLOAD"):
                if card.option("OP") == "NEW" and spread is before:
                    spread = []
                spread = [*spread, *(_spread(model, line) for line in card.data)]
            if not card.is_one_of("*CLOAD"):
                continue
            if card.option("OP") == "NEW" and not named:
                forces.clear()
            for position in card.data:
                fields, where = [*deck.fields(position), "", ""], deck.lines[position].where
                members = set_members(fields[0], sets)
                if not members or not members <= model.mesh.nodes or fields[1] not in "123456":
                    raise ModelError(f"{where}: *CLOAD needs a node or set, 1 to 6, and a force")
                if members & turned:
                    raise ModelError(f"{where}: *CLOAD at a node of *TRANSFORM is not supported")
                value = model.number(position, 2)
                for node in members:
                    dof = node, int(fields[1])
                    there = forces[dof][0] if dof in named else 0.0
                    forces[dof] = there + value, where
                    named.add(dof)
    if not forces and not spread:
        raise ModelError(
            f"{deck.where(wanted[0])}: the step of load case {number} has neither *CLOAD nor *DLOAD"
        )
    _refuse_twice(spread)
    found = [(*dof, value, at) for dof, (value, at) in sorted(forces.items())]
    by_mass = any(load.label in ON_MASS for load in spread)
    return LoadCase.of_forces(found, spread_forces(model, mesh, spread), by_mass)


def _spread(model: CalculixModel, line: int) -> SpreadLoad:
    """A line of *DLOAD. Raises ModelError."""
    name, label = [*model.deck.fields(line), ""][:2]
    where, label = model.deck.lines[line].where, label.upper().replace(" ", "")
    elements = model.mesh.named(name) if name else frozenset[int]()
    pressure = label == "P" or (label[:1] == "P" and label[1:] in tuple("123456"))
    if not elements or not (label in ON_MASS or pressure):
        raise ModelError(
            f"{where}: *DLOAD needs an element or set of the deck, and a load; supported are "
            f"{SUPPORTED}"
        )
    numbers = [model.number(line, 2 + place) for place in range(ON_MASS.get(label, 1))]
    if label in ON_MASS and not math.hypot(*numbers[-3:]):
        raise ModelError(f"{where}: {label} has no direction: its last three numbers are zero")
    return SpreadLoad(elements, label, tuple(numbers), where)


def _refuse_twice(spread: list[SpreadLoad]) -> None:
    """Raise ModelError where a load stands twice on an element: ccx takes one of them."""
    seen: dict[tuple[str, int], str] = {}
    for load in spread:
        for number in load.elements:
            if (load.label, number) in seen:
                raise ModelError(
                    f"{load.where}: {load.label} on element {number} stands there already "
                    f"({seen[load.label, number]}); give it once, with OP=NEW in a later step"
                )
            seen[load.label, number] = load.where


def _steps(model: CalculixModel) -> Iterator[list[KeywordCard]]:
    step: list[KeywordCard] = []
    for card in model.deck.cards:
        if card.is_one_of("*STEP"):
            step = [card]
        elif step:
            step.append(card)
            if card.is_one_of("*END STEP"):
                yield step
                step = []


def _refuse(model: CalculixModel, card: KeywordCard, wanted: bool) -> None:
    """Raise ModelError for what makes a case other than forces on the linear model.

    wanted: whether the card is in the case's own step; supports of all steps before count too.
    """
    where = model.deck.where(card)
    if card.is_one_of("*BOUNDARY"):
        raise ModelError(
            f"{where}: *BOUNDARY in a step; supports must stand above all steps, and enforced "
            "displacements are not supported, since stored matrices have no equations there: "
            "load the structure by forces"
        )
    if card.is_one_of(*OTHER_LOADS):
        raise ModelError(
            f"{where}: {card.keyword} in a step; load cases here are *CLOAD and *DLOAD "
            f"({SUPPORTED})"
        )
    nonlinear = "NLGEOM" in card.options and card.option("NLGEOM") != "NO"
    if card.is_one_of("*STEP") and wanted and nonlinear:
        raise ModelError(f"{where}: a load case with NLGEOM is not linear")
    if card.is_one_of("*CLOAD", "*DLOAD") and set(card.options) - {"OP"}:
        more = ", ".join(sorted(set(card.options) - {"OP"}))
        raise ModelError(f"{where}: {card.keyword} with {more} is not supported")
