"""Mass, centre of gravity and inertia of a free structure, from its rigid-body modes.

Rigid-body modes of unit modal mass are six combinations of unit translations and rotations R
about the origin, phi = R A, whatever the solver chose. With the mass of rigid motion
M_r = R^T M R, phi^T M phi = 1 says A^T M_r A = 1, so

    M_r = (A A^T)^-1

without the model's mass matrix, and at any few nodes that separate six motions. M_r holds

    [ m 1    m [c]^T ]      m: mass, c: centre of gravity, J_o: inertia about the origin,
    [ m [c]  J_o     ]      [c]: the cross product's matrix

This shows a model that leaves mass out of its modes (a point mass at a node of no element), by
comparison with the mass that the solver prints. Source: Wijker 2004, 2.3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modetune.core.correlation.correlation import rigid_body_shapes
from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers

#: A rigid-body mode may differ from a rigid motion by this share of its length: a solver's digits.
RIGID_TOLERANCE = 1e-2
#: Condition of six motions beyond which no digit is left of those a solver prints.
HOPELESS_PLACES = 1e5


@dataclass(frozen=True, slots=True)
class RigidBody:
    """mass; centre: (3,), of gravity; inertia: (3, 3), tensor about the centre; global axes.

    spread: largest relative difference of the three directions' masses, 0 where all is consistent.
    """

    mass: float
    centre: Floats
    inertia: Floats
    spread: float


def rigid_body_of_modes(
    rigid_modes: Floats, coordinates: Floats, components: Integers
) -> RigidBody:
    """Mass properties of a free structure.

    rigid_modes: (n_dof, 6), of unit modal mass; coordinates: (n_dof, 3), place of each degree of
    freedom; components: (n_dof,), 1..6; global axes, the deck's units. Raises ModesError where
    these are not six rigid motions, or the places cannot separate them.
    """
    if rigid_modes.shape != (components.size, 6):
        raise ModesError(f"rigid-body modes of shape {rigid_modes.shape}; six are needed")
    origin = coordinates.mean(axis=0)
    size = float(np.linalg.norm(coordinates - origin, axis=1).max(initial=0.0)) or 1.0
    # About the middle and in lengths of the model's own size, so that all columns are alike.
    motions = rigid_body_shapes((coordinates - origin) / size, components)
    moves = components <= 3
    motions[~moves, 3:] /= size
    if not np.linalg.cond(motions) < HOPELESS_PLACES:
        raise ModesError("the positions of the result nodes do not separate six rigid motions")
    shares, *_ = np.linalg.lstsq(motions, rigid_modes, rcond=None)
    apart = np.linalg.norm(motions @ shares - rigid_modes, axis=0)
    if (apart > RIGID_TOLERANCE * np.linalg.norm(rigid_modes, axis=0)).any():
        raise ModesError("the modes at zero are not rigid motions of the nodes of the results")
    scale = np.array([1.0, 1.0, 1.0, size, size, size])  # back to the deck's length
    rigid_mass = np.linalg.inv(shares @ shares.T) * np.outer(scale, scale)
    return rigid_body_of_mass(rigid_mass, origin)


def rigid_body_of_mass(rigid_mass: Floats, origin: Floats | None = None) -> RigidBody:
    """Mass properties by the mass of rigid motion (6, 6) about an origin (3,), that of the axes
    where left out; complex where the mass is."""
    masses = rigid_mass.diagonal()[:3]
    mass = masses.mean()
    s = rigid_mass[:3, 3:] / mass  # s[i, k] = e_i . (e_k x c) = c . (e_i x e_k)
    c = 0.5 * np.array([s[1, 2] - s[2, 1], s[2, 0] - s[0, 2], s[0, 1] - s[1, 0]])
    steiner = mass * (c @ c * np.eye(3) - np.outer(c, c))
    spread = float(np.ptp(masses.real) / mass.real)
    centre = c if origin is None else origin + c
    return RigidBody(mass, centre, rigid_mass[3:, 3:] - steiner, spread)
