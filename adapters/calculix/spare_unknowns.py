"""Unknowns beside a small model, without which ccx finds few of its modes or none.

ARPACK as ccx calls it takes five vectors for a mode, and refuses more vectors than unknowns: of a
chain of nine masses ccx finds one mode. So a small model gets masses on springs of their own, tied
to nothing, far above its modes, and all that it has are found. No more are asked for than its
nodes have translations that are free; if ties leave it fewer, modes of spare unknowns follow, and
are taken off again.
"""

from __future__ import annotations

from functools import lru_cache

from modetune.adapters.calculix.constraints import Dof, read_constraints
from modetune.adapters.calculix.model import CalculixModel
from modetune.adapters.cross_checks import SPARE_EIGENVALUE
from modetune.core.errors import ModelError

#: Unknowns that ccx wants for each mode.
FOR_A_MODE = 5
#: Stiffness and mass of a spare unknown.
STIFFNESS, MASS = 1e-8 * SPARE_EIGENVALUE, 1e-8
#: Models with more nodes have unknowns enough.
MOST_NODES = 20_000


def spare_unknowns(model: CalculixModel, n_modes: int) -> list[str]:
    """Lines of a deck for a model that may have too few unknowns for so many modes, else none."""
    wanted, free = FOR_A_MODE * n_modes, _free(model)
    if any("COMPOSITE" in card.options for card in model.sections):
        return []  # ccx 2.20 takes no masses and springs beside composite shells
    if not free or len({node for node, _ in free}) >= wanted:
        return []
    first = max(model.mesh.nodes, default=0) + 1
    element = max(model.mesh.elements, default=0) + 1
    count = -(-wanted // 3)
    place = ", ".join(model.deck.fields(model.deck.named("*NODE")[0].data[0])[1:4])
    spare = range(first, first + count)
    lines = ["*NODE", *(f"{node}, {place}" for node in spare)]
    lines += ["*ELEMENT, TYPE=MASS, ELSET=MODETUNE_SPARE"]
    lines += [f"{element + at}, {node}" for at, node in enumerate(spare)]
    lines += ["*MASS, ELSET=MODETUNE_SPARE", f"{MASS:.1E}"]
    for component in (1, 2, 3):
        name = f"MODETUNE_SPARE{component}"
        numbers = enumerate(spare, element + component * count)
        lines += [f"*ELEMENT, TYPE=SPRING1, ELSET={name}", *(f"{at}, {n}" for at, n in numbers)]
        lines += [f"*SPRING, ELSET={name}", f"{component}", f"{STIFFNESS:.1E}"]
    return lines


@lru_cache(maxsize=4)
def _free(model: CalculixModel) -> frozenset[Dof]:
    """Translations that are not held, dependent or a rigid body's, and those that stand for others.

    Empty for large models, and where ties cannot be read, of which ccx says what is wrong.
    """
    if len(model.mesh.element_nodes) > MOST_NODES:
        return frozenset()
    try:
        ties = read_constraints(model)
    except ModelError:
        return frozenset()
    nodes = model.mesh.element_nodes - set(ties.bodies)
    for body in ties.bodies.values():
        nodes |= {body.reference, body.rotation or -body.reference}
    found = {(node, component) for node in nodes for component in (1, 2, 3)}
    return frozenset(found | ties.terms) - ties.held - set(ties.dependent)


def modes_at_most(model: CalculixModel, n_modes: int) -> int:
    """So many modes, or as many as the model has freedoms for (one sector tells not)."""
    if model.deck.named("*CYCLIC SYMMETRY MODEL"):
        return n_modes
    return min(n_modes, len(_free(model)) or n_modes)
