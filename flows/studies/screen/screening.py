"""Running a screening: the Python API behind `modetune screen`.

The points of the design are ordinary modal jobs of the campaign: they go through the same engine,
under the same limits, retries and licences, and their results stay in the store. So a screening
that was stopped goes on where it was, and the same one again starts no solver.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np

from modetune.core.errors import ModetuneError
from modetune.core.modes import Floats
from modetune.core.storage.files import check_writable
from modetune.core.storage.record import RunCounts
from modetune.core.updating.reduced_range import RangeUse
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.schema import STORE_REMEDY
from modetune.flows.jobs.campaign_engine import solving_engine
from modetune.flows.studies.screen.choice import CandidateParameters, choose_parameters
from modetune.flows.studies.screen.design import Design, make_design
from modetune.flows.studies.screen.indices import Indices, design_indices
from modetune.flows.studies.screen.record import Responses, Screening, mode_names
from modetune.flows.studies.screen.request import ScreeningRequest
from modetune.flows.studies.screen.sensitivity import (
    LocalSensitivity,
    importance,
    local_sensitivity,
    loudest,
    other_rows,
)
from modetune.flows.updating.evaluation import Evaluation, Matrix
from modetune.flows.updating.evaluators import evaluator_of
from modetune.flows.updating.mode_source import Demand
from modetune.flows.updating.poses import settled

#: What is being run, for people.
DECK, POINTS = "deck's values", "points of the design"


def screen_campaign(
    campaign: Campaign,
    request: ScreeningRequest,
    working: Callable[[str], None],
) -> Screening:
    """Screen a campaign's parameters within their bounds.

    working: is called with what is being computed.

    Points that fail are left out as the method allows. Raises CampaignError (a design that cannot
    be), SolverError, ModesError (too few points are left), StoreError.
    """
    campaign = settled(campaign)
    started = time.monotonic()
    # One stream for the points and one for the analysis, so that either stays if the other changes.
    at_points, at_indices = np.random.default_rng(request.seed).spawn(2)
    parameters = campaign.parameters
    design = make_design(
        request.method,
        parameters.lower,
        parameters.upper,
        at_points,
        request.points,
        request.levels,
    )
    version = campaign.solver_version()  # a missing solver is told before anything else starts
    check_writable(campaign.store.folder, STORE_REMEDY)
    with solving_engine(campaign) as engine:
        working(f"{DECK}, sensitivities")
        evaluator = evaluator_of(campaign, engine, demand=Demand(1, len(design.points)))
        evaluator.tell = working
        nominal, matrix = evaluator.evaluate(DECK, parameters.initial, None, alone=False)
        assert matrix is not None
        working(POINTS)
        points = evaluator.points(POINTS, design.points, [nominal])
        responses = _responses(campaign, nominal, points, len(design.points))
        runs, use = evaluator.runs, evaluator.range_use
    local = local_sensitivity(campaign, nominal, matrix)
    found = None
    if request.method != "local":
        found = design_indices(design, _relative(responses, nominal), at_indices)
    return _screening(
        campaign,
        request,
        design,
        nominal,
        matrix,
        responses,
        local,
        found,
        runs,
        version,
        time.monotonic() - started,
        use,
    )


def _screening(
    campaign: Campaign,
    request: ScreeningRequest,
    design: Design,
    nominal: Evaluation,
    matrix: Matrix,
    responses: Responses,
    local: LocalSensitivity,
    found: Indices | None,
    runs: RunCounts,
    version: str,
    wall_s: float,
    use: RangeUse | None,
) -> Screening:
    paired = nominal.pairing.measured.tolist()
    numbers = tuple(campaign.test.numbers[place] for place in paired)
    names = campaign.configurations
    configurations = tuple(names[place] for place in paired) if names else ()
    values = importance(campaign, design, local, found)
    parameters, start = campaign.parameters, nominal.theta
    allowed = [
        (bound - start) / parameters.standard_deviations
        for bound in (parameters.lower, parameters.upper)
    ]
    candidates = CandidateParameters(
        campaign.parameters.names,
        values,
        loudest(
            campaign,
            mode_names(numbers, configurations),
            responses.other_names,
            design,
            local,
            found,
        ),
        local.missing,
        local.weighted,
        local.weighted_residual,
        *allowed,
    )
    pairing = nominal.pairing
    return Screening(
        name=campaign.name,
        seed=request.seed,
        solver=campaign.solver_name,
        solver_version=version,
        units=", ".join(dict.fromkeys(case.units for case in campaign.used)),
        campaign_text=campaign.text,
        names=campaign.parameters.names,
        deviations=campaign.parameters.standard_deviations,
        numbers=numbers,
        test_hz=campaign.test.modes.frequencies_hz[pairing.measured],
        nominal_hz=nominal.seen.frequencies_hz[pairing.computed],
        nominal_mac=pairing.judged_mac,
        design=design,
        responses=responses,
        local=local,
        indices=found,
        importance=values,
        choice=choose_parameters(candidates, request.choose),
        runs=runs,
        wall_s=wall_s,
        wanted=request.choose or 0,
        reduced_model=use,
        configurations=configurations,
    )


def _relative(responses: Responses, nominal: Evaluation) -> Floats:
    """Responses of the analysis, (n_points, n_responses): f / f_nominal - 1, MAC, and others."""
    here = nominal.seen.frequencies_hz[nominal.pairing.computed]
    return np.hstack([responses.frequencies_hz / here - 1.0, responses.mac, responses.others])


def _responses(
    campaign: Campaign, nominal: Evaluation, points: Iterator[Evaluation | ModetuneError], n: int
) -> Responses:
    """The responses at the n points of the design; NaN where one failed.

    Evaluations are let go one by one: of 5,000 all shapes would fill gigabytes.
    """
    n_modes = nominal.pairing.measured.size
    shaped = n_modes if campaign.test.has_shapes else 0
    frequencies, macs = np.full((n, n_modes), np.nan), np.full((n, shaped), np.nan)
    beside = other_rows(nominal.residual)
    others = np.full((n, beside.size), np.nan)
    failures, keys = [""] * n, [""] * n
    for place, item in enumerate(points):
        if isinstance(item, Evaluation):
            frequencies[place] = item.seen.frequencies_hz[item.pairing.computed]
            found = item.pairing.judged_mac[:shaped]
            # A mode whose test has no shapes, beside others that have some, keeps its own.
            macs[place] = np.where(np.isnan(found), 1.0, found)
            found = item.residual.independent(item.residual.values)[beside]
            others[place] = found / np.sqrt(item.residual.noise[beside])
            keys[place] = item.key
        else:
            failures[place] = str(item)
    blocks, labels = nominal.residual.blocks, nominal.residual.labels
    kinds = [block.kind for block in blocks for _ in range(block.size)]
    return Responses(
        frequencies,
        macs,
        tuple(failures),
        tuple(keys),
        others,
        tuple(kinds[row] for row in beside.tolist()),
        tuple(labels[row] for row in beside.tolist()),
    )
