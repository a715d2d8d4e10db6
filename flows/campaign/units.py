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


#: Sound travels so fast, m/s, in what structures are made of; wrong units show there.
SPEEDS = (500.0, 20_000.0)


def unit_doubt(units: Units, solver: Solver) -> str:
    """Why a model's units are doubtful by the materials of most of its mass, empty if they are not.

    Films, foams and honeycombs, whose numbers are of their own kind, weigh little.
    """
    deck = solver.deck
    speeds, masses = deck.wave_speeds(), deck.material_masses()
    weights = {name: masses.get(name, 0.0) if masses else 1.0 for name in speeds}
    strange = {
        name: weights[name]
        for name, speed in speeds.items()
        if not SPEEDS[0] <= speed * METRES[units] <= SPEEDS[1]
    }
    if 2.0 * sum(strange.values()) <= sum(weights.values()):
        return ""
    name = max(strange, key=strange.__getitem__)
    fitting = [
        unit for unit, scale in METRES.items() if SPEEDS[0] <= speeds[name] * scale <= SPEEDS[1]
    ]
    hint = f"; {' or '.join(fitting)} would fit" if fitting else ""
    return (
        f"in units {units} sound would travel at {speeds[name] * METRES[units]:.3g} m/s in "
        f"material {name} (root of E over density), of which most of the mass is{hint}"
    )
