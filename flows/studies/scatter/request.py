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
        Option(
            help="Parameter that differs from test to test; the others are the same in all tests."
        ),
    ] = ()
    measurement_deviation: Annotated[
        float | None,
        Option(
            help="Relative scatter of a frequency due to measurement alone; default: "
            "estimated from the tests if there are more frequencies than parameters, "
            "otherwise zero."
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
