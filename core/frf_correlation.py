"""How alike measured and computed frequency response functions are.

The response assurance criteria are the MAC's cosine with other axes. Over the lines of one
response, the frequency response assurance criterion

    FRAC_jk = |sum_w H_X(w) conj(H_A(w))|^2 / (sum_w |H_X|^2 * sum_w |H_A|^2)

is 1 where curves are equal up to a factor, and falls fast with a shift in frequency (Heylen and
Lammens 1996). Over the outputs at one input, the frequency domain assurance criterion

    FDAC(w_A, w_X) = |H_A(w_A)^H H_X(w_X)|^2 / (|H_A(w_A)|^2 |H_X(w_X)|^2)

compares operating shapes at any two frequencies: where its ridge leaves the diagonal the
computed frequencies are wrong by that much (Pascual, Golinval and Razeto 1997).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from modetune.core.correlation import mac
from modetune.core.errors import ModesError
from modetune.core.modes import Floats

Complexes = NDArray[np.complex128]


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


def fdac(computed: Complexes, measured: Complexes) -> Floats:
    """Frequency domain assurance criterion, (n_lines_computed, n_lines_measured), in [0, 1].

    computed: (n_lines_computed, n_outputs), measured: (n_lines_measured, n_outputs), responses to
    one input at the same outputs. Raises ModesError where they do not fit, or an operating shape
    is zero or not finite. Source: Pascual, Golinval and Razeto 1997.
    """
    a, b = np.asarray(computed), np.asarray(measured)
    if a.ndim != 2 or b.ndim != 2 or a.shape[1] != b.shape[1]:
        raise ModesError(f"responses {a.shape} and {b.shape} are not of the same outputs")
    return mac(a.T, b.T)


def _responses(values: Complexes) -> Complexes:
    responses = np.asarray(values)
    if responses.ndim != 3 or 0 in responses.shape:
        raise ModesError(
            f"responses must be (n_lines, n_outputs, n_inputs), none empty, not {responses.shape}"
        )
    if not np.isfinite(responses).all():
        raise ModesError("a response is not finite")
    return responses
