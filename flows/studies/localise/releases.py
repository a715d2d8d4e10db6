"""Supports and rigid links that may yield: the model without them, from further matrix jobs."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy import sparse

from modetune.adapters.solver import Deck, RigidLink
from modetune.core.algebra.matrices import MatrixResult, upper_product
from modetune.core.correlation.correlation import rigid_body_shapes
from modetune.core.errors import ModelError, SolverCrashed, SolverRejected
from modetune.core.mesh import Mesh, part_labels
from modetune.core.modes import Floats, Integers
from modetune.core.parameters import ParameterSet
from modetune.core.updating.candidates import Released, dynamic_forces, static_motion
from modetune.core.updating.responses.response import MatricesAt
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import Case
from modetune.flows.jobs.job import Plans
from modetune.flows.studies.localise.changes import AXES, LoadPlaces, ReleasedGroup
from modetune.flows.studies.localise.reduced_responses import damping_at, damps, kept_loads
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.matrices import MatrixSource
from modetune.flows.updating.mode_source import CaseState

logger = logging.getLogger(__name__)

#: Supports and links at most, the largest first; motions of a group at most.
SUPPORTS, LINKS, MOTIONS = 8, 12, 24
#: Times that the forces of the rest add motions: three gave 96 % of a spring's stiffness at each of
#: 70 nodes, one 64 %.
BLOCKS = 3
#: The free model tied again is the constrained one, except for the rounding of printed matrices.
TIED = 1e-5
#: Motions that depend on others to this share of their length are left out.
DEPENDENT = 1e-6


def released_model(
    campaign: Campaign,
    evaluator: Evaluator,
    state: CaseState,
    case: Case,
    parameters: ParameterSet,
    theta: Floats,
    base: MatrixResult,
    modes: tuple[Floats, Floats],
    places: LoadPlaces,
    rows: tuple[Integers, Integers],
    inverse: Callable[[Floats], Floats],
    shift: float,
) -> tuple[Released, tuple[ReleasedGroup, ...]] | None:
    """Return a case's model without supports and links, None where it has none or cannot be had.

    case: with the responses that are compared. theta: (n_columns,), values of the parameters; base:
    the constrained model there; modes: its eigenvalues (n_modes,) and shapes (n, n_modes). rows:
    nodes and components that are compared. inverse: (K - s M)^-1 of it, s the shift.
    """
    deck = case.solver.deck
    dampers: tuple[sparse.csr_array, ...] = ()
    try:
        freed = deck.released()
        if freed is None:
            return None
        free, links = freed
        solver = replace(case.solver, deck=free)
        engine = replace(state.engine, plans=Plans(solver), order=None)
        source = MatrixSource(engine, parameters, campaign.sensitivity.step)
        columns = range(theta.size)
        own = replace(state, engine=engine)
        evaluator.carry_out("matrices without supports", source.works(theta, columns), own)
        matrices = source.matrices(theta, columns)
        if any(map(damps, case.compared)):
            dampers = damping_at(free, MatricesAt(matrices, theta))
    except (ModelError, SolverRejected, SolverCrashed) as error:  # a mechanism, for example
        logger.info("supports and links are not released: %s", error)
        return None
    here = matrices.at(source.written(theta))
    motion = deck.observation(base, here.nodes, here.components).matrix
    observed = free.observation(here, *rows)
    loads = free.observation(here, places.load_nodes, places.load_components)
    here, base = (_of_mesh(own, of) for own, of in ((here, free), (base, deck)))
    base = _with_inner_names(base, here, deck.mesh())
    seen = _tie(motion, base, here)
    if seen is None or not _is_same(seen, here, base):
        logger.info("supports and links are not released: the free model is not the same one")
        return None
    found = list(_groups(here, base, seen, deck, links))

    def resisted(
        own: Floats, matrices: MatrixResult = here, tie: sparse.csr_array = seen
    ) -> Floats:
        moved = static_motion(matrices, tie, own, shift, inverse)
        return dynamic_forces(matrices, moved, shift)

    patterns, groups = _patterns(found, here, seen, modes, deck.mesh(), resisted)
    if not groups:
        return None
    kept = kept_loads(case.compared, rows, observed.matrix, dampers, seen @ modes[1])
    forces = sparse.csr_array(sparse.hstack([loads.matrix.T, kept]))
    return Released(matrices, seen, observed.matrix, forces, patterns, dampers), groups


def _of_mesh(matrices: MatrixResult, deck: Deck) -> MatrixResult:
    """Return matrices with the names that the mesh has for their equations."""
    nodes, components = deck.freedoms(matrices)
    return replace(matrices, nodes=nodes, components=components)


def _with_inner_names(base: MatrixResult, free: MatrixResult, mesh: Mesh) -> MatrixResult:
    """Return matrices with another model's numbers of the nodes that the solver makes itself.

    It makes them element by element, so they are alike in their order; a body that it makes nodes
    for first shifts their numbers.
    """
    made, others = (np.unique(of.nodes[~np.isin(of.nodes, mesh.nodes)]) for of in (base, free))
    if not mesh.nodes.size or made.size != others.size or np.array_equal(made, others):
        return base
    inner = np.isin(base.nodes, made)
    nodes = base.nodes.copy()
    nodes[inner] = others[np.searchsorted(made, base.nodes[inner])]
    return replace(base, nodes=nodes)


def _tie(seen: sparse.csr_array, base: MatrixResult, free: MatrixResult) -> sparse.csr_array | None:
    """Return the constrained model's motion of the free equations; None where it is unclear.

    seen: by names, which is not the equation itself where a name occurs several times.
    """
    tie = sparse.lil_array(seen)
    places: dict[tuple[int, int], list[int]] = {}
    for row, name in enumerate(zip(base.nodes.tolist(), base.components.tolist(), strict=True)):
        places.setdefault(name, []).append(row)
    own: dict[tuple[int, int], list[int]] = {}
    for row, name in enumerate(zip(free.nodes.tolist(), free.components.tolist(), strict=True)):
        own.setdefault(name, []).append(row)
    for name, rows in own.items():
        known = places.get(name, [])
        if known and len(known) != len(rows):
            return None
        for row, column in zip(rows, known, strict=False):
            tie[[row]] = 0.0
            tie[row, column] = 1.0
    return sparse.csr_array(tie)


def _is_same(tie: sparse.csr_array, free: MatrixResult, base: MatrixResult) -> bool:
    """Return whether the free model with the ties is the constrained one."""
    for whole, own in ((free.stiffness, base.stiffness), (free.mass, base.mass)):
        apart = abs(sparse.csr_array(tie.T @ whole @ tie) - own)
        if apart.nnz and float(apart.max()) > TIED * float(abs(own).max()):
            return False
    return True


def _groups(
    free: MatrixResult,
    base: MatrixResult,
    tie: sparse.csr_array,
    deck: Deck,
    links: Sequence[RigidLink],
) -> Iterator[tuple[str, bool, tuple[int, ...], Integers]]:
    """Yield label, whether a support, nodes, and rows of the free equations of each group.

    A node at rest may follow a leader that is held, and then its link yields.
    """
    mesh, fixed = deck.mesh(), deck.fixed()
    following = {node for link in links for node in link.nodes} - fixed.keys()
    held = (np.diff(tie.indptr) == 0) & ~np.isin(free.nodes, list(following))
    nodes = np.unique(free.nodes[held])
    if mesh.nodes.size:  # others are made by the solver, as of a beam's end that is held
        nodes = nodes[np.isin(nodes, mesh.nodes)]
    labels = part_labels(mesh, nodes)
    parts = [nodes[labels == label] for label in np.unique(labels)]
    for some in sorted(parts, key=len, reverse=True)[:SUPPORTS]:
        rows = np.flatnonzero(held & np.isin(free.nodes, some))
        yield f"support at {_named(some)}", True, tuple(some.tolist()), rows
    there = np.isin(_marks(free), _marks(base))
    for link in sorted(links, key=lambda item: -len(item.nodes))[:LINKS]:
        rows = np.flatnonzero(~there & ~held & np.isin(free.nodes, link.nodes))
        if rows.size:
            own = _named(np.array(link.nodes))
            text = f"rigid link of node {link.leader} to {own}" if link.leader else f"tie of {own}"
            yield text, False, link.nodes, rows


def _marks(matrices: MatrixResult) -> Integers:
    return np.asarray(7 * matrices.nodes + matrices.components)


def _named(nodes: Integers) -> str:
    if nodes.size == 1:
        return f"node {nodes[0]}"
    return f"{nodes.size} nodes ({nodes.min()} to {nodes.max()})"


def _patterns(
    groups: Sequence[tuple[str, bool, tuple[int, ...], Integers]],
    free: MatrixResult,
    tie: sparse.csr_array,
    modes: tuple[Floats, Floats],
    mesh: Mesh,
    resisted: Callable[[Floats], Floats],
) -> tuple[sparse.csr_array, tuple[ReleasedGroup, ...]]:
    """Return motions of the groups, (n_free, n_patterns), and which are whose.

    resisted: the forces (n_free, n) at which the rest of the model resists motions (n_free, n).
    """
    eigenvalues, shapes = modes
    shapes = tie @ shapes
    forces = upper_product(free.upper_stiffness, shapes)
    forces -= upper_product(free.upper_mass, shapes) * eigenvalues
    columns: list[sparse.csr_array] = []
    found: list[ReleasedGroup] = []
    for label, support, nodes, rows in groups:
        components = np.unique(free.components[rows]).tolist()
        for component in [0, *components] if len(components) > 1 else components:
            own = rows if not component else rows[free.components[rows] == component]
            motions = _motions(own, free, mesh, forces, resisted)
            start = sum(item.shape[1] for item in columns)
            spread = sparse.lil_array((free.nodes.size, motions.shape[1]))
            spread[own] = motions
            columns.append(sparse.csr_array(spread))
            axis = f", {AXES[component]}" if component else ""
            places = tuple(range(start, start + motions.shape[1]))
            found.append(ReleasedGroup(f"{label}{axis}", support, nodes, component, places))
    whole = (
        sparse.hstack(columns, format="csr") if columns else sparse.csr_array((free.nodes.size, 0))
    )
    return sparse.csr_array(whole), tuple(found)


def _motions(
    rows: Integers,
    free: MatrixResult,
    mesh: Mesh,
    forces: Floats,
    resisted: Callable[[Floats], Floats],
) -> Floats:
    """Return orthonormal motions (n_rows, n) of some freedoms.

    All of a few; else rigid motions and reactions of the modes, those of the first ones first, and
    the forces at which the rest of the model resists these.
    """
    if rows.size <= MOTIONS:
        return np.eye(rows.size)
    parts = [forces[rows][:, : MOTIONS - 6]]
    if mesh.nodes.size and np.isin(free.nodes[rows], mesh.nodes).all():
        places = mesh.coordinates[mesh.rows(free.nodes[rows])]
        parts.append(rigid_body_shapes(places - places.mean(axis=0), free.components[rows]))
    found = newest = _independent(np.hstack(parts))
    for _ in range(BLOCKS):
        moved = np.zeros((free.nodes.size, newest.shape[1]))
        moved[rows] = newest
        newest = _independent(resisted(moved)[rows])
        found = _independent(np.hstack([found, newest]))
    return found


def _independent(motions: Floats) -> Floats:
    """Return orthonormal combinations (n_rows, n) of motions."""
    lengths = np.linalg.norm(motions, axis=0)
    left, values, _ = np.linalg.svd(
        motions / np.where(lengths > 0.0, lengths, 1.0), full_matrices=False
    )
    return np.asarray(left[:, values > DEPENDENT * values[0]])
