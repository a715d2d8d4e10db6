"""Repeated tests: the mean of their modes and how exactly it is known, with wrong values left out.

**Covariance with missing and wrong values.** Repetitions x_k (k = 1..n) of m values are taken as
normal. Where some are missing, mean and covariance C follow from expectation and maximisation
(Dempster, Laird and Rubin 1977): with o the values that are there and u those that are not,

    x_u <- mean_u + C_uo C_oo^-1 (x_o - mean_o),

their own covariance C_uu - C_uo C_oo^-1 C_ou added to that of the completed values. A wrong value
would distort both, so the first round uses Student's t with 3 degrees of freedom: there a
repetition weighs (3 + m_o) / (3 + d^2), d^2 = (x_o - mean_o)^T C_oo^-1 (x_o - mean_o)
(Little 1988; Lange, Little and Taylor 1989). What lies too far from that is left out value by
value: of a repetition the value without which d^2 falls most, until the others are not unusual; the
whole repetition, where less than half of it would be left. All others then give mean and
covariance, and the two steps repeat until they agree. A repetition is unusual where d^2 is beyond
what one in a hundred sets of n good ones has anywhere: a new normal vector has
d^2 n (n - m) / ((n^2 - 1) m) ~ F(m, n - m) (Hotelling).

**Mean of tests.** Shapes are first brought to the first test's scale and sign (by least squares,
the modal scale factor). The mean of n tests has the covariance C / n. Few tests estimate C badly,
so

* standard deviations s are moved towards those of all modes, as if four more tests had scattered
  as modes do on average (moderated variance, Smyth 2004):
  s_i^2 <- ((n - 1) s_i^2 + 4 mean(s^2)) / (n + 3);
* correlations r are moved towards zero by the share that minimises their expected error (Ledoit
  and Wolf 2004; Schaefer and Strimmer 2005): sum (1 - r^2)^2 / (n - 1) over sum r^2.

Successive tests may drift with whatever warms up or settles. With a of the scatter of one seen in
the next (first autocorrelation), n tests are worth n (1 - a) / (1 + a) independent ones (Bayley and
Hammersley 1946). What all tests have wrong alike (the suspension, a misplaced sensor) does not
appear in any of this.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from modetune.core.errors import ModesError
from modetune.core.measurement.measurement import MeasuredDeviations, Measurement, RepeatedTests
from modetune.core.modes import Floats, MeasuredModes, dof_name, mode_set

#: Share of sets of good repetitions in which one is called wrong.
FALSE = 0.01
#: Least number of repetitions that show which one is wrong, in all and per value.
LEAST, EACH = 10, 3
#: Degrees of freedom of Student's t; rounds; change of the mean, in deviations, that ends them.
STUDENT, ROUNDS, SAME = 3.0, 2000, 1e-9
#: What is added to variances of about 1: a value may never have changed.
NOTHING = 1e-12
#: The median of |x| of a standard normal variable, by which a deviation follows from it.
MEDIAN = 0.6744897501960817

Mask = NDArray[np.bool_]
#: Number of tests that the scatter of all modes is worth, in addition to those of the mode.
BORROWED = 4
#: Repeated tests differ by less: frequencies relatively, and shapes from MAC 1.
APART, UNLIKE = 0.1, 0.3
#: Number of tests from which a drift is sought, and its least size in standard errors.
DRIFT_FROM, DRIFTS = 10, 2.0
#: Number of omitted values that are listed one by one.
TOLD = 12


@dataclass(frozen=True, slots=True)
class Scatter:
    """Mean (m,) and covariance (m, m) of one repetition; used: (n, m), values they are made of."""

    mean: Floats
    covariance: Floats
    used: Mask

    @property
    def deviations(self) -> Floats:
        """Standard deviations of one repetition, (m,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def expected(self, row: Floats, place: int) -> tuple[float, float]:
        """What the other values of a repetition (m,), NaN where missing, lead to expect of one, and
        how exactly."""
        there = np.isfinite(row)
        there[place] = False
        known, own = self.covariance[np.ix_(there, there)], self.covariance[place, there]
        factors = np.linalg.lstsq(known, own, rcond=None)[0]
        mean = self.mean[place] + factors @ (row - self.mean)[there]
        return float(mean), float(np.sqrt(max(self.covariance[place, place] - factors @ own, 0.0)))


def scatter_of(values: Floats) -> Scatter:
    """Mean and covariance of repetitions (n, m), NaN where missing.

    Raises ModesError where a value was measured less than twice, or nothing scatters.
    """
    seen = np.isfinite(values)
    n, m = values.shape
    if (seen.sum(axis=0) < 2).any():
        place = int(np.argmin(seen.sum(axis=0)))
        raise ModesError(f"column {place + 1} was measured {seen.sum(axis=0)[place]} times")
    middle = np.nanmedian(values, axis=0)
    away = np.where(seen, values - middle, np.nan)
    scale = np.nanmedian(np.abs(away), axis=0) / MEDIAN
    scale = np.where(scale > 0.0, scale, np.sqrt(np.nanmean(away**2, axis=0)))
    if not scale.any():
        raise ModesError("the repeated tests are identical and show no scatter")
    scale = np.where(scale > 0.0, scale, scale.max())
    x, used = away / scale, seen
    sought = n >= max(LEAST, EACH * m)
    if sought:
        mean, covariance = _fitted(x, STUDENT)
        used = _usual(x, mean, _consistent(x, mean, covariance))
    for _ in range(n):
        left = np.where(used, x, np.nan)
        mean, covariance = _fitted(left, np.inf)
        counted = int(used.any(axis=1).sum())
        covariance *= counted / (counted - 1)
        now = _usual(x, mean, covariance) if sought else used
        if (now == used).all():
            break
        used = now
    return Scatter(middle + scale * mean, covariance * np.outer(scale, scale), used)


def _fitted(x: Floats, student: float) -> tuple[Floats, Floats]:
    """Mean (m,) and covariance (m, m) of greatest likelihood of rows (n, m), NaN where missing.

    student: degrees of freedom, infinite for a normal distribution. Rows of NaN are ignored.
    """
    seen = np.isfinite(x)
    x, seen = x[seen.any(axis=1)], seen[seen.any(axis=1)]
    n, m = x.shape
    # Few repetitions leave directions in which nothing scatters; there values are independent.
    ridge = 1.0 + (1e-9 if n > 2 * m else 1.0 / n) * np.eye(m)
    mean, covariance = np.nanmean(x, axis=0), np.diag(np.nanvar(x, axis=0))
    patterns, which = np.unique(seen, axis=0, return_inverse=True)
    for _ in range(ROUNDS):
        filled, own, weights = np.where(seen, x, mean), np.zeros((m, m)), np.ones(n)
        for number, there in enumerate(patterns):
            rows = np.flatnonzero(which.ravel() == number)
            known = (covariance * ridge + NOTHING * np.eye(m))[np.ix_(there, there)]
            across = covariance[np.ix_(there, ~there)]
            off = (x[rows][:, there] - mean[there]).T
            solved = np.linalg.solve(known, off)
            if np.isfinite(student):
                weights[rows] = (student + there.sum()) / (student + (off * solved).sum(axis=0))
            filled[np.ix_(rows, ~there)] = mean[~there] + (across.T @ solved).T
            left: Floats = covariance[np.ix_(~there, ~there)] - across.T @ np.linalg.solve(
                known, across
            )
            own[np.ix_(~there, ~there)] += rows.size * left
        before, mean = mean, weights @ filled / weights.sum()
        away = filled - mean
        last, covariance = covariance, (away.T @ (weights[:, None] * away) + own) / n
        sizes = np.sqrt(np.diag(covariance) + NOTHING)
        moved = np.abs(mean - before) / sizes
        if max(moved.max(), (np.abs(covariance - last) / np.outer(sizes, sizes)).max()) < SAME:
            break
    return mean, covariance


def _squares(x: Floats, mean: Floats, covariance: Floats) -> Floats:
    """Squared distances d^2 of rows, of the values that are there, (n,)."""
    found, covariance = np.zeros(len(x)), covariance + NOTHING * np.eye(len(covariance))
    for place, row in enumerate(x):
        there = np.isfinite(row)
        off = (row - mean)[there]
        found[place] = off @ np.linalg.solve(covariance[np.ix_(there, there)], off)
    return found


def _consistent(x: Floats, mean: Floats, covariance: Floats) -> Floats:
    """The covariance with which half of all rows are nearer than half of normal ones are."""
    counts = np.isfinite(x).sum(axis=1)
    there = counts > 0
    ratio = _squares(x, mean, covariance)[there] / scipy.special.chdtri(counts[there], 0.5)
    return np.asarray(covariance * np.median(ratio))


def _usual(x: Floats, mean: Floats, covariance: Floats) -> Mask:
    """Return which values (n, m) are usual, given the others."""
    n, m = x.shape
    sizes = np.arange(1, m + 1)
    limits = np.zeros(m + 1)
    quantiles = scipy.special.fdtri(sizes, n - sizes, 1.0 - FALSE / n)
    limits[1:] = sizes * (n**2 - 1) / (n * (n - sizes)) * quantiles
    covariance, used = covariance + NOTHING * np.eye(m), np.isfinite(x)
    for row, there in zip(x, used, strict=True):
        counted = int(there.sum())
        while there.any():
            inverse = np.linalg.inv(covariance[np.ix_(there, there)])
            pulled = inverse @ (row - mean)[there]
            if (row - mean)[there] @ pulled <= limits[there.sum()]:
                break
            worst = int(np.argmax(pulled**2 / np.diag(inverse)))  # what d^2 falls by without it
            there[np.flatnonzero(there)[worst]] = False
        if 2 * there.sum() < counted:
            there[:] = False
    lost = used.sum(axis=0) < 2  # then nothing shows which of its values are the unusual ones
    used[:, lost] = np.isfinite(x)[:, lost]
    return used


def mean_of_tests(tests: Sequence[MeasuredModes], places: Sequence[str]) -> Measurement:
    """The mean of two or more tests at the same sensors. places: the file of each.

    The first test defines the modes; others may lack some. Raises ModesError if they are tests of
    something else, or if nothing scatters.
    """
    first = tests[0]
    for other in tests[1:]:
        check_alike(first, other)
    rows = [[first.numbers.index(number) for number in test.numbers] for test in tests]
    found = np.full((2, len(tests), len(first.numbers)), np.nan)
    for test, own, place in zip(tests, rows, range(len(tests)), strict=True):
        found[0, place, own] = test.modes.frequencies_hz
        if test.modes.damping_ratios.size:
            found[1, place, own] = test.modes.damping_ratios
    mean = measurement_of(RepeatedTests(tuple(places), first.numbers, *found))
    assert mean.modes is not None
    assert mean.deviations is not None
    if not first.has_shapes:
        return mean
    wanted = np.real(first.modes.mode_shapes)
    scaled = np.full((len(tests), *wanted.shape), np.nan)
    for place, (test, own) in enumerate(zip(tests, rows, strict=True)):
        scaled[place][:, own] = _scaled(wanted[:, own], test)
    shapes = np.nanmean(scaled, axis=0)
    counts = np.isfinite(scaled[:, 0]).sum(axis=0)
    variances = np.nanmean(np.nanvar(scaled, axis=0), axis=0) * counts / (counts - 1)
    deviations = _drawn(variances / np.mean(shapes**2, axis=0), len(tests)) / np.sqrt(counts)
    if (deviations == 0.0).any():
        raise ModesError("the repeated tests are identical and show no scatter")
    own_modes = mean.modes.modes
    modes = replace(
        first.modes,
        mode_shapes=shapes,
        frequencies_hz=own_modes.frequencies_hz,
        damping_ratios=own_modes.damping_ratios,
    )
    return replace(
        mean,
        modes=MeasuredModes(first.numbers, modes),
        deviations=replace(mean.deviations, shapes=deviations),
    )


def measurement_of(repeats: RepeatedTests) -> Measurement:
    """Mean frequencies and damping of repeated tests, what they are known by, and what was left
    out, in words. Raises ModesError where a mode was found less than twice, or nothing scatters.
    """
    lost = np.flatnonzero(np.isfinite(repeats.frequencies_hz).sum(axis=0) < 2)
    if lost.size:
        raise ModesError(
            f"mode {repeats.numbers[lost[0]]} was found in fewer than two of "
            f"{len(repeats.places)} tests, so its scatter is unknown"
        )
    scatter = scatter_of(repeats.frequencies_hz)
    worth, notes = _independent(repeats, scatter)
    counts = scatter.used.sum(axis=0)
    relative = scatter.covariance / np.outer(scatter.mean, scatter.mean)
    spread = _drawn(np.diag(relative), int(counts.min()))
    deviations = spread / np.sqrt(counts * worth)
    known = MeasuredDeviations(
        deviations, np.full(counts.size, np.nan), _correlation(relative, int(counts.min()))
    )
    return Measurement(
        MeasuredModes(repeats.numbers, mode_set(scatter.mean, damping_ratios=_damping(repeats))),
        notes=(*_left_out(repeats, scatter), *notes),
        deviations=known,
        repeats=replace(repeats, used=scatter.used, worth=worth),
    )


def check_alike(first: MeasuredModes, other: MeasuredModes) -> None:
    """Raise ModesError where another test does not repeat the first."""
    one, two = first.modes, other.modes
    new = [str(number) for number in other.numbers if number not in first.numbers]
    if new:
        wanted = ", ".join(map(str, first.numbers))
        raise ModesError(f"it has mode {', '.join(new)}, and the first only {wanted}")
    if not (
        np.array_equal(one.nodes, two.nodes) and np.array_equal(one.components, two.components)
    ):
        raise ModesError(f"its sensors are others{_other_sensors(first, other)}")
    rows = [first.numbers.index(number) for number in other.numbers]
    far = np.flatnonzero(np.abs(two.frequencies_hz / one.frequencies_hz[rows] - 1.0) > APART)
    if far.size:
        place = int(far[0])
        raise ModesError(
            f"mode {other.numbers[place]} at {two.frequencies_hz[place]:g} Hz, and at "
            f"{one.frequencies_hz[rows[place]]:g} Hz in the first"
        )
    if not first.has_shapes:
        return
    a, b = one.mode_shapes[:, rows], two.mode_shapes
    mac = np.sum(a * b, axis=0) ** 2 / (np.sum(a**2, axis=0) * np.sum(b**2, axis=0))
    if (mac < 1.0 - UNLIKE).any():
        place = int(np.argmin(mac))
        raise ModesError(f"mode {other.numbers[place]} has another shape (MAC {mac[place]:.2f})")


def _other_sensors(first: MeasuredModes, other: MeasuredModes) -> str:
    """Which sensors two tests do not share, in words."""
    names = [
        {
            dof_name(dof)
            for dof in zip(test.modes.nodes.tolist(), test.modes.components.tolist(), strict=True)
        }
        for test in (first, other)
    ]
    sides = (("it lacks", names[0] - names[1]), ("the first lacks", names[1] - names[0]))
    texts = [f"{what} {', '.join(sorted(there)[:6])}" for what, there in sides if there]
    return f" ({'; '.join(texts)})" if texts else ", or in another order"


def _scaled(wanted: Floats, test: MeasuredModes) -> Floats:
    own = np.real(test.modes.mode_shapes)
    return np.asarray(own * (np.sum(wanted * own, axis=0) / np.sum(own**2, axis=0)))


def _drawn(variances: Floats, n: int) -> Floats:
    """Return standard deviations drawn to those of all modes, from the variances of n tests."""
    drawn = ((n - 1) * variances + BORROWED * variances.mean()) / (n - 1 + BORROWED)
    return np.asarray(np.sqrt(drawn))


def _correlation(covariance: Floats, n: int) -> Floats:
    """Return the correlation (m, m), drawn to zero as far as n tests leave it uncertain.

    Of two tests every correlation is 1 or -1 whatever was measured, so they determine none.
    """
    if n < 3:
        return np.eye(len(covariance))
    sizes = np.sqrt(np.diag(covariance))
    sizes = np.where(sizes > 0.0, sizes, 1.0)
    r = covariance / np.outer(sizes, sizes)
    np.fill_diagonal(r, 0.0)
    m, size = len(r), float(np.sum(r**2))
    errors = float(np.sum((1.0 - r**2) ** 2)) - m  # the diagonal has none
    share = min(1.0, errors / (n - 1) / size) if size > 0.0 else 1.0
    return np.asarray((1.0 - share) * r + np.eye(m))


def _independent(repeats: RepeatedTests, scatter: Scatter) -> tuple[float, tuple[str, ...]]:
    """How much of an independent test each is worth, and a sentence where that is not all of it."""
    n = len(repeats.places)
    if n < DRIFT_FROM:
        return 1.0, ()
    varies = scatter.used & (scatter.deviations > 0.0)
    sizes = np.where(scatter.deviations > 0.0, scatter.deviations, 1.0)
    off = np.where(varies, repeats.frequencies_hz - scatter.mean, 0.0) / sizes
    alike = float(np.sum(off[1:] * off[:-1]) / max(np.sum(off**2), NOTHING))
    if alike < DRIFTS / np.sqrt(n):
        return 1.0, ()
    worth = max((1.0 - alike) / (1.0 + alike), 2.0 / n)
    return worth, (
        f"the {n} tests drift: each resembles the one before it (correlation {alike:.2f}), so "
        f"that their mean is known as by {worth * n:.0f} independent ones",
    )


def _left_out(repeats: RepeatedTests, scatter: Scatter) -> list[str]:
    """What was missing, and what was left out as wrong, a sentence each."""
    there = np.isfinite(repeats.frequencies_hz)
    missing = int((~there).sum())
    texts = []
    if missing:
        by = ", ".join(
            f"mode {number} in {lacks}"
            for number, lacks in zip(repeats.numbers, (~there).sum(axis=0).tolist(), strict=True)
            if lacks
        )
        texts.append(f"of {len(repeats.places)} tests not all found every mode: {by} not")
    wrong = np.argwhere(there & ~scatter.used)
    for test, mode in wrong[:TOLD].tolist():
        found = np.where(scatter.used[test], repeats.frequencies_hz[test], np.nan)
        mean, deviation = scatter.expected(found, mode)
        texts.append(
            f"{repeats.places[test]}: mode {repeats.numbers[mode]} at "
            f"{repeats.frequencies_hz[test, mode]:.6g} Hz is left out: the other tests, and the "
            f"other modes of this one, lead to expect {mean:.6g} Hz within {deviation:.2g}"
        )
    if len(wrong) > TOLD:
        texts.append(f"{len(wrong) - TOLD} more values are left out")
    return texts


def damping_covariance(repeats: RepeatedTests, numbers: Sequence[int]) -> Floats:
    """Covariance (n, n) of the mean damping ratios of these modes, as robust as the mean is.

    (0, 0) where a mode has fewer than two, or all are alike.
    """
    columns = [repeats.numbers.index(number) for number in numbers]
    ratios = repeats.damping_ratios[:, columns]
    counts = np.isfinite(ratios).sum(axis=0)
    if (counts < 2).any() or (np.nanstd(ratios, axis=0) == 0.0).any():
        return np.zeros((0, 0))
    found = scatter_of(ratios)
    sizes = found.deviations / np.sqrt(found.used.sum(axis=0) * repeats.worth)
    return np.asarray(_correlation(found.covariance, int(counts.min())) * np.outer(sizes, sizes))


def _damping(repeats: RepeatedTests) -> Floats:
    """Mean damping ratios (n_modes,), none where a mode has fewer than two."""
    if (np.isfinite(repeats.damping_ratios).sum(axis=0) < 2).any():
        return np.zeros(0)
    if (np.nanstd(repeats.damping_ratios, axis=0) == 0.0).all():
        return np.asarray(np.nanmean(repeats.damping_ratios, axis=0))
    return scatter_of(repeats.damping_ratios).mean
