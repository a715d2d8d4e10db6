"""Choosing sensors by the asked method, and saying what each is for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from modetune.core.errors import CampaignError
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats, Integers, ModeSet
from modetune.core.planning.sensor_placement import (
    ALIKE,
    Quality,
    Spacing,
    by_auto_mac,
    by_effective_independence,
    by_information,
    by_kinetic_energy,
    independence,
    judge,
    kinetic_energies,
    needed_sensors,
    with_modes,
)
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.studies.pretest.candidate_sensors import CandidateSensors
from modetune.flows.studies.pretest.information import Information
from modetune.flows.studies.pretest.request import PlacementMethod, PretestSettings


def check_settings(settings: PretestSettings) -> None:
    """Raise CampaignError with all that cannot be."""
    problems = []
    if settings.sensors is not None and settings.sensors < 1:
        problems.append(f"--sensors {settings.sensors}: expected one or more")
    if settings.exciters < 0:
        problems.append(f"--exciters {settings.exciters}: expected none or more")
    if settings.distance is not None and not 0.0 <= settings.distance < np.inf:
        problems.append(f"--distance {settings.distance:g}: expected a length, or 0 for none")
    if problems:
        raise CampaignError(problems)
    if settings.sensors is not None:
        check_count(settings.sensors, len(settings.modes), 3 if settings.triaxial else 1)


def check_count(sensors: int, n_modes: int, n_directions: int) -> None:
    """Raise CampaignError where there are too few sensors to distinguish the modes."""
    if sensors * n_directions < n_modes:
        raise CampaignError(
            f"--sensors {sensors}: too few to distinguish {n_modes} modes, wherever they are; "
            "use at least as many sensors as modes"
        )


#: Distance between sensors where none is given, of the model's box diagonal.
DISTANCE = 0.05
#: A distance that was not asked for is halved so often where it leaves too few places.
HALVINGS = 6


@dataclass(frozen=True, slots=True)
class PlacedSensor:
    """A chosen sensor. frame: (n_directions, 3), what it measures along, global axes.

    contribution: what is lost without it, by the method (see docs/pretest.md); reason: in words.
    """

    node: int
    label: str
    place: tuple[float, float, float]
    frame: tuple[tuple[float, float, float], ...]
    contribution: float
    reason: str


@dataclass(frozen=True, slots=True)
class Ground:
    """What is chosen from.

    modes: those that the sensors must distinguish; rows: their shapes (n, n_directions, n_modes)
    at the candidates; weighted: by the root of the mass, where that is asked for.
    """

    modes: ModeSet
    mesh: Mesh
    candidates: CandidateSensors
    rows: Floats
    weighted: Floats
    information: Information | None


def choose_sensors(
    model: Ground, settings: PretestSettings, count: int
) -> tuple[Integers, Spacing, list[str]]:
    """Return the chosen candidates, the most useful first, the spacing, and notes."""
    distance = settings.distance
    if distance is not None:
        spacing = model.candidates.spacing(distance)
        return _by_method(model, settings.method, count, spacing), spacing, []
    size = float(np.linalg.norm(np.ptp(model.candidates.coordinates, axis=0)))
    for halving in range(HALVINGS):
        spacing = model.candidates.spacing(DISTANCE * size / 2**halving)
        try:
            chosen = _by_method(model, settings.method, count, spacing)
        except CampaignError:
            continue  # too few places at the default distance
        text = f"there is room only for a distance of {spacing.distance:.3g} between sensors"
        return chosen, spacing, [text] if halving else []
    spacing = model.candidates.spacing(0.0)
    return _by_method(model, settings.method, count, spacing), spacing, []


def _by_method(model: Ground, method: PlacementMethod, count: int, spacing: Spacing) -> Integers:
    if method == "auto_mac":
        return by_auto_mac(model.rows, count, spacing)
    if method == "kinetic_energy":
        return by_kinetic_energy(model.weighted, count, spacing)
    if method == "information":
        assert model.information is not None
        found = model.information
        joint, base = with_modes(found.matrices, found.base, model.rows)
        return by_information(joint, base, count, spacing)
    return by_effective_independence(model.weighted, count, spacing)


def needed_number(model: Ground, spacing: Spacing, count: int) -> int | None:
    """How many sensors of effective independence keep the modes apart, None where none do."""
    kept = spacing.thinned(independence(model.rows))
    return needed_sensors(model.rows[kept], count) if kept.size > count else None


def likeness(
    model: Ground, quality: Quality, numbers: tuple[int, ...], count: int, needed: int | None
) -> str:
    """Return the modes that the sensors can hardly distinguish, with a remedy."""
    first, second = (numbers[place] for place in quality.pair)
    text = (
        f"these {count} sensors can hardly distinguish modes {first} and {second}: auto-MAC "
        f"{quality.largest:.2f}, above {ALIKE}"
    )
    if needed is not None:
        return f"{text}; {needed} sensors by effective independence are enough"
    whole = judge(model.rows, np.arange(model.candidates.n))
    return (
        f"{text}; more sensors of effective independence do not help ({whole.largest:.2f} with all "
        f"{model.candidates.n} candidates): try --method auto_mac, more candidates, more "
        "directions, or a smaller --distance"
    )


def placed_sensors(
    campaign: Campaign,
    settings: PretestSettings,
    model: Ground,
    chosen: Integers,
    numbers: tuple[int, ...],
) -> tuple[PlacedSensor, ...]:
    """The chosen sensors with what each is worth."""
    contributions, reasons = _why(campaign, settings.method, model, chosen, numbers)
    taken = model.candidates.take(chosen)
    return tuple(
        PlacedSensor(
            node,
            taken.labels[row],
            tuple(taken.coordinates[row].tolist()),
            tuple(map(tuple, taken.directions[row].tolist())),
            float(contributions[row]),
            reasons[row],
        )
        for row, node in enumerate(taken.nodes.tolist())
    )


def _why(
    campaign: Campaign,
    method: PlacementMethod,
    model: Ground,
    chosen: Integers,
    numbers: tuple[int, ...],
) -> tuple[Floats, list[str]]:
    """What each chosen sensor is worth by the method, and in words."""
    if model.information is not None:
        lost, hit = model.information.lost(chosen)
        names = campaign.parameters.names
        return lost, [f"determines {names[place]}" for place in hit.tolist()]
    shares = kinetic_energies(model.rows[chosen])
    reasons = [
        f"sees mode {numbers[place]} ({100 * shares[row, place]:.0f} %)"
        for row, place in enumerate(np.argmax(shares, axis=1).tolist())
    ]
    if method == "kinetic_energy":
        return kinetic_energies(model.weighted)[chosen].mean(axis=1), reasons
    if method == "effective_independence":
        return independence(model.weighted[chosen]), reasons
    largest = judge(model.rows, chosen).largest
    rises = [
        judge(model.rows, np.delete(chosen, place)).largest - largest
        for place in range(chosen.size)
    ]
    return np.array(rises), reasons
