"""Frequency response functions: superposition from modes, comparison, and the choice of lines.

Receptance H = x / f of M x'' + C x' + (1 + i eta) K x = f at circular frequency w, from
mass-normalised modes of the undamped model,

    H_jk(w) = sum_r phi_jr phi_kr / (w_r^2 - w^2 + i d_r),
    d_r = 2 zeta_r w_r w  (viscous)   or   eta_r w_r^2  (structural).

Mobility is i w H, accelerance -w^2 H.

**Comparison.** The cosine of the MAC along another axis, over the lines of one response, is the
frequency response assurance criterion

    FRAC_jk = |sum_w H_X(w) conj(H_A(w))|^2 / (sum_w |H_X|^2 * sum_w |H_A|^2),

1 where curves are equal up to a factor, and falling fast with a shift in frequency (Heylen and
Lammens 1996).

**Lines.** Of log H a line is as sensitive to a shift of frequencies as its slope,
|d log H / d log w|, over its deviation: much on the flanks of resonances and antiresonances, little
between. Lines are taken in this order. Each excludes the lines around it in which log H changes by
less than NEXT, which would repeat the same information, so a flank has few lines, at distances that
grow away from the resonance.

**Noise** follows from coherence: with n averages log H has the variance (1 - g2) / (2 g2 n), of
amplitude and of phase each (Bendat and Piersol 2010, 9.2). Without coherence it is taken from the
second differences of H over its lines, whose median over ALIKE lines resonances do not affect: of H
as it was measured, since noise that is level in accelerations is not so in displacements. Lines
with more than NOISY are left out.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modetune.core.condensation.reduction import checked_rows
from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers

Response = Literal["receptance", "mobility", "accelerance"]
Complexes = NDArray[np.complex128]
#: Deviation of log H, above which its logarithm is not a normal one any more.
NOISY = 0.2
#: Change of log H from one chosen line to the next.
NEXT = 0.5
#: Second differences of complex noise have 6 times its variance; the median of a Rayleigh
#: distribution is sqrt(ln 2) of its root mean square.
DIFFERENCES = float(np.sqrt(6.0 * np.log(2.0)))
#: Lines over which noise is taken for level: more than resonances hold, as a rule.
ALIKE = 100


@dataclass(frozen=True, slots=True)
class NormalModes:
    """Undamped modes with damping.

    eigenvalues: (n_modes,), (rad/s)^2, 0 or more; slightly negative rigid ones are taken for 0.
    mode_shapes: (n_dof, n_modes), real, mass-normalised. damping: (n_modes,), ratio zeta if
    viscous, loss factor eta if structural, 0 or more; empty for none. Raises ModesError otherwise.
    """

    eigenvalues: Floats
    mode_shapes: Floats
    damping: Floats = field(default_factory=lambda: np.zeros(0))
    kind: Literal["viscous", "structural"] = "viscous"

    def __post_init__(self) -> None:
        n_modes = self.eigenvalues.size
        shapes = self.mode_shapes
        if shapes.ndim != 2 or shapes.shape[1] != n_modes or self.eigenvalues.shape != (n_modes,):
            raise ModesError(f"shapes {shapes.shape} and {n_modes} eigenvalues do not fit together")
        if np.iscomplexobj(shapes) or n_modes == 0:
            raise ModesError("responses are superposed from real modes, at least one")
        if self.damping.shape not in ((0,), (n_modes,)):
            raise ModesError(f"damping of shape {self.damping.shape} for {n_modes} modes")
        values = (self.eigenvalues, shapes, self.damping)
        if not all(np.isfinite(value).all() for value in values) or (self.damping < 0.0).any():
            raise ModesError("modes and damping must be finite, and damping not negative")
        if self.eigenvalues.min() < -1e-6 * np.abs(self.eigenvalues).max() - 1.0:
            raise ModesError(f"eigenvalue {self.eigenvalues.min():.3e} is negative: no stable mode")

    def gains(self, omega: Floats) -> Complexes:
        """1 / (w_r^2 - w^2 + i d_r), (n_lines, n_modes), at circular frequencies (n_lines,)."""
        lam = np.maximum(self.eigenvalues, 0.0)
        damping = self.damping if self.damping.size else np.zeros(lam.size)
        if self.kind == "viscous":
            d = 2.0 * damping * np.sqrt(lam) * omega[:, None]
        else:
            d = damping * lam * np.ones_like(omega)[:, None]
        stiffness = lam - omega[:, None] ** 2 + 1j * d
        if (stiffness == 0.0).any():
            raise ModesError("an undamped mode lies exactly at an excitation frequency")
        return np.asarray(1.0 / stiffness)


def modal_frf(
    excitation_hz: ArrayLike,
    modes: NormalModes,
    outputs: ArrayLike,
    inputs: ArrayLike,
    response: Response = "receptance",
) -> Complexes:
    """Responses superposed from modes.

    excitation_hz: (n_lines,), 0 or more; outputs, inputs: rows of the shapes. Returns (n_lines,
    n_outputs, n_inputs) in the model's units of length (per s, per s^2) per force. Raises
    ModesError where rows or frequencies do not fit, or an undamped mode is met.
    Source: Ewins 2000, 2.4.
    """
    omega = _omega(excitation_hz)
    n = modes.mode_shapes.shape[0]
    seen = modes.mode_shapes[checked_rows(outputs, n)]
    driven = modes.mode_shapes[checked_rows(inputs, n)]
    receptance = np.einsum("wr,jr,kr->wjk", modes.gains(omega), seen, driven, optimize=True)
    return _as_response(receptance, omega, response)


def _omega(excitation_hz: ArrayLike) -> Floats:
    lines = np.asarray(excitation_hz, dtype=np.float64)
    if lines.ndim != 1 or lines.size == 0 or not np.isfinite(lines).all() or (lines < 0.0).any():
        raise ModesError("excitation frequencies must be a list of finite values from 0 Hz on")
    return np.asarray(2.0 * np.pi * lines)


def _as_response(receptance: Complexes, omega: Floats, response: Response) -> Complexes:
    match response:
        case "receptance":
            return receptance
        case "mobility":
            return np.asarray(1j * omega[:, None, None] * receptance)
        case "accelerance":
            return np.asarray(-(omega[:, None, None] ** 2) * receptance)
        case _:
            raise ModesError(f"a response is receptance, mobility or accelerance, not {response!r}")


def frac(measured: Complexes, computed: Complexes) -> Floats:
    """Frequency response assurance criterion of each response, (n_outputs, n_inputs), in [0, 1].

    measured, computed: (n_lines, n_outputs, n_inputs) at the same lines, any unit. Raises
    ModesError where they do not fit, or a response is zero or not finite.
    Source: Heylen and Lammens 1996.
    """
    a, b = _responses(measured), _responses(computed)
    if a.shape != b.shape:
        raise ModesError(f"measured responses {a.shape} and computed ones {b.shape} do not fit")
    size_a, size_b = np.abs(a).max(axis=0), np.abs(b).max(axis=0)
    if (size_a == 0.0).any() or (size_b == 0.0).any():
        raise ModesError("a response is zero at all lines: it has no FRAC")
    a, b = a / size_a, b / size_b
    cross = np.abs(np.sum(a * b.conj(), axis=0)) ** 2
    lengths = np.sum(np.abs(a) ** 2, axis=0) * np.sum(np.abs(b) ** 2, axis=0)
    return np.asarray(np.minimum(cross / lengths, 1.0))


def _responses(values: Complexes) -> Complexes:
    responses = np.asarray(values)
    if responses.ndim != 3 or 0 in responses.shape:
        raise ModesError(
            f"responses must be (n_lines, n_outputs, n_inputs), none empty, not {responses.shape}"
        )
    if not np.isfinite(responses).all():
        raise ModesError("a response is not finite")
    return responses


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
    """Return positions of lines, ascending. usable: positions of the lines to choose from."""
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
