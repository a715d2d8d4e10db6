"""Maps of the error on a campaign's model, from its stored matrices and the test's shapes.

They use the model's matrices and derivatives, which the store often has from semi-analytic
sensitivities. The matrix parts that no parameter scales form two further groups, one of stiffness
and one of mass. The maps themselves are `core/updating/localisation`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.algebra.eigen import solve_modes
from modetune.core.algebra.matrices import MatrixResult, symmetric
from modetune.core.errors import ModesError
from modetune.core.mesh import Mesh, global_shapes, node_strains
from modetune.core.modes import Floats, Integers, common_dofs, dof_name, mode_set
from modetune.core.parameters import ParameterSet
from modetune.core.updating.localisation import ROUNDING as FIELD_ROUNDING
from modetune.core.updating.localisation import (
    ErrorFields,
    Group,
    GroupErrors,
    NodeErrors,
    error_fields,
    group_errors,
    node_errors,
)
from modetune.core.updating.observation import Observation, sensor_observation
from modetune.core.updating.parameter_matrices import ParameterMatrices
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.updating.evaluation import CaseEvaluation
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.matrices import MatrixSource

#: Names of what no parameter scales.
OTHER_STIFFNESS, OTHER_MASS = "other stiffness", "other mass"
#: A part of a matrix that is nowhere a larger share of its diagonal is the rounding of its text.
ROUNDING = 1e-6
#: Unknowns up to which maps are made: the system of one mode has twice as many.
MOST_UNKNOWNS = 400_000
#: Sensors that are left out one at a time, and values of fields that these may take together.
LEFT_OUT, FEWEST, MOST_VALUES = 24, 3, 10_000_000


@dataclass(frozen=True, slots=True)
class ErrorMaps:
    """Maps of the error on the model.

    groups: names, those of parameters first; errors: of the groups; nodes: residual forces by
    nodes; mesh_nodes: (n_mesh_nodes,), and strains there of the error's field, the largest being 1;
    misfits: (n_pairs,), relative distance of each test shape from its field; conditions,
    roundings: (n_pairs,), of the systems of the fields, and the errors that are left of them.
    spoiled: (n_pairs,), modes that rounding excludes from the maps. sensors: names of the sensors
    that were left out one at a time.
    """

    groups: tuple[str, ...]
    errors: GroupErrors
    nodes: NodeErrors
    mesh_nodes: Integers
    strains: Floats
    misfits: Floats
    conditions: Floats
    roundings: Floats
    spoiled: NDArray[np.bool_]
    sensors: tuple[str, ...]

    @property
    def upsets(self) -> tuple[str, ...]:
        """Return the names of sensors without which another group ranks first."""
        found = self.errors.stability
        places = {row: place for place, row in enumerate(found.left_out.tolist())}
        return tuple(self.sensors[places[row]] for row in found.upsets.tolist())


def why_no_maps(campaign: Campaign) -> str:
    if campaign.only is None:
        names = ", ".join(item.name for item in campaign.cases)
        return f"a map is of one model: name a configuration by --configuration ({names})"
    solver = campaign.case.solver
    if not campaign.test.has_shapes:
        return "maps need measured shapes, and the test has none"
    if not solver.offers.matrices:
        return f"maps need stiffness and mass matrices, which {solver.program.name} does not give"
    if not solver.deck.summary.matrix_shapes:
        return (
            "maps need matrices with the motion of nodes, and those of "
            f"{solver.deck.summary.name} lack it (docs/models.md)"
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
    if size <= MOST_UNKNOWNS:  # else it is reported before the parameters' matrices cost anything
        evaluator.carry_out("matrices", works[1:])
        model = source.matrices(theta, columns)
        size = model.base.nodes.size
    if size > MOST_UNKNOWNS:
        return (
            None,
            f"maps are made of models of up to {MOST_UNKNOWNS:,} unknowns; this one has {size:,}",
        )
    base = model.at(source.written(theta))
    groups = _groups(base, campaign.parameters, source.written(theta), model)
    found, computed, sensors = _fields(campaign, evaluation, base)
    spoiled = found.roundings > FIELD_ROUNDING
    if spoiled.all():
        return None, (
            "the expansion of the test's shapes has condition number "
            f"{found.conditions.min():.0e}: rounding leaves no digit of it; look for "
            " extremely stiff springs or bars in the deck"
        )
    fields, computed = found.select(~spoiled), computed[:, ~spoiled]
    errors = group_errors(fields, base.stiffness, base.mass, groups, computed)
    nodes = node_errors(fields, base.nodes, base.components)
    named = tuple(group.name for group in groups)
    deck = campaign.case.solver.deck
    mesh = deck.mesh()
    strains = _strains(mesh, fields, partial(deck.observation, base))
    maps = ErrorMaps(
        named,
        errors,
        nodes,
        mesh.nodes,
        strains,
        found.misfits,
        found.conditions,
        found.roundings,
        spoiled,
        sensors,
    )
    return maps, ""


def _strains(
    mesh: Mesh, fields: ErrorFields, observation: Callable[[Integers, Integers], Observation]
) -> Floats:
    """Strain of the error's field at the mesh's nodes, all modes alike; the largest is 1."""
    if mesh.nodes.size == 0:  # a model of matrices has no geometry
        return np.zeros(0)
    nodes, components = np.repeat(mesh.nodes, 3), np.tile(np.arange(1, 4), mesh.nodes.size)
    scaled = observation(nodes, components).matrix @ fields.errors / np.sqrt(fields.eigenvalues)
    modes = mode_set(np.sqrt(fields.eigenvalues) / (2.0 * np.pi), scaled, nodes, components)
    strains = node_strains(mesh, global_shapes(mesh, modes))
    return strains / (float(strains.max(initial=0.0)) or 1.0)


def _groups(
    base: MatrixResult, parameters: ParameterSet, theta: Floats, model: ParameterMatrices
) -> list[Group]:
    """What each parameter scales, and what none does."""
    groups = []
    lower, upper = parameters.lower / theta - 1.0, parameters.upper / theta - 1.0
    for column, (name, value) in enumerate(zip(parameters.names, theta.tolist(), strict=True)):
        stiffness, mass = (symmetric(value * part) for part in model.change(theta, column))
        groups.append(Group(name, stiffness, mass, float(lower[column]), float(upper[column])))
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
    """Whether anything is left: a soft spring is small compared with the model, but not at its
    ends."""
    return bool((abs(part.diagonal()) > ROUNDING * abs(whole.diagonal())).any())


def _fields(
    campaign: Campaign, evaluation: CaseEvaluation, base: MatrixResult
) -> tuple[ErrorFields, Floats, tuple[str, ...]]:
    """Fields of the test's modes, and the matrices' own modes that answer them, (n, n_pairs), and
    the names of sensors that were left out one at a time."""
    test, seen, pairing = campaign.test.modes, evaluation.seen, evaluation.pairing
    rows_m, rows_c = common_dofs(test, seen)
    deck = campaign.case.solver.deck
    observed = sensor_observation(campaign.case.sensors, partial(deck.observation, base))
    known = ~(observed.held | observed.unknown)[rows_c]  # a sensor on a support has nothing to see
    rows_m, rows_c = rows_m[known], rows_c[known]
    weighting = campaign.case.weighting
    scales = weighting.sensor_scales(rows_m)[0][:, None]
    measured = scales * np.real(test.mode_shapes[np.ix_(rows_m, pairing.measured)])
    mine = scales * np.real(seen.mode_shapes[np.ix_(rows_c, pairing.computed)])
    lengths = np.sum(measured**2, axis=0)
    if measured.size == 0 or (lengths == 0.0).any():
        raise ModesError("a measured shape is zero at all sensors that are free to move")
    # To unit modal mass, by the modal scale factor to the mass-normalised computed shape.
    measured = measured * (np.sum(measured * mine, axis=0) / lengths)
    n_rigid = evaluation.modal.n_rigid
    shift = -0.1 * float(evaluation.modal.elastic.eigenvalues[0])
    count = min(evaluation.modal.modes.n_modes, base.nodes.size)
    _, shapes = solve_modes(base.stiffness, base.mass, count, shift=shift)
    # The sensors with the largest readings have the most influence.
    most = np.argsort(-np.sum(measured**2 / lengths, axis=1), kind="stable")
    left_out = most[: _number_left_out(rows_m.size, base.nodes.size, pairing.measured.size)]
    fields = error_fields(
        base.stiffness,
        base.mass,
        test.eigenvalues[pairing.measured],
        measured,
        observed.matrix[rows_c].multiply(scales).tocsr(),
        weighting.shape_deviations[pairing.measured],
        left_out=left_out.tolist(),
    )
    own = test.nodes[rows_m[left_out]].tolist(), test.components[rows_m[left_out]].tolist()
    sensors = tuple(dof_name(dof) for dof in zip(*own, strict=True))
    return fields, shapes[:, pairing.computed + n_rigid], sensors


def _number_left_out(n_sensors: int, n: int, n_modes: int) -> int:
    """Return how many sensors to leave out one at a time; none where that is too expensive."""
    number = min(LEFT_OUT, MOST_VALUES // max(n * n_modes, 1))
    return min(number, n_sensors) if number >= FEWEST and n_sensors > FEWEST else 0
