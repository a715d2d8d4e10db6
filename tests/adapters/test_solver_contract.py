"""What every solver behind the seam must do, on models with closed forms; run for real.

Units are mm, t, s, MPa. A new solver adds a `Harness` with decks of the same models.
"""

from __future__ import annotations

import re
import shutil
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy import linalg, sparse

from modetune.adapters.calculix.solver import PROGRAM_VARIABLE, calculix_solver
from modetune.adapters.matrices.solver import matrices_solver
from modetune.adapters.paraview import unstructured_grid
from modetune.adapters.process import run_process
from modetune.adapters.solver import Analysis, MatrixAnalysis, ModalAnalysis, Solver
from modetune.core.algebra.eigen import solve_modes
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import (
    ModelError,
    SolverCrashed,
    SolverExhausted,
    SolverMissing,
    SolverRejected,
)
from modetune.core.parameters import QUANTITIES, Parameter, Quantity
from modetune.core.storage.keys import canonical_json
from modetune.core.updating.job_results import ModalResult, Result

E, NU, RHO = 70_000.0, 0.3, 2.7e-9

#: A bar along x, 20 elements of 25 mm in two groups of unequal length.
LENGTH, WIDTH, HEIGHT, BAR_ELEMENTS, ROOT_ELEMENTS = 500.0, 20.0, 10.0, 20, 7
#: A square plate, simply supported on all edges.
SIDE, THICKNESS, PLATE_ELEMENTS = 200.0, 2.0, 24
#: A chain to ground along x: spring, mass, spring, mass ... all alike.
CHAIN_MASSES, STIFFNESS, MASS = 12, 50.0, 2e-3


@dataclass(frozen=True, slots=True)
class Case:
    """A model all solvers know, what is asked of it, and what is right."""

    name: str
    parameters: tuple[Parameter, ...]
    groups: Mapping[str, tuple[str, ...]]
    n_modes: int
    nodes: tuple[int, ...]
    n_rigid: int
    mass: float
    frequencies_hz: tuple[float, ...]
    tolerance: float
    solid: bool = True


def parameter(name: str, quantity: Quantity, *targets: str) -> Parameter:
    return Parameter(name, quantity, QUANTITIES[quantity].targets[0], targets, 0.5, 2.0, 0.1)


def beam_frequency(root: float) -> float:
    """Euler-Bernoulli beam bending over HEIGHT: root^2 / 2 pi sqrt(E I / rho A L^4)."""
    radius = HEIGHT / 12.0**0.5
    return float(root**2 / (2.0 * np.pi) * radius * (E / RHO) ** 0.5 / LENGTH**2)


def plate_frequency(m: int, n: int) -> float:
    """Kirchhoff plate on simple supports: pi / 2 sqrt(D / rho h) (m^2 + n^2) / a^2."""
    bending = E * THICKNESS**3 / 12.0 / (1.0 - NU**2)
    return float(np.pi / 2.0 * (bending / RHO / THICKNESS) ** 0.5 * (m**2 + n**2) / SIDE**2)


def chain_frequency(mode: int) -> float:
    """Fixed-free chain of equal links: sqrt(k / m) / pi sin((2 j - 1) pi / (4 n + 2))."""
    angle = (2 * mode - 1) * np.pi / (4 * CHAIN_MASSES + 2)
    return float((STIFFNESS / MASS) ** 0.5 / np.pi * np.sin(angle))


BAR_PARAMETERS = (
    parameter("E_root", "youngs_modulus", "ROOT"),
    parameter("E_tip", "youngs_modulus", "TIP"),
    parameter("rho", "density", "ROOT", "TIP"),
)
BAR_GROUPS = {"E_root": ("ROOT",), "E_tip": ("TIP",)}
BAR_MASS = LENGTH * WIDTH * HEIGHT * RHO
CANTILEVER = Case(
    "cantilever",
    BAR_PARAMETERS,
    BAR_GROUPS,
    6,
    (1, 5, 81, 84),
    0,
    BAR_MASS,
    # Roots of cos x cosh x = -1; the clamp holds the cross-section too and makes it stiffer.
    (beam_frequency(1.8751),),
    0.01,
)
FREE_BAR = Case(
    "free_bar",
    BAR_PARAMETERS,
    BAR_GROUPS,
    10,
    (1, 41, 84),
    6,
    BAR_MASS,
    (beam_frequency(4.7300),),
    0.01,  # first root of cos x cosh x = 1
)
PLATE = Case(
    "plate",
    (
        parameter("E_plate", "youngs_modulus", "PLATE"),
        parameter("t_plate", "thickness", "PLATE"),
        parameter("rho", "density", "PLATE"),
    ),
    {"E_plate": ("PLATE",)},
    6,
    (15, 30, 85),
    0,
    SIDE**2 * THICKNESS * RHO,
    # 24 elements over at most 2 half waves, and S4 has the shear that Kirchhoff's plate has not.
    (plate_frequency(1, 1), plate_frequency(1, 2), plate_frequency(2, 1)),
    0.03,
    solid=False,
)
CHAIN = Case(
    "chain",
    (
        parameter("k_ground", "spring_stiffness", "GROUND"),
        parameter("k_links", "spring_stiffness", "LINKS"),
        parameter("m", "mass", "MASSES"),
    ),
    {"k_ground": ("GROUND",), "k_links": ("LINKS",)},
    2,
    (1, 3, 6),
    0,
    CHAIN_MASSES * MASS,
    (chain_frequency(1), chain_frequency(2)),
    1e-5,
    solid=False,
)
CASES = (CANTILEVER, FREE_BAR, PLATE, CHAIN)


def calculix_deck(case: Case) -> str:
    if case is PLATE:
        return calculix_plate()
    return calculix_chain() if case is CHAIN else calculix_bar(clamped=case is CANTILEVER)


def calculix_material(name: str) -> list[str]:
    return [f"*MATERIAL, NAME={name}", "*ELASTIC", f"{E}, {NU}", "*DENSITY", f"{RHO}"]


def calculix_bar(*, clamped: bool) -> str:
    lines = ["*NODE, NSET=NALL"]
    corners = ((0.0, 0.0), (WIDTH, 0.0), (WIDTH, HEIGHT), (0.0, HEIGHT))
    for station in range(BAR_ELEMENTS + 1):
        x = station * LENGTH / BAR_ELEMENTS
        lines += [f"{4 * station + i}, {x}, {y}, {z}" for i, (y, z) in enumerate(corners, 1)]
    for element in range(BAR_ELEMENTS):
        group = "ROOT" if element < ROOT_ELEMENTS else "TIP"
        nodes = ", ".join(str(4 * element + i) for i in range(1, 9))
        lines += [f"*ELEMENT, TYPE=C3D8I, ELSET={group}", f"{element + 1}, {nodes}"]
    for group in ("ROOT", "TIP"):
        lines += [*calculix_material(group), f"*SOLID SECTION, ELSET={group}, MATERIAL={group}"]
    if clamped:
        lines += ["*BOUNDARY", *(f"{node}, 1, 3" for node in range(1, 5))]
    return "\n".join(lines) + "\n"


def calculix_plate() -> str:
    side = PLATE_ELEMENTS + 1
    lines, edge = ["*NODE, NSET=NALL"], []
    for i in range(side):
        for j in range(side):
            node = side * i + j + 1
            x, y = (SIDE * k / PLATE_ELEMENTS for k in (i, j))
            lines.append(f"{node}, {x}, {y}, 0.")
            if i in (0, PLATE_ELEMENTS) or j in (0, PLATE_ELEMENTS):
                edge.append(node)
    lines.append("*ELEMENT, TYPE=S4, ELSET=PLATE")
    for i in range(PLATE_ELEMENTS):
        for j in range(PLATE_ELEMENTS):
            first = side * i + j + 1
            nodes = f"{first}, {first + side}, {first + side + 1}, {first + 1}"
            lines.append(f"{PLATE_ELEMENTS * i + j + 1}, {nodes}")
    lines += [*calculix_material("PLATE"), "*SHELL SECTION, ELSET=PLATE, MATERIAL=PLATE"]
    lines += [f"{THICKNESS}", "*BOUNDARY", *(f"{node}, 3" for node in edge)]
    return "\n".join([*lines, "1, 1, 2", f"{side}, 1"]) + "\n"


def calculix_chain(link: str = "SPRING2", directions: str = "1, 1") -> str:
    nodes = range(1, CHAIN_MASSES + 1)
    lines = ["*NODE, NSET=NALL", *(f"{node}, {10.0 * node}, 0., 0." for node in nodes)]
    lines += ["*ELEMENT, TYPE=SPRING1, ELSET=GROUND", "1, 1"]
    lines += [f"*ELEMENT, TYPE={link}, ELSET=LINKS"]
    lines += [f"{node + 1}, {node}, {node + 1}" for node in nodes[:-1]]
    lines += ["*ELEMENT, TYPE=MASS, ELSET=MASSES", *(f"{100 + node}, {node}" for node in nodes)]
    lines += ["*SPRING, ELSET=GROUND", "1", f"{STIFFNESS}"]
    lines += ["*SPRING, ELSET=LINKS", directions, f"{STIFFNESS}", "*MASS, ELSET=MASSES", f"{MASS}"]
    lines += ["*BOUNDARY", *(f"{node}, 2, 3" for node in nodes)]
    return "\n".join(lines) + "\n"


@dataclass(frozen=True, slots=True)
class Harness:
    """A solver under test: how it is made, its decks, and whether it is installed."""

    name: str
    program: str
    solver: Callable[[Path, tuple[Parameter, ...]], Solver]
    deck: Callable[[Case], str]
    comment: str
    suffix: str = ".inp"


HARNESSES = (Harness("calculix", "ccx", calculix_solver, calculix_deck, "** "),)


@pytest.fixture(params=HARNESSES, ids=lambda harness: harness.name)
def harness(request: pytest.FixtureRequest) -> Harness:
    found: Harness = request.param
    if shutil.which(found.program) is None and found.name != "calculix":
        pytest.skip(f"{found.program} is not installed")  # CalculiX has to be
    return found


@pytest.fixture(params=CASES, ids=lambda case: case.name)
def case(request: pytest.FixtureRequest) -> Case:
    found: Case = request.param
    return found


def solver_of(harness: Harness, case: Case, folder: Path, text: str = "") -> Solver:
    path = folder / f"model{harness.suffix}"
    path.write_text(text or harness.deck(case))
    return harness.solver(path, case.parameters)


def modal(case: Case) -> ModalAnalysis:
    return ModalAnalysis(case.n_modes, case.nodes, tuple(case.groups.items()))


def run(solver: Solver, values: Mapping[str, float], analysis: Analysis, folder: Path) -> Result:
    job = folder / f"job{sum(1 for _ in folder.iterdir())}"
    job.mkdir()
    solver.render(values, analysis).write(job)
    finished = run_process(solver.program.command(1), job, 120.0, threading.Event())
    return solver.read(values, analysis, job, finished.return_code)


def run_modal(solver: Solver, case: Case, folder: Path, **values: float) -> ModalResult:
    result = run(solver, values, modal(case), folder)
    assert isinstance(result, ModalResult)
    return result


def run_matrices(solver: Solver, folder: Path, **values: float) -> MatrixResult:
    result = run(solver, values, MatrixAnalysis(), folder)
    assert isinstance(result, MatrixResult)
    return result


def test_a_solver_tells_its_version(harness: Harness, tmp_path: Path) -> None:
    assert re.fullmatch(r"\d+(\.\w+)*", solver_of(harness, FREE_BAR, tmp_path).program.version())


def test_frequencies_mass_and_rigid_modes_are_right(
    harness: Harness, case: Case, tmp_path: Path
) -> None:
    result = run_modal(solver_of(harness, case, tmp_path), case, tmp_path)
    assert result.n_rigid == case.n_rigid
    assert result.elastic.frequencies_hz[: len(case.frequencies_hz)] == pytest.approx(
        case.frequencies_hz, rel=case.tolerance
    )
    assert result.mass == pytest.approx(case.mass, rel=1e-6)  # printed with seven digits
    assert sorted(set(result.modes.nodes.tolist())) == sorted(case.nodes)


def test_the_mesh_holds_all_nodes_with_results_and_cells_of_a_size(
    harness: Harness, case: Case, tmp_path: Path
) -> None:
    solver = solver_of(harness, case, tmp_path)
    mesh = solver.deck.mesh()
    assert solver.deck.mesh() is mesh  # read once
    assert solver.deck.summary.node_ids <= set(mesh.nodes.tolist())
    sizes = unstructured_grid(mesh).compute_cell_sizes()
    for cells in mesh.cells:
        mesh.rows(cells.nodes)  # raises for a node that is not there
    solid = {"hexahedron": ("Volume", WIDTH * HEIGHT * LENGTH), "quad": ("Area", SIDE**2)}
    for cells in mesh.cells:
        if cells.kind in solid:
            name, expected = solid[cells.kind]
            assert (sizes[name] > 0.0).all()
            assert sizes[name].sum() == pytest.approx(expected)
    assert sum(cells.elements.size for cells in mesh.cells) == solver.deck.summary.n_elements


def test_strain_energies_balance_and_groups_sum_to_the_total(
    harness: Harness, case: Case, tmp_path: Path
) -> None:
    result = run_modal(solver_of(harness, case, tmp_path), case, tmp_path)
    # phi^T K phi = lambda for mass-normalised modes; energies are printed with seven digits.
    np.testing.assert_allclose(result.energy_balance, 1.0, rtol=1e-5)
    elastic = slice(result.n_rigid, None)
    np.testing.assert_allclose(
        result.strain_energies[:, elastic].sum(axis=0),
        result.total_strain_energy[elastic],
        rtol=1e-5,
    )


def test_matrices_have_the_eigenvalues_of_the_modal_run(
    harness: Harness, case: Case, tmp_path: Path
) -> None:
    solver = solver_of(harness, case, tmp_path)
    if not solver.deck.summary.solid_shapes:
        pytest.skip("dependent nodes are not in the matrices")
    result = run_modal(solver, case, tmp_path)
    matrices = run_matrices(solver, tmp_path)
    # M is singular in the incompatible unknowns, K (free) in the rigid ones: K - s M is neither.
    shift = -result.eigenvalues[-1]
    stiffness, mass = matrices.stiffness.toarray(), matrices.mass.toarray()
    inverse = linalg.eigvalsh(mass, stiffness - shift * mass)[::-1]
    eigenvalues = 1.0 / inverse[: case.n_modes] + shift
    np.testing.assert_allclose(
        eigenvalues, result.eigenvalues, rtol=1e-6, atol=1e-8 * result.eigenvalues[-1]
    )


def test_affected_elements_hold_all_that_parameters_move_in_the_matrices(
    harness: Harness, case: Case, tmp_path: Path
) -> None:
    solver = solver_of(harness, case, tmp_path)
    if not solver.program.capabilities.matrices:
        assert all(
            solver.deck.affected_elements(parameter) is None for parameter in case.parameters
        )
        return
    base = run_matrices(solver, tmp_path)
    for parameter in case.parameters:
        found = solver.deck.affected_elements(parameter)
        assert (found is None) <= (not solver.deck.is_linear(parameter))
        if found is None:
            continue
        moved = run_matrices(solver, tmp_path, **{parameter.name: 1.3})
        for kind, moves in (("stiffness", found.stiffness), ("mass", found.mass)):
            one = getattr(base, kind)
            change, size = sparse.coo_array(one - getattr(moved, kind)), np.abs(one.diagonal())
            least = 1e-12 * np.sqrt(size[change.row] * size[change.col])  # ccx writes 14 digits
            rows = change.row[np.abs(change.data) > least]
            assert bool(rows.size) == moves
            touched = set(base.nodes[rows].tolist())
            assert {node for node in touched if node in solver.deck.summary.node_ids} <= found.nodes


def test_displacements_follow_from_the_matrices(
    harness: Harness, case: Case, tmp_path: Path
) -> None:
    solver = solver_of(harness, case, tmp_path)
    if not solver.program.capabilities.matrices:
        nothing = np.zeros(0, dtype=np.int64)
        empty = sparse.csr_array((0, 0))
        matrices = MatrixResult(empty, empty, nothing, nothing)
        seen = solver.deck.observation(matrices, np.array(case.nodes), np.ones_like(case.nodes))
        assert seen.unknown.all()
        return
    assert solver.deck.summary.matrix_shapes
    result, matrices = run_modal(solver, case, tmp_path), run_matrices(solver, tmp_path)
    seen = solver.deck.observation(matrices, result.modes.nodes, result.modes.components)
    assert not seen.unknown.any()
    _, shapes = solve_modes(matrices.stiffness, matrices.mass, case.n_modes)
    found, native = seen.matrix @ shapes, np.real(result.modes.mode_shapes)
    # Of the first elastic modes, alone or in pairs: a mode that is not turned among its equals has
    # the native one's displacements to the digits that are printed, times the sign.
    values, first = result.eigenvalues, result.n_rigid
    last = first + 1 + int(values[first + 1] < 1.001 * values[first])
    mine, his = found[:, first:last], native[:, first:last]
    products = his @ his.T
    np.testing.assert_allclose(mine @ mine.T, products, rtol=0.0, atol=4e-6 * products.max())


@pytest.mark.parametrize(
    ("case", "values", "factor"),
    [  # eigenvalues go with E, k, 1/rho, 1/m and (thin plate bending) t^2
        (CANTILEVER, {"E_root": 1.21, "E_tip": 1.21}, 1.1),
        (CANTILEVER, {"rho": 1.21}, 1.0 / 1.1),
        (FREE_BAR, {"E_root": 1.21, "E_tip": 1.21, "rho": 1.21}, 1.0),
        (PLATE, {"E_plate": 1.21}, 1.1),
        (CHAIN, {"k_ground": 1.21, "k_links": 1.21}, 1.1),
        (CHAIN, {"m": 1.21}, 1.0 / 1.1),
    ],
)
def test_edited_values_change_what_they_should(
    harness: Harness, case: Case, values: dict[str, float], factor: float, tmp_path: Path
) -> None:
    solver = solver_of(harness, case, tmp_path)
    before = run_modal(solver, case, tmp_path)
    after = run_modal(solver, case, tmp_path, **values)
    np.testing.assert_allclose(
        after.elastic.frequencies_hz, factor * before.elastic.frequencies_hz, rtol=2e-6
    )
    heavier = values.get("rho", values.get("m", 1.0))
    assert after.mass == pytest.approx(heavier * before.mass, rel=1e-6)


def test_thickness_raises_mass_in_proportion_and_bending_about_so(
    harness: Harness, tmp_path: Path
) -> None:
    solver = solver_of(harness, PLATE, tmp_path)
    before = run_modal(solver, PLATE, tmp_path)
    after = run_modal(solver, PLATE, tmp_path, t_plate=1.1)
    assert after.mass == pytest.approx(1.1 * before.mass, rel=1e-6)
    # D / rho h goes with t^2; shear and the mesh take a little of it.
    ratios = after.elastic.frequencies_hz / before.elastic.frequencies_hz
    assert ratios[0] == pytest.approx(1.1, rel=0.01)


def test_one_group_stiffened_gains_frequency_by_its_share_of_energy(
    harness: Harness, tmp_path: Path
) -> None:
    solver = solver_of(harness, CANTILEVER, tmp_path)
    base = run_modal(solver, CANTILEVER, tmp_path)
    step = 1e-3
    low, high = (run_modal(solver, CANTILEVER, tmp_path, E_root=1.0 + s) for s in (-step, step))
    slope = (high.eigenvalues - low.eigenvalues) / (2.0 * step)
    # d lambda / d theta = 2 U_g; eigenvalues have seven digits, so slopes have about 2e-4
    energies = 2.0 * base.elastic_energies("E_root")
    np.testing.assert_allclose(slope, energies, rtol=1e-3, atol=2e-4 * base.eigenvalues.max())


def test_updated_decks_run_to_the_same_modes(harness: Harness, case: Case, tmp_path: Path) -> None:
    solver = solver_of(harness, case, tmp_path)
    values = {case.parameters[0].name: 1.2345, case.parameters[-1].name: 0.87}
    expected = run_modal(solver, case, tmp_path, **values)
    updated = solver.deck.write_updated(values, tmp_path / "updated")
    assert updated.parent == tmp_path / "updated"
    again = run_modal(harness.solver(updated, case.parameters), case, tmp_path)
    np.testing.assert_array_equal(again.eigenvalues, expected.eigenvalues)
    assert again.mass == pytest.approx(expected.mass, rel=1e-12)  # sums in another order


def test_content_is_blind_to_paths_and_comments_and_sees_numbers(
    harness: Harness, case: Case, tmp_path: Path
) -> None:
    text = harness.deck(case)
    head, middle, tail = text.partition("\n")
    texts = {
        "plain": text,
        "elsewhere/deep": f"{head}{middle}{harness.comment} something else\n{tail}",
        "number": text.replace(".0", ".01", 1),
    }
    contents: dict[str, dict[str, str]] = {}
    analyses: dict[str, Analysis] = {
        "modal": modal(case),
        "matrices": MatrixAnalysis(),
        "more": ModalAnalysis(case.n_modes + 1, case.nodes, tuple(case.groups.items())),
        "nodes": ModalAnalysis(case.n_modes, case.nodes[:1], tuple(case.groups.items())),
        "groups": ModalAnalysis(case.n_modes, case.nodes),
    }
    for name, content in texts.items():
        (tmp_path / name).mkdir(parents=True)
        solver = solver_of(harness, case, tmp_path / name, content)
        contents[name] = {
            key: canonical_json(solver.render({}, a).content) for key, a in analyses.items()
        }
        edited = solver.render({case.parameters[0].name: 1.01}, analyses["modal"]).content
        assert canonical_json(edited) != contents[name]["modal"]
        assert str(tmp_path) not in canonical_json(edited)
    assert contents["plain"] == contents["elsewhere/deep"]
    assert len(set(contents["plain"].values())) == len(analyses)
    assert texts["number"] != text
    for key in analyses:
        assert contents["number"][key] != contents["plain"][key]


def test_a_deck_split_into_includes_has_the_content_of_the_whole(tmp_path: Path) -> None:
    solver = solver_of(HARNESSES[0], FREE_BAR, tmp_path)
    whole = canonical_json(solver.render({}, modal(FREE_BAR)).content)
    text = calculix_deck(FREE_BAR)
    cut = text.index("*MATERIAL")
    (tmp_path / "materials.inp").write_text(text[cut:])
    split = solver_of(
        HARNESSES[0], FREE_BAR, tmp_path, text[:cut] + "*INCLUDE, INPUT=materials.inp\n"
    )
    assert canonical_json(split.render({}, modal(FREE_BAR)).content) == whole


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [  # what is wrong, and the line that ccx's message leads to
        ("MATERIAL=TIP", "MATERIAL=TOP", "*SOLID SECTION, ELSET=TIP, MATERIAL=TOP"),
        (f"{E}, {NU}", f"{E}, 0.5", f"{E}, 0.5"),
        (f"{E}, {NU}", f"7o000., {NU}", f"7o000., {NU}"),
        ("5, 17, 18, 19, 20,", "5, 18, 17, 19, 20,", "5, 18, 17, 19, 20, 21, 22, 23, 24"),
        ("1, 1, 3", "CLAMP, 1, 3", "CLAMP, 1, 3"),
    ],
)
def test_a_deck_that_ccx_rejects_is_named_with_its_line(
    tmp_path: Path, old: str, new: str, line: str
) -> None:
    deck = calculix_deck(CANTILEVER)
    text = deck.replace(old, new, 1)
    assert text != deck
    solver = solver_of(HARNESSES[0], CANTILEVER, tmp_path, text)
    where = f"{tmp_path / 'model.inp'}, line {text.splitlines().index(line) + 1} "
    with pytest.raises(SolverRejected, match=re.escape(where)):
        run_modal(solver, CANTILEVER, tmp_path)


def test_a_rejected_line_that_a_parameter_changed_is_found(tmp_path: Path) -> None:
    nu = parameter("nu", "poissons_ratio", "TIP")
    path = tmp_path / "model.inp"
    path.write_text(calculix_deck(CANTILEVER))
    solver = calculix_solver(path, (nu,))
    lines = path.read_text().splitlines()
    number = len(lines) - lines[::-1].index(f"{E}, {NU}")  # the last, that of TIP
    with pytest.raises(SolverRejected, match=re.escape(f"{path}, line {number} ")):
        run(solver, {"nu": 2.0}, modal(CANTILEVER), tmp_path)


def test_more_modes_than_the_model_has_are_those_that_it_has(tmp_path: Path) -> None:
    solver = solver_of(HARNESSES[0], CHAIN, tmp_path)
    result = run(solver, {}, ModalAnalysis(12, (1,)), tmp_path)
    assert isinstance(result, ModalResult)
    every = [chain_frequency(mode) for mode in range(1, CHAIN_MASSES + 1)]
    assert result.modes.frequencies_hz == pytest.approx(every[:12], rel=CHAIN.tolerance)


def test_a_node_that_is_not_there_is_refused_before_ccx_falls_over_it(tmp_path: Path) -> None:
    # ccx 2.20 ends with a segmentation fault.
    text = calculix_deck(FREE_BAR).replace("81, 82, 83, 84", "81, 82, 83, 999")
    with pytest.raises(ModelError, match=r"line \d+: element 20 has node 999, which is not there"):
        solver_of(HARNESSES[0], FREE_BAR, tmp_path, text)


def test_a_run_without_its_closing_line_is_no_result(tmp_path: Path) -> None:
    solver = solver_of(HARNESSES[0], FREE_BAR, tmp_path)
    (tmp_path / "solver.log").write_text("STEP 1\n")
    for code in (0, 1):
        with pytest.raises(SolverCrashed, match=f"with code {code} and without its closing line"):
            solver.read({}, modal(FREE_BAR), tmp_path, code)
    (tmp_path / "solver.log").write_text(" *ERROR in u_calloc: error allocating memory\n")
    with pytest.raises(SolverExhausted, match="ran out of memory"):
        solver.read({}, modal(FREE_BAR), tmp_path, 201)


def test_springs_between_two_nodes_move_right_but_print_no_energy(tmp_path: Path) -> None:
    # Why SPRINGA sets have no energy sets.
    solver = solver_of(HARNESSES[0], CHAIN, tmp_path, calculix_chain("SPRINGA", ""))
    result = run_modal(solver, CHAIN, tmp_path)
    assert result.modes.frequencies_hz == pytest.approx(CHAIN.frequencies_hz, rel=CHAIN.tolerance)
    assert (result.strain_energies[1] == 0.0).all()
    assert np.isnan(result.energy_balance).all()
    assert solver.deck.energy_sets(CHAIN.parameters[1]) == ()


def test_a_preload_changes_the_modes_as_theory_says(tmp_path: Path) -> None:
    # Galerkin for a cantilever under a tip pull P: lambda grows by about 1 + P L^2 / 2.47 E I
    # (buckling at -2.47 E I / L^2); with a twentieth of it the first frequency by 2.5 %.
    text = calculix_deck(CANTILEVER)
    pull = 0.05 * 2.467 * E * WIDTH * HEIGHT**3 / 12.0 / LENGTH**2
    loads = "".join(f"{node}, 1, {pull / 4.0}\n" for node in range(81, 85))
    steps = (
        f"*STEP, NLGEOM\n*STATIC\n*CLOAD\n{loads}*NODE PRINT, NSET=NALL\nU\n*END STEP\n"
        "*STEP, PERTURBATION\n*FREQUENCY\n3\n*END STEP\n"
    )
    plain = run_modal(solver_of(HARNESSES[0], CANTILEVER, tmp_path), CANTILEVER, tmp_path)
    solver = solver_of(HARNESSES[0], CANTILEVER, tmp_path, text + steps)
    pulled = run_modal(solver, CANTILEVER, tmp_path)
    ratio = pulled.modes.frequencies_hz[0] / plain.modes.frequencies_hz[0]
    assert ratio == pytest.approx(1.05**0.5, rel=0.005)


def test_a_missing_ccx_is_said_with_its_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PROGRAM_VARIABLE, "no-such-ccx")
    solver = solver_of(HARNESSES[0], FREE_BAR, tmp_path)
    with pytest.raises(SolverMissing, match=f"`no-such-ccx` is not on this.*{PROGRAM_VARIABLE}"):
        solver.program.version()


def test_a_program_that_is_no_ccx_is_no_solver(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(PROGRAM_VARIABLE, "true")
    with pytest.raises(SolverMissing, match="`true -v` printed no CalculiX version"):
        solver_of(HARNESSES[0], FREE_BAR, tmp_path).program.version()


# The embedded solver knows no elements but springs and masses: the chain, held and free.

LINKS = tuple(f"k{node}" for node in range(2, CHAIN_MASSES + 1))
LUMPS = tuple(f"m{node}" for node in range(1, CHAIN_MASSES + 1))
MATRICES_CHAIN = replace(
    CHAIN,
    parameters=(
        parameter("k_ground", "spring_stiffness", "k1"),
        parameter("k_links", "spring_stiffness", *LINKS),
        parameter("m", "mass", *LUMPS),
    ),
    groups={"k_ground": ("k1",), "k_links": LINKS},
    solid=True,
)
MATRICES_FREE_CHAIN = replace(
    MATRICES_CHAIN,
    name="free_chain",
    parameters=MATRICES_CHAIN.parameters[1:],
    groups={"k_links": LINKS},
    n_modes=4,
    n_rigid=1,
    # Free chain of equal links: sqrt(k / m) / pi sin(j pi / 2 n).
    frequencies_hz=tuple(
        float((STIFFNESS / MASS) ** 0.5 / np.pi * np.sin(mode * np.pi / (2 * CHAIN_MASSES)))
        for mode in (1, 2, 3)
    ),
)


def matrices_chain(case: Case) -> str:
    lines = ["masses:", *(f"  {name}: {MASS}" for name in LUMPS), "springs:"]
    if case.n_rigid == 0:
        lines.append(f"  k1: {{between: [ground, m1], stiffness: {STIFFNESS}}}")
    for node in range(2, CHAIN_MASSES + 1):
        lines.append(f"  k{node}: {{between: [m{node - 1}, m{node}], stiffness: {STIFFNESS}}}")
    return "\n".join(lines) + "\n"


MATRICES = Harness("matrices", sys.executable, matrices_solver, matrices_chain, "# ", ".yaml")


def test_the_embedded_solver_has_no_mesh(tmp_path: Path) -> None:
    mesh = solver_of(MATRICES, MATRICES_CHAIN, tmp_path).deck.mesh()
    assert (mesh.nodes.size, mesh.cells) == (0, ())


def test_the_embedded_solver_tells_its_version(tmp_path: Path) -> None:
    version = solver_of(MATRICES, MATRICES_CHAIN, tmp_path).program.version()
    assert re.fullmatch(r"\d+(\.\w+)*", version)


@pytest.mark.parametrize(
    "check",
    [
        test_frequencies_mass_and_rigid_modes_are_right,
        test_strain_energies_balance_and_groups_sum_to_the_total,
        test_matrices_have_the_eigenvalues_of_the_modal_run,
        test_updated_decks_run_to_the_same_modes,
        test_content_is_blind_to_paths_and_comments_and_sees_numbers,
    ],
)
@pytest.mark.parametrize("chain", [MATRICES_CHAIN, MATRICES_FREE_CHAIN], ids=lambda c: c.name)
def test_the_embedded_solver_meets_the_contract(
    check: Callable[[Harness, Case, Path], None], chain: Case, tmp_path: Path
) -> None:
    check(MATRICES, chain, tmp_path)
