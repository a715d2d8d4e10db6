"""Time histories to modes: chains driven by noise, with and without their forces."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyuff
import scipy.io
from scipy import linalg

import modetune
from modetune.adapters.test_files.measurements import read_histories
from modetune.core.correlation.correlation import mac
from modetune.core.errors import CampaignError
from modetune.core.measurement.time_histories import TimeHistories, response_functions
from modetune.core.modes import Floats
from modetune.flows.studies.identify.identification import (
    Identification,
    IdentificationSettings,
)
from modetune.flows.studies.identify.operational_modes import OperationalModes, operational_modes
from tests.command_line import run_command


@dataclass(frozen=True, slots=True)
class Driven:
    """A chain's frequencies, damping ratios and shapes; its velocities and the first force."""

    frequencies_hz: Floats
    damping_ratios: Floats
    shapes: Floats
    velocities: Floats
    force: Floats
    step_s: float


#: Masses in kg, springs in N/m, damping ratios of the modes, step in s: no two of a kind.
CHAINS = {
    "four": ([1, 2.0, 1.5, 1], [900.0, 1200.0, 700.0, 1500.0], [0.01, 0.012, 0.015, 0.02], 0.02),
    "stiff": ([0.02, 0.03, 0.025], [9e4, 6e4, 8e4], [0.02, 0.01, 0.015], 1.0e-4),
    "slow": ([8e3, 5e3], [4e5, 3e5], [0.015, 0.02], 0.04),
}  # fmt: skip


def driven(name: str, n_times: int, everywhere: bool, seed: int = 3) -> Driven:
    """White noise on all masses, or on the first one, held over each step; solved exactly."""
    masses, stiffnesses, zeta, step = CHAINS[name]
    springs = np.array(stiffnesses)
    k = np.diag(springs + np.append(springs[1:], 0.0))
    k += np.diag(-springs[1:], 1) + np.diag(-springs[1:], -1)
    m, n = np.diag(masses), len(masses)
    lam, phi = linalg.eigh(k, m)
    w = np.sqrt(lam)
    c = m @ phi @ np.diag(2.0 * np.array(zeta) * w) @ phi.T @ m
    a = np.block([[np.zeros((n, n)), np.eye(n)], [-linalg.solve(m, k), -linalg.solve(m, c)]])
    b = np.vstack([np.zeros((n, n)), linalg.inv(m)])
    whole = linalg.expm(np.block([[a, b], [np.zeros((n, 3 * n))]]) * step)
    ad, bd = whole[: 2 * n, : 2 * n], whole[: 2 * n, 2 * n :]
    forces = np.random.default_rng(seed).normal(size=(n_times, n))
    if not everywhere:
        forces[:, 1:] = 0.0
    pushed = forces @ bd.T
    states, x = np.empty((n_times, 2 * n)), np.zeros(2 * n)
    for place in range(n_times):
        x = ad @ x + pushed[place]
        states[place] = x
    return Driven(w / (2 * np.pi), np.array(zeta), phi, states[:, n:], forces[:, 0], step)


def write_csv(path: Path, found: Driven, with_force: bool) -> Path:
    n = found.velocities.shape[1]
    head = ["time [s]", *(f"{k + 1}.z [mm/s]" for k in range(n))] + ["1.z [N]"] * with_force
    columns = [np.arange(len(found.force)) * found.step_s, *(1e3 * found.velocities.T)]
    columns += [found.force] * with_force
    lines = [",".join(f"{value:.9g}" for value in row) for row in np.column_stack(columns)]
    path.write_text("\n".join([",".join(head), *lines]) + "\n")
    return path


def uncertainties(found: Driven, n_times: int) -> tuple[Floats, Floats]:
    """Relative standard deviations that no method goes below: frequencies and damping.

    Of long data with all of a resonance in the band: zeta / (2 pi f T) and 1 / (2 pi zeta f T) are
    the squares (Au 2014, uncertainty laws of ambient modal identification).
    """
    periods = found.frequencies_hz * n_times * found.step_s
    zeta = found.damping_ratios
    return np.sqrt(zeta / (2 * np.pi * periods)), 1.0 / np.sqrt(2 * np.pi * zeta * periods)


@pytest.mark.parametrize("name", list(CHAINS))
def test_responses_alone_give_frequencies_and_damping_within_their_bounds(
    tmp_path: Path, name: str
) -> None:
    pytest.importorskip("pyoma2", reason="pyOMA2 is not installed (modetune[oma])")
    n_times = 40_000
    true = driven(name, n_times, everywhere=True)
    found = modetune.identify(write_csv(tmp_path / "noise.csv", true, with_force=False))
    assert isinstance(found, OperationalModes)
    modes = found.modes.modes
    assert modes.n_modes == true.frequencies_hz.size
    of_f, of_zeta = uncertainties(true, n_times)
    # Subspace methods are not the best there is: twice the least deviation, and three of these.
    assert (np.abs(modes.frequencies_hz / true.frequencies_hz - 1.0) < 6.0 * of_f).all()
    assert (np.abs(modes.damping_ratios / true.damping_ratios - 1.0) < 6.0 * of_zeta).all()
    assert (np.diag(mac(modes.mode_shapes, true.shapes)) > 0.98).all()
    assert modes.normalisation == "max"


def test_stated_deviations_are_the_scatter_of_recordings(tmp_path: Path) -> None:
    """The scatter of twelve recordings is known to a fifth; the jackknife errs to the safe side."""
    pytest.importorskip("pyoma2", reason="pyOMA2 is not installed (modetune[oma])")
    hz, stated = [], []
    for seed in range(12):
        true = driven("stiff", 20_000, everywhere=True, seed=seed)
        n = true.velocities.shape[1]
        node, z = np.arange(1, n + 1), np.full(n, 3)
        run = TimeHistories(
            true.step_s, true.velocities, node, z, np.ones(n), np.zeros(n, np.bool_), "mobility", ""
        )
        found = operational_modes(run, IdentificationSettings())
        assert found.deviations is not None
        hz.append(found.modes.modes.frequencies_hz)
        stated.append(found.deviations.frequencies)
    ratio = np.sqrt(np.mean(np.square(stated), axis=0)) * np.mean(hz, axis=0) / np.std(hz, axis=0)
    assert (ratio > 0.7).all(), ratio
    assert (ratio < 3.0).all(), ratio


@pytest.mark.parametrize("name", list(CHAINS))
@pytest.mark.parametrize("estimator", ["h1", "h2"])
def test_a_force_gives_response_functions_and_scaled_modes(
    tmp_path: Path, name: str, estimator: Any
) -> None:
    true = driven(name, 60_000, everywhere=False)
    path = write_csv(tmp_path / "force.csv", true, with_force=True)
    top = 1.2 * float(true.frequencies_hz[-1])
    low = 0.5 * float(true.frequencies_hz[0])
    found = modetune.identify(
        path, (low, top), order=20, estimator=estimator, segment=6000 * true.step_s
    )
    assert isinstance(found, Identification)
    modes = found.modes.modes
    assert modes.n_modes == true.frequencies_hz.size
    # The window's resolution of 1 / segment is spread over a width of 2 zeta f.
    np.testing.assert_allclose(modes.frequencies_hz, true.frequencies_hz, rtol=3e-3)
    np.testing.assert_allclose(modes.damping_ratios, true.damping_ratios, rtol=0.25)
    assert (np.diag(mac(modes.mode_shapes, true.shapes)) > 0.98).all()
    assert modes.normalisation == "mass"  # struck where it was measured
    assert found.frfs.kind == "mobility"
    assert found.frfs.coherences.max() <= 1.0
    assert float(np.median(found.frfs.coherences)) > 0.9


def histories(values: Floats, forces: list[bool], nodes: list[int]) -> TimeHistories:
    ones = np.ones(len(nodes))
    kinds = np.array(forces)
    ids = np.array(nodes, dtype=np.int64)
    return TimeHistories(0.01, values, ids, ones.astype(np.int64), ones, kinds, "accelerance", "x")


def test_h1_and_h2_differ_by_the_coherence_and_noise_goes_where_theory_says() -> None:
    random = np.random.default_rng(5)
    force, noise = random.normal(size=(2, 200_000))
    clean = 3.0 * force
    run = histories(np.column_stack([force, clean + noise]), [True, False], [1, 2])
    h1, h2 = (response_functions([run], way, 1.0) for way in ("h1", "h2"))
    # Gain 3, noise of unit power beside 9: H1 is unbiased, H2 too large by 10 / 9.
    assert np.mean(h1.values.real[5:-5]) == pytest.approx(3.0, abs=0.02)
    assert np.mean(h2.values.real[5:-5]) == pytest.approx(30.0 / 9.0, abs=0.03)
    assert np.mean(h1.coherences[5:-5]) == pytest.approx(0.9, abs=0.01)
    np.testing.assert_allclose(np.abs(h1.values / h2.values), h1.coherences, rtol=1e-9)


def test_two_forces_at_once_are_told_apart() -> None:
    random = np.random.default_rng(6)
    one, two = random.normal(size=(2, 100_000))
    two = 0.6 * one + 0.8 * two  # correlated
    run = histories(
        np.column_stack([one, two, 2.0 * one - 5.0 * two]), [True, True, False], [1, 2, 3]
    )
    found = response_functions([run], "h1", 1.0)
    assert found.reference_nodes.tolist() == [1, 2]
    np.testing.assert_allclose(found.values[3:-3].mean(axis=0), [2.0, -5.0], atol=1e-6)
    np.testing.assert_allclose(found.coherences, 1.0, atol=1e-9)
    with pytest.raises(CampaignError, match="H2 is for one force"):
        response_functions([run], "h2", 1.0)


def test_universal_files_of_blows_are_averaged_and_signed(tmp_path: Path) -> None:
    """Two recordings of dataset 58: a channel that comes again begins the second one."""
    true = driven("four", 8000, everywhere=False)
    for start in (0, 4000):
        part = slice(start, start + 4000)
        for node, direction, kind, label, values in (
            (1, 3, 13, "N", true.force[part]),
            (1, 3, 11, "m/s", true.velocities[part, 0]),
            (4, -3, 11, "m/s", -true.velocities[part, 3]),
        ):
            data = pyuff.prepare_58(
                func_type=1, rsp_node=node, rsp_dir=direction, ref_node=0, ref_dir=0,
                data=values, x=np.arange(4000) * true.step_s, ordinate_spec_data_type=kind,
                ordinate_axis_units_lab=label, abscissa_spec_data_type=17, binary=0, id1="blow",
                orddenom_spec_data_type=0, z_axis_axis_units_lab="NONE",
            )  # fmt: skip
            pyuff.UFF(str(tmp_path / "blows.uff"))._write_set(data, "add")
    runs, notes = read_histories([tmp_path / "blows.uff"])
    assert notes == []
    assert [run.values.shape for run in runs] == [(4000, 3)] * 2
    assert runs[0].signs.tolist() == [1.0, 1.0, -1.0]
    ended = run_command(
        tmp_path, "identify", "blows.uff", "--band", "0.7", "2.5", "--order", "12",
        "--segment", "40", "--json", "--out", "m.csv",
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    told = json.loads(ended.stdout)
    assert told["modes"][0]["frequency_hz"] == pytest.approx(true.frequencies_hz[0], rel=0.01)
    assert "from 2 recordings" in " ".join(told["notes"])
    shape = modetune.read_test(tmp_path / "m.csv").modes
    assert shape is not None
    ratio = shape.modes.mode_shapes[1, 0] / shape.modes.mode_shapes[0, 0]
    assert ratio == pytest.approx(true.shapes[3, 0] / true.shapes[0, 0], rel=0.05)


def test_responses_alone_become_a_test_that_a_campaign_reads(tmp_path: Path) -> None:
    pytest.importorskip("pyoma2", reason="pyOMA2 is not installed (modetune[oma])")
    write_csv(tmp_path / "noise.csv", driven("slow", 20_000, everywhere=True), with_force=False)
    ended = run_command(
        tmp_path, "identify", "noise.csv", "--json", "--out", "modes.csv", "--figures", "drawn"
    )
    assert ended.returncode == 0, ended.stderr
    told = json.loads(ended.stdout)
    assert (told["output_only"], told["normalisation"], len(told["modes"])) == (True, "max", 2)
    read = modetune.read_test(tmp_path / "modes.csv").modes
    assert read is not None
    assert read.modes.nodes.tolist() == [1, 2]
    assert "shapes have no scale" in (tmp_path / "modes.csv").read_text()
    drawn = {"stabilisation.png", "stabilisation.html", "auto_mac.png"}
    assert {path.name for path in (tmp_path / "drawn").iterdir()} == drawn


def test_histories_of_a_matlab_file_are_those_of_the_table(tmp_path: Path) -> None:
    times = 0.01 * np.arange(400)
    values = np.random.default_rng(2).standard_normal((400, 3))
    rows = (",".join(f"{value:.17g}" for value in row) for row in np.column_stack([times, values]))
    head = "time [s],1.z [N],s2.z [g],3.-x [g]"  # a letter before the number of a point
    (tmp_path / "run.csv").write_text("\n".join([head, *rows]) + "\n")
    labels = {"dof": ["1:+Z", "2:+Z", "3:-X"], "unit": ["N", "g", "g"]}
    of_time = {"time": times, "acc": values}
    of_rate = {"fs": 100.0, "data": values.T}
    (table,), _ = read_histories([tmp_path / "run.csv"])
    for own in (of_time, of_rate):
        scipy.io.savemat(tmp_path / "run.mat", {**own, **labels})
        (read,), notes = read_histories([tmp_path / "run.mat"])
        np.testing.assert_allclose(read.values, table.values, rtol=1e-15)
        for name in ("nodes", "components", "signs", "forces"):
            np.testing.assert_array_equal(getattr(read, name), getattr(table, name))
        assert read.step_s == pytest.approx(0.01, rel=1e-12)  # the mean of 399 differences
        assert (read.kind, len(notes)) == ("accelerance", 1)


@pytest.mark.parametrize(
    ("own", "said"),
    [
        ({}, "acc has 3 channels and no variable names their nodes and directions"),
        ({"dof": [1.03, 2.03, 3.03]}, "no variable `unit` gives the unit of acc"),
        ({"dof": [1.03, 2.03, 3.03], "unit": "bar"}, "no variable `unit` gives the unit of acc"),
    ],
)
def test_what_a_matlab_recording_lacks_is_said(
    tmp_path: Path, own: dict[str, object], said: str
) -> None:
    times = 0.01 * np.arange(400)
    recorded = {"time": times, "acc": np.ones((400, 3))}
    scipy.io.savemat(tmp_path / "run.mat", {**recorded, **own})
    ended = run_command(tmp_path, "identify", "run.mat")
    assert ended.returncode == 2, ended.stderr
    assert said in ended.stderr


HEAD = "time [s],1.z [N],2.z [m/s^2]\n"
ROWS = "".join(f"{0.01 * k:.2f},{k % 3},{k % 5}\n" for k in range(400))


@pytest.mark.parametrize(
    ("text", "options", "said"),
    [
        ("time,1.z,2.z [m/s^2]\n" + ROWS, (), "bad.csv, line 1, column 2: '1.z' is not a channel"),
        ("time,1.z [bar]\n0,1\n", (), "line 1, column 2: '1.z [bar]' is not a channel"),
        (HEAD + ROWS.replace("0.07,1,2", "0.07,x,2"), (), "bad.csv, line 9: `0.07` has 'x'"),
        (HEAD + ROWS.replace("0.07,1,2", "0.07,1"), (), "bad.csv, line 9: 2 values under 3"),
        (HEAD + ROWS.replace("0.07,1,2\n", ""), (), "times are not evenly spaced"),
        (HEAD.replace("2.z", "1.x").replace("N", "m") + ROWS, (), "must be of one quantity"),
        (HEAD.replace("2.z [m/s^2]", "1.z [kN]") + ROWS, (), "must be of one quantity"),
        (
            HEAD + ROWS,
            ("--segment", "9"),
            "segments of 900 samples: the length is not between 16 and 400",
        ),
        (HEAD + ROWS, ("--estimator", "h3"), "expected one of h1, h2"),
        (HEAD + ROWS, ("--window", "hamming"), "expected one of hann, boxcar"),
        (HEAD + ROWS, ("--segment", "4"), "1 segments cannot separate 1 forces from noise"),
        (HEAD.replace("[N]", "[m/s^2]") + ROWS, ("--estimator", "h1"), "responses without forces"),
        (HEAD.replace("[N]", "[m/s^2]") + ROWS, (), "too few for --order"),
        ("mode,1\nfrequency_hz,3.0\n", (), "no response functions and no time histories"),
    ],
)
def test_bad_histories_are_told_with_file_and_line(
    tmp_path: Path, text: str, options: tuple[str, ...], said: str
) -> None:
    (tmp_path / "bad.csv").write_text(text)
    ended = run_command(tmp_path, "identify", "bad.csv", *options)
    assert ended.returncode == 2, ended.stderr + ended.stdout
    assert said in ended.stderr
