"""One lumped mass that explains the differences of all frequencies.

A mass m at a node changes the modes to those of

    diag(lambda) q = mu (I + m sum_c phi_c phi_c^T) q

with phi_c the mass-normalised modal displacements of the node along c = x, y, z. Of all nodes and
masses those are taken whose changes of ln lambda are nearest to the measured differences, after
removing what the parameters (or a factor that all frequencies have in common) change. Such a
difference lies in a space of d = modes - parameters directions, where a random one is as close to
one given direction as sin^2 = r with probability

    I_r((d - 1) / 2, 1 / 2) / 2                     (I: regularised incomplete beta function),

so a mass is named only if it is unlikely that any node fits so well by chance.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy
from scipy.linalg import eigh

from modetune.core.modes import Floats, Integers
from modetune.core.updating.job_results import ModalResult
from modetune.flows.campaign.case import Case
from modetune.flows.diagnosis.findings import MODEL, Finding
from modetune.flows.diagnosis.pairing import WEAK_MAC, ModePreview

#: Probability that some node fits by chance.
CHANCE = 0.01
#: Nodes whose fits count as independent: neighbours move alike.
INDEPENDENT = 30
#: Nodes whose mass is fitted, the best of a linear fit.
TRIED = 8
#: Differences of ln frequency in standard deviations of the test, root mean square, to explain.
SIGNIFICANT = 5.0
#: Root mean square relative frequency difference below which no mass is looked for.
LEAST = 0.005


def point_mass_findings(
    case: Case, result: ModalResult, modes: tuple[ModePreview, ...], columns: Floats | None = None
) -> Iterator[Finding]:
    """Report a lumped mass that the model lacks, or has in excess.

    modes: the test modes with their pairs. columns: (n_measured, n_parameters), derivatives of
    ln lambda of the measured modes, each parameter to any scale, NaN where unknown; None for one
    common factor.
    """
    numbers = case.measured.numbers
    own = np.ones((len(numbers), 1)) if columns is None else columns
    own = own[[numbers.index(mode.mode) for mode in modes]]
    pairs = [
        place
        for place, mode in enumerate(modes)
        if not mode.judged_mac < WEAK_MAC and np.isfinite(own[place]).all()
    ]
    basis = _basis(own[pairs])
    d = len(pairs) - basis.shape[1]
    computed = np.array([modes[place].elastic_mode - 1 for place in pairs], dtype=np.int64)
    rows = np.flatnonzero(result.modes.components <= 3)
    if d < 3 or not rows.size or result.modes.normalisation != "mass":
        return
    wanted = np.array([2.0 * np.log(modes[p].test_hz / modes[p].computed_hz) for p in pairs])
    rest = wanted - basis @ (basis.T @ wanted)
    size = float(np.linalg.norm(rest))
    rms = 0.5 * size / np.sqrt(len(pairs))
    deviations = dict(
        zip(case.test.numbers, case.weighting.frequency_deviations.tolist(), strict=True)
    )
    noise = np.array([deviations.get(modes[p].mode, 0.0) for p in pairs])
    if rms < max(LEAST, SIGNIFICANT * float(np.sqrt(np.mean(noise**2)))):
        return
    nodes, motion = _node_motion(result, rows)
    best = _best(result, computed + result.n_rigid, motion, rest, basis)
    if best is None:
        return
    place, mass, left = best
    share = (left / size) ** 2
    n_nodes = min(nodes.size, INDEPENDENT)
    chance = float(scipy.special.betainc(0.5 * (d - 1), 0.5, min(share, 1.0)))
    if n_nodes * 0.5 * chance > CHANCE:
        return
    unit, lacks = case.units.split("-")[1], mass > 0.0
    remedy = (
        "add what the tested structure carries there (cables, sensors, exciter)"
        if lacks
        else "check the masses of the model there"
    )
    rms_left = 0.5 * left / np.sqrt(len(pairs))
    yield MODEL.doubtful(
        f"a lumped mass of {abs(mass):.3g} {unit} {'more' if lacks else 'less'} at node "
        f"{nodes[place]}, or one that moves alike, would explain the frequencies: their rms "
        f"difference would be {100 * rms_left:.2g} % instead of {100 * rms:.2g} %",
        "",
        f"{remedy}, or update a mass there: `parameters`, `quantity: mass`",
    )


def _basis(columns: Floats) -> Floats:
    """Return an orthonormal basis of columns (n, k), of their rank."""
    if not columns.size or not columns.any():
        return np.zeros((columns.shape[0], 0))
    left, values, _ = np.linalg.svd(columns / np.abs(columns).max(), full_matrices=False)
    return np.asarray(left[:, values > 1e-6 * values[0]])


def _node_motion(result: ModalResult, rows: Integers) -> tuple[Integers, Floats]:
    """Return nodes and their translations in each mode, (n_nodes, 3, n_modes)."""
    nodes, places = np.unique(result.modes.nodes[rows], return_inverse=True)
    motion = np.zeros((nodes.size, 3, result.modes.n_modes))
    motion[places, result.modes.components[rows] - 1] = result.modes.mode_shapes[rows].real
    return nodes, motion


def _best(
    result: ModalResult, pairs: Integers, motion: Floats, rest: Floats, basis: Floats
) -> tuple[int, float, float] | None:
    """Return the node, the mass and what remains of `rest` with the best fit; None without one."""
    slopes = -np.sum(motion[:, :, pairs] ** 2, axis=1)  # d ln lambda / d m, (n_nodes, n_pairs)
    slopes = slopes - (slopes @ basis) @ basis.T
    squares = np.maximum(np.sum(slopes**2, axis=1), 1e-300)
    first = slopes @ rest / squares
    order = np.argsort(-np.abs(slopes @ rest) / np.sqrt(squares))[:TRIED]
    found: tuple[int, float, float] | None = None
    for place in order.tolist():
        phi = motion[place]
        if not np.isfinite(first[place]) or first[place] == 0.0:
            continue

        def left(size: float, phi: Floats = phi, sign: float = np.sign(first[place])) -> float:
            change = _change(result, phi, sign * np.exp(size))
            if change is None:
                return 10.0 * float(np.linalg.norm(rest))
            own = change[pairs]
            return float(np.linalg.norm(rest - (own - basis @ (basis.T @ own))))

        middle = np.log(abs(first[place]))
        grid = middle + np.linspace(-3.0, 3.0, 25)
        values = [left(size) for size in grid]
        start = int(np.argmin(values))
        low, high = grid[max(start - 1, 0)], grid[min(start + 1, grid.size - 1)]
        fit = scipy.optimize.minimize_scalar(left, bounds=(low, high), method="bounded")
        if found is None or fit.fun < found[2]:
            found = place, float(np.sign(first[place]) * np.exp(fit.x)), float(fit.fun)
    return found


def _change(result: ModalResult, phi: Floats, mass: float) -> Floats | None:
    """Return the changes of ln lambda by a mass, (n_modes,); None where no mass is left."""
    inertia = np.eye(phi.shape[1]) + mass * phi.T @ phi
    if mass < 0.0 and np.linalg.eigvalsh(inertia)[0] <= 1e-3:
        return None
    eigenvalues = np.maximum(result.eigenvalues, 0.0)
    eigenvalues[: result.n_rigid] = 0.0
    values = eigh(np.diag(eigenvalues), inertia, eigvals_only=True)
    change = np.zeros(values.size)
    elastic = slice(result.n_rigid, None)
    change[elastic] = np.log(np.maximum(values[elastic], 1e-300) / eigenvalues[elastic])
    return change
