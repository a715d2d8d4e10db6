"""Maps of a model's error: closed forms, one wrong spring of a chain, noise, few sensors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import sparse

from modetune.core.errors import ModesError
from modetune.core.modes import Floats
from modetune.core.updating.localisation import (
    ErrorFields,
    Group,
    GroupErrors,
    NodeErrors,
    error_fields,
    group_errors,
    node_errors,
    removals,
)

N = 12
SPRINGS = np.linspace(900.0, 1100.0, N + 1)
MASSES = np.linspace(0.9, 1.1, N)
N_MODES = 4


def stiffness(springs: Floats) -> Floats:
    return (
        np.diag(springs[:-1] + springs[1:]) - np.diag(springs[1:-1], 1) - np.diag(springs[1:-1], -1)
    )


def modes(springs: Floats, masses: Floats) -> tuple[Floats, Floats]:
    root = np.sqrt(masses)
    values, vectors = np.linalg.eigh(stiffness(springs) / np.outer(root, root))
    shapes = vectors / root[:, None]
    return values[:N_MODES], shapes[:, :N_MODES]


def spring_groups() -> list[Group]:
    found = []
    for place in range(N + 1):
        alone = np.zeros(N + 1)
        alone[place] = SPRINGS[place]
        found.append(
            Group(f"k{place + 1}", sparse.csr_array(stiffness(alone)), sparse.csr_array((N, N)))
        )
    return found


def mass_groups() -> list[Group]:
    return [
        Group(
            f"m{place + 1}",
            sparse.csr_array((N, N)),
            sparse.csr_array(np.diag(MASSES * (np.arange(N) == place))),
        )
        for place in range(N)
    ]


@dataclass(frozen=True)
class Found:
    fields: ErrorFields
    groups: GroupErrors
    nodes: NodeErrors
    names: tuple[str, ...]

    @property
    def ranked(self) -> list[str]:
        return [self.names[place] for place in self.groups.ranking.tolist()]


def located(
    errors: dict[str, float], sensors: Floats | None = None, noise: float = 0.0, seed: int = 0
) -> Found:
    """Maps of the nominal chain against a test of the true one, whose errors are relative."""
    springs, masses = SPRINGS.copy(), MASSES.copy()
    for name, error in errors.items():
        (springs if name[0] == "k" else masses)[int(name[1:]) - 1] *= 1.0 + error
    lam, phi = modes(springs, masses)
    _, phi_c = modes(SPRINGS, MASSES)
    phi = phi * np.sign(np.sum(phi * phi_c, axis=0))
    rows = np.arange(N) if sensors is None else sensors
    rms = np.sqrt(np.mean(phi[rows] ** 2, axis=0))
    rng = np.random.default_rng(seed)
    measured = phi[rows] + noise * rms * rng.standard_normal((rows.size, N_MODES))
    k, m = sparse.csr_array(stiffness(SPRINGS)), sparse.csr_array(np.diag(MASSES))
    fields = error_fields(
        k, m, lam, measured, sparse.csr_array(np.eye(N)[rows]), np.full(lam.size, max(noise, 1e-7))
    )
    groups = spring_groups() + mass_groups()
    return Found(
        fields,
        group_errors(fields, k, m, groups, phi_c),
        node_errors(fields, np.arange(1, N + 1), np.ones(N, dtype=np.int64)),
        tuple(group.name for group in groups),
    )


def test_a_right_model_has_no_error() -> None:
    found = located({})
    lam, phi = modes(SPRINGS, MASSES)
    np.testing.assert_allclose(np.abs(found.fields.displacements), np.abs(phi), atol=1e-9)
    assert np.abs(found.fields.errors).max() < 1e-9
    assert np.abs(found.fields.forces).max() < 1e-9 * lam.max()
    assert found.fields.misfits.max() < 1e-9


@pytest.mark.parametrize("name", ["k1", "k5", "k13", "m3", "m12"])
@pytest.mark.parametrize("error", [0.3, -0.2])
def test_a_test_at_all_masses_gives_the_wrong_part_and_its_error_exactly(
    name: str, error: float
) -> None:
    # (K - lam M) u = -e (K_g - lam M_g) u for the true mode u: the share is 1, the change is e.
    found = located({name: error})
    guilty = found.names.index(name)
    assert found.ranked[0] == name
    assert found.groups.force_shares[guilty] == pytest.approx(1.0, abs=1e-6)
    assert found.groups.changes[guilty] == pytest.approx(error, abs=1e-6)
    assert found.groups.force_shares.max(initial=0.0, where=np.arange(25) != guilty) < 0.9


def test_the_residual_forces_are_the_missing_springs_pull_on_its_two_ends() -> None:
    # Spring 5 holds masses 4 and 5; by hand r = -(dk) (u_5 - u_4) (-1, +1) there, 0 elsewhere.
    found = located({"k5": 0.3})
    u, r = found.fields.displacements, found.fields.forces
    pull = 0.3 * SPRINGS[4] * (u[4] - u[3])
    expected = np.zeros((N, N_MODES))
    expected[3], expected[4] = pull, -pull
    np.testing.assert_allclose(r, expected, atol=1e-4)
    assert set(found.nodes.nodes[np.argsort(-found.nodes.forces)[:2]]) == {4, 5}
    assert np.delete(found.nodes.forces, [3, 4]).max() < 1e-4


def test_both_maps_point_to_the_wrong_spring_and_less_to_its_neighbours() -> None:
    found = located({"k5": 0.3})
    shares = found.groups.error_shares[: N + 1]
    assert np.argmax(shares) == 4
    assert shares[4] > 0.85
    assert found.groups.error_shares.sum() == pytest.approx(1.0)  # springs make up all of K
    assert np.argmax(found.groups.concentrations[: N + 1]) == 4
    forces = found.groups.force_shares[: N + 1]
    assert max(forces[3], forces[5]) > np.delete(forces, [3, 4, 5]).max()


def test_a_bound_limits_the_change_of_a_group_and_what_it_explains() -> None:
    # r = -e f: a change c in place of e explains the share (2 c e - c^2) / e^2 of it.
    lam, phi = modes(SPRINGS * np.where(np.arange(N + 1) == 4, 1.3, 1.0), MASSES)
    k, m = sparse.csr_array(stiffness(SPRINGS)), sparse.csr_array(np.diag(MASSES))
    fields = error_fields(k, m, lam, phi, sparse.csr_array(np.eye(N)), np.full(lam.size, 1e-7))
    groups = [replace(group, lower=-0.1, upper=0.1) for group in spring_groups()]
    found = group_errors(fields, k, m, groups, modes(SPRINGS, MASSES)[1])
    assert found.changes[4] == pytest.approx(0.1)
    assert found.at_bound[4]
    assert found.force_shares[4] == pytest.approx((2 * 0.1 * 0.3 - 0.1**2) / 0.3**2, abs=1e-6)
    assert (np.abs(found.pair_changes) <= 0.1).all()


def test_leaving_a_sensor_out_is_what_a_test_without_it_gives() -> None:
    lam, phi = modes(SPRINGS * np.where(np.arange(N + 1) == 4, 1.3, 1.0), MASSES)
    phi = phi + 0.05 * np.random.default_rng(1).standard_normal(phi.shape)
    k, m = sparse.csr_array(stiffness(SPRINGS)), sparse.csr_array(np.diag(MASSES))
    deviations = np.full(lam.size, 0.02)
    rows = sparse.csr_array(np.eye(N))
    fields = error_fields(k, m, lam, phi, rows, deviations, left_out=[0, 6])
    for place, sensor in enumerate((0, 6)):
        kept = np.delete(np.arange(N), sensor)
        # The deviation is relative to the length of the shape, which a sensor less shortens.
        own = deviations * np.linalg.norm(phi, axis=0) / np.linalg.norm(phi[kept], axis=0)
        alone = error_fields(k, m, lam, phi[kept], rows[kept], own)
        np.testing.assert_allclose(fields.without[place], alone.displacements, rtol=1e-8, atol=1e-9)
    found = group_errors(fields, k, m, spring_groups(), phi)
    assert found.stability.left_out.tolist() == [0, 6]
    assert found.stability.groups[0] == found.ranking[0]


def test_a_sensor_that_alone_decides_the_ranking_is_named() -> None:
    # A wild reading at mass 9 blames the springs there; without it spring 3 is the wrong one.
    lam, phi = modes(SPRINGS * np.where(np.arange(N + 1) == 2, 1.3, 1.0), MASSES)
    phi = phi.copy()
    phi[8] *= 1.6
    k, m = sparse.csr_array(stiffness(SPRINGS)), sparse.csr_array(np.diag(MASSES))
    rows, every = sparse.csr_array(np.eye(N)), list(range(N))
    fields = error_fields(k, m, lam, phi, rows, np.full(lam.size, 0.01), left_out=every)
    found = group_errors(fields, k, m, spring_groups(), phi)
    assert 8 in found.stability.upsets
    assert len(found.stability.upsets) < N / 2


def test_forces_that_cannot_be_told_apart_are_no_pair() -> None:
    lam, phi = modes(SPRINGS * np.where(np.arange(N + 1) == 4, 1.3, 1.0), MASSES)
    k, m = sparse.csr_array(stiffness(SPRINGS)), sparse.csr_array(np.diag(MASSES))
    fields = error_fields(k, m, lam, phi, sparse.csr_array(np.eye(N)), np.full(lam.size, 1e-7))
    one = spring_groups()[4]
    found = group_errors(fields, k, m, [one, replace(one, name="again")], phi)
    assert found.pair == ()


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("spring", [3, 5, 8])
def test_noise_of_one_per_cent_leaves_the_wrong_spring_first_in_both_maps(
    spring: int, seed: int
) -> None:
    found = located({f"k{spring}": 0.3}, noise=0.01, seed=seed)
    assert found.ranked[0] == f"k{spring}"
    assert np.argmax(found.groups.error_shares[: N + 1]) == spring - 1
    assert found.groups.changes[spring - 1] == pytest.approx(0.3, abs=0.12)
    top = found.nodes.nodes[np.argsort(-found.nodes.forces)[:3]]
    assert {spring - 1, spring} & set(top.tolist())


@pytest.mark.parametrize("spring", [3, 5, 8, 10])
@pytest.mark.parametrize("sensors", [np.arange(0, N, 2), np.array([1, 4, 7, 10])])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_sensors_at_a_part_of_the_masses_still_find_the_spring_or_its_neighbour(
    spring: int, sensors: Floats, noise: float
) -> None:
    found = located({f"k{spring}": 0.3}, sensors, noise)
    springs = [name for name in found.ranked if name.startswith("k")]
    assert springs[0] in {f"k{spring + off}" for off in (-1, 0, 1)}
    assert f"k{spring}" in springs[:2]
    assert np.argmax(found.groups.error_shares[: N + 1]) + 1 in (spring - 1, spring, spring + 1)


def test_two_wrong_springs_are_the_best_pair_with_their_errors() -> None:
    found = located({"k3": 0.2, "k9": -0.15})
    assert [found.names[place] for place in found.groups.pair] == ["k3", "k9"]
    assert found.groups.pair_share == pytest.approx(1.0, abs=1e-6)
    assert found.groups.pair_changes == pytest.approx([0.2, -0.15], abs=1e-6)
    assert found.groups.force_shares.max() < 0.95


def test_energy_differences_are_those_of_the_two_modes() -> None:
    # Spring g of the nominal chain stretched by the true and by the nominal mode, of all springs.
    found = located({"k5": 0.3})
    springs = SPRINGS.copy()
    springs[4] *= 1.3
    (_, phi), (_, phi_c) = modes(springs, MASSES), modes(SPRINGS, MASSES)
    walls = [np.vstack([np.zeros(N_MODES), shapes, np.zeros(N_MODES)]) for shapes in (phi, phi_c)]
    energy = [SPRINGS[:, None] * np.diff(wall, axis=0) ** 2 for wall in walls]
    expected = energy[0] / energy[0].sum(axis=0) - energy[1] / energy[1].sum(axis=0)
    np.testing.assert_allclose(found.groups.strain[: N + 1], expected, atol=1e-6)
    np.testing.assert_allclose(
        found.groups.kinetic[N + 1 :], MASSES[:, None] * (phi**2 - phi_c**2), atol=1e-6
    )


def test_the_sign_of_a_measured_shape_changes_no_share() -> None:
    lam, phi = modes(SPRINGS * np.where(np.arange(N + 1) == 4, 1.3, 1.0), MASSES)
    k, m = sparse.csr_array(stiffness(SPRINGS)), sparse.csr_array(np.diag(MASSES))
    both = [
        group_errors(
            error_fields(
                k,
                m,
                lam,
                scale * phi[::2],
                sparse.csr_array(np.eye(N)[::2]),
                np.full(lam.size, 0.01),
            ),
            k,
            m,
            spring_groups(),
            modes(SPRINGS, MASSES)[1],
        )
        for scale in (1.0, -1.0)
    ]
    np.testing.assert_allclose(both[0].force_shares, both[1].force_shares, rtol=1e-7)
    np.testing.assert_allclose(both[0].error_shares, both[1].error_shares, rtol=1e-7)


def test_a_free_chain_is_localised_as_well() -> None:
    # Without the springs to the walls K is singular; the third spring between masses is wrong.
    def free(values: Floats) -> Floats:
        return stiffness(np.concatenate([[0.0], values, [0.0]]))

    inner = np.full(N - 1, 1000.0)
    true = inner.copy()
    true[2] *= 1.3
    lam, phi = np.linalg.eigh(free(true))
    _, phi_c = np.linalg.eigh(free(inner))
    k, m = sparse.csr_array(free(inner)), sparse.csr_array(np.eye(N))
    groups = [
        Group(
            f"k{place}",
            sparse.csr_array(free(1000.0 * (np.arange(N - 1) == place))),
            sparse.csr_array((N, N)),
        )
        for place in range(N - 1)
    ]
    fields = error_fields(
        k, m, lam[1:5], phi[:, 1:5], sparse.csr_array(np.eye(N)), np.full(4, 1e-6)
    )
    found = group_errors(fields, k, m, groups, phi_c[:, 1:5])
    assert found.ranking[0] == 2
    assert found.changes[2] == pytest.approx(0.3, abs=1e-5)
    assert found.force_shares[2] == pytest.approx(1.0, abs=1e-5)


@pytest.mark.parametrize(
    ("lam", "measured"),
    [
        (np.ones(2), np.ones((3, 1))),
        (np.ones(1), np.zeros((3, 1))),
        (np.zeros(1), np.ones((3, 1))),
        (np.ones(1), np.full((3, 1), np.nan)),
    ],
)
def test_fields_of_data_that_do_not_fit_are_refused(lam: Floats, measured: Floats) -> None:
    k = sparse.csr_array(np.eye(3))
    with pytest.raises(ModesError, match="measured shapes"):
        error_fields(k, k, lam, measured, k, np.full(lam.size, 0.01))


def test_nodes_sum_their_unknowns_and_leave_turning_moments_out_of_forces() -> None:
    fields = ErrorFields(
        np.array([2.0]),
        np.zeros((4, 1)),
        np.array([[1.0], [1.0], [2.0], [0.0]]),
        np.array([[3.0], [4.0], [1.0], [9.0]]),
        np.zeros(1),
    )
    found = node_errors(fields, np.array([7, 7, 5, 5]), np.array([1, 2, 1, 6]))
    assert found.nodes.tolist() == [5, 7]
    # Forces |(3, 4)| = 5 and 1; the moment of 9 is left out.
    assert found.forces == pytest.approx([0.2, 1.0])


def test_removals_of_orthogonal_columns_are_the_squares_of_the_residuals_parts() -> None:
    # z = (3, 4, 0): the columns along the axes remove 9 / 25 and 16 / 25, and both together all.
    sensitivity = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 1.0]])
    wide = np.full(3, 10.0)
    singles, pairs = removals(sensitivity, np.array([3.0, 4.0, 0.0]), np.ones(3), -wide, wide)
    assert [item.members for item in singles] == [(1,), (0,), (2,)]
    assert [item.removed for item in singles] == pytest.approx([16 / 25, 9 / 25, 0.0])
    assert singles[0].changes == pytest.approx([2.0])
    assert pairs[0].members == (0, 1)
    assert pairs[0].removed == pytest.approx(1.0)


def test_a_bound_limits_what_a_parameter_removes() -> None:
    singles, pairs = removals(
        np.ones((1, 1)), np.array([1.0]), np.ones(1), -np.ones(1), np.array([0.5])
    )
    assert singles[0].changes == pytest.approx([0.5])
    assert singles[0].removed == pytest.approx(0.75)
    assert pairs == ()


def test_a_parameter_that_moves_nothing_removes_nothing() -> None:
    singles, _ = removals(np.zeros((2, 1)), np.ones(2), np.ones(2), -np.ones(1), np.ones(1))
    assert singles[0].removed == 0.0
