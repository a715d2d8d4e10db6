"""Clusters: modes so close that only their common space is known, of the model or of the test.

Modes of one eigenvalue have no unique shapes, and those of close ones rotate within their space at
the smallest change of the structure. A solver gives one rotation of them, a test another.
What does not depend on it is compared:

* frequencies. Where the test cannot split them (they are closer than they were measured), in
  ascending order, which is the mean and the spread of two. Where it can, but the model cannot, the
  model's shapes Phi are turned on to the test's, Psi = Phi R with R orthogonal (Procrustes,
  Schoenemann 1966), and the Rayleigh quotients psi^T K psi are compared, the diagonal of the
  space's eigenvalue matrix, whose derivative is psi^T (K' - lambda M') psi (Ojalvo 1988, Dailey
  1989);
* shapes: what the model's have outside of the space of the test's, and derivatives of that. A
  change within the space counts for nothing.

A mode alone is a cluster of one, and can be turned the other way round only.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from modetune.core.correlation.pairing import FINE, UNSEEN, Pairing
from modetune.core.modes import (
    CLOSE,
    REPEATED,
    Floats,
    Integers,
    ModeSet,
    close_labels,
    close_sets,
    common_dofs,
)


def rotation_onto(shapes: Floats, wanted: Floats, frequencies_hz: Floats) -> Floats:
    """The rotation R (n_modes, n_modes) with which shapes @ R lie as the wanted ones.

    shapes, wanted: (n_dof, n_modes), mass-normalised modes of one model at the same degrees of
    freedom, in the same order except within a cluster; frequencies_hz: (n_modes,).
    Only close modes are mixed.
    """
    rotation = np.zeros((frequencies_hz.size, frequencies_hz.size))
    for members in close_sets(frequencies_hz, CLOSE):
        inner = shapes[:, members].T @ wanted[:, members]
        left, _, right = np.linalg.svd(inner)
        rotation[np.ix_(members, members)] = left @ right
    return rotation


def rotation_to_test(
    measured: ModeSet, computed: ModeSet, pairing: Pairing, resolution: float | Floats
) -> Floats | None:
    """The rotation of close computed modes that brings them to the test's shapes.

    resolution: relative distance of frequencies that the test can split, of all or (n_modes,) of
    the measured ones. Measured shapes may have
    any scale, and be of some of the members only; the others are what is left of the space. None
    if there is nothing to rotate: no paired mode is close to another one, the test cannot split
    them either, or the sensors cannot determine the rotation.
    """
    several = [item for item in close_sets(computed.frequencies_hz, CLOSE) if item.size > 1]
    if not several:
        return None
    rows_m, rows_c = common_dofs(measured, computed)
    if not rows_m.size:
        return None
    alike = close_labels(measured.frequencies_hz, resolution)
    one = close_labels(measured.frequencies_hz, FINE * resolution)
    rotation = np.eye(computed.n_modes)
    turned = False
    for members in several:
        pairs = np.flatnonzero(np.isin(pairing.computed, members))
        if not pairs.size:
            continue
        # What the model does not split at all may lie as the test's at no cost.
        repeated = len(close_sets(computed.frequencies_hz[members], 0.5 * REPEATED)) == 1
        unsplit = (one if repeated else alike)[pairing.measured[pairs]]
        if np.unique(unsplit).size == 1 and pairs.size == members.size:
            continue
        basis = np.real(computed.mode_shapes[rows_c][:, members])
        wanted = np.real(measured.mode_shapes[rows_m][:, pairing.measured[pairs]])
        own = _orthonormal(np.linalg.lstsq(basis, wanted, rcond=UNSEEN)[0])
        if own is None:
            continue
        places = np.searchsorted(members, pairing.computed[pairs])
        others = np.setdiff1d(np.arange(members.size), places)
        block = np.zeros((members.size, members.size))
        block[:, places] = own
        if others.size:
            block[:, others] = np.linalg.svd(own)[0][:, pairs.size :]
        rotation[np.ix_(members, members)] = block
        turned = True
    return rotation if turned else None


def paired_clusters(
    measured: ModeSet, computed: ModeSet, pairing: Pairing, resolution: float | Floats
) -> list[Integers]:
    """Positions of the pairs of each cluster: close on the model's side, or not split by the test.

    Each pair is in one cluster, mostly alone; clusters are in the order of their first pairs.
    """
    sides = (
        close_labels(measured.frequencies_hz, resolution)[pairing.measured],
        close_labels(computed.frequencies_hz, CLOSE)[pairing.computed],
    )
    n_pairs = pairing.measured.size
    if all(len(set(side.tolist())) == n_pairs for side in sides):  # each pair is alone
        return list(np.arange(n_pairs)[:, None])
    first, second = np.nonzero((sides[0][:, None] == sides[0]) | (sides[1][:, None] == sides[1]))
    joined = coo_array((np.ones(first.size), (first, second)), shape=(n_pairs, n_pairs))
    _, labels = connected_components(joined, directed=False)
    return [np.flatnonzero(labels == label) for label in dict.fromkeys(labels.tolist())]


def with_neighbours(frequencies_hz: Floats, modes: Integers) -> Integers:
    """Positions of these modes of a model and of all that are close to them."""
    labels = close_labels(frequencies_hz, CLOSE)
    return np.flatnonzero((labels[:, None] == labels[modes]).any(axis=1))


def _orthonormal(columns: Floats) -> Floats | None:
    """The orthonormal columns closest to these, each first brought to length 1; None where they
    lie in fewer directions than they are."""
    lengths = np.linalg.norm(columns, axis=0)
    if not lengths.all():
        return None
    left, values, right = np.linalg.svd(columns / lengths, full_matrices=False)
    return np.asarray(left @ right) if values[-1] > UNSEEN * values[0] else None
