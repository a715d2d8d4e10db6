"""Whether the model can be true: its mass and size, and how it is held, from one modal run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from modetune.adapters.solver import Solver
from modetune.core.algebra.eigen import DENSE, most_vectors, similar_vectors
from modetune.core.algebra.factor_room import factor_forecast
from modetune.core.algebra.pardiso import is_available
from modetune.core.algebra.pencil import shifted_pattern
from modetune.core.correlation.rigid_body import RigidBody, rigid_body_of_modes
from modetune.core.errors import ModelError, ModesError, SolverExhausted
from modetune.core.mesh import Mesh, edge_differences
from modetune.core.modes import Floats, ModeSet
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import RIGID_MODES, Case
from modetune.flows.campaign.schema import ModelCheck
from modetune.flows.campaign.units import KILOGRAMS, METRES, Units, guessed_units, unit_doubt
from modetune.flows.diagnosis.findings import MODEL, Finding, Level, Setting, setting
from modetune.flows.updating.mode_source import CaseState
from modetune.flows.updating.reduced_model import ByMatrices

#: Structures that are tested, metres and kilograms; beyond it the units are likely wrong.
SIZES_M = (1e-3, 1000.0)
MASSES_KG = (1e-4, 1e7)
#: What helps where size, units or mass are doubtful, each accepted by its name.
SIZE = "name the units that the deck is written in; `model.checks: [size]` accepts it"
UNITS = "name the units that the deck is written in; `model.checks: [units]` accepts them"
MASS = (
    "look at densities, point masses and units (Nastran: PARAM,WTMASS); `model.checks: [mass]` "
    "accepts it"
)
#: Nothing is heavier than osmium over its own box, kg/m3.
DENSEST = 22_600.0
#: A rigid-body frequency above this share of the first elastic one is not near zero.
NEAR_ZERO = 1e-3
#: Bars and plates of ten-node tetrahedra whose neighbouring corners move more unlike than this part
#: of their motion had frequencies 1 to 120 % too high; below it they were up to 9 % too high. The
#: error grows with the square: of 37 meshes, with sections from 1 x 1 to 7.5 x 1, none had a
#: frequency that was further off than FINER times the square of that part.
COARSE, FINER = 0.4, 0.7
#: Number of modes in a message.
LISTED = 6
#: Mass by the solver and by rigid-body modes agree within its printed digits.
MASS_TOLERANCE = 1e-3


#: The source of a model's mass; empty where there is none.
MassBy = Literal["solver", "rigid-body modes", "materials", ""]


@dataclass(frozen=True, slots=True)
class ModelFacts:
    """Facts about the model from the run.

    size_m: diagonal of the box round all nodes, NaN without geometry. mass, mass_kg: by the
    solver, else by the rigid-body modes, else estimated from sections and densities without
    point masses, else NaN; mass_by: the source of these. body: from rigid-body modes, the
    deck's units, None where body_missing says why. n_rigid: as updating counts them; rigid_hz: the
    largest of their frequencies; elastic_hz: (n_elastic,).
    """

    size_m: float
    mass: float
    mass_kg: float
    body: RigidBody | None
    body_missing: str
    mass_by: MassBy
    n_rigid: int
    rigid_hz: float
    elastic_hz: Floats


def model_facts(campaign: Campaign, result: ModalResult) -> ModelFacts:
    """Facts of the model from its mesh and its modes."""
    body, missing = _body(campaign, result)
    rigid = np.abs(result.eigenvalues[: result.n_rigid]).max(initial=0.0)
    by: MassBy
    mass, by = result.mass, "solver"
    if not np.isfinite(mass):
        mass, by = (body.mass, "rigid-body modes") if body else _mass_of_materials(campaign)
    return ModelFacts(
        size_m=model_size(campaign),
        mass=mass,
        mass_kg=mass * KILOGRAMS[campaign.case.units],
        body=body,
        body_missing=missing,
        mass_by=by,
        n_rigid=result.n_rigid,
        rigid_hz=float(np.sqrt(rigid) / 2.0 / np.pi),
        elastic_hz=result.elastic.frequencies_hz,
    )


def _mass_of_materials(campaign: Campaign) -> tuple[float, MassBy]:
    mass = sum(campaign.case.solver.deck.material_masses().values())
    return (mass, "materials") if mass > 0.0 else (np.nan, "")


def model_size(campaign: Campaign) -> float:
    """Diagonal of the box round the model, metres; NaN where the model has no geometry."""
    places = _mesh(campaign).coordinates
    if places.shape[0] < 2:
        return float("nan")
    return float(np.linalg.norm(np.ptp(places, axis=0))) * METRES[campaign.case.units]


def size_findings(campaign: Campaign) -> Iterator[Finding]:
    """Whether the model's materials and its size fit its units; no size without geometry."""
    case, size = campaign.case, model_size(campaign)
    doubt = unit_doubt(case.units, case.solver)
    if doubt:
        text = MODEL.doubtful(doubt, "model.units", UNITS, _other_units(case))
        yield accepted(campaign, text, "units")
    if np.isfinite(size):
        yield accepted(campaign, _size(case, size), "size")
    yield from _masses(case.solver)


def _masses(solver: Solver) -> Iterator[Finding]:
    """Whether the solver has the kind of masses that the deck asks for.

    Lumped ones are the cheaper choice that consistent ones better; not the other way round.
    """
    text = solver.other_masses
    if not text:
        return
    lumps = solver.program.capabilities.masses == "lumped"
    remedy = "run it on a solver that has them, or refine the mesh" if lumps else ""
    level: Level = "doubtful" if lumps else "good"
    yield Finding(level, "model", text, "model.solver", remedy, (setting("model.solver"),) * lumps)


def accepted(campaign: Campaign, found: Finding, check: ModelCheck) -> Finding:
    """A finding, no longer doubtful where the campaign accepts that under this name."""
    if found.level != "doubtful":
        return found
    if check not in campaign.case.accepted:
        accept = Setting(("model", "checks"), (check,), "add")
        return replace(found, settings=(*found.settings, accept))
    return replace(found, level="good", what=f"{found.what} (accepted)", remedy="", settings=())


def _other_units(case: Case) -> Setting:
    """Return the setting of other units, those of the materials where they differ."""
    units, _ = guessed_units(case.solver)
    return setting("model.units", units if units != case.units else None)


def _size(case: Case, size: float) -> Finding:
    if SIZES_M[0] <= size <= SIZES_M[1]:
        return MODEL.good(f"{size:.4g} m across", "model.units")
    text = f"in units {case.units} the model is {size:.3g} m across"
    return MODEL.doubtful(text, "model.units", SIZE, _other_units(case))


def mass_findings(campaign: Campaign, facts: ModelFacts) -> Iterator[Finding]:
    """Report whether mass, centre of gravity and inertia are plausible."""
    if not facts.mass_by:
        yield MODEL.good(
            f"the mass is unknown: {campaign.solver_name} does not print it, and "
            f"{facts.body_missing}"
        )
        return
    mass_kg, text = facts.mass_kg, f"the mass is {facts.mass_kg:.6g} kg"
    if facts.mass_by == "materials":
        text = f"the mass is about {mass_kg:.2g} kg from sections and densities, plus point masses"
    found = MODEL.good(text)
    heavy = mass_kg > DENSEST * facts.size_m**3  # the cube round the diagonal: the largest volume
    if heavy or not MASSES_KG[0] <= mass_kg <= MASSES_KG[1]:
        found = MODEL.doubtful(
            f"in units {campaign.case.units} the mass is {mass_kg:.3g} kg"
            + (f", in a model {facts.size_m:.3g} m across" if heavy else ""),
            "model.units",
            MASS,
            _other_units(campaign.case),
        )
    yield accepted(campaign, found, "mass")
    yield from _body_findings(facts, campaign.case.units)


def _body_findings(facts: ModelFacts, units: Units) -> Iterator[Finding]:
    body = facts.body
    if body is None:
        unknown = f"centre of gravity and inertia are unknown: {facts.body_missing}"
        yield MODEL.good(unknown)
        return
    # Values below rounding error, as along the normal of a plane of symmetry, are shown as zero.
    shown = np.where(np.abs(body.centre) < 1e-6 * np.abs(body.centre).max(), 0.0, body.centre)
    centre = ", ".join(f"{value:.5g}" for value in shown)
    moments = ", ".join(f"{value:.5g}" for value in body.inertia.diagonal())
    length, mass, _ = units.split("-")
    text = (
        f"centre of gravity ({centre}) {length}, moments of inertia about it ({moments}) "
        f"{mass} {length}^2"
    )
    yield MODEL.good(text)
    if body.spread > MASS_TOLERANCE:
        yield MODEL.doubtful(
            f"the mass differs by {100 * body.spread:.2g} % between directions",
            "",
            "a point mass may act in some directions only",
        )
    apart = abs(body.mass / facts.mass - 1.0)
    if apart > MASS_TOLERANCE:
        yield MODEL.doubtful(
            f"the rigid-body modes give a mass of {body.mass:.6g} {mass}, the solver "
            f"{facts.mass:.6g} {mass}",
            "",
            "some mass is not connected to the structure, or the solver does not count it",
        )


def rigid_findings(
    result: ModalResult, components: frozenset[int], by_hand: bool
) -> Iterator[Finding]:
    """Whether the model is free, held, or something in between.

    components: of its results; by_hand: whether the campaign says how many modes are rigid.
    """
    elastic = result.eigenvalues[result.n_rigid :]
    if elastic.size == 0:
        yield MODEL.wrong(
            f"all {result.modes.n_modes} computed modes are rigid",
            "",
            "check for a mechanism with many motions, and for wrong units",
        )
        return
    if (elastic <= 0.0).any():
        lowest = float(elastic.min())
        yield MODEL.wrong(
            f"an elastic eigenvalue is not above zero ({lowest:.3g} (rad/s)^2)",
            "",
            "the stiffness is not positive: look for a mechanism or for preload beyond buckling",
        )
        return
    if result.n_rigid == 0:
        yield MODEL.good(
            f"held: no rigid-body mode, the first at {np.sqrt(elastic[0]) / 2 / np.pi:.4g} Hz"
        )
        return
    free = len(components & {1, 2, 3}) if len(components & {1, 2, 3}) < 3 else RIGID_MODES
    if by_hand:
        yield MODEL.good(f"{result.n_rigid} rigid modes, as `rigid_modes` says")
        return
    if result.n_rigid != free:
        text = f"{result.n_rigid} modes have no strain energy, a free structure has {free}"
        remedy = "look for parts that nothing joins, hinges, or nodes without stiffness"
        if result.n_rigid > free:
            text = f"a mechanism: {text}"
        else:
            text = f"half held: {text}, a held one none"
            remedy = "look at the supports; a mechanism shows so too"
        meant = f"; if it is meant, say `rigid_modes: {result.n_rigid}`"
        by_hand_too = setting("model.rigid_modes", result.n_rigid)
        yield MODEL.doubtful(text, "model.rigid_modes", remedy + meant, by_hand_too)
        return
    yield _near_zero(result, elastic)


def mesh_findings(campaign: Campaign, elastic: ModeSet, up_to_hz: float) -> Iterator[Finding]:
    """Report how large ten-node tetrahedra are for the modes up to a frequency."""
    unlike = edge_differences(_mesh(campaign), elastic, "tetra10")
    if unlike is None:
        return
    below = elastic.frequencies_hz <= up_to_hz
    coarse = np.flatnonzero((unlike > COARSE) & below)
    if not coarse.size:
        most = float(unlike.max(where=below, initial=0.0))
        yield MODEL.good(
            f"ten-node tetrahedra: neighbouring corners differ by at most {100 * most:.0f} % of "
            f"their motion, with which bars had frequencies up to {100 * FINER * most**2:.2g} % "
            "too high"
        )
        return
    hz = ", ".join(f"{value:.4g}" for value in elastic.frequencies_hz[coarse[:LISTED]])
    more = f" and {coarse.size - LISTED} more" if coarse.size > LISTED else ""
    text = MODEL.doubtful(
        f"ten-node tetrahedra are too large for the modes at {hz} Hz{more}: neighbouring corners "
        f"differ by up to {100 * unlike[coarse].max():.0f} % of their motion, with which bars had "
        "frequencies 1 to 120 % too high",
        "model.deck",
        "compare with a mesh twice as fine; `model.checks: [mesh]` accepts it",
    )
    yield accepted(campaign, text, "mesh")


def _near_zero(result: ModalResult, elastic: Floats) -> Finding:
    worst = float(np.sqrt(np.abs(result.eigenvalues[: result.n_rigid]).max() / elastic[0]))
    text = (
        f"free: {result.n_rigid} rigid-body modes, at most {worst:.1g} of the first elastic "
        "frequency"
    )
    # Of modes by matrices, whose printed digits hide the energy of rigid modes alone.
    hidden = np.isnan(result.total_strain_energy)
    by_digits = hidden[: result.n_rigid].all() and not hidden[result.n_rigid :].any()
    if worst <= NEAR_ZERO or by_digits:
        return MODEL.good(text)
    return MODEL.doubtful(
        text,
        "",
        "they have no strain energy, so these frequencies are rounding errors, which would hide "
        "elastic modes as low as these: look for tiny or very stiff elements",
    )


def _body(campaign: Campaign, result: ModalResult) -> tuple[RigidBody | None, str]:
    """Mass properties from the rigid-body modes, or why there are none."""
    if result.n_rigid != RIGID_MODES:
        return None, "they need six rigid-body modes, which only a free model has"
    modes = in_global_axes(result.modes, campaign)
    if modes is None:
        return None, "the model has no geometry"
    shapes, places = modes
    rigid = np.asarray(shapes.mode_shapes[:, :RIGID_MODES], dtype=np.float64)
    try:
        return rigid_body_of_modes(rigid, places, shapes.components), ""
    except ModesError as error:
        return None, str(error)


def in_global_axes(modes: ModeSet, campaign: Campaign) -> tuple[ModeSet, Floats] | None:
    """Return the modes at nodes with global axes, and the coordinates of each row (n_dof, 3).

    None if the mesh has none of the nodes.
    """
    mesh = _mesh(campaign)
    rows = np.isin(modes.nodes, mesh.nodes)
    if mesh.frames:  # leave out a few nodes with local axes: the others suffice
        rows &= ~np.isin(modes.nodes, np.array(sorted(mesh.frames), dtype=np.int64))
    if not rows.any():
        return None
    kept = modes.rows(np.flatnonzero(rows))
    return kept, mesh.coordinates[mesh.rows(kept.nodes)]


def _mesh(campaign: Campaign) -> Mesh:
    try:
        return campaign.case.solver.deck.mesh()
    except ModelError:  # code that requires the mesh reports it; here one fact is missing
        return Mesh(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), ())


LIMIT = "run.memory_gb"


def memory_findings(state: CaseState) -> list[Finding]:
    """Report the memory for the factors of a case's matrices.

    This orders the unknowns once; it first releases factors in memory, which would count
    twice. Raises ModelError, StoreError.
    """
    by_matrices = isinstance(state.finder, ByMatrices)
    if not by_matrices and not state.case.needs("matrices"):
        return []
    if not is_available():
        unknown = "the memory of factors is not limited: MKL's PARDISO is not installed"
        remedy = "install MKL's PARDISO (`pypardiso`), or remove the limit"
        without = Setting(("run", "memory_gb"), None, "remove")
        found = [MODEL.doubtful(unknown, LIMIT, remedy, without)]
        return found if state.campaign.run.memory_gb else []
    if isinstance(state.finder, ByMatrices):
        state.finder.release()
    base = state.finder.assembled(state.campaign.start).model.base
    pattern = shifted_pattern(base.upper_stiffness, base.upper_mass)
    if pattern.shape[0] <= DENSE:
        return []
    n_modes, room = state.analysis.n_modes, state.engine.room
    vectors = most_vectors(n_modes), similar_vectors(n_modes)
    try:
        on_disk, text = factor_forecast(pattern, vectors[0], vectors[1], room)
    except SolverExhausted as error:
        return [MODEL.wrong(str(error), LIMIT, "", setting(LIMIT))]
    if not on_disk:
        return [MODEL.good(text, LIMIT)]
    remedy = "raise it if the machine has more memory"
    return [MODEL.doubtful(text, LIMIT, remedy, setting(LIMIT))]
