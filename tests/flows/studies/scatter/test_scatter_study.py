"""`modetune scatter` on twins whose parameters' covariance is known, and as it is typed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import eigh
from typer.testing import CliRunner, Result

from modetune.adapters.calculix.solver import calculix_solver
from modetune.adapters.solver import MatrixAnalysis
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import CampaignError
from modetune.core.modes import Floats
from modetune.core.parameters import Parameter
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.cli.main import app
from modetune.flows.studies.scatter.estimate import scatter_campaign
from modetune.flows.studies.scatter.record import SCATTER, ScatterRecord
from modetune.flows.studies.scatter.request import ScatterRequest
from tests.adapters.solved import needs_ccx
from tests.adapters.test_solver_contract import run
from tests.flows.studies.sample.test_by_reduced import TRUTH, frequencies, row_of_masses
from tests.flows.updating.test_stored_matrices import BAR, written

#: Standard deviations of the parameters from test to test, relative to the deck, and correlation.
SIZES, TIE = (0.04, 0.03), 0.6
NOISE = 2e-4


def table(folder: Path, name: str, hz: Floats, noise: float = NOISE) -> None:
    """Tests (n, n_modes) as a file, each frequency measured with this deviation."""
    random = np.random.default_rng(11)
    hz = hz * (1.0 + noise * random.standard_normal(hz.shape))
    heads = ",".join(f"frequency_{n}_hz" for n in range(1, hz.shape[1] + 1))
    rows = [",".join([str(n), *(f"{v:.9g}" for v in row)]) for n, row in enumerate(hz, 1)]
    (folder / name).write_text("\n".join([f"test,{heads}", *rows]) + "\n")


@pytest.fixture
def row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Five masses on six springs: 500 tests in which both end springs differ."""
    file = row_of_masses(tmp_path, 4)
    covariance = np.outer(SIZES, SIZES) * np.array([[1.0, TIE], [TIE, 1.0]])
    ends = np.random.default_rng(3).multivariate_normal(TRUTH, covariance, 500)
    table(tmp_path, "test.csv", frequencies(ends)[:, :4])
    text = file.read_text().replace("bounds: [0.4, 2.4]", "bounds: [0.5, 2.4]")
    text = text.replace("residuals: {frequency_deviation: 0.01}\n", "")
    file.write_text(text)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    monkeypatch.delenv("MODETUNE_STORE", raising=False)
    return file


def typed(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["scatter", *arguments, "--no-prefect"])


def test_a_row_of_masses_has_two_answers_and_the_covariance_of_one(row: Path) -> None:
    result = typed(str(row), "--json", "--figures", "figures")
    assert result.exit_code == 3, result.output  # the row is the same from both ends
    said = json.loads(result.stdout)
    assert said["status"] == "doubtful"
    assert "2 separate solutions explain the mean of the tests" in said["findings"][0]["text"]
    assert all(Path(path).is_file() for path in said["written"])
    record = SCATTER.read(Path("runs/row/scatter.h5"))
    means = np.array([answer.mean for answer in record.answers])
    place = int(np.argmin(np.abs(means - TRUTH).sum(axis=1)))
    answer = record.answers[place]
    _recovered(record, place, np.array(SIZES))
    tie = answer.covariance[0, 1] / np.sqrt(np.prod(np.diag(answer.covariance)))
    assert tie == pytest.approx(TIE, abs=0.1)
    # The other answer is the same row seen from the other end.
    other = record.answers[1 - place]
    np.testing.assert_allclose(other.mean, answer.mean[::-1], atol=3e-3)
    again = typed(str(row))
    assert again.exit_code == 3
    assert "solver runs: 0, cached" in again.stdout
    assert "estimated from the tests" in again.stdout


def _recovered(record: ScatterRecord, place: int, sizes: Floats) -> None:
    answer = record.answers[place]
    for covariance in (answer.covariance, answer.linear_covariance):
        np.testing.assert_allclose(np.sqrt(np.diag(covariance)), sizes, rtol=0.1)
    low, high = answer.deviation_interval
    # 95 % intervals of a few parameters: the truth may be a little outside of one.
    assert (0.97 * low < sizes).all()
    assert (sizes < 1.03 * high).all()
    assert answer.noise == pytest.approx(NOISE, rel=0.1)
    assert answer.lack > 1e-3
    assert answer.off < 0.2
    np.testing.assert_allclose(
        np.sqrt(np.diag(answer.predicted_covariance)),
        np.sqrt(np.diag(record.covariance)),
        rtol=0.02,
    )


def test_the_campaign_weighs_by_the_whole_covariance(row: Path) -> None:
    weighting = load_campaign(row, []).case.weighting
    covariance = weighting.frequency_covariance
    assert covariance.shape == (4, 4)
    expected = np.cov(np.genfromtxt("test.csv", delimiter=",", skip_header=1)[:, 1:].T)
    hz = load_campaign(row, []).case.test.modes.frequencies_hz
    # The mean of 500; deviations are drawn a little to each other (4 of 503 tests).
    np.testing.assert_allclose(
        covariance, expected / np.outer(hz, hz) / 500, atol=0.02 * covariance.max()
    )
    own = load_campaign(row, ["residuals.frequency_deviation=0.001"]).case.weighting
    assert own.frequency_covariance.tolist() == np.diag([1e-6] * 4).tolist()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--of", "k2"), "--of k2: the campaign has no such parameter"),
        (("--measurement-deviation", "-1"), "--measurement-deviation -1: expected 0 or more"),
        (
            ("--set", "test.use=[1]"),
            "1 measured values cannot determine the scatter of 2 parameters",
        ),
        (("--set", "test.modes=one.csv"), "campaign.yaml: the test was not repeated"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(
    row: Path, arguments: tuple[str, ...], said: str
) -> None:
    (row.parent / "one.csv").write_text("mode,1,2\nfrequency_hz,5,9\n")
    result = typed(str(row), *arguments)
    assert isinstance(result.exception, CampaignError)
    assert said in str(result.exception)


def bars(folder: Path, sets: Floats, n_modes: int) -> Floats:
    """Frequencies (n, n_modes) of the bar by LAPACK, from matrices that CalculiX assembles."""
    parameters = tuple(
        Parameter(name, "youngs_modulus", "material", (target.split(": ")[1],), 0.2, 3.0, 0.2)
        for name, _, target in BAR.parameters
    )
    solver = calculix_solver(folder / "part.inp", parameters)
    found = []
    for place, values in enumerate([np.ones(3), *(np.ones(3) + np.eye(3))]):
        at = folder / f"matrices{place}"
        at.mkdir()
        named = dict(zip((p.name for p in parameters), values.tolist(), strict=True))
        result = run(solver, named, MatrixAnalysis(), at)
        assert isinstance(result, MatrixResult)
        upper = [result.upper_stiffness.toarray(), result.upper_mass.toarray()]
        found.append([item + np.triu(item, 1).T for item in upper])
    (base, mass), *others = found
    hz = []
    for values in sets:
        stiffness = base + sum(
            (value - 1.0) * (one - base) for value, (one, _) in zip(values, others, strict=True)
        )
        ends = [len(mass) - n_modes, len(mass) - 1]  # unknowns inside of bricks have no mass
        inverse = eigh(mass, stiffness, eigvals_only=True, subset_by_index=ends)
        hz.append(1.0 / np.sqrt(inverse[::-1]))
    return np.array(hz) / (2.0 * np.pi)


@needs_ccx
def test_a_bar_of_three_materials_takes_a_handful_of_runs(tmp_path: Path) -> None:
    """500 tests of bricks in CalculiX, whose three moduli differ from test to test."""
    file = written(BAR, tmp_path / "part")
    sizes = np.array([0.03, 0.04, 0.02])
    moduli = np.random.default_rng(5).multivariate_normal(BAR.truth, np.diag(sizes**2), 500)
    table(file.parent, "tests.csv", bars(file.parent, moduli, 6))
    settings = ["model.eigensolver=pardiso", "test.modes=tests.csv", "residuals.shape_weight=0"]
    record = scatter_campaign(load_campaign(file, settings), ScatterRequest(), lambda text: None)
    assert record.runs.modal == 1  # it confirms the reduced model
    assert record.runs.sensitivity <= 4  # matrices of four models
    (answer,) = record.answers
    np.testing.assert_allclose(answer.mean, BAR.truth, rtol=0.01)
    _recovered(record, 0, sizes)


@pytest.mark.parametrize("masses", [False, True], ids=["springs", "springs and weighed masses"])
def test_four_storeys_have_two_answers(
    masses: bool, shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Leibniz University Hannover's 4-DOF benchmark, EURODYN 2026: fifty tests of one frame."""
    monkeypatch.delenv("MODETUNE_STORE", raising=False)
    case = Path(__file__).resolve().parents[4] / "configs" / "four_storey"
    items = [f"k{n}, quantity: spring_stiffness, deviation: 0.7" for n in range(1, 5)]
    if masses:  # weighed to 1 %
        items += [f"m{n}, quantity: mass, deviation: 0.01, bounds: [0.9, 1.1]" for n in range(1, 5)]
    (tmp_path / "tests.yaml").write_text(
        f"name: tests\nmodel: {{deck: {case / 'four_storey.yaml'}, solver: matrices, "
        f"units: m-kg-s}}\ntest: {{modes: {shared_data / 'four_storey' / 'tests_br.csv'}}}\n"
        "parameters:\n" + "".join(f"  - {{name: {item}, elset: {item[:2]}}}\n" for item in items)
    )
    request = ScatterRequest(of=("k1", "k2", "k3", "k4"))
    record = scatter_campaign(load_campaign(tmp_path / "tests.yaml"), request, lambda text: None)
    springs = sorted((answer.mean[:4].tolist() for answer in record.answers), key=lambda k: k[0])
    # By Newton's method on the characteristic polynomial; a per cent of a mass is one of a spring.
    expected = np.array([[0.8682, 1.1192, 1.0128, 1.0322], [1.8519, 0.5819, 1.4323, 0.6581]])
    np.testing.assert_allclose(springs, expected, rtol=0.02 if masses else 0.002)
    for answer in record.answers:
        np.testing.assert_allclose(answer.predicted, 0.0, atol=2e-5)
        sizes = np.sqrt(np.diag(record.covariance))
        np.testing.assert_allclose(
            answer.predicted_covariance / np.outer(sizes, sizes),
            record.covariance / np.outer(sizes, sizes),
            atol=0.02,
        )
        assert answer.off < 0.1
    assert record.worth == pytest.approx(5.0, abs=1.0)
    assert not np.isfinite(record.tests[30, 3])
