"""An update that its test cannot satisfy names what is wrong with the test, and the key for it.

Three structures of NumPy matrices that no other test has: a cantilever beam in bending, condensed
to its deflections; a net of masses on cords that move across it; a tree of masses in two
directions.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigh

import modetune
from modetune.core.errors import ModesError
from modetune.core.modes import Floats
from modetune.core.updating.trust import trust_sentences
from modetune.flows.updating.record import CampaignRun

Model = tuple[list[Floats], Floats, list[str], list[float]]


def beam() -> Model:
    """Twelve elements; parts: the half at the clamp and the half at the tip."""
    n, length = 12, 0.1
    element = np.array(
        [
            [12.0, 6 * length, -12.0, 6 * length],
            [6 * length, 4 * length**2, -6 * length, 2 * length**2],
            [-12.0, -6 * length, 12.0, -6 * length],
            [6 * length, 2 * length**2, -6 * length, 4 * length**2],
        ]
    ) * (2.0e3 / length**3)
    halves = [np.zeros((2 * n + 2, 2 * n + 2)) for _ in range(2)]
    for number in range(n):
        own = slice(2 * number, 2 * number + 4)
        halves[number * 2 // n][own, own] += element
    mass = np.zeros((2 * n + 2, 2 * n + 2))
    mass[np.arange(0, 2 * n + 2, 2), np.arange(0, 2 * n + 2, 2)] = 0.8
    mass[np.arange(1, 2 * n + 2, 2), np.arange(1, 2 * n + 2, 2)] = 1e-5
    free = np.arange(2, 2 * n + 2)
    dofs = [f"{node}.{way}" for node in range(1, n + 1) for way in ("z", "ry")]
    return (
        [half[np.ix_(free, free)] for half in halves],
        mass[np.ix_(free, free)],
        dofs,
        [0.85, 1.2],
    )


def net() -> Model:
    """Four by five masses between walls; parts: cords along x and along y."""
    nx, ny = 4, 5
    cords = [
        np.kron(np.eye(ny), 2.0 * np.eye(nx) - np.eye(nx, k=1) - np.eye(nx, k=-1)) * 900.0,
        np.kron(2.0 * np.eye(ny) - np.eye(ny, k=1) - np.eye(ny, k=-1), np.eye(nx)) * 500.0,
    ]
    mass = np.diag(np.linspace(0.7, 1.6, nx * ny))
    return cords, mass, [f"{node}.z" for node in range(1, nx * ny + 1)], [1.15, 0.9]


def tree() -> Model:
    """A trunk of six masses and a branch of five, in x and y; parts: both directions."""
    parents = [None, 0, 1, 2, 3, 4, 2, 6, 7, 8, 9]
    n = len(parents)
    sides = [np.zeros((2 * n, 2 * n)) for _ in range(2)]
    for axis, stiffness in enumerate((4.0e3, 1.5e3)):
        for node, parent in enumerate(parents):
            ends = [2 * node + axis] + ([] if parent is None else [2 * parent + axis])
            signs = np.array([1.0, -1.0])[: len(ends)]
            sides[axis][np.ix_(ends, ends)] += (
                stiffness * (1.0 + 0.07 * node) * np.outer(signs, signs)
            )
    dofs = [f"{node}.{way}" for node in range(1, n + 1) for way in "xy"]
    return sides, np.diag(np.linspace(1.0, 2.0, 2 * n)), dofs, [1.2, 0.85]


MODELS: list[Callable[[], Model]] = [beam, net, tree]


def updated(folder: Path, model: Model, spoil: Callable[..., Any], **test: Any) -> CampaignRun:
    """Update from the true model's modes, with noise, after `spoil` has changed them."""
    parts, mass, dofs, truth = model
    stiffness = sum((k * value for k, value in zip(parts, truth, strict=True)), 0.0 * mass)
    values, shapes = eigh(stiffness, mass)
    rows = [row for row, name in enumerate(dofs) if ".r" not in name]
    rng, n_modes = np.random.default_rng(9), 6
    hz = np.sqrt(values[:n_modes]) / (2.0 * np.pi) * (1.0 + 0.002 * rng.normal(size=n_modes))
    seen = shapes[np.ix_(rows, range(n_modes))]
    seen = seen + 0.03 * np.sqrt(np.mean(seen**2, axis=0)) * rng.normal(size=seen.shape)
    names = [dofs[row] for row in rows]
    hz, seen = spoil(hz, seen)
    campaign = modetune.load(
        {
            "name": "spoilt",
            "model": {
                "stiffness": sum(parts, 0.0 * mass),
                "mass": mass,
                "parts": {f"k{n}": {"stiffness": k} for n, k in enumerate(parts)},
                "dofs": dofs,
            },
            "test": {"frequencies_hz": hz, "mode_shapes": seen, "dofs": names, **test},
            "parameters": [
                {"name": f"k{n}", "quantity": "matrix_factor", "part": f"k{n}", "bounds": [0.5, 2]}
                for n in range(len(parts))
            ],
            "residuals": {
                "shape_weight": 1.0, "frequency_deviation": 0.002, "shape_deviation": 0.03,
            },
            "update": {"starts": 1},
            "report": {"page": False},
            "store": str(folder / "store"),
        },
        folder=folder / "campaign",
    )  # fmt: skip
    return modetune.update(campaign, folder / "runs")


def causes(run: CampaignRun) -> list[str]:
    assert run.record.trust is not None
    return [text for text in trust_sentences(run.record.trust) if "A possible cause" in text]


@pytest.mark.parametrize("model", MODELS)
def test_frequencies_in_rad_per_second_are_named_before_more_modes_are_solved(
    tmp_path: Path, model: Callable[[], Model]
) -> None:
    with pytest.raises(ModesError, match=r"^[^.]*all measured frequencies .* in rad/s; check the"):
        updated(tmp_path, model(), lambda hz, seen: (2.0 * np.pi * hz, seen))


@pytest.mark.parametrize("model", MODELS)
def test_a_reversed_sensor_is_named_with_the_key_that_corrects_it(
    tmp_path: Path, model: Callable[[], Model]
) -> None:
    made = model()
    name = [dof for dof in made[2] if ".r" not in dof][4]

    def reverse(hz: Floats, seen: Floats) -> tuple[Floats, Floats]:
        signs = np.ones(len(seen))
        signs[4] = -1.0
        return hz, signs[:, None] * seen

    (cause,) = causes(updated(tmp_path / "spoilt", made, reverse))
    assert f"sensor {name}: reversed?" in cause
    assert f"`test.sensors.reverse: [{name}]`" in cause
    corrected = updated(tmp_path / "good", made, reverse, sensors={"reverse": [name]})
    assert causes(corrected) == []
    errors = np.abs(corrected.record.updated - made[3]) / corrected.record.standard_errors
    assert (errors < 4.0).all()


@pytest.mark.parametrize("model", MODELS)
def test_exchanged_sensors_are_named_with_the_key_that_corrects_them(
    tmp_path: Path, model: Callable[[], Model]
) -> None:
    made = model()
    names = [dof for dof in made[2] if ".r" not in dof]

    def exchange(hz: Floats, seen: Floats) -> tuple[Floats, Floats]:
        order = np.arange(len(seen))
        order[[2, 7]] = order[[7, 2]]
        return hz, seen[order]

    try:
        (cause,) = causes(updated(tmp_path / "spoilt", made, exchange))
    except ModesError as refusal:  # the beam's fourth mode has no partner then
        cause = str(refusal)
    pair = f"[{names[2]}, {names[7]}]"
    assert f"`test.sensors.exchange: [{pair}]`" in cause
    corrected = updated(tmp_path / "good", made, exchange, sensors={"exchange": [names[2:8:5]]})
    assert causes(corrected) == []


@pytest.mark.parametrize("model", MODELS)
def test_a_good_test_has_no_cause(tmp_path: Path, model: Callable[[], Model]) -> None:
    run = updated(tmp_path, model(), lambda hz, seen: (hz, seen))
    assert causes(run) == []
    assert run.record.trust is not None
    assert run.record.trust.times_noise == 0.0
