"""The record of a screening, screening.h5: everything from which its tables and figures follow.

The file is the dataclass Screening below as `core/storage/codec` writes it, behind a seal: single
values are attributes, arrays datasets, dataclasses groups, each by the name of its field.

Groups: design, responses, local, indices (not for `local`), choice, reduced_model (where points
were found by one), runs. A group of what a screening does not have is not there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import h5py

from modetune.core.brief import brief
from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, mode_name
from modetune.core.storage.campaign_record import RunCounts
from modetune.core.storage.sealed_file import RecordFile
from modetune.core.updating.reduced_basis import RangeUse
from modetune.flows.studies.screen.choice import ChosenParameters
from modetune.flows.studies.screen.design import Design
from modetune.flows.studies.screen.indices import Indices
from modetune.flows.studies.screen.sensitivity import LocalSensitivity


@dataclass(frozen=True, slots=True)
class Responses:
    """What the points gave.

    frequencies_hz, mac: (n_points, n_modes), of the modes paired with the test's; NaN where a
    point failed, mac without columns where no shape was measured. others: (n_points, n_others), of
    other kinds of response what is measured minus computed, in standard deviations of the test;
    other_kinds, other_names: of which kind each is, and of what. failures: a sentence a point,
    empty where it is good. keys: of the modal jobs.
    """

    frequencies_hz: Floats
    mac: Floats
    failures: tuple[str, ...]
    keys: tuple[str, ...]
    others: Floats
    other_kinds: tuple[str, ...]
    other_names: tuple[str, ...]

    @property
    def n_failed(self) -> int:
        return sum(bool(text) for text in self.failures)


@dataclass(frozen=True, slots=True, repr=False)
class Screening:
    """A screening from its design to its choice.

    names, deviations: of the parameters; numbers: of the used modes; test_hz, nominal_hz,
    nominal_mac: (n_modes,), of the pairs at the deck's values. indices: None for `local`.
    importance: (n_parameters,). wanted: how many parameters were asked for, 0 where the choice
    was free. reduced_model: by which the points were found, None where each took a run.
    configurations: whose test each mode is of, empty where the campaign has one model.
    """

    name: str
    seed: int
    solver: str
    solver_version: str
    units: str
    campaign_text: str
    names: tuple[str, ...]
    deviations: Floats
    numbers: tuple[int, ...]
    test_hz: Floats
    nominal_hz: Floats
    nominal_mac: Floats
    design: Design
    responses: Responses
    local: LocalSensitivity
    indices: Indices | None
    importance: Floats
    choice: ChosenParameters
    runs: RunCounts = field(default_factory=RunCounts)
    wall_s: float = 0.0
    wanted: int = 0
    reduced_model: RangeUse | None = None
    configurations: tuple[str, ...] = ()

    __repr__ = brief

    @property
    def points_by(self) -> str:
        """How the points' modes were found, where not each took a run of the solver."""
        return self.reduced_model.sentence if self.reduced_model else ""

    @property
    def modes(self) -> tuple[str, ...]:
        """Names of the used modes for people."""
        return mode_names(self.numbers, self.configurations)

    @property
    def response_names(self) -> tuple[str, ...]:
        """Of the rows of the indices: frequencies of all modes, their MAC, then the others."""
        modes = [name.removeprefix("mode ") for name in self.modes]
        frequencies = tuple(f"frequency {name}" for name in modes)
        macs = tuple(f"MAC {name}" for name in modes)
        found = self.responses
        return frequencies + (macs if found.mac.shape[1] else ()) + found.other_names


def mode_names(numbers: Sequence[int], configurations: Sequence[str]) -> tuple[str, ...]:
    """Modes as people call them; configurations: of each, empty where there is one."""
    return tuple(map(mode_name, numbers, configurations or [""] * len(numbers)))


def _without_interactions(file: h5py.File) -> None:
    """Change the content of format 6 into that of 7, which has no factorials. Raises CampaignError
    for one of these."""
    if file["design"].attrs["method"] == "factorial":
        raise CampaignError("factorial screenings were removed; screen with morris or sobol")
    if "indices" in file:
        del file["indices/interactions"]


SCREENING = RecordFile(Screening, "screening", "screening.h5", 7, {6: _without_interactions})
