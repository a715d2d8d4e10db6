"""Every study with every kind of response: done with what the kind says, or refused with a line.

One chain of six masses is the model of all campaigns, so that jobs of one kind's studies answer
those of the others; a second one, with a payload, is the other configuration. Strains need places,
which it has not: they are refused here, and go through all studies in
tests/flows/updating/test_modal_strain.py.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from modetune.adapters.test_files.universal.file import write_universal
from modetune.core.measurement.measurement import MeasuredFrfs, Measurement
from modetune.core.modes import MeasuredModes, mode_set
from tests.adapters.test_files.universal_text import mode_55, save
from tests.command_line import run_command

MASSES = np.array([2.0, 1.5, 1.0, 1.2, 0.8, 1.0])
SPRINGS = np.array([9e4, 6e4, 7e4, 8e4, 6e4, 5e4])
#: Factors of the second and the fifth spring, of all masses and of the damper at the ground.
TRUTH = {"k2": 1.1, "k5": 0.93, "m": 1.0, "c1": 1.3}
GROUND, BETWEEN, PULL, FORCE, PAYLOAD = 4.0, 2.0, 100.0, 2, 1.0
PARAMETERS = {
    "k2": "quantity: spring_stiffness, elset: k2, bounds: [0.7, 1.5]",
    "k5": "quantity: spring_stiffness, elset: k5, bounds: [0.7, 1.5]",
    "m": "quantity: mass, elset: [m1, m2, m3, m4, m5, m6], bounds: [0.8, 1.25]",
    "c1": "quantity: viscous_damping, elset: c1, bounds: [0.5, 2.0]",
}
#: What each kind writes below `residuals`; %s: readings of a pull at the last mass.
KINDS = {
    "shapes": "shape_weight: 1.0",
    "mac": "mac: {}",
    "static": "static: {cases: [{forces: {6.x: 100.0}, displacements: {%s}, deviation: 0.002}]}",
    "damping": "damping: {deviation: 0.02, tolerance: 0.01}",
    "mass_properties": "mass_properties: {mass: {target: 7.5, deviation: 0.01, limits: [6, 9]}}",
    "frf": "frf: {points: 4, frac: 0.8}",
    "complex_shapes": "complex_shapes: {deviation: 0.001, mac: 0.99999}",
}
#: What may change beside the second spring, so that each kind has something of its own to tell.
ALSO = {"damping": "c1", "mass_properties": "m", "static": "m", "complex_shapes": "c1"}


def truth(payload: float = 0.0) -> tuple[Any, Any, Any]:
    """K, C and M."""
    springs = SPRINGS * [1.0, TRUTH["k2"], 1.0, 1.0, TRUTH["k5"], 1.0]
    stiffness = np.diag(springs + np.append(springs[1:], 0.0))
    stiffness -= np.diag(springs[1:], 1) + np.diag(springs[1:], -1)
    damping = np.zeros((6, 6))
    damping[0, 0] = GROUND * TRUTH["c1"]
    damping[3:5, 3:5] = BETWEEN * np.array([[1.0, -1.0], [-1.0, 1.0]])
    return stiffness, damping, np.diag(MASSES + payload * np.eye(6)[5])


def write_case(folder: Path, name: str = "", payload: float = 0.0) -> None:
    """A model and its test: four modes with dampings, and accelerances by a force at the third."""
    k, c, m = truth(payload)
    root = np.sqrt(np.diag(m))
    lam, turned = np.linalg.eigh(k / np.outer(root, root))
    inverse = np.linalg.inv(m)
    state = np.block([[np.zeros((6, 6)), np.eye(6)], [-inverse @ k, -inverse @ c]])
    found, vectors = np.linalg.eig(state)
    order = [n for n in np.argsort(np.abs(found)) if found[n].imag > 0.0][:4]
    roots = found[order]
    hz, shapes = np.sqrt(lam[:4]) / (2.0 * np.pi), (turned / root[:, None])[:, :4]
    nodes, ones = np.arange(1, 7), np.ones(6, np.int64)
    modes = mode_set(hz, shapes, nodes, ones, [-s.real / abs(s) for s in roots])
    lines = np.arange(5.0, 70.0, 0.1)
    values = np.array(
        [-(w**2) * np.linalg.inv(k - w**2 * m + 1j * w * c)[:, FORCE] for w in 2.0 * np.pi * lines]
    )
    frfs = MeasuredFrfs(
        "accelerance", lines, values, nodes, ones, np.ones(6), np.full(6, FORCE + 1), ones,
        np.ones(6), np.zeros((0, 0)),
    )  # fmt: skip
    test = Measurement(modes=MeasuredModes((1, 2, 3, 4), modes), frfs=frfs)
    write_universal(folder / f"test{name}.unv", test)
    own = []
    for number, (root, place) in enumerate(zip(roots.tolist(), order, strict=True), start=1):
        moved = (complex(2.0, -1.5) * vectors[:6, place]).tolist()  # in any phase and scale
        points = {node: [value, 0.0j, 0.0j] for node, value in enumerate(moved, start=1)}
        own.append(mode_55(number, complex(root), points))
    save(folder / f"test_complex_shapes{name}.unv", *own)
    ends = ["ground", *(f"m{n}" for n in range(1, 7))]
    masses = [f"  m{n}: {mass!r}" for n, mass in enumerate(np.diag(m).tolist(), start=1)]
    springs = [
        f"  k{n}: {{between: [{ends[n - 1]}, {ends[n]}], stiffness: {value}}}"
        for n, value in enumerate(SPRINGS, start=1)
    ]
    dampers = [
        f"  c1: {{between: [ground, m1], viscous: {GROUND}}}",
        f"  c2: {{between: [m4, m5], viscous: {BETWEEN}}}",
    ]
    text = ["masses:", *masses, "springs:", *springs, "dampers:", *dampers, ""]
    (folder / f"chain{name}.yaml").write_text("\n".join(text))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("kinds")
    write_case(path)
    write_case(path, "_loaded", PAYLOAD)
    for kind in KINDS:
        (path / f"{kind}.yaml").write_text(campaign(kind))
        (path / f"{kind}_two.yaml").write_text(campaign(kind, two=True))
    return path


def campaign(kind: str, two: bool = False, first: float = 1.0) -> str:
    k, _, _ = truth()
    pulled = np.linalg.solve(k, PULL * np.eye(6)[5])
    readings = ", ".join(f"{n}.x: {pulled[n - 1]:.9g}" for n in (1, 3, 6))
    section = KINDS[kind] % readings if "%s" in KINDS[kind] else KINDS[kind]
    names = ["k2", "k5", *([ALSO[kind]] if kind in ALSO else [])]
    rows = "".join(f"  - {{name: {name}, {PARAMETERS[name]}}}\n" for name in names)
    part = "model: {deck: chain%s.yaml, solver: matrices, units: m-kg-s}"
    file = "test_complex_shapes" if kind == "complex_shapes" else "test"
    test = f"test: {{modes: {file}%s.unv, sensors: {{by: number}}}}"
    head = f"{part % ''}\n{test % ''}\n"
    if two:
        loaded = section.replace("target: 7.5", f"target: {7.5 + PAYLOAD}")
        own = f"\n    residuals: {{frequency_weight: {first}, {loaded}}}"
        each = [
            f"  - name: {name}\n    {part % end}\n    {test % end}{more}\n"
            for name, end, more in (("empty", "", ""), ("loaded", "_loaded", own))
        ]
        head = "configurations:\n" + "".join(each)
    return (
        f"name: {kind.replace('_', '-')}\n{head}parameters:\n{rows}residuals:\n"
        f"  frequency_weight: {first}\n  {section}\nupdate: {{e1: {{frequency: 0.001}}}}\n"
        "report: {page: false}\n"
    )


def told(folder: Path, *command: str, code: int = 0) -> Any:
    ended = run_command(folder, *command, "--json", "--no-prefect")
    assert ended.returncode == code, ended.stderr
    return json.loads(ended.stdout)


def agrees(found: Any, kind: str) -> None:
    assert found["status"] == "converged", found["reason"]
    for item in found["parameters"]:
        # Ratios of dampers, and lines that follow resonances, are known to e1's percent.
        assert item["updated"] == pytest.approx(TRUTH[item["name"]], rel=0.01), kind


@pytest.mark.parametrize("kind", KINDS)
def test_an_update_from_two_starts_finds_what_the_kind_tells(folder: Path, kind: str) -> None:
    found = told(folder, "update", f"{kind}.yaml", "--starts", "2")
    agrees(found, kind)
    # Logarithms of response functions do not tell which resonance they see, from afar.
    assert found["trust"]["starts"]["places"] == 1 or kind == "frf"


@pytest.mark.parametrize(
    ("kind", "method"),
    [*((kind, method) for kind in KINDS for method in ("local", "morris")), ("static", "sobol")],
)
def test_a_screening_counts_the_kind(folder: Path, kind: str, method: str) -> None:
    # Forty points are the least of Sobol's method with three parameters.
    points = {"morris": ["--points", "8"], "sobol": ["--points", "40"]}.get(method, [])
    found = told(folder, "screen", f"{kind}.yaml", "--method", method, *points)
    rows = {item["name"]: item for item in found["parameters"]}
    if kind == "shapes":
        assert all(any(item["mac"]) for item in rows.values())
        return
    assert set(rows["k2"]["others"]) == {kind}
    own = ALSO.get(kind, "k2")
    # Only this kind sees the damper; only by it do mass and stiffness of all differ.
    assert any(rows[own]["others"][kind]) or kind == "static"
    if kind == "damping":
        assert not any(rows["c1"]["frequencies"])
        assert rows["c1"]["importance"] > 1.0
        assert "c1" in found["chosen"]


@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "frf"])  # that takes 10 s
def test_a_posterior_lies_around_the_truth(folder: Path, kind: str) -> None:
    found = told(folder, "sample", f"{kind}.yaml", "--steps", "300")
    for item in found["parameters"]:
        # The test is exact, and the prior's pull is below a deviation.
        assert abs(item["mean"] - TRUTH[item["name"]]) < 2.0 * item["deviation"], item


def test_no_sample_breaks_a_limit(folder: Path) -> None:
    """Samples with a limit are those without it that keep it: both ways to the same mass."""
    masses = []
    for name, limits in (("limited", "[7.55, 9]"), ("free", "[6, 9]")):
        text = campaign("mass_properties").replace("name: mass-properties", f"name: {name}")
        own = f"target: 7.56, deviation: 0.03, limits: {limits}"
        path = folder / f"{name}.yaml"
        path.write_text(text.replace("target: 7.5, deviation: 0.01, limits: [6, 9]", own))
        told(folder, "sample", path.name, "--steps", "300")
        with h5py.File(folder / "runs" / name / "posterior.h5") as file:
            masses.append(7.5 * np.array(file["samples"])[:, 2])  # k2, k5, m
    limited, free = masses
    assert limited.min() >= 7.55
    assert 0.05 < (free < 7.55).mean() < 0.95
    kept = free[free >= 7.55]
    # Some hundred samples that count each: means to a tenth of a deviation, deviations to 10 %.
    assert limited.mean() == pytest.approx(kept.mean(), abs=0.3 * kept.std())
    assert limited.std() == pytest.approx(kept.std(), rel=0.3)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("study", ["check", "pretest", "localise", "validate"])
def test_the_other_studies_end(folder: Path, kind: str, study: str) -> None:
    more = {"validate": ["--leave-one-out"], "pretest": ["--method", "information"]}
    found = told(folder, study, f"{kind}.yaml", *more.get(study, []))
    assert found["status"] in ("done", "good", "sound", "doubtful")


@pytest.mark.parametrize("kind", KINDS)
def test_two_configurations_are_updated_at_once(folder: Path, kind: str) -> None:
    agrees(told(folder, "update", f"{kind}_two.yaml", "--set", "update.starts=1"), kind)


def test_a_limit_of_memory_holds_for_the_factors_of_static_loads(folder: Path) -> None:
    limit = "run.memory_gb=0.001"  # a megabyte, which this process alone exceeds
    ended = run_command(folder, "update", "static.yaml", "--set", limit, "--no-prefect")
    assert ended.returncode > 0
    assert "raise `run.memory_gb`" in ended.stderr


def test_strains_of_a_model_without_places_are_refused_with_a_line(folder: Path) -> None:
    text = campaign("shapes").replace(
        "  shape_weight: 1.0\n", '  modal_strain: {gauges: ["1-2"], modes: {1: [1.0]}}\n'
    )
    (folder / "strains.yaml").write_text(text)
    ended = run_command(folder, "update", "strains.yaml", "--no-prefect")
    assert ended.returncode == 2
    assert "strains.yaml, line 9" in ended.stderr.replace("\n", " "), ended.stderr
