"""The request of a scatter study; imports nothing heavy, because the command line reads it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from typer import Option

from modetune.core.near_names import suggestion
from modetune.flows.studies.sample.request import SeedOfAll, SetsOverRange


@dataclass(frozen=True, slots=True)
class ScatterRequest:
    """The parameters that scatter (of: all where empty) and the scatter of the measurement."""

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
