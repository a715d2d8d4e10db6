"""What a shell property says: its plies from the bottom up, and where its mid-surface is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

#: Adds a material with this density; returns its ccx name and whether its directions matter.
AddMaterial = Callable[[Any, float], tuple[str, bool]]


@dataclass(frozen=True, slots=True)
class Ply:
    """material: its ccx name; angle: from the element's material axis, degrees."""

    material: str
    thickness: float
    angle: float


@dataclass(frozen=True, slots=True)
class Laminate:
    """offset: of the mid-surface from the nodes, along the normal."""

    plies: tuple[Ply, ...]
    offset: float
    oriented: bool
    is_composite: bool

    @property
    def thickness(self) -> float:
        return sum(ply.thickness for ply in self.plies)


def laminate_of(card: Any, add: AddMaterial, problems: list[str]) -> Laminate | None:
    """The laminate of a PSHELL, PCOMP or PCOMPG; None where it cannot be translated."""
    if card.type == "PSHELL":
        return _plate(card, add, problems)
    if card.type in ("PCOMP", "PCOMPG"):
        return _composite(card, add, problems)
    problems.append(f"{card.type} {card.pid}: shells are translated with PSHELL, PCOMP, PCOMPG")
    return None


def _plate(card: Any, add: AddMaterial, problems: list[str]) -> Laminate | None:
    found = []
    if card.mid1 is None or card.mid2 is None:
        found.append("membrane or bending alone (MID1 or MID2 blank)")
    elif card.mid2_ref is not card.mid1_ref:
        found.append(f"bending of another material (MID2={card.Mid2()}, MID1={card.Mid1()})")
    if card.mid3 is not None and card.mid3_ref is not card.mid1_ref:
        found.append(f"transverse shear of another material (MID3={card.Mid3()})")
    if card.twelveIt3 is not None and abs(card.twelveIt3 - 1.0) > 1e-6:
        found.append(f"12 I / T^3 = {card.twelveIt3:g}, not 1")
    if card.mid4:
        found.append("coupling of membrane and bending (MID4)")
    if not card.t:
        found.append("no thickness (T)")
    problems += [f"PSHELL {card.pid}: {reason} is not translated" for reason in found]
    if found:
        return None
    material = card.mid1_ref
    name, oriented = add(material, material.rho + (card.nsm or 0.0) / card.t)
    return Laminate((Ply(name, card.t, 0.0),), 0.0, oriented, is_composite=False)


def _composite(card: Any, add: AddMaterial, problems: list[str]) -> Laminate | None:
    kind = (card.lam or "").upper()
    if kind not in ("", "SYM"):
        problems.append(f"{card.type} {card.pid}: LAM={kind} is not translated")
        return None
    rows = list(zip(card.mids_ref, card.thicknesses, card.thetas, strict=True))
    if not rows or any(material is None or not thickness for material, thickness, _ in rows):
        problems.append(f"{card.type} {card.pid}: a ply without material or thickness")
        return None
    if kind == "SYM":
        rows += rows[::-1]
    total = sum(thickness for _, thickness, _ in rows)
    extra = (card.nsm or 0.0) / total
    uses = [add(material, material.rho + extra) for material, _, _ in rows]
    plies = tuple(
        Ply(use[0], thickness, theta or 0.0)
        for use, (_, thickness, theta) in zip(uses, rows, strict=True)
    )
    # With LAM=SYM pyNastran and Nastran take Z0 as the bottom of the whole laminate.
    bottom = -total / 2.0 if card.z0 is None else card.z0
    offset = bottom + total / 2.0
    offset = 0.0 if abs(offset) < 1e-9 * total else offset
    oriented = any(use[1] for use in uses)
    if not oriented and len({ply.material for ply in plies}) == 1:
        # Plies of one isotropic material are one plate, whatever their angles.
        plies = (Ply(plies[0].material, total, 0.0),)
        return Laminate(plies, offset, oriented, is_composite=False)
    return Laminate(plies, offset, oriented, is_composite=True)
