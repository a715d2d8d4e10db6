"""Results of a run: modes as the files of Nastran list them, then in the order of the analysis.

OP2 and F06 files give one mode after the other. Every mode must list the same points; a
scalar point has its first component only.

Shapes stay in the frame of each node that the deck chose for its results (CD), and masses are in
the deck's consistent units: the weight generator takes PARAM,WTMASS off, so it is put on again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from modetune.adapters.cross_checks import SPARE_EIGENVALUE, check_energies
from modetune.adapters.solver import ModalAnalysis
from modetune.core.modes import Floats, Integers, ModeSet, mode_set
from modetune.core.updating.job_results import ModalResult

COMPONENTS = 6
#: Generalised masses are printed with seven digits; what is this near to 1 is 1.
UNIT_MASS = 1e-5


@dataclass(frozen=True, slots=True)
class NastranModes:
    """What a file says of normal modes, in the deck's own units and the file's normalisation.

    eigenvalues, generalized_mass: (n_modes,), (rad/s)^2, the latter NaN or empty if unknown.
    mode_numbers: (n_shapes,), places of the shapes' eigenvalues, from 1; nodes, components:
    (n_dof,), components 1..6; mode_shapes: (n_dof, n_shapes), sorted by node, in each point's
    output frame (CD); n_dof is 0 where no shapes were asked for.
    elements: (n_el,), ascending; strain_energies: (n_el, n_modes), NaN where the file does not
    list the element for the mode; total_strain_energy: (n_modes,), of the whole problem, NaN
    where there are no energies.
    mass: of the grid point weight generator, which takes PARAM,WTMASS off again; NaN where there is
    none.
    """

    eigenvalues: Floats
    generalized_mass: Floats
    mode_numbers: Integers
    nodes: Integers
    components: Integers
    mode_shapes: Floats
    elements: Integers
    strain_energies: Floats
    total_strain_energy: Floats
    mass: float


@dataclass(frozen=True, slots=True)
class GridShape:
    """One mode as listed: nodes and scalar (n_nodes,), values (n_nodes, 6)."""

    mode: int
    eigenvalue: float
    nodes: Integers
    scalar: np.ndarray[tuple[int], np.dtype[np.bool_]]
    values: Floats


@dataclass(frozen=True, slots=True)
class ElementEnergies:
    """Strain energies of one element type in one mode; elements and energies are (n_el,).

    total: of all elements of the problem, NaN if unknown.
    """

    mode: int
    element_type: str
    total: float
    elements: Integers
    energies: Floats


def shape_matrix(shapes: Sequence[GridShape], n_modes: int) -> tuple[Integers, Integers, Floats]:
    """Nodes (n_dof,), components (n_dof,) and mode shapes (n_dof, n_modes), sorted by node.

    Raises ValueError where modes list different points, a point twice, or no finite number.
    """
    if not shapes:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros((0, n_modes))
    first = shapes[0]
    order = np.argsort(first.nodes, kind="stable")
    nodes, scalar = first.nodes[order], first.scalar[order]
    if nodes.size == 0 or nodes[0] < 1 or (np.diff(nodes) == 0).any():
        raise ValueError(f"mode {first.mode} lists no points, a point twice, or one below 1")
    for shape in shapes:
        if not (
            np.array_equal(shape.nodes, first.nodes) and np.array_equal(shape.scalar, first.scalar)
        ):
            raise ValueError(f"modes {first.mode} and {shape.mode} list different points")
    used = np.ones((nodes.size, 6), dtype=np.bool_)
    used[scalar, 1:] = False
    columns = [shape.values[order][used] for shape in shapes]
    matrix = np.stack(columns, axis=1)
    # MYSTRAN prints no numbers for some modes of spare unknowns, which `without_spare` leaves out.
    matrix[:, [shape.eigenvalue >= 0.5 * SPARE_EIGENVALUE for shape in shapes]] = 0.0
    if not np.isfinite(matrix).all():
        raise ValueError("a mode shape is not a finite number")
    rows, columns_used = np.nonzero(used)
    return nodes[rows], columns_used + 1, matrix


def energy_table(
    tables: Sequence[ElementEnergies], numbers: Sequence[int]
) -> tuple[Integers, Floats, Floats]:
    """Elements (n_el,), energies (n_el, n_modes) and totals (n_modes,) for these mode numbers.

    NaN where a mode does not list an element. A table that comes twice for a mode and an element
    type counts once; an element number that several types have (a plate and a concentrated mass,
    say) gets the sum of both, for an energy cannot be asked of the one alone by number.
    Raises ValueError for an energy or a total that is infinite or not a number.
    """
    place = {number: column for column, number in enumerate(numbers)}
    kept = {(table.element_type, table.mode): table for table in tables if table.mode in place}
    elements = np.unique(
        np.concatenate([np.zeros(0, dtype=np.int64), *(t.elements for t in kept.values())])
    )
    energies = np.full((elements.size, len(numbers)), np.nan)
    totals = np.full(len(numbers), np.nan)
    for table in kept.values():
        if not (np.isfinite(table.energies).all() and np.isfinite(table.total)):
            raise ValueError(f"a strain energy of mode {table.mode} is not a finite number")
        rows, column = np.searchsorted(elements, table.elements), place[table.mode]
        # Within one type an element occurs once; a second row repeats the first.
        energies[rows, column] = np.nan_to_num(energies[rows, column]) + table.energies
        totals[column] = table.total
    return elements, energies, totals


def unit_modes(found: NastranModes) -> ModeSet:
    """Return the modes of a file at all of its nodes, of unit modal mass if it has modal masses.

    Raises ValueError where a mode has no shape.
    """
    n_modes = found.mode_shapes.shape[1]
    shown = found.mode_numbers
    if not n_modes or shown.max() > found.eigenvalues.size:
        raise ValueError(f"{found.eigenvalues.size} eigenvalues and {n_modes} eigenvectors")
    masses = found.generalized_mass[shown - 1]
    return mode_set(
        np.sqrt(np.maximum(found.eigenvalues[shown - 1], 0.0)) / (2.0 * np.pi),
        found.mode_shapes * unit_scale(masses),
        found.nodes,
        found.components,
        normalisation="unknown" if np.isnan(masses).any() else "mass",
    )


def unit_scale(generalized_mass: Floats) -> Floats:
    """Return factors that mass-normalise the shapes, (n_modes,); 1 if the masses are unknown."""
    known = np.where(np.isnan(generalized_mass), 1.0, generalized_mass)
    if not (known > 0.0).all():
        mode = int(np.argmin(known)) + 1
        raise ValueError(f"mode {mode} with the generalised mass {known.min():g}")
    return np.where(np.abs(known - 1.0) < UNIT_MASS, 1.0, known**-0.5)


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
