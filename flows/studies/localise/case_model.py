"""A case on a reduced model that contains every change, and its misfit with one of them."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import sparse

from modetune.adapters.solver import Deck
from modetune.core.algebra.eigen import ModeSolver, SolvedModes
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.correlation.pairing import LostMode
from modetune.core.errors import ModelError, ModesError
from modetune.core.modes import Floats, Integers
from modetune.core.parameters import Parameter, ParameterSet
from modetune.core.updating.candidates import AttachedModel, Term, attached_model
from modetune.core.updating.job_results import ModalResult
from modetune.core.updating.minima import Misfit, MisfitAt, polished
from modetune.core.updating.parameter_matrices import ParameterMatrices
from modetune.core.updating.reduced_basis import ReducedModel, reduce, unreduced
from modetune.core.updating.residual import residual_sensitivity
from modetune.core.updating.responses.response import MatricesAt, Residual, StateDerivatives
from modetune.core.updating.rigid_motions import rigid_motions
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.case import Case
from modetune.flows.jobs.job import Plans
from modetune.flows.studies.localise.changes import (
    LoadPlaces,
    ModelChange,
    ReleasedGroup,
)
from modetune.flows.studies.localise.reduced_responses import (
    answers,
    damping_at,
    damps,
    kept_loads,
    on_reduced,
    seen_nodes,
)
from modetune.flows.studies.localise.releases import released_model
from modetune.flows.updating.evaluation import CaseEvaluation, at_sensors, compare, model_state
from modetune.flows.updating.evaluator import Evaluator
from modetune.flows.updating.matrices import MatrixSource
from modetune.flows.updating.mode_source import REDUCED, CaseState
from modetune.flows.updating.solutions import (
    first_shift,
    named_freedoms,
    observer_of,
    solved_energies,
)

#: Unknowns up to which there are proposals, and up to which a model is not reduced.
MOST_UNKNOWNS, SMALL = 400_000, 120
#: Modes of the basis beyond those that are compared, and vectors at most.
MORE_MODES, MOST_VECTORS = 12, 150
#: Eigenvalues below this share of the first elastic one are those of rigid modes.
RIGID = 1e-4
#: Elastic eigenvalues are no smaller than this share of the first one.
LOOSE = 1e-9


@dataclass(frozen=True, slots=True)
class CaseModel:
    """A case on a reduced model with loads.

    case: comparing all measured frequencies and shapes. columns: of its own parameters among the
    campaign's. theta: (n_columns,), the model's at the examined state, groups behind. known: the
    case there. rows: nodes and components of the model's rows. mass: about that of the model.
    n_loads: of places and kept ones. released: supports and links that may yield, loads behind
    these.
    """

    case: Case
    columns: Integers
    theta: Floats
    known: CaseEvaluation
    loaded: AttachedModel
    rows: tuple[Integers, Integers]
    mass: float
    n_loads: int
    released: tuple[ReleasedGroup, ...]

    def changed(self, terms: Sequence[Term], n_amplitudes: int = 0) -> ChangedCase:
        """Return the case with a change, as of `AttachedModel.changed`."""
        model = self.loaded.changed(terms, n_amplitudes)
        compared = on_reduced(self.case.compared, model, self.rows)
        needed = any(item.needs - {"shapes"} for item in compared)
        matrices = model.matrices() if needed else None
        return ChangedCase(self, replace(self.case, compared=compared), model, matrices)


@dataclass(frozen=True, slots=True)
class ChangedCase:
    """A case with a change of its model.

    case: with responses of the changed model. matrices: that model's, where a response needs them.
    """

    of: CaseModel
    case: Case
    model: ReducedModel
    matrices: ParameterMatrices | None

    @property
    def by_modes(self) -> ChangedCase:
        """Return the same without responses that need matrices."""
        own = tuple(item for item in self.case.compared if not answers(item))
        return replace(self, case=replace(self.case, compared=own), matrices=None)

    def compared(self, theta: Floats) -> CaseEvaluation:
        """Return the comparison at values of the model's columns. Raises ModesError, LostMode."""
        known = self.of.known
        eigenvalues, shapes = self.model.modes(theta, known.modal.modes.n_modes)
        first = float(known.modal.eigenvalues[known.modal.n_rigid])
        n_rigid = min(known.modal.n_rigid, int(np.sum(eigenvalues < RIGID * first)))
        # What yields may leave the model almost loose, with eigenvalues that are rounding.
        eigenvalues[n_rigid:] = np.maximum(eigenvalues[n_rigid:], LOOSE * first)
        rows = self.of.rows
        modal = ModalResult.of_shapes(eigenvalues, shapes, *rows, 0.5 * eigenvalues, n_rigid)
        at = None if self.matrices is None else MatricesAt(self.matrices, theta)
        return compare(self.case, theta, "", modal, known, REDUCED, matrices=at)


def all_data(case: Case) -> Case:
    """Return a case that compares all measured data that a reduced model answers for."""
    weighting = case.weighting
    if case.test.has_shapes and not weighting.with_shapes:
        ones = np.ones_like(weighting.shape_weights)
        weighting = replace(weighting, shape_weights=ones)
    if not weighting.frequencies_used.any():
        ones = np.ones_like(weighting.frequency_weights)
        weighting = replace(weighting, frequency_weights=ones)
    compared = tuple(item for item in case.compared if not item.needs - {"shapes"} or answers(item))
    return replace(case, weighting=weighting, compared=compared, held_out=None)


def case_model(
    campaign: Campaign,
    evaluator: Evaluator,
    state: CaseState,
    part: CaseEvaluation,
    quantities: Sequence[Parameter],
    places: LoadPlaces,
) -> CaseModel:
    """Return a case's reduced model at an evaluated point. Raises ModelError, ModesError.

    quantities: further ones, behind the case's own parameters. places: of loads.
    """
    own, deck = state.campaign.parameters, state.case.solver.deck
    dampers: tuple[sparse.csr_array, ...] = ()
    if part.matrices is not None and any(map(damps, all_data(state.case).compared)):
        dampers = damping_at(deck, part.matrices)
    if quantities:
        deck = deck.with_parameters(tuple(quantities))
        bound = replace(state.case.solver, deck=deck)
        engine = replace(state.engine, plans=Plans(bound), order=None)
        state = replace(state, case=replace(state.case, solver=bound), engine=engine)
    parameters = ParameterSet((*own.parameters, *quantities), own.dependents)
    source = MatrixSource(state.engine, parameters, campaign.sensitivity.step)
    theta = np.concatenate([part.theta, np.ones(len(quantities))])
    affine = _matrices(evaluator, state, source, theta)
    written, case = source.written(theta), all_data(state.case)
    nodes, turning = seen_nodes(case.compared)
    rows = named_freedoms(
        tuple({*case.nodes, *nodes}), np.array([*case.rotation_nodes, *turning], dtype=np.int64)
    )
    observer = observer_of(state.campaign, affine.base, *rows)
    here = affine.at(written)
    solver = ModeSolver(count=False)
    model, basis, solved, shift = _reduced(state, part, affine, written, here, observer, solver)
    freed = released_model(
        campaign, evaluator, state, case, parameters, theta, here,
        (solved.eigenvalues, solved.shapes), places, rows, solver.inverse, shift,
    )  # fmt: skip
    released, groups = freed or (None, ())
    seen = deck.observation(affine.base, places.load_nodes, places.load_components)
    kept = kept_loads(case.compared, rows, observer, dampers, solved.shapes)
    loads = sparse.csr_array(sparse.hstack([seen.matrix.T, kept]))
    loaded = attached_model(
        affine, model, basis, observer, solver.inverse, loads, released, (written, shift),
        np.arange(seen.matrix.shape[0], loads.shape[1]), dampers,
    )  # fmt: skip
    mass, n_loads = _mass(here, deck), loads.shape[1]
    known = CaseModel(case, state.columns, written, part, loaded, rows, mass, n_loads, groups)
    return replace(known, known=known.changed(()).compared(written))


def _matrices(
    evaluator: Evaluator, state: CaseState, source: MatrixSource, theta: Floats
) -> ParameterMatrices:
    """Return the matrices for all values of a case; those of a large model are not all computed."""
    columns = range(theta.size)
    works = source.works(theta, columns)
    own = evaluator.carry_out("matrices", works[:1], state)  # the model's
    _check_size(own[0][0].result(MatrixResult) if own else None)
    evaluator.carry_out("matrices", works[1:], state)
    affine = source.matrices(theta, columns)
    _check_size(affine.base)
    return affine


def _reduced(
    state: CaseState,
    part: CaseEvaluation,
    affine: ParameterMatrices,
    theta: Floats,
    here: MatrixResult,
    observer: sparse.csr_array,
    solver: ModeSolver,
) -> tuple[ReducedModel, Floats, SolvedModes, float]:
    """Return a model on its modes and their derivatives, the basis, the modes and the shift.

    here: the matrices at theta (n_columns,). solver: has their factors at the shift then.
    """
    size = here.nodes.size
    massive = int(np.count_nonzero(here.upper_mass.diagonal()))
    n_modes = min(part.modal.modes.n_modes + MORE_MODES, massive)
    solved = solver.solve(here.upper_stiffness, here.upper_mass, n_modes)
    shift = solved.shift
    if size <= SMALL or not solver.inverts_exactly:
        shift = min(shift, first_shift(state.campaign))
        solver.factorise(here.upper_stiffness, here.upper_mass, shift)
    if size <= SMALL:
        return unreduced(affine, shift, observer), np.eye(size), solved, shift
    _, n_rigid = solved_energies(state.campaign, here, solved)
    model, basis = reduce(
        affine, theta, solved.eigenvalues, solved.shapes, solver.inverse,
        part.pairing.computed + n_rigid, n_rigid, observer, most=MOST_VECTORS,
    )  # fmt: skip
    return model, basis, solved, shift


def _check_size(matrices: MatrixResult | None) -> None:
    """Raise ModelError for a model that is too large, before more of its matrices are computed."""
    if matrices is not None and matrices.nodes.size > MOST_UNKNOWNS:
        raise ModelError(
            f"changes are proposed for models of up to {MOST_UNKNOWNS:,} unknowns; this one has "
            f"{matrices.nodes.size:,}"
        )


def _mass(matrices: MatrixResult, deck: Deck) -> float:
    """Return the mass of a model by its rigid translations, else about it by the diagonal."""
    try:
        moved = rigid_motions(matrices, deck.mesh(), True, deck.observation).shapes[:, :3]
        return float(np.max(np.sum(moved * (matrices.mass @ moved), axis=0)))
    except (ModesError, ModelError):
        return float(matrices.upper_mass.diagonal()[matrices.components <= 3].sum()) / 3.0


class ChangeMisfit(Misfit):
    """The misfit of all measured data with one change, over log parameters and log amplitudes."""

    def __init__(
        self, cases: Sequence[CaseModel], change: ModelChange | None, bounds: ParameterSet
    ) -> None:
        self.cases, self.change = cases, change
        self.n_own = len(bounds)
        extra = (np.zeros(0),) * 2 if change is None else (change.lower, change.upper)
        tiny = np.finfo(np.float64).tiny
        self.lower = np.log(np.concatenate([np.maximum(bounds.lower, tiny), extra[0]]))
        self.upper = np.log(np.concatenate([bounds.upper, extra[1]]))
        if change is None:
            self.changed = [item.changed(()) for item in cases]
        else:
            n = change.lower.size if change.group < 0 else 0
            own = zip(cases, change.terms, strict=True)
            self.changed = [item.changed(terms, n) for item, terms in own]
        self.n_evaluations = 0

    @cached_property
    def by_modes(self) -> ChangeMisfit:
        """Return the misfit of modes alone; this one where nothing else is compared."""
        if all(each.matrices is None for each in self.changed):
            return self
        found = copy(self)
        found.changed = [each.by_modes for each in self.changed]
        return found

    def least(self, x: Floats) -> tuple[Floats, float]:
        """Return the minimum near a point, and the misfit there.

        Logarithms of response functions have a minimum wherever resonances pass each other, so
        modes lead to the point from which all data decide.
        """
        if self.by_modes is not self:
            x, _ = polished(self.by_modes, x)
        return polished(self, x)

    def columns(self, case: CaseModel) -> Integers:
        """Return the model's columns of the case's parameters and the amplitudes."""
        own = np.arange(case.columns.size)
        if self.change is None:
            return own
        if self.change.group >= 0:
            return np.append(own, own.size + self.change.group)
        return np.concatenate([own, case.theta.size + np.arange(self.change.lower.size)])

    def at(self, case: CaseModel, values: Floats) -> Floats:
        """Return the model's columns at parameter values and amplitudes."""
        own, amplitudes = values[case.columns], values[self.n_own :]
        theta = np.concatenate([case.theta, amplitudes if self._added else []])
        theta[self.columns(case)] = np.concatenate([own, amplitudes])
        return np.asarray(theta)

    @property
    def _added(self) -> bool:
        return self.change is not None and self.change.group < 0

    def parts(self, x: Floats) -> list[tuple[ChangedCase, CaseEvaluation]] | None:
        """Return the comparison of each case, None where a mode is lost."""
        values = np.exp(x)
        self.n_evaluations += 1
        try:
            return [(each, each.compared(self.at(each.of, values))) for each in self.changed]
        except (LostMode, ModesError):
            return None

    def residual(self, x: Floats) -> Floats | None:
        """Return the residual in standard deviations of the measurement."""
        parts = self.parts(x)
        return (
            None if parts is None else np.concatenate([_normal(part.residual) for _, part in parts])
        )

    def value(self, x: Floats) -> float:
        found = self.residual(x)
        return np.inf if found is None else float(found @ found)

    def slopes(self, x: Floats) -> tuple[Floats, Floats] | None:
        """Return the residual and its derivatives with respect to x, (n_residuals, n)."""
        parts = self.parts(x)
        if parts is None:
            return None
        values, rows, own = np.exp(x), [], []
        for each, part in parts:
            case, theta = each.of, part.theta
            columns = self.columns(case)
            paired = part.pairing.computed + part.modal.n_rigid
            shapes = np.real(part.modal.modes.mode_shapes[:, paired])
            whole = each.model.derivatives(theta, paired, shapes)
            found = ModeDerivatives(whole.eigenvalues[:, columns], whole.mode_shapes[:, :, columns])
            state = model_state(each.case, part.seen, part.pairing, part.modal, part.matrices)
            seen = at_sensors(each.case, part, found)
            of = StateDerivatives(seen, tuple(columns.tolist()), found)
            slopes = np.zeros((part.residual.values.size, x.size))
            places = np.concatenate([case.columns, np.arange(self.n_own, x.size)])
            slopes[:, places] = -residual_sensitivity(part.responses, state, of) * values[places]
            rows.append(_scaled(part.residual, slopes))
            own.append(_normal(part.residual))
        return np.concatenate(own), np.vstack(rows)

    def sample(self, x: Floats) -> MisfitAt | None:
        found = self.slopes(x)
        if found is None:
            return None
        residual, rows = found
        return MisfitAt(float(residual @ residual), 2.0 * rows.T @ residual, 2.0 * rows.T @ rows)


def _deviations(found: Residual) -> Floats:
    return np.asarray(np.sqrt(np.where(found.weights > 0.0, 1.0 / found.noise, 0.0)))


def _normal(found: Residual) -> Floats:
    return _deviations(found) * found.independent(found.values)


def _scaled(found: Residual, rows: Floats) -> Floats:
    return _deviations(found)[:, None] * found.independent(rows)
