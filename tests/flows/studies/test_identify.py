"""From measured functions to a test file: recovery of known modes, the command, and what fails."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import matplotlib.image
import numpy as np
import pytest

from modetune.adapters.test_files.measurements import read_measurement
from modetune.adapters.test_files.modes_csv import read_modes_csv
from modetune.adapters.test_files.universal.file import write_universal
from modetune.core.correlation.correlation import mac
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import MeasuredFrfs, Measurement
from modetune.core.measurement.response_functions import NormalModes, Response, modal_frf
from modetune.core.measurement.stabilisation import Criteria
from modetune.core.modes import Floats
from modetune.flows.studies.identify.figures import write_figures
from modetune.flows.studies.identify.identification import (
    Identification,
    IdentificationSettings,
    identify,
)
from tests.command_line import run_command

#: A damped system whose fourth and fifth modes are 1 % apart.
FREQUENCIES = np.array([20.0, 33.0, 47.0, 60.0, 60.6, 88.0, 120.0])
DAMPING = np.array([0.01, 0.008, 0.006, 0.005, 0.006, 0.01, 0.008])
N_SENSORS = 14


def true_shapes(n_dof: int = N_SENSORS, seed: int = 11) -> Floats:
    """Shapes of unit modal mass (by decree), (n_dof, 7), every mode driven at the first two."""
    shapes = np.random.default_rng(seed).normal(size=(n_dof, FREQUENCIES.size))
    shapes[:2] = np.where(np.abs(shapes[:2]) < 0.5, 0.5, shapes[:2])
    return shapes


def measured(
    kind: Response = "accelerance",
    references: int = 1,
    noise: float = 0.02,
    seed: int = 0,
    lines: Floats | None = None,
    hz: Floats = FREQUENCIES,
    ratios: Floats = DAMPING,
) -> MeasuredFrfs:
    """Functions in z at sensors 1..14 from forces at 1..references.

    noise: circular complex, standard deviation relative to each function's root mean square.
    Superposed by core.frf, which shares no code with the identification.
    """
    at = np.linspace(0.0, 150.0, 1201) if lines is None else lines
    modes = NormalModes((2.0 * np.pi * hz) ** 2, true_shapes(), ratios)
    values = modal_frf(at, modes, np.arange(N_SENSORS), np.arange(references), kind)
    values = values.reshape(at.size, -1)
    rng = np.random.default_rng(seed)
    scatter = rng.normal(size=values.shape) + 1j * rng.normal(size=values.shape)
    values = values + noise * np.sqrt(np.mean(np.abs(values) ** 2, axis=0) / 2.0) * scatter
    n = values.shape[1]
    sensors, forces = np.divmod(np.arange(n), references)
    return MeasuredFrfs(
        kind,
        at,
        values,
        sensors + 1,
        np.full(n, 3),
        np.ones(n),
        forces + 1,
        np.full(n, 3),
        np.ones(n),
        np.zeros((0, 0)),
    )


BAND = IdentificationSettings(band_hz=(8.0, 140.0))


def assert_recovered(found: Identification, shapes: Floats | None = None) -> None:
    """The issue's measure: frequencies 0.1 %, damping 5 %, MAC 0.99, and no mode too many."""
    modes = found.modes.modes
    np.testing.assert_allclose(modes.frequencies_hz, FREQUENCIES, rtol=1e-3)
    np.testing.assert_allclose(modes.damping_ratios, DAMPING, rtol=0.05)
    table = mac(modes.mode_shapes, true_shapes() if shapes is None else shapes)
    assert np.diag(table).min() >= 0.99


@pytest.mark.parametrize(
    # Each pair of two of these once at least.
    ("kind", "noise", "references"),
    [
        ("accelerance", 0.0, 1), ("accelerance", 0.01, 2), ("accelerance", 0.03, 1),
        ("mobility", 0.0, 2), ("mobility", 0.01, 1), ("mobility", 0.03, 2),
        ("receptance", 0.0, 1), ("receptance", 0.01, 2), ("receptance", 0.03, 2),
    ],
)  # fmt: skip
def test_modes_of_a_known_system_come_back_from_noisy_functions(
    kind: Response, noise: float, references: int
) -> None:
    # A receptance falls with frequency squared: 1 % of its rms hides modes above its first few.
    scale = 0.05 if kind == "receptance" else 1.0
    found = identify(measured(kind, references, noise * scale), BAND)
    assert_recovered(found)
    assert found.modes.modes.normalisation == "mass"
    assert found.phase_collinearity.min() > 0.99
    assert found.frac.min() > 0.99


@pytest.mark.parametrize("seed", range(4))
def test_no_draw_of_noise_adds_or_loses_a_mode(seed: int) -> None:
    assert_recovered(identify(measured(noise=0.03, seed=seed), BAND))


def test_shapes_of_a_driving_point_are_of_unit_modal_mass() -> None:
    found = identify(measured(references=2, noise=0.01), BAND).modes.modes.mode_shapes
    shapes = true_shapes()
    signed = found * np.sign(np.sum(found * shapes, axis=0))
    assert np.abs(signed - shapes).max() < 0.02 * np.abs(shapes).max()


def test_two_modes_of_one_frequency_that_references_see_unlike_are_told() -> None:
    """One pole fits them, as each function has a residue of its own; one shape does not."""
    together = np.where(FREQUENCIES == 60.6, 60.0, FREQUENCIES)
    ratios = np.where(FREQUENCIES == 60.6, 0.005, DAMPING)
    found = identify(measured(references=2, noise=0.01, hz=together, ratios=ratios), BAND)
    (told,) = [note for note in found.notes if "two modes of one frequency" in note]
    assert told.startswith("mode 4 (60 Hz)")
    apart = identify(measured(references=2, noise=0.03), BAND)
    assert not [note for note in apart.notes if "two modes of one frequency" in note]


def test_a_sensor_that_looks_the_other_way_is_turned_back() -> None:
    frfs = measured(noise=0.01)
    flipped = np.where(frfs.nodes == 5, -1.0, 1.0)
    turned = replace(frfs, values=frfs.values * flipped, signs=flipped)
    assert_recovered(identify(turned, BAND))


def test_a_hammer_that_went_round_gives_shapes_at_its_points() -> None:
    frfs = measured(noise=0.01)
    hammer = replace(
        frfs,
        nodes=frfs.reference_nodes,
        components=frfs.reference_components,
        reference_nodes=frfs.nodes,
        reference_components=frfs.components,
    )
    found = identify(hammer, BAND)
    assert_recovered(found)
    assert found.modes.modes.nodes.tolist() == list(range(1, N_SENSORS + 1))
    assert "shapes are at the points of the force" in found.notes[0]


def test_without_a_driving_point_the_largest_entry_is_one() -> None:
    frfs = measured(noise=0.01)
    kept = frfs.nodes != 1
    found = identify(
        replace(
            frfs,
            values=frfs.values[:, kept],
            nodes=frfs.nodes[kept],
            components=frfs.components[kept],
            signs=frfs.signs[kept],
            reference_nodes=frfs.reference_nodes[kept],
            reference_components=frfs.reference_components[kept],
            reference_signs=frfs.reference_signs[kept],
        ),
        BAND,
    )
    assert_recovered(found, true_shapes()[1:])
    assert found.modes.modes.normalisation == "max"
    assert found.modes.modes.mode_shapes.max(axis=0) == pytest.approx(1.0)


def test_a_band_finds_the_modes_in_it_only_and_tells_what_it_left_out() -> None:
    """The mode at 120 Hz leaves a pole at the band's end that is stable at eleven orders."""
    found = identify(measured(), IdentificationSettings(band_hz=(40.0, 100.0)))
    np.testing.assert_allclose(found.modes.modes.frequencies_hz, FREQUENCIES[2:6], rtol=1e-3)
    assert len(found.notes) == 1
    assert "the stable pole at 99." in found.notes[0]
    assert "was left out" in found.notes[0]


def test_poles_chosen_by_hand_are_those_and_no_others() -> None:
    found = identify(measured(), replace(BAND, pick=(60.62, 33.1, 60.01)))
    np.testing.assert_allclose(found.modes.modes.frequencies_hz, FREQUENCIES[[1, 3, 4]], rtol=1e-3)


def test_a_pole_asked_for_that_does_not_exist_is_one_sentence_with_the_nearest() -> None:
    with pytest.raises(CampaignError, match=r"within 1 % of 75 Hz; the nearest is at 88") as caught:
        identify(measured(), replace(BAND, pick=(33.0, 75.0)))
    assert len(caught.value.problems) == 1


def test_a_mode_that_is_missed_is_told_by_the_peak_it_leaves() -> None:
    """Order 8 cannot hold seven modes and noise."""
    found = identify(measured(noise=0.03), replace(BAND, order=8))
    assert found.modes.modes.n_modes < FREQUENCIES.size
    assert any("have a peak at" in note and "--order" in note for note in found.notes)


def test_an_impossible_criterion_leaves_no_mode_and_says_what_to_try() -> None:
    with pytest.raises(CampaignError, match="no pole is stable over 10 orders up to 60"):
        identify(measured(noise=0.05), replace(BAND, criteria=Criteria(1e-9, 1e-9, 1e-9)))


def test_noise_alone_has_no_modes() -> None:
    rng = np.random.default_rng(2)
    frfs = measured()
    noise = rng.normal(size=frfs.values.shape) + 1j * rng.normal(size=frfs.values.shape)
    with pytest.raises(CampaignError, match="no pole is stable"):
        identify(replace(frfs, values=noise), BAND)


@pytest.mark.parametrize(
    ("band", "said"),
    [
        ((200.0, 300.0), "0 lines .* in the band 200 to 300 Hz.* reach from 0 to 150 Hz"),
        ((100.0, 50.0), "0 lines .* in the band 100 to 50 Hz"),
        ((60.0, 60.3), "3 lines .* at least 6 are needed"),
    ],
)
def test_a_band_without_data_is_refused_with_the_range(
    band: tuple[float, float], said: str
) -> None:
    with pytest.raises(CampaignError, match=said):
        identify(measured(), IdentificationSettings(band_hz=band))


def test_functions_of_one_line_are_refused() -> None:
    with pytest.raises(CampaignError, match=r"1 lines .* at least 6 are needed"):
        identify(measured(noise=0.0, lines=np.array([60.0])), IdentificationSettings())


def test_a_zero_function_is_left_out_and_told() -> None:
    frfs = measured(noise=0.01)
    found = identify(replace(frfs, values=np.where(frfs.nodes == 7, 0.0, frfs.values)), BAND)
    assert 7 not in found.modes.modes.nodes
    assert found.notes[0] == "7.z is zero in the band and was left out"


def test_functions_that_are_all_zero_are_refused() -> None:
    frfs = measured()
    with pytest.raises(CampaignError, match="all response functions are zero in the band"):
        identify(replace(frfs, values=np.zeros_like(frfs.values)), BAND)


def test_no_function_at_all_is_refused() -> None:
    none, empty = np.zeros(0, dtype=np.int64), np.zeros(0)
    frfs = MeasuredFrfs(
        "accelerance",
        np.linspace(0.0, 9.0, 10),
        np.zeros((10, 0), dtype=np.complex128),
        none,
        none,
        empty,
        none,
        none,
        empty,
        np.zeros((0, 0)),
    )
    with pytest.raises(CampaignError, match="no response functions"):
        identify(frfs, BAND)


def test_functions_without_a_reference_or_a_direction_are_refused() -> None:
    frfs = measured()
    nothing = np.zeros_like(frfs.components)
    with pytest.raises(CampaignError, match="names no reference"):
        identify(replace(frfs, reference_components=nothing), BAND)
    with pytest.raises(CampaignError, match="lacks the direction of its sensor"):
        identify(replace(frfs, components=nothing), BAND)


def test_a_test_in_two_parts_without_a_common_reference_is_refused() -> None:
    frfs = measured(noise=0.01)
    second = frfs.nodes > 7
    parts = replace(frfs, reference_nodes=np.where(second, 99, frfs.reference_nodes))
    with pytest.raises(CampaignError, match="a reference must be common to all parts"):
        identify(parts, BAND)


def test_coherence_is_told_with_its_worst_function() -> None:
    frfs = measured(noise=0.01)
    coherences = np.where(frfs.nodes == 4, 0.5, 1.0) * np.ones(frfs.values.shape)
    found = identify(replace(frfs, coherences=coherences), BAND)
    # Thirteen functions of 1 and one of 0.5.
    assert found.notes == (
        "mean coherence in the band is 0.96, least 0.50 at 4.z / 1.z; the fit does not "
        "use it as a weight",
    )


def test_a_coherence_that_is_not_finite_is_in_no_mean() -> None:
    frfs = measured(noise=0.01)
    coherences = np.where(frfs.nodes == 4, np.nan, 1.0) * np.ones(frfs.values.shape)
    found = identify(replace(frfs, coherences=coherences), BAND)
    assert len(found.notes) == 1
    assert "mean coherence in the band is 1.00, least 1.00 at " in found.notes[0]
    none = identify(replace(frfs, coherences=coherences * np.nan), BAND)
    assert none.notes == ()


def test_figures_are_written_and_show_something(tmp_path: Path) -> None:
    found = identify(measured(references=2), BAND)
    written = write_figures(tmp_path, "a test", found)
    assert [path.name for path in written] == [
        "stabilisation.png",
        "auto_mac.png",
        "synthesis_worst.png",
        "synthesis_best.png",
        "synthesis_driving_point.png",
        "stabilisation.html",
    ]
    for path in written[:-1]:
        assert np.ptp(matplotlib.image.imread(path)[:, :, :3]) == 1.0  # black and white and between
    page = written[-1].read_text(encoding="utf-8")
    assert "frequency, damping, shape: stable" in page
    assert 'src="http' not in page


def run(folder: Path, *arguments: str) -> CompletedProcess[str]:
    return run_command(folder, "identify", *arguments)


def sentence(ended: CompletedProcess[str]) -> str:
    assert ended.returncode == 2
    assert "Traceback" not in ended.stderr
    return ended.stderr


@pytest.fixture(scope="module")
def universal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A universal file with the functions of two references, with 2 % noise."""
    path = tmp_path_factory.mktemp("frfs") / "frfs.unv"
    write_universal(path, Measurement(frfs=measured(references=2)))
    return path


def test_the_command_reads_a_universal_file_and_writes_a_test_file(
    universal: Path, tmp_path: Path
) -> None:
    ended = run(
        tmp_path,
        str(universal),
        "--band",
        "8",
        "140",
        "--out",
        "modes.csv",
        "--figures",
        "figures",
        "--json",
    )
    assert ended.returncode == 0, ended.stderr
    told: dict[str, Any] = json.loads(ended.stdout)
    assert [mode["frequency_hz"] for mode in told["modes"]] == pytest.approx(FREQUENCIES, rel=1e-3)
    assert told["frac"]["least"] > 0.99
    assert (tmp_path / "figures" / "stabilisation.png").is_file()
    text = (tmp_path / "modes.csv").read_text()
    assert text.startswith(f"# identified by modetune from {universal}\n# 28 functions")
    back = read_modes_csv(tmp_path / "modes.csv").modes
    np.testing.assert_allclose(back.damping_ratios, DAMPING, rtol=0.05)
    assert np.diag(mac(back.mode_shapes, true_shapes())).min() >= 0.99


@pytest.mark.parametrize("name", ["modes.h5", "modes.unv"])
def test_modes_are_written_in_every_form_that_is_read(
    universal: Path, tmp_path: Path, name: str
) -> None:
    ended = run(tmp_path, str(universal), "--band", "8", "140", "--pick", "33,60.6", "--out", name)
    assert ended.returncode == 0, ended.stderr
    back = read_measurement([tmp_path / name]).modes
    assert back is not None
    np.testing.assert_allclose(back.modes.frequencies_hz, FREQUENCIES[[1, 4]], rtol=1e-3)
    assert np.diag(mac(back.modes.mode_shapes, true_shapes()[:, [1, 4]])).min() >= 0.99


def test_people_get_a_table_with_quality(universal: Path, tmp_path: Path) -> None:
    ended = run(tmp_path, str(universal), "--band", "8", "140")
    assert ended.returncode == 0, ended.stderr
    assert "60.6" in ended.stdout
    assert "FRAC of 28 functions: mean 0.99" in ended.stdout


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--pick", "5.5;12"), "--pick requires numbers separated by commas"),
        (("--pick", "nan"), "--pick requires numbers separated by commas"),
        (("--criteria", "0.01,0.05"), "three numbers: frequency,damping,shape"),
        (("--criteria", "0,0.05,0.02"), "must lie between 0 and 1"),
        (("--out", "modes.txt"), "a test file is written as .csv, .h5"),
        (("--band", "500", "600"), "reach from 0 to 150 Hz"),
        (("--order", "900"), "--order 900 does not fit"),
    ],
)
def test_mistakes_are_one_sentence(
    universal: Path, tmp_path: Path, arguments: tuple[str, ...], said: str
) -> None:
    assert said in sentence(run(tmp_path, str(universal), *arguments))


def test_a_file_of_sound_pressure_over_time_is_refused_with_what_it_holds(
    shared_data: Path, tmp_path: Path
) -> None:
    """The public sample file holds one time history in Pa, whatever its name suggests."""
    said = sentence(run(tmp_path, str(shared_data / "uff" / "Sample_UFF58_ascii.uff")))
    assert "time history" in said
    assert "response functions" in said


def test_a_file_of_modes_has_nothing_to_identify_from(tmp_path: Path) -> None:
    (tmp_path / "modes.csv").write_text("mode,1\nfrequency_hz,5\n1.z,1\n")
    said = sentence(run(tmp_path, "modes.csv"))
    assert "no response functions and no time histories are in there" in said
