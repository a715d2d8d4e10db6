"""Measured shapes on the whole mesh, by several methods side by side: `modetune model expand`.

The test itself selects the method: each sensor is held out once, a tenth of the test
points at a time, and filled from the others as unmeasured freedoms are. The error there is that of
the whole expansion as far as a test can know it; zero motion would have 100 %.

With u the measured motions as unknowns of the model (`core/condensation/measured_unknowns`) the
dynamic stiffness condensed to them at a frequency is exact there, so that Kidder's and the static
expansion from some of the sensors to others need no further factorisation: A_hh u_h = -A_hk u_k.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import get_args

import numpy as np
from scipy import sparse

from modetune.adapters.solver import ModalAnalysis
from modetune.adapters.test_files.measurements import check_out, write_modes
from modetune.core.algebra.factor_room import factor_room
from modetune.core.brief import brief
from modetune.core.condensation.expansion import (
    Places,
    serep_expansion,
    spline_expansion,
    static_expansion,
)
from modetune.core.condensation.measured_unknowns import MeasuredModel
from modetune.core.condensation.reduction import Reduction, dynamic, irs
from modetune.core.correlation.correlation import Shapes
from modetune.core.errors import CampaignError, ModelError, ModesError
from modetune.core.measurement.measurement import TestGeometry
from modetune.core.measurement.sensor_map import global_directions
from modetune.core.mesh import Mesh
from modetune.core.modes import Floats, Integers, MeasuredModes, ModeSet, dof_name, mode_set
from modetune.core.near_names import named
from modetune.core.parameters import Values
from modetune.core.storage.files import check_writable
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import RIGID_MODES
from modetune.flows.campaign.units import METRES
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.jobs.execution import solve_jobs
from modetune.flows.jobs.job import Job
from modetune.flows.report.chart import PARAMETER_COLOURS, Axis, Bars, Chart, Panel, names_of
from modetune.flows.studies.expand.request import ExpansionMethod
from modetune.flows.studies.full_model import (
    FullModel,
    by_sensors,
    full_model,
    relative,
    sensor_names,
)

#: Parts that the test points are held out in.
PARTS = 10
#: A direction is along an axis where its cosine is one to this.
ALONG = 1e-6
#: The warning where more than half of the motion at held-out sensors is wrong.
POOR = "; no motion at all would have 100 %: do not believe it between the sensors"
METHODS = get_args(ExpansionMethod)


@dataclass(frozen=True, slots=True)
class ExpandedShapes:
    """What one method made of the test.

    held_out: (n_modes,), relative error at sensors that were held out; at_sensors: (n_modes,),
    what it takes away from measured values; NaN and a reason where it is unavailable. modes: at
    the mesh's nodes, in the axes of `mesh`. n_basis: modes of SEREP's basis.
    """

    method: str
    held_out: Floats
    at_sensors: Floats
    condition: float = float("nan")
    n_basis: int = 0
    modes: ModeSet | None = None
    mesh: Mesh | None = None
    unavailable: str = ""

    @property
    def error(self) -> float:
        """Root mean square over the modes of the error at held-out sensors."""
        return float(np.sqrt(np.mean(self.held_out**2)))


@dataclass(frozen=True, slots=True, repr=False)
class Expansions:
    """The test's shapes on the whole model by all methods that were asked for.

    numbers: of the test's modes; left_out: sensors at places that cannot move. best: the method of
    the least error at held-out sensors, or the one that was asked for.
    """

    name: str
    numbers: tuple[int, ...]
    frequencies_hz: Floats
    n_sensors: int
    left_out: tuple[str, ...]
    methods: tuple[ExpandedShapes, ...]
    best: str

    __repr__ = brief

    @property
    def chosen(self) -> ExpandedShapes:
        return next(item for item in self.methods if item.method == self.best)

    @property
    def sentence(self) -> str:
        """Which method is best, for people."""
        return (
            f"{self.best}: error at held-out sensors {100.0 * self.chosen.error:.3g} % of "
            f"{len(self.numbers)} modes at {self.n_sensors} sensors"
            f"{POOR * (self.chosen.error > 0.5)}"
        )


@dataclass(frozen=True)
class _Test:
    """Shapes (n_sensors, n_modes) and what the methods need of the model."""

    campaign: Campaign
    values: Values
    frequencies_hz: Floats
    shapes: Shapes
    n_modes: int | None

    @cached_property
    def full(self) -> FullModel:
        return full_model(self.campaign, self.values)

    @cached_property
    def seen(self) -> tuple[MeasuredModel, Integers]:
        return self.full.seen(by_sensors(self.full), sensor_names(self.campaign))

    @cached_property
    def parts(self) -> list[Integers]:
        """Sensors that are held out together, all of a test point."""
        _, point = np.unique(self.campaign.case.sensors.nodes, return_inverse=True)
        count = min(PARTS, int(point.max()) + 1)
        return [np.flatnonzero(point % count == part) for part in range(count)]

    def held_out(self, fill: Callable[[Integers], Shapes]) -> Floats:
        """The error of what is filled in from the sensors of these rows, (n_sensors, n_modes)."""
        if len(self.parts) < 2:
            return np.full(self.shapes.shape[1], np.nan)
        found = np.zeros_like(self.shapes)
        everyone = np.arange(self.shapes.shape[0], dtype=np.int64)
        for part in self.parts:
            found[part] = fill(np.setdiff1d(everyone, part))[part]
        return relative(found - self.shapes, self.shapes)

    def result(
        self, method: str, held_out: Floats, modes: ModeSet, mesh: Mesh, seen: Shapes, worst: float
    ) -> ExpandedShapes:
        away = relative(seen - self.shapes, self.shapes)
        return ExpandedShapes(method, held_out, away, worst, modes=modes, mesh=mesh)

    def motion(self, on_equations: Shapes) -> ModeSet:
        """Shapes on the solver's equations at all nodes."""
        nodes, components, matrix = self.full.every_motion
        return self.modes(np.asarray(matrix @ on_equations), nodes, components)

    def modes(self, shapes: Shapes, nodes: Integers, components: Integers) -> ModeSet:
        damping = self.campaign.case.measured.modes.damping_ratios
        return mode_set(self.frequencies_hz, shapes, nodes, components, damping)

    @property
    def mesh(self) -> Mesh:
        return self.campaign.case.solver.deck.mesh()


def expand_shapes(
    campaign: Campaign,
    values: Values,
    method: str | None = None,
    n_modes: int | None = None,
) -> Expansions:
    """Expand the test of a campaign, by one method or by all that the model allows.

    n_modes: elastic modes of SEREP's basis, chosen where None. Raises CampaignError where no method
    is available or the test has no shapes, SolverError, StoreError.
    """
    wanted = METHODS if method is None else (named("--method", method, METHODS),)
    names = sensor_names(campaign)
    measured = campaign.case.measured
    shapes: Shapes = measured.modes.mode_shapes
    test = _Test(campaign, values, measured.modes.frequencies_hz, shapes, n_modes)
    held, room = set[int](), job_engine(campaign).room
    found = []
    for name in wanted:
        try:
            with factor_room(room):
                found.append(FILLERS[name](test))
        except (CampaignError, ModelError, ModesError) as error:
            nothing = np.full(len(measured.numbers), np.nan)
            found.append(ExpandedShapes(name, nothing, nothing, unavailable=str(error)))
    if "seen" in vars(test):
        held = set(range(len(names))) - set(test.seen[1].tolist())
    there = [item for item in found if not item.unavailable]
    if not there:
        raise CampaignError([f"{item.method}: {item.unavailable}" for item in found])
    best = min(there, key=lambda item: np.nan_to_num(item.error, nan=np.inf))
    return Expansions(
        name=campaign.name,
        numbers=measured.numbers,
        frequencies_hz=test.frequencies_hz,
        n_sensors=len(names),
        left_out=tuple(dof_name(names[place]) for place in sorted(held)),
        methods=tuple(found),
        best=best.method,
    )


def _serep(test: _Test) -> ExpandedShapes:
    """By as many of the model's elastic modes as leave the least error, or as were asked for."""
    case = test.campaign.case
    nodes = tuple(sorted(case.solver.deck.summary.node_ids))
    wanted = max(case.n_modes, RIGID_MODES + (test.n_modes or 0))
    (outcome,) = solve_jobs(
        job_engine(test.campaign), [Job(test.values, ModalAnalysis(wanted, nodes))]
    )
    elastic = outcome.result(ModalResult).elastic
    seen = np.asarray(case.sensors.matrix(elastic.nodes, elastic.components) @ elastic.mode_shapes)
    most = min(elastic.n_modes, seen.shape[0] - max(map(len, test.parts)))
    if test.n_modes is not None and test.n_modes > most:
        raise ModesError(
            f"--modes {test.n_modes}: {most} is the most, of {elastic.n_modes} elastic modes and "
            f"{seen.shape[0]} sensors of which some are held out"
        )
    tried: dict[int, Floats] = {}
    for count in range(1, most + 1) if test.n_modes is None else (test.n_modes,):
        with suppress(ModesError):  # modes that some of the sensors cannot distinguish
            tried[count] = test.held_out(partial(_combined, test, seen[:, :count]))
    if not tried:
        raise ModesError("the sensors cannot distinguish the modes of the model")
    count = min(tried, key=lambda number: float(np.nan_to_num(np.linalg.norm(tried[number]))))
    # The basis at the sensors is above the shapes themselves.
    whole, n_seen = np.vstack([seen, elastic.mode_shapes.real])[:, :count], seen.shape[0]
    found = serep_expansion(whole, test.shapes, np.arange(n_seen, dtype=np.int64))
    modes = test.modes(found.mode_shapes[n_seen:], elastic.nodes, elastic.components)
    told = test.result(
        "serep",
        tried[count],
        modes,
        test.mesh,
        np.asarray(found.mode_shapes[:n_seen]),
        float(found.condition.max()),
    )
    return replace(told, n_basis=count)


def _combined(test: _Test, basis: Floats, kept: Integers) -> Shapes:
    return serep_expansion(basis, test.shapes[kept], kept).mode_shapes


def _by_balance(test: _Test, frequencies_hz: Floats, method: str) -> ExpandedShapes:
    """Dynamic balance at a frequency a mode; with zero frequencies the static expansion."""
    seen, moving = test.seen
    shapes = test.shapes[moving]
    whole = np.zeros((seen.stiffness.shape[0], shapes.shape[1]), dtype=shapes.dtype)
    filled: dict[float, Reduction] = {}
    for frequency in np.unique(frequencies_hz).tolist():
        filled[frequency] = dynamic(seen.stiffness, seen.mass, seen.rows, frequency)
        these = np.flatnonzero(frequencies_hz == frequency)
        whole[:, these] = filled[frequency].transformation @ shapes[:, these]
    small = {
        frequency: item.stiffness - (2.0 * np.pi * frequency) ** 2 * item.mass
        for frequency, item in filled.items()
    }

    def fill(kept: Integers) -> Shapes:
        rows = np.flatnonzero(np.isin(moving, kept))
        found = np.zeros_like(test.shapes)
        for mode, frequency in enumerate(frequencies_hz.tolist()):
            stiffness = sparse.csr_array(small[frequency])
            one = static_expansion(stiffness, shapes[rows][:, [mode]], rows)
            found[moving, mode] = one.mode_shapes[:, 0]
        return found

    worst = max(item.condition for item in filled.values())
    seen_shapes = np.zeros_like(test.shapes)
    seen_shapes[moving] = shapes
    modes = test.motion(np.asarray(seen.back @ whole))
    return test.result(method, test.held_out(fill), modes, test.mesh, seen_shapes, worst)


def _irs(test: _Test) -> ExpandedShapes:
    seen, moving = test.seen
    shapes = test.shapes[moving]

    def fill(kept: Integers) -> Shapes:
        rows = np.flatnonzero(np.isin(moving, kept))
        part = irs(seen.stiffness, seen.mass, seen.rows[rows])
        found = np.zeros_like(test.shapes)
        found[moving] = part.transformation[seen.rows] @ shapes[rows]
        return found

    whole = irs(seen.stiffness, seen.mass, seen.rows)
    modes = test.motion(np.asarray(seen.back @ (whole.transformation @ shapes)))
    seen_shapes = np.zeros_like(test.shapes)
    seen_shapes[moving] = shapes
    return test.result("irs", test.held_out(fill), modes, test.mesh, seen_shapes, whole.condition)


def _spline(test: _Test) -> ExpandedShapes:
    sensors, mesh = test.campaign.case.sensors, test.mesh
    if not mesh.nodes.size:
        raise ModelError("the model has no places: it is matrices alone")
    directions = global_directions(sensors.model_nodes, sensors.directions, mesh)
    axes = np.abs(directions).argmax(axis=1)
    along = np.take_along_axis(directions, axes[:, None], axis=1)[:, 0]
    tilted = np.flatnonzero((np.abs(along) < 1.0 - ALONG) | sensors.turns)
    if tilted.size:
        dof = int(sensors.nodes[tilted[0]]), int(sensors.components[tilted[0]])
        raise ModelError(
            f"sensor {dof_name(dof)} measures no translation along a global axis, and a spline "
            "fills each of these on its own"
        )
    shapes = test.shapes * np.sign(along)[:, None]
    where = test.campaign.case.mapping.read_at(mesh)
    places = Places(where, (axes + 1).astype(np.int64))

    def fill(kept: Integers) -> Shapes:
        some = Places(where[kept], places.components[kept])
        found = spline_expansion(shapes[kept], some, places).mode_shapes
        return np.asarray(found * np.sign(along)[:, None])

    kinds = np.unique(places.components)
    nodes, components = np.repeat(mesh.nodes, kinds.size), np.tile(kinds, mesh.nodes.size)
    targets = Places(np.repeat(mesh.coordinates, kinds.size, axis=0), components)
    found = spline_expansion(shapes, places, targets)
    modes = test.modes(found.mode_shapes, nodes, components)
    plain = replace(mesh, frames={})  # splines are made along the global axes
    worst = float(found.condition.max())
    return test.result("spline", test.held_out(fill), modes, plain, test.shapes, worst)


FILLERS: Mapping[str, Callable[[_Test], ExpandedShapes]] = {
    "serep": _serep,
    "kidder": lambda test: _by_balance(test, test.frequencies_hz, "kidder"),
    "static": lambda test: _by_balance(test, np.zeros_like(test.frequencies_hz), "static"),
    "irs": _irs,
    "spline": _spline,
}


#: The series in its folder.
SERIES = "expanded"


def check_files(campaign: Campaign, out: Path | None, paraview: Path | None) -> None:
    """Refuse what cannot be written before the work is done. Raises CampaignError."""
    if out is not None:
        check_out(out)
    if paraview is not None:
        from modetune.adapters.paraview import check_series

        if not campaign.case.solver.deck.mesh().cells:
            raise CampaignError(
                f"{campaign.file}: a model of the solver {campaign.solver_name} has no elements, "
                "so there is nothing to show in ParaView; leave --paraview out"
            )
        check_writable(paraview, "name another place with --paraview")
        check_series(paraview, SERIES)


def write_files(
    campaign: Campaign, found: Expansions, out: Path | None, paraview: Path | None
) -> list[Path]:
    """Write what was asked for of the chosen method. Raises StorageUnavailable."""
    written: list[Path] = []
    modes, mesh = found.chosen.modes, found.chosen.mesh
    assert modes is not None
    assert mesh is not None
    if out is not None:
        nodes = np.flatnonzero(np.isin(mesh.nodes, modes.nodes))
        points = TestGeometry(
            nodes=mesh.nodes[nodes],
            coordinates=mesh.coordinates[nodes],
            frames=np.array(
                [mesh.frames.get(node, np.eye(3)) for node in mesh.nodes[nodes].tolist()]
            ).reshape(-1, 3, 3),
            metres=METRES[campaign.case.units],
        )
        text = (f"modetune expand: {found.sentence}",)
        write_modes(out, MeasuredModes(found.numbers, modes), points if nodes.size else None, text)
        written.append(out)
    if paraview is not None:
        from modetune.adapters.paraview import mode_grids, write_series

        grids = mode_grids(mesh, modes)
        written.append(write_series(paraview, SERIES, grids, modes.frequencies_hz))
    return written


def error_chart(found: Expansions) -> Chart:
    """The error at held-out sensors of each mode by each method."""
    shown: list[ExpandedShapes] = [item for item in found.methods if not item.unavailable]
    bars = tuple(
        Bars(item.method, 100.0 * item.held_out, colour)
        for item, colour in zip(shown, PARAMETER_COLOURS, strict=False)
    )
    panel = Panel(bars, Axis("mode of the test", names_of(found.numbers)), Axis("error, %"))
    title = f"{found.name}: error of expanded shapes at held-out sensors"
    return Chart(title, title, (panel,))
