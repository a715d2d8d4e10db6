"""Modes from response functions when their poles are known: residues, residuals, better poles.

Each function is a sum of modes and of what lies outside the band (Ewins 2000, 4.3; Heylen, Lammens
and Sas 1997, A.1), with s = i w and m = 0, 1, 2 for receptance, mobility and accelerance:

    H_jk(w) = s^m [ sum_r A_jkr / (s - p_r) + A*_jkr / (s - p*_r) + upper_jk + lower_jk / s^2 ].

With the poles p known this is linear in the residues A and both residual terms: least squares
in the frequency domain (LSFD). Real and imaginary parts are stacked, which keeps conjugates
together.

Poles of the linear estimator are biased by noise, their damping by some per cent where modes are
close. `refine_poles` takes the bias out: residues are eliminated (variable projection, Golub and
Pereyra 1973, with Kaufman's simplification 1975), so that Gauss-Newton works on the poles alone.
With P the projector onto the complement of the basis B(p) and C = B^+ Y,

    J_q = -P (dB/dq) C,   Y the functions,   r = P Y,

and J^T J, J^T r are traces of small matrices, so that hundreds of functions cost no memory.

The residue matrix of a mode is of rank one, A_jk = u_j v_k: u is the shape, v the participation of
the references. With a driving point its scale is that of unit modal mass, u_j u_k = 2 i w_d A_jk.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from modetune.core.errors import ModesError
from modetune.core.measurement.response_functions import Complexes, Response
from modetune.core.modes import Floats, Integers

POWER: dict[Response, int] = {"receptance": 0, "mobility": 1, "accelerance": 2}
#: Gauss-Newton steps, and the relative step of all poles below which they are good.
STEPS, CLOSE = 20, 1e-7


@dataclass(frozen=True, slots=True)
class ModalFit:
    """Response functions as modes.

    kind: of the functions. poles: (n_modes,), rad/s. residues: (n_functions, n_modes), of
    receptance. upper, lower: (n_functions,), complex.
    """

    kind: Response
    poles: Complexes
    residues: Complexes
    upper: Complexes
    lower: Complexes

    def synthesise(self, frequencies_hz: Floats) -> Complexes:
        """The functions at any frequencies above 0, (n_lines, n_functions)."""
        s = 2j * np.pi * frequencies_hz[:, None]
        modes = (1.0 / (s - self.poles)) @ self.residues.T
        conjugates = (1.0 / (s - self.poles.conj())) @ self.residues.conj().T
        rest = self.upper + self.lower / s**2
        return np.asarray(s ** POWER[self.kind] * (modes + conjugates + rest))

    def select(self, modes: Integers) -> ModalFit:
        """The fit with these modes only, residual terms as they are."""
        return replace(self, poles=self.poles[modes], residues=self.residues[:, modes])


def fit_residues(
    frequencies_hz: Floats, values: Complexes, poles: Complexes, kind: Response
) -> ModalFit:
    """Residues and residual terms by least squares.

    frequencies_hz: (n_lines,), above 0; values: (n_lines, n_functions); poles: (n_modes,), rad/s,
    upper half plane. Raises ModesError where there are fewer numbers than unknowns.
    """
    basis = _basis(frequencies_hz, poles, kind)
    if basis.shape[0] < basis.shape[1]:
        raise ModesError(
            f"{frequencies_hz.size} lines do not determine {poles.size} modes and residual terms"
        )
    size = np.linalg.norm(basis, axis=0)
    q, r = np.linalg.qr(basis / size)
    # The small triangle by singular values: poles that nearly coincide leave it nearly singular.
    found = np.linalg.lstsq(r, q.T @ _stacked(values), rcond=None)[0] / size[:, None]
    n = poles.size
    return ModalFit(
        kind=kind,
        poles=poles,
        residues=(found[:n] + 1j * found[n : 2 * n]).T,
        upper=found[2 * n] + 1j * found[2 * n + 1],
        lower=found[2 * n + 2] + 1j * found[2 * n + 3],
    )


def refine_poles(
    frequencies_hz: Floats, values: Complexes, poles: Complexes, kind: Response
) -> Complexes:
    """Poles that fit the functions best, near the given ones, (n_modes,).

    As fit_residues. Functions weigh as they are scaled. A pole that would leave the stable half
    plane, or its place by more than its resonance is wide (0.2 % at least), keeps the value it was
    given.
    """
    data = _stacked(values)
    at, error = poles, _misfit(frequencies_hz, data, poles, kind)
    for _ in range(STEPS):
        step, shortened = _gauss_newton(frequencies_hz, data, at, kind), 1.0
        while shortened > 1e-3:
            trial = at + shortened * step
            if (trial.real < 0.0).all() and (trial.imag > 0.0).all():
                now = _misfit(frequencies_hz, data, trial, kind)
                if now < error:
                    break
            shortened /= 2.0
        else:
            break
        at, error = trial, now
        if np.abs(shortened * step / at).max() < CLOSE:
            break
    strayed = np.abs(at - poles) > np.maximum(2.0 * np.abs(poles.real), 0.002 * np.abs(poles))
    return np.where(strayed, poles, at)


def mode_shares(
    frequencies_hz: Floats, values: Complexes, poles: Complexes, kind: Response
) -> Floats:
    """How much of the response near its frequency is lost without a mode, (n_modes,), 0 to 1.

    Arguments as fit_residues. Root of the power over the half-width of the resonance that the
    other modes, fitted again, cannot replace: near 1 for an isolated mode, a half for one
    of a close pair, and small for a computational pole, however stable.
    """
    spacing = float(np.diff(frequencies_hz).max())
    left = (
        np.abs(
            values - fit_residues(frequencies_hz, values, poles, kind).synthesise(frequencies_hz)
        )
        ** 2
    )
    shares = np.zeros(poles.size)
    for mode, pole in enumerate(poles.tolist()):
        others = fit_residues(frequencies_hz, values, np.delete(poles, mode), kind)
        width = max(-pole.real / (2.0 * np.pi), 2.0 * spacing)
        near = np.abs(frequencies_hz - abs(pole) / (2.0 * np.pi)) <= width
        without = np.abs(values[near] - others.synthesise(frequencies_hz[near])) ** 2
        gain = np.sum(without) - np.sum(left[near])
        whole = float(np.sum(np.abs(values[near]) ** 2))
        # A pole that was refined out of the band has no lines near it.
        shares[mode] = np.sqrt(max(gain, 0.0) / whole) if whole > 0.0 else 0.0
    return np.minimum(shares, 1.0)


def unexplained_peaks(
    frequencies_hz: Floats, values: Complexes, synthesised: Complexes
) -> tuple[float, ...]:
    """Frequencies of peaks that the modes do not make up, where one may be missing, ascending.

    values, synthesised: (n_lines, n_functions), all functions of like size. A peak is where more
    than half of the response is left, and what is left has ten times the power of its median, which
    noise has not.
    """
    left = np.sum(np.abs(values - synthesised) ** 2, axis=1)
    whole = np.sum(np.abs(values) ** 2, axis=1)
    # Five lines together: single ones scatter with few functions.
    left, whole = (np.convolve(power, np.ones(5), "same") for power in (left, whole))
    above = (left > 10.0 * np.median(left)) & (left > 0.25 * whole) & (left > 1e-10 * whole.max())
    edges = np.flatnonzero(np.diff(np.concatenate([[0], above.astype(np.int64), [0]])))
    return tuple(
        float(frequencies_hz[start + int(np.argmax(left[start:end]))])
        for start, end in edges.reshape(-1, 2)
    )


def shapes_and_participations(
    residues: Complexes, rows: Integers, columns: Integers
) -> tuple[Complexes, Complexes]:
    """Residue matrices as products A_jk = u_j v_k of rank one: u (n_rows, n_modes), v likewise.

    residues: (n_functions, n_modes); rows, columns: (n_functions,), 0-based place of response and
    reference. Not every pair need be measured, and some may be so twice; a row that nothing
    connects with the strongest reference stays zero. Least squares, row and column in turn.
    """
    n_rows, n_columns = int(rows.max()) + 1, int(columns.max()) + 1
    n_modes = residues.shape[1]
    u = np.zeros((n_rows, n_modes), dtype=np.complex128)
    v = np.zeros((n_columns, n_modes), dtype=np.complex128)
    for mode in range(n_modes):
        a = residues[:, mode]
        strength = np.bincount(columns, np.abs(a) ** 2, n_columns)
        v[int(np.argmax(strength)), mode] = 1.0
        for _ in range(200 if n_columns > 1 else 1):
            before = u[:, mode].copy()
            u[:, mode] = _solve_side(a, rows, v[columns, mode], n_rows)
            v[:, mode] = _solve_side(a, columns, u[rows, mode], n_columns)
            if np.abs(u[:, mode] - before).max() <= 1e-10 * np.abs(u[:, mode]).max():
                break
    return u, v


def unit_mass_factors(own: Complexes, force: Complexes, poles: Complexes) -> Complexes:
    """What shapes u are multiplied by to have unit modal mass, (n_modes,).

    own, force: (n_points, n_modes), u and v at the driving points. A mode without motion at all of
    them keeps its scale: 1. Source: Ewins 2000, 2.6, with A = phi phi^T / 2 i w_d.
    """
    strength = np.sum(np.abs(own) ** 2, axis=0)
    squares = 2j * poles.imag * np.sum(own.conj() * force, axis=0)
    scaled = np.divide(squares, strength, out=np.ones_like(squares), where=strength > 0.0)
    return np.asarray(np.sqrt(scaled))


def _solve_side(a: Complexes, places: Integers, other: Complexes, count: int) -> Complexes:
    weights = np.bincount(places, np.abs(other) ** 2, count)
    product = a * other.conj()
    sums = np.bincount(places, product.real, count) + 1j * np.bincount(places, product.imag, count)
    return np.divide(sums, weights, out=np.zeros(count, np.complex128), where=weights > 0.0)


def _stacked(values: Complexes) -> Floats:
    return np.concatenate([values.real, values.imag])


def _basis(frequencies_hz: Floats, poles: Complexes, kind: Response) -> Floats:
    """(2 n_lines, 2 n_modes + 4): real and imaginary parts of residues, then upper, then lower."""
    s = 2j * np.pi * frequencies_hz[:, None]
    first, second = 1.0 / (s - poles), 1.0 / (s - poles.conj())
    one = np.ones_like(s)
    columns = [first + second, 1j * (first - second), one, 1j * one, one / s**2, 1j / s**2]
    return _stacked(s ** POWER[kind] * np.hstack(columns))


def _slopes(frequencies_hz: Floats, poles: Complexes, kind: Response) -> Floats:
    """Derivatives of the basis, (4, 2 n_lines, n_modes).

    Of the columns of real and imaginary residues with the real part of the own pole, then with
    its imaginary part.
    """
    s = 2j * np.pi * frequencies_hz[:, None]
    first, second = 1.0 / (s - poles) ** 2, 1.0 / (s - poles.conj()) ** 2
    both = [first + second, 1j * (first - second), 1j * (first - second), -(first + second)]
    return np.stack([_stacked(s ** POWER[kind] * part) for part in both])


def _misfit(frequencies_hz: Floats, data: Floats, poles: Complexes, kind: Response) -> float:
    basis = _basis(frequencies_hz, poles, kind)
    q = np.linalg.qr(basis / np.linalg.norm(basis, axis=0))[0]
    return float(np.sum((data - q @ (q.T @ data)) ** 2))


def _gauss_newton(
    frequencies_hz: Floats, data: Floats, poles: Complexes, kind: Response
) -> Complexes:
    """Step of all poles, (n_modes,), complex."""
    n = poles.size
    basis = _basis(frequencies_hz, poles, kind)
    size = np.linalg.norm(basis, axis=0)
    q, r = np.linalg.qr(basis / size)
    fitted = q.T @ data
    c = np.linalg.lstsq(r, fitted, rcond=None)[0][: 2 * n] / size[: 2 * n, None]
    slopes = _slopes(frequencies_hz, poles, kind)
    # Columns of D: real residue with real part of the pole, imaginary residue with it, then both
    # with the imaginary part; `member` says which residue a column of D multiplies.
    d = np.hstack(list(slopes))
    d = d - q @ (q.T @ d)
    member = np.concatenate([np.arange(2 * n), np.arange(2 * n)])
    products = (d.T @ d) * (c @ c.T)[np.ix_(member, member)]
    # P is already in D, so that D^T r = D^T Y.
    sides = np.sum((d.T @ data) * c[member], axis=1)
    # Both columns of D that belong to one unknown (a part of a pole) are summed.
    summing = np.zeros((4 * n, 2 * n))
    index = np.arange(n)
    for block, unknown in enumerate((index, index, n + index, n + index)):
        summing[block * n + index, unknown] = 1.0
    normal, side = summing.T @ products @ summing, summing.T @ sides
    scale = np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
    found = np.linalg.lstsq(normal / np.outer(scale, scale), side / scale, rcond=1e-12)[0] / scale
    return np.asarray(found[:n] + 1j * found[n:])
