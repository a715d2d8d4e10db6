"""Laying a test over a model: closed forms, laws, symmetric structures, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from modetune.core.errors import ModesError
from modetune.core.measurement.registration import Alignment, fit_similarity
from modetune.core.modes import Floats

angles = st.tuples(*[st.floats(-180.0, 180.0)] * 3)
shifts = st.tuples(*[st.floats(-100.0, 100.0)] * 3)
scales = st.floats(1e-3, 1e3)

#: A bracket without any symmetry, metres: three legs of different length, a lug on one.
CORNERS = np.array(
    [(0, 0, 0), (2.0, 0, 0), (0, 1.2, 0), (0, 0, 0.7), (2.0, 0.3, 0), (1.0, 0, 0.2), (0, 1.2, 0.3)]
)


def turned(degrees: tuple[float, ...]) -> Floats:
    return np.asarray(Rotation.from_euler("xyz", degrees, degrees=True).as_matrix())


def angle(first: Floats, second: Floats) -> float:
    """Degrees between two rotations."""
    return float(np.degrees(Rotation.from_matrix(first @ second.T).magnitude()))


def grid(x: Floats, y: Floats, z: float = 0.0) -> Floats:
    return np.array([(a, b, z) for a in x for b in y])


@given(angles, shifts, scales)
def test_a_turned_scaled_and_shifted_cloud_is_found_exactly(
    degrees: tuple[float, ...], shift: tuple[float, ...], scale: float
) -> None:
    targets = scale * CORNERS @ turned(degrees).T + np.array(shift)
    found = fit_similarity(CORNERS, targets)
    size = scale * 2.0 + np.abs(shift).max()  # rounding goes with the largest number
    assert found.scale == pytest.approx(scale, rel=1e-9 * size / scale)
    np.testing.assert_allclose(found.rotation, turned(degrees), atol=1e-9 * size / scale)
    np.testing.assert_allclose(found.apply(CORNERS), targets, atol=1e-9 * size)
    assert found.largest <= 1e-9 * size
    assert found.notes == ()


@given(angles)
def test_points_in_a_plane_are_never_mirrored(degrees: tuple[float, ...]) -> None:
    plate = grid(np.linspace(0, 2, 4), np.array([0.0, 0.3, 1.0]))
    found = fit_similarity(plate, plate @ turned(degrees).T)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    np.testing.assert_allclose(found.rotation, turned(degrees), atol=1e-9)


def test_a_known_scale_is_kept() -> None:
    found = fit_similarity(CORNERS, 1020.0 * CORNERS, scale=1000.0)
    assert found.scale == 1000.0
    np.testing.assert_allclose(found.rotation, np.eye(3), atol=1e-12)
    # What stays is 20 mm a metre about the middle.
    expected = 20.0 * np.linalg.norm(CORNERS - CORNERS.mean(axis=0), axis=1)
    np.testing.assert_allclose(found.residuals, expected, rtol=1e-9)
    assert found.largest == pytest.approx(expected.max())


def test_noise_leaves_its_own_root_mean_square() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-1.0, 1.0, (4000, 3))
    targets = points @ turned((20, -50, 130)).T + rng.normal(0.0, 0.01, points.shape)
    found = fit_similarity(points, targets)
    # Three coordinates with sigma 0.01 each: sqrt(3) 0.01, whose own spread is 1/sqrt(24000).
    assert found.rms == pytest.approx(np.sqrt(3.0) * 0.01, rel=0.03)
    assert angle(found.rotation, turned((20, -50, 130))) < 0.05


def test_the_fit_is_the_best_of_its_neighbours() -> None:
    rng = np.random.default_rng(8)
    targets = CORNERS @ turned((10, 20, 30)).T + rng.normal(0.0, 0.05, CORNERS.shape)
    found = fit_similarity(CORNERS, targets)
    least = np.sum(found.residuals**2)
    for _ in range(50):
        tilt = Rotation.from_rotvec(rng.normal(0.0, 0.02, 3)).as_matrix()
        other = Alignment(
            found.scale * (1.0 + rng.normal(0.0, 0.02)),
            tilt @ found.rotation,
            found.translation + rng.normal(0.0, 0.02, 3),
        )
        assert np.sum((other.apply(CORNERS) - targets) ** 2) > least


def test_a_mirrored_test_is_told_and_not_mirrored_back() -> None:
    found = fit_similarity(CORNERS * np.array([1.0, 1.0, -1.0]), CORNERS)
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)
    assert "mirror image" in found.notes[0]


@pytest.mark.parametrize("points", [CORNERS[:2], CORNERS[:0]])
def test_fewer_than_three_points_are_refused(points: Floats) -> None:
    with pytest.raises(ModesError, match=f"are {len(points)}; a fit takes three or more"):
        fit_similarity(points, points)


def test_points_on_a_line_are_refused() -> None:
    line = np.linspace(0, 1, 7)[:, None] * np.array([1.0, 2.0, 3.0])
    with pytest.raises(ModesError, match=r"one line.*cannot be fitted"):
        fit_similarity(line, line)


def test_three_times_the_same_point_is_refused() -> None:
    with pytest.raises(ModesError, match="one line"):
        fit_similarity(np.ones((3, 3)), CORNERS[:3])


def test_points_and_partners_must_be_as_many() -> None:
    with pytest.raises(ModesError, match="3 points cannot be fitted to 4 partners"):
        fit_similarity(CORNERS[:3], CORNERS[:4])


def test_a_given_alignment_has_no_residual() -> None:
    given_one = Alignment(2.0, turned((0, 0, 90)), np.array([1.0, 0.0, 0.0]))
    # x goes to y, twice as far, and one along x.
    np.testing.assert_allclose(
        given_one.apply(np.array([[1.0, 0, 0]])), [[1.0, 2.0, 0]], atol=1e-12
    )
    np.testing.assert_allclose(given_one.turn(np.array([1.0, 0, 0])), [0, 1, 0], atol=1e-12)
    assert (given_one.rms, given_one.largest) == (0.0, 0.0)
