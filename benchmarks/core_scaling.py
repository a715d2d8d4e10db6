"""How the time of core's work grows with the model.

Each case is run on solid-like models (a box of three unknowns a point, each point coupled to its 26
neighbours) from 10^3 to 10^5 unknowns; the exponent p of time ~ n^p is fitted over the sizes,
and the largest memory the process has held is given. Nelson's derivatives are those of 20 modes for
50 parameters, each the stiffness of a slab; pairing is of 200 noisy shapes with 200, in another
order. Sparse direct solution of boxes goes with
p = 2 at best in the limit (George 1973); below 10^5 the products with 300 masters weigh more.

    python benchmarks/core_scaling.py [--sizes 1000 100000] [--masters 300] [--cases guyan irs]

To time something else, write a function (Box) -> None and add it to CASES.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse import linalg

from modetune.core.algebra.factorisation import factorise
from modetune.core.condensation.expansion import kidder_expansion
from modetune.core.condensation.reduction import dynamic, guyan, irs, serep
from modetune.core.correlation.pairing import pair_by_shape
from modetune.core.modes import Floats, Integers, ModeSet, mode_set
from modetune.core.updating.sensitivity import nelson

N_MODES = 20
N_PARAMETERS = 50
N_PAIRED = 200


@dataclass(frozen=True, slots=True)
class Box:
    """stiffness, mass (n, n); masters (n_masters,); frequencies_hz, mode_shapes of 20 modes;
    changes: dK, dM of 50 parameters; measured, computed: 200 modes each at all n unknowns."""

    stiffness: sparse.csr_array
    mass: sparse.csr_array
    masters: Integers
    frequencies_hz: Floats
    mode_shapes: Floats
    changes: list[tuple[sparse.csr_array, sparse.csr_array]]
    measured: ModeSet
    computed: ModeSet


def box(n_unknowns: int, n_masters: int) -> Box:
    """A box of about that many unknowns, held on all faces, with its lowest modes."""
    side = max(3, round((n_unknowns / 3.0) ** (1.0 / 3.0)))
    ones = np.ones(side - 1)
    line: Any = 2.0 * np.eye(side) - np.diag(ones, 1) - np.diag(ones, -1)
    spread: Any = (4.0 * np.eye(side) + np.diag(ones, 1) + np.diag(ones, -1)) / 6.0
    mixing: Any = np.array([[2.0, 0.5, 0.1], [0.5, 3.0, 0.2], [0.1, 0.2, 1.0]])
    stiffness = sparse.csr_array((side**3 * 3,) * 2)
    for weight, factors in (
        (1.0, (line, spread, spread)),
        (1.3, (spread, line, spread)),
        (0.7, (spread, spread, line)),
    ):
        x, y, z = map(sparse.csr_array, factors)
        grid: Any = weight * sparse.kron(sparse.kron(x, y), z)
        stiffness = sparse.csr_array(stiffness + sparse.kron(grid, mixing))
    n = stiffness.shape[0]
    mass = sparse.csr_array(sparse.diags_array(1.0 + (np.arange(n) // 3) % 3 / 10.0))
    masters = np.unique(np.linspace(0, n - 1, min(n_masters, n // 4)).astype(np.int64))
    inverse = linalg.LinearOperator((n, n), matvec=factorise(stiffness).solve, dtype=np.float64)
    start = np.random.default_rng(1).standard_normal(n)
    eigenvalues, shapes = linalg.eigsh(
        stiffness, k=N_MODES, M=mass, sigma=0.0, OPinv=inverse, v0=start
    )
    frequencies_hz = np.sqrt(eigenvalues) / (2.0 * np.pi)
    return Box(stiffness, mass, masters, frequencies_hz, shapes, slabs(stiffness), *mode_pair(n))


def slabs(stiffness: sparse.csr_array) -> list[tuple[sparse.csr_array, sparse.csr_array]]:
    """Return the stiffness of 50 slabs, each alone, without mass."""
    n = stiffness.shape[0]
    nothing, slab = sparse.csr_array((n, n)), np.arange(n) * N_PARAMETERS // n
    found = []
    for number in range(N_PARAMETERS):
        inside = sparse.diags_array((slab == number).astype(np.float64))
        found.append((sparse.csr_array(inside @ stiffness @ inside), nothing))
    return found


def mode_pair(n: int) -> tuple[ModeSet, ModeSet]:
    """200 shapes of n unknowns, and the same with noise in another order."""
    rng = np.random.default_rng(2)
    shapes, order = rng.standard_normal((n, N_PAIRED)), rng.permutation(N_PAIRED)
    noisy = shapes + 0.1 * rng.standard_normal(shapes.shape)
    hz = np.arange(1.0, N_PAIRED + 1.0)
    nodes, components = np.arange(n) // 3 + 1, np.arange(n) % 3 + 1
    return (
        mode_set(hz, noisy, nodes, components),
        mode_set(hz[order], shapes[:, order], nodes, components),
    )


def run_guyan(model: Box) -> None:
    guyan(model.stiffness, model.mass, model.masters)


def run_irs(model: Box) -> None:
    irs(model.stiffness, model.mass, model.masters)


def run_serep(model: Box) -> None:
    serep(model.stiffness, model.mass, model.masters, model.mode_shapes)


def run_dynamic(model: Box) -> None:
    dynamic(model.stiffness, model.mass, model.masters, float(model.frequencies_hz[0]))


def run_kidder(model: Box) -> None:
    shapes = model.mode_shapes[model.masters][:, :3]
    kidder_expansion(model.stiffness, model.mass, model.frequencies_hz[:3], shapes, model.masters)


def run_nelson(model: Box) -> None:
    eigenvalues = (2.0 * np.pi * model.frequencies_hz) ** 2
    nelson(
        model.stiffness,
        model.mass,
        eigenvalues,
        model.mode_shapes,
        model.changes,
        list(range(N_MODES)),
        model.masters,
    )


def run_pairing(model: Box) -> None:
    pair_by_shape(model.measured, model.computed)


CASES: tuple[Callable[[Box], None], ...] = (
    run_guyan,
    run_irs,
    run_dynamic,
    run_serep,
    run_kidder,
    run_nelson,
    run_pairing,
)


def exponent(sizes: list[int], seconds: list[float]) -> float:
    """p of seconds ~ sizes^p by least squares of the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def main() -> None:
    options = argparse.ArgumentParser(description="Growth of core's run time with model size")
    options.add_argument("--sizes", type=int, nargs="+", default=[1000, 3000, 10000, 30000, 100000])
    options.add_argument("--masters", type=int, default=300)
    names = [case.__name__.removeprefix("run_") for case in CASES]
    options.add_argument("--cases", nargs="+", choices=names, default=names)
    chosen = options.parse_args()
    models = [box(size, chosen.masters) for size in chosen.sizes]
    sizes = [model.stiffness.shape[0] for model in models]
    out = sys.stdout.write
    out(f"{'unknowns':<14}" + "".join(f"{size:>12}" for size in sizes) + f"{'exponent':>12}\n")
    for case in [case for case in CASES if case.__name__[4:] in chosen.cases]:
        seconds = []
        for model in models:
            start = time.perf_counter()
            case(model)
            seconds.append(time.perf_counter() - start)
        times = "".join(f"{value:>10.3f} s" for value in seconds)
        out(f"{case.__name__.removeprefix('run_'):<14}{times}{exponent(sizes, seconds):>12.2f}\n")
    # ru_maxrss is in KiB on Linux.
    out(f"largest memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2:.2f} GiB\n")


if __name__ == "__main__":
    main()
