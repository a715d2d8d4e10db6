"""Where a campaign's model is wrong: the Python API of `modetune localise`.

Three kinds of evidence, each from what the store has first: what single parameters and pairs can
remove of the residual (sensitivities), maps of the error on the model (stored matrices at the
test's modes, see `core/updating/localisation`), and whether any admissible parameter set can remove
the residual at all (`core/updating/model_form`). Maps need measured shapes, and a solver whose
matrices have their unknowns at the model's nodes; without them the result has the other two and
the reason.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from modetune.core.algebra.factor_room import factor_room
from modetune.core.brief import brief
from modetune.core.errors import CampaignError, ModelError, ModesError
from modetune.core.modes import Floats
from modetune.core.storage.campaign_record import RunCounts, read_record
from modetune.core.updating.localisation import Removal, removals
from modetune.core.updating.model_form import FORECAST, ModelForm, model_form_sentence
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.jobs.campaign_engine import solving_engine
from modetune.flows.report.form_verdict import residual_form
from modetune.flows.studies.localise.error_maps import ErrorMaps, error_maps, why_no_maps
from modetune.flows.studies.localise.proposals import Proposals, proposals
from modetune.flows.updating.evaluation import Evaluation
from modetune.flows.updating.evaluator import Evaluator, evaluator_of
from modetune.flows.updating.matrices import one_thread
from modetune.flows.updating.mode_source import Demand
from modetune.flows.updating.sensitivities import UnlikeMatrices


@dataclass(frozen=True, slots=True, repr=False)
class Localisation:
    """Where a model is wrong.

    parameters: names; theta: (n_parameters,), the values that were looked at. modes: numbers of
    the test's modes, in the order of the pairs. singles, pairs: what parameters remove of the
    residual, the best first. form: the test for model-form error; labels: of its entries;
    updated: whether it is a verdict on the updated model. maps: None where they cannot be made,
    and why_no_maps says why; proposals and why_no_proposals likewise. runs: what it cost.
    """

    parameters: tuple[str, ...]
    theta: Floats
    modes: tuple[int, ...]
    singles: tuple[Removal, ...]
    pairs: tuple[Removal, ...]
    form: ModelForm
    labels: tuple[str, ...]
    updated: bool
    maps: ErrorMaps | None
    why_no_maps: str
    runs: RunCounts
    proposals: Proposals | None = None
    why_no_proposals: str = ""

    __repr__ = brief

    @property
    def sentence(self) -> str:
        """What the test for model-form error says."""
        return model_form_sentence(self.form, self.labels, self.parameters, self.updated)


def one_model(
    campaign: Campaign, record: Path | None, configuration: str | None
) -> tuple[Campaign, Floats | None]:
    """Return a campaign of one model and the values of its parameters, None at its start.

    record: run folder or campaign.h5; configuration: name of one, where there are several.
    Raises CampaignError where these are not of the campaign; StoreError.
    """
    theta = None if record is None else _updated_values(campaign, record)
    names = [item.name for item in campaign.cases if item.name]
    if configuration is None and not names:
        return campaign, theta
    if configuration not in names:
        there = f"there is {', '.join(names)}" if names else "the campaign has none"
        text = "none is named" if configuration is None else repr(configuration)
        raise CampaignError(
            f"{campaign.file}: --configuration: name one of the campaign's configurations; {text}, "
            f"{there}"
        )
    case = campaign.cases[names.index(configuration)]
    columns = slice(None) if case.columns is None else list(case.columns)
    return campaign.alone(case), None if theta is None else theta[columns]


def _updated_values(campaign: Campaign, path: Path) -> Floats:
    record = read_record(path)
    if record.parameters.names != campaign.parameters.names:
        raise CampaignError(
            f"{path} has the parameters {', '.join(record.parameters.names)}, but {campaign.file} "
            f"has {', '.join(campaign.parameters.names)}; name the record of this campaign"
        )
    return record.updated


def localise(
    campaign: Campaign,
    theta: Floats | None = None,
    changes: bool = True,
    tell: Callable[[str], None] = lambda text: None,
) -> Localisation:
    """Look for the error at parameter values, at the campaign's start if left out.

    theta: (n_parameters,), values that updating ended on; the test for model-form error is then a
    verdict, not a forecast. changes: whether to look for changes that the model lacks; tell: is
    called with the progress of that.
    Raises ModesError, SolverError, StoreError.
    """
    updated = theta is not None
    values = campaign.start if theta is None else theta
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
    form, labels = residual_form(
        matrix.values,
        found,
        campaign.parameters,
        values,
        least=0.0 if updated else FORECAST,
        prior=campaign.precision(values) if campaign.fields else None,
    )
    return Localisation(
        parameters=campaign.parameters.names,
        theta=values,
        modes=numbers,
        singles=singles,
        pairs=pairs,
        form=form,
        labels=labels,
        updated=updated,
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
    solver = campaign.case.solver
    if not solver.offers.matrices:
        return None, f"they need matrices, which {solver.program.name} does not give"
    try:
        with factor_room(evaluator.only.engine.room), one_thread():
            return proposals(campaign, evaluator, evaluation, tell), ""
    except (ModelError, ModesError, UnlikeMatrices) as error:
        return None, str(error)
