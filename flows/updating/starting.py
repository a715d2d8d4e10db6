"""Where a campaign starts, and whether anything changed since its run before.

`update: {start: last}` starts from the parameters that the run before ended on. They are carried
over as values of the deck's quantities, so a deck whose values were replaced in between means the
same start. Where nothing changed since that run, its own start is taken again: then the store
answers every job, and an updating that ended without e1 is not pushed on night after night.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modetune.core.errors import CampaignError, StoreDamaged
from modetune.core.modes import MeasuredModes
from modetune.core.storage.record import CampaignRecord
from modetune.core.storage.record_file import read_record
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.engine import JobEngine
from modetune.flows.jobs.job import Job
from modetune.flows.updating.by_matrices import ByMatrices
from modetune.flows.updating.evaluators import finder_of
from modetune.flows.updating.finders import campaign_analysis
from modetune.flows.updating.modes_choice import UPDATING

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class EarlierRun:
    """What the record of a finished run tells of its inputs and its end.

    test: numbers, frequencies, shapes, nodes and components as they were measured. started,
    updated: parameters by name, updated ones as values of the deck's quantities. record: all of it.
    """

    campaign_text: str
    settings: str
    test: tuple[NDArray[Any], ...]
    modal_key: str
    started: dict[str, float]
    updated: dict[str, float]
    record: CampaignRecord


def read_earlier(folder: Path) -> EarlierRun | None:
    """The run before in this run folder, or nothing. A record that cannot be read is told of."""
    path = folder / "campaign.h5"
    if not path.exists():
        return None
    try:
        record = read_record(path)
    except (CampaignError, StoreDamaged) as error:
        logger.warning("the record of the run before cannot be read: %s", error)
        return None
    names, first = record.parameters.names, record.iterations[0]
    ends = record.parameters.assigned(record.updated)
    values = [p.number(deck, v) for (p, v), deck in zip(ends, record.deck_values, strict=True)]
    return EarlierRun(
        campaign_text=record.campaign_text,
        settings="\n".join(record.settings),
        test=_test_arrays(record.test),
        modal_key=first.modal_key,
        started=dict(zip(names, first.parameters.tolist(), strict=True)),
        updated=dict(zip(names, values, strict=False)),
        record=record,
    )


def with_first_cost(record: CampaignRecord, earlier: EarlierRun | None) -> CampaignRecord:
    """The record with runs and times of the run before, where the store answered all of its jobs.

    What a model cost is told of it for good, not what it cost to look it up again.
    """
    if earlier is None or record.runs.modal or record.runs.sensitivity:
        return record
    then = earlier.record
    same = [item.modal_key for item in then.iterations] == [
        item.modal_key for item in record.iterations
    ]
    if not same:
        return record
    iterations = tuple(
        replace(item, runs=old.runs, wall_s=old.wall_s)
        for item, old in zip(record.iterations, then.iterations, strict=True)
    )
    return replace(record, runs=then.runs, wall_s=then.wall_s, iterations=iterations)


def is_unchanged(campaign: Campaign, engine: JobEngine, earlier: EarlierRun) -> bool:
    """Whether campaign, settings, test, deck and solver are those of the run before."""
    if (campaign.text, "\n".join(campaign.settings)) != (earlier.campaign_text, earlier.settings):
        return False
    now = _test_arrays(campaign.test)
    if not all(np.array_equal(one, then) for one, then in zip(now, earlier.test, strict=True)):
        return False
    # The key of the first modes stands for all that the deck and the solver are.
    analysis = campaign_analysis(campaign)
    if engine.key(Job(earlier.started, analysis)) == earlier.modal_key:
        return True
    started = np.array([earlier.started[name] for name in campaign.parameters.names])
    finder = finder_of(campaign, engine, UPDATING, campaign)
    if not isinstance(finder, ByMatrices) or finder.works(started, analysis):
        return False
    return finder.stored().key(started, analysis) == earlier.modal_key


def start_of(campaign: Campaign, engine: JobEngine, earlier: EarlierRun | None) -> Campaign:
    """The campaign with the start that its `update: start` asks for."""
    if campaign.update.start == "deck":
        return campaign
    if earlier is None:
        logger.info("there is no run before to start from; starting from the deck")
        return campaign
    if is_unchanged(campaign, engine, earlier):
        names = campaign.parameters.names
        return replace(campaign, begin=tuple(earlier.started[name] for name in names))
    begin = []
    for item in campaign.parameters.parameters:
        deck_value = campaign.deck_value(item)
        value = earlier.updated.get(item.name, np.nan)
        relative = item.relative_to(deck_value, value)
        known = np.isfinite(relative)
        begin.append(float(np.clip(relative, item.lower, item.upper)) if known else item.initial)
    logger.info("starting from the parameters that the run before ended on")
    return replace(campaign, begin=tuple(begin))


def _test_arrays(test: MeasuredModes) -> tuple[NDArray[Any], ...]:
    modes = test.modes
    return (
        np.array(test.numbers),
        modes.frequencies_hz,
        modes.mode_shapes,
        modes.nodes,
        modes.components,
    )
