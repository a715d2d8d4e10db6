"""What a shell property says: stiffness and mass of a unit of its area.

With e the strains of the mid-surface, k its curvatures and g the transverse shear strains, in the
material axes, the energy of a unit of area is (e A e + 2 e B k + k D k + g H g) / 2.

PSHELL: A = t Q1, D = (12 I / t^3) t^3 / 12 Q2, B = t^2 Q4, H = (TS / T) t G3 with the plane-stress
laws Q and the shear law G of its materials. PCOMP: classical laminate theory, A, B, D = sum over
plies of the integrals of Q, z Q, z^2 Q. H is that of the shear stresses that equilibrium asks for
(Rohwer 1988): bending in one direction alone, s(z) = integral of Q_11 (z_n - z) from the bottom
up, 1 / H = integral of s^2 / G dz / D_n^2, with z_n the neutral axis and D_n the bending stiffness
about it. A homogeneous plate has 5/6 by it, a sandwich its core alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special

from modetune.core.modes import Floats

#: A shell without transverse shear strain (MID3 or G1Z, G2Z blank) gets this multiple of its
#: in-plane shear stiffness: enough to suppress the strain, too little to hide the bending.
RIGID_SHEAR = 100.0
#: Blank TS/T of a PSHELL.
TS_T = 5.0 / 6.0


@dataclass(frozen=True, slots=True)
class ShellLaw:
    """membrane A, coupling B, bending D: (3, 3), about the mid-surface; shear H: (2, 2).

    mass: of a unit of area. offset: of the mid-surface from the grid points, along the normal.
    """

    membrane: Floats
    coupling: Floats
    bending: Floats
    shear: Floats
    mass: float
    thickness: float
    offset: float = 0.0

    @property
    def bends(self) -> bool:
        return bool(self.bending.any())

    @property
    def stretches(self) -> bool:
        return bool(self.membrane.any())


def law_of(card: Any, thickness: float | None = None) -> ShellLaw:
    """The law of a PSHELL, PCOMP or PCOMPG; thickness: of the element where it has its own.

    Raises ValueError with a sentence on why there is none.
    """
    if card.type == "PSHELL":
        return _plate(card, thickness or card.t or 0.0)
    if card.type in ("PCOMP", "PCOMPG"):
        return _composite(card)
    raise ValueError("shells have a law with PSHELL, PCOMP and PCOMPG only")


def _plate(card: Any, thickness: float) -> ShellLaw:
    membrane, bending = card.mid1_ref, card.mid2_ref
    if (membrane or bending) is None:
        raise ValueError("it has neither a membrane nor a bending material (MID1, MID2)")
    if not thickness > 0.0:
        raise ValueError("its thickness T is not above zero")
    zero = np.zeros((3, 3))
    a = thickness * plane_stress(membrane) if membrane else zero
    inertia = (card.twelveIt3 or 1.0) * thickness**3 / 12.0
    d = inertia * plane_stress(bending) if bending else zero
    b = thickness**2 * plane_stress(card.mid4_ref) if card.mid4_ref else zero
    rigid = RIGID_SHEAR * thickness * plane_stress(membrane or bending)[2, 2] * np.eye(2)
    h = rigid
    if card.mid3_ref and bending:
        law = transverse_shear(card.mid3_ref)
        h = rigid if law is None else (card.tst or TS_T) * thickness * law
    mass = (membrane or bending).rho * thickness + (card.nsm or 0.0)
    return ShellLaw(a, b, d, h if bending else np.zeros((2, 2)), mass, thickness)


def _composite(card: Any) -> ShellLaw:
    kind = (card.lam or "").upper()
    if kind not in ("", "SYM", "MEM", "BEND", "SMEAR"):
        raise ValueError(f"LAM={kind} is not known")
    rows = list(zip(card.mids_ref, card.thicknesses, card.thetas, strict=True))
    if not rows or any(material is None or not thickness for material, thickness, _ in rows):
        raise ValueError("a ply without material or thickness")
    rows += rows[::-1] if kind == "SYM" else []
    plies = [(material, thickness, float(theta or 0.0)) for material, thickness, theta in rows]
    total = sum(thickness for _, thickness, _ in plies)
    edges = np.cumsum([0.0, *(thickness for _, thickness, _ in plies)]) - total / 2.0
    laws = [turned_plane(plane_stress(material), angle) for material, _, angle in plies]
    moments = [(edges[1:] ** n - edges[:-1] ** n) / n for n in (1, 2, 3)]
    a, b, d = (np.einsum("p,pij->ij", moment, np.array(laws)) for moment in moments)
    b[np.abs(b) < 1e-12 * np.abs(a).max() * total] = 0.0
    shears = [transverse_shear(material) for material, _, _ in plies]
    h = RIGID_SHEAR * a[2, 2] * np.eye(2)
    if all(shear is not None for shear in shears):
        turned = [
            turned_shear(shear, angle)
            for shear, (_, _, angle) in zip(shears, plies, strict=True)
            if shear is not None
        ]
        h = laminate_shear(laws, turned, edges)
    if kind == "SMEAR":
        b, d = np.zeros((3, 3)), a * total**2 / 12.0
    if kind == "MEM":
        b, d, h = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((2, 2))
    if kind == "BEND":
        a, b = np.zeros((3, 3)), np.zeros((3, 3))
    mass = sum(material.rho * thickness for material, thickness, _ in plies) + (card.nsm or 0.0)
    # With LAM=SYM pyNastran and Nastran take Z0 as the bottom of the whole laminate.
    offset = 0.0 if card.z0 is None else card.z0 + total / 2.0
    offset = 0.0 if abs(offset) < 1e-9 * total else offset
    return ShellLaw(a, b, d, h, mass, total, offset)


def laminate_shear(laws: list[Floats], shears: list[Floats], edges: Floats) -> Floats:
    """(2, 2) transverse shear stiffness; laws: (3, 3) and shears: (2, 2) of the plies, turned.

    edges: (n_plies + 1,), where plies begin and end, from the bottom up.
    """
    points, weights = special.roots_legendre(3)  # exact: s^2 is of the fourth degree
    flexibility = np.zeros((2, 2))
    moduli = np.array([np.diag(law)[:2] for law in laws])
    lows, tops = edges[:-1, None], edges[1:, None]
    neutral = (moduli * (tops**2 - lows**2) / 2).sum(0) / (moduli * (tops - lows)).sum(0)
    bending = (moduli * ((tops - neutral) ** 3 - (lows - neutral) ** 3) / 3).sum(0)
    below = np.zeros(2)
    for modulus, shear, low, top in zip(moduli, shears, edges[:-1], edges[1:], strict=True):
        inverse = np.linalg.inv(shear)
        for point, weight in zip(points, weights, strict=True):
            z = (low + top) / 2 + point * (top - low) / 2
            stress = below + modulus * ((low - neutral) ** 2 - (z - neutral) ** 2) / 2
            flexibility += weight * (top - low) / 2 * np.outer(stress, stress) * inverse
        below = below + modulus * ((low - neutral) ** 2 - (top - neutral) ** 2) / 2
    return np.asarray(np.linalg.inv(flexibility / np.outer(bending, bending)))


def turned_plane(law: Floats, degrees: float) -> Floats:
    """A plane-stress law (3, 3) of axes at an angle, in the axes it is measured from."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    strains = np.array(
        [[c * c, s * s, c * s], [s * s, c * c, -c * s], [-2 * c * s, 2 * c * s, c * c - s * s]]
    )
    return np.asarray(strains.T @ law @ strains)


def turned_shear(law: Floats, degrees: float) -> Floats:
    """A transverse shear law (2, 2) of axes at an angle, in the axes it is measured from."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    axes = np.array([[c, s], [-s, c]])
    return np.asarray(axes.T @ law @ axes)


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
    raise ValueError(f"{card.type} {card.mid}: shells have a law with MAT1, MAT2 and MAT8 only")


def _orthotropic(e1: float, e2: float, nu12: float, g12: float) -> Floats:
    share = 1.0 - nu12 * nu12 * e2 / e1
    if not share > 0.0:
        raise ValueError(f"Poisson's ratio {nu12:g} is too large for moduli {e1:g} and {e2:g}")
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
