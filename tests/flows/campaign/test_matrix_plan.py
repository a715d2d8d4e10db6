"""Which matrix jobs a set of parameters takes, counted by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from modetune.adapters.solver import AffectedElements
from modetune.flows.campaign.matrix_plan import FACTORS, LINEAR_FACTORS, MatrixPlan, Sampling, plan

THICKNESS = (-1, 1, 2, 3)
#: An element that is in no parameter.
OTHER = 99


def part(place: int, stiffness: bool = True, mass: bool = False) -> AffectedElements:
    """The place-th brick of a row, whose end nodes the bricks beside it share."""
    nodes = frozenset({place, place + 1})
    return AffectedElements(frozenset({place}), nodes, stiffness, mass, (1,), proportional=not mass)


def thick(place: int) -> AffectedElements:
    """The same place as a shell whose thickness is the parameter."""
    nodes = frozenset({place, place + 1})
    return AffectedElements(frozenset({place}), nodes, True, True, THICKNESS, proportional=False)


def planned(*affected: AffectedElements, initial: float = 1.0, whole: bool = False) -> MatrixPlan:
    """The plan of a model that has these parameters' elements, and one more unless whole."""
    samplings = {
        place: Sampling(item, item.powers, LINEAR_FACTORS if item.powers == (1,) else FACTORS[:4])
        for place, item in enumerate(affected)
    }
    elements = frozenset[int]().union(*(item.elements for item in affected))
    theta = np.full(len(affected), initial)
    return plan(theta, samplings, elements if whole else elements | {OTHER})


def moved(found: MatrixPlan) -> list[tuple[int, ...]]:
    return sorted(sample.columns for sample in found.samples)


def test_parameters_that_share_a_node_get_jobs_of_their_own() -> None:
    found = planned(part(1), part(2))
    assert moved(found) == [(0,), (1,)]
    assert found.rest == ()


def test_disjoint_parameters_go_in_one_job() -> None:
    found = planned(part(1), part(3), part(5))
    (sample,) = found.samples
    assert sample.columns == (0, 1, 2)
    assert sample.theta == (LINEAR_FACTORS[0],) * 3


def test_a_row_of_ten_parts_takes_two_jobs() -> None:
    # Neighbours alone collide: the even and the odd ones.
    found = planned(*(part(place) for place in range(10)))
    assert moved(found) == [(0, 2, 4, 6, 8), (1, 3, 5, 7, 9)]


def test_modulus_and_density_of_one_material_share_a_job() -> None:
    found = planned(part(1), part(1, stiffness=False, mass=True))
    (sample,) = found.samples
    assert sample.columns == (0, 1)


def test_densities_of_neighbours_do_not_share_a_job() -> None:
    found = planned(*(part(place, stiffness=False, mass=True) for place in (1, 2)))
    assert moved(found) == [(0,), (1,)]


def test_a_thickness_takes_four_jobs_each_at_a_factor_of_its_own() -> None:
    found = planned(thick(1), initial=1.2)
    assert moved(found) == [(0,)] * 4
    values = [sample.theta[0] for sample in found.samples]
    # A factor is on the initial value; four powers take four of them and the base.
    np.testing.assert_allclose(values, [1.2 * factor for factor in FACTORS[:4]], rtol=1e-15)


def test_a_modulus_goes_with_the_first_job_of_a_thickness_far_from_it() -> None:
    found = planned(thick(1), part(5))
    assert moved(found) == [(0,), (0,), (0,), (0, 1)]
    (both,) = (sample for sample in found.samples if sample.columns == (0, 1))
    assert both.theta == (FACTORS[0], LINEAR_FACTORS[0])
    assert all(sample.theta[1] == 1.0 for sample in found.samples if sample is not both)


def test_thickness_and_density_of_neighbours_do_not_share_a_job() -> None:
    # A thickness moves the mass too.
    found = planned(thick(1), part(2, stiffness=False, mass=True))
    assert moved(found) == [(0,), (0,), (0,), (0,), (1,)]


def test_moduli_of_the_whole_model_spare_the_largest_colour() -> None:
    found = planned(part(1), part(2), part(3), whole=True)
    assert found.rest == (0, 2)
    assert moved(found) == [(1,)]


def test_one_modulus_of_a_whole_model_takes_no_job_but_the_base() -> None:
    found = planned(part(1), whole=True)
    assert found == MatrixPlan((1.0,), (), (0,))


def test_an_element_in_no_parameter_leaves_nothing_to_spare() -> None:
    found = planned(part(1), part(2), part(3))
    assert found.rest == ()
    assert moved(found) == [(0, 2), (1,)]


@pytest.mark.parametrize(
    "beside", [part(3, stiffness=False, mass=True), thick(3)], ids=["density", "thickness"]
)
def test_a_parameter_that_is_no_modulus_leaves_nothing_to_spare(beside: AffectedElements) -> None:
    found = planned(part(1), part(2), beside, whole=True)
    assert found.rest == ()
    assert {column for sample in found.samples for column in sample.columns} == {0, 1, 2}


def test_no_job_moves_two_parameters_that_touch_one_entry_of_a_matrix() -> None:
    rng = np.random.default_rng(7)
    for _ in range(50):
        affected = [
            AffectedElements(
                frozenset({n}),
                frozenset(rng.choice(12, 3, replace=False).tolist()),
                kind != 1,
                kind != 0,
                THICKNESS if kind == 2 else (1,),
                kind == 0,
            )
            for n, kind in enumerate(rng.integers(0, 3, 8).tolist())
        ]
        found = planned(*affected)
        for sample in found.samples:
            items = [affected[column] for column in sample.columns]
            for one, other in ((a, b) for a in items for b in items if a is not b):
                shared = (one.stiffness and other.stiffness) or (one.mass and other.mass)
                assert not shared or one.nodes.isdisjoint(other.nodes)
        jobs = [sum(n in sample.columns for sample in found.samples) for n in range(8)]
        assert jobs == [len(item.powers) for item in affected]  # as many as powers, no more


def test_a_layer_among_others_is_not_all_of_its_elements() -> None:
    layer = replace(part(1), proportional=False)
    assert planned(layer, whole=True).rest == ()


def test_elements_of_two_parameters_leave_nothing_to_spare() -> None:
    found = planned(part(1), part(1), whole=True)
    assert found.rest == ()
    assert moved(found) == [(0,), (1,)]


def test_a_parameter_without_powers_takes_two_pairs_by_itself() -> None:
    pairs = (1.01, 1 / 1.01, 1.02, 1 / 1.02)
    samplings = {
        0: Sampling(None, (), pairs),
        1: Sampling(part(5), (1,), LINEAR_FACTORS),
        2: Sampling(part(7), (1,), LINEAR_FACTORS),
    }
    found = plan(np.array([1.1, 1.0, 1.0]), samplings, frozenset({5, 7}))
    assert moved(found) == [(0,)] * 4 + [(1, 2)]
    values = [sample.theta[0] for sample in found.samples if sample.columns == (0,)]
    np.testing.assert_allclose(values, 1.1 * np.array(pairs))
