"""A campaign that is drafted for a deck: its model, its test, where the sensors sit, parameters.

The test is tried on the model as it lies, then with a fit, then without the sensors that find no
node; what is written is the first of these that can be read as a campaign.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from modetune.adapters.test_files.measurements import read_measurement
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import Measurement
from modetune.flows.campaign.mapping import Mapping
from modetune.flows.campaign.sketch import DeckSketch, sketch_deck, sketched_campaign
from modetune.flows.studies.identify.identification import (
    IdentificationSettings,
    identify,
    write_modes,
)
from modetune.flows.studies.init.candidate_parameters import Candidate, candidates

#: Settings of `test.sensors` that are tried, and what each means.
POSES: tuple[tuple[dict[str, str], str], ...] = (
    ({}, "the test's axes are taken as the model's; `modetune sensors` shows each sensor's node"),
    ({"align": "fit"}, "rotation and translation were found from the points alone: look at them "
     "with `modetune sensors --picture sensors.png`"),
    ({"unmapped": "leave_out"}, "the test's axes are taken as the model's; some sensors have no "
     "node near them and are left out: look with `modetune sensors --picture sensors.png`"),
    ({"align": "fit", "unmapped": "leave_out"}, "rotation and translation were found from the "
     "points alone, and some sensors have no node near them: look with `modetune sensors`"),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class TestDraft:
    """The test's files as the campaign names them, and how its sensors find their nodes.

    identified: the file of modes that was made from response functions, None where there were
    modes; sensors: the settings of `test.sensors`; about: what these mean; mapping: what they give.
    """

    files: tuple[Path, ...]
    measurement: Measurement
    identified: Path | None
    sensors: dict[str, str]
    about: str
    mapping: Mapping

    @property
    def has_shapes(self) -> bool:
        return self.measurement.modes is not None and self.measurement.modes.has_shapes


@dataclass(frozen=True, slots=True)
class Draft:
    """A campaign that was drafted; path: of its file."""

    path: Path
    sketch: DeckSketch
    test: TestDraft | None
    candidates: tuple[Candidate, ...]

    @property
    def free(self) -> tuple[Candidate, ...]:
        return tuple(item for item in self.candidates if item.free)

    @property
    def next(self) -> tuple[str, ...]:
        """The commands to go on with, each with what it is for."""
        name = os.path.relpath(self.path)
        check = (f"modetune check {name}", "judges model, test and sensors before anything is run")
        if self.test is None:
            more = [(f"modetune modes {name}", "computes the model's modes")]
            more += [(f"modetune pretest {name}", "proposes places for sensors and exciters")]
        else:
            more = [(f"modetune screen {name}", "tells which parameters this test can determine")]
            more += [(f"modetune update {name}", "updates the model")]
        width = max(len(command) for command, _ in (check, *more))
        return tuple(f"{command:{width}}  {what}" for command, what in (check, *more))


def draft_campaign(
    deck: Path, tests: Sequence[Path], settings: Sequence[str], path: Path, force: bool = False
) -> Draft:
    """Draft a campaign for a deck, which is written to a path by `write_draft`.

    Raises CampaignError, ModelError for why there can be none.
    """
    sketch = sketch_deck(deck, settings)
    found = candidates(sketch.solver)
    if not found:
        raise CampaignError(
            f"{deck} has nothing that could be updated: no material, property, spring or mass that "
            f"its elements use has a number of its own for {sketch.name}"
        )
    test = _test(sketch, tests, path.parent, force) if tests else None
    return Draft(path, sketch, test, tuple(found))


def keep(path: Path, force: bool) -> None:
    """Leave a file that is there, unless forced. Raises CampaignError."""
    if path.exists() and not force:
        raise CampaignError(
            f"{path} is there already and stays as it is; name another with --out, or write over "
            "it with --force"
        )


def _test(sketch: DeckSketch, tests: Sequence[Path], folder: Path, force: bool) -> TestDraft:
    """The test, with modes identified where it has response functions alone."""
    measurement, files, identified = read_measurement(tests), tuple(tests), None
    if measurement.modes is None:
        if measurement.frfs is None:
            raise CampaignError(
                f"{', '.join(map(str, tests))}: neither modes nor response functions in it"
            )
        identified = folder / f"{tests[0].stem}-modes.csv"
        keep(identified, force)
        found = identify(measurement.frfs, IdentificationSettings())
        write_modes(identified, found, measurement.geometry, ", ".join(path.name for path in tests))
        files = (identified, *(tests if measurement.geometry is not None else ()))
        measurement = read_measurement(files)
    problems: list[str] = []
    for sensors, about in POSES if measurement.geometry is not None else POSES[::2]:
        named = [f"test.sensors.{key}={value}" for key, value in sensors.items()]
        files_named = f"test.modes={[str(item.resolve()) for item in files]}"
        try:
            mapping = sketched_campaign(sketch, [files_named, *named]).case.mapping
        except CampaignError as error:
            problems += [item for item in error.problems if item not in problems]
            continue
        if mapping.alignment is None:
            about = "sensors are the model's nodes of the same numbers"
        return TestDraft(files, measurement, identified, sensors, about, mapping)
    raise CampaignError([f"the test cannot be laid over {sketch.deck}:", *problems])
