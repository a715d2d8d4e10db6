"""Posteriors by a surrogate against sums over a grid, and against the reduced model itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modetune.core.modes import Floats
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.studies.sample import posterior, refinement
from modetune.flows.studies.sample.posterior import sample_campaign
from modetune.flows.studies.sample.record import PosteriorRecord
from modetune.flows.studies.sample.request import SamplingRequest
from modetune.flows.studies.sample.summary import ITSELF, findings
from modetune.flows.updating.forecast import Unwatched
from tests.adapters.solved import needs_ccx
from tests.flows.updating.test_reduced_model import on_springs
from tests.flows.updating.test_stored_matrices import BAR, JOINT, Case, written

#: Five masses in a row between two walls, alike from both ends; kg, N/m.
MASSES, SPRINGS = (1.0, 1.5, 2.0, 1.5, 1.0), (900.0, 2000.0, 3000.0, 3000.0, 2000.0, 900.0)
NAMES = ("ground", "m1", "m2", "m3", "m4", "m5", "ground")
TRUTH, DEVIATION = (1.5, 0.7), 0.01
LOWER, UPPER, PRIOR = 0.4, 2.4, 1.0


def frequencies(ends: Floats) -> Floats:
    """Of the row with the springs at both ends scaled by (n, 2), (n, 5)."""
    inner = np.array(SPRINGS)[1:-1]
    stiffness = np.diag(np.append(inner, 0.0) + np.append(0.0, inner))
    stiffness = np.tile(stiffness - np.diag(inner, 1) - np.diag(inner, -1), (len(ends), 1, 1))
    stiffness[:, [0, -1], [0, -1]] += ends * [SPRINGS[0], SPRINGS[-1]]
    roots = np.sqrt(MASSES)
    return np.sqrt(np.linalg.eigvalsh(stiffness / roots / roots[:, None])) / (2 * np.pi)


def row_of_masses(folder: Path, n_modes: int) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    masses = "".join(f"  m{n}: {mass}\n" for n, mass in enumerate(MASSES, 1))
    springs = "".join(
        f"  k{n}: {{between: [{NAMES[n - 1]}, {NAMES[n]}], stiffness: {spring}}}\n"
        for n, spring in enumerate(SPRINGS, 1)
    )
    (folder / "row.yaml").write_text(f"masses:\n{masses}springs:\n{springs}")
    hz = ",".join(f"{value:.12g}" for value in frequencies(np.array([TRUTH]))[0, :n_modes])
    numbers = ",".join(str(n) for n in range(1, n_modes + 1))
    (folder / "test.csv").write_text(f"mode,{numbers}\nfrequency_hz,{hz}\n")
    items = "".join(
        f"  - {{name: {name}, quantity: spring_stiffness, elset: {name}, "
        f"bounds: [{LOWER}, {UPPER}], deviation: {PRIOR}}}\n"
        for name in ("k1", "k6")
    )
    (folder / "campaign.yaml").write_text(
        "name: row\nmodel: {deck: row.yaml, solver: matrices, units: m-kg-s}\n"
        f"test: {{modes: test.csv}}\nparameters:\n{items}"
        f"residuals: {{frequency_deviation: {DEVIATION}}}\nstore: store\n"
    )
    return folder / "campaign.yaml"


def on_grid(n_modes: int) -> tuple[Floats, Floats]:
    """Points (n, 2) between the bounds, and the exact posterior's share at each, (n,)."""
    axis = np.linspace(LOWER, UPPER, 201)
    points = np.stack([one.ravel() for one in np.meshgrid(axis, axis)], axis=1)
    measured = frequencies(np.array([TRUTH]))[0, :n_modes] ** 2
    computed = frequencies(points)[:, :n_modes] ** 2
    misfit = (((measured - computed) / measured / (2.0 * DEVIATION)) ** 2).sum(axis=1)
    share = np.exp(-0.5 * (misfit + (((points - 1.0) / PRIOR) ** 2).sum(axis=1)))
    return points, share / share.sum()


@pytest.mark.parametrize("n_modes", [1, 2, 3], ids=["a curve", "two bent hills", "two hills"])
def test_all_hills_are_those_of_a_grid(n_modes: int, tmp_path: Path) -> None:
    campaign = load_campaign(row_of_masses(tmp_path, n_modes), [])
    record = sample_campaign(campaign, SamplingRequest(), Unwatched().working)
    assert record.density_error <= refinement.GOOD
    points, share = on_grid(n_modes)
    samples, size = record.samples, float(record.effective_sizes.min())
    # The row is the same from both ends, and so are the hills.
    first = float((samples[:, 0] > samples[:, 1]).mean())
    assert first == pytest.approx(0.5, abs=4.0 * 0.5 / np.sqrt(size))
    # The softer end and the stiffer one, whichever they are, have one hill.
    for side in (np.min, np.max):
        found, there = side(samples, axis=1), side(points, axis=1)
        mean = float(share @ there)
        deviation = float(np.sqrt(share @ (there - mean) ** 2))
        # Four Monte Carlo errors; what a log density is off by moves moments as much at most.
        least = 4.0 / np.sqrt(size) + record.density_error
        assert found.mean() == pytest.approx(mean, abs=least * deviation)
        assert found.std() == pytest.approx(deviation, rel=least)


#: Two halves, of which the test cannot say which is the stiffer one.
HALVES = Case(
    on_springs(),
    (("E_A", "youngs_modulus", "material: A"), ("E_B", "youngs_modulus", "material: B")),
    (1.4, 0.7),
    tuple(range(1, 37)),
    n_modes=10,
)
#: ... bricks of three materials in a row; bricks and shells with shapes that take part.
STRUCTURES = {"halves": HALVES, "bar": BAR, "joint": JOINT}


def sampled(file: Path, deviation: float = 0.02, **asked: int) -> PosteriorRecord:
    settings = ["model.eigensolver=pardiso", f"residuals.frequency_deviation={deviation}"]
    request = SamplingRequest(**{"walkers": 16, "steps": 400, "checks": 2, **asked})
    return sample_campaign(load_campaign(file, settings), request, Unwatched().working)


@needs_ccx
@pytest.mark.parametrize("name", STRUCTURES)
def test_samples_of_a_surrogate_are_as_likely_by_the_reduced_model(
    name: str, tmp_path: Path
) -> None:
    record = sampled(written(STRUCTURES[name], tmp_path / "part"), checks=100)
    assert not record.by_reduced_model
    assert record.runs.modal == 1  # it confirms the reduced model
    # So many checks are sets of the reduced model: none of them was learned from.
    assert len(record.check_keys) == 100
    assert record.check_errors.max() < 0.1
    assert record.density_error <= refinement.EXACT


@needs_ccx
def test_halves_that_may_be_exchanged_have_as_many_samples_either_way(tmp_path: Path) -> None:
    record = sampled(written(HALVES, tmp_path / "part"), 0.007)
    assert record.reduced_model is not None
    assert record.peaks.shape[0] == 2
    first = float((record.samples[:, 0] > record.samples[:, 1]).mean())
    size = float(record.effective_sizes.min())
    assert first == pytest.approx(0.5, abs=4.0 * 0.5 / np.sqrt(size))


@needs_ccx
def test_where_no_surrogate_is_good_enough_the_reduced_model_itself_gives_the_samples(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(refinement, "MOST_SETS", 0)  # none to learn from
    monkeypatch.setattr(posterior, "LONGEST", 1)
    record = sampled(written(JOINT, tmp_path / "part"), walkers=8, steps=100)
    assert record.by_reduced_model
    assert record.check_errors.max() < 0.1
    assert ITSELF in [finding.text for finding in findings(record)]
