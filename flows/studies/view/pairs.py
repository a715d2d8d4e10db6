"""Test modes and elastic modes of the first model: MAC, frequencies, and pairs by hand."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import replace

from modetune.core.errors import ModesError, NotStored
from modetune.core.storage.keys import Json
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.diagnosis.pairing import first_pairs, mac_table
from modetune.flows.jobs.campaign_engine import engine_of, job_engine
from modetune.flows.jobs.job import Job
from modetune.flows.studies.view.campaign_changes import Change, Part
from modetune.flows.updating.mode_source import campaign_analysis

#: Elastic modes are shown up to this many times the highest measured frequency.
REACH = 2.0


def pairs_json(
    campaign: Campaign, solve: bool, cancelled: threading.Event, configuration: str = ""
) -> dict[str, Json]:
    """The table of pairs; solve: by the solver where the store has not the model's modes.

    configuration: whose, of several; else of the first.

    Raises CampaignError, SolverError, StoreError.
    """
    case = next((case for case in campaign.cases if case.name == configuration), campaign.cases[0])
    engine = engine_of(job_engine(campaign), campaign, case)
    engine = replace(engine, may_run=solve, cancelled=cancelled)
    campaign = campaign.alone(case)
    job = Job(campaign.parameters.values(campaign.start), campaign_analysis(campaign))
    try:
        result = engine.solve(job).result(ModalResult)
    except NotStored:
        return {"unsolved": True}
    case, test = campaign.case, campaign.case.measured
    elastic = case.sensors.observe(result.elastic) if test.has_shapes else result.elastic
    rows = [place for place, number in enumerate(test.numbers) if number in campaign.test.numbers]
    chosen = [*case.rules.by_hand.values(), len(rows)]
    near = elastic.frequencies_hz <= REACH * test.modes.frequencies_hz.max()
    shown = min(max(int(near.sum()), *chosen) + 1, elastic.frequencies_hz.size)
    told: dict[str, Json] = {
        "numbers": [test.numbers[place] for place in rows],
        "test_hz": [float(test.modes.frequencies_hz[place]) for place in rows],
        "elastic_hz": elastic.frequencies_hz[:shown].tolist(),
        "mac": mac_table(test.modes, elastic)[rows, :shown].tolist() if test.has_shapes else None,
        "by_hand": {str(number): mode for number, mode in case.rules.by_hand.items()},
        "paired": {},
        "note": "",
    }
    try:
        found = first_pairs(test, elastic, case.rules)
    except ModesError as error:
        told["note"] = f"no automatic pairs: {error}"
    else:
        pairs = zip(found.measured.tolist(), found.computed.tolist(), strict=True)
        told["paired"] = {str(test.numbers[m]): c + 1 for m, c in pairs if m in rows}
    return told


def pairs_change(part: Part, pairs: Mapping[int, int]) -> Change:
    """`test.pairs` as they were picked. Raises CampaignError."""
    return part.change({("test", "pairs"): dict(sorted(pairs.items())) or None})
