"""Matrices of a model as functions of its parameters, from CalculiX's own, for real."""

from __future__ import annotations

import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.adapters.solver import MatrixAnalysis
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.core.errors import ModelError
from modetune.core.modes import Floats, mode_set
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.jobs.campaign_engine import job_engine
from modetune.flows.updating.evaluation import Point
from modetune.flows.updating.evaluator import evaluator_of
from modetune.flows.updating.matrices import MatrixSource
from modetune.flows.updating.mode_source import by_solver, campaign_analysis, modes_source
from modetune.flows.updating.sensitivities import SemiAnalytic, UnlikeMatrices
from tests.adapters.solved import needs_ccx
from tests.flows.updating.test_stored_matrices import row_of_materials

pytestmark = needs_ccx
CAMPAIGN = """\
name: part
model: {deck: part.inp, solver: calculix, units: mm-t-s}
test: {modes: part.csv}
parameters:
  - {name: nu, quantity: poissons_ratio, material: A1}
  - {name: E_1, quantity: youngs_modulus, material: A1}
  - {name: E_3, quantity: youngs_modulus, material: A3}
residuals: {frequency_weight: 1.0, shape_weight: 0.0}
sensitivity: {method: semi_analytic, difference: central, step: 0.01}
store: store
"""
#: Away from the deck's values.
THETA = np.array([1.05, 0.9, 1.2])
#: Forty arrays of 4 MB, a small one after each, which keeps a heap from shrinking; in another
#: thread, as matrices are read, after one of 30 MB has come and gone. What stays is told.
PROGRAM = """
import os, sys, threading
import numpy as np
from modetune.flows.updating.matrices import return_freed_memory

def held():
    return int(open("/proc/self/statm").read().split()[1]) * os.sysconf("SC_PAGE_SIZE")

def work():
    global kept
    np.ones(30 << 17)
    pairs = [(np.ones(1 << 19), bytearray(5000)) for _ in range(40)]
    kept = [small for _, small in pairs]

if sys.argv[1:]:
    return_freed_memory()
before = held()
thread = threading.Thread(target=work)
thread.start()
thread.join()
print(held() - before)
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine bricks of three materials, the first one's Poisson's ratio among the parameters."""
    folder = tmp_path_factory.mktemp("source")
    (folder / "part.inp").write_text(row_of_materials())
    write_modes_csv(folder / "part.csv", (1, 2, 3), mode_set([900.0, 1100.0, 5000.0]))
    (folder / "part.yaml").write_text(CAMPAIGN)
    return folder / "part.yaml"


def source_of(campaign: Campaign) -> MatrixSource:
    return MatrixSource(job_engine(campaign), campaign.parameters, campaign.sensitivity.step)


def derived(file: Path, method: str, theta: Floats) -> tuple[Floats, int, Point]:
    """Derivatives of three eigenvalues by one method, the matrix or modal jobs it took, and where
    they were taken."""
    campaign = load_campaign(file, [f"sensitivity.method={method}"])
    engine = job_engine(campaign)
    evaluator = evaluator_of(campaign, engine)
    evaluation, _ = evaluator.evaluate(0, theta, None, alone=True)
    (part,) = evaluation.parts
    found = evaluator.derivatives(part.point, evaluator.only.analysis)
    return found.eigenvalues, evaluator.runs.sensitivity, part.point


def test_a_parameter_without_powers_is_derived_by_pairs_around_each_set(file: Path) -> None:
    assert not source_of(load_campaign(file)).everywhere
    exact, jobs, _ = derived(file, "semi_analytic", THETA)
    # The model there, two pairs of Poisson's ratio, and two moduli that share no node.
    assert jobs == 1 + 4 + 1
    again, jobs, _ = derived(file, "semi_analytic", THETA * 1.01)
    assert jobs == 1 + 4 + 1
    assert not np.array_equal(exact, again)
    differences, _, _ = derived(file, "finite_difference", THETA)
    # The stiffness goes with 1 / (1 - 2 nu): a pair is off by s^2 / 2 times a curvature, central
    # differences by s^2 / 6 times the next derivative; moduli are exact but for seven digits.
    apart = np.abs(exact - differences) / np.abs(exact).max(axis=0)
    assert (apart < [3e-3, 1e-3, 1e-3]).all(), apart


def test_pairs_that_do_not_agree_are_refused(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    campaign = load_campaign(file)
    source = source_of(campaign)
    _, _, point = derived(file, "semi_analytic", THETA)
    moved = np.array([1.15, 1.0, 1.0])
    honest = MatrixSource.matrices

    # The wider pair is of another set.
    def wrong(self: MatrixSource, theta: Floats, columns: Any, wide: bool = False) -> Any:
        return honest(self, moved if wide else theta, columns, wide)

    monkeypatch.setattr(MatrixSource, "matrices", wrong)
    method = SemiAnalytic(source, False, campaign_analysis(campaign))
    with pytest.raises(UnlikeMatrices, match=r"with respect to nu from two pairs .* differ by"):
        method._computed(point, [0, 1])


def test_sums_of_powers_are_known_everywhere_from_the_same_jobs(file: Path) -> None:
    campaign = load_campaign(
        file,
        [
            "parameters=[{name: E_1, quantity: youngs_modulus, "
            "material: A1}, {name: E_2, quantity: youngs_modulus, "
            "material: A2}, {name: rho_3, quantity: density, "
            "material: A3}]"
        ],
    )
    source = source_of(campaign)
    assert source.everywhere
    jobs = source.jobs(np.ones(3), [0])
    assert jobs == source.jobs(THETA, [0, 1, 2])
    # The model, the first modulus with the density, and the second modulus beside it.
    assert len(jobs) == 3
    assert all(isinstance(job.analysis, MatrixAnalysis) for job in jobs)
    here = source.matrices(THETA, [0]).at(source.written(THETA))
    own = (
        job_engine(campaign)
        .solve(type(jobs[0])(campaign.parameters.values(THETA), MatrixAnalysis()))
        .result(type(here))
    )
    for one, other in ((here.stiffness, own.stiffness), (here.mass, own.mass)):
        size = np.sqrt(other.diagonal())
        apart = (one - other).toarray()
        assert np.abs(apart).max() <= 1e-12 * size.max() ** 2  # text of 14 digits
    assert source.jobs(THETA, [0]) == ()  # the store has what they gave


@pytest.mark.parametrize("eigensolver", ["pardiso", "auto"])
@pytest.mark.parametrize("place", ["slurm", "dask"])
def test_jobs_on_other_machines_bring_matrices_as_those_here_do(
    file: Path, eigensolver: str, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("modetune.flows.updating.mode_source.RUN_S", 10.0)
    settings = [
        f"model.eigensolver={eigensolver}",
        f"run.engine={place}",
        "parameters=[{name: E_1, quantity: youngs_modulus, material: A1}]",
    ]
    engine = job_engine(load_campaign(file))
    assert (
        modes_source(
            load_campaign(file, settings), by_solver(load_campaign(file, settings), engine)
        )
        is not None
    )


def test_matrices_that_do_not_fit_are_refused_with_what_needs_none(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = source_of(load_campaign(file))

    def unlike(*arguments: Any) -> Any:
        raise ModelError("the stored matrices have other equations")

    monkeypatch.setattr("modetune.flows.updating.matrices.differences", unlike)
    remedy = r"`sensitivity.method: finite_difference` with `model.eigensolver: solver`"
    engine = job_engine(load_campaign(file))
    for job in source.jobs(THETA, [1]):
        engine.solve(job)
    with pytest.raises(ModelError, match=rf"other equations; {remedy} needs no matrices"):
        source.matrices(THETA, [1])
    # The advice is one that the campaign can follow.
    settings = ["sensitivity.method=finite_difference", "model.eigensolver=solver"]
    assert (
        modes_source(
            load_campaign(file, settings), by_solver(load_campaign(file, settings), engine)
        )
        is None
    )


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is another one")
def test_arrays_that_were_freed_are_not_held() -> None:
    assert what_stays("returned") < 10e6
    # Some settings of glibc make it give all back by itself, and now and then a thread's heap does.
    if (held := max(what_stays() for _ in range(3))) < 100e6:
        pytest.skip(f"this C library held {held / 1e6:.0f} MB of 168 by itself")


def what_stays(*given: str) -> int:
    return int(subprocess.check_output([sys.executable, "-c", PROGRAM, *given]))
