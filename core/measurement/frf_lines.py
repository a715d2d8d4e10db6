"""Frequencies at which a response function tells most, away from its noise.

Of log H a line tells about a shift of frequencies as much as its slope, |d log H / d log w|, over
its deviation: much on the flanks of resonances and antiresonances, little between. Lines are taken
in this order. A line leaves out those around it in which log H changes by less than NEXT, which
would tell the same, so a flank has few, at distances that grow away from the resonance.

Noise is known by coherence: with n averages log H has the variance (1 - g2) / (2 g2 n), of
amplitude and of phase each (Bendat and Piersol 2010, 9.2). Without it, it is taken from the second
differences of H over its lines, whose median over ALIKE lines resonances do not draw: of H as it
was measured, since noise that is level in accelerations is not so in displacements. Lines with
more than NOISY are left out.
"""

from __future__ import annotations

import numpy as np

from modetune.core.measurement.frf import Complexes
from modetune.core.modes import Floats, Integers

#: Deviation of log H, above which its logarithm is not a normal one any more.
NOISY = 0.2
#: Change of log H from one chosen line to the next.
NEXT = 0.5
#: Second differences of complex noise have 6 times its variance; the median of a Rayleigh
#: distribution is sqrt(ln 2) of its root mean square.
DIFFERENCES = float(np.sqrt(6.0 * np.log(2.0)))
#: Lines over which noise is taken for level: more than resonances hold, as a rule.
ALIKE = 100


def log_variances(values: Complexes, coherence: Floats, averages: int) -> Floats:
    """Variances of log |H| and of its phase, (n_lines,); infinite where nothing is known.

    values: (n_lines,), of the quantity that was measured; coherence: (n_lines,), or empty.
    """
    with np.errstate(divide="ignore"):
        if coherence.size:
            return np.asarray((1.0 - coherence) / (2.0 * averages * coherence))
        apart = np.abs(values[2:] - 2.0 * values[1:-1] + values[:-2]) / DIFFERENCES
        if not apart.size:
            return np.zeros(values.size)
        parts = np.array_split(np.arange(1, values.size - 1), max(1, round(apart.size / ALIKE)))
        levels = [np.median(apart[part - 1]) for part in parts]
        noise = np.interp(np.arange(values.size), [part.mean() for part in parts], levels)
        return np.asarray(0.5 * noise**2 / np.abs(values) ** 2)


def chosen_lines(
    frequencies_hz: Floats, values: Complexes, variances: Floats, usable: Integers, most: int
) -> Integers:
    """Positions of at most so many lines, ascending. usable: positions, those that may be taken."""
    with np.errstate(divide="ignore", invalid="ignore"):
        step = np.log(values[2:] / values[:-2])
        width = np.log(frequencies_hz[2:] / frequencies_hz[:-2])
        noise = 2.0 * (variances[2:] + variances[:-2])
        slope = np.sqrt(np.maximum(np.abs(step) ** 2 - noise, 0.0)) / width
        worth = np.pad(slope**2 / (variances[1:-1] + NOISY**2), 1)
    usable = usable[(variances[usable] <= NOISY**2) & (worth[usable] > 0.0)]
    slopes, at = np.pad(slope, 1), np.log(frequencies_hz, where=frequencies_hz > 0.0)
    chosen: list[int] = []
    left = usable[np.argsort(-worth[usable], kind="stable")]
    while left.size and len(chosen) < most:
        first = int(left[0])
        chosen.append(first)
        left = left[np.abs(at[left] - at[first]) * slopes[first] >= NEXT]
    return np.sort(np.array(chosen, dtype=np.int64))
