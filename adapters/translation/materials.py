"""Nastran materials as CalculiX materials.

A CalculiX shell becomes a solid, so a plane-stress material (MAT8) is given no coupling between
its plane and the thickness: the plane-stress law is then exact whatever the thickness does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from modetune.adapters.translation.calculix_text import CalculixText, number_list
from modetune.core.modes import Floats

#: A given shear modulus this close to E / 2 (1 + nu) is the isotropic one with rounded digits.
SAME_SHEAR = 5e-3


@dataclass(frozen=True, slots=True)
class MaterialUse:
    """A material with what a property adds to it: an own density (rho + NSM / t)."""

    name: str
    oriented: bool


def plane_stress(card: Any) -> Floats:
    """(3, 3) law of plane stress in the material's axes. Raises ValueError."""
    if card.type == "MAT1":
        e, g, nu = card.e, card.g, card.nu
        if not e or not g:
            raise ValueError(f"MAT1 {card.mid}: E and G above zero are needed, got E={e}, G={g}")
        # Nastran keeps all three where they are given: E and nu in the diagonal, G in shear.
        return _orthotropic(e, e, nu, g)
    if card.type == "MAT8":
        if not (card.e11 and card.e22 and card.g12):
            raise ValueError(f"MAT8 {card.mid}: E1, E2 and G12 above zero are needed")
        return _orthotropic(card.e11, card.e22, card.nu12, card.g12)
    if card.type == "MAT2":
        g11, g12, g13 = (value or 0.0 for value in (card.G11, card.G12, card.G13))
        g22, g23, g33 = (value or 0.0 for value in (card.G22, card.G23, card.G33))
        return np.array([[g11, g12, g13], [g12, g22, g23], [g13, g23, g33]])
    raise ValueError(f"{card.type} {card.mid}: shells are translated with MAT1, MAT2 and MAT8")


def _orthotropic(e1: float, e2: float, nu12: float, g12: float) -> Floats:
    share = 1.0 - nu12 * nu12 * e2 / e1
    cross = nu12 * e2 / share
    return np.array([[e1 / share, cross, 0.0], [cross, e2 / share, 0.0], [0.0, 0.0, g12]])


def transverse_shear(card: Any) -> Floats | None:
    """(2, 2) law of transverse shear, None where the card means none of that strain."""
    if card.type == "MAT1":
        return np.asarray((card.g or 0.0) * np.eye(2)) if card.g else None
    if card.type == "MAT8":
        return np.diag([card.g1z, card.g2z]) if card.g1z and card.g2z else None
    if card.type == "MAT2" and card.G11 and card.G22:
        return np.array([[card.G11, card.G12 or 0.0], [card.G12 or 0.0, card.G22]])
    return None


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
