"""One basis for modes of equal frequency, whichever an eigensolver gives.

Of a repeated eigenvalue only the space of its modes is defined, and a solver's basis of it follows
from rounding, from the order of the unknowns and from start vectors. Here the basis follows from
the space: the degree of freedom that moves most in any mode of the space moves in the first mode
alone, with positive sign; of the others, the one that moves most in what remains moves in the
first two modes alone, and so on (the lower triangle of a QR factorisation with row pivoting). Of
degrees of freedom that move alike, as in symmetric structures, the first counts.
"""

from __future__ import annotations

import numpy as np

from modetune.core.modes import Floats, close_sets

#: Relative distance of eigenvalues below which modes are repeated: ten times what rounding leaves
#: of equal ones where the largest eigenvalue is 10^7 times theirs.
SAME = 1e-8
#: Relative difference of squared motions below which degrees of freedom move alike.
ALIKE = 1e-6
#: A direction is fixed only if a degree of freedom has this share of the space's largest motion.
SEEN = 1e-6


def canonical_rotation(eigenvalues: Floats, shapes: Floats) -> Floats:
    """Return an orthogonal rotation that gives repeated modes their basis, (n_modes, n_modes).

    eigenvalues: (n_modes,), ascending; shapes: (n_dof, n_modes), whose rows are in an order that
    does not depend on the solver. Use shapes @ rotation.
    """
    rotation = np.eye(eigenvalues.size)
    for members in close_sets(np.abs(eigenvalues), SAME):
        if members.size > 1:
            rotation[np.ix_(members, members)] = _turn(shapes[:, members])
    return rotation


def _turn(shapes: Floats) -> Floats:
    """Return the rotation of one set of repeated modes, (n_members, n_members)."""
    left, turn = shapes.copy(), np.eye(shapes.shape[1])
    largest = float(np.max(np.sum(left**2, axis=1), initial=0.0))
    for place in range(shapes.shape[1]):
        motions = np.sum(left[:, place:] ** 2, axis=1)
        if motions.max(initial=0.0) <= SEEN**2 * largest:
            break
        row = int(np.argmax(motions >= (1.0 - ALIKE) * motions.max()))
        # A Householder reflection takes this row's motion to one mode.
        wanted = left[row, place:].copy()
        length = float(np.linalg.norm(wanted))
        sign = 1.0 if wanted[0] < 0.0 else -1.0
        wanted[0] -= sign * length
        step = np.eye(wanted.size) - 2.0 * np.outer(wanted, wanted) / (wanted @ wanted)
        step[:, 0] *= sign
        left[:, place:] = left[:, place:] @ step
        turn[:, place:] = turn[:, place:] @ step
    return turn
