"""What `modetune correlate` compares: campaign files, records and test files as two sides.

A model is compared at the test's sensors: next to a test file, its campaign is read with that test
instead of its own, so that the campaign's settings map the sensors onto the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from scipy import sparse

from modetune.adapters.solver import ModalAnalysis
from modetune.adapters.test_files.measurements import read_measurement
from modetune.core.algebra.eigen import solve_modes
from modetune.core.algebra.factor_room import factor_room
from modetune.core.condensation.reduction import guyan, serep
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.modes import ModeSet, common_dofs
from modetune.core.parameters import Values
from modetune.core.storage.campaign_record import is_record, read_record
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.campaign.sketch import YAML, is_deck, open_model
from modetune.flows.campaign.test import tracking_nodes
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.execution import solve_jobs
from modetune.flows.jobs.job import Job
from modetune.flows.studies.correlate.correlation import (
    Correlation,
    Orthogonality,
    Side,
    correlate,
    orthogonality,
)
from modetune.flows.studies.correlate.request import MassReduction
from modetune.flows.studies.full_model import by_sensors, dof_arrays, full_model
from modetune.flows.updating.baseline import State
from modetune.flows.updating.mode_source import campaign_analysis, parse_values

SourceKind = Literal["campaign", "deck", "record", "test"]
#: Kinds that have a model to be solved.
MODELS = ("campaign", "deck")


@dataclass(frozen=True, slots=True)
class SideSource:
    """A file to compare, and what it is.

    at: parameter values of a campaign, NAME=VALUE; more: files of the same test.
    """

    path: Path
    kind: SourceKind
    at: tuple[str, ...] = ()
    more: tuple[Path, ...] = ()


@dataclass(frozen=True, slots=True)
class Model:
    """A campaign's model at parameter values, and its elastic modes at all nodes asked for."""

    campaign: Campaign
    values: Values
    elastic: ModeSet

    def side(self, seen: ModeSet, label: str) -> Side:
        numbers = tuple(range(1, seen.n_modes + 1))
        return Side(label, "model", numbers, seen, self.geometry)

    @property
    def geometry(self) -> TestGeometry | None:
        """Of the campaign's test, along whose directions the model is seen."""
        return self.campaign.case.measurement.geometry


def source(path: Path, at: Sequence[str] = ()) -> SideSource:
    """What a path is of. Raises CampaignError where it is nothing, or `at` is for no campaign."""
    several = [Path(part.strip()) for part in str(path).split(",")]
    if len(several) > 1 and not path.exists() and all(part.is_file() for part in several):
        return SideSource(several[0], "test", (), tuple(several[1:]))
    if path.is_dir():
        path = path / "campaign.h5"
    if not path.exists():
        raise CampaignError(
            f"{path} is not there; expected a campaign file, a deck, a campaign.h5 or its run "
            "folder, or a test file"
        )
    kind: SourceKind = "test"
    if path.suffix.lower() in YAML:
        kind = "campaign"
    elif _is_record(path):
        kind = "record"
    elif is_deck(path):
        kind = "deck"
    if at and kind != "campaign":
        raise CampaignError(f"{path} is not a campaign file, so it has no values to set")
    return SideSource(path, kind, tuple(at))


def _is_record(path: Path) -> bool:
    """Whether a file is a campaign's record, to be left to its own reader."""
    try:
        return is_record(path) or path.name == "campaign.h5"
    except OSError:
        return path.name == "campaign.h5"  # its reader says what is wrong


def correlate_sources(
    first: SideSource,
    second: SideSource | None,
    state: State = "updated",
    settings: Sequence[str] = (),
    method: MassReduction | None = None,
) -> Correlation:
    """Compare two sources, or a campaign or record with its own test.

    state: which model of a record. method: how the mass matrix is reduced to the common degrees
    of freedom for orthogonality, None for none. A test comes
    before a model.
    Raises CampaignError, SolverError, StoreError.
    """
    model: Model | None = None
    if second is None:
        left, right, model = _alone(first, state, settings)
    elif first.kind in MODELS and second.kind in MODELS:
        left, right, model = _two_models(first, second, settings)
    elif first.kind in MODELS or second.kind in MODELS:
        campaign, other = (first, second) if first.kind in MODELS else (second, first)
        model, mine, theirs = _model_beside(campaign, other, state, settings)
        ordered = other.kind == "test" or campaign is second
        left, right = (theirs, mine) if ordered else (mine, theirs)
    else:
        left, right = (_read(item, state) for item in (first, second))
        if right.kind == "test" and left.kind != "test":
            left, right = right, left
    found = correlate(left, right)
    if method is None:
        return found
    if model is None:
        raise CampaignError("orthogonality needs a mass matrix: name a campaign file for one side")
    return replace(found, orthogonality=_orthogonality(found, model, method))


def _alone(
    item: SideSource, state: State, settings: Sequence[str]
) -> tuple[Side, Side, Model | None]:
    """Compare a campaign's or record's model with its own test."""
    if item.kind == "test":
        raise CampaignError(
            f"{item.path} is a test; name what it is to be compared with: a campaign file, a "
            "campaign.h5 or another test"
        )
    if item.kind == "record":
        record = read_record(item.path)
        test = Side("test", "test", record.test.numbers, record.test.modes, record.geometry)
        return test, _read(item, state), None
    if item.kind == "deck":
        raise CampaignError(f"{item.path} is a deck; name the test that it is to be compared with")
    model = _model(load_campaign(item.path, list(settings)), item.at)
    campaign = model.campaign
    test = Side("test", "test", campaign.test.numbers, campaign.test.modes, model.geometry)
    return test, model.side(_seen(model), campaign.name), model


def _model_beside(
    item: SideSource,
    other: SideSource,
    state: State,
    settings: Sequence[str],
) -> tuple[Model, Side, Side]:
    """A campaign's model as the other side's sensors see it, and the other side."""
    if other.kind == "record":
        theirs = _read(other, state)
        model = _model(open_model(item.path, settings), item.at)
        return model, model.side(_seen(model), model.campaign.name), theirs
    campaign = open_model(item.path, settings, (other.path, *other.more))
    model = _model(campaign, item.at)
    test = model.campaign.test
    theirs = Side(other.path.name, "test", test.numbers, test.modes, model.geometry)
    return model, model.side(_seen(model), model.campaign.name), theirs


def _two_models(
    first: SideSource,
    second: SideSource,
    settings: Sequence[str],
) -> tuple[Side, Side, Model]:
    """Two models at the sensors of their tests, or where these share none, at common nodes."""
    models = [_model(open_model(item.path, settings), item.at) for item in (first, second)]
    seen, by_sensors = [_seen(model) for model in models], True
    if common_dofs(*seen)[0].size == 0:
        ids = (
            models[0].campaign.case.solver.deck.summary.node_ids
            & models[1].campaign.case.solver.deck.summary.node_ids
        )
        if not ids:
            raise CampaignError(
                f"{first.path} and {second.path} have neither sensors nor nodes in common; give "
                "both campaigns the same test, with coordinates, so that each model is seen by it"
            )
        models = [
            _model(model.campaign, item.at, tracking_nodes(ids))
            for model, item in zip(models, (first, second), strict=True)
        ]
        seen, by_sensors = [model.elastic for model in models], False
    labels = _labels(models, first, second)
    left, right = (
        model.side(modes, label) for model, modes, label in zip(models, seen, labels, strict=True)
    )
    if not by_sensors:  # along the model's axes
        left, right = (replace(side, geometry=None) for side in (left, right))
    return left, right, models[1]


def _labels(models: list[Model], first: SideSource, second: SideSource) -> list[str]:
    names = [model.campaign.name for model in models]
    if names[0] != names[1]:
        return names
    texts = [", ".join(item.at) for item in (first, second)]
    if texts[0] == texts[1]:
        texts = ["(first)", "(second)"]
    return [f"{names[0]} {text or '(initial)'}" for text in texts]


def _model(
    campaign: Campaign,
    at: Sequence[str],
    nodes: tuple[int, ...] | None = None,
) -> Model:
    """The modes of a campaign's model, from the store or the solver."""
    values = parse_values(campaign, list(at))
    analysis = campaign_analysis(campaign)
    if nodes is not None:
        analysis = ModalAnalysis(analysis.n_modes, nodes)
    (outcome,) = solve_jobs(job_engine(campaign), [Job(values, analysis)])
    result = outcome.result(ModalResult)
    return Model(campaign, values, result.elastic)


def _seen(model: Model) -> ModeSet:
    """The model's modes as its test's sensors see them; no shapes where the test has none."""
    if not model.campaign.test.has_shapes:
        return model.elastic.rows(np.zeros(0, dtype=np.int64))
    return model.campaign.case.sensors.observe(model.elastic)


def _read(item: SideSource, state: State) -> Side:
    """A record's model or a test file as a side."""
    if item.kind == "record":
        record = read_record(item.path)
        accepted = [iteration for iteration in record.iterations if iteration.accepted]
        chosen = accepted[-1 if state == "updated" else 0].computed
        numbers = tuple(range(1, chosen.n_modes + 1))
        return Side(f"{record.name} {state}", "record", numbers, chosen, record.geometry)
    measured = read_measurement([item.path, *item.more])
    test = measured.modes
    if test is None:
        raise CampaignError(f"{item.path} holds no modes; `modetune identify` makes them from FRFs")
    return Side(item.path.name, "test", test.numbers, test.modes, measured.geometry)


def _orthogonality(found: Correlation, model: Model, method: MassReduction) -> Orthogonality:
    """One matrix job; common degrees of freedom that can move are masters."""
    full, names = full_model(model.campaign, model.values), list(found.dofs)
    sensors = model.campaign.case.sensors
    named = zip(sensors.nodes.tolist(), sensors.components.tolist(), strict=True)
    places = {name: place for place, name in enumerate(named)}
    if places.keys() >= set(names):
        chosen = sparse.eye_array(len(places), format="csr")[[places[name] for name in names]]
        wanted = by_sensors(full).turned(sparse.csr_array(chosen))
    else:  # two models at common nodes
        wanted = full.observation(*dof_arrays(names))
    seen, moving = full.seen(wanted, names)
    masters = seen.stiffness, seen.mass, seen.rows
    with factor_room(full.room):
        if method == "serep":
            # No more modes than masters: only so each is kept exactly.
            count = min(model.campaign.case.n_modes, moving.size)
            reduced = serep(*masters, solve_modes(seen.stiffness, seen.mass, count)[1])
        else:
            reduced = guyan(*masters)
    return orthogonality(found, method, tuple(names[n] for n in moving.tolist()), reduced.mass)
