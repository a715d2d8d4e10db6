"""A model condensed to a few of its unknowns: the Python API of `modetune model reduce`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from modetune.adapters.matrices.export import WrittenMatrices
from modetune.core.algebra.eigen import solve_modes
from modetune.core.algebra.factor_room import factor_room
from modetune.core.brief import brief
from modetune.core.condensation.measured_unknowns import MeasuredModel
from modetune.core.condensation.reduction import (
    Reduction,
    craig_bampton,
    guyan,
    irs,
    iterated_irs,
    reduced_modes,
    serep,
)
from modetune.core.errors import CampaignError
from modetune.core.modes import CLOSE, Floats, Integers, close_sets
from modetune.core.parameters import Values
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.studies.full_model import (
    Dofs,
    FullModel,
    by_sensors,
    dof_arrays,
    full_model,
    masters_of,
    sensor_names,
)
from modetune.flows.studies.reduce.request import ReductionMethod, ReductionRequest

#: Modes that are compared by default, rigid ones included.
COMPARED = 16
#: Relative to the highest compared eigenvalue, smaller ones count as zero: the relative difference
#: of two rounding errors has no meaning.
RIGID = 1e-8


@dataclass(frozen=True, slots=True, repr=False)
class ModelReduction:
    """A reduced model compared with the full one.

    masters: names of its unknowns. held: names that are fixed and so left out. full_hz, reduced_hz,
    errors: (n_modes,), errors relative, NaN of rigid modes. shared: (n_modes,), the part of each
    mode's kinetic energy that the reduced model's modes hold in its place (of close modes: those
    in the places of all), 1 where it is kept. matrices: what is written.
    """

    method: ReductionMethod
    masters: tuple[tuple[int, int], ...]
    held: tuple[tuple[int, int], ...]
    n_full: int
    full_hz: Floats
    reduced_hz: Floats
    errors: Floats
    shared: Floats
    reduction: Reduction
    matrices: WrittenMatrices

    __repr__ = brief

    @property
    def sentence(self) -> str:
        """Size and accuracy of the reduced model."""
        known = self.errors[np.isfinite(self.errors)]
        error = 100.0 * np.abs(known).max(initial=0.0)
        errors = f"largest error of {known.size} elastic frequencies {error:.3g} %"
        if not known.size:
            errors = "all compared modes are rigid (--modes, masters)"
        steps = self.reduction.iterations
        settled = "" if self.reduction.converged else f", not settled after {steps} iterations"
        return (
            f"{self.n_full} unknowns reduced to {self.reduction.stiffness.shape[0]} by "
            f"{self.method}{settled}: {errors}, condition number {self.reduction.condition:.1e}"
        )


def reduce_model(campaign: Campaign, values: Values, asked: ReductionRequest) -> ModelReduction:
    """Reduce a model at parameter values. Raises CampaignError, ModelError, SolverError."""
    names = masters_of(campaign, asked.masters) if asked.masters else sensor_names(campaign)
    model = full_model(campaign, values)
    wanted = model.observation(*dof_arrays(names)) if asked.masters else by_sensors(model)
    seen, moving = model.seen(wanted, names)
    kept = [names[place] for place in moving.tolist()]
    n, n_kept = seen.stiffness.shape[0], len(kept)
    count = min(asked.modes or min(COMPARED, n_kept), n)
    if asked.method == "serep" and count > n_kept:
        raise CampaignError(
            f"--modes {count}: SEREP keeps no more modes than there are masters, which are {n_kept}"
        )
    if asked.method == "craig_bampton":
        count = min(asked.modes or COMPARED, n - n_kept)
    compared = min(max(count, 1), n)
    with factor_room(model.room):
        eigenvalues, shapes = solve_modes(seen.stiffness, seen.mass, compared)
        found = _reduced(asked.method, seen, count, shapes)
    lam, phi = reduced_modes(found)
    compared = min(compared, lam.size)
    full, reduced = eigenvalues[:compared], lam[:compared]
    rigid = RIGID * float(np.abs(full).max())
    elastic = (full > rigid) & (reduced > rigid)
    full_hz, reduced_hz = (np.sqrt(np.maximum(a, 0.0)) / (2.0 * np.pi) for a in (full, reduced))
    errors = np.full(compared, np.nan)
    errors[elastic] = reduced_hz[elastic] / full_hz[elastic] - 1.0
    sets = [np.flatnonzero(~elastic), *_close(full_hz, elastic)]
    return ModelReduction(
        method=asked.method,
        masters=tuple(kept),
        held=tuple(names[place] for place in np.flatnonzero(wanted.held).tolist()),
        n_full=n,
        full_hz=full_hz,
        reduced_hz=reduced_hz,
        errors=errors,
        shared=_shared(seen, shapes[:, :compared], phi[:, :compared], sets),
        reduction=found,
        matrices=_written(model, found, kept, np.asarray(seen.back @ found.transformation)),
    )


def _close(full_hz: Floats, elastic: NDArray[np.bool_]) -> list[Integers]:
    """Places of elastic modes that are close to each other, a set each."""
    places = np.flatnonzero(elastic)
    return [places[item] for item in close_sets(full_hz[places], CLOSE)]


def _shared(seen: MeasuredModel, full: Floats, reduced: Floats, sets: list[Integers]) -> Floats:
    """Of each mode of the full model what modes of the reduced one in its places hold.

    All are of unit modal mass: products in the mass are cosines.
    """
    cosines = full.T @ (seen.mass @ reduced)
    found = np.zeros(full.shape[1])
    for places in sets:
        found[places] = np.sum(cosines[np.ix_(places, places)] ** 2, axis=1)
    return found


def _reduced(method: ReductionMethod, seen: MeasuredModel, count: int, shapes: Floats) -> Reduction:
    k, m, rows = seen.stiffness, seen.mass, seen.rows
    match method:
        case "guyan":
            return guyan(k, m, rows)
        case "irs":
            return irs(k, m, rows)
        case "iterated_irs":
            return iterated_irs(k, m, rows)
        case "serep":
            return serep(k, m, rows, shapes)
        case "craig_bampton":
            return craig_bampton(k, m, rows, count)


def _written(
    model: FullModel, found: Reduction, kept: Dofs, transformation: Floats
) -> WrittenMatrices:
    """Return the reduced matrices with the motion of all equations of the solver."""
    n_scalar = found.stiffness.shape[0] - len(kept)
    above = max(model.campaign.case.solver.deck.summary.node_ids, default=0) + 1
    nodes, components = dof_arrays([*kept, *((above + k, 1) for k in range(n_scalar))])
    extra: dict[str, Floats | Integers] = {
        "transformation": transformation,
        "full_nodes": model.matrices.nodes,
        "full_components": model.matrices.components,
    }
    text = f"modetune reduce: {model.campaign.name}, {found.method}, {len(kept)} masters"
    if n_scalar:
        text += f", {n_scalar} fixed-interface modes as scalar points from {above}"
    return WrittenMatrices(found.stiffness, found.mass, nodes, components, n_scalar, extra, (text,))
