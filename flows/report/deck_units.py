"""The unit in which a deck has a quantity, by its system of consistent units."""

from __future__ import annotations

#: Length, mass, force and stress of each system.
SYSTEMS: dict[str, tuple[str, str, str, str]] = {
    "m-kg-s": ("m", "kg", "N", "Pa"),
    "mm-t-s": ("mm", "t", "N", "MPa"),
    "in-slinch-s": ("in", "slinch", "lbf", "psi"),
    "ft-slug-s": ("ft", "slug", "lbf", "psf"),
}


def unit_of(units: str, quantity: str) -> str:
    """The unit of a parameter's quantity; empty where it has none, or the units are not known.

    A dimension of a section is a length; a spring may turn, so that its unit is not told.
    """
    if units not in SYSTEMS:
        return ""
    length, mass, _, stress = SYSTEMS[units]
    return {
        "youngs_modulus": stress,
        "shear_modulus": stress,
        "density": f"{mass}/{length}³",
        "thickness": length,
        "area": f"{length}²",
        "inertia_1": f"{length}⁴",
        "inertia_2": f"{length}⁴",
        "torsion_constant": f"{length}⁴",
        "dimension": length,
        "mass": mass,
    }.get(quantity, "")
