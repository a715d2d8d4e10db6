"""Fields: a parameter an element or zone of a part, held together by their neighbourhood.

A test of some modes determines few combinations of hundreds of values, so a field solves a
regularised problem (Tikhonov and Arsenin 1977; for damage Titurus and Friswell 2008): with
x = theta - theta_0 the changes of its zones, s the deviation of one and G the differences between
neighbours,

    min |z - S x|^2_W + a x^T P x,

    neighbours        P = c (G^T G + I / l^2) / s^2      smooth: neighbours change alike
    total_variation   P = (G^T diag(1 / |G x|) G + I / l^2) / s     few edges: patches
    sparse            P = diag(1 / |x|) / s              few zones change

c is such that a zone has the variance s^2 on average where a is 1 (then P is the inverse covariance
of a Gauss-Markov field, Rue and Held 2005); l is the length in zones over which they go together.
The last two are the norms of length one, by weights that follow x from step to step (iteratively
reweighted least squares, Rodriguez and Wohlberg 2009): what each step brings down majorises them.

What the test cannot distinguish. One zone alone, changed by the c_j that fits best, leaves

    chi_j^2 = |d|^2_W - (S_j^T W d)^2 / (S_j^T W S_j),   d = z + S x,

of what the test says of the change from the start. Places that leave no more than `AS_WELL` above
the least are answers that the test cannot distinguish: zones that are joined are one place. A zone
whose change by its deviation moves the measured values by less than one standard deviation of the
test is not seen.

Zones. Seeds are taken one after the other, each farthest along the mesh from those before (Gonzalez
1985), and elements go to the nearest seed along the mesh (Dijkstra): so each zone is connected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components, dijkstra

from modetune.core.errors import ModelError
from modetune.core.mesh import CORNERS, DIMENSIONS, Mesh
from modetune.core.modes import Floats, Integers

Smoothing = Literal["neighbours", "total_variation", "sparse"]
#: Changes, in deviations, below which the weights of the norms of length one no longer grow.
LEAST_CHANGE = 1e-2
#: Two standard deviations: places within this of the least chi^2 are equally good answers.
AS_WELL = 4.0
#: Zones up to which a field is one dense problem a step.
MOST_ZONES = 2000
#: Number of places, and of zones of one, that are named.
NAMED = 6


@dataclass(frozen=True, slots=True)
class Field:
    """The zones of a field.

    columns: (n_zones,), positions of their parameters; neighbours: (n_pairs, 2), rows of columns;
    elements: (n_elements,), numbers in the deck, and owners: (n_elements,), the row of each one's
    zone; centres: (n_elements, 3), global axes. length: in zones.
    """

    name: str
    columns: Integers
    neighbours: Integers
    elements: Integers
    owners: Integers
    centres: Floats
    smoothing: Smoothing = "neighbours"
    length: float = 3.0

    def precision(self, changes: Floats, deviation: float) -> Floats:
        """P, (n_zones, n_zones), where the zones have changed so, (n_zones,)."""
        n, sizes = self.columns.size, changes / deviation
        if self.smoothing == "sparse":
            return np.diag(1.0 / np.maximum(np.abs(sizes), LEAST_CHANGE)) / deviation**2
        first, second = self.neighbours.T
        weights = np.ones(first.size)
        if self.smoothing == "total_variation":
            weights /= np.maximum(np.abs(sizes[first] - sizes[second]), LEAST_CHANGE)
        found = np.eye(n) / self.length**2
        np.add.at(found, (first, first), weights)
        np.add.at(found, (second, second), weights)
        np.add.at(found, (first, second), -weights)
        np.add.at(found, (second, first), -weights)
        if self.smoothing == "neighbours":
            found *= np.trace(np.linalg.inv(found)) / n
        return found / deviation**2


def prior_precision(fields: Sequence[Field], changes: Floats, deviations: Floats) -> Floats:
    """Weights of parameters in what steps bring down: (n,) without fields, else (n, n).

    changes: (n,), from their initial values; deviations: (n,), beforehand.
    """
    weights = deviations**-2
    if not fields:
        return np.asarray(weights)
    found = np.diag(weights)
    for item in fields:
        own = item.columns
        found[np.ix_(own, own)] = item.precision(changes[own], float(deviations[own[0]]))
    return found


@dataclass(frozen=True, slots=True)
class FieldAnswer:
    """What a test shows of a field, in addition to values and standard errors of its parameters.

    field: its zones; strengths: (n_zones,), standard deviations of the test by which a zone's
    change by its deviation is seen; alone: (n_zones,), chi^2 that is left where one zone changes
    alone, by changes (n_zones,); left: chi^2 that the field leaves; started: without any change.
    places: rows of the zones of each place that explains the test alone, the best first; empty
    where no zone does as well as noise allows. sentences: all this in words.
    """

    field: Field
    strengths: Floats
    alone: Floats
    changes: Floats
    left: float
    started: float
    places: tuple[Integers, ...]
    doubts: tuple[str, ...]
    sentences: tuple[str, ...]


def answer(
    field: Field,
    sensitivity: Floats,
    residual: Floats,
    weights: Floats,
    changes: Floats,
    deviations: Floats,
    names: Sequence[str],
    noise: float = 0.0,
    bounds: tuple[Floats, Floats] | None = None,
) -> FieldAnswer:
    """What a test says of a field.

    sensitivity: (n_residuals, n_parameters), residual, weights: (n_residuals,), where updating
    ended; changes, deviations: (n_parameters,); names: of the parameters; noise: chi^2
    that deviations explain; bounds: of changes from the start, (n_parameters,) each, as a zone
    alone changes no further.
    """
    own, root = field.columns, np.sqrt(weights)
    rows = root[:, None] * sensitivity[:, own]
    left = root * residual
    told = left + rows @ changes[own]
    squares = np.sum(rows**2, axis=0)
    strengths = np.sqrt(squares) * deviations[own]
    seen = strengths >= 1.0
    alone = np.where(squares > 0.0, (rows.T @ told) / np.where(squares > 0.0, squares, 1.0), 0.0)
    started = float(told @ told)
    if bounds is not None:
        alone = np.clip(alone, bounds[0][own], bounds[1][own])
    misfits = started - alone * (2.0 * (rows.T @ told) - alone * squares)
    places = _places(field, misfits, seen) if started > AS_WELL else ()
    named = [names[place] for place in own.tolist()]
    found = FieldAnswer(
        field, strengths, misfits, alone, float(left @ left), started, places, (), ()
    )
    return _told(found, named, changes[own], max(noise, AS_WELL))


def _places(field: Field, misfits: Floats, seen: NDArray[np.bool_]) -> tuple[Integers, ...]:
    """Zones that explain the test alone, as good as the best, in connected places."""
    if not seen.any():
        return ()
    least = float(misfits[seen].min())
    good = np.flatnonzero(seen & (misfits <= least + AS_WELL))
    n = field.columns.size
    inside = np.isin(field.neighbours, good).all(axis=1)
    first, second = field.neighbours[inside].T
    graph = sparse.coo_array((np.ones(first.size), (first, second)), shape=(n, n))
    _, labels = connected_components(graph, directed=False)
    found = [good[labels[good] == label] for label in np.unique(labels[good])]
    found = [place[np.argsort(misfits[place], kind="stable")] for place in found]
    return tuple(sorted(found, key=lambda place: float(misfits[place[0]])))


def _told(found: FieldAnswer, names: Sequence[str], changes: Floats, noise: float) -> FieldAnswer:
    """Return the answer with its sentences: what the test shows, and what it cannot distinguish."""
    name, n = found.field.name, len(names)
    unseen = np.flatnonzero(found.strengths < 1.0)
    doubts = []
    if unseen.size:
        doubts.append(
            f"{name}: {unseen.size} of {n} zones move no measured value by more than its "
            f"deviation ({_named(names, unseen)}): their values follow from their neighbours."
        )
    if found.started <= noise:
        doubts.append(
            f"{name}: the start explains the test as well as its deviations ask (chi-square "
            f"{found.started:.3g}, {noise:.3g} expected): where they are smaller, state it."
        )
    if found.started <= AS_WELL:
        return replace(found, doubts=tuple(doubts))
    if len(found.places) > 1:
        each = "; or ".join(_place(found, names, place) for place in found.places[:NAMED])
        more = len(found.places) - NAMED
        doubts.append(
            f"{name}: the test cannot distinguish {len(found.places)} places, each of which alone "
            f"explains it as well: {each}{f'; and {more} more' if more > 0 else ''}."
        )
    top = int(np.argmax(np.abs(changes)))
    texts = [f"{name}: the largest change is {names[top]} {100 * changes[top]:+.3g} %."]
    if found.places:
        best = found.places[0]
        share = 100 * (1.0 - float(found.alone[best[0]]) / found.started)
        whole = 100 * (1.0 - found.left / found.started)
        texts.append(
            f"{name}: one zone alone, {_place(found, names, best)}, explains {share:.1f} % of "
            f"what the test says of the change (the field {whole:.1f} %)."
        )
    return replace(found, doubts=tuple(doubts), sentences=tuple(texts))


def _place(found: FieldAnswer, names: Sequence[str], place: Integers) -> str:
    """Return the best zone of a place with its change, and the equally good ones."""
    first = int(place[0])
    beside = f" (or {_named(names, place[1:])})" if place.size > 1 else ""
    return f"{names[first]} by {100 * found.changes[first]:+.3g} %{beside}"


def _named(names: Sequence[str], rows: Integers) -> str:
    shown = [names[row] for row in rows[:NAMED].tolist()]
    more = rows.size - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")


def element_graph(mesh: Mesh, wanted: frozenset[int]) -> tuple[Integers, Floats, Integers]:
    """Elements of a mesh among the wanted: numbers (n,), centres (n, 3), neighbours (n_pairs, 2).

    Neighbours are rows of elements that share a face where both are solids, an edge where one is a
    shell, a corner where one is a line. Raises ModelError for elements whose nodes are not there.
    """
    numbers, centres, across, owners, corners = [], [], [], [], []
    count = 0
    for cells in mesh.cells:
        own = np.flatnonzero(np.isin(cells.elements, np.fromiter(wanted, np.int64, len(wanted))))
        rows = mesh.rows(cells.nodes[own, : CORNERS[cells.kind]])
        numbers.append(cells.elements[own])
        centres.append(mesh.coordinates[rows].mean(axis=1))
        kind = cells.kind.rstrip("0123456789")
        across.append(np.full(own.size, max(1, DIMENSIONS.get(kind, 3))))
        owners.append(np.repeat(np.arange(count, count + own.size), rows.shape[1]))
        corners.append(rows.ravel())
        count += own.size
    if not count:
        raise ModelError("none of its elements is in the mesh")
    at, node = np.concatenate(owners), np.concatenate(corners)
    incidence = sparse.csr_array((np.ones(at.size), (at, node)), shape=(count, mesh.nodes.size))
    shared = sparse.coo_array(sparse.triu(incidence @ incidence.T, k=1))
    dimensions = np.concatenate(across)
    needed = np.minimum(dimensions[shared.row], dimensions[shared.col])
    kept = shared.data >= needed
    pairs = np.stack([shared.row[kept], shared.col[kept]], axis=1).astype(np.int64)
    return np.concatenate(numbers), np.concatenate(centres), pairs


def zones_of(centres: Floats, neighbours: Integers, n_zones: int) -> Integers:
    """The zone of each element, (n_elements,), numbers from 0.

    Raises ModelError where there are fewer elements than zones, or more parts that are not joined.
    """
    n = len(centres)
    first, second = neighbours.T
    lengths = np.linalg.norm(centres[first] - centres[second], axis=1)
    lengths = np.maximum(lengths, 1e-12 * (float(lengths.max(initial=0.0)) or 1.0))
    graph = sparse.csr_array(sparse.coo_array((lengths, (first, second)), shape=(n, n)))
    parts, labels = connected_components(graph, directed=False)
    if not parts <= n_zones <= n:
        raise ModelError(
            f"{n_zones} zones of {n} elements in {parts} parts that are not joined; a zone is a "
            f"connected part, so {parts} to {n} are possible"
        )
    # One seed a part, then the element farthest from all seeds.
    seeds = [int(np.flatnonzero(labels == part)[0]) for part in range(parts)]
    while len(seeds) < n_zones:
        distances = dijkstra(graph, directed=False, indices=seeds, min_only=True)
        seeds.append(int(np.argmax(distances)))
    _, _, sources = dijkstra(
        graph, directed=False, indices=seeds, min_only=True, return_predecessors=True
    )
    return np.asarray(np.searchsorted(np.sort(seeds), sources))


def joined(neighbours: Integers, owners: Integers) -> Integers:
    """Pairs of zones that have neighbouring elements, (n_pairs, 2); owners: zone of each."""
    pairs = np.sort(owners[neighbours], axis=1)
    return np.asarray(np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0).reshape(-1, 2))
