"""Responses that need a model's matrices, on a reduced model that contains a change.

They are response functions, damping ratios and complex shapes. Dampers keep the values of the
examined state, whatever the parameters. Response functions need, as in `core/updating/frf_modes`,
the static responses to forces at their sensors, and the motion that dampers cause.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy import sparse

from modetune.adapters.solver import Deck
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModelError
from modetune.core.modes import Floats, Integers
from modetune.core.updating.candidates import DampedModel
from modetune.core.updating.damped_pairs import DampedPairs
from modetune.core.updating.damping_model import Damper, DampingModel, Linear
from modetune.core.updating.responses.complex_shapes import ComplexShapes
from modetune.core.updating.responses.damping import DampingRatios
from modetune.core.updating.responses.frf import Frf, KnownFrfModes
from modetune.core.updating.responses.response import MatricesAt, Response
from modetune.flows.responses.response import SensorObserver

#: Nodes and components of a model's rows.
Rows = tuple[Integers, Integers]
#: Returns degrees of freedom in terms of the equations of matrices, (n_dofs, n_equations).
Observe = Callable[[MatrixResult], sparse.csr_array]
#: The numbers of a damper that stays as it is.
ONE = (Linear(1.0),)


def answers(item: Response) -> bool:
    """Return whether a reduced model answers for a response that needs matrices."""
    return isinstance(item, Frf | DampingRatios | ComplexShapes)


def seen_nodes(compared: Sequence[Response]) -> tuple[Integers, Integers]:
    """Return nodes whose motion these responses see, and those whose rotations they see."""
    seen = [item.observe.seen.seen_components() for item in compared
            if isinstance(item, Frf | ComplexShapes) and isinstance(item.observe, SensorObserver)
            ]  # fmt: skip
    nodes = np.concatenate([np.zeros(0, dtype=np.int64), *(of[0] for of in seen)])
    components = np.concatenate([np.zeros(0, dtype=np.int64), *(of[1] for of in seen)])
    return nodes, nodes[components > 3]


def damps(item: Response) -> bool:
    """Return whether the dampers of the model count in a response."""
    return "losses" in item.needs


def damping_at(deck: Deck, at: MatricesAt) -> tuple[sparse.csr_array, ...]:
    """Return the viscous and the structural matrix (n, n) of a deck at a state.

    Raises ModelError where the deck has losses and the stiffness of their groups is not given.
    """
    model = deck.damping(at.model.base)
    if model.losses and at.groups is None:
        raise ModelError("the stiffness of parts with loss factors is not known without supports")
    system = model.system(at.model, at.theta, at.groups)
    return system.viscous, system.structural


def kept_loads(
    compared: Sequence[Response],
    rows: Rows,
    observer: sparse.csr_array,
    dampers: Sequence[sparse.csr_array],
    shapes: Floats,
) -> sparse.csr_array:
    """Return forces (n, n_kept) whose static responses a reduced model contains.

    observer: (n_rows, n), of the rows; shapes: (n, n_modes), the modes that move the dampers.
    """
    found = [sparse.csr_array((observer.shape[1], 0))]
    for item in compared:
        if isinstance(item, Frf) and isinstance(item.observe, SensorObserver):
            used = np.unique([(curve.output, curve.force) for curve in item.curves])
            seen = item.observe.seen.matrix(*rows)[used]
            found.append(sparse.csr_array((seen @ observer).T))
    found += [sparse.csr_array(matrix @ shapes) for matrix in dampers]
    return sparse.csr_array(sparse.hstack(found))


def on_reduced(
    compared: Sequence[Response], model: DampedModel, rows: Rows
) -> tuple[Response, ...]:
    """Return the responses of a reduced model whose rows are these."""

    def dampers(here: MatrixResult) -> DampingModel:
        viscous, structural = map(sparse.csr_array, model.dampers)
        of = Damper("viscous", viscous, ONE), Damper("structural", structural, ONE)
        return DampingModel(of)

    def observer(given: Observe) -> Observe:
        if not isinstance(given, SensorObserver):
            return given
        moved = sparse.csr_array(given.seen.matrix(*rows) @ model.rows)
        return lambda here: moved

    def changed(item: Response) -> Response:
        match item:
            case Frf():
                own = dampers if item.dampers else None
                seen = observer(item.observe)
                return replace(item, observe=seen, dampers=own, _known=KnownFrfModes())
            case ComplexShapes():
                seen = observer(item.observe)
                return replace(item, observe=seen, pairs=DampedPairs(dampers))
            case DampingRatios():
                return replace(item, pairs=DampedPairs(dampers))
            case _:
                return item

    return tuple(map(changed, compared))
