"""Places of sensors and exciters: closed forms of beams, determinant identities, all subsets."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from modetune.core.errors import CampaignError, ModesError
from modetune.core.modes import Floats, Integers
from modetune.core.planning import exciter_placement, sensor_placement
from modetune.core.planning.exciter_placement import (
    choose_exciters,
    choose_suspension,
    participation,
    rigid_mass,
)
from modetune.core.planning.sensor_placement import (
    Spacing,
    by_auto_mac,
    by_effective_independence,
    by_information,
    by_kinetic_energy,
    eliminate,
    independence,
    judge,
    kinetic_energies,
    loud,
    needed_sensors,
    order_of_use,
    parameter_information,
    unit_modes,
    with_modes,
)

#: Roots of cos(a) cosh(a) = -1 and +1 (Blevins 1979, table 8-1): cantilever, free beam.
CANTILEVER = (1.87510407, 4.69409113, 7.85475744, 10.99554073)
FREE = (4.73004074, 7.85320462, 10.99560784)


def cantilever(x: Floats, n_modes: int) -> Floats:
    """Bending shapes of a cantilever of length 1 at x, (n, 1, n_modes)."""
    shapes = []
    for root in CANTILEVER[:n_modes]:
        ratio = (np.sinh(root) - np.sin(root)) / (np.cosh(root) + np.cos(root))
        z = root * x
        shapes.append(np.cosh(z) - np.cos(z) - ratio * (np.sinh(z) - np.sin(z)))
    return np.asarray(np.stack(shapes, axis=1)[:, None, :])


def supported(x: Floats, n_modes: int) -> Floats:
    """Shapes sin(k pi x) of a beam on two supports, (n, 1, n_modes)."""
    shapes = [np.sin(k * np.pi * x) for k in range(1, n_modes + 1)]
    return np.asarray(np.stack(shapes, axis=1)[:, None, :])


def along(x: Floats, distance: float = 0.0) -> Spacing:
    """Candidates on a line, each a node of its own."""
    places = np.column_stack([x, np.zeros((x.size, 2))])
    return Spacing(np.arange(1, x.size + 1), places, distance)


def anywhere(n: int) -> Spacing:
    return along(np.arange(float(n)))


def random_rows(seed: int, n: int, n_directions: int, n_modes: int) -> Floats:
    return np.random.default_rng(seed).standard_normal((n, n_directions, n_modes))


def determinant(rows: Floats, chosen: Integers | tuple[int, ...]) -> float:
    flat = rows[list(chosen)].reshape(-1, rows.shape[2])
    return float(np.linalg.det(flat.T @ flat))


# effective independence


def test_independence_is_the_diagonal_of_the_projector_and_adds_up_to_the_modes() -> None:
    rows = random_rows(1, 20, 1, 4)
    flat = rows[:, 0]
    projector = flat @ np.linalg.pinv(flat)
    assert independence(rows) == pytest.approx(np.diag(projector), abs=1e-12)
    assert independence(rows).sum() == pytest.approx(4.0)  # the trace of a projector is its rank


@pytest.mark.parametrize("n_directions", [1, 3])
def test_independence_is_the_share_of_the_determinant_that_a_place_holds(n_directions: int) -> None:
    rows = random_rows(2, 10, n_directions, 4)
    whole = determinant(rows, tuple(range(10)))
    without = [determinant(rows, tuple(set(range(10)) - {place})) for place in range(10)]
    assert independence(rows) == pytest.approx(1.0 - np.array(without) / whole, abs=1e-11)


@pytest.mark.parametrize("n_directions", [1, 3])
def test_updates_take_out_what_new_inverses_would(n_directions: int) -> None:
    # Compared with the definition: everything computed anew after each place.
    rows = random_rows(3, 150, n_directions, 5)
    left, went = list(range(150)), []
    while len(left) > 8:
        went.append(left.pop(int(np.argmin(independence(rows[left])))))
    kept, removed = eliminate(rows, 8)
    assert kept.tolist() == left
    assert removed.tolist() == went


def test_elimination_is_nearly_the_best_of_all_subsets() -> None:
    ratios = []
    for seed in range(20):
        rows = random_rows(seed, 12, 1, 3)
        best = max(determinant(rows, subset) for subset in combinations(range(12), 5))
        ratios.append(determinant(rows, eliminate(rows, 5)[0]) / best)
    assert max(ratios) <= 1.0 + 1e-12
    assert sorted(ratios)[10] > 0.95
    assert min(ratios) > 0.5


def test_one_sensor_for_the_first_mode_of_a_cantilever_sits_at_its_tip() -> None:
    x = np.linspace(0.02, 1.0, 50)
    assert by_effective_independence(cantilever(x, 1), 1, along(x)).tolist() == [49]


def test_two_sensors_for_two_modes_of_a_cantilever_are_the_tip_and_its_best_partner() -> None:
    # At the tip both shapes are 2 and -2 (Blevins 1979), so with one sensor there the determinant
    # of two is 4 (phi_1 + phi_2)^2 of the other, which is largest at 0.548 L.
    x = np.linspace(0.001, 1.0, 1000)
    rows = cantilever(x, 2)
    assert rows[-1, 0] == pytest.approx([2.0, -2.0], abs=1e-6)
    inner = x[int(np.argmax(np.abs(rows[:, 0, 0] + rows[:, 0, 1])))]
    chosen = by_effective_independence(rows, 2, along(x))
    assert sorted(x[chosen]) == pytest.approx([inner, 1.0], abs=1e-3)
    grid = np.linspace(0.05, 1.0, 20)
    best = max(combinations(range(20), 2), key=lambda pair: determinant(cantilever(grid, 2), pair))
    chosen = by_effective_independence(cantilever(grid, 2), 2, along(grid))
    assert sorted(chosen.tolist()) == list(best)


def test_the_middle_of_a_supported_beam_sees_its_first_mode_best() -> None:
    x = np.linspace(0.1, 0.9, 9)
    assert by_effective_independence(supported(x, 1), 1, along(x)).tolist() == [4]


def test_rounding_does_not_decide_among_mirror_images() -> None:
    x = np.linspace(-1.0, 1.0, 41)
    shapes = np.stack([1.0 - x**2, x, x**3 - 0.5 * x], axis=1)[:, None, :]
    noise = 1e-14 * np.random.default_rng(4).standard_normal(shapes.shape)
    chosen = by_effective_independence(shapes, 6, along(x))
    assert sorted(by_effective_independence(shapes + noise, 6, along(x))) == sorted(chosen)


def test_many_candidates_go_in_shares_and_the_choice_stays_good(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rows = random_rows(5, 400, 1, 4)
    exact, _ = eliminate(rows, 10)
    monkeypatch.setattr(sensor_placement, "ONE_BY_ONE", 60)
    kept, removed = eliminate(rows, 10)
    assert kept.size == 10
    assert sorted([*kept, *removed]) == list(range(400))
    # Compared with one by one, which is the method as published.
    assert determinant(rows, kept) > 0.9 * determinant(rows, exact)


def test_shapes_that_are_alike_at_all_candidates_are_refused() -> None:
    x = np.linspace(0.1, 0.9, 9)
    rows = supported(x, 2)
    same = np.concatenate([rows, 2.0 * rows[:, :, :1]], axis=2)  # mode 3 is mode 1 again
    with pytest.raises(ModesError, match="3 modes are those of 2 independent ones"):
        eliminate(same, 4)


def test_a_place_that_cannot_be_spared_is_not_taken_out() -> None:
    # Two modes of which each of two places sees one alone: neither can go.
    rows = np.array([[[1.0, 0.0]], [[0.0, 1.0]], [[0.0, 0.0]]])
    assert eliminate(rows, 2)[0].tolist() == [0, 1]
    with pytest.raises(ModesError, match="2 sensors are the fewest"):
        eliminate(rows, 1)


# spacing


def test_sensors_keep_their_distance_and_directions_of_one_node_do_not() -> None:
    x = np.linspace(0.02, 1.0, 50)
    close = by_effective_independence(cantilever(x, 3), 5, along(x))
    apart = by_effective_independence(cantilever(x, 3), 5, along(x, 0.15))
    assert np.diff(np.sort(x[close])).min() < 0.05  # what the distance is for
    assert np.diff(np.sort(x[apart])).min() >= 0.15
    same = Spacing(np.array([1, 1, 2]), np.array([[0.0] * 3, [0.0] * 3, [0.1, 0.0, 0.0]]), 0.5)
    assert same.blocked([0]).tolist() == [True, False, True]


@pytest.mark.parametrize("choose", [by_effective_independence, by_kinetic_energy, by_auto_mac])
def test_a_distance_that_leaves_too_few_places_is_refused(
    choose: object,
) -> None:
    x = np.linspace(0.1, 1.0, 10)
    assert callable(choose)
    with pytest.raises(CampaignError, match="smaller distance"):
        choose(cantilever(x, 2), 4, along(x, 0.5))


# auto-MAC


def test_sines_at_even_places_are_orthogonal() -> None:
    # Discrete sine transform: sin(k pi i / 8), i = 1..7, are orthogonal for k = 1..7.
    x = np.arange(1, 8) / 8.0
    quality = judge(supported(x, 4), np.arange(7))
    assert quality.auto_mac == pytest.approx(np.eye(4), abs=1e-14)
    assert quality.condition == pytest.approx(1.0)
    assert quality.determinant == pytest.approx(1.0)
    assert quality.efficiency == pytest.approx(1.0)


def test_quality_names_the_modes_that_look_alike() -> None:
    # Modes 1 and 3 of a supported beam are the same at its quarter points but for a sign at the
    # middle: phi_1 = (s, 1, s), phi_3 = (s, -1, s) with s = 1/sqrt(2): MAC ((1 - 1) / 4)^2 = 0;
    # without the middle both are (s, s): MAC 1.
    rows = supported(np.array([0.25, 0.5, 0.75]), 3)
    assert judge(rows, np.array([0, 1, 2])).largest == pytest.approx(0.0, abs=1e-15)
    blind = judge(rows, np.array([0, 2]))
    assert blind.largest == pytest.approx(1.0)
    assert blind.pair == (0, 2)
    assert blind.condition == np.inf
    assert blind.determinant == 0.0


def test_the_determinant_is_relative_to_that_of_all_candidates() -> None:
    rows = random_rows(6, 15, 1, 3)
    chosen = np.array([1, 4, 8, 13])
    expected = determinant(rows, chosen) / determinant(rows, np.arange(15))
    quality = judge(rows, chosen)
    assert quality.determinant == pytest.approx(expected)
    assert quality.efficiency == pytest.approx(expected ** (1 / 3) * 15 / 4)


def test_exchange_finds_the_least_auto_mac_of_all_subsets() -> None:
    found = []
    for seed in range(12):
        rows = random_rows(seed, 10, 1, 3)
        usable = np.flatnonzero(loud(rows))
        best = min(
            judge(rows, np.array(subset)).largest for subset in combinations(usable.tolist(), 5)
        )
        reached = judge(rows, by_auto_mac(rows, 5, anywhere(10))).largest
        assert reached >= best - 1e-9
        found.append(reached - best)
    # An optimum of single exchanges: mostly that of all subsets, never far.
    assert sorted(found)[6] < 0.02
    assert max(found) < 0.1


def test_auto_mac_beats_effective_independence_in_what_it_minimises() -> None:
    x = np.linspace(0.02, 1.0, 50)
    rows = cantilever(x, 4)
    ways = [choose(rows, 6, along(x, 0.05)) for choose in (by_auto_mac, by_effective_independence)]
    assert judge(rows, ways[0]).largest < judge(rows, ways[1]).largest
    assert judge(rows, ways[0]).determinant < judge(rows, ways[1]).determinant


def test_sensors_that_hardly_move_are_not_used_for_auto_mac() -> None:
    rows = random_rows(7, 30, 1, 3)
    rows[:10] *= 1e-3  # any auto-MAC could come from these, in noise
    assert (by_auto_mac(rows, 6, anywhere(30)) >= 10).all()


def test_how_many_sensors_are_needed_is_the_first_that_suffices() -> None:
    x = np.linspace(0.02, 1.0, 50)
    rows = cantilever(x, 4)
    needed = needed_sensors(rows, 4, 0.02)
    assert needed is not None
    for count in range(4, needed + 1):
        largest = judge(rows, eliminate(rows, count)[0]).largest
        assert (largest <= 0.02) == (count == needed)
    assert needed_sensors(rows, 4, 1e-9) is None


# kinetic energy


def test_kinetic_energy_is_shared_out_over_all_candidates() -> None:
    # Two masses 3 and 1 on a rod: the rigid mode moves both alike, so 3/4 and 1/4 of its energy.
    rows = np.array([[[1.0, 1.0]], [[1.0, -3.0]]]) * np.sqrt([3.0, 1.0])[:, None, None]
    assert kinetic_energies(rows)[:, 0] == pytest.approx([0.75, 0.25])
    assert kinetic_energies(rows)[:, 1] == pytest.approx([3 / 12, 9 / 12])
    assert kinetic_energies(rows).sum(axis=0) == pytest.approx([1.0, 1.0])


def test_kinetic_energy_takes_what_moves_most() -> None:
    x = np.linspace(0.1, 1.0, 10)
    assert by_kinetic_energy(cantilever(x, 1), 3, along(x)).tolist() == [9, 8, 7]
    assert by_kinetic_energy(cantilever(x, 1), 3, along(x, 0.25)).tolist() == [9, 6, 3]


def test_the_scale_of_a_mode_does_not_count() -> None:
    rows = random_rows(8, 20, 1, 3)
    scaled = rows * np.array([1e-6, -3.0, 1e6])
    assert np.sum(unit_modes(rows) ** 2, axis=(0, 1)) == pytest.approx([1.0, 1.0, 1.0])
    for choose in (by_effective_independence, by_auto_mac, by_kinetic_energy):
        assert choose(rows, 6, anywhere(20)).tolist() == choose(scaled, 6, anywhere(20)).tolist()


def test_the_first_few_of_a_choice_are_good_by_themselves() -> None:
    rows = random_rows(9, 8, 1, 3)
    order = order_of_use(rows)
    assert sorted(order) == list(range(8))
    first = max(range(8), key=lambda place: float(np.sum(unit_modes(rows)[place] ** 2)))
    assert order[0] == first  # the longest row
    assert determinant(rows, order[:3]) > 0.5 * max(
        determinant(rows, subset) for subset in combinations(range(8), 3)
    )


# information


def test_one_parameter_is_best_told_where_its_derivative_is_largest() -> None:
    slopes = np.array([0.1, -0.9, 0.5, 0.7])[:, None, None]
    found = by_information(parameter_information(slopes), np.eye(1), 2, anywhere(4))
    assert found.tolist() == [1, 3]


def test_information_is_the_best_of_all_subsets_or_nearly() -> None:
    ratios = []
    for seed in range(15):
        matrices = parameter_information(random_rows(seed, 11, 2, 3))
        prior = np.diag([0.1, 1.0, 0.5])

        def worth(
            subset: tuple[int, ...], matrices: Floats = matrices, prior: Floats = prior
        ) -> float:
            return float(np.linalg.det(prior + matrices[list(subset)].sum(axis=0)))

        best = max(worth(subset) for subset in combinations(range(11), 4))
        ratios.append(worth(tuple(by_information(matrices, prior, 4, anywhere(11)))) / best)
    assert max(ratios) <= 1.0 + 1e-12
    assert sorted(ratios)[7] > 1.0 - 1e-12  # most often the best
    assert min(ratios) > 0.9


def test_what_is_known_already_is_not_measured_again() -> None:
    # Place 0 tells parameter 0 well, place 1 tells parameter 1 less well.
    matrices = np.array([np.diag([9.0, 0.0]), np.diag([0.0, 1.0])])
    assert by_information(matrices, np.eye(2), 1, anywhere(2)).tolist() == [0]
    known = np.diag([1e4, 1.0])
    assert by_information(matrices, known, 1, anywhere(2)).tolist() == [1]


def test_modes_that_parameters_do_not_need_are_kept_apart_all_the_same() -> None:
    # All information on the parameter is where only mode 1 moves; mode 2 moves at places 2 and 3.
    rows = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 0.5], [0.0, 1.0]])[:, None, :]
    matrices = parameter_information(np.array([3.0, 2.0, 0.1, 0.1])[:, None, None])
    alone = by_information(matrices, np.eye(1), 2, anywhere(4))
    assert sorted(alone) == [0, 1]
    assert judge(rows, alone).condition == np.inf
    joint, base = with_modes(matrices, np.eye(1), rows)
    together = by_information(joint, base, 2, anywhere(4))
    assert sorted(together) == [0, 3]
    assert judge(rows, together).largest == 0.0


# exciters


def test_one_exciter_for_two_modes_of_a_supported_beam_sits_at_a_third() -> None:
    # sin(pi x) = sin(2 pi x) at x = 1/3, where both are sqrt(3) / 2; elsewhere one is less.
    x = np.linspace(0.0, 1.0, 61)
    shapes = supported(x, 2)[:, 0]
    place = choose_exciters(shapes, 1)
    assert x[place] == pytest.approx([1 / 3])
    assert participation(shapes)[place[0]] == pytest.approx([np.sqrt(0.75)] * 2, abs=2e-3)


def test_two_exciters_drive_each_mode_by_the_better_of_them() -> None:
    # Modes 1 and 2 have their antinodes at 1/2 and 1/4 (or 3/4): both are then driven fully.
    x = np.linspace(0.0, 1.0, 21)
    assert sorted(x[choose_exciters(supported(x, 2)[:, 0], 2)]) == pytest.approx([0.25, 0.5])


def test_exchange_of_exciters_comes_near_all_sets(monkeypatch: pytest.MonkeyPatch) -> None:
    worst = []
    for seed in range(10):
        shapes = random_rows(seed, 14, 1, 4)[:, 0]
        shares = participation(shapes)
        best = shares[choose_exciters(shapes, 3)].max(axis=0).min()
        monkeypatch.setattr(exciter_placement, "EXHAUSTIVE", 0)
        by_exchange = choose_exciters(shapes, 3)
        monkeypatch.undo()
        assert len(set(by_exchange.tolist())) == 3
        worst.append(shares[by_exchange].max(axis=0).min() / best)
    assert max(worst) <= 1.0 + 1e-12
    assert min(worst) > 0.8


def test_a_bar_pushed_at_its_end_feels_a_quarter_of_its_mass() -> None:
    # Uniform bar of mass m and length L: 1 / (1/m + (L/2)^2 / (m L^2 / 12)) = m / 4.
    mass, length = 6.0, 2.0
    x = np.array([0.0, 0.5]) * length
    rigid = np.stack(
        [np.full(2, 1 / np.sqrt(mass)), (x - length / 2) / np.sqrt(mass * length**2 / 12)], axis=1
    )
    assert rigid_mass(rigid) == pytest.approx([mass / 4, mass])
    assert rigid_mass(np.zeros((1, 2))).tolist() == [np.inf]


def test_a_free_beam_hangs_at_the_nodes_of_its_first_mode() -> None:
    # Nodes of the first free-free mode: 0.2242 L from both ends (Blevins 1979, table 8-1).
    x = np.linspace(0.0, 1.0, 1001)
    root = FREE[0]
    ratio = (np.cosh(root) - np.cos(root)) / (np.sinh(root) - np.sin(root))
    z = root * x
    shape = np.cosh(z) + np.cos(z) - ratio * (np.sinh(z) + np.sin(z))
    points, shares = choose_suspension(np.abs(shape)[:, None], 2, along(x, 0.1))
    assert sorted(x[points]) == pytest.approx([0.224, 0.776], abs=1e-3)
    assert shares == pytest.approx([0.0, 0.0], abs=2e-3)


def test_suspension_points_end_where_no_place_is_left() -> None:
    points, _ = choose_suspension(np.ones((3, 1)), 5, along(np.array([0.0, 0.1, 1.0]), 0.5))
    assert points.tolist() == [0, 2]
