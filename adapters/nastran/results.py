"""From what a run left to results: modes in the analysis' order, and sensitivities.

Shapes stay in the frame of each node that the deck chose for its results (CD), and masses are in
the deck's consistent units: the weight generator takes PARAM,WTMASS off, so it is put on again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from modetune.adapters.cross_checks import check_energies
from modetune.adapters.nastran.design import COMPONENTS, n_rows, response_id
from modetune.adapters.nastran.design_sensitivity import DesignSensitivities
from modetune.adapters.nastran.eigenvectors import NastranModes, unit_scale
from modetune.adapters.solver import ModalAnalysis, SensitivityAnalysis
from modetune.core.modes import Floats, Integers, mode_set
from modetune.core.updating.results import ModalResult, ModeDerivatives


def completed(modes: NastranModes, printed: NastranModes) -> NastranModes:
    """An OP2 file's modes, with what the print file has and the OP2 file lacks."""
    n_modes = modes.eigenvalues.size
    lacking: list[str] = []
    if printed.eigenvalues.size == n_modes and np.isnan(modes.generalized_mass).all():
        lacking += ["generalized_mass"]
    if not modes.nodes.size and printed.mode_shapes.shape[1] == n_modes:
        lacking += ["nodes", "components", "mode_shapes"]
    if not modes.elements.size and printed.strain_energies.shape[1] == n_modes:
        lacking += ["elements", "strain_energies", "total_strain_energy"]
    if not np.isfinite(modes.mass):
        lacking += ["mass"]
    return replace(modes, **{name: getattr(printed, name) for name in lacking})


def modal_result(
    modes: NastranModes,
    analysis: ModalAnalysis,
    group_elements: Sequence[frozenset[int]],
    wtmass: float,
) -> ModalResult:
    """The lowest n_modes of a run.

    group_elements: the elements of each of the analysis' groups. Raises ValueError with the
    reason where the run does not hold what was asked for.
    """
    n_modes = analysis.n_modes
    if modes.eigenvalues.size < n_modes:
        raise ValueError(
            f"{modes.eigenvalues.size} modes of the {n_modes} that were asked for; the model has "
            "fewer, or the run broke off"
        )
    eigenvalues = modes.eigenvalues[:n_modes]
    scale = unit_scale(modes.generalized_mass[:n_modes])
    rows = shape_rows(modes.nodes, modes.components, analysis.nodes)
    total = modes.total_strain_energy[:n_modes] * scale**2
    check_energies(eigenvalues, total)
    return ModalResult(
        eigenvalues=eigenvalues,
        modes=mode_set(
            np.sqrt(np.maximum(eigenvalues, 0.0)) / (2.0 * np.pi),
            modes.mode_shapes[rows, :n_modes] * scale,
            np.repeat(np.asarray(analysis.nodes, dtype=np.int64), COMPONENTS),
            np.tile(np.arange(1, COMPONENTS + 1), len(analysis.nodes)),
            normalisation="mass",
        ),
        groups=tuple(name for name, _ in analysis.groups),
        strain_energies=np.array(
            [
                _group_energy(modes, name, elements, n_modes) * scale**2
                for (name, _), elements in zip(analysis.groups, group_elements, strict=True)
            ]
        ).reshape(len(analysis.groups), n_modes),
        total_strain_energy=total,
        mass=modes.mass * wtmass,
    )


def shape_rows(nodes: Integers, components: Integers, wanted: Sequence[int]) -> Integers:
    """Rows of six components at each wanted node, in that order, (6 n_wanted,).

    Raises ValueError where the shapes are at other nodes than those.
    """
    found = set(nodes.tolist())
    missing = [node for node in wanted if node not in found]
    more = sorted(found - set(wanted))
    if missing or more:
        kind, node = ("no", missing[0]) if missing else ("an unasked", more[0])
        raise ValueError(
            f"shapes at {len(found)} nodes where {len(wanted)} were asked for: {kind} shape at "
            f"node {node}"
        )
    place = {
        dof: row for row, dof in enumerate(zip(nodes.tolist(), components.tolist(), strict=True))
    }
    wanted_dofs = [(node, component + 1) for node in wanted for component in range(COMPONENTS)]
    if any(dof not in place for dof in wanted_dofs):
        raise ValueError("shapes with fewer than six components at a node: it is a scalar point")
    return np.array([place[dof] for dof in wanted_dofs], dtype=np.int64)


def _group_energy(modes: NastranModes, name: str, elements: frozenset[int], n_modes: int) -> Floats:
    """Strain energy of a group's elements in each mode, (n_modes,)."""
    rows = np.isin(modes.elements, sorted(elements))
    energies = modes.strain_energies[rows, :n_modes]
    if int(rows.sum()) < len(elements) or np.isnan(energies).any():
        listed = set(modes.elements[rows][~np.isnan(energies).any(axis=1)].tolist())
        lost = min(elements - listed)
        raise ValueError(
            f"no strain energy of element {lost}, which group {name} has, in all modes"
        )
    return np.asarray(energies.sum(axis=0))


def mode_derivatives(
    found: DesignSensitivities, analysis: SensitivityAnalysis, values: Sequence[float]
) -> ModeDerivatives:
    """Derivatives with respect to the relative values of the analysis' parameters.

    values: where the parameters stand (design.py tells why they divide). Rows of rigid modes are
    rounding. Raises ValueError that names the first response or variable that is not there.
    """
    n_parameters = len(analysis.parameters)
    columns = {response.number: place for place, response in enumerate(found.responses)}
    # Where the file does not number its rows, they are all of the job's design variables.
    known = found.design_variables.tolist() or list(range(1, len(found.values) + 1))
    for place, name in enumerate(analysis.parameters):
        if place + 1 not in known:
            raise ValueError(f"no sensitivities to design variable {place + 1} ({name})")
    rows = [known.index(place + 1) for place in range(n_parameters)]
    table = found.values[rows] / np.asarray(values)[:, None]

    def derivatives(mode: int, row: int = -1) -> Floats:
        number = response_id(analysis, mode, row)
        if number not in columns:
            what = f"the eigenvalue of mode {mode + 1}"
            if row >= 0:
                node = analysis.nodes[row // COMPONENTS]
                what = f"component {row % COMPONENTS + 1} of node {node} in mode {mode + 1}"
            raise ValueError(f"no sensitivity of {what} (response {number})")
        slopes: Floats = table[:, columns[number]]
        return slopes

    modes = range(analysis.n_modes)
    slopes = np.array([derivatives(mode) for mode in modes])
    shapes = np.array(
        [[derivatives(mode, row) for mode in modes] for row in range(n_rows(analysis))]
    )
    return ModeDerivatives(slopes, shapes.reshape(-1, analysis.n_modes, n_parameters))
