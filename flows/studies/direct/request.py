"""The request of a direct correction; imports nothing heavy, because the command line reads it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from typer import Option

DirectMethod = Literal["berman", "baruch", "error_matrix"]
#: How unmeasured unknowns are filled.
Filling = Literal["kidder", "static", "serep", "model"]


@dataclass(frozen=True, slots=True)
class DirectRequest:
    """The method of a correction, how it fills shapes, and the scale of the test's shapes."""

    method: Annotated[
        DirectMethod,
        Option(
            help="berman (mass and stiffness), baruch (stiffness alone) or error_matrix "
            "(first order)."
        ),
    ] = "berman"
    filling: Annotated[
        Filling,
        Option(help="How to expand shapes to unmeasured unknowns: kidder, static, serep or model."),
    ] = "kidder"
    mass_normalised: Annotated[
        bool,
        Option(
            "--mass-normalised",
            help="The test's shapes have unit modal mass in the model's units.",
        ),
    ] = False
