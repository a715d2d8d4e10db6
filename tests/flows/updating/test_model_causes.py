"""An update that fails, or suspects its model, names what is wrong with model or test.

Four structures of NumPy matrices that no other test has: a tapered tower (plane frame), a ring
(plane frame, free), a truss bridge, and a stiffened panel (grillage, free). The tests are those of
a changed structure: with a mass, other supports, or in other units.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigh

import modetune
from modetune.core.errors import ModesError
from modetune.core.modes import Floats
from modetune.core.updating.trust import trust_sentences

#: Deviation of measured frequencies and of shapes, relative.
FREQUENCY, SHAPE = 0.002, 0.02


@dataclass(frozen=True)
class Structure:
    """Parts of the stiffness, the mass, names of the unknowns, held unknowns of the model, sensors,
    and held unknowns of the same structure with other supports."""

    parts: tuple[Floats, ...]
    mass: Floats
    dofs: tuple[str, ...]
    held: tuple[int, ...]
    sensors: tuple[int, ...]
    other_supports: tuple[int, ...]

    def modes(self, n: int, held: Sequence[int] | None = None) -> tuple[Floats, Floats]:
        """Elastic frequencies and mass-normalised shapes (all unknowns) for true values."""
        free = np.setdiff1d(np.arange(len(self.dofs)), self.held if held is None else held)
        stiffness = sum((k * v for k, v in zip(self.parts, TRUTH, strict=True)), 0.0 * self.mass)
        values, vectors = eigh(stiffness[np.ix_(free, free)], self.mass[np.ix_(free, free)])
        elastic = np.flatnonzero(values > 1e-6 * values[6])[:n]
        shapes = np.zeros((len(self.dofs), n))
        shapes[free] = vectors[:, elastic]
        return np.sqrt(values[elastic]) / (2.0 * np.pi), shapes

    def heavier(self, unknowns: Sequence[int], mass: float) -> Structure:
        changed = self.mass.copy()
        changed[list(unknowns), list(unknowns)] += mass
        return replace(self, mass=changed)


#: True factors on the parts.
TRUTH = (1.06, 0.95)


def bar(axial: float, bending: float, length: float) -> Floats:
    """Stiffness of a plane frame element, (6, 6): x, y, rz at both ends."""
    k = np.zeros((6, 6))
    k[np.ix_([0, 3], [0, 3])] = axial / length * np.array([[1.0, -1.0], [-1.0, 1.0]])
    b, n = bending / length**3, length
    k[np.ix_([1, 2, 4, 5], [1, 2, 4, 5])] = b * np.array(
        [
            [12.0, 6 * n, -12.0, 6 * n],
            [6 * n, 4 * n * n, -6 * n, 2 * n * n],
            [-12.0, -6 * n, 12.0, -6 * n],
            [6 * n, 2 * n * n, -6 * n, 4 * n * n],
        ]
    )
    return k


def frame(
    places: Floats, bars: Sequence[tuple[int, int, float, float, float]], part: Callable[[int], int]
) -> tuple[tuple[Floats, ...], Floats]:
    """Two parts of a plane frame's stiffness and its lumped mass.

    bars: nodes, EA, EI and mass per length; part: of a bar by its number.
    """
    n = 3 * len(places)
    parts, mass = (np.zeros((n, n)), np.zeros((n, n))), np.zeros((n, n))
    for number, (a, b, axial, bending, density) in enumerate(bars):
        way = places[b] - places[a]
        length = float(np.linalg.norm(way))
        c, s = way / length
        turn = np.kron(np.eye(2), np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]))
        own = [3 * a, 3 * a + 1, 3 * a + 2, 3 * b, 3 * b + 1, 3 * b + 2]
        parts[part(number)][np.ix_(own, own)] += turn.T @ bar(axial, bending, length) @ turn
        half = 0.5 * density * length
        mass[own, own] += half * np.array([1.0, 1.0, length**2 / 12.0] * 2)
    return parts, mass


def names(n: int) -> tuple[str, ...]:
    return tuple(f"{node}.{way}" for node in range(1, n + 1) for way in ("x", "y", "rz"))


def tower(axial: float = 6e11) -> Structure:
    """Sixteen elements, clamped, half as wide at the top; measured across."""
    n = 17
    places = np.column_stack([np.zeros(n), np.linspace(0.0, 40.0, n)])
    widths = np.linspace(2.0, 1.0, n - 1)
    bars = [(i, i + 1, axial * w, 2e9 * w**3, 800.0 * w) for i, w in enumerate(widths.tolist())]
    parts, mass = frame(places, bars, lambda number: number // 8)
    across = tuple(3 * i for i in range(1, n))
    return Structure(parts, mass, names(n), (0, 1, 2), across, ())


def ring() -> Structure:
    """Twenty-four elements, free in its plane; one quarter is another part; measured in x and y."""
    n = 24
    angles = 2.0 * np.pi * np.arange(n) / n
    places = 1.5 * np.column_stack([np.cos(angles), np.sin(angles)])
    bars = [
        (i, (i + 1) % n, 6e7, 4e3 * (1.0 + 0.3 * (i < 7)), 12.0 * (1.0 + 0.2 * (i < 10)))
        for i in range(n)
    ]
    parts, mass = frame(places, bars, lambda number: int(number >= 9))
    both = tuple(3 * i + way for i in range(n) for way in (0, 1))
    return Structure(parts, mass, names(n), (), both, (0, 1, 2, 36, 37, 38))


def bridge() -> Structure:
    """A Warren truss of ten bays, on a fixed and a sliding bearing; chords and diagonals."""
    bays = 10
    lower = [(4.0 * i, 0.0) for i in range(bays + 1)]
    upper = [(4.0 * i + 2.0, 3.0) for i in range(bays)]
    places = np.array(lower + upper)
    up = bays + 1
    chords = [(i, i + 1) for i in range(bays)] + [(up + i, up + i + 1) for i in range(bays - 1)]
    diagonals = [(i, up + i) for i in range(bays)] + [(up + i, i + 1) for i in range(bays)]
    bars = [(a, b, 1.2e9, 5e7, 150.0) for a, b in chords]
    bars += [(a, b, 0.6e9, 3e7, 80.0) for a, b in diagonals]
    parts, mass = frame(places, bars, lambda number: int(number >= len(chords)))
    both = tuple(3 * i + way for i in range(len(places)) for way in (0, 1))
    return Structure(parts, mass, names(len(places)), (0, 1, 3 * bays + 1), both, ())


def panel() -> Structure:
    """A grillage of seven by five nodes, free, with stiffer beams along x; measured across."""
    nx, ny, a = 7, 5, 0.15
    n = 3 * nx * ny
    parts, mass = (np.zeros((n, n)), np.zeros((n, n))), np.zeros((n, n))
    for j in range(ny):
        for i in range(nx):
            here = j * nx + i
            mass[3 * here, 3 * here] = 0.4 + 0.1 * (j in (1, 3)) + 0.02 * i + 0.03 * j
            mass[3 * here + 1, 3 * here + 1] = mass[3 * here + 2, 3 * here + 2] = 1e-4
            for along, there in ((0, here + 1), (1, here + nx)):
                if (i == nx - 1, j == ny - 1)[along]:
                    continue
                bending = (300.0 * (1.0 + 2.0 * (j in (1, 3))), 180.0)[along]
                k = bar(60.0, bending, a)
                # z, rotation about the own axis (torsion), rotation across: slope is -ry, rx.
                own = [3 * here, 3 * here + 1 + along, 3 * here + 2 - along]
                own += [3 * there, 3 * there + 1 + along, 3 * there + 2 - along]
                order = [1, 0, 2, 4, 3, 5]  # of bar: deflection, axial as torsion, slope
                sign = np.diag([1.0, 1.0, (-1.0, 1.0)[along]] * 2)
                parts[along][np.ix_(own, own)] += sign @ k[np.ix_(order, order)] @ sign
    dofs = tuple(f"{node}.{way}" for node in range(1, nx * ny + 1) for way in ("z", "rx", "ry"))
    clamped = tuple(3 * j * nx + way for j in range(ny) for way in range(3))
    return Structure(parts, mass, dofs, (), tuple(range(0, n, 3)), clamped)


def updated(
    folder: Path,
    model: Structure,
    hz: Floats,
    shapes: Floats | None,
    sensors: Sequence[int] | None = None,
    **test: Any,
) -> str:
    """What an update of the model says: its refusal, or why it is not to be trusted."""
    free = np.setdiff1d(np.arange(len(model.dofs)), model.held)
    rng = np.random.default_rng(3)
    hz = hz * (1.0 + FREQUENCY * rng.normal(size=hz.size))
    seen = np.array([row for row in sensors or model.sensors if row in free])
    measured: dict[str, Any] = {"frequencies_hz": hz}
    if shapes is not None:
        own = shapes[seen]
        size = SHAPE * np.sqrt(np.mean(own**2, axis=0))
        measured |= {
            "mode_shapes": own + size * rng.normal(size=own.shape),
            "dofs": [model.dofs[row] for row in seen],
        }
    cut = np.ix_(free, free)
    campaign = modetune.load(
        {
            "name": "cause",
            "model": {
                "stiffness": sum(model.parts, 0.0 * model.mass)[cut],
                "mass": model.mass[cut],
                "parts": {f"k{n}": {"stiffness": k[cut]} for n, k in enumerate(model.parts)},
                "dofs": [model.dofs[row] for row in free],
            },
            "test": measured | test,
            "parameters": [
                {"name": name, "quantity": "matrix_factor", "part": name, "bounds": [0.7, 1.4]}
                for name in ("k0", "k1")
            ],
            "residuals": {"shape_weight": 1.0, "frequency_deviation": FREQUENCY,
                          "shape_deviation": SHAPE} if shapes is not None
            else {"frequency_deviation": FREQUENCY},
            "update": {"starts": 1},
            "report": {"page": False},
            "store": str(folder / "store"),
        },
        folder=folder / "campaign",
    )  # fmt: skip
    try:
        record = modetune.update(campaign, folder / "runs").record
    except ModesError as refusal:
        return str(refusal)
    assert record.trust is not None
    return " ".join(s for s in trust_sentences(record.trust) if "possible cause" in s)


STRUCTURES = [tower, ring, bridge, panel]


@pytest.mark.parametrize("make", STRUCTURES)
def test_a_sound_test_has_no_cause(tmp_path: Path, make: Callable[[], Structure]) -> None:
    model = make()
    assert updated(tmp_path, model, *model.modes(7)) == ""
    assert updated(tmp_path / "hz", model, model.modes(7)[0], None) == ""


def test_a_sound_test_without_some_modes_has_no_cause(tmp_path: Path) -> None:
    model = panel()
    hz, shapes = model.modes(7)
    kept = [0, 1, 3, 4, 5, 6]
    assert updated(tmp_path, model, hz[kept], shapes[:, kept]) == ""


@pytest.mark.parametrize("with_shapes", [True, False])
@pytest.mark.parametrize(
    ("make", "node", "share"), [(tower, 7, 0.05), (bridge, 7, 0.05), (panel, 4, 0.05)]
)
def test_a_missing_mass_is_named_with_its_node_and_size(
    tmp_path: Path, make: Callable[[], Structure], node: int, share: float, with_shapes: bool
) -> None:
    model = make()
    ways = [row for row, name in enumerate(model.dofs) if name in _translations(node)]
    mass = share * float(np.trace(model.mass[::3, ::3]))
    hz, shapes = model.heavier(ways, mass).modes(8)
    text = updated(tmp_path, model, hz, shapes if with_shapes else None)
    assert f"more at node {node}, or one that moves alike, would explain" in text
    assert "`quantity: mass`" in text
    found = float(text.split("a lumped mass of ")[1].split()[0])
    assert found == pytest.approx(mass, rel=0.2)  # of a few modes, with noise


def _translations(node: int) -> list[str]:
    return [f"{node}.{way}" for way in "xyz"]


@pytest.mark.parametrize("make", STRUCTURES)
def test_a_free_model_of_a_held_structure_is_named(
    tmp_path: Path, make: Callable[[], Structure]
) -> None:
    model = make()
    measured = model.modes(7, model.held or model.other_supports)
    text = updated(tmp_path, replace(model, held=()), *measured)
    assert "the model is free where the tested structure seems held" in text
    assert "compare the supports in `model.deck`" in text


@pytest.mark.parametrize("make", [tower, ring, bridge])
def test_a_held_model_of_a_free_structure_is_named(
    tmp_path: Path, make: Callable[[], Structure]
) -> None:
    model = make()
    model = replace(model, held=model.held or model.other_supports)
    text = updated(tmp_path, model, *model.modes(7, ()))
    assert "the model is held where the tested structure seems free" in text


@pytest.mark.parametrize("make", [ring, panel])
def test_a_mode_of_the_suspension_is_named(tmp_path: Path, make: Callable[[], Structure]) -> None:
    model = make()
    hz, shapes = model.modes(6)
    way = model.dofs[0].split(".")[1]
    rigid = np.array([1.0 if name.endswith(f".{way}") else 0.0 for name in model.dofs])
    hz, shapes = np.insert(hz, 0, 0.2 * hz[0]), np.column_stack([rigid, shapes])
    text = updated(tmp_path, model, hz, shapes)
    assert "test mode 1: a rigid-body motion at" in text
    assert "leave it out with `test.use`" in text


@pytest.mark.parametrize("make", [tower, ring, bridge])
@pytest.mark.parametrize("with_shapes", [True, False])
@pytest.mark.parametrize(
    ("factor", "reason"),
    [(1e-3, "frequencies in kHz"), (1e3, "mm in place of m"), (19.65, "PARAM,WTMASS")],
)
def test_a_wrong_unit_is_named(
    tmp_path: Path,
    make: Callable[[], Structure],
    with_shapes: bool,
    factor: float,
    reason: str,
) -> None:
    model = make()
    hz, shapes = model.modes(6)
    text = updated(tmp_path, model, factor * hz, shapes if with_shapes else None)
    assert text.startswith("all measured frequencies are about")
    assert reason in text
    assert "(`model.units`)" in text


@pytest.mark.parametrize("make", [tower, ring, panel])
@pytest.mark.parametrize("with_shapes", [True, False])
def test_a_common_factor_beyond_the_bounds_is_named(
    tmp_path: Path, make: Callable[[], Structure], with_shapes: bool
) -> None:
    model = make()
    hz, shapes = model.modes(6)
    text = updated(tmp_path, model, 1.9 * hz, shapes if with_shapes else None)
    assert "stiffness over mass is off by a factor of" in text
    assert "widen the `bounds`" in text


@pytest.mark.parametrize("make", [tower, bridge])
def test_a_mode_that_the_test_lacks_is_named_by_frequencies_alone(
    tmp_path: Path, make: Callable[[], Structure]
) -> None:
    model = make()
    hz, _ = model.modes(7)
    text = updated(tmp_path, model, np.delete(hz, 2), None)
    assert "if the test lacks the model's elastic mode 3" in text
    named = {3: 4, 4: 5, 5: 6, 6: 7}
    assert f"`test.pairs: {named}` pairs them so" in text
    assert updated(tmp_path / "named", model, np.delete(hz, 2), None, pairs=named) == ""


@pytest.mark.parametrize("with_shapes", [True, False])
@pytest.mark.parametrize("make", [tower, bridge, panel])
def test_a_mode_that_the_model_lacks_is_named(
    tmp_path: Path, make: Callable[[], Structure], with_shapes: bool
) -> None:
    model = make()
    hz, shapes = model.modes(7)
    size = np.abs(shapes[:, 3]).max()
    other = size * np.random.default_rng(0).normal(size=len(shapes))
    hz, shapes = np.insert(hz, 3, 0.5 * (hz[2] + hz[3])), np.insert(shapes, 3, other, axis=1)
    text = updated(tmp_path, model, hz, shapes if with_shapes else None)
    if with_shapes:
        assert "test mode 4 (" in text
        assert "the model has no such mode, though it has 7 of the test's 8" in text
    else:
        assert "if the model lacks test mode 4" in text


def soft_tower() -> Structure:
    """A tower whose first axial mode lies among the bending modes; the sensors look across."""
    return tower(axial=6e10)


def panel_along_its_middle() -> Structure:
    """Sensors on the middle beam: they do not see modes that turn about it."""
    model = panel()
    return replace(model, sensors=tuple(range(3 * 14, 3 * 21, 3)))


@pytest.mark.parametrize(("make", "mode"), [(soft_tower, 6), (panel_along_its_middle, 0)])
def test_a_mode_that_the_sensors_do_not_see_is_named(
    tmp_path: Path, make: Callable[[], Structure], mode: int
) -> None:
    """The test has the frequency, from another sensor, and noise for a shape."""
    model = make()
    hz, shapes = model.modes(7 if mode else 4)
    seen = shapes.copy()
    seen[list(model.sensors), mode] = 1e-3 * (-1.0) ** np.arange(len(model.sensors))
    text = updated(tmp_path, model, hz, seen)
    assert f"test mode {mode + 1} (" in text
    assert "which the sensors hardly see" in text
    assert "`test.unmatched: drop`" in text
