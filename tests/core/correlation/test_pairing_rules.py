"""Pairs by hand, pairs that cannot be, modes left out, and pairs that are not certain."""

from __future__ import annotations

import numpy as np
import pytest

from modetune.core.correlation.pairing import (
    LostMode,
    NotAmongComputed,
    Pairing,
    PairRules,
    first_pairing,
    next_pairing,
    uncertain_pairs,
)
from modetune.core.modes import Floats, MeasuredModes, ModeSet, mode_set
from modetune.core.parameters import Parameter, ParameterSet, Quantity, frequency_reach

SPLIT = 0.002
NOBODY = np.zeros(0)
#: A wing: its mode in the plane is measured at 60.7 Hz and computed at 107.5 Hz.
WING_TEST = [10.1, 20.2, 40.4, 60.7, 81.5]
WING_MODEL = [10.0, 20.0, 40.0, 81.3, 107.5]


def of_places(hz: list[float], places: list[int] | None = None) -> ModeSet:
    """Modes that move one of nine points each, by its place."""
    shapes = np.eye(9)[:, range(len(hz)) if places is None else places]
    return mode_set(hz, shapes, np.arange(9), np.full(9, 3))


def measured(hz: list[float], places: list[int]) -> MeasuredModes:
    return MeasuredModes(tuple(range(1, len(hz) + 1)), of_places(hz, places))


def frequencies_only(hz: list[float]) -> MeasuredModes:
    return MeasuredModes(tuple(range(1, len(hz) + 1)), mode_set(hz))


def first(test: MeasuredModes, model: ModeSet, rules: PairRules, drop: bool = False) -> Pairing:
    return first_pairing(test, model, rules, SPLIT, NOBODY, drop)


def test_named_pairs_come_first_and_the_others_keep_their_order() -> None:
    test, model = frequencies_only(WING_TEST), of_places(WING_MODEL)
    pairing = first(test, model, PairRules({4: 5}))
    assert pairing.measured.tolist() == [0, 1, 2, 3, 4]
    assert pairing.computed.tolist() == [0, 1, 2, 4, 3]
    assert pairing.reasons[3] == "named by hand"


def test_a_named_pair_has_its_mac_and_follows_its_computed_shape() -> None:
    test, model = measured([10.0, 20.0], [0, 1]), of_places([10.0, 20.0, 30.0])
    rules = PairRules({2: 3})
    pairing = first(test, model, rules)
    assert pairing.computed.tolist() == [0, 2]
    np.testing.assert_allclose(pairing.mac, [1.0, 0.0])
    moved = of_places([10.0, 15.0, 21.0], [0, 2, 1])  # the third has become the second
    again = next_pairing(test, moved, moved, (pairing, model), rules, SPLIT)
    assert again.computed.tolist() == [0, 1]


def test_a_mode_that_is_named_and_not_computed_is_told_with_the_nearest() -> None:
    with pytest.raises(NotAmongComputed, match=r"5 computed elastic modes.*elastic mode 4 at 81.3"):
        first(frequencies_only(WING_TEST), of_places(WING_MODEL), PairRules({5: 9}))


def test_shapes_make_no_pair_that_bounds_cannot_bring_together() -> None:
    test, model = measured([10.0, 44.85], [0, 1]), of_places([10.0, 3947.0])
    assert first(test, model, PairRules()).computed.tolist() == [0, 1]
    with pytest.raises(
        LostMode, match=r"3947 Hz, with MAC 1.00, is no pair.* 1974 to 7813 Hz"
    ) as e:
        first(test, model, PairRules(reach=(0.7, 1.414)))
    assert not e.value.above  # more modes would lie higher still


def test_modes_without_a_partner_are_left_out_of_all_that_follows() -> None:
    test, model = measured([10.0, 15.0, 20.0], [0, 8, 1]), of_places([10.0, 20.0])
    with pytest.raises(LostMode):
        first(test, model, PairRules())
    pairing = first(test, model, PairRules(drop=True), drop=True)
    assert pairing.measured.tolist() == [0, 2]
    found = of_places([10.0, 15.0, 20.0], [0, 8, 1])  # later it would be there
    again = next_pairing(test, found, found, (pairing, model), PairRules(drop=True), SPLIT)
    assert again.measured.tolist() == [0, 2]
    assert again.computed.tolist() == [0, 2]


def test_without_shapes_a_mode_out_of_reach_is_left_out_and_the_order_closes() -> None:
    test, model = frequencies_only(WING_TEST), of_places(WING_MODEL)
    pairing = first(test, model, PairRules(drop=True, reach=(0.85, 1.15)), drop=True)
    assert pairing.measured.tolist() == [0, 1, 2, 4]
    assert pairing.computed.tolist() == [0, 1, 2, 3]


def test_a_mode_of_another_order_makes_pairs_uncertain_until_they_are_named() -> None:
    test, model = frequencies_only(WING_TEST), of_places(WING_MODEL)
    rules = PairRules(reach=(0.4, 1.5))
    found = uncertain_pairs(test, model, first(test, model, rules), rules)
    assert list(found) == [5]
    assert "elastic mode 4 at 81.3 Hz is far nearer" in found[5]
    for named in (PairRules({5: 5}), PairRules({4: 5, 5: 4})):
        assert uncertain_pairs(test, model, first(test, model, named), named) == {}


@pytest.mark.parametrize("factor", [0.7, 1.0, 1.4])
def test_a_model_that_is_too_stiff_or_soft_all_over_is_no_doubt(factor: float) -> None:
    hz = [10.0, 11.0, 12.5, 13.0, 14.5, 15.5]
    test, model = frequencies_only(hz), of_places([factor * item for item in hz])
    rules = PairRules()
    assert uncertain_pairs(test, model, first(test, model, rules), rules) == {}


def test_without_shapes_bounds_that_cannot_bring_a_pair_together_are_told_with_figures() -> None:
    test, model = frequencies_only([10.0, 20.0]), of_places([10.0, 25.0])
    rules = PairRules(reach=(0.9, 1.1))
    found = uncertain_pairs(test, model, first(test, model, rules), rules)
    assert found == {
        2: "20 Hz measured and 25 Hz computed, which the parameters' bounds let become "
        "22.5 to 27.5 Hz"
    }


def parameter(quantity: Quantity, lower: float, upper: float) -> Parameter:
    return Parameter(quantity, quantity, "material", ("A",), lower, upper, 0.2)


@pytest.mark.parametrize(
    ("parameters", "reach"),
    [
        ([parameter("youngs_modulus", 0.5, 2.0)], (0.5**0.5, 2.0**0.5)),
        ([parameter("density", 0.5, 2.0)], (0.5**0.5, 2.0**0.5)),
        # A plate's frequency goes with its thickness, that of a mass on it with the root of t^3.
        ([parameter("thickness", 0.8, 1.25)], (0.8**2, 1.25**2)),
        (
            [parameter("youngs_modulus", 0.5, 2.0), parameter("density", 0.5, 2.0)],
            (0.5, 2.0),
        ),
    ],
)
def test_reach_is_rayleighs_bound(parameters: list[Parameter], reach: tuple[float, float]) -> None:
    found = ParameterSet(tuple(parameters))
    np.testing.assert_allclose(frequency_reach(found, found.initial), reach)


def test_no_frequency_of_a_chain_leaves_its_reach() -> None:
    noise = np.random.default_rng(4)
    springs = ParameterSet(
        tuple(parameter("spring_stiffness", 0.3, 3.0) for _ in range(5))
        + tuple(parameter("mass", 0.5, 2.0) for _ in range(5))
    )
    low, high = frequency_reach(springs, springs.initial)
    start = frequencies(np.ones(10))
    for _ in range(50):
        ratio = frequencies(noise.uniform(springs.lower, springs.upper)) / start
        assert (ratio >= low).all()
        assert (ratio <= high).all()


def frequencies(theta: Floats) -> Floats:
    k, m = theta[:5], theta[5:]
    stiffness = np.diag(k + np.append(k[1:], 0.0)) - np.diag(k[1:], 1) - np.diag(k[1:], -1)
    return np.asarray(np.sqrt(np.linalg.eigvalsh(stiffness / np.sqrt(np.outer(m, m)))))
