"""How much the test sees of a parameter, in its own standard deviations.

A parameter moves each response by so much over its bounds (`Indices.moves`; the slope at the
deck's values times the width of the bounds where there is no design). Divided by the standard
deviation that the campaign gives the measured response, this says how many standard deviations
the test sees; all responses that the residual compares, of every kind, count together as root of
the sum of squares. A shape that changes by the relative size d has a MAC of 1 - d^2 with what it
was, so a MAC that moves by m counts as a shape that moves by the root of m.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modetune.core.modes import Floats
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.studies.screen.design import Design
from modetune.flows.studies.screen.indices import Indices
from modetune.flows.studies.screen.record import LocalSensitivity


def importance(
    campaign: Campaign, design: Design, local: LocalSensitivity, found: Indices | None
) -> Floats:
    """Standard deviations of the test that each parameter moves the responses by, (n,)."""
    return np.asarray(np.linalg.norm(seen_moves(campaign, design, local, found), axis=0))


def loudest(
    campaign: Campaign,
    modes: Sequence[str],
    others: Sequence[str],
    design: Design,
    local: LocalSensitivity,
    found: Indices | None,
) -> tuple[str, ...]:
    """The response that each parameter moves most, for people; modes: names of the paired ones;
    others: of what is compared beside frequencies and shapes."""
    moves = seen_moves(campaign, design, local, found)
    names = [f"{what} of {name}" for what in ("frequency", "MAC") for name in modes]
    names[len(moves) - len(others) :] = others
    return tuple(names[row] for row in moves.argmax(axis=0).tolist())


def seen_moves(
    campaign: Campaign, design: Design, local: LocalSensitivity, found: Indices | None
) -> Floats:
    """The same of each response, (n_responses, n_parameters); zero where it is not compared."""
    weighting, n = campaign.weighting, local.frequencies.shape[0]
    if found is None:
        width, initial = design.upper - design.lower, campaign.parameters.initial
        moded = np.vstack([local.frequencies, local.mac]) / initial
        moves = np.abs(np.vstack([moded, local.others])) * width
    else:
        moves = found.moves
    seen, macs = np.zeros(moves.shape), moves.shape[0] - local.others.shape[0]
    seen[macs:] = moves[macs:]
    used = weighting.frequencies_used
    seen[:n][used] = moves[:n][used] / weighting.frequency_deviations[used, None]
    if weighting.with_shapes:
        used = weighting.shapes_used
        seen[n:macs][used] = np.sqrt(moves[n:macs][used]) / weighting.shape_deviations[used, None]
    return seen
