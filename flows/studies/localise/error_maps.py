"""Maps of the error on a campaign's model, from its stored matrices and the test's shapes.

They take the model's matrices and their derivatives, which a semi-analytic sensitivity needs too
and so often finds in the store. What no parameter scales stands as two groups
of its own, one of stiffness and one of mass. The maps themselves are `core/updating/localisation`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.algebra.eigen import solve_modes
from modetune.core.algebra.matrices import MatrixResult, symmetric
from modetune.core.errors import ModesError
from modetune.core.mesh import Mesh, global_shapes, node_strains
from modetune.core.modes import Floats, Integers, common_dofs, mode_set
from modetune.core.updating.localisation import (
    ErrorFields,
    Group,
    GroupErrors,
    NodeErrors,
    error_fields,
    group_errors,
    node_errors,
)
from modetune.core.updating.parameter_matrices import ParameterMatrices
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.updating.evaluation import CaseEvaluation
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.matrix_source import MatrixSource

#: Names of what no parameter scales.
OTHER_STIFFNESS, OTHER_MASS = "other stiffness", "other mass"
#: A part of the matrices smaller than this share of the whole is the rounding of their text.
ROUNDING = 1e-6
#: Unknowns up to which maps are made: the system of one mode has twice as many.
MOST_UNKNOWNS = 400_000


@dataclass(frozen=True, slots=True)
class ErrorMaps:
    """Maps of the error on the model.

    groups: names, those of parameters first; errors: of the groups; nodes: residual forces by
    nodes; mesh_nodes: (n_mesh_nodes,), and strains there of the error's field, the largest being 1;
    misfits: (n_pairs,), relative distance of each test shape from the field that stands for it.
    """

    groups: tuple[str, ...]
    errors: GroupErrors
    nodes: NodeErrors
    mesh_nodes: Integers
    strains: Floats
    misfits: Floats


def why_no_maps(campaign: Campaign) -> str:
    solver = campaign.case.solver
    if not campaign.test.has_shapes:
        return "maps need measured shapes, and the test has none"
    if not solver.offers.matrices:
        return f"maps need stiffness and mass matrices, which {solver.program.name} does not give"
    if not solver.deck.summary.solid_shapes:
        return (
            "maps need matrices whose unknowns are at the model's nodes: solids without dependent "
            "nodes, or a model of matrices"
        )
    return ""


def error_maps(
    campaign: Campaign, evaluator: Evaluator, evaluation: CaseEvaluation
) -> tuple[ErrorMaps | None, str]:
    """Maps, and why there are none where that is so."""
    source = MatrixSource(evaluator.only.engine, campaign.parameters, campaign.sensitivity.step)
    theta, columns = evaluation.theta, range(len(campaign.parameters))
    works = source.works(theta, columns)
    own = evaluator.carry_out("matrices", works[:1])  # the model's
    size = own[0][0].result(MatrixResult).nodes.size if own else 0
    if size <= MOST_UNKNOWNS:  # else it is told before the parameters' matrices cost anything
        evaluator.carry_out("matrices", works[1:])
        model = source.matrices(theta, columns)
        size = model.base.nodes.size
    if size > MOST_UNKNOWNS:
        return (
            None,
            f"maps are made of models of up to {MOST_UNKNOWNS:,} unknowns; this one has {size:,}",
        )
    base = model.at(source.written(theta))
    groups = _groups(base, campaign.parameters.names, source.written(theta), model)
    fields, computed = _fields(campaign, evaluation, base)
    errors = group_errors(fields, base.stiffness, base.mass, groups, computed)
    nodes = node_errors(fields, base.nodes, base.components)
    named = tuple(group.name for group in groups)
    mesh = campaign.case.solver.deck.mesh()
    strains = _strains(mesh, fields, base)
    return ErrorMaps(named, errors, nodes, mesh.nodes, strains, fields.misfits), ""


def _strains(mesh: Mesh, fields: ErrorFields, base: MatrixResult) -> Floats:
    """Strain of the error's field at the mesh's nodes, all modes alike; the largest is 1."""
    if mesh.nodes.size == 0:  # a model of matrices has no geometry
        return np.zeros(0)
    own = _first_unknowns(base)
    scaled = fields.errors[own] / np.sqrt(fields.eigenvalues)
    modes = mode_set(
        np.sqrt(fields.eigenvalues) / (2.0 * np.pi), scaled, base.nodes[own], base.components[own]
    )
    strains = node_strains(mesh, global_shapes(mesh, modes))
    return strains / (float(strains.max(initial=0.0)) or 1.0)


def _first_unknowns(base: MatrixResult) -> Integers:
    """Rows of the unknowns that are at nodes: a solver may have more under the same names."""
    _, first = np.unique(np.stack([base.nodes, base.components]), axis=1, return_index=True)
    return np.sort(first)


def _groups(
    base: MatrixResult, names: Sequence[str], theta: Floats, model: ParameterMatrices
) -> list[Group]:
    """What each parameter scales, and what none does."""
    groups = []
    for column, (name, value) in enumerate(zip(names, theta.tolist(), strict=True)):
        stiffness, mass = (symmetric(value * upper) for upper in model.change(theta, column))
        groups.append(Group(name, stiffness, mass))
    stiffness, mass = base.stiffness, base.mass
    for group in groups:
        stiffness, mass = stiffness - group.stiffness, mass - group.mass
    nothing = sparse.csr_array(base.stiffness.shape)
    if _weighty(stiffness, base.stiffness):
        groups.append(Group(OTHER_STIFFNESS, sparse.csr_array(stiffness), nothing))
    if _weighty(mass, base.mass):
        groups.append(Group(OTHER_MASS, nothing, sparse.csr_array(mass)))
    return groups


def _weighty(part: sparse.csr_array, whole: sparse.csr_array) -> bool:
    return float(abs(part).max()) > ROUNDING * float(abs(whole).max())


def _fields(
    campaign: Campaign, evaluation: CaseEvaluation, base: MatrixResult
) -> tuple[ErrorFields, Floats]:
    """Fields of the test's modes, and the matrices' own modes that answer them, (n, n_pairs)."""
    test, seen, pairing = campaign.test.modes, evaluation.seen, evaluation.pairing
    rows_m, rows_c = common_dofs(test, seen)
    observer, kept = _observer(campaign, base, rows_c)
    weighting = campaign.case.weighting
    scales = weighting.sensor_scales(rows_m[kept])[0][:, None]
    measured = scales * np.real(test.mode_shapes[np.ix_(rows_m[kept], pairing.measured)])
    mine = scales * np.real(seen.mode_shapes[np.ix_(rows_c[kept], pairing.computed)])
    lengths = np.sum(measured**2, axis=0)
    if measured.size == 0 or (lengths == 0.0).any():
        raise ModesError("a measured shape is zero at all sensors that are free to move")
    # To unit modal mass, by the modal scale factor to the mass-normalised computed shape.
    measured = measured * (np.sum(measured * mine, axis=0) / lengths)
    n_rigid = evaluation.modal.n_rigid
    shift = -0.1 * float(evaluation.modal.elastic.eigenvalues[0])
    count = min(evaluation.modal.modes.n_modes, base.nodes.size)
    _, shapes = solve_modes(base.stiffness, base.mass, count, shift=shift)
    fields = error_fields(
        base.stiffness,
        base.mass,
        test.eigenvalues[pairing.measured],
        measured,
        observer.multiply(scales).tocsr(),
        weighting.shape_deviations[pairing.measured],
    )
    return fields, shapes[:, pairing.computed + n_rigid]


def _observer(
    campaign: Campaign, base: MatrixResult, rows: Integers
) -> tuple[sparse.csr_array, NDArray[np.bool_]]:
    """What these sensors see of the matrices' unknowns, and which of them can move.

    A sensor on an unknown that is held in place has nothing to see.
    """
    own = _first_unknowns(base)
    free = set(zip(base.nodes[own].tolist(), base.components[own].tolist(), strict=True))
    sensors = campaign.case.sensors
    kept = np.array(
        [
            _moves(
                sensors.model_nodes[row], sensors.directions[row], bool(sensors.turns[row]), free
            )
            for row in rows.tolist()
        ],
        dtype=np.bool_,
    )
    chosen = rows[kept]
    part = replace(
        sensors,
        nodes=sensors.nodes[chosen],
        components=sensors.components[chosen],
        model_nodes=sensors.model_nodes[chosen],
        directions=sensors.directions[chosen],
        turns=sensors.turns[chosen],
        distances=sensors.distances[chosen],
    )
    small = sparse.coo_array(part.matrix(base.nodes[own], base.components[own]))
    return sparse.csr_array(
        (small.data, (small.row, own[small.col])), shape=(chosen.size, base.nodes.size)
    ), kept


def _moves(node: int, direction: Floats, turns: bool, unknowns: set[tuple[int, int]]) -> bool:
    """Whether all that a sensor looks along are unknowns."""
    axes = np.flatnonzero(np.abs(direction) > 1e-6)
    return all((int(node), int(axis) + 1 + 3 * turns) in unknowns for axis in axes)
