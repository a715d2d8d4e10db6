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

Energies. The group's share of the strain and of the kinetic energy of the test's mode u, less that
in the computed mode (Stubbs and Kim 1996 take the same for damage).

What is reported is bounded. A share of energy is |x^T A_g x| over the sum of these of all groups,
at least over x^T A x. A change is the best one within the group's bounds, and share_g the share
that this change explains, (2 e <r, f_g> - e^2 <f_g, f_g>) / <r, r>. A group with less than
NEGLIGIBLE of the energy in every mode has no change: its forces are noise, and at the worst the
rounding of u. The systems above are solved with one refinement, whose size is the relative error of
u by rounding.

Stability. Without sensor j the solution follows from the same factors (Sherman and Morrison 1950).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.algebra.factorisation import Factorisation, factorise
from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers
from modetune.core.updating.parameter_steps import StepProblem, parameter_step

#: Number of parameters or groups, the best single ones, among which pairs are tried.
MOST_FOR_PAIRS = 40
#: Share of the energy of a mode below which no test determines a change: by 100 % it moves the
#: frequency by half of that, 0.005 %.
NEGLIGIBLE = 1e-4
#: Share of the force residual below which a change explains nothing.
EXPLAINS = 1e-3
#: Error of a field by rounding, relative to it, from which on it is not used: its energies are then
#: off by the square, a hundredth of NEGLIGIBLE.
ROUNDING = 1e-3
#: Condition of two groups' forces from which on their changes cannot be told apart.
INSEPARABLE = 1e4
#: Groups, the best ones, whose stability is examined.
EXAMINED = 4


@dataclass(frozen=True, slots=True)
class Group:
    """A part of the model that may be wrong.

    stiffness, mass: (n, n), what a relative error of one adds to K and M: p dK/dp and p dM/dp.
    lower, upper: bounds of the relative error.
    """

    name: str
    stiffness: sparse.csr_array
    mass: sparse.csr_array
    lower: float = -1.0
    upper: float = 1.0


@dataclass(frozen=True, slots=True)
class ErrorFields:
    """Measured modes filled out, and what the model lacks to have them.

    eigenvalues: (n_modes,), measured, (rad/s)^2; displacements, errors, forces: (n, n_modes), the
    fields u, d and r; misfits: (n_modes,), |T u - phi| / |phi|. conditions: (n_modes,), of their
    systems; roundings: (n_modes,), relative error of u by rounding. left_out: (n_left,), sensors
    that were left out one at a time, and without: (n_left, n, n_modes), u without each.
    """

    eigenvalues: Floats
    displacements: Floats
    errors: Floats
    forces: Floats
    misfits: Floats
    conditions: Floats = field(default_factory=lambda: np.zeros(0))
    roundings: Floats = field(default_factory=lambda: np.zeros(0))
    left_out: Integers = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    without: Floats = field(default_factory=lambda: np.zeros((0, 0, 0)))

    def select(self, modes: NDArray[np.bool_]) -> ErrorFields:
        """Return the fields of some modes, (n_modes,)."""
        return ErrorFields(
            self.eigenvalues[modes],
            self.displacements[:, modes],
            self.errors[:, modes],
            self.forces[:, modes],
            self.misfits[modes],
            self.conditions[modes],
            self.roundings[modes],
            self.left_out,
            self.without[:, :, modes],
        )


@dataclass(frozen=True, slots=True)
class JackknifeRanking:
    """The best groups when sensors are left out one at a time.

    groups: (n_examined,), positions, the best first. left_out: (n_left,), sensors. shares, changes:
    (n_left, n_examined).
    """

    groups: Integers
    left_out: Integers
    shares: Floats
    changes: Floats

    @property
    def upsets(self) -> Integers:
        """Return the sensors without which another group ranks first."""
        if not self.left_out.size or not self.groups.size:
            return self.left_out[:0]
        return np.asarray(self.left_out[np.argmax(self.shares, axis=1) != 0])

    @property
    def ranges(self) -> Floats:
        """Return the smallest and the largest change of each group, (n_examined, 2).

        Empty where no sensor was left out.
        """
        if not self.left_out.size:
            return np.zeros((0, 2))
        return np.stack([self.changes.min(axis=0), self.changes.max(axis=0)], axis=1)

    @property
    def varies(self) -> bool:
        """Return whether the change of the best group varies by more than a factor of two."""
        if not (self.left_out.size and self.groups.size):
            return False
        low, high = sorted(np.abs(self.ranges[0]).tolist())
        return bool(self.ranges[0].prod() < 0.0 or high > 2.0 * low)


@dataclass(frozen=True, slots=True)
class GroupErrors:
    """How much each group is to blame; the module's docstring says by what.

    force_shares, changes: (n_groups,), share of the force residual that the group alone explains,
    and the relative error within its bounds that does it, NaN where the group has no energy or
    explains nothing; at_bound: (n_groups,). pair: positions of the two groups that explain most
    together, pair_share and pair_changes (2,) likewise; empty where no two can be separated.
    error_shares, concentrations: (n_groups,), the latter NaN without energy. strain, kinetic:
    (n_groups, n_modes), shares of energy of the test's mode less the computed one's. condition: of
    the metric.
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
    at_bound: NDArray[np.bool_]
    condition: float
    stability: JackknifeRanking

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

    members: positions; changes: (n_members,), within the bounds; removed: 1 is all; at_bound:
    whether a bound limits them.
    """

    members: tuple[int, ...]
    changes: Floats
    removed: float
    at_bound: bool = False

    @property
    def explains(self) -> bool:
        """Whether the changes remove anything."""
        return self.removed >= EXPLAINS


def error_fields(
    stiffness: sparse.csr_array,
    mass: sparse.csr_array,
    eigenvalues: Floats,
    measured: Floats,
    observer: sparse.csr_array,
    shape_deviations: Floats,
    model_deviation: float = 0.1,
    left_out: Sequence[int] = (),
) -> ErrorFields:
    """The fields of the constitutive-relation error, one factorisation a mode.

    stiffness, mass: (n, n); eigenvalues: (n_modes,), measured, above zero; measured: (n_sensors,
    n_modes), real, scaled to shapes of unit modal mass; observer: (n_sensors, n), T;
    shape_deviations: (n_modes,), of an entry relative to the shape's root mean square;
    model_deviation: tau. left_out: sensors to leave out, one at a time.
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
    conditions, roundings = np.zeros(n_modes), np.zeros(n_modes)
    without = np.zeros((len(left_out), n, n_modes))
    ends = observer[list(left_out)].toarray() if len(left_out) else np.zeros((0, n))
    for mode, lam in enumerate(eigenvalues.tolist()):
        trust = lam * (model_deviation / (shape_deviations[mode] * lengths[mode])) ** 2
        shifted = stiffness - lam * mass
        seen = trust * (observer.T @ observer)
        system = sparse.block_array([[-stiffness, shifted], [shifted, seen]], format="csr")
        load = np.concatenate([np.zeros(n), trust * (observer.T @ measured[:, mode])])
        factors = factorise(system, np.inf)
        first = factors.solve(load)
        correction = factors.solve(load - system @ first)
        solution = first + correction
        d[:, mode], u[:, mode] = solution[:n], solution[n:]
        r[:, mode] = shifted @ u[:, mode]
        conditions[mode], roundings[mode] = factors.condition, _rounding(correction[n:], first[n:])
        for place, end in enumerate(ends):
            alone = factors.solve(np.concatenate([np.zeros(n), end]))[n:]
            reading = float(measured[left_out[place], mode])
            rest = 1.0 - trust * float(end @ alone)
            # A sensor without which nothing fixes the field leaves no field.
            gap = trust * (float(end @ u[:, mode]) - reading)
            without[place, :, mode] = u[:, mode] + (alone * gap / rest if rest > 1e-9 else 0.0)
    misfits = np.linalg.norm(observer @ u - measured, axis=0) / lengths
    rows = np.asarray(left_out, dtype=np.int64)
    return ErrorFields(eigenvalues, u, d, r, misfits, conditions, roundings, rows, without)


def _rounding(correction: Floats, found: Floats) -> float:
    """Return the size of a correction relative to what it corrects."""
    size = float(np.linalg.norm(found))
    return float(np.linalg.norm(correction)) / size if size > 0.0 else np.inf


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
    u, d, lam = fields.displacements, fields.errors, fields.eigenvalues
    parts = [group.stiffness for group in groups], [group.mass for group in groups]
    own, usual, own_mass = (
        _shares(whole, of, shapes)
        for whole, of, shapes in (
            (stiffness, parts[0], d),
            (stiffness, parts[0], u),
            (mass, parts[1], u),
        )
    )
    weight = _forms(stiffness, d) / lam
    error_shares = own @ weight / (float(weight.sum()) or 1.0)
    weighty = np.maximum(usual, own_mass).max(axis=1, initial=0.0) >= NEGLIGIBLE
    metric = factorise(sparse.csr_array(stiffness + float(lam.min()) * mass), np.inf)
    gram, cross, total = _force_products(fields, metric, groups)
    box = np.array([[group.lower, group.upper] for group in groups]).reshape(-1, 2)
    changes, shares = _explained(np.diag(gram), cross, total, box, weighty)
    order = np.argsort(-shares, kind="stable")
    tried = sorted(place for place in order[:MOST_FOR_PAIRS].tolist() if weighty[place])
    pair, pair_share, pair_changes = _best_pair(gram, cross, total, box, tried)
    mean = usual.mean(axis=1)
    examined = np.array([n for n in order[:EXAMINED].tolist() if shares[n] >= EXPLAINS], dtype=int)
    return GroupErrors(
        force_shares=shares,
        changes=np.where(shares >= EXPLAINS, changes, np.nan),
        pair=pair,
        pair_share=pair_share,
        pair_changes=pair_changes,
        error_shares=error_shares,
        concentrations=np.where(
            mean >= NEGLIGIBLE, error_shares / np.maximum(mean, NEGLIGIBLE), np.nan
        ),
        strain=usual - _shares(stiffness, parts[0], computed),
        kinetic=own_mass - _shares(mass, parts[1], computed),
        at_bound=weighty & ((changes <= box[:, 0]) | (changes >= box[:, 1])),
        condition=metric.condition,
        stability=_stability(fields, stiffness, mass, metric, groups, examined, box),
    )


def _shares(whole: sparse.csr_array, parts: Sequence[sparse.csr_array], shapes: Floats) -> Floats:
    """Return the share of each part in the energy of each shape, (n_parts, n_modes), 0 to 1."""
    sizes = np.abs([_forms(part, shapes) for part in parts]).reshape(len(parts), -1)
    sums = np.maximum(_forms(whole, shapes), sizes.sum(axis=0))
    return np.asarray(sizes / np.where(sums > 0.0, sums, 1.0))


def _explained(
    squares: Floats, cross: Floats, total: float, box: Floats, weighty: NDArray[np.bool_]
) -> tuple[Floats, Floats]:
    """Return each group's best change within its bounds, and the share that it explains."""
    acts = weighty & (squares > 0.0)
    changes = np.where(acts, cross / np.where(acts, squares, 1.0), 0.0)
    changes = np.clip(changes, np.minimum(box[:, 0], 0.0), np.maximum(box[:, 1], 0.0))
    shares = changes * (2.0 * cross - changes * squares) / (total or 1.0)
    return changes, np.clip(shares, 0.0, 1.0)


def _stability(
    fields: ErrorFields,
    stiffness: sparse.csr_array,
    mass: sparse.csr_array,
    metric: Factorisation,
    groups: Sequence[Group],
    examined: Integers,
    box: Floats,
) -> JackknifeRanking:
    """Return the shares and changes of some groups without each sensor that was left out."""
    lam, few = fields.eigenvalues, [groups[place] for place in examined.tolist()]
    shares = np.zeros((fields.left_out.size, examined.size))
    changes = np.zeros_like(shares)
    for row, u in enumerate(fields.without if examined.size else ()):
        forces = stiffness @ u - lam * (mass @ u)
        there = replace(fields, displacements=u, forces=forces)
        gram, cross, total = _force_products(there, metric, few)
        every = np.ones(examined.size, dtype=bool)
        changes[row], shares[row] = _explained(np.diag(gram), cross, total, box[examined], every)
    return JackknifeRanking(examined, fields.left_out, shares, changes)


def _forms(matrix: sparse.csr_array, fields: Floats) -> Floats:
    """x^T A x of each column, (n_modes,)."""
    return np.asarray(np.sum(fields * (matrix @ fields), axis=0))


def _force_products(
    fields: ErrorFields, metric: Factorisation, groups: Sequence[Group]
) -> tuple[Floats, Floats, float]:
    """<f_g, f_h> (n_groups, n_groups), <r, f_g> (n_groups,) and <r, r>."""
    u, lam = fields.displacements, fields.eigenvalues
    sides = [lam * (group.mass @ u) - group.stiffness @ u for group in groups]
    solved = [metric.solve(side) / lam for side in sides]
    gram = np.array([[float(np.sum(a * b)) for b in solved] for a in sides])
    cross = np.array([float(np.sum(fields.forces * b)) for b in solved])
    total = float(np.sum(fields.forces * metric.solve(fields.forces) / lam))
    return 0.5 * (gram + gram.T), cross, total


def _best_pair(
    gram: Floats, cross: Floats, total: float, box: Floats, tried: Sequence[int]
) -> tuple[tuple[int, ...], float, Floats]:
    """Return the two groups that explain most of the force residual together, within bounds.

    tried: positions of the groups that may be one of them.
    """
    best: tuple[tuple[int, ...], float, Floats] = ((), 0.0, np.zeros(0))
    for members in combinations(tried, 2):
        part, load = gram[np.ix_(members, members)], cross[list(members)]
        sizes = np.sqrt(np.diag(part))
        if not (sizes > 0.0).all():
            continue
        # Of two forces of unit length the eigenvalues are 1 + c and 1 - c.
        cosine = abs(float(part[0, 1] / (sizes[0] * sizes[1])))
        if 1.0 + cosine > INSEPARABLE * (1.0 - cosine):
            continue
        changes = _in_box(part, load, box[list(members)])
        share = float(2.0 * changes @ load - changes @ part @ changes) / (total or 1.0)
        if share > best[1]:
            best = (members, min(share, 1.0), changes)
    return best


def _in_box(gram: Floats, load: Floats, box: Floats) -> Floats:
    """Return the two changes within bounds, (2,), with the minimum of c^T G c / 2 - c^T b."""
    free = np.linalg.solve(gram, load)
    lower, upper = np.minimum(box[:, 0], 0.0), np.maximum(box[:, 1], 0.0)
    if ((free >= lower) & (free <= upper)).all():
        return np.asarray(free)
    found: list[Floats] = []
    for fixed in (0, 1):  # else the minimum is on one of four edges
        for value in (lower[fixed], upper[fixed]):
            other = 1 - fixed
            changes = np.full(2, value)
            best = (load[other] - gram[other, fixed] * value) / gram[other, other]
            changes[other] = np.clip(best, lower[other], upper[other])
            found.append(changes)
    return min(found, key=lambda item: float(item @ gram @ item / 2.0 - item @ load))


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
    removed = min(max(1.0 - after / before, 0.0), 1.0) if before > 0.0 else 0.0
    reach = 1e-9 * np.maximum(1.0, np.abs(step.change))
    on_bound = (step.change <= problem.lower + reach) | (step.change >= problem.upper - reach)
    return Removal(members, step.change, removed, bool(on_bound.any()))
