"""Tests that arrive in the lab's folder are tracked, judged and updated with, each once."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

import modetune
from modetune.adapters.test_files.measurements import write_test
from modetune.core.measurement.measurement import MeasuredFrfs, Measurement
from modetune.core.modes import Floats
from modetune.core.monitoring.past_runs import read_history, utc
from tests.flows.studies.test_history import FREQUENCY, SHAPE, SIX, Structure, six_masses

#: Seconds since 1970 at which the first of the nights was measured.
FIRST, DAY = 1.79e9, 86_400.0


class Lab:
    """A folder in which tests of the six masses arrive."""

    def __init__(self, structure: Structure) -> None:
        self.structure = structure
        self.folder = structure.folder / "lab"
        self.folder.mkdir()

    def add(
        self,
        night: int,
        order: Sequence[int] = (0, 1, 2, 3, 4, 5),
        scale: float = 1.0,
        signs: Sequence[float] = (1.0,) * 6,
        **factors: float,
    ) -> Path:
        """Add the test of a night, whose modes are numbered from 1 in this order."""
        rng = np.random.default_rng(night)
        hz, shapes = SIX.modes(factors)
        hz = scale * hz * (1.0 + FREQUENCY * rng.standard_normal(hz.size))
        rms = np.sqrt(np.mean(shapes**2, axis=0))
        shapes = shapes + SHAPE * rms * rng.standard_normal(shapes.shape)
        shapes = np.array(signs)[:, None] * shapes
        picked = list(order)
        rows: list[list[Any]] = [["mode", *range(1, len(picked) + 1)]]
        rows.append(["frequency_hz", *hz[picked].tolist()])
        rows += [[f"{k}.x", *row] for k, row in enumerate(shapes[:, picked].tolist(), start=1)]
        rows.append(["environment temperature_C", 15.0 + night])
        text = "\n".join(",".join(map(str, row)) for row in rows)
        return self.put(f"night_{night:02}.csv", text, night)

    def put(self, name: str, text: str, night: int) -> Path:
        file = self.folder / name
        file.write_text(f"{text}\n")
        os.utime(file, (FIRST + DAY * night, FIRST + DAY * night))
        return file

    def receive(self, *options: str) -> CompletedProcess[str]:
        return self.structure.run("receive", "campaign.yaml", "lab", *options)

    def received(self, *options: str) -> tuple[int, dict[str, Any]]:
        ended = self.receive("--json", *options)
        found: dict[str, Any] = json.loads(ended.stdout)
        assert found["exit_code"] == ended.returncode
        return ended.returncode, found


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    structure = six_masses(tmp_path / "six")
    structure.test(0)
    return Lab(structure)


def test_modes_in_any_order_get_the_campaigns_numbers(lab: Lab) -> None:
    lab.add(1, order=(5, 3, 0, 1, 4))
    lab.add(2)
    code, found = lab.received()
    assert (code, found["sentence"]) == (0, "six: 2 new tests; 2 received in all")
    first, second = found["tests"]
    assert (first["modes"], first["missing"]) == ([1, 2, 4, 5, 6], [3])
    assert second["modes"] == [1, 2, 3, 4, 5, 6]
    runs = read_history(lab.structure.runs).runs
    assert [run.modes for run in runs] == [
        ("1", "2", "4", "5", "6"),
        ("1", "2", "3", "4", "5", "6"),
    ]
    hz = SIX.modes({})[0]
    np.testing.assert_allclose(runs[0].test_hz, hz[[0, 1, 3, 4, 5]], rtol=5 * FREQUENCY)
    assert [run.environment["temperature_C"] for run in runs] == [16.0, 17.0]


def test_what_the_campaign_says_of_its_test_holds_for_all(lab: Lab) -> None:
    """The lab mounts sensor 3 upside down, and one of the wanted modes is missing one night."""
    file = lab.structure.folder / "campaign.yaml"
    keys = "{modes: measured.csv, use: [1, 2, 3], hold_out: [5], pairs: {2: 2, 3: 3}, "
    keys += "sensors: {reverse: [3.x]}}"
    file.write_text(file.read_text().replace("{modes: measured.csv}", keys))
    signs = (1.0, 1.0, -1.0, 1.0, 1.0, 1.0)
    lab.add(0, signs=signs).replace(lab.structure.folder / "measured.csv")
    lab.add(1, signs=signs)
    lab.add(2, order=(0, 1, 3, 4), signs=signs)
    code, found = lab.received()
    assert code == 0, found
    assert [item["decision"] for item in found["tests"]] == ["accepted"] * 2
    assert [item["missing"] for item in found["tests"]] == [[], [3, 6]]
    runs = read_history(lab.structure.runs).runs
    assert [run.modes for run in runs] == [("1", "2", "3"), ("1", "2")]


def test_a_test_that_comes_late_takes_its_place_in_time(lab: Lab) -> None:
    lab.add(3, k1=0.85)
    lab.received()
    late = lab.add(1)
    late.write_text(late.read_text() + "measured_at,2026-09-21T05:00:00+02:00\n")
    os.utime(late, (FIRST, FIRST))
    lab.received()
    told = json.loads(lab.structure.run("history", "campaign.yaml", "--json").stdout)["runs"]
    assert [(run["number"], run["at"]) for run in told] == [
        (2, "2026-09-21T03:00:00Z"),
        (1, "2026-09-24T14:13:20Z"),
    ]
    k1 = [run["parameters"][0]["relative"] for run in told]
    assert k1[1] / k1[0] == pytest.approx(0.85, abs=0.02)


def test_each_test_counts_once_and_a_change_ends_with_7(lab: Lab) -> None:
    for night in (1, 2, 3):
        lab.add(night)
    assert lab.received("--fail-on", "change")[0] == 0
    lab.add(4, k1=0.85)
    code, found = lab.received("--fail-on", "change")
    assert (code, len(found["tests"])) == (7, 1)
    assert "Changed: k1 -1" in found["tests"][0]["sentence"]
    code, found = lab.received("--fail-on", "change")
    assert (code, found["tests"]) == (0, [])
    assert len(read_history(lab.structure.runs).runs) == 4


def test_doubtful_files_are_set_aside_with_the_reason(lab: Lab) -> None:
    lab.add(1, signs=(1.0, 1.0, -1.0, 1.0, 1.0, 1.0))
    lab.add(2, scale=2.0)
    lab.add(3, order=(0, 5))
    lab.put("night_04.csv", "mode,1,2\nfrequency_hz,3.0", 4)
    lab.put("night_05.csv", "mode,1,2,3,4,5,6\nfrequency_hz,3,4,5,6,7,8", 5)
    lab.put("notes.txt", "rain, sensor 3 remounted", 5)
    (lab.folder / "dead.csv").write_text(_without_motion(lab.add(6).read_text(), "4.x"))
    os.utime(lab.folder / "dead.csv", (FIRST + 7 * DAY, FIRST + 7 * DAY))
    code, found = lab.received()
    reasons = {Path(item["file"]).stem: "; ".join(item["reasons"]) for item in found["tests"]}
    assert list(reasons) == [f"night_{night:02}" for night in range(1, 7)] + ["dead"]
    assert reasons["night_01"].startswith("sensor 3.x seems reversed (mean MAC ")
    assert "all frequencies are 2 times" in reasons["night_02"]
    assert reasons["night_03"] == "only 2 of 6 modes were found again (not 2, 3, 4, 5)"
    assert "line 2" in reasons["night_04"]
    assert "frequencies only" in reasons["night_05"]
    assert reasons["night_06"] == ""
    assert "sensor 4.x measured nothing" in reasons["dead"]
    assert code == 2
    assert len(read_history(lab.structure.runs).runs) == 1
    assert lab.received()[0] == 0  # they are said once
    assert len(lab.received("--again")[1]["tests"]) == 6


def _without_motion(text: str, sensor: str) -> str:
    rows = (line.split(",") for line in text.splitlines())
    still = ([row[0], *["0.0"] * (len(row) - 1)] if row[0] == sensor else row for row in rows)
    return "\n".join(",".join(row) for row in still)


def test_a_file_that_still_grows_waits(lab: Lab) -> None:
    file = lab.add(1)
    os.utime(file)
    code, found = lab.received()
    assert (code, found["tests"], found["arriving"]) == (0, [], ["lab/night_01.csv"])
    code, found = lab.received("--settle", "0")
    assert (code, len(found["tests"])) == (0, 1)


def test_a_file_from_a_clock_ahead_does_not_wait_for_ever(lab: Lab) -> None:
    file = lab.add(1)
    os.utime(file, (FIRST + 1e9, FIRST + 1e9))
    assert lab.received()[1]["arriving"] == ["lab/night_01.csv"]  # it came just now
    code, found = lab.received("--settle", "0")
    assert (code, len(found["tests"])) == (0, 1)
    assert found["tests"][0]["at"] <= utc(time.time())


def test_an_update_that_was_killed_is_repeated(lab: Lab) -> None:
    lab.add(1)
    lab.received()
    (entry,) = (lab.structure.runs / "tests").glob("*.json")
    entry.write_text(json.dumps({**json.loads(entry.read_text()), "updated": False}))
    code, found = lab.received()
    assert (code, [item["updated"] for item in found["tests"]]) == (0, [True])
    assert len(read_history(lab.structure.runs).runs) == 1  # the same evidence


def test_a_drift_over_months_is_followed(lab: Lab) -> None:
    """Frequencies that fall by a third in steps of 5 % are always those of the same modes."""
    factors = 0.9 ** np.arange(1, 9)
    for night, factor in enumerate(factors.tolist(), start=1):
        lab.add(night, **dict.fromkeys(SIX.springs, factor))
    found = modetune.receive(
        lab.structure.folder / "campaign.yaml",
        lab.folder,
        lab.structure.folder / "runs",
        settings={
            "store": str(lab.structure.folder / "store"),
            "update.max_iterations": 0,
        },
    )
    assert [item.modes for item in found] == [(1, 2, 3, 4, 5, 6)] * 8
    assert not any(item.reasons for item in found)


def test_modes_are_identified_where_response_functions_arrive(lab: Lab) -> None:
    """Accelerances of all masses for a force on the fourth, of 1 % damping, in a universal file."""
    hz, shapes = SIX.modes({})
    write_test(lab.folder / "run.unv", Measurement(frfs=accelerances(hz, shapes, 3)))
    os.utime(lab.folder / "run.unv", (FIRST, FIRST))
    code, found = lab.received()
    (item,) = found["tests"]
    assert (code, item["decision"], item["modes"]) == (0, "accepted", [1, 2, 3, 4, 5, 6])
    (run,) = read_history(lab.structure.runs).runs
    np.testing.assert_allclose(run.test_hz, hz, rtol=1e-3)
    np.testing.assert_allclose(run.damping_ratios, 0.01, rtol=0.05)
    assert np.abs(run.values / run.deck_values - 1.0).max() < 0.02


def accelerances(hz: Floats, shapes: Floats, at: int) -> MeasuredFrfs:
    """Accelerances of all masses for a force on one, by the modes; shapes are of unit mass."""
    lines = np.arange(0.5, 20.0, 0.01)
    omega, poles = 2.0 * np.pi * lines[:, None], 2.0 * np.pi * hz[None, :]
    gains = 1.0 / (poles**2 - omega**2 + 2j * 0.01 * omega * poles)
    values = -(omega**2) * ((gains * shapes[at]) @ shapes.T)
    n = hz.size
    ones, x = np.ones(n), np.ones(n, dtype=np.int64)
    return MeasuredFrfs(
        "accelerance", lines, values, np.arange(1, n + 1), x, ones, (at + 1) * x, x, ones,
        np.zeros((0, 0)),
    )  # fmt: skip


def test_modes_of_a_recording_bring_their_deviations(lab: Lab) -> None:
    """Velocities of all masses under white noise of the ground's wind, 1 % damping, 200 s."""
    pytest.importorskip("pyoma2", reason="pyOMA2 is not installed (modetune[oma])")
    hz, shapes = SIX.modes({})
    step, rng = 0.02, np.random.default_rng(1)
    motion = np.zeros((10_000, hz.size))
    for mode, f in enumerate(hz.tolist()):  # each mode is an oscillator, stepped exactly
        w, zeta = 2.0 * np.pi * f, 0.01
        a = np.array([[0.0, 1.0], [-(w**2), -2.0 * zeta * w]])
        push, state = expm(a * step), np.zeros(2)
        forces = rng.standard_normal(len(motion))
        for place, force in enumerate(forces.tolist()):
            state = push @ state + (0.0, force)
            motion[place, mode] = state[1]
    values = motion @ shapes.T
    head = ["time [s]", *(f"{k}.x [m/s]" for k in range(1, hz.size + 1))]
    rows = [",".join(head)]
    rows += [f"{step * k:.2f},{','.join(f'{v:.6g}' for v in row)}" for k, row in enumerate(values)]
    lab.put("wind.csv", "\n".join(rows), 1)
    code, found = lab.received()
    (item,) = found["tests"]
    assert (code, item["decision"]) == (0, "accepted"), item
    assert len(item["modes"]) >= 5
    (file,) = (lab.structure.runs / "tests").glob("*.h5")
    deviations = modetune.read_test(file).deviations
    assert deviations is not None
    # A tenth of a per cent is what 200 s allow: sqrt(zeta / (2 pi f T)) is 0.07 % at 3 Hz.
    assert (deviations.frequencies[np.isfinite(deviations.frequencies)] < 0.01).all()
    (run,) = read_history(lab.structure.runs).runs
    assert np.abs(run.values / run.deck_values - 1.0).max() < 0.1
