"""Where a screening's answer requires a second look: what its design says against it.

The choice rests on the linear model at the deck's values. A design over the whole of the bounds
tells where that model does not hold; and an index whose interval is wide ranks nothing.
"""

from __future__ import annotations

import numpy as np

from modetune.core.modes import Floats
from modetune.flows.studies.screen.design import MOST_POINTS
from modetune.flows.studies.screen.indices import Indices
from modetune.flows.studies.screen.record import Screening

#: Share of a frequency's variance that must be explained for the linear choice to be believed.
LEAST_EXPLAINED = 0.5
#: A parameter with a smaller share of a mode's largest mu* has no say in what is chosen.
LEAST_EFFECT = 0.1
#: Widest half of a 95 % interval of a Sobol index that still ranks.
WIDEST = 0.1
HENCE = "so the choice, which is linear, may not hold over the bounds"


def notes(screening: Screening) -> list[str]:
    """Sentences, most general first; none where nothing is wanting."""
    found = screening.indices
    said = _fewer_than_asked(screening)
    if found is None:
        return said
    method = screening.design.method
    if method == "lhs":
        said += _unexplained(screening, found.explained, "a plane explains")
    elif method == "morris":
        said += _scattered(screening, found)
    elif method == "sobol":
        alone = np.where(found.moves.any(axis=1), found.measure("first").sum(axis=1), np.nan)
        said += _unexplained(screening, alone, "the parameters, each alone, explain")
        said += _wide(screening, found)
    return said


def _fewer_than_asked(screening: Screening) -> list[str]:
    wanted, candidates, chosen = screening.wanted, len(screening.names), screening.choice.chosen
    if wanted <= len(chosen):
        return []
    why = (
        f"there are {candidates} candidates"
        if wanted > candidates
        else "the test does not tell the others apart"
    )
    return [f"--choose {wanted}: {len(chosen)} are proposed, {why}"]


def _unexplained(screening: Screening, shares: Floats, what: str) -> list[str]:
    return [
        f"{name}: {what} {100.0 * max(share, 0.0):.0f} % of its variance, {HENCE}"
        for name, share in zip(screening.modes, shares.tolist(), strict=False)
        if share < LEAST_EXPLAINED  # no number is less
    ]


def _scattered(screening: Screening, found: Indices) -> list[str]:
    said = []
    sizes, spreads = found.measure("mu_star"), found.measure("sigma")
    for row, name in enumerate(screening.modes):
        heard = sizes[row] >= LEAST_EFFECT * sizes[row].max()
        names = [
            screening.names[place]
            for place in np.flatnonzero(heard & (spreads[row] > sizes[row])).tolist()
        ]
        if names:
            said.append(f"{name}: sigma exceeds mu* of {', '.join(names)}, {HENCE}")
    return said


def _wide(screening: Screening, found: Indices) -> list[str]:
    """Intervals narrow with the root of the number of base samples, a power of two."""
    n_modes, each = len(screening.numbers), len(screening.names) + 2
    half = float(found.measure("total_confidence")[:n_modes].max(initial=0.0))
    if not half > WIDEST:
        return []
    samples = found.used / each * (half / WIDEST) ** 2
    points = min(each * 2 ** int(np.ceil(np.log2(samples))), MOST_POINTS)
    return [
        f"a total index is known to +-{half:.2g} only: too few points to rank: --points {points}"
    ]
