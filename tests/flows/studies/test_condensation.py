"""`expand`, `reduce`, `direct` on three structures: a chain, a strip of shells, a mounted frame."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import linalg

import modetune
from modetune.core.errors import CampaignError, SolverExhausted
from modetune.core.modes import COMPONENTS
from tests.adapters.mystran_decks import frame
from tests.adapters.solved import needs_ccx, needs_mystran
from tests.command_line import run_command

#: Springs in N/m of eight masses of 1 to 3 kg, the first one to ground.
SPRINGS = (900.0, 1200.0, 700.0, 1500.0, 1100.0, 800.0, 1300.0, 1000.0)
CHAIN = (
    "masses: {" + ", ".join(f"m{k}: {1.0 + k % 3}" for k in range(1, 9)) + "}\nsprings:\n"
    "  k1: {between: [ground, m1], stiffness: 900.0}\n"
    + "".join(
        f"  k{k}: {{between: [m{k - 1}, m{k}], stiffness: {SPRINGS[k - 1]}}}\n"
        for k in range(2, 9)
    )
)  # fmt: skip
#: A cantilever of shells that stands obliquely, 240 x 20 x 2 mm, clamped at its first two nodes.
STRIP = (
    "*NODE, NSET=ALL\n"
    + "".join(
        f"{10 * i + j}, {16.0 * i:.1f}, {20.0 * j:.1f}, {12.0 * i:.1f}\n"
        for i in range(13)
        for j in (1, 2)
    )
    + "*ELEMENT, TYPE=S4, ELSET=PLATE\n"
    + "".join(
        f"{i + 1}, {10 * i + 1}, {10 * i + 11}, {10 * i + 12}, {10 * i + 2}\n" for i in range(12)
    )
    + "*MATERIAL, NAME=M\n*ELASTIC\n70000., .3\n*DENSITY\n2.7e-9\n"
    + "*SHELL SECTION, ELSET=PLATE, MATERIAL=M\n2.\n*BOUNDARY\n1, 1, 6\n2, 1, 6\n"
)


def chain_matrices() -> tuple[Any, Any]:
    springs = np.array(SPRINGS)
    off = -springs[1:]
    k = np.diag(springs + np.append(springs[1:], 0.0)) + np.diag(off, 1) + np.diag(off, -1)
    return k, np.diag([1.0 + n % 3 for n in range(1, 9)])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "chain.yaml").write_text(CHAIN)
    (tmp_path / "strip.inp").write_text(STRIP)
    (tmp_path / "frame.bdf").write_text(frame())
    return tmp_path


def measured_of(
    name: str, nodes: list[int], components: str, n_modes: int = 4, noise: float = 0.0
) -> tuple[Path, Any]:
    """A test of a model's own modes at these places, and the modes themselves."""
    model = modetune.modes(name, number=n_modes + 6, settings=["model.units=m-kg-s"]).elastic
    places = {
        dof: row
        for row, dof in enumerate(zip(model.nodes.tolist(), model.components.tolist(), strict=True))
    }
    random = np.random.default_rng(2)
    lines = [
        "mode," + ",".join(str(k + 1) for k in range(n_modes)),
        "frequency_hz," + ",".join(f"{f:.10g}" for f in model.frequencies_hz[:n_modes]),
    ]
    for node in nodes:
        for axis in components:
            shape = model.mode_shapes[places[node, COMPONENTS.index(axis) + 1], :n_modes].real
            size = np.abs(model.mode_shapes[:, :n_modes]).max(axis=0)
            shape = shape + noise * size * random.normal(size=n_modes)
            lines.append(f"{node}.{axis}," + ",".join(f"{value:.10g}" for value in shape))
    path = Path(name).with_suffix(".csv")
    path.write_text("\n".join(lines) + "\n")
    return path, model


CASES = [
    pytest.param("chain.yaml", [1, 3, 4, 6, 8], "x", id="chain"),
    pytest.param("strip.inp", [31, 52, 62, 81, 92, 112, 121], "xyz", id="strip", marks=needs_ccx),
    pytest.param("frame.bdf", [1, 3, 5, 8, 10, 12, 15, 17], "xyz", id="frame", marks=needs_mystran),
]
UNITS = ["model.units=m-kg-s"]


@pytest.mark.parametrize(("model", "nodes", "components"), CASES)
def test_serep_and_kidder_give_a_models_own_modes_back_everywhere(
    folder: Path, model: str, nodes: list[int], components: str
) -> None:
    test, own = measured_of(model, nodes, components)
    found = modetune.expand(model, test, modes=4, settings=UNITS)
    ways = {item.method: item for item in found.methods}
    for name, tolerance in (("serep", 1e-7), ("kidder", 1e-4)):
        # Ten digits in the test; Kidder amplifies them next to modes of the model held there.
        shapes = ways[name].modes
        assert shapes is not None
        rows = {
            dof: row
            for row, dof in enumerate(
                zip(shapes.nodes.tolist(), shapes.components.tolist(), strict=True)
            )
        }
        names = zip(own.nodes.tolist(), own.components.tolist(), strict=True)
        both = [(rows[dof], row) for row, dof in enumerate(names) if dof in rows and dof[1] <= 3]
        assert len(both) > 4 * len(nodes) or model == "chain.yaml"
        mine, theirs = np.array(both).T
        expected = own.mode_shapes[theirs, :4]
        error = np.abs(shapes.mode_shapes[mine] - expected).max(axis=0)
        assert (error <= tolerance * np.abs(expected).max(axis=0)).all(), name
        assert ways[name].error < 1e-3
    assert found.best in ("serep", "kidder")


@pytest.mark.parametrize(("model", "nodes", "components"), CASES)
def test_modes_are_orthogonal_in_the_mass_that_serep_leaves_at_the_sensors(
    folder: Path, model: str, nodes: list[int], components: str
) -> None:
    if model == "strip.inp":  # fourteen modes of a plate that moves along its normal alone
        nodes = [10 * i + j for i in range(1, 13) for j in (1, 2)]
    test, _ = measured_of(model, nodes, components)
    found = modetune.correlate(model, test, orthogonality="serep", settings=UNITS).orthogonality
    assert found is not None
    assert len(found.dofs) == len(nodes) * len(components)
    # Ten digits in the test, shapes of a size that is not one of unit mass: cosines are.
    sizes = np.sqrt(np.abs(np.diag(found.first)))
    cosines = np.abs(found.first) / np.outer(sizes, sizes)
    np.testing.assert_allclose(cosines, np.eye(4), atol=1e-6)
    np.testing.assert_allclose(np.abs(found.second[:4, :4]), np.eye(4), atol=1e-6)


@pytest.mark.parametrize(("model", "nodes", "components"), CASES)
def test_a_limit_of_memory_holds_for_the_factors_of_each_study(
    folder: Path, model: str, nodes: list[int], components: str
) -> None:
    """A megabyte, which this process alone exceeds."""
    test, _ = measured_of(model, nodes, components)
    settings = [*UNITS, "run.memory_gb=0.001"]
    masters = [f"{node}.{components}" for node in nodes]
    for study in (
        lambda: modetune.expand(model, test, settings=settings),
        lambda: modetune.reduce(model, "guyan", masters, settings=settings),
        lambda: modetune.correlate(model, test, orthogonality="guyan", settings=settings),
    ):
        with pytest.raises(SolverExhausted, match=r"raise `run\.memory_gb`"):
            study()


@pytest.mark.parametrize(("model", "nodes", "components"), CASES)
def test_the_error_at_held_out_sensors_is_what_noise_leaves(
    folder: Path, model: str, nodes: list[int], components: str
) -> None:
    test, _ = measured_of(model, nodes, components, noise=0.03)
    found = modetune.expand(model, test, settings=UNITS)
    serep = next(item for item in found.methods if item.method == "serep")
    # Noise of the held-out value itself is there, of the others some more of it comes in.
    assert 0.005 < serep.error < (0.3 if model != "chain.yaml" else 1.0)
    assert all(item.error >= found.chosen.error for item in found.methods if not item.unavailable)


@pytest.mark.parametrize(("model", "nodes", "components"), CASES)
@pytest.mark.parametrize("method", ["guyan", "irs", "iterated_irs", "serep", "craig_bampton"])
def test_a_reduced_model_lies_above_the_full_one_and_is_told_so(
    folder: Path, model: str, nodes: list[int], components: str, method: Any
) -> None:
    masters = [f"{node}.{components}" for node in nodes]
    found = modetune.reduce(model, method, masters, modes=3, settings=UNITS)
    own = modetune.modes(model, settings=UNITS).elastic.frequencies_hz[:3]
    np.testing.assert_allclose(found.full_hz, own, rtol=2e-5)  # digits that solvers print
    # Rayleigh and Ritz: no frequency falls by a constraint, but for the rounding of the largest
    # eigenvalue: through the strip's thickness (c / t)^2, 1e9 times the first one, times 2.2e-16.
    assert (found.errors > -1e-6).all()
    most = {"guyan": 0.2, "irs": 0.02, "iterated_irs": 1e-3, "serep": 1e-6, "craig_bampton": 0.02}
    assert found.errors.max() < most[method]
    if method == "serep":
        np.testing.assert_allclose(found.shared, 1.0, atol=1e-6)


def test_guyan_at_the_ends_of_a_chain_is_springs_in_series(folder: Path) -> None:
    found = modetune.reduce("chain.yaml", "guyan", ["8.x"])
    # One master: all springs in series; each mass moves by its share of the flexibility.
    share = np.cumsum(1.0 / np.array(SPRINGS))
    np.testing.assert_allclose(found.matrices.stiffness, [[1.0 / share[-1]]], rtol=1e-12)
    masses = np.diag(chain_matrices()[1])
    expected = np.sum(masses * (share / share[-1]) ** 2)
    np.testing.assert_allclose(found.matrices.mass, [[expected]], rtol=1e-12)


def test_what_is_reduced_is_a_model_for_the_next_command(folder: Path) -> None:
    ended = run_command(
        folder, "model", "reduce", "chain.yaml", "--masters", "2,5.x,7-8",
        "--method", "craig_bampton", "--modes", "2", "--out", "small.yaml", "--json",
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    told = json.loads(ended.stdout)
    assert told["masters"] == ["2.x", "5.x", "7.x", "8.x"]
    assert told["unknowns"] == 8
    small = modetune.modes("small.yaml")
    reduced = [row["reduced_hz"] for row in told["modes"]]
    np.testing.assert_allclose(small.modes.frequencies_hz[:2], reduced, rtol=1e-9)


@pytest.mark.parametrize("method", ["berman", "baruch"])
def test_a_corrected_chain_has_the_tests_frequencies_and_is_told_what_broke(
    folder: Path, method: Any
) -> None:
    test, own = measured_of("chain.yaml", [1, 2, 4, 5, 7, 8], "x", 3, noise=0.02)
    text = test.read_text().splitlines()
    hertz = own.frequencies_hz[:3] * [1.05, 0.97, 1.02]
    text[1] = "frequency_hz," + ",".join(f"{f:.10g}" for f in hertz)
    test.write_text("\n".join(text) + "\n")
    found = modetune.direct("chain.yaml", test, method)
    lam = linalg.eigh(found.matrices.stiffness, found.matrices.mass, eigvals_only=True)
    all_hz = np.sqrt(lam) / (2.0 * np.pi)
    for wanted in hertz:
        assert np.abs(all_hz / wanted - 1.0).min() < 1e-9
    stiffness, mass = found.damage
    k = chain_matrices()[0]
    filled = (np.abs(found.matrices.stiffness) > 1e-9 * np.abs(k).max()) & (k == 0.0)
    assert stiffness.couplings == filled.sum() == 8 * 8 - (8 + 2 * 7)
    assert 0.0 < stiffness.unmeasured < 1.0
    assert (mass.size == 0.0) == (method == "baruch")
    assert {item.test for item in found.modes} >= {1, 2, 3}
    assert "couplings of unknowns that no element joins" in found.notes[0]


def test_the_error_matrix_method_finds_a_soft_spring_from_all_modes(folder: Path) -> None:
    """To first order, with every unknown and mode measured: dK of a spring 2 % softer."""
    k, m = chain_matrices()
    soft = k.copy()
    soft[np.ix_([3, 4], [3, 4])] -= 0.02 * SPRINGS[4] * np.array([[1.0, -1.0], [-1.0, 1.0]])
    lam, phi = linalg.eigh(soft, m)
    lines = ["mode," + ",".join(map(str, range(1, 9)))]
    lines.append("frequency_hz," + ",".join(f"{f:.12g}" for f in np.sqrt(lam) / (2 * np.pi)))
    lines += [f"{n + 1}.x," + ",".join(f"{v:.12g}" for v in phi[n]) for n in range(8)]
    (folder / "soft.csv").write_text("\n".join(lines) + "\n")
    found = modetune.direct("chain.yaml", "soft.csv", "error_matrix", mass_normalised=True)
    change = found.matrices.stiffness - k
    np.testing.assert_allclose(change, soft - k, atol=0.05 * np.abs(soft - k).max())
    assert found.damage[1].size < 1e-3


def test_a_negative_stiffness_and_rigid_motion_that_is_not_free_are_told(folder: Path) -> None:
    (folder / "free.yaml").write_text(
        "masses: {a: 1.0, b: 2.0, c: 1.5, d: 1.0}\nsprings:\n"
        "  s: {between: [a, b], stiffness: 100.0}\n  t: {between: [b, c], stiffness: 150.0}\n"
        "  u: {between: [c, d], stiffness: 120.0}\n"
    )
    (folder / "free.csv").write_text(
        "mode,1,2\nfrequency_hz,1.5,3.1\n1.x,1.0,1.0\n2.x,0.3,-0.9\n3.x,-0.5,0.2\n4.x,-0.9,0.8\n"
    )
    found = modetune.direct("free.yaml", "free.csv", "berman")
    # The test's shapes are not free of momentum, so rigid motion is strained.
    assert found.rigid_hz > 0.0
    assert any("rigid motion is not free" in note for note in found.notes)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["reduce", "chain.yaml"], "requires measured mode shapes"),
        (["reduce", "chain.yaml", "--masters", "9"], "--masters '9': the model has no node 9"),
        (["reduce", "chain.yaml", "--masters", "3.z"], "have no component z"),
        (["reduce", "chain.yaml", "--masters", "keep.txt"], "keep.txt, line 2: 'seven' is not"),
        (["reduce", "chain.yaml", "--masters", "3", "--method", "irz"], "expected one of guyan"),
        (["reduce", "chain.yaml", "--masters", "3", "--out", "a.inp"], "a.inp: matrices are"),
        (["reduce", "chain.yaml", "--masters", "3", "--method", "serep", "--modes", "2"],
         "SEREP keeps no more modes than there are masters"),
        (["expand", "chain.yaml", "bare.csv"], "requires measured mode shapes"),
        (["expand", "chain.yaml", "held.csv", "--method", "kiddr"], "expected one of serep"),
        (["expand", "chain.yaml", "held.csv", "--paraview", "p"], "nothing to show in ParaView"),
        (["expand", "chain.yaml", "held.csv", "--out", "shapes.txt"], "a test file is written as"),
        (["direct", "chain.yaml", "held.csv", "--method", "brman"], "expected one of berman"),
        (["direct", "chain.yaml", "held.csv", "--filling", "air"], "expected one of kidder"),
    ],
)  # fmt: skip
def test_bad_input_is_one_sentence_with_its_place(
    folder: Path, arguments: list[str], said: str
) -> None:
    (folder / "keep.txt").write_text("# kept\n3.x seven\n")
    (folder / "bare.csv").write_text("mode,1\nfrequency_hz,1.0\n")
    (folder / "held.csv").write_text("mode,1\nfrequency_hz,1.0\n2.x,1.0\n5.x,0.4\n")
    ended = run_command(folder, "model", *arguments, "--no-prefect")
    assert ended.returncode == 2, ended.stderr + ended.stdout
    assert said in ended.stderr
    assert "Traceback" not in ended.stderr


def test_a_large_model_is_to_be_reduced_before_it_is_corrected(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("modetune.flows.studies.direct.correction.MOST", 7)
    test, _ = measured_of("chain.yaml", [1, 3, 8], "x", 2)
    with pytest.raises(CampaignError, match=r"modetune model reduce --out reduced\.yaml"):
        modetune.direct("chain.yaml", test)


@needs_ccx
def test_the_chosen_expansion_is_written_for_paraview_and_as_modes(folder: Path) -> None:
    pyvista = pytest.importorskip("pyvista", reason="ParaView files need pyvista")
    test, own = measured_of("strip.inp", [31, 52, 71, 92, 112, 121], "xyz")
    ended = run_command(
        folder, "model", "expand", "strip.inp", str(test), "--units", "m-kg-s", "--method", "serep",
        "--out", "whole.h5", "--paraview", "pv", "--figures", "fig", "--json", "--no-prefect",
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    told = json.loads(ended.stdout)
    assert [row["method"].partition(",")[0] for row in told["methods"]] == ["serep"]
    assert [Path(name).name for name in told["written"]] == [
        "whole.h5", "expanded.pvd", "held_out.png",
    ]  # fmt: skip
    whole = modetune.read_test("whole.h5")
    assert whole.modes is not None
    assert whole.modes.modes.n_dof == own.n_dof
    reader = pyvista.PVDReader(folder / "pv" / "expanded.pvd")
    reader.set_active_time_value(2.0)
    grid = reader.read()[0]
    place = int(np.flatnonzero(np.asarray(grid["node"]) == 62)[0])
    rows = [int(np.flatnonzero((own.nodes == 62) & (own.components == c))[0]) for c in (1, 2, 3)]
    expected = own.mode_shapes[rows, 1].real
    error = np.abs(np.asarray(grid["mode_shape"])[place] - expected).max()
    assert error < 1e-6 * np.abs(expected).max()
