"""The record of a campaign, its run folder, and the summary for people and machines.

A record under way is written at most once in a second, and in a tenth of the time at most, since
writing each would take a campaign with all results in the store, or with hundreds of parameters,
longer than its iterations; the newest record is always written. A kill loses at most the view of
that time's work: its results are stored.
"""

from __future__ import annotations

import hashlib
import platform
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from modetune import __version__
from modetune.core.errors import ModesError, StorageUnavailable
from modetune.core.measurement.sensor_map import global_directions
from modetune.core.mesh import Mesh, global_shapes
from modetune.core.modes import ModeSet, mode_set
from modetune.core.monitoring.drift import Drift
from modetune.core.storage.campaign_record import (
    CampaignRecord,
    IterationRecord,
    RunCounts,
    SensorPlaces,
    read_record,
    write_record,
)
from modetune.core.storage.keys import Json
from modetune.core.surface import Surface
from modetune.core.updating.verdict import FailOn, TrustVerdict
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import Case
from modetune.flows.extras import named_extras
from modetune.flows.report.comparison import fresh_matrices, mac_table
from modetune.flows.report.field_tables import fields_json
from modetune.flows.report.form_verdict import verdict_summary
from modetune.flows.report.headline import first_line
from modetune.flows.report.mode_shapes import ModeShapes, mode_shapes
from modetune.flows.report.mode_tables import (
    ModeRow,
    held_out_rows,
    mode_labels,
    mode_rows,
    unmatched_modes,
)
from modetune.flows.report.parameter_tables import ParameterRow, parameter_rows
from modetune.flows.report.report_file import PAGE
from modetune.flows.report.response_tables import response_rows
from modetune.flows.report.tables import frame, json_object
from modetune.flows.updating.diagnosis import (
    campaign_trust,
    field_answers,
    model_errors,
    parameter_errors,
    trust_summary,
)
from modetune.flows.updating.evaluation import Evaluation, Matrix
from modetune.flows.updating.forecast import Forecast

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr
    from matplotlib.figure import Figure

#: Packages whose arithmetic a campaign's numbers depend on, in addition to the solver.
PACKAGES = ("numpy", "scipy", "h5py")
#: Seconds that a record may wait to be written, and times what writing the one before took.
LATE_S, LATE = 1.0, 10.0


def campaign_record(
    campaign: Campaign,
    iterations: Sequence[IterationRecord],
    matrix: Matrix | None,
    status: str,
    reason: str,
    runs: RunCounts,
    wall_s: float,
    end: Evaluation | None = None,
) -> CampaignRecord:
    """Return the present record of a campaign; standard errors are by its newest matrix.

    end: the evaluation where updating ended; without it errors are those of the test's noise.
    """
    accepted, only = [item for item in iterations if item.accepted], campaign.only
    own = campaign.parameters
    of_model = None if end is None else model_errors(campaign, end)
    errors = parameter_errors(campaign, accepted[-1], matrix, of_model)
    answers = () if status == "running" else field_answers(campaign, iterations, matrix)
    return CampaignRecord(
        name=campaign.name,
        campaign_text=campaign.text,
        settings=campaign.settings,
        modetune_version=__version__,
        solver=campaign.solver_name,
        solver_version=campaign.solver_version(),
        parameters=own,
        deck_values=np.array(
            [campaign.deck_value(item) for item in (*own.parameters, *own.dependents)]
        ),
        test=campaign.test,
        iterations=tuple(iterations),
        status=status,
        reason=reason,
        updated=accepted[-1].parameters,
        standard_errors=errors.standard_errors,
        repeatability=errors.repeatability,
        correlation=errors.correlation,
        runs=runs,
        wall_s=wall_s,
        surface=None if only is None else shown_surface(only),
        geometry=None if only is None else only.measurement.geometry,
        # Pictures draw sensors at their places, without what moves those on arms.
        sensors=replace(only.sensors, sections=None)
        if only is not None and only.sensors.n_sensors
        else None,
        places=None if only is None else sensor_places(only),
        frfs=None if only is None else only.measurement.frfs,
        units=campaign.cases[0].units,
        e1_frequency=campaign.tolerances.frequency,
        e1_mac=campaign.tolerances.mac,
        e2=campaign.update.e2,
        configurations=campaign.configurations,
        splits=campaign.splits,
        versions=_versions(),
        # A large deck takes a moment to digest, so only the final record has its digest.
        deck_digest="" if status == "running" else _deck_digest(campaign),
        trust=None
        if status == "running"
        else campaign_trust(campaign, iterations, matrix, errors, status == "converged", answers),
        fields=answers,
        covariance=errors.covariance,
        environment=campaign.environment,
        measured_at=campaign.measured_at,
    )


@cache
def _versions() -> tuple[str, ...]:
    python = f"Python {platform.python_version()}"
    return (python, *(f"{name} {version(name)}" for name in PACKAGES), platform.platform())


def _deck_digest(campaign: Campaign) -> str:
    """Return SHA-256 and name of each deck's file, as `sha256sum` does, without includes."""
    files = [file for each in campaign.cases if (file := each.solver.deck.summary.file) is not None]
    try:
        texts = [f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.name}" for file in files]
    except OSError:  # moved since it was read
        return ""
    return "; ".join(dict.fromkeys(texts))


def summary(record: CampaignRecord, run_dir: Path) -> dict[str, Json]:
    """The `--json` object of `modetune update`."""
    return json_object(
        record,
        "status reason",
        headline=first_line(record),
        verdict=record.verdict,
        ended_at=record.trust and record.trust.ended,
        iterations=record.iterations[-1].number,
        solver_runs=record.runs,
        parameters=parameter_rows(record),
        modes=mode_rows(record),
        unmatched=[record.test.numbers[place] for place in unmatched_modes(record)],
        mean_error_initial=np.abs(record.iterations[0].frequency_errors).mean(),
        mean_error_updated=np.abs(record.best.frequency_errors).mean(),
        responses=response_rows(record),
        held_out=held_out_rows(record.held_out),
        fields=fields_json(record),
        splits=record.splits,
        sensitivity_skipped=sum(item.sensitivity_skipped for item in record.iterations),
        wall_s=round(record.wall_s, 3),
        core_minutes=round(record.runs.core_s / 60.0, 4),
        licence_minutes=round(record.runs.licence_s / 60.0, 4),
        run_dir=run_dir,
        solver=record.solver,
        solver_version=record.solver_version,
        trust=trust_summary(record.trust),
        model_form=verdict_summary(record),
    )


def shown_surface(case: Case) -> Surface | None:
    """Return the model's surface, None where it has no coordinates (only matrices)."""
    return case.surface if case.surface.nodes.size else None


def sensor_places(case: Case) -> SensorPlaces | None:
    """Return sensors on the model in global axes, None where it has no coordinates."""
    mesh, mapping = case.solver.deck.mesh(), case.mapping
    if mesh.nodes.size == 0 or mapping.sensors.n_sensors == 0:
        return None
    sensors, places = mapping.sensors, mapping.places[mapping.rows]
    at_nodes = mesh.coordinates[mesh.rows(sensors.model_nodes)]
    return SensorPlaces(
        coordinates=np.where(np.isfinite(places), places, at_nodes),
        directions=global_directions(sensors.model_nodes, sensors.directions, mesh),
    )


def shown_field(campaign: Campaign, evaluation: Evaluation) -> ModeSet:
    """Return the paired modes' translations at the surface's nodes, in global axes."""
    case, part = campaign.only, evaluation.parts[0]
    if case is None or case.surface.nodes.size == 0:
        return mode_set([])
    surface, paired = case.surface, part.whole.elastic.select(part.pairing.computed)
    frames = case.solver.deck.mesh().frames
    shown = set(surface.nodes.tolist())
    turned = {node: axes for node, axes in frames.items() if node in shown}
    shapes = global_shapes(Mesh(surface.nodes, surface.coordinates, (), turned), paired)
    return mode_set(
        paired.frequencies_hz,
        shapes.transpose(1, 2, 0).reshape(3 * surface.nodes.size, paired.n_modes),
        np.repeat(surface.nodes, 3),
        np.tile((1, 2, 3), surface.nodes.size),
    )


@contextmanager
def unfinished_record(path: Path) -> Iterator[Callable[[CampaignRecord], None]]:
    """Yield a function that writes a record to a file; the newest is in it at the end.

    Raises StorageUnavailable, of a record that waited with the next one.
    """
    lock, newest = threading.Lock(), list[CampaignRecord]()
    due = time.monotonic() + LATE_S
    timer: threading.Timer | None = None

    def write() -> None:
        nonlocal due, timer
        with lock:
            if timer is not None:
                timer.cancel()
            timer = None
            if newest:
                began = time.monotonic()
                write_record(path, newest.pop())
                ended = time.monotonic()
                due = ended + max(LATE_S, LATE * (ended - began))

    def write_late() -> None:
        with suppress(StorageUnavailable):
            write()

    def keep(record: CampaignRecord) -> None:
        nonlocal timer
        with lock:
            newest[:] = [record]
        left = due - time.monotonic()
        if record.status != "running" or left <= 0.0:
            write()
        elif timer is None:
            timer = threading.Timer(left, write_late)
            timer.start()

    try:
        yield keep
    finally:
        write_late()


@dataclass(frozen=True, slots=True, repr=False)
class CampaignRun:
    """A campaign's end: its record, its folder, the updated deck and the report's page there.

    forecast: what it was expected to cost, where that was asked for. page: None where there is
    none. fail_on: what makes the update fail. drift: of the structure over its runs, None where the
    run was read from its record or has too many parameters. news: whether it shows a change that
    the run before it did not show.
    """

    record: CampaignRecord
    folder: Path
    updated_deck: Path
    forecast: Forecast | None = None
    page: Path | None = None
    fail_on: FailOn = "never"
    drift: Drift | None = None
    news: bool = False

    @property
    def converged(self) -> bool:
        """Whether e1 is met."""
        return self.record.status == "converged"

    @property
    def verdict(self) -> TrustVerdict:
        """How far the updated parameters can be trusted."""
        return self.record.verdict

    @property
    def exit_code(self) -> int:
        """The exit code of `modetune update`: 3 where e1 is not met, else 6 where `fail_on`
        excludes the verdict, 7 where it excludes a change of the structure, else 0."""
        if not self.converged:
            return 3
        if self.fail_on == "change":
            return 7 if self.record.state == "changed" else 0
        return 6 if self.verdict.excluded_by(self.fail_on) else 0

    @property
    def parameters(self) -> pd.DataFrame:
        """A row a parameter: initial and updated value, relative to the deck, standard error."""
        return frame(parameter_rows(self.record), ParameterRow).set_index("name")

    @property
    def modes(self) -> pd.DataFrame:
        """A row a mode: frequencies in Hz and MAC before and after, errors as shares."""
        return frame(mode_rows(self.record), ModeRow).set_index("mode")

    @property
    def mac(self) -> pd.DataFrame:
        """MAC of the test's modes (rows) and the updated model's elastic modes (columns)."""
        import pandas as pd

        record, last = self.record, self.record.best
        table = mac_table(record, last).T
        rows = mode_labels(record)
        return pd.DataFrame(table, rows[: len(table)], range(1, table.shape[1] + 1))

    @property
    def shapes(self) -> ModeShapes:
        """Shapes of test and model at the sensors. Raises ModesError without measured shapes."""
        return mode_shapes(self.record)

    @property
    def sensitivities(self) -> pd.DataFrame:
        """Newest (df/f) / (dp/p) by mode and parameter. Raises ModesError where none were
        computed."""
        import pandas as pd

        matrices = fresh_matrices(self.record)
        if not matrices:
            raise ModesError(f"{self.record.name}: no sensitivities were computed")
        rows = pd.Index([row.label for row in mode_rows(self.record)], name="mode")
        columns = pd.Index(self.record.parameters.names, name="parameter")
        return pd.DataFrame(matrices[-1][1], rows, columns)

    def to_xarray(self) -> xr.Dataset:
        """Return frequencies, MAC, shapes and sensitivities with named axes.

        Axes are mode, model (test, initial, updated), dof and parameter. What the record lacks is
        left out. Raises ModetuneError without xarray.
        """
        with named_extras():
            import xarray as xr

        frequencies = self.modes[["test_hz", "initial_hz", "updated_hz"]].to_numpy()
        models, parts = ["test", "initial", "updated"], {}
        parts["frequency_hz"] = xr.DataArray(frequencies, dims=["mode", "model"])
        coordinates = {"mode": [row.label for row in mode_rows(self.record)], "model": models}
        if self.record.test.has_shapes:
            shapes = self.shapes
            each = np.stack([shapes.test, shapes.initial, shapes.updated])
            parts["shape"] = xr.DataArray(each, dims=["model", "dof", "mode"])
            macs = np.stack([np.ones(len(shapes.modes)), shapes.mac_initial, shapes.mac_updated])
            parts["mac"] = xr.DataArray(macs, dims=["model", "mode"])
            coordinates["dof"] = list(shapes.dofs)
        if fresh_matrices(self.record):
            parts["sensitivity"] = xr.DataArray(
                self.sensitivities.to_numpy(), dims=["mode", "parameter"]
            )
            coordinates["parameter"] = list(self.record.parameters.names)
        return xr.Dataset(parts, coordinates, {"name": self.record.name})

    @property
    def summary(self) -> dict[str, Any]:
        """What `modetune update --json` prints."""
        return dict(summary(self.record, self.folder))

    def plot_modes(self) -> Figure:
        """Frequencies of test and model, before and after."""
        return self._figure("frequencies")

    def plot_mac(self) -> Figure:
        """MAC of test and model, before and after. Raises ModesError without measured shapes."""
        return self._figure("mac_map")

    def plot_comac(self) -> Figure:
        """COMAC of each sensor. Raises ModesError without measured shapes."""
        return self._figure("comac")

    def plot_parameters(self) -> Figure:
        """Each parameter over the iterations, relative to the deck."""
        return self._figure("parameters")

    def plot_sensitivities(self) -> Figure:
        """The sensitivities that were computed. Raises ModesError where none were."""
        return self._figure("sensitivities")

    def plot_convergence(self) -> Figure:
        """Residual and slope (e2) over the iterations."""
        return self._figure("convergence")

    def __repr__(self) -> str:
        return "\n".join(self._lines())

    def _repr_html_(self) -> str:
        head = "<br>".join(self._lines()[:3])
        return f"<p>{head}</p>{self.modes.to_html()}{self.parameters.to_html()}"

    def _lines(self) -> list[str]:
        record = self.record
        first, last = (
            np.abs(item.frequency_errors) for item in (record.iterations[0], record.best)
        )
        return [
            first_line(record),
            f"{record.status}: {record.reason}",
            f"frequency errors: mean {first.mean():.2%} -> {last.mean():.2%}, worst "
            f"{first.max():.2%} -> {last.max():.2%}; iterations: {record.iterations[-1].number}",
            "parameters: "
            + ", ".join(
                f"{name} {value:.4g}"
                for name, value in zip(
                    record.parameters.names, record.parameters.shown(record.updated), strict=True
                )
            ),
            f"in {self.folder}",
        ]

    def _figure(self, name: str) -> Figure:
        from modetune.flows.report.campaign_charts import campaign_charts
        from modetune.flows.report.matplotlib_charts import matplotlib_figure

        for known, chart in campaign_charts(self.record):
            if known == name:
                return matplotlib_figure(chart)
        raise ModesError(f"{self.record.name}: there is nothing to show as {name}")


def read_run(path: Path) -> CampaignRun:
    """An update from its run folder or its campaign.h5. Raises StoreError, StoreDamaged."""
    file = path / "campaign.h5" if path.is_dir() else path
    record, folder = read_record(file), file.parent
    names = [item.split("  ", 1)[-1] for item in record.deck_digest.split("; ") if item]
    deck, page = folder.joinpath("updated", *names[:1]), folder / PAGE
    return CampaignRun(record, folder, deck, None, page if page.is_file() else None)
