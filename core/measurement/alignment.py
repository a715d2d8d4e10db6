"""How the points of a test are laid over a model: scale, rotation and translation.

A test has axes, an origin and a unit of length of its own. A test point x lies in the model at

    y = s R x + t,        s > 0, R a proper rotation, t in the model's length.

Points with known partners (Umeyama 1991, IEEE Trans. PAMI 13, eqs. 40-42): with centred points X
and targets Y (n, 3) and the decomposition Y^T X / n = U D V^T, the least sum of |y - s R x - t|^2
has

    R = U S V^T,  s = tr(D S) / (|X|^2 / n),  t = mean(y) - s R mean(x),  S = diag(1, 1, det U V)

S keeps R proper: a mirrored structure is another structure. Points in one plane have D[2] = 0 and
still one R only; points on one line leave a turn about it open and are refused.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from modetune.core.errors import ModesError
from modetune.core.modes import Floats

#: Points whose second extent is below this part of the first lie on a line.
ON_A_LINE = 1e-3


@dataclass(frozen=True, slots=True)
class Alignment:
    """Where test points lie in a model: y = scale rotation x + translation.

    scale: model lengths a test length. rotation: (3, 3), proper. translation: (3,), the model's
    length. residuals: (n_points,), distances left by a fit, the model's length; empty where the
    alignment was given. used: (n_points,), which points took part in the fit.
    notes: what is to be known of it, a sentence each.
    """

    scale: float
    rotation: Floats
    translation: Floats
    residuals: Floats = field(default_factory=lambda: np.zeros(0))
    used: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    notes: tuple[str, ...] = ()

    def apply(self, coordinates: Floats) -> Floats:
        """Coordinates (n, 3) of the test in the model's axes and length."""
        return np.asarray(self.scale * coordinates @ self.rotation.T + self.translation)

    def turn(self, directions: Floats) -> Floats:
        """Directions (..., 3) of the test in the model's axes."""
        return np.asarray(directions @ self.rotation.T)

    @property
    def rms(self) -> float:
        """Root mean square of what the fit left at the points it used; 0 where given."""
        left = self.residuals[self.used]
        return float(np.sqrt(np.mean(left**2))) if left.size else 0.0

    @property
    def largest(self) -> float:
        """Largest of what the fit left at the points it used; 0 where given."""
        return float(self.residuals[self.used].max(initial=0.0))

    @property
    def degrees(self) -> float:
        """How far the rotation turns, 0 to 180."""
        return degrees_of(self.rotation)


@dataclass(frozen=True, slots=True)
class Registration:
    """Ways to lay a test over a model.

    best: the likeliest. others: those that cannot be told from it, likelier ones first. slides:
    how far points may move at most in motions that the fit cannot tell, the model's length.
    on_nodes: whether points lie on nodes. mirrored: whether the mirrored points fit far better.
    """

    best: Alignment
    others: tuple[Alignment, ...] = ()
    slides: float = 0.0
    on_nodes: bool = False
    mirrored: bool = False


def fit_similarity(points: Floats, targets: Floats, scale: float | None = None) -> Alignment:
    """The alignment that brings points nearest to their known partners.

    points, targets: (n, 3), partners in the same row. scale: model lengths a test length where it
    is known; None fits it too. Raises ModesError for fewer than three points, points on one line
    and arrays that do not fit together. Source: Umeyama (1991).
    """
    if points.shape != targets.shape:
        raise ModesError(f"{len(points)} points cannot be fitted to {len(targets)} partners")
    require_spread(points, "the test's points with known partners")
    require_spread(targets, "the model's nodes they belong to")
    found = umeyama(points, targets, scale)
    mirror = np.diag([1.0, 1.0, -1.0])
    mirrored = umeyama(points @ mirror, targets, scale)
    left, other = (
        np.linalg.norm(fit.apply(where) - targets, axis=1)
        for fit, where in ((found, points), (mirrored, points @ mirror))
    )
    size = float(np.linalg.norm(np.ptp(targets, axis=0)))
    notes: tuple[str, ...] = ()
    # In a plane the mirrored points are the points, and both fit alike.
    if np.sqrt(np.mean(left**2)) > 1e-6 * size and np.sum(other**2) < 0.25 * np.sum(left**2):
        notes = (
            "the test's points fit far better as their own mirror image: a partner may be wrong, "
            "or the test's axes are left-handed",
        )
    return Alignment(
        found.scale, found.rotation, found.translation, left, np.ones(len(points), bool), notes
    )


def umeyama(points: Floats, targets: Floats, scale: float | None) -> Alignment:
    """The fit of points (n, 3) to targets (n, 3) without residuals or checks, eqs. 40-42."""
    x, y = points - points.mean(axis=0), targets - targets.mean(axis=0)
    U, D, Vt = np.linalg.svd(y.T @ x)
    S = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = (U * S) @ Vt
    spread = float(np.sum(x**2))
    # Points all paired with one node would have scale 0, by which nothing can be divided.
    fitted = max(float(D @ S) / spread, 1e-300) if spread > 0.0 else 1.0
    s = fitted if scale is None else scale
    return Alignment(s, R, targets.mean(axis=0) - s * R @ points.mean(axis=0))


def degrees_of(rotation: Floats) -> float:
    """How far a rotation (3, 3) turns, 0 to 180."""
    return float(np.degrees(np.arccos(np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0))))


def require_spread(points: Floats, whose: str) -> None:
    """Raise ModesError where points (n, 3) fix no rotation."""
    if len(points) < 3:
        raise ModesError(f"{whose} are {len(points)}; a fit takes three or more, not on one line")
    extents = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if extents[1] <= ON_A_LINE * extents[0]:
        raise ModesError(
            f"{whose} lie on one line, which leaves the rotation about it open: it cannot be fitted"
        )
