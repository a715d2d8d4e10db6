"""The load cases of a CalculiX deck: the concentrated forces of its *STATIC steps.

A case has the number of its step among the static ones. Loads go on from step to step until
OP=NEW; within one step those of a degree of freedom add up, and the first one there takes the
place of an earlier step's (seen in reactions of ccx 2.20).
"""

from __future__ import annotations

from collections.abc import Iterator

from modetune.adapters.calculix.constraints import node_sets, read_constraints, set_members
from modetune.adapters.calculix.deck import KeywordCard
from modetune.adapters.calculix.model import CalculixModel
from modetune.core.errors import ModelError
from modetune.core.updating.static import LoadCase

#: What a load case cannot have here: other loads and supports than the matrices' own.
OTHER_LOADS = (
    "*BOUNDARY", "*DLOAD", "*DSLOAD", "*TEMPERATURE", "*CFLUX", "*DFLUX", "*FILM", "*RADIATE",
    "*MODEL CHANGE", "*CHANGE FRICTION",
)  # fmt: skip


def load_case(model: CalculixModel, number: int) -> LoadCase:
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
    turned = read_constraints(model).turned
    wanted = static[number - 1]
    for step in steps[: steps.index(wanted) + 1]:
        named = set[tuple[int, int]]()
        for card in step:
            _refuse(model, card, step is wanted)
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
                    before = forces[dof][0] if dof in named else 0.0
                    forces[dof] = before + value, where
                    named.add(dof)
    if not forces:
        raise ModelError(f"{deck.where(wanted[0])}: the step of load case {number} has no *CLOAD")
    return LoadCase.of_forces([(*dof, value, at) for dof, (value, at) in sorted(forces.items())])


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
    if card.is_one_of(*OTHER_LOADS):
        raise ModelError(
            f"{where}: {card.keyword} in a step; load cases here are concentrated forces "
            "(*CLOAD) on a model whose supports stand above all steps"
        )
    nonlinear = "NLGEOM" in card.options and card.option("NLGEOM") != "NO"
    if card.is_one_of("*STEP") and wanted and nonlinear:
        raise ModelError(f"{where}: a load case with NLGEOM is not linear")
    if card.is_one_of("*CLOAD") and set(card.options) - {"OP"}:
        more = ", ".join(sorted(set(card.options) - {"OP"}))
        raise ModelError(f"{where}: *CLOAD with {more} is not supported")
