"""Changes found in series of nights with known truth, false alarms, and the ideal detector.

    python -m benchmarks.nights [--nights 20000] [--series 200] [--harsh 2000] [--seed 0]

A chain of five masses and springs of unequal sizes is tested every night: five frequencies and
shapes at all masses. The stiffnesses of a night scatter by the covariance of repeatability of that
eigenvalue problem, by its sensitivities, scaled to 1.0 % each. Temperature moves over 20 K, drawn
every night or as a season with weather; each stiffness has a slope of -0.1 or -0.4 %/K. The noise
is white, or AR(1) with 0.8 from night to night. The first 30 nights are learned from; then

* steps: one stiffness drops by 5 %. Counted are the series in which it is found within two nights,
  and those in which that spring alone is named;
* drifts: one stiffness moves by 0.1 errors per night. Counted are those found within 45 nights;
* false alarms: nothing changes for 100 nights. A series ends with its first alarm.

Two ideal detectors show what a drift of that size allows. Both know the law of the noise, its
correlation and covariance, slopes, the first night of the drift, and that one spring drifts, but
not which nor its sign. The first knows the reference; the second learns it from the same 30 nights.
Each is the sharpest linear test per spring, with its limit simulated so that 1 night in 1,000
alarms. Harsher noises, for which no target was set, are AR(1) with 0.95, white and slow halves, one
spring with slow scatter of its own, Student's t with 4 degrees of freedom, and three times the
stated scatter.

The last row has stiffnesses that are updated every night to noisy frequencies and shapes by
modetune's steps, with the covariance of each update.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import eigh

from modetune.core.modes import Floats
from modetune.core.monitoring.drift import Drift, find_drift
from modetune.core.monitoring.series import Series
from modetune.core.updating.parameter_steps import (
    StepProblem,
    parameter_covariance,
    parameter_step,
)

Generator = np.random.Generator
LEARNING, WATCHED, DRIFTING = 30, 100, 45
#: Step and drift per night of one stiffness; slopes per K; swing of the temperature in K.
STEP, DRIFT, SLOPES, SWING = -0.05, 0.001, (-0.001, -0.004), 20.0
ERROR = 0.01
#: Deviations of frequencies and of shapes (root mean square 1) in a test, to be scaled.
FREQUENCY, SHAPE = 0.002, 0.01
DAY = 86400.0


@dataclass(frozen=True, slots=True)
class Structure:
    """A structure of matrices: K = sum of parts (p, n, n) times relative stiffnesses; M.

    n_modes: modes that the test has, with all components of their shapes.
    """

    parts: Floats
    mass: Floats
    n_modes: int

    def modes(self, values: Floats) -> tuple[Floats, Floats]:
        """Eigenvalues (n_modes,) and shapes (n, n_modes) of unit root mean square, with a sign that
        does not change along with small changes of the stiffnesses."""
        stiffness = np.tensordot(values, self.parts, 1)
        eigenvalues, shapes = eigh(stiffness, self.mass, subset_by_index=(0, self.n_modes - 1))
        signs = np.sign(np.sqrt(np.arange(1.0, len(shapes) + 1.0)) @ shapes)
        return eigenvalues, shapes * signs / np.sqrt(np.mean(shapes**2, axis=0))

    def responses(self, values: Floats) -> Floats:
        """Frequencies, relative, and shapes, each in its deviation."""
        eigenvalues, shapes = self.modes(values)
        return np.concatenate([np.log(eigenvalues) / 2.0 / FREQUENCY, shapes.ravel() / SHAPE])

    def sensitivity(self, values: Floats) -> Floats:
        """Of the responses to the stiffnesses, (n_responses, n), by central differences."""
        h = 1e-5
        return np.array(
            [
                (self.responses(values + h * one) - self.responses(values - h * one)) / (2.0 * h)
                for one in np.eye(values.size)
            ]
        ).T


def chain() -> Structure:
    """Return five masses in a row, with springs to the ground and to each other."""
    springs = np.array([1.0, 1.4, 0.8, 1.1, 0.6])
    ends = np.eye(5) - np.eye(5, k=-1)
    parts = np.array([k * np.outer(end, end) for k, end in zip(springs, ends, strict=True)])
    return Structure(parts, np.diag([1.0, 0.7, 1.3, 0.9, 0.5]), 5)


def repeatability(structure: Structure) -> Floats:
    """The covariance of one night's stiffnesses, scaled to 1.0 % each."""
    sensitivity = structure.sensitivity(np.ones(len(structure.parts)))
    covariance = np.linalg.inv(sensitivity.T @ sensitivity)
    errors = np.sqrt(np.diag(covariance))
    return np.asarray(ERROR**2 * covariance / np.outer(errors, errors))


def ar1(rng: Generator, n: int, size: int, correlation: float) -> Floats:
    """Stationary AR(1) series of variance 1, (n, size)."""
    noise = rng.standard_normal((n, size))
    for night in range(1, n):
        fresh = np.sqrt(1.0 - correlation**2) * noise[night]
        noise[night] = correlation * noise[night - 1] + fresh
    return noise


Noise = Callable[[Generator, int, Floats], Floats]


def correlated(correlation: float, scale: float = 1.0) -> Noise:
    """Noise by the covariance with that root (p, p), as an AR(1) series."""

    def draw(rng: Generator, n: int, root: Floats) -> Floats:
        return np.asarray(scale * ar1(rng, n, len(root), correlation) @ root.T)

    return draw


def white_and_slow(rng: Generator, n: int, root: Floats) -> Floats:
    """Half of the variance white, half AR(1) with 0.95."""
    both = ar1(rng, n, len(root), 0.0) + ar1(rng, n, len(root), 0.95)
    return np.asarray(both @ root.T / np.sqrt(2.0))


def one_slow(rng: Generator, n: int, root: Floats) -> Floats:
    """White, and the first parameter has twice its error as AR(1) with 0.95 in addition."""
    noise = ar1(rng, n, len(root), 0.0) @ root.T
    noise[:, 0] += 2.0 * np.linalg.norm(root[0]) * ar1(rng, n, 1, 0.95)[:, 0]
    return noise


def heavy(rng: Generator, n: int, root: Floats) -> Floats:
    """Student's t with 4 degrees of freedom, of the same variance."""
    return np.asarray(rng.standard_t(4, (n, len(root))) @ root.T / np.sqrt(2.0))


NOISES = {"white": correlated(0.0), "AR(1) 0.8": correlated(0.8)}
HARSH = {
    "AR(1) 0.95": correlated(0.95),
    "half white, half AR(1) 0.95": white_and_slow,
    "one spring with slow scatter": one_slow,
    "Student's t, 4 degrees": heavy,
    "three times the stated scatter": correlated(0.5, 3.0),
}


def temperatures(rng: Generator, n: int, season: bool) -> Floats:
    """Temperatures of n nights, within the swing."""
    if not season:
        return rng.uniform(0.0, SWING, n)
    phase = 2.0 * np.pi * (np.arange(n) / 365.0 + rng.uniform())
    seasonal = 0.35 * SWING * np.sin(phase) + rng.normal(0.0, 3.0, n)
    return np.asarray(np.clip(seasonal, -0.5 * SWING, 0.5 * SWING))


def series_of(values: Floats, covariance: Floats, temperature: Floats) -> Series:
    """Nights with one covariance."""
    n, p = values.shape
    return Series(
        DAY * np.arange(n),
        tuple(f"k_{place + 1}" for place in range(p)),
        1.0 + values,
        np.tile(covariance, (n, 1, 1)),
        temperature[:, None],
        ("temperature",),
    )


def nights(rng: Generator, n: int, covariance: Floats, noise: Noise, season: bool) -> Series:
    """Nights without a change."""
    temperature = temperatures(rng, n, season)
    slopes = rng.choice(SLOPES, len(covariance))
    scatter = noise(rng, n, np.linalg.cholesky(covariance))
    return series_of(scatter + np.outer(temperature, slopes), covariance, temperature)


def with_change(series: Series, place: int, change: Floats) -> Series:
    """The nights up to the end of a change of one parameter, which starts after learning."""
    n = LEARNING + change.size
    values = series.values[:n].copy()
    values[LEARNING:, place] += change
    return replace(
        series,
        times=series.times[:n],
        values=values,
        covariances=series.covariances[:n],
        environment=series.environment[:n],
    )


def first_alarm(drift: Drift) -> int | None:
    """Number of nights after learning until the first alarm."""
    found = np.flatnonzero(drift.changed_runs[LEARNING:])
    return int(found[0]) + 1 if found.size else None


@dataclass(frozen=True, slots=True)
class Counts:
    """Of series: steps found within two nights and named alone, drifts found with the median
    night; of nights without a change: how many, false alarms and nights left out."""

    series: int = 0
    steps: int = 0
    named: int = 0
    drifts: int = 0
    drift_night: float = np.nan
    nights: int = 0
    alarms: int = 0
    left_out: int = 0


def count_changes(rng: Generator, covariance: Floats, noise: Noise, season: bool, n: int) -> Counts:
    """Steps and drifts found in n series."""
    steps = named = 0
    found_after = []
    p = len(covariance)
    for _ in range(n):
        steady = nights(rng, LEARNING + DRIFTING, covariance, noise, season)
        place, sign = int(rng.integers(p)), float(rng.choice([-1.0, 1.0]))
        step = find_drift(with_change(steady, place, np.full(2, STEP)))
        steps += first_alarm(step) is not None
        names = [change.name for change in step.changes if change.changed]
        named += names == [f"k_{place + 1}"]
        ramp = sign * DRIFT * np.arange(1, DRIFTING + 1)
        after = first_alarm(find_drift(with_change(steady, place, ramp)))
        found_after.append(np.inf if after is None else after)
    return Counts(
        n, steps, named, int(np.isfinite(found_after).sum()), float(np.median(found_after))
    )


def count_alarms(rng: Generator, covariance: Floats, noise: Noise, season: bool, n: int) -> Counts:
    """False alarms in n nights. A series ends with its first alarm."""
    watched = alarms = left_out = 0
    while watched < n:
        drift = find_drift(nights(rng, LEARNING + WATCHED, covariance, noise, season))
        after = first_alarm(drift)
        alarms += after is not None
        watched += WATCHED if after is None else after
        left_out += len(drift.left_out)
    return Counts(nights=watched, alarms=alarms, left_out=left_out)


def ideal_share(
    rng: Generator, covariance: Floats, correlation: float, reference: bool, n: int = 4000
) -> float:
    """The share of drifts that an ideal detector finds within 45 nights.

    reference: it knows the reference, rather than learning it from 30 nights. On each night it has,
    per spring, the sum of all whitened nights, weighed by the drift as the reference leaves it, in
    its error. The limit is that of 1 in 1,000 nights without a drift.
    """
    total, p = LEARNING + DRIFTING, len(covariance)
    lags = np.abs(np.subtract.outer(np.arange(total), np.arange(total)))
    whitening = np.linalg.inv(
        np.linalg.cholesky(np.where(lags == 0, 1.0, float(correlation) ** lags))
    )
    root = np.linalg.cholesky(covariance)
    directions = np.linalg.inv(root)
    lengths = np.linalg.norm(directions, axis=0)
    directions = directions / lengths
    ramp = np.concatenate([np.zeros(LEARNING), np.arange(1.0, DRIFTING + 1.0)])
    weights = np.zeros((DRIFTING, total))
    for night in range(DRIFTING):
        seen = LEARNING + night + 1
        shape, one = whitening[:seen, :seen] @ ramp[:seen], whitening[:seen, :seen].sum(axis=1)
        if not reference:
            shape = shape - one * (one @ shape) / (one @ one)
        weights[night, :seen] = shape / np.linalg.norm(shape)

    def statistics(drifting: bool, count: int) -> Floats:
        """The largest statistic of any spring, (count, nights)."""
        found = np.zeros((count, DRIFTING))
        for place in range(count):
            white = rng.standard_normal((total, p))
            if drifting:
                spring = int(rng.integers(p))
                change = DRIFT * lengths[spring] * directions[:, spring]
                white = white + np.outer(whitening @ ramp, change)
            found[place] = np.abs(weights @ white @ directions).max(axis=1)
        return found

    limit = np.quantile(statistics(False, n), 0.999)
    return float((statistics(True, n) > limit).any(axis=1).mean())


def updated_nights(
    rng: Generator, structure: Structure, n: int, change: Floats, slopes: Floats
) -> Series:
    """Nights whose stiffnesses come from updates to noisy frequencies and shapes.

    change: (n, p), of the true stiffnesses; slopes: (p,), per K. Each night starts from the deck's
    values and takes weighted least-squares steps until they are rounding.
    """
    p = slopes.size
    bound = np.full(p, 0.2)
    sensitivity = structure.sensitivity(np.ones(p))
    ones = np.ones(len(sensitivity))
    scale = ERROR / np.sqrt(np.mean(np.diag(parameter_covariance(sensitivity, ones, ones))))
    temperature = temperatures(rng, n, False)
    values, covariances = np.zeros((n, p)), np.zeros((n, p, p))
    for night in range(n):
        truth = 1.0 + change[night] + temperature[night] * slopes
        measured = structure.responses(truth) + scale * rng.standard_normal(ones.size)
        found = np.ones(p)
        for _ in range(20):
            sensitivity = structure.sensitivity(found)
            residual = measured - structure.responses(found)
            problem = StepProblem(
                sensitivity, residual, ones, np.ones(p), found - 1.0, -bound, bound
            )
            step = parameter_step(problem, "weighted_least_squares").change
            found = found + step
            if np.abs(step).max() < 1e-7:  # a hundred-thousandth of a night's error
                break
        values[night] = found - 1.0
        covariances[night] = parameter_covariance(sensitivity, scale**2 * ones, ones)
    series = series_of(values, covariances[0], temperature)
    return replace(series, covariances=covariances)


def count_updates(rng: Generator, n: int) -> Counts:
    """Steps of 5 % found in n series of real updates, and alarms on nights without a change."""
    structure, p = chain(), len(chain().parts)
    steps = named = alarms = watched = 0
    for _ in range(n):
        change = np.zeros((LEARNING + 30, p))
        place = int(rng.integers(p))
        change[-2:, place] = STEP
        series = updated_nights(rng, structure, len(change), change, rng.choice(SLOPES, p))
        drift = find_drift(series)
        after = first_alarm(drift)
        false = after is not None and after <= 28
        alarms += false
        watched += after if after is not None and false else 28
        steps += after is not None and not false
        named += [item.name for item in drift.changes if item.changed] == [f"k_{place + 1}"]
    return Counts(n, steps, named, nights=watched, alarms=alarms)


def main(arguments: list[str] | None = None) -> None:
    """Count and print the tables of docs/monitoring.md."""
    parser = argparse.ArgumentParser(prog="nights", description=__doc__.partition("\n")[0])
    parser.add_argument("--nights", type=int, default=20000, help="without a change, per noise")
    parser.add_argument("--series", type=int, default=200, help="with a step and with a drift")
    parser.add_argument("--harsh", type=int, default=2000, help="nights of each harsher noise")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args(arguments)
    covariance = repeatability(chain())
    sharper = ERROR * np.sqrt(np.diag(np.linalg.inv(covariance)))
    write = sys.stdout.write
    write(f"A spring alone is known {np.round(sharper, 2)} times as well.\n\n")
    write(
        "| noise, temperature | steps | named | drifts (median night) | ideal, known reference | "
    )
    write("ideal, learned | nights | alarms | per 1,000 | left out |\n")
    write("| --- " * 10 + "|\n")
    for name, noise in NOISES.items():
        correlation = 0.8 if "0.8" in name else 0.0
        ideals = [
            ideal_share(np.random.default_rng(chosen.seed), covariance, correlation, known)
            for known in (True, False)
        ]
        for season in (False, True):
            rng = np.random.default_rng(chosen.seed)
            changes = count_changes(rng, covariance, noise, season, chosen.series)
            steady = count_alarms(rng, covariance, noise, season, chosen.nights // 2)
            kind = "season" if season else "any"
            write(
                f"| {name}, {kind} | {changes.steps} of {changes.series} | "
                f"{changes.named} | {changes.drifts} ({changes.drift_night:.0f}) | "
                f"{ideals[0]:.1%} | {ideals[1]:.1%} | {steady.nights} | {steady.alarms} | "
                f"{1e3 * steady.alarms / steady.nights:.2f} | {steady.left_out} |\n"
            )
            sys.stdout.flush()
    for name, noise in HARSH.items() if chosen.harsh else ():
        rng = np.random.default_rng(chosen.seed)
        steady = count_alarms(rng, covariance, noise, True, chosen.harsh)
        write(
            f"| {name}, season | | | | | | {steady.nights} | {steady.alarms} | "
            f"{1e3 * steady.alarms / steady.nights:.2f} | {steady.left_out} |\n"
        )
        sys.stdout.flush()
    updates = count_updates(np.random.default_rng(chosen.seed), max(chosen.series // 10, 1))
    write(
        f"| real updates, white, any | {updates.steps} of {updates.series} | {updates.named} | | | "
        f"| {updates.nights} | {updates.alarms} | | |\n"
    )


if __name__ == "__main__":
    main()
