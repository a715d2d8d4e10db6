"""The verbs of the command line for Python: the same names, the same work, results to look at.

Each takes a campaign, or the path of its file, and gives a result with frames (pandas), figures
(matplotlib) and a repr of a few lines. Nothing is shown and Prefect is not used unless asked.
`modetune` gives all of them: `import modetune; run = modetune.update("campaign.yaml")`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Literal

from modetune.adapters.test_files.measurements import read_measurement
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import MeasuredFrfs, Measurement
from modetune.core.updating.direct import Filling
from modetune.core.updating.results import ModalResult
from modetune.flows.campaign.campaign import Campaign, load_campaign, load_model
from modetune.flows.campaign.objects import write_campaign
from modetune.flows.campaign.sketch import looked_at
from modetune.flows.campaign.terminal import terminal
from modetune.flows.studies.check.judging import PreCheckReport, check_campaign
from modetune.flows.studies.condensation.direct import (
    DirectCorrection,
    DirectMethod,
    correct_directly,
)
from modetune.flows.studies.condensation.expand import Expansions, expand_shapes
from modetune.flows.studies.condensation.reduce import ModelReduction, reduce_model
from modetune.flows.studies.correlate.correlate import Correlation
from modetune.flows.studies.correlate.sides import correlate_sources, source
from modetune.flows.studies.identify.identify import Identification, IdentificationSettings
from modetune.flows.studies.identify.operational import OperationalModes, identified
from modetune.flows.studies.identify.reading import SpectraSettings, read_functions
from modetune.flows.studies.init.draft import Draft
from modetune.flows.studies.init.text import init_campaign
from modetune.flows.studies.localise.localise import Localisation, place_of
from modetune.flows.studies.localise.localise import localise as localise_error
from modetune.flows.studies.pretest.running import Pretest, run_pretest
from modetune.flows.studies.requests import (
    PretestSettings,
    ReductionMethod,
    ReductionRequest,
    SamplingRequest,
    ScatterRequest,
    ScreeningMethod,
    ScreeningRequest,
)
from modetune.flows.studies.sample.record import PosteriorRecord
from modetune.flows.studies.sample.running import sample_campaign
from modetune.flows.studies.scatter.record import ScatterRecord
from modetune.flows.studies.scatter.running import scatter_campaign
from modetune.flows.studies.screen.record import Screening
from modetune.flows.studies.screen.running import screen_campaign
from modetune.flows.studies.validate.leave_out import Validation
from modetune.flows.studies.validate.leave_out import leave_one_out as judge_left_out
from modetune.flows.studies.validate.leave_out import validate as judge_held_out
from modetune.flows.updating.display import ConsoleProgress
from modetune.flows.updating.modal_run import model_modes, parse_values
from modetune.flows.updating.prefect import shown
from modetune.flows.updating.run import CampaignRun, read_run
from modetune.flows.updating.starts import update_from_starts
from modetune.flows.updating.updating import Unwatched

StrPath = str | Path
#: A campaign, the path of its file, or its keys with arrays in place of files.
CampaignLike = Campaign | StrPath | Mapping[str, Any]
#: KEY.KEY: VALUE over the campaign file, or the same as the command line has it.
Settings = Mapping[str, Any] | Sequence[str]


def load(
    campaign: StrPath | Mapping[str, Any], settings: Settings = (), folder: StrPath | None = None
) -> Campaign:
    """A campaign from its file, or from Python objects with the same keys.

    In a mapping arrays may stand for the files of model and test: `model` with stiffness, mass
    (n, n), parts and dofs, `test` with frequencies_hz (n_modes,), mode_shapes (n_sensors, n_modes)
    and dofs. It is written as a campaign file into a folder, `.modetune/campaigns/NAME` unless
    named. settings: {"update.max_iterations": 5}. Raises CampaignError with all problems.
    """
    return _load(campaign, settings, folder, load_campaign)


def update(
    campaign: CampaignLike,
    runs: StrPath = "runs",
    *,
    settings: Settings = (),
    progress: bool = False,
    prefect: bool = False,
) -> CampaignRun:
    """Update a campaign's model until it agrees with its test, from all its `update.starts`.

    Leaves record, updated deck and report in `runs/NAME`. progress: lines on standard error.
    prefect: show the run on a Prefect server's pages. Raises SolverError, ModesError, StoreError.
    """
    campaign = campaign_of(campaign, settings)
    folder = Path(runs) / campaign.name
    with _watched(progress) as watcher:
        if not prefect:
            return update_from_starts(campaign, folder, watcher)
        with shown(campaign.name) as pages:
            run = update_from_starts(campaign, folder, watcher, pages)
            pages.ended(run.record, run.folder)
            return run


def init(
    deck: StrPath,
    test: StrPath | Sequence[StrPath] = (),
    out: StrPath | None = None,
    *,
    force: bool = False,
    settings: Settings = (),
) -> Draft:
    """Write a campaign file for a deck: its test, and what could be updated, with reasons.

    test: its files; out: the file, `campaign.yaml` beside the deck unless named; one that is there
    stays unless force. settings: `model.solver` and `model.units`, which are found in the deck
    unless given. Raises CampaignError, ModelError.
    """
    place = None if out is None else Path(out)
    return init_campaign(Path(deck), _paths(test), _texts(settings), place, force)


def modes(
    campaign: CampaignLike,
    at: Mapping[str, float] | None = None,
    *,
    number: int | None = None,
    settings: Settings = (),
) -> ModalResult:
    """The modes of a campaign's model or of a deck, rigid ones included, at the sensors and the
    nodes that are shown.

    at: parameters' values relative to the deck, by name; the initial ones unless named. number: how
    many modes. Raises CampaignError, SolverError, StoreError.
    """
    loaded = _looked_at(campaign, settings)
    return model_modes(loaded, _values(loaded, at), number)


def check(
    campaign: CampaignLike,
    test: StrPath | Sequence[StrPath] = (),
    *,
    run: bool = True,
    settings: Settings = (),
) -> PreCheckReport:
    """Judge campaign, test and model before updating, or a deck, alone or with a test's files.

    run: with one modal run beside the test.
    """
    return check_campaign(_looked_at(campaign, settings, test), run=run)


def screen(
    campaign: CampaignLike,
    method: ScreeningMethod = "local",
    *,
    points: int | None = None,
    choose: int | None = None,
    seed: int = 1,
    settings: Settings = (),
    progress: bool = False,
) -> Screening:
    """Which parameters the test can tell, and which to update.

    points: evaluation points at most; choose: how many parameters are proposed. Raises
    CampaignError, SolverError, ModesError, StoreError.
    """
    request = ScreeningRequest(method, points, seed, None, choose)
    with _watched(progress) as watcher:
        return screen_campaign(campaign_of(campaign, settings), request, watcher.working)


def sample(
    campaign: CampaignLike,
    *,
    record: StrPath | CampaignRun | None = None,
    points: int | None = None,
    seed: int = 1,
    settings: Settings = (),
    progress: bool = False,
) -> PosteriorRecord:
    """The posterior of a campaign's parameters.

    record: an update that it starts from; points: solver runs over the range. Raises CampaignError
    (the surrogate stays too poor), SolverError, ModesError, StoreError.
    """
    earlier = _run_of(record).record if record is not None else None
    request = SamplingRequest(points=points, seed=seed)
    with _watched(progress) as watcher:
        return sample_campaign(campaign_of(campaign, settings), request, watcher.working, earlier)


def scatter(
    campaign: CampaignLike,
    *,
    of: Sequence[str] = (),
    measurement_deviation: float | None = None,
    points: int | None = None,
    seed: int = 1,
    settings: Settings = (),
    progress: bool = False,
) -> ScatterRecord:
    """The scatter of a campaign's parameters behind that of its repeated tests.

    of: names of those that differ from test to test, all where none is named;
    measurement_deviation: of a frequency by the measurement alone, relative. Raises CampaignError,
    SolverError, ModesError, StoreError.
    """
    request = ScatterRequest(tuple(of), measurement_deviation, points, seed)
    with _watched(progress) as watcher:
        return scatter_campaign(
            campaign_of(campaign, settings), request, watcher.working, watcher=watcher
        )


def validate(
    campaign: CampaignLike,
    *,
    leave_one_out: bool = False,
    settings: Settings = (),
    progress: bool = False,
) -> Validation:
    """Judge an update by what it was not made from, before and after.

    By what the campaign holds out, or by each used mode in turn. Raises CampaignError, SolverError,
    ModesError, StoreError.
    """
    judge = judge_left_out if leave_one_out else judge_held_out
    with _watched(progress) as watcher:
        return judge(campaign_of(campaign, settings), watcher.working)


def localise(
    campaign: CampaignLike,
    *,
    record: StrPath | None = None,
    configuration: str | None = None,
    settings: Settings = (),
) -> Localisation:
    """Where the model is wrong, at the campaign's start or where an update left it.

    configuration: which one, where the campaign has several. Raises SolverError, ModesError.
    """
    place = place_of(
        campaign_of(campaign, settings), None if record is None else Path(record), configuration
    )
    return localise_error(place.campaign, place.theta)


def pretest(campaign: StrPath | Mapping[str, Any], **asked: Any) -> Pretest:
    """Places for sensors and exciters from the model alone.

    asked: fields of PretestSettings: modes, sensors, method, candidates, directions, triaxial,
    distance, exciters, by_mass. Raises CampaignError, ModesError, SolverError.
    """
    try:
        settings = PretestSettings(**asked)
    except TypeError as error:
        raise CampaignError(f"pretest: {error}") from None
    return run_pretest(_load(campaign, (), None, load_model), settings)


def correlate(
    first: StrPath,
    second: StrPath | None = None,
    *,
    state: Literal["updated", "initial"] = "updated",
    settings: Settings = (),
    orthogonality: Literal["guyan", "serep"] | None = None,
) -> Correlation:
    """Pairs, MAC and COMAC of two campaigns, decks, records or tests; of one, beside its own test.

    state: which model of a record. Raises CampaignError, SolverError, StoreError.
    """
    sides = source(Path(first)), source(Path(second)) if second is not None else None
    return correlate_sources(*sides, state, _texts(settings), orthogonality)


def expand(
    campaign: CampaignLike,
    test: StrPath | Sequence[StrPath] = (),
    method: str | None = None,
    *,
    modes: int | None = None,
    at: Mapping[str, float] | None = None,
    settings: Settings = (),
) -> Expansions:
    """The test's shapes at all nodes of a campaign's model or a deck, by all methods or one.

    modes: elastic modes of SEREP's basis, chosen by held-out sensors unless named; at: values of
    parameters. Raises CampaignError, SolverError, StoreError.
    """
    loaded = _looked_at(campaign, settings, test)
    return expand_shapes(loaded, _values(loaded, at), method, modes)


def reduce(
    campaign: CampaignLike,
    method: ReductionMethod = "guyan",
    masters: Sequence[str] = (),
    *,
    test: StrPath | Sequence[StrPath] = (),
    modes: int | None = None,
    at: Mapping[str, float] | None = None,
    settings: Settings = (),
) -> ModelReduction:
    """A model condensed to masters ("12.z", "13"), or to its test's sensors.

    modes: how many are compared, kept by SEREP or added by Craig and Bampton. Raises CampaignError,
    ModelError, SolverError, StoreError.
    """
    loaded = _looked_at(campaign, settings, test)
    asked = ReductionRequest(method, ",".join(masters), modes)
    return reduce_model(loaded, _values(loaded, at), asked)


def direct(
    campaign: CampaignLike,
    test: StrPath | Sequence[StrPath] = (),
    method: DirectMethod = "berman",
    filling: Filling = "kidder",
    *,
    mass_normalised: bool = False,
    at: Mapping[str, float] | None = None,
    settings: Settings = (),
) -> DirectCorrection:
    """A model's stiffness and mass corrected as whole matrices, and what that breaks in them.

    mass_normalised: whether the test's shapes are of unit modal mass in the model's own unit.
    Raises CampaignError, ModesError, ModelError, SolverError, StoreError.
    """
    loaded = _looked_at(campaign, settings, test)
    return correct_directly(loaded, _values(loaded, at), method, filling, mass_normalised)


def identify(
    test: StrPath | Sequence[StrPath] | Measurement | MeasuredFrfs,
    band: tuple[float, float] | None = None,
    order: int = 60,
    pick: Sequence[float] = (),
    *,
    estimator: Literal["h1", "h2"] | None = None,
    segment: float | None = None,
    window: Literal["hann", "boxcar"] | None = None,
) -> Identification | OperationalModes:
    """Modes from response functions or time histories; of responses alone from these.

    band in Hz; pick: take the poles nearest to these, Hz. estimator, segment (s), window: of
    response functions from time histories.
    """
    settings = IdentificationSettings(band, order, tuple(pick))
    outputs = None
    if isinstance(test, MeasuredFrfs):
        test = Measurement(frfs=test)
    elif not isinstance(test, Measurement):
        spectra = SpectraSettings(estimator, segment, window)
        test, outputs = read_functions(_paths(test), spectra)
    return identified(test, outputs, settings)


def read_test(paths: StrPath | Sequence[StrPath]) -> Measurement:
    """A test from its file, or from files that belong together (modes, geometry, functions)."""
    return read_measurement(_paths(paths))


def read_record(path: StrPath) -> CampaignRun:
    """An update from its run folder or campaign.h5. Raises StoreError, StoreDamaged."""
    return read_run(Path(path))


def campaign_of(campaign: CampaignLike, settings: Settings = ()) -> Campaign:
    """A campaign as it is, or loaded. Raises CampaignError."""
    if isinstance(campaign, Campaign):
        if settings:
            raise CampaignError("the campaign is loaded already; give the settings to load")
        return campaign
    return load(campaign, settings)


def _looked_at(
    campaign: CampaignLike, settings: Settings, test: StrPath | Sequence[StrPath] = ()
) -> Campaign:
    """A campaign, which may lack test and parameters, or that of a deck. Raises CampaignError."""
    if isinstance(campaign, str | Path):
        return looked_at(Path(campaign), _texts(settings), _paths(test))
    if test:
        raise CampaignError("a test stands beside the path of a deck or of a campaign file")
    return campaign_of(campaign, settings)


def _values(campaign: Campaign, at: Mapping[str, float] | None) -> dict[str, float]:
    asked = [f"{name}={float(value)!r}" for name, value in (at or {}).items()]
    return parse_values(campaign, asked)


def _paths(paths: StrPath | Sequence[StrPath]) -> list[Path]:
    return [Path(path) for path in ([paths] if isinstance(paths, str | Path) else paths)]


def _load(
    campaign: StrPath | Mapping[str, Any],
    settings: Settings,
    folder: StrPath | None,
    load: Callable[[Path, list[str]], Campaign],
) -> Campaign:
    if isinstance(campaign, Mapping):
        path = write_campaign(campaign, None if folder is None else Path(folder))
    else:
        path = Path(campaign)
    return load(path, _texts(settings))


def _texts(settings: Settings) -> list[str]:
    if isinstance(settings, Mapping):
        return [f"{key}={value}" for key, value in settings.items()]
    return list(settings)


def _run_of(record: StrPath | CampaignRun) -> CampaignRun:
    return record if isinstance(record, CampaignRun) else read_record(record)


def _watched(progress: bool) -> AbstractContextManager[Any]:
    return ConsoleProgress(terminal(stderr=True)).shown() if progress else nullcontext(Unwatched())
