"""How often the evidence chooses the right one of two models, on chains whose truth is known.

    python -m benchmarks.selection [--pairs 200] [--seed 1]

Each pair is two models of one chain of masses between walls: other springs or masses are uncertain
in each, or one model has a parameter more. One of them, drawn with equal chance, makes the test:
its parameters are drawn from their prior (uniform in the logarithm, within bounds that differ from
pair to pair, 5 % to a factor of 2), and frequencies and shapes get noise of their stated
deviations. Both models are then fitted, and weighed as `modetune compare` does. The expected ln
Bayes factor is that of the same test without noise. The last line is one JSON object. Exit code 1:
a claim is broken.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.linalg import eigh
from scipy.optimize import least_squares

from modetune.core.modes import Floats
from modetune.core.updating.evidence import log_evidence, probabilities

N, N_MODES = 7, 5
SENSORS = (0, 2, 3, 5)
FREQUENCY_DEVIATION, SHAPE_DEVIATION = 0.003, 0.03
DECIDED = 0.95
BINS = (
    (-np.inf, 1.0, "below 1"),
    (1.0, 3.0, "1 to 3"),
    (3.0, 5.0, "3 to 5"),
    (5.0, np.inf, "5 or more"),
)


@dataclass(frozen=True, slots=True)
class Chain:
    """A model and its parameters.

    chosen: which springs (0 to N) and masses (N + 1 onwards) are parameters; half: half of the
    prior's width in the logarithm.
    """

    springs: Floats
    masses: Floats
    chosen: tuple[int, ...]
    half: float

    def modes(self, x: Floats) -> tuple[Floats, Floats]:
        """Return frequencies and shapes at the sensors; x: logarithms of the parameters."""
        values = np.concatenate([self.springs, self.masses])
        values[list(self.chosen)] *= np.exp(x)
        k, m = values[: N + 1], values[N + 1 :]
        stiffness = np.diag(k[:-1] + k[1:]) - np.diag(k[1:-1], 1) - np.diag(k[1:-1], -1)
        lam, shapes = eigh(stiffness, np.diag(m), subset_by_index=(0, N_MODES - 1))
        return np.sqrt(lam), shapes[list(SENSORS)]


def residuals(model: Chain, x: Floats, frequencies: Floats, shapes: Floats) -> Floats:
    """Return measured minus computed in standard deviations."""
    hz, computed = model.modes(x)
    scales = np.sum(shapes * computed, axis=0) / np.sum(computed**2, axis=0)
    rms = np.sqrt(np.mean(shapes**2, axis=0))
    return np.concatenate(
        [
            (frequencies - hz) / frequencies / FREQUENCY_DEVIATION,
            ((shapes - computed * scales) / rms / SHAPE_DEVIATION).ravel(),
        ]
    )


def evidences(models: Sequence[Chain], frequencies: Floats, shapes: Floats) -> list[float]:
    """Return ln Z of each model at its minimum misfit within the bounds."""
    fits = []
    for model in models:
        n = len(model.chosen)
        starts = [np.zeros(n), np.full(n, 0.7 * model.half), np.full(n, -0.7 * model.half)]
        ends = [
            least_squares(
                partial(residuals, model),
                start,
                bounds=(-model.half, model.half),
                args=(frequencies, shapes),
            )
            for start in starts
        ]
        fits.append(min(ends, key=lambda end: float(end.cost)))
    freedom = N_MODES * len(SENSORS)  # frequencies, and shapes less their scales
    ratios = [
        2.0 * fit.cost / (freedom - len(model.chosen))
        for fit, model in zip(fits, models, strict=True)
    ]
    scale = max(1.0, min(ratios))
    found = []
    for fit, model in zip(fits, models, strict=True):
        n = len(model.chosen)
        box = np.column_stack([-model.half - fit.x, model.half - fit.x])
        widths = np.full(n, 2.0 * model.half)
        jacobian = np.asarray(fit.jac, dtype=np.float64)
        slope, hessian = jacobian.T @ fit.fun, jacobian.T @ jacobian
        found.append(log_evidence(2.0 * float(fit.cost), hessian, widths, scale, slope, box))
    return found


def one_pair(rng: np.random.Generator) -> tuple[float, float, float]:
    """Return the expected and the found ln Bayes factor of the true model, and its probability."""
    springs, masses = rng.uniform(800.0, 1200.0, N + 1), rng.uniform(0.8, 1.2, N)
    half = float(np.exp(rng.uniform(np.log(0.05), np.log(np.log(2.0)))))
    places = rng.permutation(2 * N + 1)
    first = tuple(places[: rng.integers(1, 3)].tolist())
    nested = rng.random() < 0.3
    second = (*first, int(places[3])) if nested else tuple(places[3 : 3 + len(first)].tolist())
    models = [Chain(springs, masses, chosen, half) for chosen in (first, second)]
    true = int(rng.integers(2))
    hz, shapes = models[true].modes(rng.uniform(-half, half, len(models[true].chosen)))
    exact = evidences(models, hz, shapes)
    rms = np.sqrt(np.mean(shapes**2, axis=0))
    noisy = shapes + SHAPE_DEVIATION * rms * rng.standard_normal(shapes.shape)
    measured = hz * (1.0 + FREQUENCY_DEVIATION * rng.standard_normal(N_MODES))
    found = evidences(models, measured, noisy)
    other = 1 - true
    return (
        exact[true] - exact[other],
        found[true] - found[other],
        float(probabilities(found)[true]),
    )


def table(pairs: Sequence[tuple[float, float, float]]) -> tuple[list[str], dict[str, float]]:
    """Return the rows of the table and the shares that are claimed."""
    expected, _, probability = (np.array(column) for column in zip(*pairs, strict=True))
    right, wrong = probability >= DECIDED, probability <= 1.0 - DECIDED
    kinds = {
        "right model more probable": probability > 0.5,
        "decided, right": right,
        "decided, wrong": wrong,
        "undecided": ~right & ~wrong,
    }
    rows = [f"| {' | '.join(['expected ln Bayes factor', 'pairs', *kinds])} |"]
    rows.append(f"|{' --- |' * (2 + len(kinds))}")
    for low, high, name in BINS:
        own = (expected >= low) & (expected < high)
        shares = [f"{100.0 * values[own].mean():.0f} %" for values in kinds.values() if own.any()]
        rows.append(f"| {' | '.join([name, str(own.sum()), *shares])} |")
    strong, weak, claims = expected >= 5.0, np.abs(expected) < 1.0, right | wrong
    return rows, {
        "pairs": float(len(pairs)),
        "strong": float(strong.sum()),
        "right_of_strong": float((probability > 0.5)[strong].mean()),
        "weak": float(weak.sum()),
        "undecided_of_weak": float((~claims)[weak].mean()),
        "claims": float(claims.sum()),
        "right_of_claims": float(right[claims].mean()),
    }


def main(arguments: list[str] | None = None) -> None:
    """Compare pairs of models and print the table."""
    parser = argparse.ArgumentParser(prog="benchmarks.selection", description=__doc__)
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args(arguments)
    rng = np.random.default_rng(chosen.seed)
    rows, shares = table([one_pair(rng) for _ in range(chosen.pairs)])
    sys.stdout.write("\n".join([*rows, json.dumps(shares)]) + "\n")
    kept = shares["right_of_strong"] >= 0.95 and shares["right_of_claims"] >= 0.9
    raise SystemExit(0 if kept else 1)


if __name__ == "__main__":
    main()
