"""Nastran materials of solids as CalculiX materials."""

from __future__ import annotations

from typing import Any

from modetune.adapters.translation.calculix_text import CalculixText, number_list

#: A given shear modulus this close to E / 2 (1 + nu) is the isotropic one with rounded digits.
SAME_SHEAR = 5e-3


def solid_material(builder: CalculixText, card: Any, wtmass: float, problems: list[str]) -> str:
    """Add the material of a solid (isotropic MAT1 only); its name."""
    if card.type != "MAT1":
        problems.append(f"{card.type} {card.mid}: solids are translated with MAT1 only")
        return ""
    if not card.e or not is_isotropic(card.e, card.g, card.nu):
        problems.append(
            f"MAT1 {card.mid}: E={card.e}, G={card.g} and NU={card.nu} are not an isotropic solid; "
            "leave one of them blank"
        )
        return ""
    elastic = ["*ELASTIC", number_list((card.e, card.nu))]
    return _add(builder, card, elastic, card.rho * wtmass)


def is_isotropic(e: float, g: float, nu: float) -> bool:
    """Whether G is E / 2 (1 + nu), but for rounded digits."""
    return bool(g) and abs(2.0 * g * (1.0 + nu) / e - 1.0) < SAME_SHEAR


def _add(builder: CalculixText, card: Any, elastic: list[str], density: float) -> str:
    """Add a material; one name for each density that a material is used with."""
    lines = [*elastic, "*DENSITY", number_list((density,))] if density else elastic
    base, name, count = f"M{card.mid}", f"M{card.mid}", 1
    while not builder.can_be_material(name, lines):
        count += 1
        name = f"{base}_{count}"
    builder.material(name, lines)
    return name
