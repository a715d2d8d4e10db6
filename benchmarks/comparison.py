"""Figures of a comparison: medians over repeated rounds, ratios of pairs, growth with the size.

In each round every way runs once, one after the other, after a plain modal run, so that what else
the machine does falls on all alike. A ratio is taken in each round; the figure is their median.
Growth is p of wall time ~ equations^p by least squares of the logarithms.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from statistics import median

import numpy as np
from benchmarks.ways import REFERENCE, WAYS, Trial

from modetune.core.storage.keys import Json


@dataclass(frozen=True, slots=True)
class Round:
    """A plain modal run's wall time, and one trial of each way by its letter."""

    plain_s: float
    trials: Mapping[str, Trial]


@dataclass(frozen=True, slots=True)
class SizeResult:
    """All rounds of one size of a problem. threads: of plain runs and those of scripts."""

    size: str
    n_equations: int
    n_parameters: int
    n_modes: int
    threads: int
    rounds: tuple[Round, ...]

    @property
    def letters(self) -> tuple[str, ...]:
        """The ways that were run."""
        return tuple(self.rounds[0].trials)

    def trials(self, letter: str) -> tuple[Trial, ...]:
        return tuple(each.trials[letter] for each in self.rounds)

    def wall_s(self, letter: str) -> float:
        """Median over the rounds."""
        return median(trial.cost.wall_s for trial in self.trials(letter))

    def to_plain(self, letter: str) -> float:
        """Median ratio of wall times to the round's plain run."""
        return median(each.trials[letter].cost.wall_s / each.plain_s for each in self.rounds)

    def to_reference(self, letter: str, of: Callable[[Trial], float]) -> float | None:
        """Median ratio of a figure to the reference's in the same round; None without it."""
        if REFERENCE not in self.letters:
            return None
        return median(of(each.trials[letter]) / of(each.trials[REFERENCE]) for each in self.rounds)


def wall_s(trial: Trial) -> float:
    return trial.cost.wall_s


def peak_bytes(trial: Trial) -> float:
    return trial.cost.peak_bytes


def growth(sizes: Sequence[float], seconds: Sequence[float]) -> float | None:
    """p of seconds ~ sizes^p; None for fewer than two sizes."""
    if len(set(sizes)) < 2:
        return None
    return float(np.polyfit(np.log(sizes), np.log(seconds), 1)[0])


def growths(results: Sequence[SizeResult]) -> dict[str, float | None]:
    """The exponent of each way, and of the plain run, over the sizes it was run at."""
    found = {}
    for way in WAYS:
        at = [result for result in results if way.letter in result.letters]
        if at:
            found[way.letter] = growth(
                [result.n_equations for result in at], [result.wall_s(way.letter) for result in at]
            )
    plain = [median(each.plain_s for each in result.rounds) for result in results]
    found["plain"] = growth([result.n_equations for result in results], plain)
    return found


def table(result: SizeResult) -> str:
    """The ways of one size, a line each."""
    plain = median(each.plain_s for each in result.rounds)
    lines = [
        f"{result.size}: {result.n_equations:,} equations, {result.n_parameters} parameters, "
        f"{result.n_modes} modes, {len(result.rounds)} rounds; "
        f"a plain modal run {plain:.2f} s, threads {result.threads}",
        f"{'':33}{'wall s':>8}{'/ e':>7}{'/plain':>7}{'modal':>6}{'matr.':>6}{'CPU s':>8}"
        f"{'GB':>6}{'largest':>9}{'mean':>9}{'distance':>9}  met",
    ]
    for way in (way for way in WAYS if way.letter in result.letters):
        last, ratio = result.trials(way.letter)[-1], result.to_reference(way.letter, wall_s)
        cost = last.cost
        lines.append(
            f"{way.letter}  {way.name:30}{result.wall_s(way.letter):8.1f}"
            f"{'-' if ratio is None else f'{ratio:.2f}':>7}{result.to_plain(way.letter):7.1f}"
            f"{cost.modal_runs:6}{cost.matrix_runs:6}{cost.cpu_s:8.1f}{cost.peak_bytes / 1e9:6.2f}"
            f"{last.largest_error:9.1e}{last.mean_error:9.1e}{last.mean_distance:9.3f}"
            f"  {'yes' if last.converged else 'NO'}"
        )
    return "\n".join(lines)


def summary(results: Sequence[SizeResult]) -> dict[str, Json]:
    """All of it for machines."""
    return {"sizes": [_size(result) for result in results], "growth": _json(growths(results))}


def _size(result: SizeResult) -> dict[str, Json]:
    return {
        "size": result.size,
        "equations": result.n_equations,
        "parameters": result.n_parameters,
        "modes": result.n_modes,
        "threads": result.threads,
        "plain_s": [each.plain_s for each in result.rounds],
        "ways": {letter: _way(result, letter) for letter in result.letters},
    }


def _way(result: SizeResult, letter: str) -> dict[str, Json]:
    return {
        "name": next(way.name for way in WAYS if way.letter == letter),
        "wall_s": result.wall_s(letter),
        "wall_to_reference": result.to_reference(letter, wall_s),
        "wall_to_plain": result.to_plain(letter),
        "memory_to_reference": result.to_reference(letter, peak_bytes),
        "trials": [_json(asdict(trial)) for trial in result.trials(letter)],
    }


def _json(values: Mapping[str, object]) -> dict[str, Json]:
    return dict(values)  # type: ignore[arg-type]  # numbers, flags, and tuples of them
