"""The request of a screening; imports nothing heavy, because the command line reads it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from typer import Option

ScreeningMethod = Literal["local", "morris", "sobol", "lhs"]


@dataclass(frozen=True, slots=True)
class ScreeningRequest:
    """The method of a screening, its points, and how many parameters it proposes."""

    method: Annotated[ScreeningMethod, Option(help="local, morris, sobol or lhs.")] = "local"
    points: Annotated[
        int | None,
        Option(help="Maximum number of points of the design; default: about ten per parameter."),
    ] = None
    seed: Annotated[int, Option(min=0, help="Seed of the design's random numbers.")] = 1
    levels: Annotated[
        int | None,
        Option(help="Number of levels per parameter for morris, an even number; default: 4."),
    ] = None
    choose: Annotated[int | None, Option(min=1, help="Number of parameters to propose.")] = None
