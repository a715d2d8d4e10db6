"""Consistent units of a model, and whether they are plausible."""

from __future__ import annotations

from typing import Literal

from modetune.adapters.solver import Solver

Units = Literal["m-kg-s", "mm-t-s", "in-slinch-s", "ft-slug-s"]
LengthUnit = Literal["m", "cm", "mm", "in", "ft"]

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


#: Speeds of sound in structural materials, m/s; wrong units show there.
SPEEDS = (500.0, 20_000.0)


#: Young's moduli, Pa, and densities, kg/m3, of load-bearing materials: wood to tungsten.
MODULI, DENSITIES = (1e8, 1.2e12), (300.0, 2.3e4)
#: Young's moduli of usual structural materials: plastics to steel and carbon fibre.
USUAL_MODULI = (1e9, 4e11)


def guessed_units(solver: Solver) -> tuple[Units | None, str]:
    """Return the units in which most of the model's mass is of a real material, and the reason.

    None where no units or several fit. This is a guess that callers must report to the user.
    """
    known, masses = solver.deck.elastic_constants(), solver.deck.material_masses()
    if not known:
        return None, "no material of the deck has a Young's modulus"
    score = dict.fromkeys(METRES, 0.0)
    for name, (modulus, density) in known.items():
        for units in score:
            if _real(units, modulus, density):
                score[units] += masses.get(name, 0.0) if any(masses.values()) else 1.0
    fitting = [units for units, weight in score.items() if weight and weight == max(score.values())]
    name = max(known, key=lambda item: (masses.get(item, 0.0), known[item][1] > 0.0))
    modulus, density = known[name]
    text = f"E {modulus:.6g}" + (f" and density {density:.6g}" if density else "") + f" of {name}"
    if len(fitting) == 1:
        return fitting[0], f"{text} are those of a real material in {fitting[0]}"
    among = f"fit {' and '.join(fitting)}" if fitting else "fit no known units"
    return None, f"{text} {among}"


def _real(units: Units, modulus: float, density: float) -> bool:
    """Return whether such a material exists, or without a density whether E is a usual modulus."""
    pascals = modulus * KILOGRAMS[units] / METRES[units]
    if not density:
        return USUAL_MODULI[0] <= pascals <= USUAL_MODULI[1]
    heavy, speed = density * KILOGRAMS[units] / METRES[units] ** 3, (modulus / density) ** 0.5
    return (
        MODULI[0] <= pascals <= MODULI[1]
        and DENSITIES[0] <= heavy <= DENSITIES[1]
        and SPEEDS[0] <= speed * METRES[units] <= SPEEDS[1]
    )


def unit_doubt(units: Units, solver: Solver) -> str:
    """Return why the materials of most of the mass make a model's units doubtful, else "".

    Films, foams and honeycombs have unusual values but little mass.
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
        f"in units {units} material {name}, with most of the mass, has a speed of sound of "
        f"{speeds[name] * METRES[units]:.3g} m/s (square root of E over density){hint}"
    )
