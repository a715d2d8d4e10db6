"""Free structures of low frequency on MYSTRAN: all rigid and repeated modes, by closed forms."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.translation.solver import translated_solver
from tests.adapters.solved import needs_ccx, needs_mystran, solved

ALUMINIUM = "MAT1,1,7.+10,,.3,2700."
E, RHO, NU = 7e10, 2700.0, 0.3


def bars(points: list[tuple[float, float, float]], ends: list[tuple[int, int]], d: float) -> str:
    """Round bars of diameter d between points numbered from 1."""
    area, inertia = np.pi * d**2 / 4.0, np.pi * d**4 / 64.0
    lines = [ALUMINIUM, f"PBAR,1,1,{area:.6E},{inertia:.6E},{inertia:.6E},{2.0 * inertia:.6E}"]
    lines += [f"GRID,{n},,{x:.6f},{y:.6f},{z:.6f}" for n, (x, y, z) in enumerate(points, start=1)]
    lines += [f"CBAR,{n},1,{a},{b},0.,0.,1." for n, (a, b) in enumerate(ends, start=1)]
    return "\n".join(lines) + "\n"


def ring(count: int = 80, radius: float = 25.0, d: float = 0.04) -> tuple[str, list[float]]:
    """A thin ring: in and out of its plane, each mode twice (Love's formulas)."""
    angles = 2.0 * np.pi * np.arange(count) / count
    points = [(radius * np.cos(a), radius * np.sin(a), 0.0) for a in angles.tolist()]
    ends = [(n + 1, (n + 1) % count + 1) for n in range(count)]
    base = np.sqrt(E / RHO) * d / 4.0 / radius**2 / (2.0 * np.pi)
    waves = [
        base * m * (m**2 - 1) / np.sqrt(m**2 + more) for m in (2, 3) for more in (1.0 + NU, 1.0)
    ]
    return bars(points, ends, d), sorted([*waves, *waves])


def wing(count: int = 400, length: float = 60.0, d: float = 0.05) -> tuple[str, list[float]]:
    """A slender free bar, equally stiff both ways, that has some inertia about its own axis."""
    points = [(length * n / count, 0.0, 0.0) for n in range(count + 1)]
    text = bars(points, [(n, n + 1) for n in range(1, count + 1)], d)
    text += "".join(f"CONM2,{1000 + n},{n},,0.\n,1.-4\n" for n in range(1, count + 2))
    base = np.sqrt(E / RHO) * d / 4.0 / length**2 / (2.0 * np.pi)
    waves = [base * root**2 for root in (4.730041, 7.853205, 10.995608)]
    return text, sorted([*waves, *waves])


def plate(count: int = 16, side: float = 10.0, t: float = 0.002) -> tuple[str, list[float]]:
    """A free square plate: Leissa's frequency parameters for Poisson's ratio 0.3."""
    row = count + 1
    lines = [ALUMINIUM, f"PSHELL,1,1,{t},1,,1", "PARAM,K6ROT,100."]
    lines += [
        f"GRID,{n * row + m + 1},,{side * m / count:.6f},{side * n / count:.6f},0."
        for n in range(row)
        for m in range(row)
    ]
    for n in range(count):
        for m in range(count):
            one = n * row + m + 1
            lines.append(
                f"CQUAD4,{n * count + m + 1},1,{one},{one + 1},{one + row + 1},{one + row}"
            )
    base = np.sqrt(E * t**2 / (12.0 * (1.0 - NU**2) * RHO)) / side**2 / (2.0 * np.pi)
    return "\n".join(lines) + "\n", [base * root for root in (13.47, 19.60, 24.27, 34.80, 34.80)]


@needs_mystran
@pytest.mark.parametrize("structure", [ring, wing, plate])
def test_free_structures_of_low_frequency_keep_all_their_modes(
    structure: Callable[[], tuple[str, list[float]]], tmp_path: Path
) -> None:
    bulk, wanted = structure()
    result = solved(bulk, tmp_path, mystran_solver, n_modes=6 + len(wanted))
    assert result.n_rigid == 6
    # Meshes of this size are within 2 % (the plate's fourth), bars within 0.1 %.
    np.testing.assert_allclose(result.modes.frequencies_hz[6:], wanted, rtol=0.02)


@needs_ccx
@pytest.mark.parametrize(("lighter", "warns"), [(1.0, True), (1e4, False)])
def test_calculix_warns_of_frequencies_below_its_own_shift(
    lighter: float, warns: bool, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bulk, wanted = ring()
    light = bulk.replace("2700.", f"{RHO / lighter:.2f}")
    result = solved(light, tmp_path, translated_solver, n_modes=10)
    assert ("below 0.16 Hz" in caplog.text) == warns
    if not warns:
        assert result.n_rigid == 6
        found = result.modes.frequencies_hz[6:]
        np.testing.assert_allclose(found, np.sqrt(lighter) * np.array(wanted[:4]), rtol=0.01)
