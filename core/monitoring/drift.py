"""Whether a structure changed: nights compared with all before them, whatever their scatter.

**A change in time.** The values of night k are v_k = reference + slopes^T x_k + change_k + noise_k,
with x_k the environment and a noise whose covariance is that of the test, widened to what the
nights show, and correlated in time (night_noise.py). From a possible start to tonight the change is
a step over 1 or 2 nights (the chart of Shewhart 1931) or a ramp over 8, 32 or 128 nights or all (a
drift). For each start the change is fitted together with reference and slopes to all nights so
far, and divided by its error. That is the generalised likelihood ratio of Willsky and Jones (1976);
over all starts it is the two-sided CUSUM of Page (1954) for a change of unknown size, and few
starts lose little of it (Lai 1995). What 30 nights leave open about reference and slopes is part of
the error, which a CUSUM or an EWMA with given parameters takes as zero (Jensen et al. 2006).

**Directions.** Values are whitened by A, the scatter of nights: inverse Wishart around s^2 C, with
C the stated covariance; s and how closely A follows C come from the learning nights' marginal
likelihood. In these units, tests per window are

    parameter j alone changed:   t = a_j^T d / error,   a_j = A^-1/2 e_j / |A^-1/2 e_j|,
    anything changed:            T^2 = d^T d / error^2   (Hotelling 1947),

d the change. The first is the sharpest test of a change in one parameter while the others vary
with it by noise alone. Each direction has its own scatter, by Student's t.

**Correlation in time.** Probabilities are means over the laws of night_noise.py, weighed by the
restricted likelihood of the nights so far. Either all directions share a law, or the direction has
its own: both are weighed by their marginal likelihood, the former alone where the evidence for it
is substantial.

**Limits.** The probability per night of any false alarm, `false_alarms`, is divided by the number
of structures and windows; a tenth goes to T^2, the rest evenly to the parameters (Bonferroni).

**Two nights.** Real tests have wild values now and then. So an alarm needs two nights that agree; a
night that the next one does not confirm is left out from then on. A change by ten errors is
reported at once: a wild value of that size has a probability of at most 1 % for any noise
(Chebyshev).

**Which parameters.** A change of one parameter also moves the tests of those that vary with it. So
the report names the parameter of the sharpest test, and those whose own change, whatever the
others do, exceeds the limit by its error.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from modetune.core.brief import brief
from modetune.core.errors import CampaignError
from modetune.core.modes import Floats, Integers
from modetune.core.monitoring.environment import Environment, choose_quantities, fit_environment
from modetune.core.monitoring.night_noise import (
    NoiseLaw,
    fit_changes,
    night_positions,
    noise_laws,
    whiten_nights,
)
from modetune.core.monitoring.noise_weighing import (
    averaged,
    fit_law,
    learned_scatter,
    plausible_laws,
    without_learning,
)
from modetune.core.monitoring.series import Series

State = Literal["learning", "steady", "changed", "unknown"]

#: A change of that many errors needs no second night, nor more than two runs.
AT_ONCE = 10.0
#: Fewer nights do not show their own scatter: the stated repeatability alone counts.
HANDFUL = 6
#: Nights of the windows: steps, and ramps. A ramp of half or twice the true length keeps more than
#: 0.85 of the evidence in white noise.
STEPS, RAMPS = (1, 2), (8, 32, 128, 512)
#: Part of false alarms that T^2 may have; the parameters have the rest.
JOINT = 0.1
#: Probability, times the number of tests, below which the night before confirms a drift.
CONFIRMED = 0.01
#: Least ratio of the changes of two nights that show the same one, along their mean. A night
#: without a change has none of it on average, so that half is as far from either.
ALIKE = 0.5
#: Directions with less of the scatter than this are exact combinations of parameters.
EXACT = 1e-8
#: Number of nights, in addition to the learning nights, that are looked back on.
MEMORY = 250


@dataclass(frozen=True, slots=True)
class ParameterChange:
    """The change of one parameter, the environment's part removed.

    since_reference: the last run's value less that of the learning runs; since_last: less that of
    the run before; both relative to the deck. Those in errors are divided by the error of
    repeatability of the last run. step, slow: which detector found a change in this parameter.
    first_alarm: index of the run, in the series.
    """

    name: str
    since_reference: float
    since_last: float
    since_reference_in_errors: float
    since_last_in_errors: float
    step: bool = False
    slow: bool = False
    first_alarm: int | None = None

    @property
    def changed(self) -> bool:
        """Whether a detector found a change."""
        return self.step or self.slow


@dataclass(frozen=True, slots=True, repr=False)
class Drift:
    """What became of a structure.

    joint: (n_runs,), the evidence of a change as a standard normal deviate, all tests and windows
    and their number in one; NaN where a run has no result or is still learned from. joint_limit:
    beyond it a run is unusual, and with the next one an alarm. changed_runs: (n_runs,), whether a
    change was reported at the time or before. lag_correlation: of successive nights, with its
    error. scatter: that of nights over that of repeatability. left_out: runs with wild values.
    environment: None where too few runs have a result. notes: what a reader should know besides.
    """

    state: State
    sentence: str
    changes: tuple[ParameterChange, ...]
    joint: Floats
    joint_limit: float
    changed_runs: np.ndarray[tuple[int], np.dtype[np.bool_]]
    lag_correlation: float
    lag_correlation_error: float
    scatter: float
    environment: Environment | None
    left_out: tuple[int, ...]
    notes: tuple[str, ...]

    __repr__ = brief


def find_drift(
    series: Series,
    learning: int = 30,
    reference: int = 0,
    structures: int = 1,
    false_alarms: float = 1e-3,
) -> Drift:
    """Return whether the parameters changed since the learning runs, and which.

    learning: number of runs with a result that are learned from. reference: index of the first of
    them; earlier runs are ignored, such as those before a repair. structures: number of structures
    that are watched alike. false_alarms: per run, of all structures together.
    Raises CampaignError where these make no sense.
    """
    problems = []
    if learning < HANDFUL:
        problems.append(f"learning {learning}: at least {HANDFUL} runs are needed to learn from")
    if not 0 <= reference < max(series.times.size, 1):
        problems.append(f"reference {reference}: the series has {series.times.size} runs")
    if structures < 1:
        problems.append(f"structures {structures}: at least 1 is watched")
    if not 0.0 < false_alarms < 0.5:
        problems.append(f"false_alarms {false_alarms}: between 0 and 0.5 per run")
    if problems:
        raise CampaignError(problems)
    return _Watch(series, learning, reference, false_alarms / structures).drift()


@dataclass(frozen=True, slots=True)
class _Evidence:
    """Probabilities of what the nights show if nothing changed, (n_windows, N, tests), infinite
    for windows that a night does not have. Tests are the parameters, then T^2; weights: (tests,),
    of the false alarms; counts: (N,), of the windows. change: (n_windows, N, p), of parameters in
    stated errors; own: (n_windows, N, p), over its error whatever the others do; white:
    (n_windows, N, r), the change in units where the scatter of nights is 1 in all directions."""

    rows: Integers
    nights: Integers
    probabilities: Floats
    change: Floats
    own: Floats
    white: Floats
    weights: Floats
    counts: Floats
    lag_correlation: tuple[float, float]
    scatter: float

    def adjusted(self, windows: slice) -> Floats:
        """The probability of each night and test, times the number of tests, (N, tests)."""
        least = self.probabilities[windows].min(axis=0)
        return np.asarray(least * self.counts[:, None] / self.weights)

    def window(self, night: int, windows: slice) -> int:
        """Return which window shows the change most clearly."""
        least = (self.probabilities[:, night] / self.weights).min(axis=1)
        places = np.arange(least.size)[windows]
        return int(places[np.argmin(least[places])])

    def parameters(self, night: int, windows: slice, limit: float) -> tuple[int, ...]:
        """Which parameters changed, of those that are tested."""
        window, p = self.window(night, windows), self.change.shape[2]
        own = np.abs(self.own[window, night])
        changed = own > -scipy.special.ndtri(limit / (2.0 * p * self.counts[night]))
        changed[int(np.argmin(self.probabilities[window, night, :p]))] = True
        return tuple(np.flatnonzero(changed).tolist())


@dataclass(frozen=True, slots=True)
class _Alarm:
    """A change found at a run; start: the first run that has it. parameters: indices of those that
    changed, among the watched. white: (r,), the change as in the evidence; empty where only the
    stated errors were compared."""

    run: int
    start: int
    parameters: tuple[int, ...]
    slow: bool
    white: Floats


@dataclass(frozen=True, slots=True)
class _Nights:
    """Runs as statistics see them: rows in the series, positions in time (n,), values (n, r) in
    units of the stated errors, design (n, m), sizes of each night's noise (n,), what it has beyond
    the usual (n, r, r), and the way to parameters and back, root (p, r) and inverse (r, p)."""

    rows: Integers
    positions: Floats
    values: Floats
    design: Floats
    sizes: Floats
    extra: Floats
    root: Floats
    inverse: Floats


class _Watch:
    """One structure under watch: its runs, which of them count, and what they show."""

    def __init__(self, series: Series, learning: int, reference: int, limit: float) -> None:
        self.names, self.learning, self.limit = series.names, learning, limit
        self.left_out: list[int] = []
        self.notes: list[str] = []
        variances = np.diagonal(series.covariances, axis1=1, axis2=2)
        with np.errstate(invalid="ignore"):
            known = np.isfinite(series.values) & np.isfinite(variances) & (variances > 0.0)
        tested = known.any(axis=1)
        self.watched = np.flatnonzero(2 * known.sum(axis=0) >= max(int(tested.sum()), 1))
        others = [name for place, name in enumerate(series.names) if place not in self.watched]
        if others and self.watched.size:
            self.notes.append(f"most tests do not determine {', '.join(others)}; not watched")
        self.series = series.of(self.watched) if self.watched.size else series
        runs = np.flatnonzero(self.series.complete)
        self.runs = runs[runs >= reference]
        sizes = np.diagonal(self.series.covariances, axis1=1, axis2=2)[self.runs]
        self.sizes = np.sqrt(np.median(sizes, axis=0)) if self.runs.size else np.ones(0)

    def drift(self) -> Drift:
        """Look at all runs in turn."""
        n = self.series.times.size
        self.joint = np.full(n, np.nan)
        self.unconfirmed: _Alarm | None = None
        self.evidence: _Evidence | None = None
        changed = np.zeros(n, dtype=bool)
        while (alarm := self._first_alarm()) is not None:
            back = self._return_of(alarm)
            changed[alarm.run : back] = True
            if back is None:
                break
            gone = (self.runs >= alarm.start) & (self.runs < back)
            # The first run that is as before came just before the second.
            self.runs = np.delete(self.runs, np.flatnonzero(gone)[:-1])
            self.notes.append(f"a change since run {alarm.start + 1} was gone by run {back + 1}")
        learned = self._counted()[: self.learning]
        if alarm is not None:
            learned = learned[learned < alarm.start]
        elif 1 < learned.size == self._counted().size:
            learned = learned[:-1]  # the last run is compared with those before it
        any_known = learned.size > 0 and self.watched.size > 0
        environment = self._environment(learned) if any_known else None
        changes = self._changes(environment)
        state, sentence = self._state(alarm, changes)
        if alarm is not None:
            changes = _with_alarm(changes, alarm, self.watched)
            sentence = _changed_sentence(changes)
        if environment is not None:
            self.notes.extend(environment.notes)
            if self.runs.size and self.runs[-1] == n - 1:
                self.notes.extend(environment.extrapolated(self.series.environment[-1]))
        lag = self.evidence.lag_correlation if self.evidence else (np.nan, np.nan)
        scatter = self.evidence.scatter if self.evidence else np.nan
        return Drift(
            state,
            sentence,
            changes,
            self.joint,
            float(-scipy.special.ndtri(self.limit)),
            changed,
            *lag,
            scatter,
            environment,
            tuple(self.left_out),
            tuple(self.notes),
        )

    def _counted(self) -> Integers:
        return self.runs[~np.isin(self.runs, self.left_out)]

    def _state(
        self, alarm: _Alarm | None, changes: tuple[ParameterChange, ...]
    ) -> tuple[State, str]:
        if not self.watched.size:
            return "unknown", "Unknown: most tests do not determine any parameter"
        if not self.runs.size or self.runs[-1] < self.series.times.size - 1:
            return "unknown", "Unknown: the last run does not determine all parameters"
        if alarm is not None:
            return "changed", ""
        if self.unconfirmed is not None:
            found = _changed_sentence(_with_alarm(changes, self.unconfirmed, self.watched))
            return "unknown", f"Unconfirmed, in the last run alone: {found.partition(': ')[2]}"
        if self._counted().size <= self.learning:
            count = self._counted().size
            how = "compared by the stated repeatability only" if count < HANDFUL else "no change"
            return "learning", f"Learning: {count} of {self.learning} runs, {how}"
        return "steady", "Steady"

    # ---- the runs in turn ----

    def _first_alarm(self) -> _Alarm | None:
        """The first change: by stated repeatability, while learning, or after it."""
        if not self.watched.size:
            return None
        early = self._early_alarm()
        if early is not None:
            return early
        alarm = None
        first = max(HANDFUL, 3 * (2 + len(self.series.quantities)))
        if self.runs.size > first:
            alarm = self._scan(first, self.learning, learning=True)
        if alarm is None and self._counted().size > self.learning:
            alarm = self._scan(self.learning, None, learning=False)
        return alarm

    def _early_alarm(self) -> _Alarm | None:
        """A step by ten errors within the first handful of runs, as the learning runs show it.

        Errors are the stated ones, or the scatter about step and environment where that is larger.
        Two runs leave no room for the environment: the whole difference counts.
        """
        runs = self.runs[: self.learning]
        values = self.series.values[runs] / self.sizes
        environment = self.series.environment[runs]
        for start in range(1, min(runs.size, HANDFUL)):
            design = np.column_stack([np.ones(runs.size), np.arange(runs.size) >= start])
            away = environment - environment.mean(axis=0)
            for column in away[:, np.isfinite(away).all(axis=0)].T:
                wider = np.column_stack([design, column])
                if np.linalg.matrix_rank(wider) == wider.shape[1]:
                    design = wider
            degrees = runs.size - design.shape[1]
            step, *_ = np.linalg.lstsq(design, values, rcond=None)
            left = values - design @ step
            scatter = np.sqrt(np.sum(left**2, axis=0) / degrees) if degrees else np.ones(1)
            # Two runs differ by sqrt(2) errors by noise; what the environment may explain adds.
            spread = np.sqrt(max(np.linalg.pinv(design.T @ design)[1, 1] / 2.0, 1.0))
            large = np.abs(step[1]) >= AT_ONCE * np.maximum(scatter, 1.0) * spread
            if large.any():
                places = tuple(np.flatnonzero(large).tolist())
                return _Alarm(int(runs[start]), int(runs[start]), places, False, np.zeros(0))
        return None

    def _scan(self, first: int, last: int | None, learning: bool) -> _Alarm | None:
        """The first change of the runs from place first to last among those that count."""
        place = first
        found = self._weigh(self._counted()[:last], first, learning)
        while place < found.rows.size:
            night = place - first
            run = int(found.rows[place])
            single = found.adjusted(slice(0, 1))[night]
            pair = found.adjusted(slice(1, 2))[night]
            slow = found.adjusted(slice(2, None)) if not learning else None
            least = min(single.min(), pair.min(), slow[night].min() if slow is not None else np.inf)
            if not learning:
                self.joint[run] = -scipy.special.ndtri(min(max(least, 1e-300), 1.0 - 1e-16))
                self.evidence = found
            tests = np.flatnonzero(pair < self.limit)
            agree = tests.size and night and self._confirms(found, night - 1, found, night)
            if agree and not (learning and not self._large(found, 1, night)):
                places = found.parameters(night, slice(1, 2), self.limit)
                before = int(found.rows[place - 1])
                return _Alarm(run, before, places, False, found.white[1, night])
            tests = np.flatnonzero(single < self.limit)
            if tests.size and not (learning and not self._large(found, 0, night)):
                places = found.parameters(night, slice(0, 1), self.limit)
                alarm = _Alarm(run, run, places, False, found.white[0, night])
                if self._large(found, 0, night):
                    return alarm
                if place + 1 == found.rows.size:
                    self.unconfirmed = alarm
                    return None
                kept = np.delete(found.rows, place)
                other = self._weigh(kept, first, learning)
                if self._confirms(found, night, other, night):
                    return replace(alarm, run=int(found.rows[place + 1]))
                self.left_out.append(run)
                found = other
                continue
            if slow is not None and night:
                before = slow[night - 1] < CONFIRMED
                tests = np.flatnonzero((slow[night] < self.limit) & before)
                if tests.size:
                    start = int(found.rows[first])
                    places = found.parameters(night, slice(2, None), self.limit)
                    white = found.white[found.window(night, slice(2, None)), night]
                    return _Alarm(run, start, places, True, white)
            place += 1
        return None

    def _large(self, found: _Evidence, window: int, night: int) -> bool:
        """Whether a change is too large for a wild value, or for what few nights show."""
        return bool(
            (np.abs(found.change[window, night]) >= AT_ONCE * max(1.0, found.scatter)).any()
        )

    def _confirms(self, found: _Evidence, night: int, other: _Evidence, after: int) -> bool:
        """Whether the run after a night shows the same change."""
        one, two = found.white[0, night], other.white[0, after]
        along = np.array([one, two]) @ (one + two)
        return bool(along.min() >= ALIKE * along.max())

    def _return_of(self, alarm: _Alarm) -> int | None:
        """The second of the first two runs after an alarm that have less than half of the change;
        None where the change is still there."""
        counted = self._counted()
        before, after = counted[counted < alarm.start], counted[counted > alarm.run]
        before = before[-2 * self.learning :]  # enough for what is usual, and each pair costs less
        if before.size < HANDFUL or not alarm.white.size:
            return None
        for place in range(1, after.size):
            rows = np.concatenate([before, after[place - 1 : place + 1]])
            white = self._weigh(rows, before.size, True).white[0]
            if (white @ alarm.white < ALIKE * (alarm.white @ alarm.white)).all():
                return int(after[place])
        return None

    # ---- statistics ----

    def _environment(self, learned: Integers) -> Environment:
        columns, notes = choose_quantities(self.series, learned)
        known = np.isfinite(self.series.environment[learned][:, list(columns)]).all(axis=1)
        learned = learned[known]
        lag = self.evidence.lag_correlation[0] if self.evidence else 0.0
        law = NoiseLaw(lag, 1.0, 1.0)
        whitening = law.whitening(night_positions(self.series.times[learned]))
        found = fit_environment(self.series, learned, columns, whitening)
        return replace(found, notes=notes)

    def _changes(self, environment: Environment | None) -> tuple[ParameterChange, ...]:
        """The change of each parameter of the last run that has a result."""
        runs = self.runs[-2:]
        found = np.full((4, len(self.names)), np.nan)
        if environment is not None:
            expected, _ = environment.predict(self.series.environment[runs])
            away = self.series.values[runs] - expected
            errors = np.sqrt(np.diag(self.series.covariances[runs[-1]]))
            errors = np.where(errors > 0.0, errors, np.nan)
            before = away[-1] - away[0] if runs.size > 1 else np.full(errors.size, np.nan)
            found[:, self.watched] = away[-1], before, away[-1] / errors, before / errors
        return tuple(
            ParameterChange(name, since, last, since_errors, last_errors)
            for name, (since, last, since_errors, last_errors) in zip(
                self.names, found.T.tolist(), strict=True
            )
        )

    def _weigh(self, rows: Integers, first: int, learning: bool) -> _Evidence:
        """Evidence at each of the runs from place first on, given those before it."""
        if rows.size > first + MEMORY:
            rows = np.concatenate([rows[:first], rows[-MEMORY:]])
        series = self.series
        base = rows[:first]
        columns, _ = choose_quantities(series, base)
        known = np.isfinite(series.environment[base][:, list(columns)]).all(axis=1)
        law = NoiseLaw(0.0, 1.0, 1.0)
        environment = fit_environment(series, base[known], columns, law.whitening(base[known]))
        found = series.environment[rows]
        design = environment.design(found)
        design[:, 1:] /= np.where(
            environment.highest > environment.lowest, design[:first, 1:].std(axis=0), 1.0
        )
        units = np.outer(self.sizes, self.sizes)
        covariances = series.covariances[rows] / units
        doubt = environment.doubt(found) / units
        values = series.values[rows] / self.sizes
        values = values - values[:first].mean(axis=0)
        usual = np.median(np.trace(covariances[:first], axis1=1, axis2=2))
        good = np.trace(covariances[:first], axis1=1, axis2=2) <= 2.0 * usual
        sizes, vectors = np.linalg.eigh(covariances[:first][good].mean(axis=0))
        kept = sizes > EXACT * sizes[-1]
        root = vectors[:, kept] * np.sqrt(sizes[kept])
        inverse = (vectors[:, kept] / np.sqrt(sizes[kept])).T
        usual_noise = np.eye(len(inverse))
        worse = _positive(inverse @ covariances @ inverse.T - usual_noise)
        # What the environment may explain enters the errors of changes. It does not lower the
        # weight of a night: the scatter would seem small where it explains nothing.
        weights = np.sqrt(1.0 + np.trace(worse, axis1=1, axis2=2) / len(inverse))
        extra = _positive(inverse @ (covariances + doubt) @ inverse.T - usual_noise)
        nights = _Nights(
            rows,
            night_positions(series.times[rows]),
            values @ inverse.T,
            design,
            weights,
            extra,
            root,
            inverse,
        )
        return _evidence(nights, first, learning)


def _evidence(nights: _Nights, first: int, learning: bool) -> _Evidence:
    """Evidence at each night from place first on."""
    n, r = nights.values.shape
    laws = noise_laws()
    looks = np.arange(first - 1, n)
    whitened = [
        whiten_nights(law, nights.positions, nights.sizes, nights.values, nights.design, looks)
        for law in laws
    ]
    learned = learned_scatter(laws, whitened, first - nights.design.shape[1], learning)
    values, axes = np.linalg.eigh(learned.covariance)
    to_axes = (axes / np.sqrt(values)).T
    back = nights.root @ (axes * np.sqrt(values))
    directions, noise, tested = _directions(nights, to_axes)
    p = tested.size
    law_places = plausible_laws(laws, whitened, to_axes, looks)
    looks = looks[1:]
    watched = looks + 1 - first
    windows = _windows(int(watched.max(initial=0)), learning)
    probabilities = np.full((len(windows), looks.size, p + 1), np.inf)
    change, own = np.zeros((2, len(windows), looks.size, p))
    white = np.zeros((len(windows), looks.size, r))
    counts = np.zeros(looks.size)
    lag_correlation = (np.nan, np.nan)
    for window, (length, ramp) in enumerate(windows):
        starts = np.maximum(looks + 1 - length, first)
        # A longer ramp that is cut to the same nights is the same test.
        there = watched > (windows[window - 1][0] if ramp and length > RAMPS[0] else 0)
        counts += there
        fits = [
            fit_law(
                whitened[place],
                fit_changes(without_learning(whitened[place]), starts, looks, ramp),
                to_axes,
                directions,
                noise,
                learned,
                looks,
            )
            for place in law_places
        ]
        priors = np.log([laws[place].prior for place in law_places])
        found, weights = averaged(fits, priors, p)
        found[:, :p][:, ~tested] = np.inf
        probabilities[window] = np.where(there[:, None], found, np.inf)
        changes = np.array([fit.change for fit in fits])
        mean = np.einsum("lk,lkr->kr", weights, changes)
        change[window], white[window] = mean @ back.T, mean @ axes.T
        errors = np.sqrt(
            np.einsum("lk,lkr->kr", weights, [fit.variance for fit in fits]) @ back.T**2
        )
        own[window] = change[window] / np.where(errors > 0.0, errors, np.inf)
        if window == 0 and looks.size:
            lags = np.array([laws[place].lag_correlation for place in law_places])
            lag_correlation = _mean_and_error(lags, weights[:, -1])
    share = np.append(np.full(p, (1.0 - JOINT) / p), JOINT)
    scatter = float(np.sqrt(np.mean(np.diag(learned.covariance))))
    return _Evidence(
        nights.rows,
        looks,
        probabilities,
        change,
        own,
        white,
        share,
        counts,
        lag_correlation,
        scatter,
    )


def _windows(watched: int, learning: bool) -> list[tuple[int, bool]]:
    """Return length and whether a ramp of each window. watched: nights behind the learning ones."""
    windows = [(length, False) for length in STEPS]
    if learning:
        return windows
    shorter = (0, *RAMPS)
    ramps = zip(RAMPS, shorter, strict=False)
    return [*windows, *((length, True) for length, before in ramps if before < watched)]


def _directions(nights: _Nights, to_axes: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return directions (r, p + r) of the parameters alone and of the axes, the variance of each
    night's noise along them (n, p + r), and whether a parameter has a direction (p,)."""
    alone = to_axes @ nights.inverse
    lengths = np.linalg.norm(alone, axis=0)
    axes = np.eye(nights.values.shape[1])
    directions = np.hstack([alone / np.where(lengths > 0.0, lengths, 1.0), axes])
    turned = to_axes @ nights.extra @ to_axes.T
    noise = 1.0 + np.einsum("ip,kij,jp->kp", directions, turned, directions)
    return directions, noise / nights.sizes[:, None] ** 2, lengths > 0.0


def _mean_and_error(values: Floats, weights: Floats) -> tuple[float, float]:
    average = weights @ values
    return float(average), float(np.sqrt(weights @ np.square(values - average)))


def _positive(matrices: Floats) -> Floats:
    """The positive part of symmetric matrices (n, r, r)."""
    values, vectors = np.linalg.eigh(matrices)
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None, :]) @ vectors.transpose(0, 2, 1))


def _with_alarm(
    changes: tuple[ParameterChange, ...], alarm: _Alarm, watched: Integers
) -> tuple[ParameterChange, ...]:
    """Mark the parameters that changed."""
    places = watched[list(alarm.parameters)]
    return tuple(
        replace(change, step=not alarm.slow, slow=alarm.slow, first_alarm=alarm.run)
        if place in places
        else change
        for place, change in enumerate(changes)
    )


def _changed_sentence(changes: tuple[ParameterChange, ...]) -> str:
    found = sorted(
        (change for change in changes if change.changed),
        key=lambda change: -np.nan_to_num(abs(change.since_reference_in_errors)),
    )
    return "Changed: " + ", ".join(map(_change_text, found))


def _change_text(change: ParameterChange) -> str:
    """Return a change in words; a parameter on a bound has no repeatability."""
    text = f"{change.name} {100.0 * change.since_reference:+.2g} %"
    errors = abs(change.since_reference_in_errors)
    return f"{text} ({errors:.2g} repeatability errors)" if errors == errors else text
