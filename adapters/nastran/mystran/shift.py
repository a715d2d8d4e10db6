"""The shift of MYSTRAN's first factorisation, K - shift M.

It is negative, so that the matrix of a free structure is not singular. MYSTRAN's Lanczos iteration
loses rigid and repeated modes where the shift is far above the lowest elastic eigenvalue (free bars
of 60 m at 0.06 Hz: three of six rigid modes with 70 times that eigenvalue, none with seven times).
Below some hundred roundings of the largest eigenvalue, K - shift M is as singular as K.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from modetune.adapters.nastran.bulk import Bulk
from modetune.adapters.nastran.cross_sections import cross_section
from modetune.adapters.nastran.deck import NastranDeck
from modetune.core.algebra.rigid_modes import EPS
from modetune.core.mesh import Mesh, shortest_length

#: Fields of an EIGRL card: its number, and the shift.
EIGRL_ID, EIGRL_SHIFT = 1, 7
#: The shift of most structures, (rad/s)^2: 5 Hz.
USUAL = 1000.0
#: The least shift in multiples of the rounding of the largest eigenvalue.
ABOVE_ROUNDING = 300.0
#: The first eigenvalue of a free bar is this times (c r / l^2)^2 with its radius of gyration r.
FREE_BAR = 22.37**2
#: The shift as a share of that: masses that carry no stiffness make the true one lower.
SHARE = 0.1


def first_shift(deck: NastranDeck, method: int) -> str:
    """The shift of the user's own EIGRL where it is negative, empty elsewhere."""
    for card in deck.named("EIGRL"):
        shift = card.text(EIGRL_SHIFT)
        if card.text(EIGRL_ID) == str(method) and shift.startswith("-"):
            return shift
    return ""


def usual_shift(mesh: Mesh, bulk: Bulk, speed: float, largest: float) -> str:
    """A shift below ten times the lowest elastic eigenvalue, as a field of EIGRL.

    speed: of waves in the fastest material; largest: eigenvalue of the model, (rad/s)^2; both are 0
    where unknown. Raises ModelError where an element names a node that is not in the mesh.
    """
    spans = np.ptp(mesh.coordinates, axis=0) if mesh.nodes.size else np.zeros(3)
    length = float(np.linalg.norm(spans))
    if not (speed and length):
        return f"-{USUAL:.0f}."
    radius = min([shortest_length(mesh), *_radii(bulk)])
    lowest = FREE_BAR * (speed * radius / length**2) ** 2
    shift = min(USUAL, max(SHARE * lowest, ABOVE_ROUNDING * EPS * largest))
    return f"-{USUAL:.0f}." if shift == USUAL else f"-{shift:.1E}"


def _radii(bulk: Bulk) -> list[float]:
    """Radii of gyration of the sections of bars and shells."""
    found = []
    for item in bulk.properties.values():
        if item.type in ("PSHELL", "PCOMP", "PCOMPG"):
            found.append(float(item.Thickness() or 0.0) / 12.0**0.5)
        elif item.type in ("PBAR", "PBARL", "PBEAM", "PBEAML"):
            with suppress(ValueError):  # a section that modetune does not know
                for station in cross_section(item).stations:
                    least = float(np.linalg.eigvalsh(station.moments)[0])
                    found.append((max(least, 0.0) / station.area) ** 0.5 if station.area else 0.0)
    return [radius for radius in found if radius > 0.0]
