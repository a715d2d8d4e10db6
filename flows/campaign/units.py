"""Consistent units of a model, and whether they can be true."""

from __future__ import annotations

from modetune.adapters.solver import Solver
from modetune.flows.campaign.schema import LengthUnit, Units

KILOGRAMS: dict[Units, float] = {
    "m-kg-s": 1.0,
    "mm-t-s": 1e3,
    "in-slinch-s": 175.126835,
    "ft-slug-s": 14.5939029,
}
METRES: dict[Units, float] = {
    "m-kg-s": 1.0,
    "mm-t-s": 1e-3,
    "in-slinch-s": 0.0254,
    "ft-slug-s": 0.3048,
}


LENGTH_METRES: dict[LengthUnit, float] = {
    "m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "ft": 0.3048,
}  # fmt: skip


def unit_problems(where: str, units: Units, solver: Solver) -> list[str]:
    """Sound travels at 500 to 20,000 m/s in what structures are made of; wrong units show there."""
    found = []
    for material, speed in solver.deck.wave_speeds().items():
        metres = speed * METRES[units]
        if not 500.0 <= metres <= 20_000.0:
            fitting = [name for name, scale in METRES.items() if 500.0 <= speed * scale <= 20_000.0]
            hint = f"; {' or '.join(fitting)} would fit" if fitting else ""
            found.append(
                f"{where}: in units {units} sound would travel at {metres:.3g} m/s in material "
                f"{material} (root of E over density){hint}"
            )
    return found
