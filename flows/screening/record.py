"""The record of a screening: everything from which its tables and figures follow.

/                     attributes: name, method, seed, solver, solver_version, units, wall_s, wanted,
                      runs_modal, runs_sensitivity, runs_reused, campaign (text of the file)
parameters/           names, lower, upper, deviations (n_parameters,)
modes/                numbers, test_hz, nominal_hz, nominal_mac (n_modes,)
design/               points (n_points, n_parameters), blocks, failures (text, empty where
                      good), keys of the jobs (n_points,); attribute levels
responses/            frequencies_hz, mac (n_points, n_modes), NaN where a point failed; mac
                      without columns where no shape was measured
local/                frequencies: (df/f) / (dp/p) (n_modes, n_parameters), mac likewise where
                      shapes are compared, weighted (n_residuals, n_parameters),
                      weighted_residual, methods, missing (text)
indices/              one dataset a measure (n_responses, n_parameters), moves, explained,
                      interactions, interaction_shares; attribute used. Not for `local`.
choice/               importance, verdicts: names, ranks, reasons; ranking, misfits, groups
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import h5py
import numpy as np

from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, Integers
from modetune.core.record import RunCounts
from modetune.core.store import writing
from modetune.flows.screening.choice import Choice, Verdict
from modetune.flows.screening.design import METHODS, Design, Method
from modetune.flows.screening.indices import Indices

FORMAT = 1
FILE = "screening.h5"
UNREADABLE = (OSError, KeyError, IndexError, TypeError, ValueError, RuntimeError, AttributeError)


@dataclass(frozen=True, slots=True)
class LocalSensitivity:
    """Sensitivities at the deck's values.

    frequencies: (n_modes, n_parameters), (df/f) / (dp/p). mac: likewise dMAC / (dp/p), without
    rows where shapes are not compared. weighted, weighted_residual: as `core/subset.py` wants
    them. methods: how each column was computed; missing: why a column could not be had, or empty.
    """

    frequencies: Floats
    mac: Floats
    weighted: Floats
    weighted_residual: Floats
    methods: tuple[str, ...]
    missing: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Responses:
    """What the points gave.

    frequencies_hz, mac: (n_points, n_modes), of the modes paired with the test's; NaN where a
    point failed, mac without columns where no shape was measured. failures: a sentence a point,
    empty where it is good. keys: of the modal jobs.
    """

    frequencies_hz: Floats
    mac: Floats
    failures: tuple[str, ...]
    keys: tuple[str, ...]

    @property
    def n_failed(self) -> int:
        return sum(bool(said) for said in self.failures)


@dataclass(frozen=True, slots=True)
class Screening:
    """A screening from its design to its choice.

    names, deviations: of the parameters; numbers: of the used modes; test_hz, nominal_hz,
    nominal_mac: (n_modes,), of the pairs at the deck's values. indices: None for `local`.
    importance: (n_parameters,). wanted: how many parameters were asked for, 0 where the choice
    was free.
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
    choice: Choice
    runs: RunCounts = field(default_factory=RunCounts)
    wall_s: float = 0.0
    wanted: int = 0

    @property
    def response_names(self) -> tuple[str, ...]:
        """Of the rows of the indices: frequencies of all modes, then their MAC."""
        frequencies = tuple(f"frequency {number}" for number in self.numbers)
        macs = tuple(f"MAC {number}" for number in self.numbers)
        return frequencies + (macs if self.responses.mac.shape[1] else ())


#: Fields that are plain attributes of the file.
TEXTS = ("name", "seed", "solver", "solver_version", "units", "wall_s", "wanted")


def write_screening(path: Path, screening: Screening) -> None:
    """Write the record whole or not at all. Raises StorageUnavailable."""
    design, responses, local = screening.design, screening.responses, screening.local
    with writing(path) as part, h5py.File(part, "w") as file:
        file.attrs.update({name: getattr(screening, name) for name in TEXTS})
        file.attrs.update(format=FORMAT, method=design.method, campaign=screening.campaign_text)
        runs = screening.runs
        file.attrs.update(runs_modal=runs.modal, runs_sensitivity=runs.sensitivity,
                          runs_reused=runs.reused, core_s=runs.core_s)  # fmt: skip
        _put(file, "parameters", names=screening.names, lower=design.lower, upper=design.upper,
             deviations=screening.deviations)  # fmt: skip
        _put(file, "modes", numbers=np.array(screening.numbers), test_hz=screening.test_hz,
             nominal_hz=screening.nominal_hz, nominal_mac=screening.nominal_mac)  # fmt: skip
        _put(file, "design", points=design.points, blocks=design.blocks,
             failures=responses.failures, keys=responses.keys)  # fmt: skip
        file["design"].attrs["levels"] = design.levels
        _put(file, "responses", frequencies_hz=responses.frequencies_hz, mac=responses.mac)
        _put(file, "local", frequencies=local.frequencies, mac=local.mac, weighted=local.weighted,
             weighted_residual=local.weighted_residual, methods=local.methods,
             missing=local.missing)  # fmt: skip
        if (found := screening.indices) is not None:
            measures = dict(zip(found.measures, found.values, strict=True))
            _put(file, "indices", moves=found.moves, explained=found.explained,
                 interactions=found.interactions, interaction_shares=found.interaction_shares,
                 **measures)  # fmt: skip
            file["indices"].attrs.update(used=found.used, measures=list(found.measures))
        choice = screening.choice
        _put(file, "choice", importance=screening.importance,
             names=tuple(item.name for item in choice.verdicts),
             ranks=np.array([item.rank for item in choice.verdicts]),
             reasons=tuple(item.reason for item in choice.verdicts),
             ranking=np.array(choice.ranking), misfits=np.array(choice.misfits),
             groups=tuple(" ".join(map(str, group)) for group in choice.groups))  # fmt: skip


def read_screening(path: Path) -> Screening:
    """The record as it was written. Raises CampaignError."""
    try:
        with h5py.File(path, "r") as file:
            if int(file.attrs["format"]) > FORMAT:
                raise CampaignError(f"{path} was written by a newer modetune; install that version")
            return _read(file)
    except UNREADABLE as error:
        raise CampaignError(f"{path} is no record of a screening: {error}") from error


def _put(file: h5py.File, name: str, **columns: Floats | Integers | tuple[str, ...]) -> None:
    group = file.create_group(name)
    for key, value in columns.items():
        if isinstance(value, tuple):
            group.create_dataset(key, data=list(value), dtype=h5py.string_dtype())
        else:
            group[key] = value


def _texts(group: h5py.Group, name: str) -> tuple[str, ...]:
    return tuple(str(text) for text in group[name].asstr()[()])


def _read(file: h5py.File) -> Screening:
    attrs, local, parameters, modes = file.attrs, file["local"], file["parameters"], file["modes"]
    method = next(name for name in METHODS if name == attrs["method"])
    return Screening(
        name=str(attrs["name"]),
        seed=int(attrs["seed"]),
        solver=str(attrs["solver"]),
        solver_version=str(attrs["solver_version"]),
        units=str(attrs["units"]),
        campaign_text=str(attrs["campaign"]),
        names=_texts(parameters, "names"),
        deviations=parameters["deviations"][()],
        numbers=tuple(modes["numbers"][()].tolist()),
        test_hz=modes["test_hz"][()],
        nominal_hz=modes["nominal_hz"][()],
        nominal_mac=modes["nominal_mac"][()],
        design=_read_design(file, method),
        responses=Responses(
            file["responses/frequencies_hz"][()],
            file["responses/mac"][()],
            _texts(file["design"], "failures"),
            _texts(file["design"], "keys"),
        ),
        local=LocalSensitivity(
            *(local[n][()] for n in ("frequencies", "mac", "weighted", "weighted_residual")),
            *(_texts(local, n) for n in ("methods", "missing")),
        ),
        indices=_read_indices(file["indices"]) if "indices" in file else None,
        importance=file["choice/importance"][()],
        choice=_read_choice(file["choice"]),
        runs=RunCounts(
            int(attrs["runs_modal"]),
            int(attrs["runs_sensitivity"]),
            int(attrs["runs_reused"]),
            float(attrs["core_s"]),
        ),
        wall_s=float(attrs["wall_s"]),
        wanted=int(attrs.get("wanted", 0)),
    )


def _read_design(file: h5py.File, method: Method) -> Design:
    design, parameters = file["design"], file["parameters"]
    return Design(
        method=method,
        points=design["points"][()],
        blocks=design["blocks"][()],
        lower=parameters["lower"][()],
        upper=parameters["upper"][()],
        levels=int(design.attrs["levels"]),
    )


def _read_indices(group: h5py.Group) -> Indices:
    measures = tuple(str(name) for name in group.attrs["measures"])
    return Indices(
        measures=measures,
        values=np.stack([group[name][()] for name in measures]),
        moves=group["moves"][()],
        explained=group["explained"][()],
        interactions=group["interactions"][()],
        interaction_shares=group["interaction_shares"][()],
        used=int(group.attrs["used"]),
    )


def _read_choice(group: h5py.Group) -> Choice:
    rows = zip(_texts(group, "names"), group["ranks"][()].tolist(), _texts(group, "reasons"),
               strict=True)  # fmt: skip
    groups = tuple(tuple(map(int, text.split())) for text in _texts(group, "groups"))
    return Choice(
        tuple(Verdict(*row) for row in rows), tuple(group["ranking"][()].tolist()), groups,
        tuple(group["misfits"][()].tolist()),
    )  # fmt: skip
