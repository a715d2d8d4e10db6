"""The public door: what `import modetune` gives, run as the README runs it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import sparse

import modetune
from modetune.core.modes import Floats

ROOT = Path(__file__).resolve().parent.parent
SIX_MASS = ROOT / "configs" / "six_mass"


@pytest.fixture(autouse=True)
def _own_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is left beside the repository's campaigns."""
    monkeypatch.setenv("MODETUNE_STORE", str(tmp_path / "store"))


def chain(springs: list[float]) -> tuple[Floats, list[Floats]]:
    """K of masses in a row, the first spring to the ground, and each spring's own part."""
    n = len(springs)
    parts = []
    for place, value in enumerate(springs):
        ends = np.zeros(n)
        ends[place] = 1.0
        if place:
            ends[place - 1] = -1.0
        parts.append(value * np.outer(ends, ends))
    return np.sum(parts, axis=0), parts


def arrays() -> dict[str, object]:
    """Three equal masses in a row; the test is of springs that are 20 % stiffer and 15 % softer."""
    stiffness, parts = chain([1000.0, 1000.0, 1000.0])
    truth, _ = chain([1200.0, 850.0, 1000.0])
    eigenvalues, shapes = np.linalg.eigh(truth)  # unit masses
    return {
        "name": "chain",
        "model": {
            "stiffness": sparse.csr_array(stiffness),
            "mass": np.eye(3),
            "parts": {"k1": {"stiffness": parts[0]}, "k2": {"stiffness": parts[1]}},
        },
        "test": {
            "frequencies_hz": np.sqrt(eigenvalues) / (2.0 * np.pi),
            "mode_shapes": shapes,
            "dofs": ["1.x", (2, "x"), (3, 1)],
        },
        "parameters": [
            {"name": name, "quantity": "matrix_factor", "part": name} for name in ("k1", "k2")
        ],
        "update": {"e1": {"frequency": 1e-6, "mac": 0.999}},
        "report": {"page": False},
    }


def test_a_campaign_of_arrays_finds_the_truth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    campaign = modetune.load(arrays())
    run = modetune.update(campaign)
    assert run.converged
    # exact twin: e1 of 1e-6 in frequency is 2e-6 in eigenvalues, which move less than the springs
    assert run.parameters["updated"].tolist() == pytest.approx([1.2, 0.85], abs=2e-5)
    assert run.modes["mac_updated"].min() > 0.999
    assert np.diag(run.mac.to_numpy()).min() > 0.999


@pytest.mark.parametrize("method", ["auto", "finite_difference"])
def test_doublets_that_the_test_has_turned_lead_to_the_truth(
    method: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Masses alike in x and y: every mode comes twice, and the test's lie at 25 degrees."""
    monkeypatch.chdir(tmp_path)
    springs = [1000.0, 1100.0, 1200.0, 900.0]
    stiffness, parts = chain(springs)
    truth, _ = chain([1.2 * springs[0], 1.2 * springs[1], 0.85 * springs[2], 0.85 * springs[3]])
    eigenvalues, shapes = np.linalg.eigh(truth)
    angle = np.radians(25.0)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    both = np.eye(2)
    run = modetune.update(
        {
            "name": "doublets",
            "model": {
                "stiffness": np.kron(stiffness, both),
                "mass": np.eye(8),
                "parts": {
                    "low": {"stiffness": np.kron(parts[0] + parts[1], both)},
                    "high": {"stiffness": np.kron(parts[2] + parts[3], both)},
                },
                "dofs": [f"{node}.{axis}" for node in range(1, 5) for axis in "xy"],
            },
            "test": {
                "frequencies_hz": np.repeat(np.sqrt(eigenvalues[:3]) / (2.0 * np.pi), 2),
                "mode_shapes": np.kron(shapes[:, :3], turn),
                "dofs": [f"{node}.{axis}" for node in range(1, 5) for axis in "xy"],
            },
            "parameters": [
                {"name": name, "quantity": "matrix_factor", "part": name}
                for name in ("low", "high")
            ],
            "residuals": {"shape_weight": 1.0},
            "sensitivity": {"method": method},
            "update": {"e1": {"frequency": 1e-8, "mac": 0.999}},
            "report": {"page": False},
        }
    )
    assert run.parameters["updated"].tolist() == pytest.approx([1.2, 0.85], rel=1e-4)
    assert run.summary["trust"]["verdict"] == "trusted"
    assert not run.summary["model_form"]["suspected"]


def test_a_campaign_of_arrays_is_one_for_the_command_line_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    campaign = modetune.load(arrays(), folder="made")
    again = modetune.load("made/campaign.yaml")
    assert again.file.samefile(campaign.file)
    assert np.array_equal(again.test.modes.mode_shapes, campaign.test.modes.mode_shapes)
    run = modetune.update(campaign)
    assert modetune.update(again).record.runs.modal == 0
    read = modetune.read_record(str(run.folder))
    assert read.modes.equals(run.modes)
    assert read.updated_deck == run.updated_deck


def test_what_does_not_fit_in_arrays_is_told_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    given = arrays()
    assert isinstance(given["model"], dict)
    assert isinstance(given["test"], dict)
    given["model"]["stiffness"] = np.array([[1.0, 2.0], [0.0, 1.0]])
    given["test"]["dofs"] = ["1.x", "2.x"]
    with pytest.raises(modetune.ModetuneError) as told:
        modetune.load(given)
    assert "model: the stiffness is not symmetric" in str(told.value)
    assert "mode_shapes has 3 rows but dofs has 2 entries" in str(told.value)


def test_reprs_are_a_few_lines() -> None:
    campaign = modetune.load(str(SIX_MASS / "campaign.yaml"))
    assert len(repr(campaign)) < 400
    assert "six-mass" in repr(campaign)


def test_results_of_studies_are_shown_in_a_few_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = modetune.screen(SIX_MASS / "campaign.yaml")
    assert repr(found).startswith("Screening(name='six-mass', seed=1, ")
    assert "names=('k1', 'k2', 'k3', 'k4')" in repr(found)
    assert len(repr(found)) < 1200
    test = modetune.read_test(SIX_MASS / "measured.csv")
    assert "modes=<MeasuredModes>" in repr(test)
    assert test.modes is not None
    assert "mode_shapes=<3 x 3>" in repr(test.modes.modes)


def test_results_have_frames_figures_and_short_reprs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run = modetune.update(SIX_MASS / "campaign.yaml", settings={"report.page": False})
    assert len(repr(run)) < 600
    assert "<table" in run._repr_html_()
    assert list(run.parameters.index) == ["k1", "k2", "k3", "k4"]
    for plot in (
        run.plot_modes,
        run.plot_mac,
        run.plot_parameters,
        run.plot_sensitivities,
        run.plot_convergence,
        run.plot_comac,
    ):
        assert plot().axes


def test_shapes_and_sensitivities_are_objects(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Frequencies are homogeneous in the springs, of degree one half: each row sums to that."""
    monkeypatch.chdir(tmp_path)
    given = arrays()
    assert isinstance(given["model"], dict)
    assert isinstance(given["parameters"], list)
    third = chain([0.0, 0.0, 1000.0])[1][2]
    given["model"]["parts"]["k3"] = {"stiffness": third}
    given["parameters"].append({"name": "k3", "quantity": "matrix_factor", "part": "k3"})
    run = modetune.update(given)
    shapes = run.shapes
    assert repr(shapes).startswith("ModeShapes(chain: 3 modes at 3 degrees of freedom, MAC at ")
    assert np.linalg.norm(shapes.test, axis=0) == pytest.approx(np.ones(3), rel=1e-12)
    assert shapes.updated == pytest.approx(shapes.test, abs=1e-3)  # of e1, 1e-6 in frequency
    assert len(shapes.plot().axes) == 3
    assert [axes.get_title() for axes in shapes.plot(2, "1").axes] == ["mode 2", "mode 1"]
    with pytest.raises(modetune.ModetuneError, match=r"no paired mode 4 .*there are: 1, 2, 3"):
        shapes.plot(4)
    assert shapes.frame[("2", "test")].tolist() == shapes.test[:, 1].tolist()
    table = run.sensitivities
    assert list(table.columns) == ["k1", "k2", "k3"]
    # by stored matrices, exact at the point where they were computed
    assert table.sum(axis=1).tolist() == pytest.approx([0.5] * 3, rel=1e-6)


def test_a_run_is_an_xarray_dataset(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("xarray", reason="the extra `arrays` is not installed")
    monkeypatch.chdir(tmp_path)
    run = modetune.update(arrays())
    found = run.to_xarray()
    assert dict(found.sizes) == {"mode": 3, "model": 3, "dof": 3, "parameter": 2}
    assert found["shape"].sel(model="test", mode="2").values.tolist() == (
        run.shapes.test[:, 1].tolist()
    )
    at = found["sensitivity"].sel(mode="1", parameter="k2")
    assert float(at) == run.sensitivities.loc["1", "k2"]
    hz = found["frequency_hz"].sel(model="updated")
    assert hz.values.tolist() == run.modes["updated_hz"].tolist()


def test_xarray_that_is_missing_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    run = modetune.update(arrays())
    monkeypatch.setitem(sys.modules, "xarray", None)
    with pytest.raises(modetune.ModetuneError, match=r"pip install 'modetune\[arrays\]'"):
        run.to_xarray()


def test_starts_of_the_campaign_are_honoured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    given = {**arrays(), "update": {"starts": 3}}
    run = modetune.update(given)
    assert run.record.trust is not None
    assert run.record.trust.spread is not None
    assert len(run.record.trust.spread.starts) == 3


def test_the_studies_take_a_path_and_give_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    campaign = modetune.load(SIX_MASS / "campaign.yaml")
    assert modetune.check(campaign, run=False).level == "good"
    assert modetune.screen(campaign).names == ("k1", "k2", "k3", "k4")
    assert modetune.localise(campaign).singles
    assert modetune.correlate(SIX_MASS / "campaign.yaml").pairs
    assert modetune.read_test(SIX_MASS / "measured.csv").modes is not None


def test_everything_promised_is_there_and_nothing_heavy_is_imported_for_it() -> None:
    assert dir(modetune) == sorted([*modetune.__all__, "__version__"])
    assert all(getattr(modetune, name) is not None for name in modetune.__all__)
    said = subprocess.run(
        [sys.executable, "-c", "import modetune, sys; print('numpy' in sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert said.strip() == "False"


def test_the_lines_of_the_readme_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = re.search(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert text is not None
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    monkeypatch.chdir(tmp_path)
    exec(compile(text.group(1), "README.md", "exec"), {})
