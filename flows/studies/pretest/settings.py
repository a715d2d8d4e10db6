"""What is asked of a pretest."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np

from modetune.core.errors import CampaignError
from modetune.flows.studies.pretest.candidates import Directions

Method = Literal["effective_independence", "auto_mac", "kinetic_energy", "information"]


@dataclass(frozen=True, slots=True)
class PretestSettings:
    """What is asked of a pretest.

    modes: numbers of elastic modes, from 1; empty: the first eight. sensors: how many; None: twice
    as many as modes. candidates: surface, all, or a file of node numbers. distance: between
    sensors at different nodes, the deck's length; None: 5 % of the model's box diagonal.
    by_mass: whether shapes are weighted by the root of the mass at each candidate.
    """

    modes: tuple[int, ...] = ()
    sensors: int | None = None
    method: Method = "effective_independence"
    candidates: str = "surface"
    directions: Directions = "xyz"
    triaxial: bool = False
    distance: float | None = None
    exciters: int = 1
    by_mass: bool = False


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
    """Raise CampaignError where so few sensors cannot tell so many modes apart, wherever."""
    if sensors * n_directions < n_modes:
        raise CampaignError(
            f"--sensors {sensors}: fewer than the {n_modes} modes, which so few cannot tell apart "
            "whatever their places; ask for at least as many sensors as modes"
        )


def parse_modes(text: str) -> tuple[int, ...]:
    """Numbers of `1-8` or `1,3,5-7`, ascending; of an empty text none. Raises CampaignError."""
    numbers: set[int] = set()
    for part in text.split(",") if text.strip() else []:
        found = re.fullmatch(r"\s*([1-9][0-9]{0,3})(?:\s*-\s*([1-9][0-9]{0,3}))?\s*", part)
        if found is None or int(found[2] or found[1]) < int(found[1]):
            raise CampaignError(
                f"--modes {text!r}: expected numbers of elastic modes from 1, as in 1-8 or 1,3,5-7"
            )
        numbers.update(range(int(found[1]), int(found[2] or found[1]) + 1))
    return tuple(sorted(numbers))
