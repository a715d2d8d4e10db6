"""What is asked of studies: fields of the Python API that are options of the command line too.

Nothing heavy is imported, for the command line reads these to say what it takes. A function beside
an option reads the text that is typed.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from typer import Option

from modetune.core.errors import CampaignError
from modetune.core.near_names import suggestion

ScreeningMethod = Literal["local", "morris", "sobol", "lhs", "factorial"]
ReductionMethod = Literal["guyan", "irs", "iterated_irs", "serep", "craig_bampton"]
PlacementMethod = Literal["effective_independence", "auto_mac", "kinetic_energy", "information"]
Directions = Literal["xyz", "normal"]
ExpansionMethod = Literal["serep", "kidder", "static", "irs", "spline"]
DirectMethod = Literal["berman", "baruch", "error_matrix"]
#: How unmeasured unknowns are filled.
Filling = Literal["kidder", "static", "serep", "model"]
#: How a mass matrix is reduced to the sensors.
MassReduction = Literal["guyan", "serep"]
#: Which model of a record.
ModelState = Literal["updated", "initial"]
SetsOverRange = Annotated[
    int | None, Option(help="Sets over the range; as many may follow near the posterior.")
]
SeedOfAll = Annotated[int, Option(help="Seed of all random numbers.")]
#: More of anything than this is a slip of the hand.
MOST = 100_000
#: Marks an option whose text is either words or the name of a file.
FILE_OR_WORDS = "file or words"


def is_file(text: str) -> bool:
    """Whether a text names a file; a list of words may be too long for a name."""
    try:
        return Path(text).is_file()
    except OSError:
        return False


@dataclass(frozen=True, slots=True)
class ScreeningRequest:
    """What is asked of a screening."""

    method: Annotated[ScreeningMethod, Option(help="local, morris, sobol, lhs or factorial.")] = (
        "local"
    )
    points: Annotated[
        int | None, Option(help="Points of the design at most; about ten a parameter.")
    ] = None
    seed: Annotated[int, Option(min=0, help="Of the design's random numbers.")] = 1
    levels: Annotated[
        int | None, Option(help="Of each parameter: morris (even, 4), factorial (2).")
    ] = None
    choose: Annotated[int | None, Option(min=1, help="How many parameters to propose.")] = None


@dataclass(frozen=True, slots=True)
class SamplingRequest:
    """What is asked of a sampling.

    None: by the number of parameters, of checks by what gives the samples; twice as many sets as
    over the range may follow near the posterior where nobody says how many.
    """

    points: SetsOverRange = None
    walkers: Annotated[int | None, Option(help="Walkers of the sampler.")] = None
    steps: Annotated[int, Option(help="Steps of a walker; more follow if needed.")] = 2000
    seed: SeedOfAll = 1
    checks: Annotated[
        int | None,
        Option(help="Sets of the posterior that are solved for: 8, 2 with a reduced model."),
    ] = None

    def problems(self, n_parameters: int) -> list[str]:
        """What is unavailable, a sentence each."""
        least = n_parameters + 3
        asked = (
            ("--points", self.points, least), ("--steps", self.steps, 100),
            ("--checks", self.checks, 0), ("--seed", self.seed, 0),
        )  # fmt: skip
        return [
            f"{name} {value}: expected {low} to {MOST}"
            for name, value, low in asked
            if value is not None and not low <= value <= MOST
        ]


@dataclass(frozen=True, slots=True)
class ScatterRequest:
    """What is asked of the scatter of parameters; of: all of them where empty."""

    of: Annotated[
        tuple[str, ...],
        Option(help="A parameter that differs from test to test; others are the same in all."),
    ] = ()
    measurement_deviation: Annotated[
        float | None,
        Option(
            help="Scatter of a frequency by the measurement alone, relative; else the tests tell "
            "it where there are more frequencies than parameters, or it is taken as none."
        ),
    ] = None
    points: SetsOverRange = None
    seed: SeedOfAll = 1

    def problems(self, names: tuple[str, ...]) -> list[str]:
        """What is unavailable, a sentence each."""
        found = [
            f"--of {name}: the campaign has no such parameter{suggestion(name, names)}"
            for name in self.of
            if name not in names
        ]
        deviation = self.measurement_deviation
        if deviation is not None and not 0.0 <= deviation < 1.0:
            found.append(
                f"--measurement-deviation {deviation:g}: expected 0 or more and less than 1, "
                "relative to the frequency"
            )
        return found


@dataclass(frozen=True, slots=True)
class ReductionRequest:
    """What is asked of a reduction; modes: as many as fit where None."""

    method: Annotated[
        ReductionMethod, Option(help="guyan, irs, iterated_irs, serep or craig_bampton.")
    ] = "guyan"
    masters: Annotated[
        str,
        Option(
            help="Unknowns that are kept: 12.z,13,20-25.xyz, or a file with them; default: the "
            "test's sensors."
        ),
        FILE_OR_WORDS,
    ] = ""
    modes: Annotated[
        int | None,
        Option(min=1, help="Modes that are compared, and that SEREP keeps or Craig-Bampton adds."),
    ] = None


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


@dataclass(frozen=True, slots=True)
class PretestSettings:
    """What is asked of a pretest.

    modes: numbers of elastic modes, from 1; distance: between sensors at different nodes; by_mass:
    whether shapes are weighted by the root of the mass at each candidate.
    """

    modes: Annotated[
        tuple[int, ...],
        Option(help="Elastic modes, as 1-8 or 1,3,5-7; default: the first eight."),
        parse_modes,
    ] = ()
    sensors: Annotated[int | None, Option(help="How many; default: twice as many as modes.")] = None
    method: Annotated[
        PlacementMethod,
        Option(help="effective_independence, auto_mac, kinetic_energy or information."),
    ] = "effective_independence"
    candidates: Annotated[
        str,
        Option(help="surface, all, or a file with a node number in front of each line."),
        FILE_OR_WORDS,
    ] = "surface"
    directions: Annotated[Directions, Option(help="xyz, or normal: out of the surface.")] = "xyz"
    triaxial: Annotated[
        bool, Option("--triaxial", help="Three directions at a place are one sensor.")
    ] = False
    distance: Annotated[
        float | None,
        Option(help="Least distance of sensors, the deck's length; default: 5 % of the structure."),
    ] = None
    exciters: Annotated[int, Option(help="How many exciters.")] = 1
    by_mass: Annotated[
        bool, Option("--mass", help="Weight shapes by the mass at each candidate.")
    ] = False
