"""The request of a correlation; imports nothing heavy, because the command line reads it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from typer import Option

from modetune.flows.studies.study import ModelState

#: How a mass matrix is reduced to the sensors.
MassReduction = Literal["guyan", "serep"]


@dataclass(frozen=True, slots=True)
class CorrelationRequest:
    """Which model of a record is compared, and how a mass matrix is reduced to its sensors."""

    state: Annotated[ModelState, Option(help="Model of a record: updated or initial.")] = "updated"
    orthogonality: Annotated[
        MassReduction | None,
        Option(help="Cross-orthogonality, with a mass matrix reduced by guyan or serep."),
    ] = None
