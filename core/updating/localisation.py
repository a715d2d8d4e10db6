"""Where a model is wrong: maps of the error behind a difference of measured and computed modes.

Constitutive-relation error (Ladeveze, Nedjar and Reynier 1994). A measured mode of eigenvalue lam
is filled out to a field u of all unknowns, together with a field v whose stresses balance the
inertia of u, K v = lam M u. In a right model both are one; the energy of d = u - v is the error of
the constitutive relation. With T the sensors' view of the model and phi the measured shape,

    min  (d^T K d / lam) / tau^2  +  (|T u - phi| / |phi|)^2 / s^2,    K d = (K - lam M) u = r,

tau the relative error that is allowed to the model, s that of the measured shapes. The minimum
solves one sparse symmetric system for each mode, with a = lam tau^2 / (s |phi|)^2:

    [ -K            K - lam M ] [d]   [     0     ]
    [ K - lam M     a T^T T   ] [u] = [ a T^T phi ].

r is the modal force residual of the test in the model (of dynamic expansion it would live at the
sensors alone, of SEREP anywhere; here it is as small as the test allows). Three maps follow.

Force residual. A group of elements whose stiffness and mass are wrong by the share e leaves the
forces r = -e (K_g - lam M_g) u. The share of r that one e for all modes explains is

    share_g = <r, f_g>^2 / (<r, r> <f_g, f_g>),    f_g = -(K_g - lam M_g) u,

1 for the guilty group of a test without noise, at all unknowns, and then e is the error itself.
Best single and best pair are the first steps of the subspace method of Lallement and Piranda
(1990). <a, b> sums a^T (K + lam_1 M)^-1 b / lam over the modes: an energy, so that stiff and soft
unknowns weigh alike; lam_1, the lowest measured eigenvalue, makes it good for free structures.

Constitutive error. d^T K_g d over d^T K d, the share of the error's energy in each group, and how
many times more that is than the group's share of the strain energy of u. On the
mesh it is seen as the strain of d (`core/mesh`), which in a part that is wrong by
the share e is e times the strain of u.

Energies. Strain and kinetic energy of each group in the test's mode, u of unit modal mass, less
that in the computed mode, each over lam / 2 (Stubbs and Kim 1996 take the same for damage).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy import sparse

from modetune.core.algebra.factorisation import factorise
from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers
from modetune.core.updating.parameter_steps import StepProblem, parameter_step

#: Number of parameters, the best single ones, among which pairs are tried.
MOST_FOR_PAIRS = 40


@dataclass(frozen=True, slots=True)
class Group:
    """A part of the model that may be wrong.

    stiffness, mass: (n, n), what a relative error of one adds to K and M: p dK/dp and p dM/dp.
    """

    name: str
    stiffness: sparse.csr_array
    mass: sparse.csr_array


@dataclass(frozen=True, slots=True)
class ErrorFields:
    """Measured modes filled out, and what the model lacks to have them.

    eigenvalues: (n_modes,), measured, (rad/s)^2; displacements, errors, forces: (n, n_modes), the
    fields u, d and r; misfits: (n_modes,), |T u - phi| / |phi|.
    """

    eigenvalues: Floats
    displacements: Floats
    errors: Floats
    forces: Floats
    misfits: Floats


@dataclass(frozen=True, slots=True)
class GroupErrors:
    """How much each group is to blame; the module's docstring says by what.

    force_shares, changes: (n_groups,), share of the force residual that the group alone explains,
    and the relative error that does it. pairs: positions of the two groups that explain most
    together, pair_share and pair_changes (2,) likewise; empty where there is one group.
    error_shares, concentrations: (n_groups,). strain, kinetic: (n_groups, n_modes), energies of
    the test's mode less the computed one's.
    """

    force_shares: Floats
    changes: Floats
    pair: tuple[int, ...]
    pair_share: float
    pair_changes: Floats
    error_shares: Floats
    concentrations: Floats
    strain: Floats
    kinetic: Floats

    @property
    def ranking(self) -> Integers:
        """Positions of the groups, the most to blame by its force residual first."""
        return np.argsort(-self.force_shares, kind="stable")


@dataclass(frozen=True, slots=True)
class NodeErrors:
    """The force residual by nodes: numbers (n_nodes,), ascending.

    forces: (n_nodes,), root mean square over the modes of the residual forces on translations, the
    largest being 1.
    """

    nodes: Integers
    forces: Floats


@dataclass(frozen=True, slots=True)
class Removal:
    """Parameters that are changed alone, and the share of the weighted residual they remove.

    members: positions; changes: (n_members,), within the bounds; removed: 1 is all.
    """

    members: tuple[int, ...]
    changes: Floats
    removed: float


def error_fields(
    stiffness: sparse.csr_array,
    mass: sparse.csr_array,
    eigenvalues: Floats,
    measured: Floats,
    observer: sparse.csr_array,
    shape_deviations: Floats,
    model_deviation: float = 0.1,
) -> ErrorFields:
    """The fields of the constitutive-relation error, one factorisation a mode.

    stiffness, mass: (n, n); eigenvalues: (n_modes,), measured, above zero; measured: (n_sensors,
    n_modes), real, scaled to shapes of unit modal mass; observer: (n_sensors, n), T;
    shape_deviations: (n_modes,), of an entry relative to the shape's root mean square;
    model_deviation: tau.
    Raises ModesError where these do not fit together, ModelError where a system is singular.
    """
    n, n_modes = stiffness.shape[0], eigenvalues.size
    if measured.shape != (observer.shape[0], n_modes) or observer.shape[1] != n:
        raise ModesError(
            f"measured shapes {measured.shape} of {n_modes} modes do not fit sensors of shape "
            f"{observer.shape} on {n} unknowns"
        )
    lengths = np.linalg.norm(measured, axis=0)
    if not (np.isfinite(measured).all() and (lengths > 0.0).all() and (eigenvalues > 0.0).all()):
        raise ModesError("measured shapes and frequencies must be finite and not zero")
    u, d, r = (np.zeros((n, n_modes)) for _ in range(3))
    for mode, lam in enumerate(eigenvalues.tolist()):
        trust = lam * (model_deviation / (shape_deviations[mode] * lengths[mode])) ** 2
        shifted = stiffness - lam * mass
        seen = trust * (observer.T @ observer)
        system = sparse.block_array([[-stiffness, shifted], [shifted, seen]], format="csr")
        load = np.concatenate([np.zeros(n), trust * (observer.T @ measured[:, mode])])
        solution = factorise(system, np.inf).solve(load)
        d[:, mode], u[:, mode] = solution[:n], solution[n:]
        r[:, mode] = shifted @ u[:, mode]
    misfits = np.linalg.norm(observer @ u - measured, axis=0) / lengths
    return ErrorFields(eigenvalues, u, d, r, misfits)


def group_errors(
    fields: ErrorFields,
    stiffness: sparse.csr_array,
    mass: sparse.csr_array,
    groups: Sequence[Group],
    computed: Floats,
) -> GroupErrors:
    """All measures of all groups.

    computed: (n, n_modes), the model's modes that answer the measured ones, mass-normalised.
    """
    gram, cross, total = _force_products(fields, stiffness, mass, groups)
    squares = np.where(np.diag(gram) > 0.0, np.diag(gram), np.inf)
    pair, pair_share, pair_changes = _best_pair(gram, cross, total)
    u, d, lam = fields.displacements, fields.errors, fields.eigenvalues
    energy = float(np.sum(_forms(stiffness, d) / lam)) or 1.0
    own = np.array([np.sum(_forms(group.stiffness, d) / lam) for group in groups])
    unit = u / np.sqrt(_forms(mass, u))
    strain = np.array([_forms(group.stiffness, unit) / lam for group in groups])
    usual = strain.sum(axis=1) / float(np.sum(_forms(stiffness, unit) / lam))
    lam_c = _forms(stiffness, computed)
    return GroupErrors(
        force_shares=cross**2 / squares / (total or 1.0),
        changes=cross / squares,
        pair=pair,
        pair_share=pair_share,
        pair_changes=pair_changes,
        error_shares=own / energy,
        concentrations=np.where(usual > 1e-12, own / energy / np.maximum(usual, 1e-12), 0.0),
        strain=strain - np.array([_forms(group.stiffness, computed) / lam_c for group in groups]),
        kinetic=np.array(
            [_forms(group.mass, unit) - _forms(group.mass, computed) for group in groups]
        ),
    )


def _forms(matrix: sparse.csr_array, fields: Floats) -> Floats:
    """x^T A x of each column, (n_modes,)."""
    return np.asarray(np.sum(fields * (matrix @ fields), axis=0))


def _force_products(
    fields: ErrorFields,
    stiffness: sparse.csr_array,
    mass: sparse.csr_array,
    groups: Sequence[Group],
) -> tuple[Floats, Floats, float]:
    """<f_g, f_h> (n_groups, n_groups), <r, f_g> (n_groups,) and <r, r>."""
    u, lam = fields.displacements, fields.eigenvalues
    metric = factorise(sparse.csr_array(stiffness + float(lam.min()) * mass), np.inf)
    sides = [lam * (group.mass @ u) - group.stiffness @ u for group in groups]
    solved = [metric.solve(side) / lam for side in sides]
    gram = np.array([[float(np.sum(a * b)) for b in solved] for a in sides])
    cross = np.array([float(np.sum(fields.forces * b)) for b in solved])
    total = float(np.sum(fields.forces * metric.solve(fields.forces) / lam))
    return 0.5 * (gram + gram.T), cross, total


def _best_pair(gram: Floats, cross: Floats, total: float) -> tuple[tuple[int, ...], float, Floats]:
    """The two groups that explain most of the force residual together."""
    best: tuple[tuple[int, ...], float, Floats] = ((), 0.0, np.zeros(0))
    for members in combinations(range(cross.size), 2):
        part = np.ix_(members, members)
        changes = np.linalg.lstsq(gram[part], cross[list(members)], rcond=1e-12)[0]
        share = float(changes @ cross[list(members)]) / (total or 1.0)
        if share > best[1]:
            best = (members, share, changes)
    return best


def node_errors(fields: ErrorFields, nodes: Integers, components: Integers) -> NodeErrors:
    """The force residual by nodes.

    nodes, components: (n,), what each unknown is called; unknowns of one node are summed.
    """
    # Forces on a shape of unit modal mass grow with lam: divided by it all modes count alike.
    squares = np.mean((fields.forces / fields.eigenvalues) ** 2, axis=1) * (components <= 3)
    names, owner = np.unique(nodes, return_inverse=True)
    forces = np.sqrt(np.bincount(owner, squares, names.size))
    return NodeErrors(names, forces / (float(forces.max(initial=0.0)) or 1.0))


def removals(
    sensitivity: Floats, residual: Floats, weights: Floats, lower: Floats, upper: Floats
) -> tuple[tuple[Removal, ...], tuple[Removal, ...]]:
    """What each parameter, and each pair, can remove of the weighted residual; the best first.

    sensitivity: (n_residuals, n_parameters); residual, weights: (n_residuals,); lower, upper:
    (n_parameters,), bounds of the change. Linear.
    """
    size = sensitivity.shape[1]
    singles = [
        _removal((place,), sensitivity, residual, weights, (lower, upper)) for place in range(size)
    ]
    singles.sort(key=lambda item: -item.removed)
    among = sorted(item.members[0] for item in singles[:MOST_FOR_PAIRS])
    pairs = [
        _removal(members, sensitivity, residual, weights, (lower, upper))
        for members in combinations(among, 2)
    ]
    pairs.sort(key=lambda item: -item.removed)
    return tuple(singles), tuple(pairs)


def _removal(
    members: tuple[int, ...],
    sensitivity: Floats,
    residual: Floats,
    weights: Floats,
    box: tuple[Floats, Floats],
) -> Removal:
    chosen = list(members)
    problem = StepProblem(
        sensitivity[:, chosen],
        residual,
        weights,
        np.ones(len(chosen)),
        np.zeros(len(chosen)),
        box[0][chosen],
        box[1][chosen],
    )
    if not (np.abs(problem.sensitivity) * weights[:, None] > 0.0).any():
        return Removal(members, np.zeros(len(chosen)), 0.0)
    step = parameter_step(problem, "weighted_least_squares")
    before = float(residual @ (weights * residual))
    after = float(step.predicted @ (weights * step.predicted))
    return Removal(members, step.change, 1.0 - after / before if before > 0.0 else 0.0)
