"""The model's own error: ratios by closed forms, predictions by refits, intervals by draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy

from modetune.core.correlation.pairing import pair_by_order
from modetune.core.modes import Floats, Integers, MeasuredModes, ModeSet, mode_set
from modetune.core.updating.model_error import (
    LinearFit,
    linear_fit,
    missed_modes,
    model_error_columns,
    with_model_error,
)
from modetune.core.updating.parameter_steps import parameter_covariance
from modetune.core.updating.responses.frequencies import Frequencies
from modetune.core.updating.responses.response import ModelState, Residual, stacked
from modetune.core.updating.responses.shapes import Shapes
from modetune.core.updating.trust import too_many_missed
from modetune.core.updating.weighting import even_weighting


def fitted(
    sensitivity: Floats,
    values: Floats,
    variances: Floats | None = None,
    classes: Integers | None = None,
    groups: Integers | None = None,
    prior: Floats | None = None,
    columns: Floats | None = None,
) -> LinearFit:
    """Return a weighted least-squares fit; by default each row is a mode, all of one class."""
    n, n_parameters = sensitivity.shape
    variances = np.ones(n) if variances is None else variances
    known = np.zeros((n_parameters, n_parameters)) if prior is None else prior
    weighted = sensitivity / variances[:, None]
    change = np.linalg.solve(sensitivity.T @ weighted + known, weighted.T @ values)
    modes = np.arange(n) if groups is None else groups
    return LinearFit(
        sensitivity,
        values - sensitivity @ change,
        variances,
        1.0 / variances,
        known,
        np.zeros((n, 0)) if columns is None else columns,
        np.zeros(n, np.int64) if classes is None else classes,
        modes,
        np.full(n, -1),
        tuple(f"mode {number + 1}" for number in range(int(modes.max()) + 1)),
    )


def errors(fit: LinearFit) -> Floats:
    prior = fit.known if fit.known.any() else None
    given = fit.sensitivity, fit.variances, fit.weights, prior
    return np.sqrt(np.diag(parameter_covariance(*given, errors=fit.errors)))


def birge_ratios(fit: LinearFit) -> Floats:
    return np.asarray(np.sqrt(with_model_error(fit)[0].variances / fit.variances))


def test_the_ratio_of_repeated_values_is_that_of_their_scatter() -> None:
    """One parameter, the mean of eight values: expected is n - 1, less two for the few."""
    values = np.array([4.0, -3.0, 5.0, -6.0, 2.0, 1.0, -4.0, 1.0])
    ratio = np.sqrt(np.sum((values - values.mean()) ** 2) / (8 - 1 - 2))
    ratios = birge_ratios(fitted(np.ones((8, 1)), values))
    np.testing.assert_allclose(ratios, ratio, rtol=1e-12)
    # Values that scatter less than their deviations do not make the errors smaller.
    np.testing.assert_array_equal(birge_ratios(fitted(np.ones((8, 1)), 0.01 * values)), 1.0)


def test_a_class_without_a_degree_of_freedom_takes_the_ratio_of_all() -> None:
    sensitivity = np.zeros((9, 2))
    sensitivity[:8, 0], sensitivity[8, 1] = 1.0, 1.0
    values = np.array([4.0, -3.0, 5.0, -6.0, 2.0, 1.0, -4.0, 1.0, 7.0])
    classes = np.array([0] * 8 + [1])
    ratios = birge_ratios(fitted(sensitivity, values, classes=classes))
    assert ratios[8] == pytest.approx(ratios[0], rel=1e-12)
    assert ratios[0] > 3.0


def test_the_prior_is_not_scaled() -> None:
    """Without a measured effect a parameter keeps the deviation that it had before the test."""
    rng = np.random.default_rng(2)
    sensitivity = np.column_stack([rng.normal(size=12), np.zeros(12)])
    fit = fitted(sensitivity, 20.0 * rng.normal(size=12), prior=np.diag([25.0, 25.0]))
    ratios = birge_ratios(fit)
    assert (ratios > 10.0).all()
    assert errors(with_model_error(fit)[0])[1] == pytest.approx(0.2, rel=1e-12)


def test_a_left_out_mode_is_predicted_as_a_fit_without_it_does() -> None:
    """Against refits: six modes of a frequency and four shape entries, three parameters."""
    rng = np.random.default_rng(5)
    sensitivity, values = rng.normal(size=(30, 3)), 3.0 * rng.normal(size=30)
    groups, classes = np.arange(30) % 6, np.repeat([0, 1], [6, 24])
    variances = np.where(classes == 0, 1.0, 4.0)
    fit = fitted(sensitivity, values, variances, classes, groups)
    found, n = missed_modes(fit)
    assert n == 6
    expected = []
    for mode in range(6):
        own = groups == mode
        others = fitted(sensitivity[~own], values[~own], variances[~own], classes[~own])
        ratios = birge_ratios(others)
        scaled = [ratios[classes[~own] == kind][0] for kind in classes[own].tolist()]
        change = np.linalg.lstsq(
            sensitivity[~own] / np.sqrt(variances[~own])[:, None],
            values[~own] / np.sqrt(variances[~own]),
            rcond=None,
        )[0]
        spread = parameter_covariance(
            sensitivity[~own], ratios**2 * variances[~own], 1.0 / variances[~own]
        )
        covariance = sensitivity[own] @ spread @ sensitivity[own].T
        covariance += np.diag(variances[own] * np.array(scaled) ** 2)
        miss = values[own] - sensitivity[own] @ change
        if miss @ np.linalg.solve(covariance, miss) > 11.0705:  # chi-square, 5 values, 5 %
            expected.append(f"mode {mode + 1}")
    assert found == tuple(expected)


def test_predictions_with_errors_of_the_model_are_those_of_full_covariances() -> None:
    """Against the covariance of a mode's rows in full, where only the mode knows a parameter."""
    rng = np.random.default_rng(11)
    groups, n_missed = np.arange(40) % 4, 0
    for _ in range(30):
        sensitivity, columns = rng.normal(size=(40, 4)), rng.normal(size=(40, 5))
        sensitivity[groups > 0, 3] = 0.0  # only mode 1 knows the fourth parameter
        values = rng.normal(size=40) + 0.3 * columns @ rng.normal(size=5)
        values[groups == 1] *= rng.uniform(1.0, 2.5)
        fit = fitted(sensitivity, values, groups=groups, columns=columns)
        expected = []
        for mode in range(4):
            own, information = groups == mode, sensitivity.T @ sensitivity
            share = sensitivity[own] @ np.linalg.solve(information, sensitivity[own].T)
            loose, axes = np.linalg.eigh(np.eye(10) - share)
            axes = axes[:, loose >= 0.01]
            assert axes.shape[1] == (9 if mode == 0 else 10)
            rows, others = sensitivity[own], np.linalg.pinv(sensitivity[~own])
            left = values[~own] - sensitivity[~own] @ others @ values[~own]
            _, size = with_model_error(replace(fit.without(own), left=left))
            moved = size * (columns[own] - rows @ others @ columns[~own])
            covariance = np.eye(10) + rows @ others @ others.T @ rows.T + moved @ moved.T
            miss = axes.T @ (values[own] - rows @ others @ values[~own])
            square = miss @ np.linalg.solve(axes.T @ covariance @ axes, miss)
            if square > scipy.stats.chi2.ppf(0.95, axes.shape[1]):
                expected.append(f"mode {mode + 1}")
        assert missed_modes(fit) == (tuple(expected), 4)
        n_missed += len(expected)
    assert 10 < n_missed < 110


def test_modes_of_many_sensors_are_predicted_without_a_matrix_as_large() -> None:
    """Three modes at 100,000 sensors, of which a full covariance takes 80 GB."""
    rng = np.random.default_rng(13)
    rows, groups = rng.normal(size=(300_000, 5)), np.arange(300_000) % 3
    values = np.where(groups == 1, 1.5, 1.0) * rng.normal(size=300_000)
    columns = rng.normal(size=(300_000, 8))
    assert missed_modes(fitted(rows, values, groups=groups, columns=columns)) == (("mode 2",), 3)


def test_of_very_many_modes_a_hundred_are_predicted() -> None:
    rng = np.random.default_rng(7)
    fit = fitted(rng.normal(size=(350, 2)), rng.normal(size=350), groups=np.arange(350))
    missed, n = missed_modes(fit)
    assert n == 100
    assert len(missed) <= 12  # 5 % by chance


def test_a_mode_that_alone_determines_a_parameter_is_not_predicted() -> None:
    sensitivity = np.array([[1.0, 0.0], [1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    assert missed_modes(fitted(sensitivity, np.array([0.1, -0.1, 0.2, 5.0])))[1] == 3


@pytest.mark.parametrize("model_error", [0.0, 3.0])
def test_nineteen_of_twenty_intervals_contain_the_truth(model_error: float) -> None:
    """Eight frequencies, 96 shape entries, three parameters; the model errs by its own amount.

    2,000 draws put the share of 6,000 intervals within 0.6 % (two deviations); half of all
    intervals by noise alone miss the truth where the model errs.
    """
    rng = np.random.default_rng(11)
    classes, groups = np.repeat([0, 1], [8, 96]), np.r_[np.arange(8), np.repeat(np.arange(8), 12)]
    inside = np.zeros(2)
    n_draws = 2000
    for _ in range(n_draws):
        sensitivity = rng.normal(size=(104, 3))
        # The truth is no change at all.
        values = rng.normal(size=104) * np.sqrt(1.0 + model_error**2)
        fit = fitted(sensitivity, values, classes=classes, groups=groups)
        change = np.linalg.lstsq(sensitivity, values, rcond=None)[0]
        for place, known in enumerate((fit, with_model_error(fit)[0])):
            inside[place] += np.mean(np.abs(change) < 1.96 * errors(known)) / n_draws
    noise, whole = inside
    assert 0.94 < whole < 0.98
    assert noise < 0.55 if model_error else noise > 0.94


def test_errors_are_withheld_where_modes_contradict_each_other_beyond_chance() -> None:
    """An error common to all entries of a mode, which its parameters move together, is no noise."""
    rng = np.random.default_rng(3)
    groups = np.repeat(np.arange(6), 20)
    withheld = {}
    for common in (0.0, 8.0):
        found = []
        for _ in range(100):
            sensitivity = np.repeat(rng.normal(size=(6, 2)), 20, axis=0)
            values = rng.normal(size=120) + common * np.repeat(rng.normal(size=6), 20)
            missed, n = missed_modes(fitted(sensitivity, values, groups=groups))
            found.append(too_many_missed(len(missed), n))
        withheld[common] = np.mean(found)
    assert withheld[0.0] <= 0.05
    # The ratio of the class covers a part of such an error.
    assert withheld[8.0] >= 0.3


@pytest.mark.parametrize(
    ("n", "least"), [(2, 2), (3, 2), (5, 2), (6, 3), (10, 3), (20, 5), (40, 9)]
)
def test_a_few_missed_modes_are_chance(n: int, least: int) -> None:
    """The binomial distribution rules few modes, the share of a fifth many."""
    assert [too_many_missed(k, n) for k in (least - 1, least)] == [False, True]
    assert not too_many_missed(0, 0)


#: A building of ten storeys with stiffnesses in three groups.
STOREYS, GROUPS = 10, 3
RESPONSES = (Frequencies(), Shapes())


def building(
    stiffness: Floats, mass: Floats, more: Floats | float = 0.0, heavier: Floats | float = 0.0
) -> ModeSet:
    """Return all modes of a chain of masses on springs, the first to the ground.

    more, heavier: (n, n), added to stiffness and mass.
    """
    springs = np.diag(stiffness) + np.diag(np.append(stiffness[1:], 0.0))
    springs -= np.diag(stiffness[1:], 1) + np.diag(stiffness[1:], -1)
    values, shapes = scipy.linalg.eigh(springs + more, np.diag(mass) + heavier)
    hz = np.sqrt(values) / (2.0 * np.pi)
    nodes = np.arange(1, STOREYS + 1)
    return mode_set(hz, shapes, nodes, np.ones(STOREYS), normalisation="mass")


def state_of(model: ModeSet, test: ModeSet) -> ModelState:
    weighting = even_weighting(test.n_modes, test.n_dof, 0.002, 0.05)
    order = pair_by_order(test, model)
    numbers = tuple(range(1, test.n_modes + 1))
    return ModelState(MeasuredModes(numbers, test), weighting, model, order)


def noisy(modes: ModeSet, frequency: float, shape: float, rng: np.random.Generator) -> ModeSet:
    """Return modes with relative deviations of frequencies, and of shapes relative to their rms."""
    sizes = np.sqrt(np.mean(modes.mode_shapes**2, axis=0))
    return replace(
        modes,
        frequencies_hz=modes.frequencies_hz * (1.0 + frequency * rng.normal(size=modes.n_modes)),
        mode_shapes=modes.mode_shapes + shape * sizes * rng.normal(size=modes.mode_shapes.shape),
    )


def residual_of(theta: Floats, groups: Integers, test: ModeSet) -> Residual:
    state = state_of(building(1e3 * theta[groups], np.ones(STOREYS)), test)
    return stacked([[item.residual(state) for item in RESPONSES]])


def slopes_of(theta: Floats, groups: Integers, test: ModeSet) -> Floats:
    """Return the sensitivity by central differences, (n_residuals, n_groups)."""
    steps = 1e-5 * np.eye(GROUPS)
    ends = [[residual_of(theta + s, groups, test).values for s in (-h, h)] for h in steps]
    return np.column_stack([(low - high) / 2e-5 for low, high in ends])


def values_of(state: ModelState) -> Floats:
    return np.concatenate([item.residual(state).values for item in RESPONSES])


def test_columns_are_the_derivatives_by_masses_springs_and_links() -> None:
    """Against differences of models with a mass more, a spring to ground, a stiffer storey."""
    rng = np.random.default_rng(4)
    stiffness, mass = rng.uniform(900.0, 1100.0, STOREYS), rng.uniform(0.9, 1.1, STOREYS)
    test = building(stiffness, rng.uniform(0.9, 1.1, STOREYS)).select(range(4))
    model = building(stiffness, mass)
    columns = model_error_columns(state_of(model, test), RESPONSES)
    kinds = np.split(columns, [STOREYS, 2 * STOREYS], axis=1)
    slopes = (test.eigenvalues / model.eigenvalues[:4])[:, None]
    for found in kinds:
        assert np.mean(np.sum((found[:4] * slopes) ** 2, axis=1)) == pytest.approx(1.0)
    eye = np.eye(STOREYS)
    ways = {
        "mass": [(0.0 * eye, np.diag(own)) for own in eye],
        "spring": [(np.diag(own), 0.0 * eye) for own in eye],
        "link": [(np.outer(own, own), 0.0 * eye) for own in np.diff(eye, axis=0)],
    }
    for found, (kind, changes) in zip(kinds, ways.items(), strict=True):
        steps = []
        for more, heavier in changes:
            size = 1e-5 * (1000.0 if kind != "mass" else 1.0)
            ends = [
                values_of(state_of(building(stiffness, mass, s * more, s * heavier), test))
                for s in (size, -size)
            ]
            steps.append((ends[1] - ends[0]) / (2.0 * size))
        wanted = np.column_stack(steps)
        if kind == "link":  # of some pairs of neighbours
            turns = (
                found.T @ wanted / np.outer(*(np.linalg.norm(x, axis=0) for x in (found, wanted)))
            )
            wanted = wanted[:, turns.argmax(axis=1)]
        factor = float(np.sum(found * wanted) / np.sum(wanted**2))
        assert factor > 0.0
        np.testing.assert_allclose(found, factor * wanted, atol=1e-6 * np.abs(found).max())


def test_a_model_that_lacks_a_mass_has_intervals_that_contain_the_truth() -> None:
    """Three stiffnesses of 50 buildings, one storey 10 to 40 % heavier than in the model.

    By noise alone most intervals miss the truth; 95 % of 150 scatter by 3.6 % (two deviations).
    """
    rng = np.random.default_rng(8)
    groups, one = np.arange(STOREYS) % GROUPS, np.ones(STOREYS)
    inside = np.zeros(2)
    for _ in range(50):
        truth, heavier = rng.uniform(0.9, 1.1, GROUPS), one.copy()
        heavier[rng.integers(STOREYS)] += rng.uniform(0.1, 0.4)
        test = noisy(building(1e3 * truth[groups], heavier).select(range(6)), 0.002, 0.05, rng)
        theta = np.ones(GROUPS)
        for _ in range(5):
            rows, left = slopes_of(theta, groups, test), residual_of(theta, groups, test)
            root = 1.0 / np.sqrt(left.variances)
            theta = theta + np.linalg.lstsq(rows * root[:, None], left.values * root, rcond=None)[0]
        state = state_of(building(1e3 * theta[groups], one), test)
        columns = model_error_columns(state, RESPONSES)
        none = np.zeros(GROUPS)
        left = residual_of(theta, groups, test)
        fit = linear_fit(left, slopes_of(theta, groups, test), none, left.weights, columns)
        for place, known in enumerate(
            (replace(fit, errors=columns[:, :0]), with_model_error(fit)[0])
        ):
            inside[place] += float(np.mean(np.abs(theta - truth) < 1.96 * errors(known)))
    assert inside[0] < 30.0
    assert inside[1] > 46.0
