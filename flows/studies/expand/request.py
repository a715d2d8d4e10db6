"""The request of an expansion; imports nothing heavy, because the command line reads it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from typer import Option

ExpansionMethod = Literal["serep", "kidder", "static", "irs", "spline"]


@dataclass(frozen=True, slots=True)
class ExpansionRequest:
    """The method of an expansion, all where None, and the modes of SEREP's basis."""

    method: Annotated[
        ExpansionMethod | None,
        Option(
            help="serep, kidder, static, irs or spline; default: all, and --out writes the "
            "one with the smallest error at held-out sensors."
        ),
    ] = None
    modes: Annotated[
        int | None,
        Option(
            min=1, help="Number of elastic modes in SEREP's basis; default: chosen automatically."
        ),
    ] = None
