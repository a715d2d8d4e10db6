"""The commands as Python functions: the same names and work, with results as objects.

Each takes a campaign, or the path of its file, and returns a result with frames (pandas), figures
(matplotlib) and a repr of a few lines. `modetune` exports all of them: `import modetune; run =
modetune.update("campaign.yaml")`.

Functions that run a study share these arguments. settings: KEY.KEY: VALUE, overrides the campaign
file. progress: print progress on standard error. prefect: start a Prefect server if none runs;
without it a configured or running server is used, and none with MODETUNE_NO_PREFECT=1. runs: folder
for run folders. figures: folder for figures; page: HTML file. solver, units: those of a deck. All
raise CampaignError, ModelError, SolverError, ModesError and StoreError.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal, TypedDict, Unpack, get_origin, overload

from modetune.adapters.function.solver import FunctionProgram, UserFunction
from modetune.adapters.test_files.measurements import read_measurement
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import MeasuredFrfs, Measurement
from modetune.core.measurement.stabilisation import Criteria
from modetune.core.storage.store import Store
from modetune.flows.campaign.arrays import user_function, write_campaign
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.campaign.site import RunSection
from modetune.flows.campaign.sketch import campaign_name
from modetune.flows.campaign.solvers import bind_function
from modetune.flows.extras import named_extras
from modetune.flows.report.terminal import terminal
from modetune.flows.responses.own import own_response
from modetune.flows.server.run import carried_out
from modetune.flows.studies.catalogue import find_study
from modetune.flows.studies.identify.identification import Identification, IdentificationSettings
from modetune.flows.studies.identify.measured_functions import SpectraSettings, read_functions
from modetune.flows.studies.identify.operational_modes import OperationalModes, identify_test
from modetune.flows.studies.init.draft import Draft, init_campaign
from modetune.flows.studies.study import StudyParameter, split_files, with_model
from modetune.flows.updating.display import ConsoleProgress
from modetune.flows.updating.forecast import OnIteration, Progress, Unwatched, Watched
from modetune.flows.updating.record import CampaignRun, read_run

if TYPE_CHECKING:
    from modetune.core.updating.job_results import ModalResult
    from modetune.core.updating.verdict import FailOn
    from modetune.flows.studies.check.pre_check import PreCheckReport
    from modetune.flows.studies.compare.competing_models import ModelChoice
    from modetune.flows.studies.correlate.correlation import Correlation
    from modetune.flows.studies.correlate.request import MassReduction
    from modetune.flows.studies.direct.correction import DirectCorrection
    from modetune.flows.studies.direct.request import DirectMethod, Filling
    from modetune.flows.studies.expand.expansion import Expansions
    from modetune.flows.studies.expand.request import ExpansionMethod
    from modetune.flows.studies.fleet.watched_structures import WatchedStructure
    from modetune.flows.studies.history.differences import RunDifference
    from modetune.flows.studies.history.study import StructureHistory
    from modetune.flows.studies.localise.localisation import Localisation
    from modetune.flows.studies.pretest.plan import Pretest
    from modetune.flows.studies.pretest.request import Directions, PlacementMethod
    from modetune.flows.studies.receive.lab_files import ReceivedFile
    from modetune.flows.studies.reduce.reduction import ModelReduction
    from modetune.flows.studies.reduce.request import ReductionMethod
    from modetune.flows.studies.sample.record import PosteriorRecord
    from modetune.flows.studies.scatter.record import ScatterRecord
    from modetune.flows.studies.screen.record import Screening
    from modetune.flows.studies.screen.request import ScreeningMethod
    from modetune.flows.studies.study import ModelState
    from modetune.flows.studies.twin.solver_modes import Twin
    from modetune.flows.studies.validate.validation import Validation
    from modetune.flows.updating.baseline import BaselineCheck

StrPath = str | Path
#: A campaign, the path of its file, or its keys with arrays in place of files.
CampaignLike = Campaign | StrPath | Mapping[str, Any]
#: KEY.KEY: VALUE over the campaign file, or the same as the command line has it.
Settings = Mapping[str, Any] | Sequence[str]
#: One path, or several.
Paths = StrPath | Sequence[StrPath]
#: Values of parameters relative to the deck, by name; the initial ones unless named.
At = Mapping[str, float] | None


def load(
    campaign: StrPath | Mapping[str, Any], settings: Settings = (), folder: StrPath | None = None
) -> Campaign:
    """Load a campaign from its file, or from Python objects with the same keys.

    A mapping may have arrays instead of the files of model and test: `model` with stiffness, mass
    (n, n), parts and dofs, `test` with frequencies_hz (n_modes,), mode_shapes (n_sensors, n_modes)
    and dofs. It is written as a campaign file to a folder, `.modetune/campaigns/NAME` by default.
    `model` may also be a function of the parameters' values that returns (frequencies_hz,
    mode_shapes) or (stiffness, mass), or a mapping with it as `function`.
    settings: {"update.max_iterations": 5}. Raises CampaignError with all problems.
    """
    path = _campaign_path(campaign, folder)
    function = user_function(campaign) if isinstance(campaign, Mapping) else None
    if function is None:
        return load_campaign(path, _texts(settings))
    loaded = load_campaign(path, _texts(settings), bind=bind_function(function))
    if loaded.run.engine != "local" or loaded.run.timeout_s != RunSection().timeout_s:
        raise CampaignError(
            f"{function.place} runs in this process: `run.engine` must be local, and nothing can "
            "stop it after `run.timeout_s`"
        )
    return loaded


def update(
    campaign: CampaignLike | None = None,
    runs: StrPath = "runs",
    *,
    model: Callable[..., Any] | None = None,
    test: Any = None,
    parameters: Mapping[str, Any] | Sequence[Mapping[str, Any]] = (),
    name: str = "",
    version: str | None = None,
    dofs: Sequence[Any] | None = None,
    responses: Sequence[Mapping[str, Any]] = (),
    starts: int | None = None,
    fail_on: FailOn | None = None,
    settings: Settings = (),
    on_iteration: OnIteration | None = None,
    progress: bool = False,
    prefect: bool = False,
) -> CampaignRun:
    """Update a campaign's model until it agrees with its test, from all its `update.starts`.

    Writes record, updated deck and report to `runs/NAME`. starts: overrides `update.starts`.
    fail_on: overrides `run.fail_on`; a verdict that it excludes makes the flow run fail and the
    result's `exit_code` 6, and raises nothing. on_iteration: called with each `IterationRecord`.

    model: instead of a campaign, a function of the parameters' values that returns
    (frequencies_hz, mode_shapes) or (stiffness, mass), with the `test` and `parameters` of `load`.
    parameters: values by name, {"k1": 1100.0}, or a list with campaign keys and a `value` each.
    name: of the campaign, the function's by default. version: of the function's results, which are
    stored only with one. dofs: names of its rows, the test's sensors by default.

    responses: further values to compare, each {"function": f, "measured": values, "deviation":
    values}: f(frequencies_hz, mode_shapes) gets the modes of the test and returns the values.
    """
    given = locals()
    for key in ("model", "test", "parameters", "name", "version", "dofs"):
        del given[key]
    if (campaign is None) == (model is None):
        raise CampaignError("update requires either a campaign or model=, test= and parameters=")
    if model is not None:
        given["campaign"] = {
            "name": name or campaign_name(Path(UserFunction(model).name)),
            "model": {"function": model, "version": version, "dofs": dofs},
            "test": test,
            "parameters": parameters,
        }
    found: CampaignRun = _found("update", given)
    return found


def init(
    deck: StrPath,
    test: StrPath | Sequence[StrPath] = (),
    out: StrPath | None = None,
    *,
    solver: str | None = None,
    units: str | None = None,
    subcase: int | None = None,
    step: int | None = None,
    force: bool = False,
    settings: Settings = (),
) -> Draft:
    """Draft a campaign file for a deck: test, sensors and candidate parameters, with reasons.

    test: files of its test. out: file to write, by default `campaign.yaml` next to the deck.
    subcase, step: of a deck with several, which gives the modes. force: overwrite an existing file.
    Raises CampaignError, ModelError.
    """
    place = None if out is None else Path(out)
    changed = with_model(_texts(settings), solver, units, subcase, step)
    return init_campaign(Path(deck), _paths(test), changed, place, force)


def go(
    deck: StrPath,
    test: StrPath | Sequence[StrPath] = (),
    out: StrPath | None = None,
    runs: StrPath = "runs",
    *,
    solver: str | None = None,
    units: str | None = None,
    subcase: int | None = None,
    step: int | None = None,
    force: bool = False,
    fail_on: FailOn | None = None,
    settings: Settings = (),
    progress: bool = False,
    prefect: bool = False,
) -> CampaignRun:
    """Go from a deck and a test to an updated model: init, identify, check, update and report.

    out: the campaign file, by default `campaign.yaml` next to the deck; one that exists is used as
    it is, unless force. Raises CampaignError where going on would be wrong: unknown units, a test
    that fits the model in several ways, or a pre-check that finds something wrong.
    """
    given = {**locals(), "test": [str(path) for path in _paths(test)]}
    found: CampaignRun | CampaignError = _found("go", given)
    if isinstance(found, CampaignError):
        raise found
    return found


def modes(
    campaign: CampaignLike,
    at: At = None,
    *,
    number: int | None = None,
    solver: str | None = None,
    units: str | None = None,
    subcase: int | None = None,
    step: int | None = None,
    settings: Settings = (),
    progress: bool = False,
    prefect: bool = False,
) -> ModalResult:
    """Compute the modes of a campaign's model or of a deck, including rigid-body modes, at the
    sensors and the nodes of figures.

    number: number of modes.
    """
    found: ModalResult = _found("modes", locals())
    return found


class CheckKeywords(TypedDict, total=False):
    """Keywords of `check` that do not change the type of its result."""

    run: bool
    state: ModelState
    frequency_band: float
    mac_band: float
    solver: str | None
    units: str | None
    subcase: int | None
    step: int | None
    summary: StrPath | None
    junit: StrPath | None
    settings: Settings
    progress: bool
    prefect: bool


@overload
def check(
    campaign: CampaignLike,
    test: Paths = (),
    *,
    against: None = None,
    **options: Unpack[CheckKeywords],
) -> PreCheckReport: ...


@overload
def check(
    campaign: CampaignLike,
    test: Paths = (),
    *,
    against: StrPath | CampaignRun,
    record: StrPath | CampaignRun | None = None,
    fail_on: FailOn | None = None,
    **options: Unpack[CheckKeywords],
) -> BaselineCheck: ...


def check(
    campaign: CampaignLike,
    test: Paths = (),
    *,
    run: bool = True,
    against: StrPath | CampaignRun | None = None,
    record: StrPath | CampaignRun | None = None,
    fail_on: FailOn | None = None,
    state: ModelState = "updated",
    frequency_band: float = 0.01,
    mac_band: float = 0.05,
    solver: str | None = None,
    units: str | None = None,
    subcase: int | None = None,
    step: int | None = None,
    summary: StrPath | None = None,
    junit: StrPath | None = None,
    settings: Settings = (),
    progress: bool = False,
    prefect: bool = False,
) -> PreCheckReport | BaselineCheck:
    """Check campaign, test and model before updating, or a deck, alone or with the files of its
    test.

    run: whether to compute the model's modes. against: an earlier update, the baseline with which
    the model is compared instead. record: another update, to compare instead of the model. fail_on:
    verdicts of these updates that make the flow run fail, overrides `run.fail_on`. state: model of
    the baseline. frequency_band, mac_band: allowed increase of a relative frequency error,
    and allowed decrease of a MAC. summary, junit: files for CI, in Markdown and XML.
    """
    given = locals()
    given["no_run"] = not given.pop("run")
    found: PreCheckReport | BaselineCheck = _found("check", given)
    return found


def screen(
    campaign: CampaignLike,
    method: ScreeningMethod = "local",
    *,
    points: int | None = None,
    choose: int | None = None,
    levels: int | None = None,
    seed: int = 1,
    out: StrPath | None = None,
    figures: StrPath | None = None,
    page: StrPath | None = None,
    runs: StrPath = "runs",
    settings: Settings = (),
    progress: bool = False,
    prefect: bool = False,
) -> Screening:
    """Screen candidate parameters and propose which to update; writes `screening.h5`.

    points: maximum number of points of the design. choose: number of parameters to propose. levels:
    number of levels per parameter, for morris. out: campaign file with only the
    proposed parameters.
    """
    found: Screening = _found("screen", locals())
    return found


def sample(
    campaign: CampaignLike,
    *,
    record: StrPath | CampaignRun | None = None,
    state: ModelState | None = None,
    points: int | None = None,
    walkers: int | None = None,
    steps: int = 2000,
    checks: int | None = None,
    seed: int = 1,
    figures: StrPath | None = None,
    page: StrPath | None = None,
    runs: StrPath = "runs",
    settings: Settings = (),
    progress: bool = False,
    prefect: bool = False,
) -> PosteriorRecord:
    """Sample the posterior of a campaign's parameters; writes `posterior.h5`.

    record: update from whose final values to start, by default the newest one in `runs`. state:
    "initial" starts over the whole bounds instead. points: number of solver runs over the range.
    walkers, steps: of the sampler. checks: number of posterior points to verify by solving. Raises
    CampaignError if the surrogate remains too inaccurate.
    """
    found: PosteriorRecord = _found("sample", locals())
    return found


def scatter(
    campaign: CampaignLike,
    *,
    of: Sequence[str] = (),
    measurement_deviation: float | None = None,
    record: StrPath | CampaignRun | None = None,
    state: ModelState | None = None,
    points: int | None = None,
    seed: int = 1,
    figures: StrPath | None = None,
    page: StrPath | None = None,
    runs: StrPath = "runs",
    settings: Settings = (),
    progress: bool = False,
    prefect: bool = False,
) -> ScatterRecord:
    """Estimate the scatter of a campaign's parameters from repeated tests; writes `scatter.h5`.

    of: names of the parameters that differ from test to test, by default all.
    measurement_deviation: relative scatter of a frequency due to measurement alone. record, state:
    as for `sample`.
    """
    found: ScatterRecord = _found("scatter", locals())
    return found


def validate(
    campaign: CampaignLike,
    *,
    leave_one_out: bool = False,
    settings: Settings = (),
    progress: bool = False,
    prefect: bool = False,
) -> Validation:
    """Validate an update: predict held-out data before and after it.

    Uses what the campaign holds out, or each used mode in turn.
    """
    found: Validation = _found("validate", locals())
    return found


def localise(
    campaign: CampaignLike,
    *,
    record: StrPath | CampaignRun | None = None,
    state: ModelState | None = None,
    configuration: str | None = None,
    changes: bool = True,
    apply: int | None = None,
    out: StrPath | None = None,
    figures: StrPath | None = None,
    runs: StrPath = "runs",
    settings: Settings = (),
    progress: bool = False,
    prefect: bool = False,
) -> Localisation:
    """Locate modelling errors of the updated model, or of the initial one without an update.

    record: run whose updated model to examine, by default that of the campaign in `runs`. state:
    examine this model. configuration: name of the one to examine, if the campaign has several.
    changes: look for masses, springs and absorbers that the model lacks. apply: number of the
    change to write into a new deck and the campaign file `out`.
    """
    found: Localisation = _found("localise", locals())
    return found


def compare(
    campaigns: Paths,
    runs: StrPath = "runs",
    *,
    settings: Settings = (),
    progress: bool = False,
    prefect: bool = False,
) -> ModelChoice:
    """Compare models of one test by their evidence, and find what would decide between them.

    campaigns: files of campaigns, each updated unless its folder in `runs` has the update.
    """
    found: ModelChoice = _found("compare", locals())
    return found


def confirm(
    run: StrPath | CampaignRun,
    runs: StrPath = "runs",
    *,
    by: Literal["auto", "modes", "matrices"] = "auto",
    fail_on: FailOn | None = None,
    settings: Settings = (),
    progress: bool = False,
    prefect: bool = False,
) -> CampaignRun:
    """Let the solver confirm the answer of an update with `update.confirm: later`.

    run: its run folder, campaign file, or result. by: as `update.confirm`. fail_on: as of `update`.
    """
    found: CampaignRun = _found("confirm", locals())
    return found


def history(
    of: CampaignLike | Sequence[str | Path],
    runs: StrPath = "runs",
    *,
    csv: StrPath | None = None,
    figures: StrPath | None = None,
    page: StrPath | None = None,
    settings: Settings = (),
) -> StructureHistory | RunDifference:
    """Show the history of a structure: its runs, trends, and whether it changed.

    of: a campaign or run folder; or a list of it with one or two dates, or of two runs, for what
    changed between them. csv: file for the table of runs.
    """
    words = [of] if isinstance(of, Campaign | str | Path | Mapping) else list(of)
    given: dict[str, Any]
    given = {"of": [_campaign_path(word, None) for word in words], "runs": runs, "prefect": False}
    given |= {"progress": False, "csv": csv, "figures": figures, "page": page, "settings": settings}
    found: StructureHistory | RunDifference = _found("history", given)
    return found


def fleet(
    of: StrPath | Sequence[StrPath],
    runs: StrPath = "runs",
    *,
    update: bool = False,
    parallel: int | None = None,
    fail_on: FailOn | None = None,
    page: StrPath | None = None,
    settings: Settings = (),
    progress: bool = False,
    prefect: bool = False,
) -> tuple[WatchedStructure, ...]:
    """Return many structures with their newest runs, the worst first.

    of: campaign files, run folders, folders of run folders, or patterns of these. update: update
    the campaigns first, `parallel` at a time; failures are in the structures and raise nothing.
    """
    words = [of] if isinstance(of, str | Path) else list(of)
    given = {**locals(), "of": [Path(word) for word in words]}
    del given["words"]
    found: tuple[WatchedStructure, ...] = _found("fleet", given)
    return found


def receive(
    campaign: CampaignLike,
    lab: StrPath | Sequence[StrPath] = (),
    runs: StrPath = "runs",
    *,
    settle: float = 30.0,
    again: bool = False,
    band: str | None = None,
    order: int = 60,
    fail_on: FailOn | None = None,
    settings: Settings = (),
    progress: bool = False,
    prefect: bool = False,
) -> tuple[ReceivedFile, ...]:
    """Update with each new test of the lab's folder, oldest first, and return what became of them.

    lab: folders in which tests arrive, or test files; those that were received before are left
    alone. settle: seconds for which a file has not changed before it is read. again: also judge
    files that were set aside again. band: for identification, "5,80" Hz; order: pairs of poles.
    """
    given = {
        **locals(),
        "lab": [Path(one) for one in ([lab] if isinstance(lab, str | Path) else lab)],
    }
    found: tuple[ReceivedFile, ...] = _found("receive", given)
    return found


def pretest(
    campaign: CampaignLike,
    *,
    modes: Sequence[int] = (),
    sensors: int | None = None,
    method: PlacementMethod = "effective_independence",
    candidates: StrPath = "surface",
    directions: Directions = "xyz",
    triaxial: bool = False,
    distance: float | None = None,
    exciters: int = 1,
    by_mass: bool = False,
    out: StrPath | None = None,
    picture: StrPath | None = None,
    settings: Settings = (),
    progress: bool = False,
    prefect: bool = False,
) -> Pretest:
    """Choose sensor and exciter positions from the model alone.

    modes: numbers of elastic modes, from 1. sensors: number of sensors. candidates: surface, all,
    or a file of nodes. triaxial: count three directions at a node as one sensor. distance: minimum
    between sensors, in the deck's length unit. by_mass: weight shapes by the mass at each
    candidate. out: CSV file of the sensors as points of a test. picture: PNG file.
    """
    found: Pretest = _found("pretest", locals())
    return found


def correlate(
    first: Paths,
    second: Paths | None = None,
    *,
    state: ModelState = "updated",
    settings: Settings = (),
    orthogonality: MassReduction | None = None,
    at: At = None,
    second_at: At = None,
    solver: str | None = None,
    units: str | None = None,
    out: StrPath | None = None,
    figures: StrPath | None = None,
    progress: bool = False,
    prefect: bool = False,
) -> Correlation:
    """Compare two campaigns, decks, records or tests, or one with its own test: pairs, MAC, COMAC.

    state: model of a record. at, second_at: parameter values of the campaigns. out: CSV file.
    """
    found: Correlation = _found("correlate", locals())
    return found


def expand(
    campaign: CampaignLike,
    test: Paths = (),
    method: ExpansionMethod | None = None,
    *,
    modes: int | None = None,
    at: At = None,
    out: StrPath | None = None,
    paraview: StrPath | None = None,
    figures: StrPath | None = None,
    page: StrPath | None = None,
    solver: str | None = None,
    units: str | None = None,
    subcase: int | None = None,
    step: int | None = None,
    settings: Settings = (),
    progress: bool = False,
    prefect: bool = False,
) -> Expansions:
    """Expand the test's shapes to all nodes of a campaign's model or a deck, by all methods or one.

    modes: number of elastic modes in SEREP's basis, by default chosen with held-out sensors. out:
    test file. paraview: folder.
    """
    found: Expansions = _found("expand", locals())
    return found


def reduce(
    campaign: CampaignLike,
    method: ReductionMethod = "guyan",
    masters: Sequence[str] | StrPath = (),
    *,
    test: Paths = (),
    modes: int | None = None,
    at: At = None,
    out: StrPath | None = None,
    page: StrPath | None = None,
    solver: str | None = None,
    units: str | None = None,
    subcase: int | None = None,
    step: int | None = None,
    settings: Settings = (),
    progress: bool = False,
    prefect: bool = False,
) -> ModelReduction:
    """Reduce a model to masters ("12.z", "13", or a file of them), by default its test's sensors.

    modes: number of modes to compare, which SEREP keeps or Craig-Bampton adds. out: file for the
    matrices.
    """
    found: ModelReduction = _found("reduce", locals())
    return found


def direct(
    campaign: CampaignLike,
    test: Paths = (),
    method: DirectMethod = "berman",
    filling: Filling = "kidder",
    *,
    mass_normalised: bool = False,
    at: At = None,
    out: StrPath | None = None,
    page: StrPath | None = None,
    solver: str | None = None,
    units: str | None = None,
    subcase: int | None = None,
    step: int | None = None,
    settings: Settings = (),
    progress: bool = False,
    prefect: bool = False,
) -> DirectCorrection:
    """Correct a model's stiffness and mass matrices directly, and report what that breaks in them.

    mass_normalised: whether the test's shapes have unit modal mass in the model's units. out: file
    for the matrices.
    """
    found: DirectCorrection = _found("direct", locals())
    return found


def twin(
    campaign: CampaignLike,
    solvers: str = "nastran,calculix",
    *,
    at: At = None,
    settings: Settings = (),
    progress: bool = False,
    prefect: bool = False,
) -> Twin:
    """Compute the modes of one model with several solvers, and compare them with those of the
    first.

    solvers: their names, separated by commas.
    """
    found: Twin = _found("twin", locals())
    return found


def identify(
    test: StrPath | Sequence[StrPath] | Measurement | MeasuredFrfs,
    band: tuple[float, float] | None = None,
    order: int = 60,
    pick: Sequence[float] = (),
    *,
    criteria: tuple[float, float, float] = (0.01, 0.05, 0.02),
    estimator: Literal["h1", "h2"] | None = None,
    segment: float | None = None,
    window: Literal["hann", "boxcar"] | None = None,
    out: StrPath | None = None,
    figures: StrPath | None = None,
) -> Identification | OperationalModes:
    """Identify modes from response functions, or from time histories with or without a force.

    band: in Hz. pick: take the poles nearest to these frequencies, Hz. criteria: relative
    tolerances of a stable pole in frequency, damping and shape. estimator, segment (s), window: for
    response functions from time histories. out: test file for the modes. figures: folder.
    """
    settings = IdentificationSettings(band, order, tuple(pick), Criteria(*criteria))
    outputs, files = None, []
    if isinstance(test, MeasuredFrfs):
        test = Measurement(frfs=test)
    elif not isinstance(test, Measurement):
        files = _paths(test)
        test, outputs = read_functions(files, SpectraSettings(estimator, segment, window))
    places = [None if place is None else Path(place) for place in (out, figures)]
    with named_extras():
        return identify_test(test, outputs, settings, files, *places)[0]


def read_test(paths: StrPath | Sequence[StrPath]) -> Measurement:
    """Read a test from its file, or from several files (modes, geometry, response functions)."""
    return read_measurement(_paths(paths))


def read_record(path: StrPath) -> CampaignRun:
    """Read an update from its run folder or campaign.h5. Raises StoreError, StoreDamaged."""
    return read_run(Path(path))


def _found(name: str, given: dict[str, Any]) -> Any:
    """Return the result of a study; given: the arguments of its function, by name."""
    study = find_study(name)
    first = study.fields[0].name
    loaded, settings, watch = None, given.pop("settings"), given.pop("on_iteration", None)
    own = given.pop("responses", ())
    if "campaign" in given:
        campaign = given.pop("campaign")
        called = isinstance(campaign, Mapping) and user_function(campaign) is not None
        if (own or called) and not isinstance(campaign, Campaign):
            starts = given.pop("starts", None)
            more = [] if starts is None else [f"update.starts={starts}"]
            campaign, settings = load(campaign, [*_texts(settings), *more]), ()
        if given.get("test") and not isinstance(campaign, str | Path):
            raise CampaignError("a test requires the path of a deck or of a campaign file")
        if isinstance(campaign, Campaign):
            if settings:
                raise CampaignError("the campaign is loaded already; give the settings to load")
            loaded, settings = campaign, campaign.settings
        given[first] = _campaign_path(campaign, None)
    watched: AbstractContextManager[Progress] = (
        ConsoleProgress(terminal(stderr=True)).shown()
        if given.pop("progress")
        else nullcontext(Unwatched())
    )
    door = _door(given.pop("prefect"))
    parameters = {"settings": _texts(settings)} | {
        item.name: _parameter(item, given[item.name]) for item in study.fields if item.name in given
    }
    if own and loaded is not None:
        case = loaded.case
        compared = (*case.compared, own_response(own, case.test))
        loaded = replace(loaded, cases=(replace(case, compared=compared),))
    with named_extras(), watched as progress, _without_past(loaded) as loaded:
        seen = progress if watch is None else Watched(progress, watch)
        end = carried_out(study, parameters, seen, prefect=door, campaign=loaded)
    if end.failure is not None:
        raise end.failure
    return end.found


@contextmanager
def _without_past(campaign: Campaign | None) -> Iterator[Campaign | None]:
    """Yield the campaign, with an empty store of its own if its model is a function without a
    version: what such a function returned before may be out of date."""
    program = None if campaign is None else campaign.cases[0].solver.program
    if not isinstance(program, FunctionProgram) or program.function.version:
        yield campaign
        return
    assert campaign is not None
    with TemporaryDirectory(prefix="modetune-") as folder:
        yield replace(campaign, store=Store(Path(folder)))


def _door(start: bool) -> Literal["start", "find", "off"]:
    """Return the server that a function uses: one that it may start, an existing one, or none."""
    if os.environ.get("MODETUNE_NO_PREFECT", "").lower() in ("1", "true", "t", "yes", "y", "on"):
        return "off"
    return "start" if start else "find"


def _parameter(item: StudyParameter, value: Any) -> Any:
    """Return an argument of a function in its study's form."""
    several = get_origin(item.json_kind) is list
    if isinstance(value, Mapping):
        return [f"{key}={float(number)!r}" for key, number in value.items()]
    if isinstance(value, CampaignRun):
        return value.folder
    if item.is_path and several:
        return split_files(str(value)) if isinstance(value, str | Path) else _paths(value or ())
    return ",".join(value) if isinstance(value, list | tuple) and not several else value


def _campaign_path(campaign: CampaignLike, folder: StrPath | None) -> Path:
    """Return the file of a campaign, after writing it if the campaign consists of objects."""
    if isinstance(campaign, Campaign):
        return campaign.file
    if isinstance(campaign, Mapping):
        return write_campaign(campaign, None if folder is None else Path(folder))
    return Path(campaign)


def _paths(paths: Paths) -> list[Path]:
    return [Path(path) for path in ([paths] if isinstance(paths, str | Path) else paths)]


def _texts(settings: Settings) -> list[str]:
    if isinstance(settings, Mapping):
        return [f"{key}={value}" for key, value in settings.items()]
    return list(settings)
