"""The changes that a model may lack, as they follow from its mesh, its deck and its sensors.

One kind of change has one prior: every amplitude between its bounds is equally probable on a
logarithmic scale, every place of the kind too.

| kind | between |
| --- | --- |
| point mass, masses of all sensors | 10^-4 and 0.3 of the model's mass |
| inertia | the same times the square of a tenth of the model's size |
| spring to the ground, spring between close nodes | 10^-3 and 10^3 of the place's own stiffness |
| support or rigid link that yields, by freedom | 10^-2 of the least and 10^4 of the median that the
                                                   rest resists there |
| absorber | 10^-3 and 0.2 of the mass; half the first and 1.5 times the last test frequency |
| quantity of a group | 1/5 and 5 times the deck's |
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial import cKDTree

from modetune.core.mesh import Mesh, cell_sizes, part_labels
from modetune.core.modes import Floats, Integers
from modetune.core.parameters import Parameter
from modetune.core.updating.candidates import AttachedModel, Term, spread_nodes
from modetune.flows.campaign.case import Case

Kind = Literal[
    "point mass", "inertia", "spring to ground", "rotational spring to ground", "spring",
    "rotational spring", "absorber", "sensor masses", "yielding support", "yielding link", "group",
]  # fmt: skip

#: Places of masses and of springs to the ground, of absorbers, and pairs of close nodes.
PLACES, ABSORBERS, PAIRS = 200, 30, 60
#: Bounds of masses, shares of the model's mass; of inertias, also of a tenth of its size squared.
MASSES, ABSORBER_MASSES, ARM = (1e-4, 0.3), (1e-3, 0.2), 0.1
#: Bounds of stiffnesses, shares of the place's own; of quantities of groups, of the deck's.
STIFFNESSES, FACTORS = (1e-3, 1e3), (0.2, 5.0)
#: Bounds of the stiffness of a support or link, by freedom, shares of the rest of the model's.
YIELDING = (1e-2, 1e4)
#: What the rest resists is nothing below this share of the most that it does anywhere.
NOTHING = 1e-9
#: Bounds of an absorber's frequency, shares of the first and last of the test.
AROUND = (0.5, 1.5)
AXES = ("", "x", "y", "z", "about x", "about y", "about z")


@dataclass(frozen=True, slots=True)
class LoadPlaces:
    """Where changes may be.

    loads: nodes and components (n_loads,) of unit forces, as positions of `Term.loads` mean them.
    nodes: of masses and springs to the ground. absorbers: nodes. pairs: (n_pairs, 2), close nodes
    that no element joins. sensors: nodes, of each case. components: which of 1..6 nodes have.
    """

    load_nodes: Integers
    load_components: Integers
    nodes: tuple[int, ...]
    absorbers: tuple[int, ...]
    pairs: tuple[tuple[int, int], ...]
    sensors: tuple[tuple[int, ...], ...]
    components: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class ReleasedGroup:
    """Freedoms of a support or link that yield together: columns of `Released.patterns`.

    component: of 1..6, 0 for all.
    """

    label: str
    support: bool
    nodes: tuple[int, ...]
    component: int
    columns: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class ModelChange:
    """One change of a model.

    nodes, component: the place; terms: what it adds to each case, nothing where the place is not.
    lower, upper: (n_amplitudes,). group: position of a group's quantity among those that are tried;
    quantity: that itself. constrained: whether the model as it is has an infinite amplitude of it.
    """

    kind: Kind
    label: str
    nodes: tuple[int, ...]
    component: int
    terms: tuple[tuple[Term, ...], ...]
    lower: Floats
    upper: Floats
    group: int = -1
    quantity: Parameter | None = None
    constrained: bool = False


def places_of(cases: Sequence[Case]) -> LoadPlaces:
    """Return the places of changes in the first case, and the sensors of all."""
    deck = cases[0].solver.deck
    components = tuple(sorted(deck.summary.components))
    mesh, fixed = deck.mesh(), deck.fixed()
    numbers = mesh.nodes
    coordinates = mesh.coordinates
    if not numbers.size:  # matrices have no geometry
        numbers = np.array(sorted(deck.summary.node_ids), dtype=np.int64)
        coordinates = np.stack([numbers.astype(np.float64)] + 2 * [np.zeros(numbers.size)], axis=1)
    held = {node for node, axes in fixed.items() if set(components) <= set(axes)}
    rows = np.flatnonzero(~np.isin(numbers, list(held)))
    numbers, coordinates = numbers[rows], coordinates[rows]
    sensors = tuple(
        tuple(n for n in sorted(set(case.sensors.model_nodes.tolist())) if n not in held)
        for case in cases
    )
    measured = {node for own in sensors for node in own}
    known = np.flatnonzero(np.isin(numbers, list(measured)))
    nothing = np.zeros(0, dtype=np.int64)
    known = known[spread_nodes(coordinates[known], nothing, PLACES // 2)]
    chosen = spread_nodes(coordinates, known, PLACES)
    few = chosen[spread_nodes(coordinates[chosen], nothing, ABSORBERS)]
    pairs = tuple(pair for pair in close_pairs(mesh) if not held & set(pair))[:PAIRS]
    nodes = tuple(numbers[chosen].tolist())
    every = sorted({*nodes, *measured, *(node for pair in pairs for node in pair)})
    return LoadPlaces(
        np.repeat(np.array(every, dtype=np.int64), len(components)),
        np.tile(np.array(components, dtype=np.int64), len(every)),
        nodes,
        tuple(numbers[few].tolist()),
        pairs,
        sensors,
        components,
    )


def close_pairs(mesh: Mesh) -> list[tuple[int, int]]:
    """Return pairs of nodes that no element joins, nearer than an element's size, nearest first."""
    sizes = cell_sizes(mesh)
    if not sizes or mesh.nodes.size < 2:
        return []
    reach = float(np.median(list(sizes.values())))
    tree = cKDTree(mesh.coordinates)
    near = tree.query_pairs(reach, output_type="ndarray")
    if not near.size:
        return []
    parts = part_labels(mesh, mesh.nodes)
    near = near[parts[near[:, 0]] != parts[near[:, 1]]]
    apart = np.linalg.norm(mesh.coordinates[near[:, 0]] - mesh.coordinates[near[:, 1]], axis=1)
    order = np.argsort(apart, kind="stable")
    return [(int(mesh.nodes[a]), int(mesh.nodes[b])) for a, b in near[order].tolist()]


def changes_of(
    cases: Sequence[Case],
    places: LoadPlaces,
    loaded: Sequence[AttachedModel],
    released: Sequence[Sequence[ReleasedGroup]],
    n_loads: Sequence[int],
    mass: float,
    groups: Sequence[Parameter],
) -> Iterator[ModelChange]:
    """Yield all changes of some cases.

    released: supports and links of each case that may yield, whose columns are loads behind the
    `n_loads` others. mass: of the model. groups: quantities behind the cases' own parameters.
    """
    mesh = cases[0].solver.deck.mesh()
    names = list(zip(places.load_nodes.tolist(), places.load_components.tolist(), strict=True))
    rows = [
        {name: place for place, name in enumerate(names) if moves[place]}
        for moves in (np.abs(each.at).max(axis=1, initial=0.0) > 0.0 for each in loaded)
    ]
    size = float(np.ptp(mesh.coordinates, axis=0).max()) if mesh.nodes.size else 1.0
    hz = np.concatenate([case.test.modes.frequencies_hz for case in cases])
    band = AROUND[0] * float(hz.min()), AROUND[1] * float(hz.max())
    yield from _masses(places, rows, mass, size)
    yield from _springs(places, rows, loaded)
    yield from _absorbers(places, rows, mass, band)
    yield from _yielding(released, n_loads, loaded)
    for number, item in enumerate(groups):
        bounds = np.array([FACTORS[0]]), np.array([FACTORS[1]])
        label = f"{item.quantity.replace('_', ' ')} of {', '.join(item.targets)}"
        yield ModelChange("group", label, (), 0, ((),) * len(cases), *bounds, number, item)


#: The load of each place that can move in a case.
Rows = dict[tuple[int, int], int]


def _masses(
    places: LoadPlaces, rows: Sequence[Rows], mass: float, size: float
) -> Iterator[ModelChange]:
    def at(
        kind: Kind, label: str, nodes: Sequence[tuple[int, ...]], axes: range, unit: float
    ) -> Iterator[ModelChange]:
        loads = [
            tuple(row[n, c] for n in own for c in axes if (n, c) in row)
            for own, row in zip(nodes, rows, strict=True)
        ]
        if any(loads):
            terms = tuple((Term("mass", 0, own, np.eye(len(own))),) if own else () for own in loads)
            lower, upper = (np.array([share * unit]) for share in MASSES)
            every = tuple(sorted({node for own in nodes for node in own}))
            yield ModelChange(kind, label, every, 0, terms, lower, upper)

    for node in places.nodes:
        here = [(node,)] * len(rows)
        yield from at("point mass", f"point mass at node {node}", here, range(1, 4), mass)
        if 4 in places.components:
            unit = mass * (ARM * size) ** 2
            yield from at("inertia", f"inertia at node {node}", here, range(4, 7), unit)
    most = max(len(own) for own in places.sensors)
    if most > 1:
        label, unit = "equal masses at all sensors", mass / most
        yield from at("sensor masses", label, places.sensors, range(1, 4), unit)


def _springs(
    places: LoadPlaces, rows: Sequence[Rows], loaded: Sequence[AttachedModel]
) -> Iterator[ModelChange]:
    def between(
        kind: Kind, label: str, nodes: tuple[int, ...], component: int
    ) -> Iterator[ModelChange]:
        weights = np.array([1.0, -1.0][: len(nodes)])
        terms, flexibility = list[tuple[Term, ...]](), 0.0
        for row, model in zip(rows, loaded, strict=True):
            loads = tuple(row[n, component] for n in nodes if (n, component) in row)
            whole = len(loads) == len(nodes)
            terms.append((Term("stiffness", 0, loads, weights[None]),) if whole else ())
            if whole:
                flexibility = max(flexibility, model.flexibility(loads, weights))
        if flexibility > 0.0:
            lower, upper = (np.array([share / flexibility]) for share in STIFFNESSES)
            yield ModelChange(kind, label, nodes, component, tuple(terms), lower, upper)

    for component in places.components:
        turning, axis = component > 3, AXES[component]
        kind: Kind = "rotational spring to ground" if turning else "spring to ground"
        for node in places.nodes:
            yield from between(kind, f"{kind} at node {node}, {axis}", (node,), component)
        kind = "rotational spring" if turning else "spring"
        for pair in places.pairs:
            label = f"{kind} between nodes {pair[0]} and {pair[1]}, {axis}"
            yield from between(kind, label, pair, component)


def _yielding(
    released: Sequence[Sequence[ReleasedGroup]],
    n_loads: Sequence[int],
    loaded: Sequence[AttachedModel],
) -> Iterator[ModelChange]:
    """Yield what may yield; of the same label in several cases it is the same thing."""
    known: dict[str, ModelChange] = {}
    for place, (groups, first, model) in enumerate(zip(released, n_loads, loaded, strict=True)):
        whole, own = model.whole, slice(model.size + first, None)
        energy = whole.base_stiffness[own, own] - whole.shift * whole.base_mass[own, own]
        resists = np.diag(energy)
        largest = {
            turning: max((float(resists[list(g.columns)].max()) for g in groups
                          if (g.component > 3) == turning), default=0.0)
            for turning in (False, True)
        }  # fmt: skip
        for group in groups:
            loads = tuple(first + column for column in group.columns)
            columns = np.array(group.columns)
            stiffness = float(np.median(resists[columns]))  # of the rest of the model
            if stiffness <= NOTHING * largest[group.component > 3]:
                continue  # the rest neither holds nor weighs anything there
            # Moved together, as a rigid body, the freedoms meet far less than each does alone.
            together = np.linalg.eigvalsh(energy[np.ix_(columns, columns)])
            least = max(float(together[0]), NOTHING * stiffness)
            lower, upper = np.array([YIELDING[0] * least]), np.array([YIELDING[1] * stiffness])
            kind: Kind = "yielding support" if group.support else "yielding link"
            change = known.get(group.label) or ModelChange(
                kind, f"{group.label} yields", group.nodes, group.component,
                ((),) * len(loaded), lower, upper, constrained=True,
            )  # fmt: skip
            terms = list(change.terms)
            terms[place] = (Term("stiffness", 0, loads, np.eye(len(loads))),)
            known[group.label] = replace(change, terms=tuple(terms))
    yield from known.values()


def _absorbers(
    places: LoadPlaces, rows: Sequence[Rows], mass: float, band: tuple[float, float]
) -> Iterator[ModelChange]:
    def terms(load: int | None) -> tuple[Term, ...]:
        if load is None:
            return ()
        own = Term("mass", 0, (), np.zeros((1, 0)), np.ones((1, 1)))
        return own, Term("stiffness", 1, (load,), np.ones((1, 1)), -np.ones((1, 1)))

    for node in places.absorbers:
        for component in range(1, 4):
            loads = [row.get((node, component)) for row in rows]
            if all(load is None for load in loads):
                continue
            masses = [share * mass for share in ABSORBER_MASSES]
            stiff = [m * (2.0 * np.pi * f) ** 2 for m, f in zip(masses, band, strict=True)]
            label = f"absorber at node {node}, {AXES[component]}"
            yield ModelChange(
                "absorber", label, (node,), component, tuple(map(terms, loads)),
                np.array([masses[0], stiff[0]]), np.array([masses[1], stiff[1]]),
            )  # fmt: skip
