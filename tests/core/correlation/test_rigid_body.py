"""Mass properties from rigid-body modes alone, against point masses summed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from modetune.core.correlation.correlation import rigid_body_shapes
from modetune.core.correlation.rigid_body import rigid_body_of_modes
from modetune.core.errors import ModesError
from modetune.core.modes import Floats, Integers


def rigid_modes(masses: Floats, places: Floats, seed: int) -> tuple[Floats, Floats, Integers]:
    """Six rigid modes of unit modal mass of point masses, turned among each other at random."""
    n = masses.size
    coordinates, components = np.repeat(places, 3, axis=0), np.tile(np.arange(1, 4), n)
    motions = rigid_body_shapes(coordinates, components)
    mass = motions.T @ (np.repeat(masses, 3)[:, None] * motions)
    turn, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((6, 6)))
    return motions @ np.linalg.inv(np.linalg.cholesky(mass)).T @ turn, coordinates, components


def test_point_masses_are_found_from_their_rigid_modes() -> None:
    random = np.random.default_rng(7)
    masses, places = random.uniform(1.0, 3.0, 9), random.uniform(-900.0, 2500.0, (9, 3))
    modes, coordinates, components = rigid_modes(masses, places, 1)
    body = rigid_body_of_modes(modes, coordinates, components)
    # By hand: sums over the masses, Steiner's theorem left to the sums about the centre.
    centre = masses @ places / masses.sum()
    about = places - centre
    inertia = sum(
        m * (x @ x * np.eye(3) - np.outer(x, x)) for m, x in zip(masses, about, strict=True)
    )
    assert body.mass == pytest.approx(masses.sum(), rel=1e-9)
    assert body.centre == pytest.approx(centre, rel=1e-9)
    assert body.inertia == pytest.approx(inertia, rel=1e-7, abs=1e-7 * inertia.trace())
    assert body.spread < 1e-9


def test_a_few_nodes_tell_the_mass_of_all() -> None:
    random = np.random.default_rng(8)
    masses, places = random.uniform(1.0, 3.0, 9), random.uniform(-1.0, 1.0, (9, 3))
    modes, coordinates, components = rigid_modes(masses, places, 2)
    body = rigid_body_of_modes(modes[:12], coordinates[:12], components[:12])
    assert body.mass == pytest.approx(masses.sum(), rel=1e-9)


def test_rotations_of_nodes_count_as_rotations() -> None:
    # A body of mass 2 and moments 3, 4, 5 at one node with six components.
    modes = np.diag(1.0 / np.sqrt([2.0, 2.0, 2.0, 3.0, 4.0, 5.0]))
    body = rigid_body_of_modes(modes, np.tile([[7.0, 8.0, 9.0]], (6, 1)), np.arange(1, 7))
    assert body.mass == pytest.approx(2.0)
    assert body.centre == pytest.approx([7.0, 8.0, 9.0])
    assert body.inertia == pytest.approx(np.diag([3.0, 4.0, 5.0]))


def test_modes_that_bend_are_no_rigid_motions() -> None:
    random = np.random.default_rng(9)
    modes, coordinates, components = rigid_modes(np.ones(6), random.uniform(-1, 1, (6, 3)), 3)
    modes[:, 2] += 0.1 * random.standard_normal(18)
    with pytest.raises(ModesError, match="are not rigid motions"):
        rigid_body_of_modes(modes, coordinates, components)


def test_nodes_on_a_line_do_not_tell_and_five_modes_are_too_few() -> None:
    places = np.outer(np.linspace(0.0, 1.0, 5), [1.0, 2.0, 3.0])
    coordinates, components = np.repeat(places, 3, axis=0), np.tile(np.arange(1, 4), 5)
    motions = rigid_body_shapes(coordinates, components)
    with pytest.raises(ModesError, match="do not separate six rigid motions"):
        rigid_body_of_modes(motions, coordinates, components)
    with pytest.raises(ModesError, match="six are needed"):
        rigid_body_of_modes(motions[:, :5], coordinates, components)
