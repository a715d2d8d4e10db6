"""Where a campaign's model is wrong: the Python API of `modetune localise`.

Three kinds of evidence, each from what the store has first: what single parameters and pairs can
remove of the residual (sensitivities), maps of the error on the model (stored matrices at the
test's modes, see `core/updating/localisation`), and whether any admissible parameter set can remove
the residual at all (`core/updating/model_form`). Maps need measured shapes, and a solver whose
matrices have their unknowns at the model's nodes; without them the result has the other two and
the reason.

The state that is examined is the end of the newest update in the campaign's run folder, and there
the test for model-form error is the verdict of its record, so that `modetune update` and this
command state the same numbers. Without an update it is the campaign's start, and a forecast.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from modetune.core.algebra.factor_room import factor_room
from modetune.core.brief import brief
from modetune.core.errors import CampaignError, ModelError, ModesError
from modetune.core.modes import Floats
from modetune.core.storage.campaign_record import CampaignRecord, RunCounts
from modetune.core.updating.localisation import Removal, removals
from modetune.core.updating.model_form import FORECAST, ModelForm, model_form_sentence
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.campaign_engine import solving_engine
from modetune.flows.report.form_verdict import (
    WHERE,
    FormVerdict,
    record_verdict,
    residual_form,
)
from modetune.flows.studies.localise.error_maps import ErrorMaps, error_maps, why_no_maps
from modetune.flows.studies.localise.proposals import Proposals, proposals
from modetune.flows.studies.result import near
from modetune.flows.studies.study import ModelState
from modetune.flows.studies.update_record import update_record
from modetune.flows.updating.evaluation import Evaluation
from modetune.flows.updating.evaluator import Evaluator, evaluator_of
from modetune.flows.updating.mode_source import Demand
from modetune.flows.updating.sensitivities import UnlikeMatrices

CHANGED = "the campaign file has changed since this update: `modetune update` brings it up to date"


@dataclass(frozen=True, slots=True, repr=False)
class Localisation:
    """Where a model is wrong.

    parameters: names; theta: (n_parameters,), the values that were looked at. modes: numbers of
    the test's modes, in the order of the pairs. singles, pairs: what parameters remove of the
    residual, the best first. verdict: the test for model-form error; updated: whether it is a
    verdict on the updated model. examined: which state, in words. remarks: on that choice. maps:
    None where they cannot be made, and why_no_maps says why; proposals and why_no_proposals
    likewise. runs: what it cost.
    """

    parameters: tuple[str, ...]
    theta: Floats
    modes: tuple[int, ...]
    singles: tuple[Removal, ...]
    pairs: tuple[Removal, ...]
    verdict: FormVerdict
    updated: bool
    examined: str
    remarks: tuple[str, ...]
    maps: ErrorMaps | None
    why_no_maps: str
    runs: RunCounts
    proposals: Proposals | None = None
    why_no_proposals: str = ""

    __repr__ = brief

    @property
    def form(self) -> ModelForm:
        """The test for model-form error."""
        return self.verdict.form

    @property
    def sentence(self) -> str:
        """What the test for model-form error says."""
        return self.verdict.sentence


@dataclass(frozen=True, slots=True)
class ExaminedState:
    """Where in a campaign to look for errors.

    theta: (n_parameters,), where an update ended; None at the campaign's start. verdict: of that
    update's record, None where it has none. text: the state in words. remarks: on the choice.
    """

    theta: Floats | None = None
    verdict: FormVerdict | None = None
    text: str = "the campaign's start"
    remarks: tuple[str, ...] = ()


def examined_state(
    campaign: Campaign, record: Path | None, state: ModelState | None, folder: Path
) -> ExaminedState:
    """Return the state to examine: what is named, else the end of the update, else the start.

    record: run folder or campaign.h5; folder: the campaign's run folder. Raises CampaignError
    where the record is of another campaign or there is none, StoreError.
    """
    found, path = update_record(campaign, record, state, folder), record or folder
    if found is None:
        forecast = "there is no update of this campaign yet: this is a forecast from its start"
        return ExaminedState(remarks=() if state == "initial" else (forecast,))
    own, there = campaign.parameters.names, found.parameters.names
    other = (
        f"{path} has the parameters {', '.join(there)}, but {campaign.file} has {', '.join(own)}"
    )
    if own != there and (record is not None or state == "updated"):
        raise CampaignError(f"{other}; name the record of this campaign")
    if own != there:
        return ExaminedState(remarks=(f"the campaign's start, because {other}",))
    text, remarks = f"the end of the update in {near(path)}", list[str]()
    if found.campaign_text != campaign.text:
        remarks.append(CHANGED)
    if not _same_test(campaign, found):
        remarks.append("this update had another test than the campaign has now")
        return ExaminedState(found.updated, None, text, tuple(remarks))
    verdict = record_verdict(found)
    if verdict is not None:
        verdict = replace(verdict, sentence=verdict.sentence.removesuffix(WHERE))
    return ExaminedState(found.updated, verdict, text, tuple(remarks))


def _same_test(campaign: Campaign, record: CampaignRecord) -> bool:
    one, other = campaign.test, record.test
    return one.numbers == other.numbers and np.array_equal(
        one.modes.frequencies_hz, other.modes.frequencies_hz
    )


def one_model(campaign: Campaign, configuration: str | None) -> Campaign:
    """Return a campaign, or that of one of its configurations.

    Raises CampaignError where there is no such configuration.
    """
    names = [item.name for item in campaign.cases if item.name]
    if configuration is None:
        return campaign
    if configuration not in names:
        there = f"there is {', '.join(names)}" if names else "the campaign has none"
        raise CampaignError(
            f"{campaign.file}: --configuration: name one of the campaign's configurations; "
            f"{configuration!r}, {there}"
        )
    return campaign.alone(campaign.cases[names.index(configuration)])


def localise(
    campaign: Campaign,
    state: ExaminedState = ExaminedState(),
    configuration: str | None = None,
    changes: bool = False,
    tell: Callable[[str], None] = lambda text: None,
) -> Localisation:
    """Look for the error in a state of a campaign.

    configuration: name of one, where there are several; all of them together else. changes: whether
    to look for changes that the model lacks; tell: is called with the progress of that. Raises
    CampaignError, ModesError, SolverError, StoreError.
    """
    whole, campaign = campaign, one_model(campaign, configuration)
    updated = state.theta is not None
    values = campaign.start if state.theta is None else state.theta
    if values.size != len(campaign.parameters):
        values = values[[whole.parameters.names.index(name) for name in campaign.parameters.names]]
    with solving_engine(campaign) as engine:
        why = why_no_maps(campaign)
        demand = Demand(steps=1, matrices=not why)
        evaluator = evaluator_of(campaign, engine, demand=demand)
        evaluation, matrix = evaluator.evaluate(
            "values of the parameters", values, None, alone=False
        )
        assert matrix is not None
        maps = None
        if not why:
            with factor_room(engine.room):
                maps, why = error_maps(campaign, evaluator, evaluation.parts[0])
        proposed, why_not = None, ""
        if changes:
            proposed, why_not = _proposed(campaign, evaluator, evaluation, tell)
    numbers = tuple(campaign.test.numbers[place] for place in evaluation.pairing.measured.tolist())
    found = evaluation.residual
    singles, pairs = removals(
        found.independent(matrix.values),
        found.independent(found.values),
        found.weights,
        campaign.parameters.lower - values,
        campaign.parameters.upper - values,
    )
    verdict = state.verdict
    if verdict is None:
        form, labels = residual_form(
            matrix.values,
            found,
            campaign.parameters,
            values,
            least=0.0 if updated else FORECAST,
            prior=campaign.precision(values) if campaign.fields else None,
        )
        text = model_form_sentence(form, labels, campaign.parameters.names, updated)
        verdict = FormVerdict(form, labels, text)
    return Localisation(
        parameters=campaign.parameters.names,
        theta=values,
        modes=numbers,
        singles=singles,
        pairs=pairs,
        verdict=verdict,
        updated=updated,
        examined=state.text,
        remarks=state.remarks,
        maps=maps,
        why_no_maps=why,
        runs=evaluator.runs,
        proposals=proposed,
        why_no_proposals=why_not,
    )


def _proposed(
    campaign: Campaign,
    evaluator: Evaluator,
    evaluation: Evaluation,
    tell: Callable[[str], None],
) -> tuple[Proposals | None, str]:
    """Return changes that the model may lack, and why there are none where that is so."""
    for case in campaign.used:
        if not case.solver.offers.matrices:
            name = case.solver.program.name
            return None, f"they need matrices, which {name} does not give"
    try:
        with factor_room(evaluator.used[0].engine.room):
            return proposals(campaign, evaluator, evaluation, tell), ""
    except (ModelError, ModesError, UnlikeMatrices) as error:
        return None, str(error)
