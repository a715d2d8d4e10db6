"""Masses and springs added to a CalculiX deck, before its first step."""

from __future__ import annotations

import numpy as np

from modetune.adapters.calculix.structure import CalculixStructure
from modetune.adapters.deck_files import text_with
from modetune.adapters.solver import AddedCards, Addition
from modetune.core.errors import ModelError
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats
from modetune.core.parameters import Quantity, TargetKind

#: What names of added sets begin with.
NAME = "MODETUNE_ADDED"
ELSET: TargetKind = "elset"


def with_addition(structure: CalculixStructure, mesh: Mesh, addition: Addition) -> AddedCards:
    """Return the main file with an addition. Raises ModelError."""
    deck = structure.deck
    if addition.component > 3:
        raise ModelError(f"{deck.file}: CalculiX has no springs against rotations of nodes")
    steps = deck.named("*STEP")
    if not steps:
        raise ModelError(f"{deck.file}: the deck has no *STEP, before which cards would be added")
    line = deck.lines[steps[0].lines.start]
    if line.file != deck.file:
        raise ModelError(
            f"{line.where}: the first *STEP is in an include, and cards are added to the main file "
            "alone"
        )
    names = {card.option("ELSET") for card in deck.cards}
    number = next(n for n in range(1, len(names) + 2) if not _taken(names, n))
    element = max(structure.mesh.elements, default=0) + 1
    lines, parts = ["** added by modetune localise"], list[tuple[Quantity, str, float]]()
    nodes = addition.nodes
    if addition.kind == "absorber":
        own = max(structure.summary.node_ids) + 1
        x, y, z = _place(mesh, nodes[0])
        others = [axis for axis in (1, 2, 3) if axis != addition.component]
        lines += ["*NODE", f"{own}, {x:.9g}, {y:.9g}, {z:.9g}"]
        lines += ["*BOUNDARY", *(f"{own}, {axis}, {axis}" for axis in others)]
        nodes = (nodes[0], own)
    if addition.kind != "spring":
        name = f"{NAME}_{number}_MASS"
        held = nodes if addition.kind == "mass" else nodes[1:]
        lines.append(f"*ELEMENT, TYPE=MASS, ELSET={name}")
        lines += [f"{element + place}, {node}" for place, node in enumerate(held)]
        lines += [f"*MASS, ELSET={name}", f"{addition.values[0]:.9g}"]
        parts.append(("mass", name, addition.values[0]))
        element += len(held)
    if addition.kind != "mass":
        name, axis = f"{NAME}_{number}_SPRING", str(addition.component)
        lines.append(f"*ELEMENT, TYPE=SPRING{len(nodes)}, ELSET={name}")
        lines.append(", ".join(map(str, (element, *nodes))))
        lines += [f"*SPRING, ELSET={name}", ", ".join([axis] * len(nodes))]
        lines.append(f"{addition.values[-1]:.9g}")
        parts.append(("spring_stiffness", name, addition.values[-1]))
    text = text_with(deck.file, line.number, lines)
    numbers = [(quantity, ELSET, (name,), value) for quantity, name, value in parts]
    return AddedCards(text, tuple(lines), tuple(numbers))


def _taken(names: set[str], number: int) -> bool:
    return any(name.startswith(f"{NAME}_{number}_") for name in names)


def _place(mesh: Mesh, node: int) -> Floats:
    return np.asarray(mesh.coordinates[mesh.rows(np.array([node]))[0]])
