"""Where to excite a structure and where to hang it, for a pretest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modetune.core.correlation.pairing import CLUSTER
from modetune.core.errors import CampaignError
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats, ModeSet
from modetune.core.planning.exciter_placement import (
    choose_exciters,
    choose_suspension,
    participation,
    rigid_mass,
)
from modetune.core.planning.sensor_placement import Spacing
from modetune.flows.campaign.units import KILOGRAMS, Units
from modetune.flows.studies.pretest.candidate_sensors import CandidateSensors

#: A mode of which the exciters reach less than this share of its largest motion is hardly driven.
DRIVEN = 0.1
#: Number of suspension points, and their distance in box diagonals of the model.
POINTS, APART = 4, 0.1


@dataclass(frozen=True, slots=True)
class PlacedExciter:
    """A chosen exciter. direction: unit vector, global axes.

    shares: (n_modes,), of each mode's largest motion at the candidates. rigid_kg: the mass it
    pushes as long as the structure moves as a rigid body, None of a structure that is held.
    """

    node: int
    label: str
    place: tuple[float, float, float]
    direction: tuple[float, float, float]
    shares: tuple[float, ...]
    rigid_kg: float | None


@dataclass(frozen=True, slots=True)
class SuspensionPoint:
    """A node that moves little. share: of the largest motion of the mode that moves it most."""

    node: int
    place: tuple[float, float, float]
    share: float


def place_exciters(
    candidates: CandidateSensors, rows: Floats, rigid: Floats, count: int, units: Units
) -> tuple[PlacedExciter, ...]:
    """The exciters that drive all modes best.

    rows: (n, n_directions, n_modes), rigid: (n, n_directions, n_rigid), mass-normalised. An
    exciter pushes along one direction, also where three make one sensor. Raises CampaignError.
    """
    n_directions, n_modes = rows.shape[1:]
    shapes = rows.reshape(-1, n_modes)
    if count > shapes.shape[0]:
        raise CampaignError(
            f"--exciters {count}: there are {shapes.shape[0]} candidates; ask for fewer"
        )
    if count == 0:
        return ()
    shares = participation(shapes)
    masses = rigid_mass(rigid.reshape(shapes.shape[0], rigid.shape[2])) * KILOGRAMS[units]
    found = []
    for place in choose_exciters(shapes, count).tolist():
        row, way = divmod(place, n_directions)
        label = candidates.labels[row]
        x, y, z = candidates.coordinates[row].tolist()
        a, b, c = candidates.directions[row, way].tolist()
        found.append(
            PlacedExciter(
                int(candidates.nodes[row]),
                label if n_directions == 1 else label[way],
                (x, y, z),
                (a, b, c),
                tuple(shares[place].tolist()),
                float(masses[place]) if np.isfinite(masses[place]) else None,
            )
        )
    return tuple(found)


def suspension_points(
    candidates: CandidateSensors, modes: ModeSet, mesh: Mesh, n_rigid: int
) -> tuple[SuspensionPoint, ...]:
    """Nodes at which a free structure is best held; none for one that is held already."""
    if n_rigid == 0:
        return ()
    nodes, places, motion = candidates.motion(modes, mesh)
    size = float(np.linalg.norm(np.ptp(places, axis=0)))
    chosen, shares = choose_suspension(motion, POINTS, Spacing(nodes, places, APART * size))
    points = []
    for row, share in zip(chosen.tolist(), shares.tolist(), strict=True):
        x, y, z = places[row].tolist()
        points.append(SuspensionPoint(int(nodes[row]), (x, y, z), share))
    return tuple(points)


def excitation_notes(
    exciters: tuple[PlacedExciter, ...], numbers: tuple[int, ...], frequencies_hz: Floats
) -> list[str]:
    """What the exciters cannot do."""
    if not exciters:
        return []
    best = np.max([item.shares for item in exciters], axis=0)
    notes = [
        f"mode {numbers[place]} is hardly driven: the exciters reach {100 * best[place]:.0f} % of "
        "its largest motion; add one with --exciters"
        for place in np.flatnonzero(best < DRIVEN).tolist()
    ]
    gaps = np.diff(frequencies_hz) / frequencies_hz[:-1]
    close = np.flatnonzero(gaps < CLUSTER).tolist()
    if close and len(exciters) == 1:
        first, second = numbers[close[0]], numbers[close[0] + 1]
        notes.append(
            f"modes {first} and {second} are {100 * gaps[close[0]]:.2g} % apart in frequency: "
            "shapes of such close modes are separated by two exciters, not by one"
        )
    return notes
