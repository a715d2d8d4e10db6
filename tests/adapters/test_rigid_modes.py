"""How many modes are rigid, by strain energies: CalculiX's own runs, and stiffness matrices."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.process import run_process
from modetune.adapters.solver import ModalAnalysis
from modetune.core.algebra.eigen import solve_modes
from modetune.core.algebra.matrices import upper_triangle
from modetune.core.algebra.rigid_modes import (
    GIVEN,
    RigidByHand,
    count_rigid_modes,
    matrix_energies,
)
from modetune.core.errors import CampaignError
from modetune.core.modes import Floats
from modetune.core.updating.job_results import ModalResult

STEEL = "*MATERIAL, NAME=STEEL\n*ELASTIC\n2.1e11, 0.3\n*DENSITY\n7800.\n"


def block(
    n: tuple[int, int, int], size: tuple[float, float, float], first: int = 0
) -> tuple[list[str], list[list[int]], dict[tuple[int, ...], int]]:
    """Nodes and eight-node elements of a block; nodes are numbered from first + 1."""
    places = list(product(*(range(count + 1) for count in n)))
    ids = {place: first + number for number, place in enumerate(places, 1)}
    nodes = [
        f"{ids[place]}, "
        + ", ".join(
            f"{length * at / count:.9g}" for length, at, count in zip(size, place, n, strict=True)
        )
        for place in places
    ]
    ring = ((0, 0), (1, 0), (1, 1), (0, 1))
    table = [
        [ids[i + a, j + b, k + c] for c in (0, 1) for a, b in ring]
        for i, j, k in product(*(range(count) for count in n))
    ]
    return nodes, table, ids


def solid(springs: Sequence[tuple[int, float]] = (), kind: str = "C3D8I") -> str:
    """A steel block of 300 x 100 x 100 mm, on springs to ground at its lower corners."""
    nodes, table, ids = block((6, 2, 2), (0.3, 0.1, 0.1))
    rows = [f"{n}, " + ", ".join(map(str, row)) for n, row in enumerate(table, 1)]
    text = "*NODE\n" + "\n".join(nodes) + f"\n*ELEMENT, TYPE={kind}, ELSET=EALL\n"
    text += "\n".join(rows) + "\n" + STEEL + "*SOLID SECTION, ELSET=EALL, MATERIAL=STEEL\n"
    corners = [ids[i, j, 0] for i in (0, 6) for j in (0, 2)]
    for component, stiffness in springs:
        name = f"MOUNT{component}"
        mounts = [f"{100 * component + place}, {node}" for place, node in enumerate(corners)]
        text += f"*ELEMENT, TYPE=SPRING1, ELSET={name}\n" + "\n".join(mounts)
        text += f"\n*SPRING, ELSET={name}\n{component}\n{stiffness}\n"
    return text


def plate(kind: str) -> str:
    """A free plate of 500 x 300 x 2 mm."""
    ids = {place: n for n, place in enumerate(product(range(11), range(7)), 1)}
    nodes = [f"{n}, {0.05 * i:.9g}, {0.05 * j:.9g}, 0." for (i, j), n in ids.items()]
    table = [
        [ids[i, j], ids[i + 1, j], ids[i + 1, j + 1], ids[i, j + 1]]
        for i, j in product(range(10), range(6))
    ]
    rows = [f"{n}, " + ", ".join(map(str, row)) for n, row in enumerate(table, 1)]
    return (
        "*NODE\n" + "\n".join(nodes) + f"\n*ELEMENT, TYPE={kind}, ELSET=EALL\n" + "\n".join(rows)
        + "\n" + STEEL + "*SHELL SECTION, ELSET=EALL, MATERIAL=STEEL\n0.002\n"
    )  # fmt: skip


def hinged(n_hinges: int) -> str:
    """Free blocks in a row, joined along one edge each: a mode without strain for each hinge."""
    text, rows, equations = "*NODE\n", [], []
    last: dict[tuple[int, ...], int] = {}
    for body in range(n_hinges + 1):
        nodes, table, ids = block((1, 1, 1), (0.1, 0.05, 0.05), 8 * body)
        shifted = []
        for line in nodes:
            number, x, rest = line.split(", ", 2)
            shifted.append(f"{number}, {float(x) + 0.1 * body:.9g}, {rest}")
        text += "\n".join(shifted) + "\n"
        rows += table
        for corner in ((0, 0, 0), (0, 1, 0)) if body else ():
            far = last[(1, *corner[1:])]
            equations += [f"2\n{ids[corner]}, {axis}, 1., {far}, {axis}, -1." for axis in (1, 2, 3)]
        last = ids
    text += "*ELEMENT, TYPE=C3D8I, ELSET=EALL\n"
    text += "\n".join(f"{n}, " + ", ".join(map(str, row)) for n, row in enumerate(rows, 1))
    text += "\n" + STEEL + "*SOLID SECTION, ELSET=EALL, MATERIAL=STEEL\n"
    return text + "".join(f"*EQUATION\n{item}\n" for item in equations)


def solved(
    deck: str, folder: Path, n_modes: int = 10, nodes: tuple[int, ...] = (1, 2)
) -> ModalResult:
    file = folder / "model.inp"
    file.write_text(deck)
    solver, analysis = calculix_solver(file, ()), ModalAnalysis(n_modes, nodes)
    job = folder / "job"
    job.mkdir()
    solver.render({}, analysis).write(job)
    ended = run_process(solver.program.command(1), job, 120.0, threading.Event())
    result = solver.read({}, analysis, job, ended.return_code)
    assert isinstance(result, ModalResult)
    return result


SOFT = ((1, 2500.0), (2, 2500.0), (3, 2500.0))


@pytest.mark.parametrize(
    ("deck", "expected", "first_hz"),
    [
        (solid(), 6, 4567.0),
        (solid(SOFT), 0, None),
        # 23.4 kg on four vertical springs, sqrt(4 k / m) / 2 pi: sideways and about z it is free.
        (solid(((3, 924.0),)), 3, 2.0),
        (solid(kind="C3D8R"), 6, 4557.0),
        (plate("S4"), 6, 43.3),
        (plate("S4R"), 6, 119.0),
        (hinged(1), 7, None),
        (hinged(3), 9, None),
    ],
    ids=["free", "soft", "one_way", "reduced", "shells", "reduced_shells", "hinge", "hinges"],
)
def test_calculix_runs_tell_their_rigid_modes(
    tmp_path: Path, deck: str, expected: int, first_hz: float | None
) -> None:
    result = solved(deck, tmp_path, expected + 4)
    assert result.n_rigid == expected
    if first_hz is not None:
        assert result.elastic.frequencies_hz[0] == pytest.approx(first_hz, rel=0.03)


def test_six_suspension_modes_far_below_the_first_elastic_one_are_elastic(tmp_path: Path) -> None:
    # The gap is five orders of magnitude in eigenvalues, as that above rigid modes.
    result = solved(solid(SOFT), tmp_path)
    assert result.elastic.frequencies_hz[5] < 7.0
    assert result.elastic.frequencies_hz[6] > 4000.0
    assert result.energy_balance == pytest.approx(np.ones(10), abs=1e-5)


def spring_line(link: str) -> str:
    """A block with one spring along a line to a held node: ccx prints no energy of SPRINGA."""
    text = solid() + "*NODE\n900, 0., 0., -0.1\n901, 0.3, 0.1, -0.1\n"
    text += f"*ELEMENT, TYPE={link}, ELSET=LINE\n901, 900, 1\n*SPRING, ELSET=LINE\n"
    return text + ("\n" if link == "SPRINGA" else "3, 3\n") + "4000.\n*BOUNDARY\n900, 1, 3\n"


def test_a_spring_whose_energy_is_not_printed_is_seen_by_its_eigenvalue(tmp_path: Path) -> None:
    found = solved(spring_line("SPRINGA"), tmp_path)
    (tmp_path / "two").mkdir()
    told = solved(spring_line("SPRING2"), tmp_path / "two")
    assert (found.n_rigid, told.n_rigid) == (5, 5)
    assert np.isnan(found.total_strain_energy[5])
    assert found.eigenvalues[5] == pytest.approx(told.eigenvalues[5], rel=1e-5)
    assert 2.0 * told.total_strain_energy[5] == pytest.approx(told.eigenvalues[5], rel=1e-5)


def test_a_preloaded_string_of_trusses_has_no_rigid_modes(tmp_path: Path) -> None:
    # c = sqrt(T / mu) = sqrt(100 / 7.8e-3) m/s over 1 m; ends held.
    nodes = "".join(f"{n + 1}, {n / 12:.9g}, 0., 0.\n" for n in range(13))
    rods = "".join(f"{n}, {n}, {n + 1}\n" for n in range(1, 13))
    text = f"*NODE\n{nodes}*ELEMENT, TYPE=T3D2, ELSET=EALL\n{rods}{STEEL}"
    text += "*SOLID SECTION, ELSET=EALL, MATERIAL=STEEL\n1e-6\n*BOUNDARY\n1, 1, 3\n13, 2, 3\n"
    text += "*STEP, NLGEOM\n*STATIC\n*CLOAD\n13, 1, 100.\n*END STEP\n"
    text += "*STEP, PERTURBATION\n*FREQUENCY\n4\n*END STEP\n"
    result = solved(text, tmp_path, 4)
    assert result.n_rigid == 0
    assert result.modes.frequencies_hz[0] == pytest.approx(0.5 * (100 / 7.8e-3) ** 0.5, rel=0.01)
    assert np.isnan(result.total_strain_energy[0])


# stiffness matrices, and numbers by hand


def chain(n: int, ground: float) -> Floats:
    """Springs of 1e6 between n unit masses, and one to ground."""
    k = 2e6 * np.eye(n) - 1e6 * (np.eye(n, k=1) + np.eye(n, k=-1))
    k[0, 0] = k[-1, -1] = 1e6
    k[0, 0] += ground
    return np.asarray(k)


@pytest.mark.parametrize(("ground", "expected"), [(0.0, 1), (1e-2, 0)])
def test_a_stiffness_matrix_tells_a_soft_spring_from_none(ground: float, expected: int) -> None:
    stiffness = sparse.csr_array(chain(20, ground))
    eigenvalues, shapes = solve_modes(stiffness, sparse.csr_array(np.eye(20)), 5)
    energies = matrix_energies(upper_triangle(stiffness), shapes, GIVEN)
    assert count_rigid_modes(eigenvalues, energies, lambda: 0.0) == expected
    if ground:  # all masses move alike: ground / 20 but for the chain's own flexibility
        assert 2.0 * energies[0] == pytest.approx(ground / 20, rel=1e-3)


LOW = np.array([1e-4, 2e-4, 158.0, 6e6])


def test_a_gap_in_the_spectrum_says_nothing() -> None:
    assert count_rigid_modes(LOW, 0.5 * LOW, lambda: 1e12) == 0
    idle = np.array([1e-12, 1e-13, 79.0, 3e6])
    assert count_rigid_modes(LOW, idle, lambda: 1e12) == 2
    assert count_rigid_modes(-LOW[::-1] * 1e-9, np.zeros(4), lambda: 1e12) == 4


def test_without_energies_the_rounding_of_the_largest_eigenvalue_decides() -> None:
    unknown = np.full(4, np.nan)
    # 30 eps of 1e12 is 6.7e-3, of 1e9 6.7e-6.
    assert count_rigid_modes(LOW, unknown, lambda: 1e12) == 2
    assert count_rigid_modes(LOW, unknown, lambda: 1e9) == 0


def test_a_number_by_hand_that_energies_contradict_is_refused_with_both() -> None:
    idle = np.array([1e-12, 1e-13, 79.0, 3e6])
    with pytest.raises(CampaignError) as caught:
        RigidByHand(3, "campaign.yaml:4").check(LOW, idle, 2)
    assert str(caught.value) == (
        "campaign.yaml:4: 3 rigid modes, but the strain energies say 2: that of mode 3 at 2.001 Hz "
        "is all of its eigenvalue, so it is elastic; leave the number out, or look at the supports"
    )
    with pytest.raises(CampaignError, match="1 rigid modes, but the strain energies say 2: that"):
        RigidByHand(1, "campaign.yaml:4").check(LOW, idle, 2)
    with pytest.raises(CampaignError, match="only 4 modes were computed"):
        RigidByHand(7, "campaign.yaml:4").check(LOW, idle, 2)
    RigidByHand(2, "campaign.yaml:4").check(LOW, idle, 2)


def test_a_number_by_hand_decides_where_energies_are_not_told() -> None:
    for number in (0, 2, 3):
        RigidByHand(number, "campaign.yaml:4").check(LOW, np.full(4, np.nan), 2)
