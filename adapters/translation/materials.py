"""Nastran materials as CalculiX materials.

A CalculiX shell becomes a solid, so a plane-stress material (MAT8) is given no coupling between
its plane and the thickness: the plane-stress law is then exact whatever the thickness does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from modetune.adapters.translation.calculix_text import CalculixText, number_list

#: A given shear modulus this close to E / 2 (1 + nu) is the isotropic one with rounded digits.
SAME_SHEAR = 5e-3


@dataclass(frozen=True, slots=True)
class MaterialUse:
    """A material with what a property adds to it: an own density (rho + NSM / t)."""

    name: str
    oriented: bool


def shell_material(
    builder: CalculixText, card: Any, density: float, wtmass: float, problems: list[str]
) -> MaterialUse:
    """Add the material of a shell; density: rho with non-structural mass, before WTMASS.

    Sentences on what cannot be translated go into problems.
    """
    oriented = False
    if card.type == "MAT1":
        e, g, nu = card.e, card.g, card.nu
        if not e or not g:
            problems.append(f"MAT1 {card.mid}: E and G above zero are needed, got E={e}, G={g}")
            return MaterialUse("", False)
        if is_isotropic(e, g, nu):
            elastic = ["*ELASTIC", number_list((e, nu))]
        else:
            # Nastran keeps all three in the plane-stress law: E and nu in its diagonal, G in shear.
            oriented, elastic = True, _constants(e, e, nu, g, g, g)
    elif card.type == "MAT8":
        oriented, elastic = True, _mat8(card, problems)
    else:
        elastic = _mat2(card, problems)
    return MaterialUse(_add(builder, card, elastic, density * wtmass), oriented)


def solid_material(
    builder: CalculixText, card: Any, wtmass: float, problems: list[str]
) -> MaterialUse:
    """Add the material of a solid (isotropic MAT1 only)."""
    if card.type != "MAT1":
        problems.append(f"{card.type} {card.mid}: solids are translated with MAT1 only")
        return MaterialUse("", False)
    if not card.e or not is_isotropic(card.e, card.g, card.nu):
        problems.append(
            f"MAT1 {card.mid}: E={card.e}, G={card.g} and NU={card.nu} are not an isotropic solid; "
            "leave one of them blank"
        )
        return MaterialUse("", False)
    elastic = ["*ELASTIC", number_list((card.e, card.nu))]
    return MaterialUse(_add(builder, card, elastic, card.rho * wtmass), False)


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


def _mat8(card: Any, problems: list[str]) -> list[str]:
    g12 = card.g12
    if not (card.e11 and card.e22 and g12):
        problems.append(f"MAT8 {card.mid}: E1, E2 and G12 above zero are needed")
        return []
    # Blank or zero G1Z, G2Z mean no transverse shear strain in Nastran; the in-plane modulus
    # stands in for the stiffness that a three-dimensional body must have.
    return _constants(card.e11, card.e22, card.nu12, g12, card.g1z or g12, card.g2z or g12)


def _constants(e1: float, e2: float, nu12: float, g12: float, g13: float, g23: float) -> list[str]:
    """Engineering constants, without Poisson's effect through the thickness."""
    first = (e1, e2, e2, nu12, 0.0, 0.0, g12, g13)
    return ["*ELASTIC, TYPE=ENGINEERING CONSTANTS", number_list(first), number_list((g23,))]


def _mat2(card: Any, problems: list[str]) -> list[str]:
    """A MAT2 that is an isotropic plane-stress law; anything else is refused."""
    g11, g12, g13 = card.G11, card.G12, card.G13
    g22, g23, g33 = card.G22, card.G23, card.G33
    nu = g12 / g22 if g22 else math.nan
    e = g11 * (1.0 - nu * nu)
    wanted = (g11, 0.0, 0.0, e / 2.0 / (1.0 + nu))
    found = (g22, g13 or 0.0, g23 or 0.0, g33)
    same = all(abs(a - b) <= SAME_SHEAR * abs(g11) for a, b in zip(wanted, found, strict=True))
    if not (e > 0.0 and same):
        problems.append(f"MAT2 {card.mid}: only an isotropic plane-stress MAT2 is translated")
        return []
    return ["*ELASTIC", number_list((e, nu))]
