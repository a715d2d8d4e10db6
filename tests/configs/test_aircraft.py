"""The GARTEUR generator: sizes, mass and joints from the published dimensions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modetune.configs.garteur.aircraft import (
    COARSE,
    FINE,
    GROUPS,
    MESHES,
    AircraftMesh,
    Floats,
    aircraft,
    blocks,
)
from modetune.configs.garteur.twin import write_twin

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "garteur"
#: mm, from the published dimensions: fuselage, wing, fin, tailplane, two drums.
VOLUMES = {
    "FUSELAGE": 1500.0 * 50.0 * 150.0,
    "WING": 2000.0 * 100.0 * 10.0,
    "FIN": 300.0 * 100.0 * 10.0,
    "TAILPLANE": 400.0 * 100.0 * 10.0,
    "DRUMS": 2 * 400.0 * 100.0 * 10.0,
}


def element_volumes(mesh: AircraftMesh) -> dict[str, float]:
    model = aircraft(mesh)
    volumes = {}
    for group in GROUPS:
        corners = model.nodes[model.elements[group] - 1]
        edges = [corners[:, i] - corners[:, 0] for i in (1, 3, 4)]
        triple = np.einsum("ij,ij->i", np.cross(edges[0], edges[1]), edges[2])
        assert (triple > 0.0).all()  # right-handed numbering
        volumes[group] = float(triple.sum())
    return volumes


def test_the_fine_mesh_is_of_the_thesiss_size() -> None:
    model = aircraft(FINE)
    # Thesis 5.1: 20,540 HEX8 and 29,028 nodes.
    assert sum(map(len, model.elements.values())) == pytest.approx(20_540, rel=0.2)
    assert len(model.nodes) == pytest.approx(29_028, rel=0.2)


def test_the_coarse_mesh_is_small() -> None:
    assert len(aircraft(COARSE).nodes) < 3000


@pytest.mark.parametrize("name", MESHES)
def test_volumes_are_those_of_the_dimensions(name: str) -> None:
    assert element_volumes(MESHES[name]) == pytest.approx(VOLUMES)


@pytest.mark.parametrize("name", MESHES)
def test_parts_share_all_nodes_of_their_joints(name: str) -> None:
    model = aircraft(MESHES[name])
    of = {group: set(model.elements[group].ravel().tolist()) for group in GROUPS}

    def joint(first: str, second: str) -> Floats:
        return np.asarray(model.nodes[np.array(sorted(of[first] & of[second])) - 1])

    # The joint's nodes span the whole contact area, on both sides' grids alike.
    for first, second, low, high in (
        ("WING", "FUSELAGE", (550, -25, 75), (650, 25, 75)),
        ("FIN", "FUSELAGE", (1400, -5, 75), (1500, 5, 75)),
        ("TAILPLANE", "FIN", (1400, -5, 375), (1500, 5, 375)),
        ("DRUMS", "WING", (550, -1000, 85), (650, 1000, 85)),
    ):
        nodes = joint(first, second)
        np.testing.assert_allclose(nodes.min(axis=0), low)
        np.testing.assert_allclose(nodes.max(axis=0), high)
        for group in (first, second):
            inside = model.nodes[np.array(sorted(of[group])) - 1]
            near = ((inside >= np.array(low) - 1e-6) & (inside <= np.array(high) + 1e-6)).all(1)
            if second == "WING":
                near &= np.abs(inside[:, 1]) >= 900.0 - 1e-6
            assert near.sum() == len(nodes)


def test_no_two_nodes_stand_at_one_place() -> None:
    nodes = aircraft(FINE).nodes
    assert len(np.unique(nodes.round(3), axis=0)) == len(nodes)


def test_left_and_right_mirror_each_other() -> None:
    for block in blocks(COARSE):
        if block.group != "DRUMS":
            np.testing.assert_allclose(block.y, -block.y[::-1])


def test_the_twins_test_files_are_what_their_generator_writes(tmp_path: Path) -> None:
    write_twin(tmp_path)
    for name in ("twin_measured.csv", "twin_noisy.csv"):
        fresh = (tmp_path / name).read_text().splitlines()
        kept = (CONFIGS / name).read_text().splitlines()
        assert len(fresh) == len(kept)
        for new, old in zip(fresh, kept, strict=True):
            if new.startswith(("#", "mode")):
                assert new == old
                continue
            numbers = [np.array(line.split(",")[1:], dtype=float) for line in (new, old)]
            # ccx prints seven digits; another build of it may turn a shape's sign.
            np.testing.assert_allclose(np.abs(numbers[0]), np.abs(numbers[1]), rtol=1e-4, atol=1e-4)
