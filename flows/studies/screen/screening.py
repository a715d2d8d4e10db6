"""The screening of a campaign: sensitivities, the points of a design, indices and the choice.

The points are modal jobs of the campaign, with the same engine, limits, retries and licences, and
the store has their results. So a screening that was stopped continues, and the same screening
again starts no solver.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np

from modetune.core.errors import ModetuneError
from modetune.core.modes import Floats
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.schema import STORE_REMEDY
from modetune.flows.jobs.campaign_engine import solving_engine
from modetune.flows.studies.screen.choice import CandidateParameters, choose_parameters
from modetune.flows.studies.screen.design import make_design
from modetune.flows.studies.screen.indices import design_indices
from modetune.flows.studies.screen.record import Responses, Screening, mode_names
from modetune.flows.studies.screen.request import ScreeningRequest
from modetune.flows.studies.screen.sensitivity import (
    LocalSensitivity,
    local_sensitivity,
    most_moved,
    other_rows,
    seen_moves,
)
from modetune.flows.updating.evaluation import Evaluation
from modetune.flows.updating.evaluator import evaluator_of
from modetune.flows.updating.mode_source import Demand
from modetune.flows.updating.poses import settled

#: Names of the steps for the progress line.
DECK, POINTS = "deck's values", "points of the design"


def screen_campaign(
    campaign: Campaign,
    request: ScreeningRequest,
    working: Callable[[str], None],
) -> Screening:
    """Screen a campaign's parameters within their bounds.

    working: receives the current step. Failed points are left out as the method allows.

    Raises CampaignError (an impossible design), SolverError, ModesError (too few points remain),
    StoreError.
    """
    campaign = settled(campaign)
    started = time.monotonic()
    # Separate streams for points and analysis, so that a change of one keeps the other.
    at_points, at_indices = np.random.default_rng(request.seed).spawn(2)
    parameters = campaign.parameters
    bounds = parameters.lower, parameters.upper
    design = make_design(request.method, *bounds, at_points, request.points, request.levels)
    version = campaign.solver_version()  # report a missing solver before anything else starts
    campaign.store.check_usable(STORE_REMEDY)
    with solving_engine(campaign) as engine:
        working(f"{DECK}, sensitivities")
        evaluator = evaluator_of(campaign, engine, demand=Demand(1, len(design.points)))
        evaluator.tell = working
        nominal, matrix = evaluator.evaluate(DECK, parameters.initial, None, alone=False)
        assert matrix is not None
        working(POINTS)
        points = evaluator.points(POINTS, design.points, [nominal])
        responses = _responses(campaign, nominal, points, len(design.points))
    local = local_sensitivity(campaign, nominal, matrix)
    found = None
    if request.method != "local":
        found = design_indices(design, _relative(responses, nominal), at_indices)
    pairing, names = nominal.pairing, campaign.configurations
    paired = pairing.measured.tolist()
    numbers = tuple(campaign.test.numbers[place] for place in paired)
    configurations = tuple(names[place] for place in paired) if names else ()
    moves = seen_moves(campaign, design, local, found)
    loudest = most_moved(moves, mode_names(numbers, configurations), responses.other_names)
    candidates = _candidates(campaign, nominal, local, moves, loudest)
    return Screening(
        name=campaign.name,
        seed=request.seed,
        solver=campaign.solver_name,
        solver_version=version,
        units=", ".join(dict.fromkeys(case.units for case in campaign.used)),
        campaign_text=campaign.text,
        names=parameters.names,
        deviations=parameters.standard_deviations,
        numbers=numbers,
        test_hz=campaign.test.modes.frequencies_hz[pairing.measured],
        nominal_hz=nominal.seen.frequencies_hz[pairing.computed],
        nominal_mac=pairing.judged_mac,
        design=design,
        responses=responses,
        local=local,
        indices=found,
        importance=candidates.importance,
        choice=choose_parameters(candidates, request.choose),
        runs=evaluator.runs,
        wall_s=time.monotonic() - started,
        wanted=request.choose or 0,
        reduced_model=evaluator.range_use,
        configurations=configurations,
    )


def _candidates(
    campaign: Campaign,
    nominal: Evaluation,
    local: LocalSensitivity,
    moves: Floats,
    loudest: tuple[str, ...],
) -> CandidateParameters:
    """Return the candidates; their importance is the root of the sum of squares of the moves."""
    parameters = campaign.parameters
    lower, upper = (
        (bound - nominal.theta) / parameters.standard_deviations
        for bound in (parameters.lower, parameters.upper)
    )
    return CandidateParameters(
        names=parameters.names,
        importance=np.asarray(np.linalg.norm(moves, axis=0)),
        loudest=loudest,
        missing=local.missing,
        weighted=local.weighted,
        weighted_residual=local.weighted_residual,
        lower=lower,
        upper=upper,
    )


def _relative(responses: Responses, nominal: Evaluation) -> Floats:
    """Responses of the analysis, (n_points, n_responses): f / f_nominal - 1, MAC, and others."""
    here = nominal.seen.frequencies_hz[nominal.pairing.computed]
    return np.hstack([responses.frequencies_hz / here - 1.0, responses.mac, responses.others])


def _responses(
    campaign: Campaign, nominal: Evaluation, points: Iterator[Evaluation | ModetuneError], n: int
) -> Responses:
    """The responses at the n points of the design; NaN where one failed.

    Evaluations are released one by one: the shapes of 5,000 would fill gigabytes.
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
            # A mode from a test without shapes keeps its own, if other tests have shapes.
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
