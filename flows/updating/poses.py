"""Selection of a test's pose by measured shapes, if several poses fit the sensors equally well.

Each pose reads the same computed modes at its own nodes and pairs them with the measured ones as
updating does. The MAC of a pose is the mean over its pairs. For close modes it is that of their
subspace: repeated modes have arbitrary directions within it, in the test and in the model, so
single MAC values would select a pose by chance. A symmetric structure has the same subspaces in all
its poses, so shapes cannot distinguish them either.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from modetune.core.correlation.pairing import pair_by_shape
from modetune.core.errors import CampaignError, NotStored, SolverError
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import Case
from modetune.flows.campaign.mapping import LISTED_POSES, Mapping, pose_of
from modetune.flows.campaign.test import pairing_nodes
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.execution import solve_jobs
from modetune.flows.jobs.job import Job
from modetune.flows.updating.mode_source import campaign_analysis

logger = logging.getLogger(__name__)

#: The best pose must lead by this much MAC, and its 1 - MAC must be at most half that of the next
#: pose: noise and modelling errors reduce the MAC of every pose alike.
LEAD, LEFT = 0.05, 0.5


def settled(campaign: Campaign) -> Campaign:
    """Return the campaign with each test in a certain pose.

    If several poses fit equally well, a modal run may select one by its shapes. Raises
    CampaignError if the alignment is uncertain; SolverError.
    """
    cases, problems = [], []
    for case in campaign.cases:
        found, text = case, ""
        if may_choose(case):
            own = campaign.alone(case)
            (outcome,) = solve_jobs(job_engine(own), [modal_job(own)])
            found, text = by_shapes(case, outcome.result(ModalResult))
            logger.info("%s", text)
        problems += [
            f"{case.of('the alignment of the test')} is uncertain: {text or what}. {remedy}"
            for what, remedy in found.mapping.uncertain
        ]
        cases.append(found)
    if problems:
        raise CampaignError(problems)
    return replace(campaign, cases=tuple(cases))


def may_choose(case: Case) -> bool:
    """Return whether measured shapes may select one of several poses of a test."""
    return bool(case.mapping.others) and not case.mapping.doubts and case.test.has_shapes


def from_store(campaign: Campaign) -> tuple[Case, str] | None:
    """Return `by_shapes` of a campaign of one model, if the store has its modes; else None."""
    if not may_choose(campaign.case):
        return None
    engine = replace(job_engine(campaign), may_run=False)
    try:
        return by_shapes(campaign.case, engine.solve(modal_job(campaign)).result(ModalResult))
    except (NotStored, SolverError):
        return None


def by_shapes(case: Case, result: ModalResult) -> tuple[Case, str]:
    """Return the case at the pose that its shapes select, and a sentence about each.

    result: with the nodes of all poses. The case is unchanged if shapes do not select a pose.
    """
    mappings = (case.mapping, *case.mapping.others)
    macs = np.array([_mean_mac(case, item, result) for item in mappings])
    order = np.argsort(-macs, kind="stable")
    poses = [f"{pose_of(mappings[row])}: mean MAC {macs[row]:.3f}" for row in order]
    more = len(poses) - LISTED_POSES
    text = "; ".join(poses[:LISTED_POSES]) + (f" and {more} more" if more > 0 else "")
    best, next_best = macs[order[:2]]
    if best - next_best < LEAD or 1.0 - best > LEFT * (1.0 - next_best):
        return case, f"measured shapes cannot distinguish its poses: {text}"
    chosen = replace(mappings[order[0]], doubts=(), others=())
    settled_case = replace(
        case,
        mapping=chosen,
        nodes=pairing_nodes(case.test, chosen.sensors, case.solver, case.gauged),
    )
    return settled_case, f"of the poses that fit the sensors, measured shapes select: {text}"


def modal_job(campaign: Campaign) -> Job:
    """Return the job whose modes have the nodes of all poses of a campaign's only test."""
    return Job(campaign.parameters.values(campaign.start), campaign_analysis(campaign))


def _mean_mac(case: Case, mapping: Mapping, result: ModalResult) -> float:
    seen = mapping.sensors.observe(result.elastic)
    pairing = pair_by_shape(case.test.modes, seen, lost_mac=-1.0, drop=True)
    return float(pairing.judged_mac.mean())
