"""Degrees of freedom as sums over the equations of stored matrices.

A solver's equations are not always displacements of nodes: expanded shells and beams have several
for one, dependent nodes have none. With W the matrix of an observation and phi a shape on the
equations, the shape at the wanted degrees of freedom is W phi, and so for its derivatives, W being
constant.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from modetune.core.algebra.matrices import MatrixResult
from modetune.core.measurement.sensor_map import SensorMap
from modetune.core.modes import Integers

Weights = dict[int, float]


@dataclass(frozen=True, slots=True)
class Observation:
    """What wanted degrees of freedom are in terms of equations.

    matrix: (n_wanted, n_equations), CSR; a row is empty where the degree of freedom is held in
    place (its shapes are zero) or unknown. unknown: (n_wanted,), those that the matrices do not
    give: dependent in a way that is not followed, or of an unknown kind.
    """

    matrix: sparse.csr_array
    unknown: NDArray[np.bool_]

    @property
    def held(self) -> NDArray[np.bool_]:
        """(n_wanted,), those that cannot move."""
        return np.asarray((np.diff(self.matrix.indptr) == 0) & ~self.unknown)

    def turned(self, turn: sparse.csr_array) -> Observation:
        """Other degrees of freedom that are sums of these: turn is (n_others, n_wanted)."""
        unknown = np.asarray(abs(turn) @ self.unknown.astype(np.float64) > 0.0)
        keep = sparse.diags_array((~unknown).astype(np.float64))
        matrix = sparse.csr_array(keep @ turn @ self.matrix)
        matrix.eliminate_zeros()
        return Observation(matrix, unknown)


def from_rows(rows: list[Weights | None], n_equations: int) -> Observation:
    """An observation from the weights of each wanted degree of freedom, None where unknown."""
    unknown = np.array([row is None for row in rows], dtype=np.bool_)
    known = [row or {} for row in rows]
    counts = np.array([len(row) for row in known], dtype=np.int64)
    columns = np.array([place for row in known for place in row], dtype=np.int64)
    values = np.array([value for row in known for value in row.values()])
    starts = np.concatenate([[0], np.cumsum(counts)])
    matrix = sparse.csr_array((values, columns, starts), shape=(len(rows), n_equations))
    matrix.sort_indices()
    return Observation(matrix, unknown)


def observe(
    matrices: MatrixResult, wanted_nodes: Integers, wanted_components: Integers
) -> Observation:
    """Return an observation of names, each an equation or dependent on some.

    What has neither is held in place. wanted_nodes, wanted_components: (n_wanted,).
    """
    rows = named_rows(matrices.nodes, matrices.components, wanted_nodes)
    size, dependent = matrices.nodes.size, matrices.dependent
    whole = sparse.csr_array(sparse.eye_array(size))
    if dependent is not None:
        ties = named_rows(dependent.nodes, dependent.components, wanted_nodes)
        rows |= {dof: [size + row for row in found] for dof, found in ties.items()}
        whole = sparse.csr_array(sparse.vstack([whole, dependent.matrix]))
    wanted = zip(wanted_nodes.tolist(), wanted_components.tolist(), strict=True)
    found: list[Weights | None] = [dict.fromkeys(rows.get(dof, ())[:1], 1.0) for dof in wanted]
    chosen = from_rows(found, whole.shape[0])
    return Observation(sparse.csr_array(chosen.matrix @ whole), chosen.unknown)


def named_rows(
    nodes: Integers, components: Integers, wanted_nodes: Integers
) -> dict[tuple[int, int], list[int]]:
    """Equations of each name at these nodes, ascending."""
    found: dict[tuple[int, int], list[int]] = {}
    for row in np.flatnonzero(np.isin(nodes, wanted_nodes)).tolist():
        found.setdefault((int(nodes[row]), int(components[row])), []).append(row)
    return found


def nothing_known(n_wanted: int, n_equations: int) -> Observation:
    """Return an observation of unknown rows."""
    return from_rows([None] * n_wanted, n_equations)


def sensor_observation(
    sensors: SensorMap, observation: Callable[[Integers, Integers], Observation]
) -> Observation:
    """What a test's sensors see. observation: of motions of nodes, by numbers and components."""
    nodes, components = sensors.seen_components()
    return observation(nodes, components).turned(sensors.matrix(nodes, components))
