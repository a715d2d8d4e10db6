"""Consistent units of a model, and whether they are plausible."""

from __future__ import annotations

from typing import Literal

from modetune.adapters.solver import Solver, StatedUnits

Units = Literal[
    "m-kg-s", "m-t-s", "mm-t-s", "mm-kg-s", "mm-g-s", "cm-g-s", "in-slinch-s", "ft-slug-s"
]
LengthUnit = Literal["m", "cm", "mm", "in", "ft"]

KILOGRAMS: dict[Units, float] = {
    "m-kg-s": 1.0,
    "m-t-s": 1e3,
    "mm-t-s": 1e3,
    "mm-kg-s": 1.0,
    "mm-g-s": 1e-3,
    "cm-g-s": 1e-3,
    "in-slinch-s": 175.126835,
    "ft-slug-s": 14.5939029,
}
METRES: dict[Units, float] = {
    "m-kg-s": 1.0,
    "m-t-s": 1.0,
    "mm-t-s": 1e-3,
    "mm-kg-s": 1e-3,
    "mm-g-s": 1e-3,
    "cm-g-s": 1e-2,
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
#: Sizes of units differ by less where only their digits do; those of systems differ by 2 or more.
SAME = 1e-3


def guessed_units(solver: Solver) -> tuple[Units | None, str]:
    """Return the units that the deck states, or that make most of its mass a real material.

    None where no units or several fit. This is a guess that callers must report to the user.
    """
    stated = solver.deck.stated_units()
    if stated is not None:
        found = _consistent(stated)
        return found, f"{stated.where}" + ("" if found else ": no known system of units")
    known, masses = solver.deck.elastic_constants(), solver.deck.material_masses()
    if not known:
        return None, "no material of the deck has a Young's modulus"
    known = {name: pair for name, pair in known.items() if pair[1]}  # rigid dummies have no mass
    if not known:
        return None, "no material of the deck has a density, from which units would follow"
    score = dict.fromkeys(METRES, 0.0)
    for name, (modulus, density) in known.items():
        for units in score:
            if _real(units, modulus, density):
                score[units] += masses.get(name, 0.0) if any(masses.values()) else 1.0
    fitting = [units for units, weight in score.items() if weight and weight == max(score.values())]
    name = max(known, key=lambda item: masses.get(item, 0.0))
    modulus, density = known[name]
    text = f"E {modulus:.6g} and density {density:.6g} of {name}"
    if len(fitting) == 1:
        return fitting[0], f"{text} are those of a real material in {fitting[0]}"
    among = f"fit {' and '.join(fitting)}" if fitting else "fit no known units"
    return None, f"{text} {among}"


def _consistent(stated: StatedUnits) -> Units | None:
    """Return the known units of these sizes: a unit of force is mass times length per s^2."""
    kilograms = stated.newtons / stated.metres
    for units, metres in METRES.items():
        same = abs(metres / stated.metres - 1.0) < SAME
        if same and abs(KILOGRAMS[units] / kilograms - 1.0) < SAME:
            return units
    return None


def _real(units: Units, modulus: float, density: float) -> bool:
    """Return whether such a material exists."""
    pascals = modulus * KILOGRAMS[units] / METRES[units]
    heavy, speed = density * KILOGRAMS[units] / METRES[units] ** 3, (modulus / density) ** 0.5
    return (
        MODULI[0] <= pascals <= MODULI[1]
        and DENSITIES[0] <= heavy <= DENSITIES[1]
        and SPEEDS[0] <= speed * METRES[units] <= SPEEDS[1]
    )


def unit_doubt(units: Units, solver: Solver) -> str:
    """Return why the deck or the materials of most of the mass make units doubtful, else "".

    Films, foams and honeycombs have unusual values but little mass.
    """
    deck = solver.deck
    stated = deck.stated_units()
    if stated is not None and (found := _consistent(stated)) != units:
        return f"units are {units}, but {stated.where}" + (f" ({found})" if found else "")
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
    fitting = [unit for unit in METRES if _real(unit, *deck.elastic_constants()[name])]
    hint = f"; {' or '.join(fitting)} would fit" if fitting else ""
    return (
        f"in units {units} material {name}, with most of the mass, has a speed of sound of "
        f"{speeds[name] * METRES[units]:.3g} m/s (square root of E over density){hint}"
    )
