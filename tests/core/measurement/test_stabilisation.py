"""Which poles are modes: criteria, tracks, the choice by hand; and the fit that follows."""

from __future__ import annotations

import numpy as np
import pytest

from modetune.core.correlation.correlation import mac
from modetune.core.errors import CampaignError, ModesError
from modetune.core.measurement.modal_fit import (
    fit_residues,
    mode_shares,
    refine_poles,
    shapes_and_participations,
    unexplained_peaks,
    unit_mass_factors,
)
from modetune.core.measurement.response_functions import Complexes, NormalModes, Response, modal_frf
from modetune.core.measurement.stabilisation import (
    Criteria,
    OrderPoles,
    Stability,
    follow_poles,
    judge_orders,
    physical_poles,
    pick_tracks,
)
from modetune.core.modes import Floats

SHAPES = np.array([[1.0, 1.0, 0.2], [2.0, -1.0, 0.4], [0.5, 0.3, -2.0]])


def pole(frequency_hz: float, damping: float) -> complex:
    w = 2.0 * np.pi * frequency_hz
    return complex(-damping * w, w * np.sqrt(1.0 - damping**2))


def order_of(number: int, *modes: tuple[float, float, Floats]) -> OrderPoles:
    """An order with modes (frequency, damping, shape)."""
    return OrderPoles(
        number,
        np.array([pole(f, z) for f, z, _ in modes], dtype=np.complex128),
        np.column_stack([shape for _, _, shape in modes]).astype(np.complex128),
        np.zeros(len(modes), dtype=np.int64),
    )


@pytest.mark.parametrize(
    ("frequency", "damping", "shape", "expected"),
    [  # on either side of the thesis's limits: 1 % in frequency, 5 % in damping, 2 % in MAC
        (100.9, 0.01, 0.0, Stability.STABLE),
        (101.1, 0.01, 0.0, Stability.NEW),
        (100.0, 0.0104, 0.0, Stability.STABLE),
        (100.0, 0.0106, 0.0, Stability.FREQUENCY),
        (100.0, 0.01, 0.14, Stability.STABLE),  # MAC of shapes at an angle of tan: 1/(1 + 0.14^2)
        (100.0, 0.01, 0.15, Stability.DAMPING),
    ],
)
def test_a_pole_is_stable_within_one_five_and_two_percent_of_the_order_before(
    frequency: float, damping: float, shape: float, expected: Stability
) -> None:
    first = order_of(1, (100.0, 0.01, np.array([1.0, 0.0])))
    second = order_of(2, (frequency, damping, np.array([1.0, shape])))
    judged = judge_orders([first, second], Criteria())
    assert judged[0].stability.tolist() == [Stability.NEW]
    assert judged[1].stability.tolist() == [expected]


def test_criteria_can_be_changed_and_nonsense_is_refused() -> None:
    orders = [order_of(1, (100.0, 0.01, SHAPES[:, 0])), order_of(2, (101.5, 0.01, SHAPES[:, 0]))]
    assert judge_orders(orders, Criteria(frequency=0.02))[1].stability[0] == Stability.STABLE
    with pytest.raises(CampaignError, match=r"between 0 and 1, found 1, 0\.05"):
        Criteria(frequency=1.0)


def test_only_damped_vibrations_in_the_band_are_kept_without_their_conjugates() -> None:
    wanted = [pole(20.0, 0.01), pole(30.0, 0.19)]
    given = [
        *wanted[::-1],
        pole(20.0, 0.01).conjugate(),
        pole(25.0, -0.01),
        pole(25.0, 0.3),
        pole(9.0, 0.01),
        pole(41.0, 0.01),
        complex(-100.0),
        complex(np.nan, 1.0),
    ]
    found = physical_poles(np.array(given), (10.0, 40.0), 0.2)
    assert found.tolist() == wanted


def test_two_modes_one_percent_apart_stay_two_tracks() -> None:
    """Each pole has a neighbour within 1 %; shape and damping keep them apart."""
    orders = [
        order_of(n, (60.0, 0.005, SHAPES[:, 0]), (60.6, 0.005, SHAPES[:, 1])) for n in range(1, 13)
    ]
    tracks = follow_poles(judge_orders(orders, Criteria()), Criteria())
    assert [track.frequency_hz for track in tracks] == pytest.approx([60.0, 60.6])
    assert [track.n_stable for track in tracks] == [11, 11]


def test_a_track_goes_on_over_orders_that_miss_its_mode() -> None:
    there = (1, 2, 3, 4, 7, 8, 9, 14, 15)  # two missing orders are a pause, four are one too
    orders = [
        order_of(n, (40.0, 0.01, SHAPES[:, 0]), *([(80.0, 0.01, SHAPES[:, 1])] * (n in there)))
        for n in range(1, 16)
    ]
    tracks = follow_poles(judge_orders(orders, Criteria()), Criteria())
    assert len(tracks) == 2
    # Stable are those with a pole in the order just before: 2, 3, 4, 8, 9, 15.
    assert (tracks[1].n_stable, len(tracks[1].places)) == (6, 9)


def test_wandering_poles_make_no_track_worth_choosing() -> None:
    rng = np.random.default_rng(3)
    orders = [
        order_of(
            n, (50.0, 0.01, SHAPES[:, 0]), (70.0 + rng.uniform(-9, 9), 0.05, rng.normal(size=3))
        )
        for n in range(1, 31)
    ]
    tracks = follow_poles(judge_orders(orders, Criteria()), Criteria())
    assert [t.frequency_hz for t in tracks if t.n_stable >= Criteria().enough(30)] == [
        pytest.approx(50.0)
    ]


def test_a_resonance_split_in_two_counts_once_and_the_longer_track_stays() -> None:
    split = (60.2, 0.01, SHAPES[:, 0])  # within the half-width 0.6 Hz, of the same shape
    orders = [order_of(n, (60.0, 0.01, SHAPES[:, 0]), *([split] * (n > 6))) for n in range(1, 13)]
    tracks = follow_poles(judge_orders(orders, Criteria()), Criteria())
    assert [track.frequency_hz for track in tracks] == [pytest.approx(60.0)]


def test_poles_asked_for_are_the_nearest_stable_and_others_are_named_all_at_once() -> None:
    orders = [
        order_of(n, (40.0, 0.01, SHAPES[:, 0]), (80.0, 0.01, SHAPES[:, 1])) for n in range(1, 6)
    ]
    tracks = follow_poles(judge_orders(orders, Criteria()), Criteria())
    picked = pick_tracks(tracks, [80.3, 39.9], Criteria())
    assert picked == (0, 1)
    with pytest.raises(CampaignError) as caught:
        pick_tracks(tracks, [60.0, 80.0, 80.1], Criteria())
    assert "within 1 % of 60 Hz; the nearest is at 40 Hz" in caught.value.problems[0]
    assert "at 80.0000 Hz, is asked for twice" in caught.value.problems[1]
    with pytest.raises(CampaignError, match="no pole is stable"):
        pick_tracks([], [60.0], Criteria())


def system(lines: Floats, kind: Response) -> tuple[Complexes, Complexes]:
    """Poles (3,) and functions (n_lines, 6) of three modes at three outputs and two inputs."""
    frequencies, damping = np.array([30.0, 60.0, 60.6]), np.array([0.01, 0.005, 0.006])
    modes = NormalModes((2.0 * np.pi * frequencies) ** 2, SHAPES, damping)
    values = modal_frf(lines, modes, [0, 1, 2], [0, 1], kind)
    poles = np.array([pole(f, z) for f, z in zip(frequencies, damping, strict=True)])
    return poles, values.reshape(lines.size, 6)


@pytest.mark.parametrize("kind", ["receptance", "mobility", "accelerance"])
def test_residues_and_residual_terms_come_back_from_exact_functions(kind: Response) -> None:
    """The functions come from core.frf, which superposes undamped modes with viscous damping."""
    lines = np.linspace(20.0, 80.0, 601)
    poles, values = system(lines, kind)
    s = 2j * np.pi * lines[:, None]
    # Modes above the band add a flexibility to the receptance, modes below it a mass.
    values += s ** {"receptance": 0, "mobility": 1, "accelerance": 2}[kind] * (2e-6 + 0.03 / s**2)
    fit = fit_residues(lines, values, poles, kind)
    assert np.abs(fit.synthesise(lines) - values).max() < 1e-9 * np.abs(values).max()
    expected = (SHAPES[:, None, :] * SHAPES[None, :2, :]).reshape(6, 3) / (2j * poles.imag)
    np.testing.assert_allclose(fit.residues, expected, atol=1e-9)
    np.testing.assert_allclose(fit.upper, 2e-6, rtol=1e-5)
    np.testing.assert_allclose(fit.lower, 0.03, rtol=1e-5)


@pytest.mark.parametrize("kind", ["receptance", "accelerance"])
def test_refinement_takes_biased_poles_to_the_true_ones(kind: Response) -> None:
    """Bias as the linear estimator has it: 0.03 % in frequency, 25 % in damping."""
    lines = np.linspace(20.0, 80.0, 601)
    poles, values = system(lines, kind)
    biased = 0.75 * poles.real + 1.0003j * poles.imag
    found = refine_poles(lines, values / np.abs(values).max(axis=0), biased, kind)
    np.testing.assert_allclose(found, poles, rtol=1e-8)


def test_refinement_leaves_a_pole_that_noise_would_take_away() -> None:
    lines = np.linspace(20.0, 80.0, 601)
    poles, values = system(lines, "accelerance")
    far = pole(75.0, 0.001)  # nothing vibrates there
    rng = np.random.default_rng(0)
    noisy = values + 1e-3 * np.abs(values).max() * rng.normal(size=(601, 6))
    found = refine_poles(lines, noisy, np.append(poles, far), "accelerance")
    assert abs(found[3] - far) <= 0.002 * abs(far)
    assert found.real.max() < 0.0


def test_the_share_of_a_mode_tells_resonance_from_nothing() -> None:
    lines = np.linspace(20.0, 80.0, 601)
    poles, values = system(lines, "accelerance")
    shares = mode_shares(lines, values, np.append(poles, pole(45.0, 0.01)), "accelerance")
    assert shares[0] > 0.95  # it stands alone
    assert shares[1:3].min() > 0.2  # a pair, each of which makes up for part of the other
    assert shares[3] < 1e-6  # exact functions leave nothing to a mode that is not there


def test_a_pole_out_of_the_band_has_no_share() -> None:
    lines = np.linspace(20.0, 80.0, 601)
    poles, values = system(lines, "accelerance")
    assert mode_shares(lines, values, np.append(poles, pole(95.0, 0.01)), "accelerance")[3] == 0.0


def test_a_pole_at_an_end_of_the_band_must_matter_more() -> None:
    wanted = Criteria().wanted_shares(np.array([10.5, 50.0, 99.0]), (10.0, 100.0))
    assert wanted.tolist() == [0.3, 0.05, 0.3]


def test_fewer_numbers_than_unknowns_are_refused() -> None:
    lines = np.array([20.0, 21.0])
    poles, values = system(lines, "mobility")
    with pytest.raises(ModesError, match="2 lines do not determine 3 modes"):
        fit_residues(lines, values, poles, "mobility")


def test_a_residue_matrix_with_holes_gives_shape_and_participation() -> None:
    rows, columns = np.array([0, 1, 1, 2, 3, 3]), np.array([0, 0, 1, 1, 1, 1])  # one twice
    u, v = np.array([1.0, 2.0, -1.0, 0.5 + 0.1j]), np.array([1.5, -0.7])
    found_u, found_v = shapes_and_participations((u[rows] * v[columns])[:, None], rows, columns)
    assert mac(found_u, u[:, None])[0, 0] == pytest.approx(1.0)
    assert mac(found_v, v[:, None])[0, 0] == pytest.approx(1.0)
    np.testing.assert_allclose(found_u[rows, 0] * found_v[columns, 0], u[rows] * v[columns])


def test_a_row_that_nothing_connects_stays_zero() -> None:
    rows, columns = np.array([0, 1, 2]), np.array([0, 0, 1])
    u, _ = shapes_and_participations(np.ones((3, 1), dtype=np.complex128), rows, columns)
    assert (np.abs(u[:, 0]) > 0.0).tolist() == [True, True, False]


def test_a_driving_point_gives_unit_modal_mass() -> None:
    """A = phi phi / 2 i w_d for phi of unit modal mass (Ewins 2000, 2.6)."""
    poles, phi = np.array([pole(30.0, 0.01)]), np.array([[0.4], [-0.9]])
    a = (phi[:, 0] * phi[1, 0] / (2j * poles.imag)).reshape(-1, 1)  # driven at the second
    u, v = shapes_and_participations(a, np.array([0, 1]), np.array([0, 0]))
    found = u * unit_mass_factors(u[[1]], v[[0]], poles)
    np.testing.assert_allclose(np.abs(found), np.abs(phi), rtol=1e-12)
    rests = unit_mass_factors(np.zeros((1, 1), dtype=np.complex128), v, poles)
    assert rests.tolist() == [1.0]


def test_a_peak_that_the_modes_lack_is_named_and_noise_is_not() -> None:
    lines = np.linspace(20.0, 80.0, 601)
    poles, values = system(lines, "accelerance")
    rng = np.random.default_rng(1)
    noise = rng.normal(size=values.shape) + 1j * rng.normal(size=values.shape)
    noisy = values + 0.01 * np.abs(values).mean() * noise
    whole = fit_residues(lines, noisy, poles, "accelerance").synthesise(lines)
    assert unexplained_peaks(lines, noisy, whole) == ()
    lacking = fit_residues(lines, noisy, poles[1:], "accelerance").synthesise(lines)
    peaks = unexplained_peaks(lines, noisy, lacking)
    assert any(peak == pytest.approx(30.0, abs=0.3) for peak in peaks)
