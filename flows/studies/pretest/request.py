"""The request of a pretest; imports nothing heavy, because the command line reads it."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Annotated, Literal

from typer import Option

from modetune.core.errors import CampaignError
from modetune.flows.studies.study import FILE_OR_WORDS

PlacementMethod = Literal["effective_independence", "auto_mac", "kinetic_energy", "information"]
Directions = Literal["xyz", "normal"]


def parse_modes(text: str) -> tuple[int, ...]:
    """Return the numbers of `1-8` or `1,3,5-7`, ascending, none of an empty text.

    Raises CampaignError.
    """
    numbers: set[int] = set()
    for part in text.split(",") if text.strip() else []:
        found = re.fullmatch(r"\s*([1-9][0-9]{0,3})(?:\s*-\s*([1-9][0-9]{0,3}))?\s*", part)
        if found is None or int(found[2] or found[1]) < int(found[1]):
            raise CampaignError(
                f"--modes {text!r}: expected numbers of elastic modes from 1, as in 1-8 or 1,3,5-7"
            )
        numbers.update(range(int(found[1]), int(found[2] or found[1]) + 1))
    return tuple(sorted(numbers))


@dataclass(frozen=True, slots=True)
class PretestSettings:
    """The modes that a test must separate, and the candidate positions of sensors and exciters.

    modes: numbers of elastic modes, from 1; distance: between sensors at different nodes; by_mass:
    whether shapes are weighted by the root of the mass at each candidate.
    """

    modes: Annotated[
        tuple[int, ...],
        Option(help="Elastic modes, as 1-8 or 1,3,5-7; default: the first eight."),
        parse_modes,
    ] = ()
    sensors: Annotated[
        int | None, Option(help="Number of sensors; default: twice the number of modes.")
    ] = None
    method: Annotated[
        PlacementMethod,
        Option(help="effective_independence, auto_mac, kinetic_energy or information."),
    ] = "effective_independence"
    candidates: Annotated[
        str,
        Option(
            help="Candidate nodes: surface, all, or a file whose lines begin with a node number."
        ),
        FILE_OR_WORDS,
    ] = "surface"
    directions: Annotated[Directions, Option(help="Directions: xyz, or normal to the surface.")] = (
        "xyz"
    )
    triaxial: Annotated[
        bool, Option("--triaxial", help="Count three directions at a node as one sensor.")
    ] = False
    distance: Annotated[
        float | None,
        Option(
            help="Minimum distance between sensors, in the deck's length unit; default: 5 % of "
            "the structure."
        ),
    ] = None
    exciters: Annotated[int, Option(help="Number of exciters.")] = 1
    by_mass: Annotated[
        bool, Option("--mass", help="Weight shapes by the mass at each candidate.")
    ] = False
