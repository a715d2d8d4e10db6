"""Nights of real campaigns: what an update leaves in the history, and what the history says."""

from __future__ import annotations

import csv
import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest
from scipy.linalg import eigh

import modetune
from modetune.core.errors import CampaignError
from modetune.core.modes import Floats
from modetune.core.monitoring.past_runs import FOLDER, PAST_RUN, add_past_run, read_history
from modetune.core.storage.campaign_record import read_record
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.report.headline import headline
from modetune.flows.report.page import page
from modetune.flows.studies.catalogue import find_study
from modetune.flows.studies.history.differences import RunDifference
from modetune.flows.studies.history.study import StructureHistory
from modetune.flows.updating.forecast import Unwatched
from modetune.flows.updating.update import update_campaign
from tests.command_line import run_command
from tests.flows.updating.test_same_bits import Killed

#: Relative scatter of a frequency, and of an entry of a shape, of the tests here.
FREQUENCY, SHAPE = 0.001, 0.02
GROUND = "ground"


@dataclass(frozen=True)
class Springs:
    """Masses in kg, and springs between two of them or the ground in N/m."""

    masses: Mapping[str, float]
    springs: Mapping[str, tuple[str, str, float]]

    def deck(self) -> str:
        """The model as modetune reads it."""
        lines = ["masses:", *(f"  {name}: {value}" for name, value in self.masses.items())]
        lines.append("springs:")
        for name, (one, other, value) in self.springs.items():
            lines.append(f"  {name}: {{between: [{one}, {other}], stiffness: {value}}}")
        return "\n".join(lines) + "\n"

    def modes(self, factors: Mapping[str, float]) -> tuple[Floats, Floats]:
        """Frequencies in Hz and shapes of the structure with factors on its springs."""
        at = {name: place for place, name in enumerate(self.masses)}
        stiffness = np.zeros((len(at), len(at)))
        for name, (one, other, value) in self.springs.items():
            ends = [at[mass] for mass in (one, other) if mass != GROUND]
            signs = np.array([1.0, -1.0][: len(ends)])
            stiffness[np.ix_(ends, ends)] += value * factors.get(name, 1.0) * np.outer(signs, signs)
        values, shapes = eigh(stiffness, np.diag(list(self.masses.values())))
        return np.sqrt(np.maximum(values, 0.0)) / (2.0 * np.pi), shapes


@dataclass(frozen=True)
class Structure:
    """A structure that is tested every night, and its campaign in a folder."""

    name: str
    folder: Path
    system: Springs
    parameters: tuple[str, ...]
    modes: tuple[int, ...]

    def write(self, keys: str = "") -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "deck.yaml").write_text(self.system.deck())
        parameters = "\n".join(
            f"  - {{name: {name}, quantity: spring_stiffness, elset: {name}, bounds: [0.3, 3.0]}}"
            for name in self.parameters
        )
        (self.folder / "campaign.yaml").write_text(
            f"name: {self.name}\n"
            "model: {deck: deck.yaml, solver: matrices, units: m-kg-s}\n"
            f"test: {{modes: measured.csv}}\nparameters:\n{parameters}\n"
            f"residuals: {{frequency_deviation: {FREQUENCY}, shape_deviation: {SHAPE}}}\n"
            f"update: {{starts: 1}}\n{keys}"
        )

    def test(self, night: int, **factors: float) -> None:
        """Write the test of a night: modes with noise, and the temperature."""
        rng = np.random.default_rng(night)
        hz, shapes = self.system.modes(factors)
        hz, shapes = hz[list(self.modes)], shapes[:, list(self.modes)]
        hz = hz * (1.0 + FREQUENCY * rng.standard_normal(hz.size))
        rms = np.sqrt(np.mean(shapes**2, axis=0))
        shapes = shapes + SHAPE * rms * rng.standard_normal(shapes.shape)
        rows = [["mode", *range(1, hz.size + 1)], ["frequency_hz", *hz.tolist()]]
        rows += [[f"{place}.x", *row] for place, row in enumerate(shapes.tolist(), start=1)]
        rows.append(["environment temperature_C", 15.0 + night])
        text = "\n".join(",".join(map(str, row)) for row in rows)
        (self.folder / "measured.csv").write_text(f"{text}\n")

    def run(self, *words: str) -> CompletedProcess[str]:
        store = str(self.folder / "store")
        return run_command(self.folder, *words, MODETUNE_STORE=store, MODETUNE_NO_PREFECT="1")

    def update(self, *options: str) -> CompletedProcess[str]:
        return self.run("update", "campaign.yaml", *options)

    def night(self, night: int, *options: str, **factors: float) -> CompletedProcess[str]:
        self.test(night, **factors)
        return self.update(*options)

    @property
    def runs(self) -> Path:
        return self.folder / "runs" / self.name

    def past_files(self) -> list[str]:
        """Names of the files of past runs, oldest first; some end within one second."""
        names = [f"{run.stem}.h5" for run in read_history(self.runs).runs]
        assert set(names) == {file.name for file in (self.runs / FOLDER).glob("*.h5")}
        return names


#: The six masses of the thesis (Table 1, experimental), which all other tests here watch.
SIX = Springs(
    {"m1": 1.8, "m2": 2.4, "m3": 1.6, "m4": 1.2, "m5": 1.1, "m6": 0.9},
    {
        "k1": ("m2", "m4", 1500.0), "k2": ("m4", "m5", 1600.0), "k3": ("m1", "m3", 1400.0),
        "k4": ("m1", "m2", 6500.0), "k5": ("m4", "m6", 1300.0), "k6": (GROUND, "m2", 1500.0),
        "k7": ("m5", "m6", 1300.0), "k8": (GROUND, "m6", 400.0), "k9": (GROUND, "m4", 2200.0),
        "k10": (GROUND, "m3", 3800.0),
    },
)  # fmt: skip


def six_masses(folder: Path, keys: str = "") -> Structure:
    made = Structure("six", folder, SIX, ("k1", "k2"), tuple(range(6)))
    made.write(keys)
    return made


@pytest.fixture(scope="module")
def watched(tmp_path_factory: pytest.TempPathFactory) -> Structure:
    """Three equal nights and one after a spring lost 15 %; two kept runs."""
    structure = six_masses(tmp_path_factory.mktemp("watched"), "run: {keep: 2}\n")
    for night in (1, 2, 3):
        ended = structure.night(night, "--fail-on", "change")
        assert ended.returncode == 0, ended.stderr
        # Nothing is said of the first test, which has nothing to be compared with.
        assert (f"structure: Learning: {night} of 30 runs" in ended.stdout) == (night > 1)
    ended = structure.night(4, "--fail-on", "change", "--json", k1=0.85)
    assert ended.returncode == 7, ended.stderr
    (structure.folder / "ended.json").write_text(ended.stdout)
    return structure


def test_a_loss_of_15_per_cent_ends_as_changed_with_exit_code_7(watched: Structure) -> None:
    found = json.loads((watched.folder / "ended.json").read_text())
    assert (found["status"], found["exit_code"]) == ("converged", 7)
    assert found["run_dir"] == "runs/six"
    drift = found["drift"]
    assert drift["state"] == "changed"
    assert drift["sentence"].startswith("Changed: k1 -1")
    k1, k2 = drift["changes"]
    # Noise of 0.1 % in frequencies and 2 % in shapes leaves k1 its repeatability of 0.6 %.
    assert k1["since_reference"] == pytest.approx(-0.15, abs=0.02)
    assert (k1["step"], k2["step"] or k2["slow"]) == (True, False)
    assert drift["sentence"] in found["headline"]


def test_the_report_says_it_in_red(watched: Structure) -> None:
    record = read_record(watched.runs)
    assert (record.state, record.changed) == ("changed", ("k1",))
    assert headline(record).mood == "outside"
    assert record.drift in page(record)


def test_the_history_lists_all_runs_oldest_first(watched: Structure) -> None:
    found = json.loads(watched.run("history", "campaign.yaml", "--json").stdout)
    assert (found["name"], found["status"], found["run_dir"]) == ("six", "changed", "runs/six")
    runs = found["runs"]
    assert [run["state"] for run in runs] == ["learning"] * 3 + ["changed"]
    assert [run["number"] for run in runs] == [1, 2, 3, 4]
    assert [run["environment"] for run in runs] == [
        {"temperature_C": 15.0 + night} for night in (1, 2, 3, 4)
    ]
    assert len({run["test_digest"] for run in runs}) == 4
    assert sorted(run["at"] for run in runs) == [run["at"] for run in runs]
    last = runs[-1]
    assert last["verdict"] == json.loads((watched.folder / "ended.json").read_text())["verdict"]
    k1 = last["parameters"][0]
    assert (k1["name"], k1["deck_value"]) == ("k1", 1500.0)
    assert k1["value"] == pytest.approx(0.85 * 1500.0, rel=0.02)
    assert 0.0 < k1["repeatability"] <= k1["standard_error"]
    assert [mode["elastic_mode"] for mode in last["modes"]] == [1, 2, 3, 4, 5, 6]
    assert all(mode["mac"] > 0.98 for mode in last["modes"])


def test_table_csv_page_and_charts(watched: Structure) -> None:
    words = ["--csv", "runs.csv", "--page", "history.html", "--figures", "figures"]
    ended = watched.run("history", "campaign.yaml", *words)
    assert ended.returncode == 0, ended.stderr
    assert "six: Changed: k1 -1" in ended.stdout
    with (watched.folder / "runs.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["state"] for row in rows] == ["learning"] * 3 + ["changed"]
    assert float(rows[0]["temperature_C"]) == 16.0
    assert float(rows[3]["k1"]) == pytest.approx(0.85 * 1500.0, rel=0.02)
    charts = {path.stem for path in (watched.folder / "figures").iterdir()}
    assert charts == {"parameters", "frequencies", "agreement", "environment"}
    text = (watched.folder / "history.html").read_text()
    assert "Changed: k1" in text
    assert "Updated parameters over the runs" in text


def test_the_newest_runs_keep_record_report_and_deck(watched: Structure) -> None:
    """Past runs are never removed; `run.keep: 2` keeps the files of two."""
    assert len(watched.past_files()) == 4
    stems = [name.removesuffix(".h5") for name in watched.past_files()[-2:]]
    kept = [watched.runs / FOLDER / stem for stem in stems]
    assert {path for path in (watched.runs / FOLDER).iterdir() if path.is_dir()} == set(kept)
    for path in kept:
        files = {str(file.relative_to(path)) for file in path.rglob("*") if file.is_file()}
        assert files == {"campaign.h5", "report.html", "updated/deck.yaml"}
        assert read_record(path).name == "six"
    newest = kept[-1] / "campaign.h5"
    assert newest.samefile(watched.runs / "campaign.h5")
    assert not (kept[-1] / "updated/deck.yaml").samefile(watched.runs / "updated" / "deck.yaml")


def test_what_changed_between_two_runs(watched: Structure) -> None:
    files = [str(watched.runs / FOLDER / name) for name in watched.past_files()[-2:]]
    found = json.loads(watched.run("history", *files, "--json").stdout)
    k1, k2 = found["parameters"]
    assert k1["change"] == pytest.approx(-0.15, abs=0.02)
    sizes = [
        parameter["repeatability"] / parameter["deck_value"]
        for run in (found["before"], found["after"])
        for parameter in run["parameters"][:1]
    ]
    assert k1["errors"] == pytest.approx(k1["change"] / np.hypot(*sizes), rel=1e-9)
    assert abs(k2["errors"]) < 4.0
    # The updated deck has a line for each spring that moved.
    assert [(line["line"], line["before"][:6]) for line in found["deck"]] == [
        (9, "  k1: "),
        (10, "  k2: "),
    ]
    assert "temperature_C: 18 and 19" in found["lines"]
    gone = watched.run("history", str(watched.runs / FOLDER / watched.past_files()[0]), files[1])
    assert "no longer kept (`run.keep`)" in gone.stdout


def test_python_gives_the_same(watched: Structure, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(watched.folder)
    found = modetune.history("campaign.yaml")
    assert isinstance(found, StructureHistory)
    assert (found.state, len(found.runs), found.drift is not None) == ("changed", 4, True)
    assert found.frame["k1"].iloc[-1] == pytest.approx(0.85 * 1500.0, rel=0.02)
    of_folder = modetune.history(watched.runs)
    assert isinstance(of_folder, StructureHistory)
    assert (of_folder.state, of_folder.sentence) == ("changed", found.runs[-1].drift)
    day = found.runs[0].at[:10]
    both = modetune.history(["campaign.yaml", found.runs[0].at, found.runs[-1].at])
    assert isinstance(both, RunDifference)
    assert both.largest is not None
    assert both.largest.name == "k1"
    assert isinstance(modetune.history(["campaign.yaml", day]), RunDifference)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "name a campaign"),
        (("nowhere.yaml",), "nowhere.yaml is not there"),
        (("deck.yaml",), "a model of masses and springs, not a campaign"),
        (("campaign.yaml", "2001-01-01"), "there is no run of 2001-01-01 (UTC)"),
        (("campaign.yaml", "2001-01-01", "now"), "alone or with one or two dates"),
        (("measured.csv", "deck.yaml"), "measured.csv is not a record of a history"),
    ],
)
def test_words_that_name_no_run_are_refused(
    watched: Structure, words: tuple[str, ...], said: str
) -> None:
    ended = watched.run("history", *words)
    assert ended.returncode == 2
    assert said in ended.stderr


def test_a_server_knows_which_files_the_words_name(tmp_path: Path) -> None:
    """A worker takes no study of files outside its folders (`flows/server/permission`)."""
    study = find_study("history")
    words = [str(tmp_path / "campaign.yaml"), "2026-11-27"]
    checked = study.checked({"of": words, "page": "history.html"})
    assert tmp_path / "campaign.yaml" in study.paths(checked)
    assert all(path.is_absolute() for path in study.paths(checked))


def test_a_campaign_without_a_run_is_refused(tmp_path: Path) -> None:
    structure = six_masses(tmp_path)
    ended = structure.run("history", "campaign.yaml")
    assert (ended.returncode, "no past runs yet" in ended.stderr) == (2, True)
    with pytest.raises(CampaignError, match="no past runs yet"):
        modetune.history(tmp_path)


@pytest.fixture
def copied(watched: Structure, tmp_path: Path) -> Structure:
    """The watched structure, for a test that adds to it."""
    shutil.copytree(watched.folder, tmp_path / "copy", symlinks=True)
    return Structure("six", tmp_path / "copy", SIX, watched.parameters, watched.modes)


def test_a_repeated_run_and_a_night_without_a_new_test_add_nothing(copied: Structure) -> None:
    before = copied.past_files()
    campaign = copied.folder / "campaign.yaml"
    campaign.write_text(campaign.read_text() + "report: {page: false}  # other settings\n")
    ended = copied.update("--fail-on", "change")
    assert ended.returncode == 7
    assert "structure: Changed: k1 -1" in ended.stdout
    assert copied.past_files() == before


def test_other_settings_on_the_same_test_are_remembered_and_count_once(copied: Structure) -> None:
    ended = copied.update("--set", "residuals.frequency_deviation=0.002")
    assert ended.returncode == 0, ended.stderr
    history = read_history(copied.runs)
    assert len(history.runs) == 5
    assert [run.number for run in history.nights()] == [1, 2, 3, 5]


def test_a_run_that_was_killed_before_its_past_run_is_added_by_the_next(copied: Structure) -> None:
    """The record is complete before the history is written: so a kill leaves the folder."""
    lost = copied.past_files()[-1]
    (copied.runs / FOLDER / lost).unlink()
    shutil.rmtree(copied.runs / FOLDER / lost.removesuffix(".h5"))
    assert copied.night(5, k1=0.85).returncode == 0
    assert lost in copied.past_files()
    assert len(copied.past_files()) == 5


def test_a_run_that_was_killed_before_its_report_gets_its_own_from_the_next(
    copied: Structure, monkeypatch: pytest.MonkeyPatch
) -> None:
    def kill(*given: object) -> None:
        raise Killed

    copied.test(5, k1=0.85)
    monkeypatch.setenv("MODETUNE_STORE", str(copied.folder / "store"))
    campaign = load_campaign(copied.folder / "campaign.yaml")
    with monkeypatch.context() as patch:
        patch.setattr("modetune.flows.updating.update.draw_report", kill)
        with pytest.raises(Killed):
            update_campaign(campaign, copied.runs, Unwatched())
    assert not (copied.runs / "report.html").exists()  # it was that of the run before
    assert copied.update().returncode == 0
    newest = copied.past_files()[-1].removesuffix(".h5")
    report = (copied.runs / "report.html").read_bytes()
    assert (copied.runs / FOLDER / newest / "report.html").read_bytes() == report


def test_broken_and_foreign_files_stop_no_update(copied: Structure) -> None:
    folder = copied.runs / FOLDER
    files = [folder / name for name in copied.past_files()]
    files[0].write_bytes(files[0].read_bytes()[:700])
    (folder / "notes.h5").write_text("notes of the lab\n")
    ended = copied.night(5, k1=0.85)
    assert ended.returncode == 0
    assert "structure: Changed: k1" in ended.stdout
    log = (copied.runs / "campaign.log").read_text()
    assert log.count("left out of the history") == 2
    shown = copied.run("history", "campaign.yaml")
    assert shown.returncode == 0
    assert "left out: the checksum of" in shown.stdout
    assert "notes.h5 is not a record of a history" in shown.stdout


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
@pytest.mark.parametrize("mode", [0o500, 0o000])
def test_a_folder_that_cannot_be_written_or_read_stops_no_update(
    copied: Structure, mode: int
) -> None:
    folder = copied.runs / FOLDER
    folder.chmod(mode)
    try:
        assert copied.night(5, k1=0.85).returncode == 0
        assert "was not written" in (copied.runs / "campaign.log").read_text()
        shown = copied.run("history", "campaign.yaml")
        assert shown.returncode == (0 if mode else 2)
        assert mode or "cannot be read: Permission denied" in shown.stderr
    finally:
        folder.chmod(0o700)


def test_a_file_in_the_way_stops_no_update(tmp_path: Path) -> None:
    structure = six_masses(tmp_path)
    structure.runs.mkdir(parents=True)
    (structure.runs / FOLDER).write_text("a file where the folder must be\n")
    assert structure.night(1).returncode == 0
    assert "was not written" in (structure.runs / "campaign.log").read_text()
    (structure.runs / FOLDER).unlink()
    # The record waits for the next run.
    assert structure.night(2).returncode == 0
    assert len(structure.past_files()) == 2


def test_a_clock_that_goes_back_changes_no_order(copied: Structure) -> None:
    """The newest past run is dated a year ahead: it ran while the clock was wrong."""
    newest = copied.runs / FOLDER / copied.past_files()[-1]
    run = PAST_RUN.read(newest)
    newest.unlink()
    add_past_run(copied.runs, replace(run, ended_at=run.ended_at + 366 * 86400.0))
    assert copied.night(5, k1=0.85).returncode == 0
    history = read_history(copied.runs)
    assert [past.number for past in history.runs] == [1, 2, 3, 4, 5]
    assert history.runs[-1].state == "changed"
    assert copied.run("history", "campaign.yaml", "--page", "p.html").returncode == 0


def test_keep_0_keeps_past_runs_only(tmp_path: Path) -> None:
    structure = six_masses(tmp_path, "run: {keep: 0}\n")
    assert structure.night(1).returncode == 0
    (only,) = (structure.runs / FOLDER).iterdir()
    assert only.name == structure.past_files()[0]


RING = Springs(
    {f"m{place}": 2.0 for place in range(1, 9)},
    {f"ring{place}": (f"m{place}", f"m{place % 8 + 1}", 900.0) for place in range(1, 9)}
    | {f"foot{place}": (GROUND, f"m{place}", 400.0) for place in range(1, 9)},
)
TRAIN = Springs(
    {"engine": 80.0, "tender": 30.0, "first": 20.0, "second": 22.0, "third": 18.0},
    {
        "front": ("engine", "tender", 5e5), "middle": ("tender", "first", 4e5),
        "rear": ("first", "second", 4e5), "last": ("second", "third", 4e5),
    },
)  # fmt: skip
FRAME = Springs(
    {"slab": 4000.0, "machine": 900.0, "absorber": 40.0},
    {
        "soil": (GROUND, "slab", 6e7), "mount": ("slab", "machine", 2e6),
        "blade": ("machine", "absorber", 9e4),
    },
)  # fmt: skip


@pytest.mark.parametrize(
    ("name", "system", "parameters", "modes", "damaged"),
    [
        # A ring on eight feet: all but two of its modes are pairs with one frequency.
        ("ring", RING, ("ring1", "foot3"), tuple(range(8)), "ring1"),
        # A train that runs free: one rigid-body mode, which the test does not measure.
        ("train", TRAIN, ("middle", "last"), (1, 2, 3, 4), "last"),
        # A machine on a slab, with an absorber tuned to it: two close modes of opposite motion.
        ("foundation", FRAME, ("soil", "mount", "blade"), (0, 1, 2), "mount"),
    ],
)
def test_structures_of_other_kinds(
    tmp_path: Path,
    name: str,
    system: Springs,
    parameters: tuple[str, ...],
    modes: tuple[int, ...],
    damaged: str,
) -> None:
    structure = Structure(name, tmp_path, system, parameters, modes)
    structure.write()
    for night in (1, 2):
        ended = structure.night(night, "--fail-on", "change")
        assert ended.returncode == 0, ended.stdout + ended.stderr
    ended = structure.night(3, "--fail-on", "change", **{damaged: 0.85})
    assert ended.returncode == 7, ended.stdout + ended.stderr
    assert f"structure: Changed: {damaged} -1" in ended.stdout


def beam_deck() -> str:
    """A steel cantilever of eight solids, 0.8 m long, in mm and t."""
    nodes = [
        f"{1 + place + 9 * corner}, {100 * place}, {20 * (corner in (1, 2))}, {30 * (corner > 1)}"
        for corner in range(4)
        for place in range(9)
    ]
    elements = [
        f"{place}, "
        + ", ".join(str(place + step + 9 * corner) for step in (0, 1) for corner in (0, 1, 2, 3))
        for place in range(1, 9)
    ]
    held = [f"{1 + 9 * corner}, 1, 3" for corner in range(4)]
    lines = ["*NODE, NSET=ALL", *nodes, "*ELEMENT, TYPE=C3D8I, ELSET=BEAM", *elements]
    lines += ["*MATERIAL, NAME=STEEL", "*ELASTIC", "210000., 0.3", "*DENSITY", "7.85e-9"]
    lines += ["*SOLID SECTION, ELSET=BEAM, MATERIAL=STEEL", "*BOUNDARY", *held]
    return "\n".join([*lines, "*STEP", "*FREQUENCY", "6", "*END STEP"]) + "\n"


@pytest.mark.skipif(shutil.which("ccx") is None, reason="CalculiX is not installed")
def test_a_modulus_that_fell_is_found_through_calculix(tmp_path: Path) -> None:
    """All frequencies of a structure of one material follow the square root of its modulus."""
    structure = Structure("beam", tmp_path, SIX, (), ())
    (tmp_path / "beam.inp").write_text(beam_deck())
    (tmp_path / "campaign.yaml").write_text(
        "name: beam\n"
        "model: {deck: beam.inp, solver: calculix, units: mm-t-s, checks: [mesh, size]}\n"
        "test: {modes: measured.csv}\n"
        "parameters: [{name: E, quantity: youngs_modulus, material: STEEL, bounds: [0.5, 2]}]\n"
        "residuals: {frequency_deviation: 0.002}\n"
        "update: {starts: 1}\n"
    )
    found = structure.run(
        "modes", "beam.inp", "--units", "mm-t-s", "--solver", "calculix", "--json"
    )
    hz = np.array(json.loads(found.stdout)["frequencies_hz"])[:4]
    for night, modulus in enumerate((1.0, 1.0, 0.85), start=1):
        noise = 1.0 + 0.002 * np.random.default_rng(night).standard_normal(hz.size)
        rows = [["mode", 1, 2, 3, 4], ["frequency_hz", *(hz * np.sqrt(modulus) * noise)]]
        text = "\n".join(",".join(map(str, row)) for row in rows)
        (tmp_path / "measured.csv").write_text(text)
        ended = structure.update("--fail-on", "change")
        assert ended.returncode == (7 if modulus < 1.0 else 0), ended.stdout + ended.stderr
    assert "structure: Changed: E -1" in ended.stdout
    history = read_history(structure.runs)
    # 0.2 % of four frequencies leaves the modulus 0.2 %: half the deviation times two.
    assert history.runs[-1].repeatability / 210000.0 == pytest.approx(0.002, rel=0.3)
    assert history.runs[-1].values / 210000.0 == pytest.approx(0.85, abs=0.008)


def test_a_check_cannot_fail_on_a_change(watched: Structure) -> None:
    given = ["--against", "runs/six/campaign.h5", "--fail-on", "change"]
    ended = run_command(watched.folder, "check", "campaign.yaml", *given)
    assert (ended.returncode, "give it to `modetune update`" in ended.stderr) == (2, True)
