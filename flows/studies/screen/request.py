"""The request of a screening; imports nothing heavy, because the command line reads it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from typer import Option

ScreeningMethod = Literal["local", "morris", "sobol", "lhs", "factorial"]


@dataclass(frozen=True, slots=True)
class ScreeningRequest:
    """The method of a screening, its points, and how many parameters it proposes."""

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
