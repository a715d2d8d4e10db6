"""Campaigns in which a dimension scales parts of a model of matrices by expressions."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from modetune.adapters.matrices.deck import read_deck
from modetune.core.errors import CampaignError
from modetune.core.modes import Floats
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.report.parameter_tables import parameter_rows
from modetune.flows.updating.update import update_campaign
from tests.section_frames import Frame, arch, grid, portal

TUBE = """\
  - {name: r, quantity: variable, values: absolute, initial: 0.02, bounds: [0.016, 0.03], deviation: 0.004}
  - {name: A, quantity: matrix_factor, part: [axial, section], expression: (r**2 - 0.015**2) / 1.75e-4}
  - {name: I, quantity: matrix_factor, part: bending, expression: (r**4 - 0.015**4) / 1.09375e-7}
"""  # noqa: E501  # a line a parameter, as people write them
STRIPS = """\
  - {name: t, quantity: variable, bounds: [0.5, 2]}
  - {name: A, quantity: matrix_factor, part: [axial, section], expression: t}
  - {name: I, quantity: matrix_factor, part: bending, expression: t**3}
"""
RECTANGLE = """\
  - {name: b, quantity: variable, values: absolute, initial: 0.03, bounds: [0.01, 0.06], deviation: 0.01}
  - {name: h, quantity: variable, values: absolute, initial: 0.05, bounds: [0.02, 0.09], deviation: 0.01}
  - {name: A, quantity: matrix_factor, part: [axial, section], expression: b * h / (0.03 * 0.05)}
  - {name: I, quantity: matrix_factor, part: bending, expression: b * h**3 / (0.03 * 0.05**3)}
"""  # noqa: E501
Section = Callable[[Floats], tuple[float, float]]


def tube(at: Floats) -> tuple[float, float]:
    return np.pi * (at[0] ** 2 - 0.015**2), np.pi / 4 * (at[0] ** 4 - 0.015**4)


def strip(at: Floats) -> tuple[float, float]:
    return 0.04 * 0.006 * at[0], 0.04 * (0.006 * at[0]) ** 3 / 12


def rectangle(at: Floats) -> tuple[float, float]:
    return at[0] * at[1], at[0] * at[1] ** 3 / 12


CASES: list[Any] = [
    pytest.param(portal(), tube, [0.02], [0.0235], TUBE, id="portal of a tube"),
    pytest.param(grid(), strip, [1.0], [1.3], STRIPS, id="grid of strips"),
    pytest.param(arch(), rectangle, [0.03, 0.05], [0.037, 0.043], RECTANGLE, id="arch"),
]


def campaign(folder: Path, hz: Floats, parameters: str) -> Path:
    numbers = ", ".join(str(n) for n in range(1, hz.size + 1))
    values = ", ".join(f"{value:.12g}" for value in hz)
    (folder / "test.csv").write_text(f"mode, {numbers}\nfrequency_hz, {values}\n")
    path = folder / "campaign.yaml"
    path.write_text(
        "name: section\nmodel: {deck: frame.yaml, solver: matrices, units: m-kg-s}\n"
        f"test: {{modes: test.csv}}\nparameters:\n{parameters}"
        "update: {e1: {frequency: 1.0e-7}}\n"
    )
    return path


def updated(path: Path) -> CampaignRecord:
    silent: Any = SimpleNamespace(working=lambda text: None, iteration=lambda record: None)
    return update_campaign(load_campaign(path), path.parent / "run", silent).record


@pytest.mark.parametrize(("frame", "section", "start", "truth", "parameters"), CASES)
def test_a_dimension_is_found_from_frequencies(
    tmp_path: Path, frame: Frame, section: Section, start: list[float], truth: list[float],
    parameters: str,
) -> None:  # fmt: skip
    first, true = np.array(start), np.array(truth)
    frame.write(tmp_path, *section(first))
    hz = frame.hz(*section(true), 5)
    record = updated(campaign(tmp_path, hz, parameters))
    rows = parameter_rows(record)
    found = np.array([row.updated for row in rows[: true.size]])
    np.testing.assert_allclose(found, true, rtol=1e-6)
    area, inertia = section(true)
    factors = [area / section(first)[0], inertia / section(first)[1]]
    assert [row.updated for row in rows[-2:]] == pytest.approx(factors, rel=1e-5)
    step = record.iterations[1]
    assert set(step.sensitivity_methods) == {"semi_analytic"}
    # The residual is (test - model) / test of eigenvalues.
    for column, item in enumerate(record.parameters.parameters):
        move = 1e-5 * np.eye(true.size)[column]
        high, low = (frame.hz(*section(first * (1 + sign * move)), 5) ** 2 for sign in (1, -1))
        slope = (high - low) / (2e-5 * first[column]) / hz**2 * item.scale
        np.testing.assert_allclose(step.sensitivity[:, column], slope, rtol=1e-5, atol=1e-7)
    model = read_deck(tmp_path / "run" / "updated" / "frame.yaml").model
    stiffness, mass = frame.at(*section(found))
    for matrix, expected in ((model.stiffness, stiffness), (model.mass, mass)):
        np.testing.assert_allclose(matrix.toarray(), expected, atol=1e-10 * np.abs(expected).max())


def test_another_expression_does_not_reuse_stored_derivatives(tmp_path: Path) -> None:
    """At the start all expressions are 1, so the modes there are the same."""
    frame, start = grid(), np.array([1.0])
    frame.write(tmp_path, *strip(start))
    hz = frame.hz(*strip(np.array([1.1])), 5)
    cubic = updated(campaign(tmp_path, hz, STRIPS)).iterations[1].sensitivity
    text = STRIPS.replace("t**3", "t**2")
    square = updated(campaign(tmp_path, hz, text)).iterations[1].sensitivity
    assert np.abs(square / cubic - 1.0).max() > 0.1


@pytest.mark.parametrize(
    ("old", "new", "line", "said"),
    [
        ("expression: t**3", "expression: h**3", 7, "names h; it may name the free parameters"),
        ("part: bending", "part: bendng", 7, "has no part bendng; did you mean bending?"),
        ("expression: t**3", "expression: t***3", 7, "is not arithmetic"),
        ("expression: t**3", "expression: sqrt(t - 1)", 7, "has no finite value"),
    ],
)
def test_wrong_relations_are_refused_with_their_line(
    tmp_path: Path, old: str, new: str, line: int, said: str
) -> None:
    frame = grid()
    frame.write(tmp_path, *strip(np.array([1.0])))
    assert old in STRIPS
    path = campaign(tmp_path, np.array([10.0]), STRIPS.replace(old, new))
    with pytest.raises(CampaignError) as caught:
        load_campaign(path)
    assert said in str(caught.value)
    assert f"campaign.yaml, line {line}" in str(caught.value)
