"""The residual of an updating problem: how the test differs from the model, and its derivative.

Each kind of response (`core/updating/responses`) gives its rows; here they are put together, and
e1 asked of all of them. Weights are reciprocals of measurement variances times the campaign's
emphasis (thesis (40)).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modetune.core.modes import Floats
from modetune.core.updating.responses.response import (
    ModelState,
    Residual,
    Response,
    StateDerivatives,
    block_parts,
    stacked,
)


def residual(responses: Sequence[Response], state: ModelState) -> Residual:
    """The residual of a model state by these responses, in their order. Raises ModesError."""
    return stacked([[item.residual(state) for item in responses]])


def residual_sensitivity(
    responses: Sequence[Response], state: ModelState, derivatives: StateDerivatives
) -> Floats:
    """Derivative of the computed side of the residual, (n_residuals, n_columns)."""
    found = [item.sensitivity(state, derivatives) for item in responses]
    return np.concatenate([np.zeros((0, len(derivatives.columns))), *found])


def responses_agree(responses: Sequence[Response], found: Residual) -> bool:
    """Whether e1 holds for these responses; found: with a block of each, or of others too."""
    by_kind = {item.kind: item for item in responses}
    return all(
        by_kind[part.blocks[0].kind].agrees(part)
        for part in block_parts(found)
        if part.blocks[0].kind in by_kind
    )
