"""Names of units in decks, in lower case, and the system of two of them."""

from __future__ import annotations

from modetune.adapters.solver import StatedUnits

#: Metres in a unit of length.
LENGTHS = {
    **dict.fromkeys(("m", "meter", "metre", "meters", "metres"), 1.0),
    **dict.fromkeys(("mm", "millimeter", "millimetre"), 1e-3),
    **dict.fromkeys(("cm", "centimeter", "centimetre"), 1e-2),
    **dict.fromkeys(("in", "inch", "inches"), 0.0254),
    **dict.fromkeys(("ft", "foot", "feet"), 0.3048),
}
POUND = 4.4482216
#: Newtons in a unit of force.
FORCES = {
    **dict.fromkeys(("n", "newton", "newtons"), 1.0),
    **dict.fromkeys(("mn", "milli-newton", "millinewton"), 1e-3),  # Simcenter's MN
    **dict.fromkeys(("kn", "kilo-newton", "kilonewton"), 1e3),
    **dict.fromkeys(("lb", "lbf", "pound", "pound f", "pound-force"), POUND),
    **dict.fromkeys(("dyn", "dyne"), 1e-5),
}
#: Kilograms in a unit of mass.
MASSES = {
    **dict.fromkeys(("kg", "kilogram"), 1.0),
    **dict.fromkeys(("g", "gram"), 1e-3),
    **dict.fromkeys(("t", "ton", "tonne"), 1e3),
    "slug": POUND / 0.3048,
    "slinch": POUND / 0.0254,
}


def units_of(one: str, other: str, where: str) -> StatedUnits | None:
    """Return the units that a length and a force or a mass name, in either order.

    where: file, line and statement. None where they name no such pair.
    """
    for length, second in ((one, other), (other, one)):
        metres = LENGTHS.get(length)
        newtons = FORCES.get(second)
        if metres and second in MASSES:
            newtons = MASSES[second] * metres
        if metres and newtons:
            return StatedUnits(metres, newtons, where)
    return None
