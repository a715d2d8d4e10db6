"""Models updated from response functions: closed forms of full matrices in, parameters out."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigh

from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.solver import ModalAnalysis
from modetune.adapters.test_files.universal.file import write_universal
from modetune.core.measurement.measurement import MeasuredFrfs, Measurement
from modetune.core.measurement.response_functions import Complexes, NormalModes, modal_frf
from modetune.core.modes import Floats, MeasuredModes, mode_set
from modetune.core.storage.campaign_record import read_record
from modetune.core.updating.job_results import ModalResult
from modetune.flows.report.response_functions import response_pairs
from tests.adapters.test_solver_contract import run
from tests.command_line import run_command
from tests.flows.updating.test_static import TRUTH as BAR_TRUTH
from tests.flows.updating.test_static import deck

#: A chain of eight masses on one spring, kg and N/m; with factors of its second and fifth spring.
MASSES = np.array([2.0, 1.5, 1.0, 1.2, 0.8, 1.0, 1.4, 0.9])
SPRINGS = np.array([9e4, 6e4, 7e4, 8e4, 6e4, 5e4, 9e4, 7e4])
TRUTH = {2: 1.25, 5: 0.8}
#: Damping C = BETA K: ratios of 0.2 to 2 %, another one of each mode.
BETA = 1e-4
SENSORS, FORCE = (1, 3, 5, 8), 3
CAMPAIGN = """name: chain
model: {deck: chain.yaml, solver: matrices, units: m-kg-s}
test: {modes: test.unv}
parameters:
  - {name: k2, quantity: spring_stiffness, elset: k2, bounds: [0.5, 2.0]}
  - {name: k5, quantity: spring_stiffness, elset: k5, bounds: [0.5, 2.0]}
residuals:
  frequency_weight: %g
  frf: {%s}
update: {e1: {frequency: 1.0e-3}, starts: 1}
"""


def chain(factors: dict[int, float]) -> tuple[Floats, Floats]:
    springs = SPRINGS * [factors.get(n, 1.0) for n in range(1, 9)]
    stiffness = np.diag(springs + np.append(springs[1:], 0.0))
    stiffness -= np.diag(springs[1:], 1) + np.diag(springs[1:], -1)
    return stiffness, np.diag(MASSES)


def accelerances(lines_hz: Floats) -> Complexes:
    """Of the truth by (K - w^2 M + i w C)^-1, (n_lines, n_sensors)."""
    stiffness, mass = chain(TRUTH)
    rows = np.array(SENSORS) - 1
    values = []
    for w in 2.0 * np.pi * lines_hz:
        whole = np.linalg.inv(stiffness * (1.0 + 1j * w * BETA) - w**2 * mass)
        values.append(-(w**2) * whole[rows, FORCE - 1])
    return np.array(values)


def measurement(noise: float = 0.0, coherence: float | None = None) -> Measurement:
    stiffness, _ = chain(TRUTH)
    root = np.sqrt(MASSES)
    lam, turned = np.linalg.eigh(stiffness / np.outer(root, root))
    shapes = (turned / root[:, None])[np.array(SENSORS) - 1, :4]
    hz = np.sqrt(lam[:4]) / (2.0 * np.pi)
    n = len(SENSORS)
    modes = mode_set(hz, shapes, SENSORS, [1] * n, 0.5 * BETA * np.sqrt(lam[:4]))
    lines = np.arange(2.0, 60.0, 0.05)
    values = accelerances(lines)
    random = np.random.default_rng(7)
    parts = random.standard_normal(values.shape) + 1j * random.standard_normal(values.shape)
    values = values * (1.0 + noise * parts)
    frfs = MeasuredFrfs(
        "accelerance", lines, values, np.array(SENSORS), np.ones(n, np.int64), np.ones(n),
        np.full(n, FORCE), np.ones(n, np.int64), np.ones(n),
        np.zeros((0, 0)) if coherence is None else np.full(values.shape, coherence),
    )  # fmt: skip
    return Measurement(modes=MeasuredModes((1, 2, 3, 4), modes), frfs=frfs)


def campaign(folder: Path, test: Measurement, frf: str = "", frequencies: float = 0.0) -> Path:
    lines = [f"  m{n}: {mass}" for n, mass in enumerate(MASSES, start=1)]
    ends = ["ground", *(f"m{n}" for n in range(1, 9))]
    springs = [
        f"  k{n}: {{between: [{ends[n - 1]}, {ends[n]}], stiffness: {value}}}"
        for n, value in enumerate(SPRINGS, start=1)
    ]
    (folder / "chain.yaml").write_text("\n".join(["masses:", *lines, "springs:", *springs, ""]))
    write_universal(folder / "test.unv", test)
    path = folder / "campaign.yaml"
    path.write_text(CAMPAIGN % (frequencies, frf))
    return path


def updated(folder: Path, path: Path) -> list[float]:
    ended = run_command(folder, "update", str(path), "--json", "--set", "report.page=false")
    assert ended.returncode == 0, ended.stderr
    told = json.loads(ended.stdout)
    assert told["status"] == "converged", ended.stderr
    return [item["updated"] for item in told["parameters"]]


@pytest.mark.parametrize("frequencies", [0.0, 1.0])
def test_a_chain_is_found_from_its_response_functions(tmp_path: Path, frequencies: float) -> None:
    path = campaign(tmp_path, measurement(), frequencies=frequencies)
    found = updated(tmp_path, path)
    # The file's seven digits and e1 (frequencies to 1e-3, FRAC 0.9) bound them.
    assert found == pytest.approx(list(TRUTH.values()), rel=5e-3)
    pairs = response_pairs(read_record(tmp_path / "runs" / "chain" / "campaign.h5"))
    assert [pair.title for pair in pairs] == [
        f"{node}.x for a force at 3.x" for node in (3, 1, 5, 8)
    ]
    # The model as it was: its eight modes, with the test's ratios or their median.
    stiffness, mass = chain({})
    lam, shapes = eigh(stiffness, mass)
    tested = measurement().modes
    assert tested is not None
    ratios = tested.modes.damping_ratios
    every = np.append(ratios, np.full(4, np.median(ratios)))
    for pair, node in zip(pairs, (3, 1, 5, 8), strict=True):
        modes = NormalModes(lam, shapes, every)
        assert pair.compared_hz is not None
        own = modal_frf(pair.compared_hz, modes, [node - 1], [FORCE - 1], "accelerance")[:, 0, 0]
        assert pair.before == pytest.approx(own, rel=1e-5)  # seven digits of a file


ZETA = (
    "  - {name: z%d, quantity: variable, values: absolute, initial: 0.01, bounds: [0.0005, 0.1], "
    "deviation: 0.01}\n"
)


def with_ratios(path: Path, *modes: int) -> Path:
    """A campaign with parameters z1, z2, ... beside its own."""
    more = "".join(ZETA % mode for mode in modes)
    path.write_text(path.read_text().replace("residuals:\n", f"{more}residuals:\n"))
    return path


def test_damping_ratios_are_parameters(tmp_path: Path) -> None:
    """Of each mode its own: beta w / 2 of a damping C = beta K."""
    test = measurement()
    assert test.modes is not None
    own = "damping: {1: z1, 2: z2, 3: z3, 4: z4, others: 0.02}, frac: 0.9999"
    k2, k5, *ratios = updated(tmp_path, with_ratios(campaign(tmp_path, test, own), 1, 2, 3, 4))
    assert [k2, k5] == pytest.approx(list(TRUTH.values()), rel=5e-3)
    # FRAC ends updating where damping is right to some percent; those of the band's modes are.
    assert ratios == pytest.approx(test.modes.modes.damping_ratios.tolist(), rel=0.05)


@pytest.mark.parametrize(
    ("frf", "changed", "said"),
    [
        ("damping: z1", (), "residuals.frf.damping: no parameter z1 is a `variable`"),
        ("damping: k2", (), "residuals.frf.damping: no parameter k2 is a `variable`"),
        ("damping: {7: z1}", (1,), "the test has no mode 7"),
        ("damping: 0.01", (1,), "the variable z1 is not used"),
        ("damping: {1: z1, others: 1.5}", (1,), "less than 1"),
    ],
)
def test_ratios_that_are_no_parameters_are_told(
    tmp_path: Path, frf: str, changed: tuple[int, ...], said: str
) -> None:
    path = with_ratios(campaign(tmp_path, measurement(), frf), *changed)
    ended = run_command(tmp_path, "update", str(path))
    assert ended.returncode == 2
    assert said in " ".join(ended.stderr.split()), ended.stderr


def test_coherence_weighs_and_noise_does_not_draw(tmp_path: Path) -> None:
    # 3 % noise of every line: with n averages a coherence of 1 / (1 + 2 n s^2).
    test = measurement(noise=0.03, coherence=1.0 / (1.0 + 2.0 * 10 * 0.03**2))
    found = updated(tmp_path, campaign(tmp_path, test, "averages: 10, band: [3, 30]"))
    # 64 lines of 3 % and at least a slope of 1 leave less than 1 %.
    assert found == pytest.approx(list(TRUTH.values()), rel=0.01)


def without(test: Measurement, **changed: Any) -> Measurement:
    assert test.frfs is not None
    return replace(test, frfs=replace(test.frfs, **changed))


@pytest.mark.parametrize(
    ("test", "frf", "said"),
    [
        (replace(measurement(), frfs=None), "", "no response functions that can be used"),
        (
            without(measurement(), reference_components=np.zeros(4, np.int64)),
            "",
            "without node or direction of its force",
        ),
        (measurement(coherence=1.2), "", "the coherence of response function 1.x by 3.x is 1.2"),
        (measurement(), "averages: 4", "the test has no coherences"),
        (measurement(), "band: [30, 10]", "30 to 10 Hz is not a band"),
        (measurement(), "band: [100, 200]", "no response function at a sensor"),
    ],
)
def test_what_cannot_be_compared_is_told_with_file_and_line(
    tmp_path: Path, test: Measurement, frf: str, said: str
) -> None:
    path = campaign(tmp_path, test, frf)
    ended = run_command(tmp_path, "update", str(path))
    assert ended.returncode == 2
    told = " ".join(ended.stderr.split())
    assert said in told
    assert "campaign.yaml, line 9: residuals.frf: " in told


def test_functions_that_are_not_compared_are_named(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    test = measurement()
    assert test.frfs is not None
    values = test.frfs.values.copy()
    values[:, 1] = random.standard_normal((values.shape[0], 2)) @ [1.0, 1.0j]  # noise alone
    path = campaign(tmp_path, without(test, values=values))
    told = " ".join(run_command(tmp_path, "update", str(path)).stderr.split())
    assert "campaign.yaml, line 9: 1 of 4 response functions are not compared, because none" in told
    assert "exceeds the noise between" in told


def test_a_test_without_damping_needs_a_ratio(tmp_path: Path) -> None:
    test = measurement()
    assert test.modes is not None
    bare = replace(test.modes, modes=replace(test.modes.modes, damping_ratios=np.zeros(0)))
    path = campaign(tmp_path, replace(test, modes=bare))
    ended = run_command(tmp_path, "update", str(path))
    assert "have damping ratios: give `damping`" in " ".join(ended.stderr.split())


def test_it_is_told_that_dampers_of_the_deck_take_the_place_of_the_tests_ratios(
    tmp_path: Path,
) -> None:
    path = campaign(tmp_path, measurement())

    def told() -> str:
        return " ".join(run_command(tmp_path, "check", str(path), "--no-run").stderr.split())

    said = "use the deck's dampers and loss factors instead of the test's damping ratios"
    assert said not in told()
    more = "dampers:\n  d2: {between: [m1, m2], viscous: 3.0}\n"
    deck_file = tmp_path / "chain.yaml"
    deck_file.write_text(deck_file.read_text() + more)
    assert said in told()


def test_a_sensor_that_is_left_out_takes_its_functions_with_it(tmp_path: Path) -> None:
    test = measurement()
    assert test.frfs is not None
    wrong = without(test, values=test.frfs.values * [1.0, 1.0, 3.0, 1.0])
    path = campaign(tmp_path, wrong)
    path.write_text(path.read_text().replace("residuals:", "residuals:\n  sensor_weight: {5: 0}"))
    assert updated(tmp_path, path) == pytest.approx(list(TRUTH.values()), rel=5e-3)


BAR = """name: bar
model: {deck: bar.inp, solver: calculix, units: mm-t-s}
test: {modes: test.unv}
parameters:
  - {name: E, quantity: youngs_modulus, material: A, bounds: [0.5, 2.0]}
  - {name: rho, quantity: density, material: A, bounds: [0.5, 2.0]}
residuals:
  frequency_weight: 0.0
  frf: {damping: 0.01, deviation: 0.02, frac: 0.999}
update: {e1: {frequency: 1.0e-4}, starts: 1}
"""


@pytest.mark.skipif(shutil.which("ccx") is None, reason="ccx is not installed")
def test_mobilities_tell_modulus_from_density_of_a_ccx_bar(tmp_path: Path) -> None:
    """What frequencies alone cannot. The truth is summed from 103 of its 105 modes, by ccx."""
    (tmp_path / "truth.inp").write_text(deck(*BAR_TRUTH))
    solver = calculix_solver(tmp_path / "truth.inp", ())
    (tmp_path / "jobs").mkdir()
    modal = run(solver, {}, ModalAnalysis(103, (13, 21)), tmp_path / "jobs")
    assert isinstance(modal, ModalResult)
    names = list(zip(modal.modes.nodes.tolist(), modal.modes.components.tolist(), strict=True))
    ends = [(13, 2), (13, 3), (21, 2), (21, 3)]
    rows = np.array([names.index(end) for end in ends])
    hz = modal.modes.frequencies_hz
    lines: Floats = np.arange(round(0.3 * hz[0]), 1.2 * hz[2], 2.0)
    shapes = np.real(modal.modes.mode_shapes)
    superposed = NormalModes(modal.eigenvalues, shapes, np.full(hz.size, 0.01))
    # of two forces, along y and z; m/s/N from mm/s/N
    values = 1e-3 * np.hstack(
        [modal_frf(lines, superposed, rows, [force], "mobility")[:, :, 0] for force in rows[2:]]
    )
    nodes, components = np.transpose(ends * 2)
    frfs = MeasuredFrfs(
        "mobility", lines, np.asarray(values, np.complex128), nodes, components, np.ones(8),
        np.full(8, 21), np.repeat([2, 3], 4), np.ones(8), np.zeros((0, 0)),
    )  # fmt: skip
    modes = mode_set(hz[:3], shapes[rows, :3], nodes[:4], components[:4])
    write_universal(tmp_path / "test.unv", Measurement(MeasuredModes((1, 2, 3), modes), None, frfs))
    (tmp_path / "bar.inp").write_text(deck())
    path = tmp_path / "campaign.yaml"
    path.write_text(BAR)
    found = updated(tmp_path, path)
    # It ends when e1 is met: a FRAC sees frequencies, and no factor on all amplitudes.
    assert found == pytest.approx(list(BAR_TRUTH), rel=0.02)
    assert found[0] / found[1] == pytest.approx(BAR_TRUTH[0] / BAR_TRUTH[1], rel=3e-3)
