"""MYSTRAN's own matrices: its modes, shapes at every grid point, and what parameters move."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

from modetune.adapters.nastran.dialect import MYSTRAN
from modetune.adapters.nastran.matrices import HEADING, read_restart
from modetune.adapters.nastran.solver import mystran_solver
from modetune.adapters.process import run_process
from modetune.adapters.solver import Analysis, MatrixAnalysis, ModalAnalysis, Solver
from modetune.core.algebra.eigen import solve_modes
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import NoResult
from modetune.core.modes import Floats
from modetune.core.parameters import Parameter, Quantity
from modetune.core.updating.job_results import ModalResult, Result
from modetune.core.updating.parameter_matrices import ROUNDING, differences
from tests.adapters.mystran_decks import AVERAGED, CARRIED, PINNED, bracket, frame, plate
from tests.adapters.solved import needs_mystran

pytestmark = needs_mystran
#: Printed eigenvalues have seven digits, the last of them rounded.
PRINTED = 5e-7
DECKS: dict[str, tuple[Callable[[], str], int]] = {
    "frame": (frame, 0),
    "plate": (plate, 0),
    "bracket": (bracket, 6),
}


def parameter(name: str, quantity: Quantity, by: str, *targets: str) -> Parameter:
    assert by in ("material", "property", "element")
    return Parameter(name, quantity, by, targets, 0.5, 2.0, 0.1)  # type: ignore[arg-type]


PARAMETERS = {
    "frame": (
        parameter("E_post", "youngs_modulus", "material", "1"),
        parameter("rho_post", "density", "material", "1"),
        parameter("I_beam", "inertia_1", "property", "2"),
        parameter("A_beam", "area", "property", "3"),
        parameter("J_arm", "torsion_constant", "property", "4"),
        parameter("k_mount", "spring_stiffness", "property", "209"),
        parameter("m_unit", "mass", "element", "301"),
        parameter("m_other", "mass", "element", "302"),
    ),
    "plate": (
        parameter("E_1", "youngs_modulus", "material", "1"),
        parameter("rho_2", "density", "material", "2"),
        parameter("E_3", "youngs_modulus", "material", "3"),
        parameter("m", "mass", "element", "91"),
    ),
    "bracket": (
        parameter("E_1", "youngs_modulus", "material", "1"),
        parameter("E_2", "youngs_modulus", "material", "2"),
        parameter("rho_2", "density", "material", "2"),
    ),
}


@dataclass(frozen=True, slots=True)
class Site:
    """A deck behind MYSTRAN, and what it gives."""

    name: str
    solver: Solver
    folder: Path

    def run(self, analysis: Analysis, **values: float) -> Result:
        folder = self.folder / f"job{len(list(self.folder.iterdir()))}"
        folder.mkdir()
        self.solver.render(values, analysis).write(folder)
        ended = run_process(self.solver.program.command(1), folder, 60.0, threading.Event())
        return self.solver.read(values, analysis, folder, ended.return_code)

    def matrices(self, **values: float) -> MatrixResult:
        found = self.run(MatrixAnalysis(), **values)
        assert isinstance(found, MatrixResult)
        return found

    def modal(self, n_modes: int, **values: float) -> ModalResult:
        nodes = tuple(sorted(self.solver.deck.summary.node_ids))
        found = self.run(ModalAnalysis(n_modes, nodes), **values)
        assert isinstance(found, ModalResult)
        return found


@pytest.fixture(params=sorted(DECKS))
def site(request: pytest.FixtureRequest, tmp_path: Path) -> Site:
    return site_of(request.param, tmp_path)


def site_of(name: str, folder: Path) -> Site:
    path = folder / f"{name}.bdf"
    path.write_text(DECKS[name][0]())
    jobs = folder / "jobs"
    jobs.mkdir()
    return Site(name, mystran_solver(path, PARAMETERS[name]), jobs)


def test_modes_of_the_matrices_are_mystrans_own(site: Site) -> None:
    n_rigid = DECKS[site.name][1]
    native, matrices = site.modal(n_rigid + 6), site.matrices()
    eigenvalues, shapes = solve_modes(matrices.stiffness, matrices.mass, n_rigid + 6)
    elastic = slice(n_rigid, None)
    np.testing.assert_allclose(eigenvalues[elastic], native.eigenvalues[elastic], rtol=PRINTED)
    assert native.n_rigid == n_rigid
    assert np.abs(eigenvalues[:n_rigid]).max(initial=0.0) < 1e-6 * eigenvalues[n_rigid]
    # Every grid point, in its own axes, held and dependent ones too.
    modes = native.modes
    seen = site.solver.deck.observation(matrices, modes.nodes, modes.components)
    assert not seen.unknown.any()
    mine, his = (seen.matrix @ shapes)[:, elastic], np.real(modes.mode_shapes)[:, elastic]
    signs = np.sign(np.sum(mine * his, axis=0))
    # Shapes come in single precision, or with seven digits.
    assert np.abs(mine * signs - his).max() < 1e-6 * np.abs(his).max()


def test_grid_points_of_rigid_elements_are_found_though_they_have_no_equations(
    tmp_path: Path,
) -> None:
    site = site_of("frame", tmp_path)
    matrices = site.matrices()
    assert matrices.dependent is not None
    wanted = np.array([CARRIED, PINNED, AVERAGED])
    assert not np.isin(wanted[[0, 2]], matrices.nodes).any()
    seen = site.solver.deck.observation(matrices, wanted, np.array([3, 1, 2]))
    assert not seen.held.any()
    # A motion of all grid points along an axis moves them by as much, whatever their own axes.
    mesh = site.solver.deck.mesh()
    axis = np.array([0.0, 0.6, 0.8])
    motion = np.zeros(matrices.nodes.size)
    for place, (node, component) in enumerate(
        zip(matrices.nodes.tolist(), matrices.components.tolist(), strict=True)
    ):
        if component <= 3:
            motion[place] = (mesh.frames.get(node, np.eye(3)) @ axis)[component - 1]
    every = np.repeat(wanted, 3)
    moved = site.solver.deck.observation(matrices, every, np.tile([1, 2, 3], 3)).matrix @ motion
    expected = [mesh.frames.get(node, np.eye(3)) @ axis for node in wanted.tolist()]
    np.testing.assert_allclose(moved, np.concatenate(expected), atol=1e-12)


def test_parameters_move_what_they_are_said_to_in_their_powers(site: Site) -> None:
    base = site.matrices()
    for item in PARAMETERS[site.name]:
        found = site.solver.deck.affected_elements(item)
        assert found is not None
        assert found.powers == (1,)
        near, far = (differences(base, site.matrices(**{item.name: v})) for v in (1.25, 1.75))
        for one, three, moves in zip(near, far, (found.stiffness, found.mass), strict=True):
            rows = sparse.coo_array(three)
            if item.quantity in ("youngs_modulus", "spring_stiffness", "density", "mass"):
                assert bool(rows.nnz) == moves
            touched = set(base.nodes[rows.row].tolist()) | set(base.nodes[rows.col].tolist())
            assert touched <= found.nodes
            assert _largest(three - 3.0 * one) <= 4.0 * ROUNDING * _size(base)


def _largest(matrix: sparse.csr_array) -> float:
    return float(np.abs(sparse.csr_array(matrix).data).max(initial=0.0))


def _size(base: MatrixResult) -> float:
    diagonal: Floats = base.upper_stiffness.diagonal()
    return float(diagonal.max())


def test_a_plates_thickness_is_six_powers_to_a_few_millionths(tmp_path: Path) -> None:
    site = site_of("plate", tmp_path)
    thickness = parameter("t", "thickness", "property", "2")
    solver = mystran_solver(tmp_path / "plate.bdf", (thickness,))
    found = solver.deck.affected_elements(thickness)
    assert found is not None
    assert (found.stiffness, found.mass) == (True, True)
    wider = Parameter("t", "thickness", "property", ("2",), 0.5, 2.5, 0.1)
    assert solver.deck.affected_elements(wider) is None
    site = Site("plate", solver, site.folder)
    base, at = site.matrices(), [0.55, 0.65, 0.75, 1.4, 1.65, 1.9]
    pairs = [differences(base, site.matrices(t=value)) for value in at]
    system = np.array([[value**k - 1.0 for k in found.powers] for value in at])
    for value in (0.6, 1.2, 1.8):
        row = np.array([value**k - 1.0 for k in found.powers])
        weights = np.linalg.solve(system.T, row)
        exact = differences(base, site.matrices(t=value))[0]
        fitted = sum(w * pair[0] for w, pair in zip(weights, pairs, strict=True))
        assert _largest(exact - fitted) < 1e-5 * _largest(exact)


def test_a_deck_that_is_reduced_has_no_matrices_of_parameters(tmp_path: Path) -> None:
    path = tmp_path / "reduced.bdf"
    path.write_text(bracket().replace("ENDDATA", "ASET1,123,1,THRU,8\nENDDATA"))
    assert not mystran_solver(path, ()).deck.summary.matrix_shapes


def test_mystran_stops_where_it_has_written_the_matrices(tmp_path: Path) -> None:
    site = site_of("bracket", tmp_path)
    site.matrices()
    site.modal(3)
    stopped, whole = (
        (folder / MYSTRAN.print_file).read_text() for folder in sorted(site.folder.iterdir())
    )
    assert "E I G E N V A L U E" in whole
    assert "E I G E N V A L U E" not in stopped


@pytest.mark.parametrize("damage", ["table", "entries", "marks", "missing"])
def test_files_that_are_not_whole_are_no_matrices(damage: str, tmp_path: Path) -> None:
    site = site_of("plate", tmp_path)
    site.matrices()
    (folder,) = site.folder.iterdir()
    if damage == "table":
        text = (folder / MYSTRAN.print_file).read_bytes()
        (folder / MYSTRAN.print_file).write_bytes(text[: text.rindex(HEADING) + 1500])
    elif damage == "missing":
        (folder / "job.L2A").unlink()
    else:
        data = (folder / "job.L2G").read_bytes()
        (folder / "job.L2G").write_bytes(data[:-8] if damage == "entries" else data[:-4] + b"0000")
    with pytest.raises(NoResult, match=re.escape(str(folder))):
        read_restart(folder, MYSTRAN.print_file, ())


def test_matrices_of_another_deck_are_told_by_a_grid_point_and_what_to_do(tmp_path: Path) -> None:
    site = site_of("plate", tmp_path)
    site.matrices()
    (folder,) = site.folder.iterdir()
    other = mystran_solver(_written(tmp_path / "frame.bdf", frame()), ())
    with pytest.raises(NoResult, match=r"of another deck, which has no grid point 1 .* run it"):
        other.read({}, MatrixAnalysis(), folder, 0)


def _written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path
