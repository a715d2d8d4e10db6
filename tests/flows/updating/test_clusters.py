"""Updates of structures with close modes: the truth, whichever way the test's shapes are turned."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from benchmarks.zoo.solids import bricks
from benchmarks.zoo.structure import elements, rows

import modetune
from modetune.core.modes import COMPONENTS, Floats, ModeSet

TRUTH = np.array([1.2, 0.85])
N = 12


def chain(share: float) -> dict[str, Any]:
    """A chain of twelve masses held at one end, in x and y, stiffer in y by a share."""
    parts = {}
    for name, span in (("lower", range(N // 2)), ("upper", range(N // 2, N))):
        part = np.zeros((N, N))
        for spring in span:
            part[spring, spring] += 1e6
            if spring:
                part[spring - 1, spring - 1] += 1e6
                part[[spring, spring - 1], [spring - 1, spring]] -= 1e6
        parts[name] = {"stiffness": np.kron(part, np.diag([1.0, 1.0 + share]))}
    return {
        "stiffness": sum(part["stiffness"] for part in parts.values()),
        "mass": np.eye(2 * N),
        "parts": parts,
        "dofs": [f"{mass}.{axis}" for mass in range(1, N + 1) for axis in "xy"],
        "units": "m-kg-s",
    }


CHAIN_PARAMETERS = [
    {"name": name, "quantity": "matrix_factor", "part": name} for name in ("lower", "upper")
]


def cantilever() -> tuple[str, list[int]]:
    """A square cantilever of C3D20, 190 mm by 2 mm, and the nodes of an edge and its opposite."""
    nodes, table, ids = bricks(6, 1, 1, lambda x, y, z: (190.0 * x, 2.0 * y, 2.0 * z))
    held = [node for (i, _, _), node in ids.items() if i == 0]
    sections = "".join(
        f"*MATERIAL, NAME={name}\n*ELASTIC\n70000., 0.3\n*DENSITY\n2.7e-9\n"
        f"*SOLID SECTION, ELSET={name}, MATERIAL={name}\n"
        for name in ("LOWER", "UPPER")
    )
    deck = (
        f"*NODE, NSET=NALL\n{rows(nodes)}"
        + elements("C3D20", "LOWER", range(1, 4), table)
        + elements("C3D20", "UPPER", range(4, 7), table)
        + sections
        + f"*BOUNDARY\n{rows((node, 1, 3) for node in held)}"
    )
    return deck, [node for (i, j, k), node in ids.items() if i and not i % 4 and j == k != 1]


def campaign(
    folder: Path, model: dict[str, Any], test: dict[str, Any], parameters: list[Any], e1: float
) -> modetune.Campaign:
    return modetune.load(
        {
            "name": "close",
            "model": model,
            "test": test,
            "parameters": parameters,
            "residuals": {"shape_weight": 1.0},
            "update": {"e1": {"frequency": e1}},
            "report": {"page": False},
            "run": {"parallel": 1, "threads": 1},
            "store": str(folder / "store"),
        },
        folder=folder / "campaign",
    )


def measured(modes: ModeSet) -> dict[str, Any]:
    names = zip(modes.nodes.tolist(), modes.components.tolist(), strict=True)
    return {
        "frequencies_hz": modes.frequencies_hz,
        "mode_shapes": np.real(modes.mode_shapes),
        "dofs": [f"{node}.{COMPONENTS[component - 1]}" for node, component in names],
    }


def turned(modes: ModeSet, angle: float) -> ModeSet:
    """Each doublet turned by an angle, in degrees."""
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    shapes = np.real(modes.mode_shapes).copy()
    for first in range(0, modes.n_modes - 1, 2):
        shapes[:, first : first + 2] = shapes[:, first : first + 2] @ [[cos, -sin], [sin, cos]]
    return replace(modes, mode_shapes=shapes)


def true_modes(
    folder: Path, model: dict[str, Any], parameters: list[Any], dofs: list[str], n_modes: int
) -> ModeSet:
    asked = {
        "frequencies_hz": np.arange(1.0, n_modes + 1.0),
        "mode_shapes": np.ones((len(dofs), n_modes)),
        "dofs": dofs,
    }
    names = [item["name"] for item in parameters]
    first = campaign(folder, model, asked, parameters, 0.01)
    found = modetune.modes(first, dict(zip(names, TRUTH.tolist(), strict=True))).elastic
    have = [
        f"{node}.{COMPONENTS[component - 1]}"
        for node, component in zip(found.nodes.tolist(), found.components.tolist(), strict=True)
    ]
    return found.rows([have.index(name) for name in dofs]).select(range(n_modes))


def ended(run: modetune.CampaignRun) -> tuple[Floats, str, bool]:
    told = run.summary
    return run.record.updated, told["trust"]["verdict"], told["model_form"]["suspected"]


@pytest.mark.parametrize("share", [0.0, 1e-6, 1e-4, 3e-3])
def test_turned_doublets_that_the_test_cannot_split_end_at_the_truth(
    tmp_path: Path, share: float
) -> None:
    model = chain(share)
    dofs = [f"{mass}.{axis}" for mass in range(1, N, 2) for axis in "xy"]
    modes = true_modes(tmp_path, model, CHAIN_PARAMETERS, dofs, 6)
    counts = set()
    for angle in (0.0, 25.0):
        test = measured(turned(modes, angle))
        twin = campaign(tmp_path / str(angle), model, test, CHAIN_PARAMETERS, 1e-8)
        run = modetune.update(twin, tmp_path / str(angle))
        updated, verdict, suspected = ended(run)
        np.testing.assert_allclose(updated, TRUTH, rtol=1e-6)
        assert run.record.status == "converged"
        assert verdict == "trusted"
        assert not suspected
        counts.add(len(run.record.iterations))
    assert len(counts) == 1  # the same steps


def test_a_square_cantilever_ends_at_the_truth_whichever_way_its_doublets_lie(
    tmp_path: Path,
) -> None:
    deck, sensors = cantilever()
    (tmp_path / "model.inp").write_text(deck)
    model = {"deck": str(tmp_path / "model.inp"), "units": "mm-t-s"}
    parameters = [
        {"name": f"E_{name}", "quantity": "youngs_modulus", "material": name}
        for name in ("LOWER", "UPPER")
    ]
    dofs = [f"{node}.{axis}" for node in sensors for axis in "yz"]
    modes = true_modes(tmp_path, model, parameters, dofs, 4)
    for angle in (0.0, 30.0):
        test = measured(turned(modes, angle))
        run = modetune.update(
            campaign(tmp_path / str(angle), model, test, parameters, 1e-5), tmp_path / str(angle)
        )
        updated, verdict, suspected = ended(run)
        np.testing.assert_allclose(updated, TRUTH, rtol=1e-4)
        assert (verdict, suspected) == ("trusted", False)


def axes(coupling: float) -> tuple[dict[str, Any], list[Any]]:
    """Six masses in x and y with springs of their own, coupled so weakly that the model's modes
    lie at 45 degrees, and parameters that make it stiffer along one axis."""
    unit = 2.0 * np.eye(6) - np.diag(np.ones(5), 1) - np.diag(np.ones(5), -1)
    unit[-1, -1] = 1.0
    parts = {
        name: {"stiffness": 1e6 * np.kron(unit, np.diag(along))}
        for name, along in (("kx", [1.0, 0.0]), ("ky", [0.0, 1.0]))
    }
    between = coupling * 1e6 * np.kron(np.eye(6), [[1.0, -1.0], [-1.0, 1.0]])
    model = {
        "stiffness": sum(part["stiffness"] for part in parts.values()) + between,
        "mass": np.eye(12),
        "parts": parts,
        "dofs": [f"{mass}.{axis}" for mass in range(1, 7) for axis in "xy"],
        "units": "m-kg-s",
    }
    return model, [{"name": n, "quantity": "matrix_factor", "part": n} for n in parts]


@pytest.mark.parametrize("coupling", [0.0, 1e-5, 1e-4])
def test_shapes_of_a_split_test_tell_which_way_a_model_that_is_not_split_has_to_go(
    tmp_path: Path, coupling: float
) -> None:
    model, parameters = axes(coupling)
    names = [f"{mass}.{axis}" for mass in range(1, 7) for axis in "xy"]
    modes = true_modes(tmp_path, model, parameters, names, 6)
    run = modetune.update(
        campaign(tmp_path / "twin", model, measured(modes), parameters, 1e-6), tmp_path
    )
    np.testing.assert_allclose(run.record.updated, TRUTH, rtol=1e-4)


def ring(order: list[int]) -> dict[str, Any]:
    """Six equal masses on a ring, linked and held alike, numbered in this order in the matrices."""
    n = len(order)
    parts = {}
    for mass in range(n):
        link, held = np.zeros((n, n)), np.zeros((n, n))
        held[mass, mass] = 500.0
        ends = np.zeros(n)
        ends[[mass, (mass + 1) % n]] = [1.0, -1.0]
        link[:] = 1000.0 * np.outer(ends, ends)
        parts[f"link{mass + 1}"] = {"stiffness": link[np.ix_(order, order)]}
        parts[f"held{mass + 1}"] = {"stiffness": held[np.ix_(order, order)]}
    return {
        "stiffness": sum(part["stiffness"] for part in parts.values()),
        "mass": np.eye(n),
        "parts": parts,
        "dofs": [f"{mass + 1}.x" for mass in order],
    }


def test_repeated_modes_at_the_start_give_one_answer_in_any_order_of_the_unknowns(
    tmp_path: Path,
) -> None:
    """Frequencies alone, one start: only the basis of the start's doublets differs."""
    truth = {"link1": 1.2, "held3": 0.8, "link4": 0.9, "held6": 1.15}
    model = ring(list(range(6)))
    stiffness = model["stiffness"] + sum(
        (factor - 1.0) * model["parts"][name]["stiffness"] for name, factor in truth.items()
    )
    frequencies = np.sqrt(np.linalg.eigvalsh(stiffness)) / (2.0 * np.pi)
    answers = []
    for place, order in enumerate(([0, 1, 2, 3, 4, 5], [3, 2, 5, 4, 0, 1], [5, 4, 2, 1, 3, 0])):
        content = {
            "name": "ring",
            "model": ring(order),
            "test": {"frequencies_hz": frequencies},
            "parameters": [
                {"name": name, "quantity": "matrix_factor", "part": name} for name in truth
            ],
            "update": {"starts": 1},
            "report": {"page": False},
            "store": str(tmp_path / str(place)),
        }
        run = modetune.update(modetune.load(content, folder=tmp_path / str(place)))
        answers.append(run.record.updated)
    np.testing.assert_allclose(answers[1:], answers[:1] * 2, rtol=1e-6)
