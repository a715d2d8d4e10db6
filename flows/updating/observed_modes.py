"""Modes of matrices with all unknowns, as a campaign sees them: at its nodes, with energies."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse

from modetune.adapters.solver import ModalAnalysis
from modetune.core.algebra.eigen import SolvedModes
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.algebra.pencil import shift_below
from modetune.core.algebra.rigid_modes import GIVEN, PRINTED, count_rigid_modes, matrix_energies
from modetune.core.modes import Floats, Integers
from modetune.core.updating.results import ModalResult
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.updating.semi_analytic import UnlikeMatrices

#: Raised by hand when the same matrices are solved to other numbers.
MODES_VERSION = 6
#: Unobservable nodes that a message names.
NAMED = 5


def first_shift(campaign: Campaign) -> float:
    """A shift by the test's first frequency, (rad/s)^2."""
    first = 2.0 * np.pi * float(np.min(campaign.case.measured.modes.frequencies_hz))
    return shift_below(first**2)


def rounding(campaign: Campaign) -> float:
    """Of the matrices' entries, relative."""
    return PRINTED if campaign.case.solver.deck.summary.matrices is None else GIVEN


def solved_energies(
    campaign: Campaign, matrices: MatrixResult, solved: SolvedModes
) -> tuple[Floats, int]:
    """Energies (n_modes,), NaN of rigid modes, and how many modes are rigid."""
    energies = matrix_energies(matrices.upper_stiffness, solved.shapes, rounding(campaign))
    energies[energies == 0.0] = np.nan
    return energies, count_rigid_modes(solved.eigenvalues, energies, lambda: np.inf)


def modes_at(
    observer: Callable[[Integers, Integers], sparse.csr_array],
    eigenvalues: Floats,
    shapes: Floats,
    energies: Floats,
    n_rigid: int,
    analysis: ModalAnalysis,
) -> ModalResult:
    """The modes at an analysis' nodes, of shapes of all unknowns; observer: as `observer_of`."""
    eigenvalues = eigenvalues[: analysis.n_modes]
    nodes, components = named_freedoms(analysis.nodes)
    shapes = observer(nodes, components) @ shapes[:, : analysis.n_modes]
    rigid = min(n_rigid, eigenvalues.size)
    energies = energies[: eigenvalues.size]
    return ModalResult.of_shapes(eigenvalues, shapes, nodes, components, energies, rigid)


def observer_of(
    campaign: Campaign, base: MatrixResult, nodes: Integers, components: Integers
) -> sparse.csr_array:
    """What takes shapes of all unknowns to these degrees of freedom. Raises UnlikeMatrices."""
    seen = campaign.case.solver.deck.observation(base, nodes, components)
    unknown = np.unique(nodes[seen.unknown])
    if unknown.size:
        named = ", ".join(map(str, unknown[:NAMED].tolist()))
        more = f" and {unknown.size - NAMED} more" if unknown.size > NAMED else ""
        raise UnlikeMatrices(
            f"the motion of node {named}{more} does not follow from the stored matrices' unknowns"
        )
    return seen.matrix


def named_freedoms(nodes: tuple[int, ...]) -> tuple[Integers, Integers]:
    """The degrees of freedom of a modal result at these nodes: node by node, x, y, z."""
    ordered = np.array(sorted(nodes), dtype=np.int64)
    return np.repeat(ordered, 3), np.tile(np.arange(1, 4), ordered.size)
