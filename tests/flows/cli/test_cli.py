"""The command line as a user meets it: exit codes, one paragraph an error, kills and restarts."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pytest

from modetune.configs.cases import write_case
from modetune.flows.jobs import prefect_server as process
from tests.adapters.solved import needs_ccx
from tests.command_line import run_command as run
from tests.core.matrix_decks import bar, native_eigenvalues
from tests.flows.conftest import api_of

COARSE = "model.deck=garteur_coarse.inp"


@pytest.fixture(scope="module")
def aircraft(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The aircraft's campaigns, tests and decks."""
    folder = tmp_path_factory.mktemp("aircraft")
    write_case("garteur", folder)
    return folder


@pytest.fixture
def folder(aircraft: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(aircraft, tmp_path, dirs_exist_ok=True))


def run_process(
    folder: Path, *arguments: str, **environment: str
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "modetune", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
        timeout=200,
        check=False,
    )


def one_paragraph(result: subprocess.CompletedProcess[str]) -> str:
    """The error a user sees: one that starts with our name, and no traceback."""
    assert "Traceback" not in result.stderr + result.stdout
    # What is begun is said before it, a line each where no terminal is.
    _, name, said = f"\n{result.stderr}".partition("\nmodetune: ")
    assert name
    return said


def ccx_processes(marker: str) -> list[int]:
    """Running programs whose working folder is below a place."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                if (
                    str((entry / "cwd").readlink()).startswith(marker)
                    and "ccx" in (entry / "comm").read_text()
                ):
                    found.append(int(entry.name))
            except OSError:
                continue
    return found


def wait_for(condition: Callable[[], object], seconds: float = 30.0) -> bool:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.02)
    return False


def enough_results(store: Path, count: int) -> bool:
    return len(list(store.glob("??/*.h5"))) >= count


def test_check_tells_what_was_read(folder: Path) -> None:
    result = run(folder, "check", "twin.yaml", "--json")
    assert result.returncode == 0
    told = json.loads(result.stdout)
    assert (told["nodes"], told["elements"], told["sensors"]) == (2356, 1108, 120)


def test_bad_input_ends_with_two_and_names_the_line(folder: Path) -> None:
    text = (folder / "twin.yaml").read_text().replace("material: WING", "material: WIGN")
    (folder / "twin.yaml").write_text(text)
    result = run(folder, "update", "twin.yaml", "--no-prefect")
    assert result.returncode == 2
    said = one_paragraph(result)
    assert "did you mean WING?" in said
    assert "twin.yaml, line" in said


def test_a_missing_campaign_is_one_line(folder: Path) -> None:
    result = run(folder, "check", "none.yaml")
    assert result.returncode == 2
    assert "none.yaml cannot be read" in one_paragraph(result)


def test_errors_are_objects_for_machines_too(folder: Path) -> None:
    result = run(folder, "check", "none.yaml", "--json")
    told = json.loads(result.stdout)
    assert told["status"] == "failed"
    assert told["exit_code"] == result.returncode == 2


def test_a_missing_solver_ends_with_four_and_says_how_to_get_it(folder: Path) -> None:
    result = run(folder, "update", "twin.yaml", "--no-prefect", MODETUNE_CCX="no-such-ccx")
    assert result.returncode == 4
    assert "apt-get install calculix-ccx" in one_paragraph(result)


def test_a_store_that_cannot_be_written_ends_with_five(folder: Path) -> None:
    (folder / "file").write_text("")
    result = run(
        folder, "update", "twin.yaml", "--no-prefect", MODETUNE_STORE=str(folder / "file" / "store")
    )
    assert result.returncode == 5
    assert "MODETUNE_STORE" in one_paragraph(result)


@needs_ccx
def test_modes_prints_frequencies_rigid_modes_and_mass(folder: Path) -> None:
    result = run(folder, "modes", "twin.yaml", "--json", "--at", "E_wing=0.9")
    told = json.loads(result.stdout)
    assert result.returncode == 0
    assert told["rigid_modes"] == 6
    # Volumes of the published dimensions times 2,810 kg/m3: 14,750 cm3.
    assert told["mass_kg"] == pytest.approx(41.4475, rel=1e-5)
    assert told["frequencies_hz"][6] == pytest.approx(5.92 * 0.9**0.5, rel=0.01)


@needs_ccx
def test_a_deck_that_ccx_rejects_ends_with_four_and_names_the_line(folder: Path) -> None:
    (folder / "bad.inp").write_text(
        "*NODE\n1,0,0,0\n2,1,0,0\n3,1,1,0\n4,0,1,0\n5,0,0,1\n6,1,0,1\n7,1,1,1\n8,0,1,1\n"
        "*ELEMENT, TYPE=C3D8I, ELSET=BAR\n1,1,2,3,4,5,6,7,8\n*MATERIAL, NAME=ALU\n*ELASTIC\n"
        "71000., 0.3\n*SOLID SECTION, ELSET=BAR, MATERIAL=ALU\n*NSET, NSET=A\n1, 999\n*BOUNDARY\n"
        "NOSUCHSET, 1, 3\n"
    )
    (folder / "bad.csv").write_text("mode,1\nfrequency_hz,10\n")
    (folder / "bad.yaml").write_text(
        "name: bad\nmodel: {deck: bad.inp, solver: calculix, units: mm-t-s}\n"
        "test: {modes: bad.csv}\nparameters:\n"
        "  - {name: E, quantity: youngs_modulus, material: ALU}\n"
    )
    result = run(folder, "update", "bad.yaml", "--no-prefect")
    assert result.returncode == 4
    assert "bad.inp" in one_paragraph(result)


@needs_ccx
def test_finished_without_e1_ends_with_three(folder: Path) -> None:
    result = run(
        folder,
        "update",
        "thesis.yaml",
        "--no-prefect",
        "--json",
        "--set",
        COARSE,
        "--set",
        "update.e1.frequency=0.001",
        "--set",
        "report.page=false",
    )
    assert result.returncode == 3
    told = json.loads(result.stdout)
    assert told["status"] == "stationary"
    assert "e1 is not met" in told["reason"]


@pytest.fixture
def beam(folder: Path) -> str:
    """A campaign file for a bar of 24 lengths, five with a modulus of their own to be found."""
    places = {f"E{place}": place for place in (2, 6, 11, 16, 20)}
    true = [1.2 if place in places.values() else 1.0 for place in range(24)]
    frequencies = np.sqrt(native_eigenvalues(bar(true)[0], 6, folder / "true")) / 2 / np.pi
    (folder / "bar.inp").write_text(bar([1.0] * 24)[0])
    (folder / "bar.csv").write_text(
        "mode, 1, 2, 3, 4, 5, 6\nfrequency_hz, " + ", ".join(f"{f:.6f}" for f in frequencies)
    )
    (folder / "beam.yaml").write_text(
        "name: beam\nmodel: {deck: bar.inp, solver: calculix, units: mm-t-s}\n"
        "test: {modes: bar.csv}\nparameters:\n"
        + "".join(
            f"  - {{name: {name}, quantity: youngs_modulus, material: M{place}}}\n"
            for name, place in places.items()
        )
        + "update: {e1: {frequency: 1.0e-6}, e2: 0.0, max_iterations: 2}\n"
        "sensitivity: {method: finite_difference, step: 0.01}\nreport: {page: false}\n"
    )
    return "beam.yaml"


@needs_ccx
def test_a_killed_campaign_goes_on_and_ends_on_the_same_bits(
    folder: Path, beam: str, real_ccx: str
) -> None:
    arguments = ["update", beam, "--no-prefect", "--json"]
    plain = folder / "plain"
    plain.mkdir()
    whole = json.loads(run(folder, *arguments, MODETUNE_STORE=str(plain / "store")).stdout)
    assert (whole["solver_runs"]["modal"], whole["solver_runs"]["sensitivity"]) == (3, 10)
    store = folder / "killed-store"
    environment = {**os.environ, "MODETUNE_STORE": str(store), "MODETUNE_CCX": real_ccx}
    ran = 0
    for finished in (1, 4, 9):  # killed when the store holds so many results
        process = subprocess.Popen(
            [sys.executable, "-m", "modetune", *arguments],
            cwd=folder,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        wanted = partial(enough_results, store, finished)
        assert wait_for(wanted, 120.0)
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert wait_for(lambda: not ccx_processes(str(store)), 10.0), "an orphan ccx lives on"
        ran = len(list(store.glob("??/*.h5")))
    last = json.loads(run(folder, *arguments, MODETUNE_STORE=str(store)).stdout)
    assert last["parameters"] == whole["parameters"]
    assert last["modes"] == whole["modes"]
    told = ("verdict", "headline", "trust", "exit_code")
    assert [last[key] for key in told] == [whole[key] for key in told]
    counted = last["solver_runs"]
    assert counted["modal"] + counted["sensitivity"] == (
        whole["solver_runs"]["modal"] + whole["solver_runs"]["sensitivity"] - ran
    )


@needs_ccx
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_at_once_and_leaves_no_solver(
    folder: Path, number: signal.Signals, real_ccx: str
) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "modetune", "update", "twin.yaml", "--no-prefect"],
        cwd=folder,
        env={**os.environ, "MODETUNE_CCX": real_ccx},
        text=True,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        # A suite in the background ignores Ctrl-C, and so would this process.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    assert wait_for(lambda: ccx_processes(str(folder)), 60.0)
    process.send_signal(number)
    _, said = process.communicate(timeout=30.0)
    assert process.returncode == 130
    assert "the same command continues from there" in said
    assert "Traceback" not in said
    assert wait_for(lambda: not ccx_processes(str(folder)), 10.0)


@needs_ccx
def test_a_timeout_kills_the_solver_and_says_so(folder: Path, real_ccx: str) -> None:
    result = run(
        folder,
        "update",
        "thesis.yaml",
        "--no-prefect",
        "--set",
        "run={timeout_s: 0.5, retries: 0}",
        "--set",
        COARSE,
        MODETUNE_CCX=real_ccx,
    )
    assert result.returncode == 4
    assert "ran longer than 0.5 s" in one_paragraph(result)
    assert not ccx_processes(str(folder))


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 6 MB: room for the deck and the start of a matrix job."""
    place = tmp_path / "small"
    place.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=6m", "tmpfs", str(place)]
    if subprocess.run(mount, capture_output=True, check=False).returncode != 0:
        pytest.skip("a small file system can be mounted by root only")
    yield place
    subprocess.run(["umount", str(place)], check=True)


@needs_ccx
def test_a_full_disk_ends_with_five_and_harms_nothing(folder: Path, small_disk: Path) -> None:
    store = small_disk / "store"
    settings = [
        "--no-prefect",
        "--set",
        "run={parallel: 1, threads: 1}",
        "--set",
        COARSE,
        "--set",
        "model.eigensolver=solver",  # a job's folder with matrices is larger than the disk
        "--set",
        "report.page=false",
    ]
    good = run(folder, "update", "thesis.yaml", *settings, MODETUNE_STORE=str(store))
    assert good.returncode == 0, good.stderr
    kept = {path: path.read_bytes() for path in store.glob("??/*.h5")}
    result = run(folder, "update", "twin.yaml", *settings, MODETUNE_STORE=str(store))
    assert result.returncode == 5
    assert "is full" in one_paragraph(result)
    assert len(kept) == 2
    assert all(path.read_bytes() == data for path, data in kept.items())


@needs_ccx
def test_a_flow_run_shows_every_piece_and_what_e2_skipped(folder: Path, server_base: Path) -> None:
    served = {process.HOME_VARIABLE: str(server_base), "MODETUNE_NO_PREFECT": "0"}
    arguments = [
        "update",
        "thesis.yaml",
        "--json",
        "--set",
        COARSE,
        "--set",
        "update={step: weighted_least_squares, e2: 0.5, step_limit: 0.03, "
        "max_iterations: 3, e1: {frequency: 0.0001}}",
        "--set",
        "sensitivity={method: finite_difference, between: keep}",
    ]
    result = run_process(folder, *arguments, **served)
    assert result.returncode == 3, result.stderr
    told = json.loads(result.stdout)
    assert told["sensitivity_skipped"] >= 1
    assert "prefect" not in result.stderr.lower()
    again = json.loads(run_process(folder, *arguments, **served).stdout)
    assert again["solver_runs"]["modal"] == 0
    home = process.machine_home(server_base)
    assert process.read_address(home), "the second command did not find the first one's server"
    names = task_states(home)
    assert ("iteration 0 / modal", "Completed") in names
    assert ("iteration 0 / modal", "Cached") in names
    assert ("iteration 0 / sensitivity E_wing", "Completed") in names
    assert any(state == "Skipped" and "sensitivity E_wing" in name for name, state in names)
    with h5py.File(folder / "runs" / "garteur-thesis" / "campaign.h5") as file:
        skipped = [bool(item.attrs["sensitivity_skipped"]) for item in file["iterations"].values()]
    assert np.sum(skipped) == told["sensitivity_skipped"]


def task_states(home: Path) -> set[tuple[str, str]]:
    """Names and states of all task runs that the shared server of a home knows."""
    found: set[tuple[str, str]] = set()
    for _ in range(100):  # the server writes task runs in batches
        runs = api_of(home).post("/task_runs/filter", {"limit": 200})
        found = {(item["name"], item["state_name"]) for item in runs}
        ended = {"Completed", "Cached", "Derived", "Skipped"}
        states = {state for _, state in found}
        if len(runs) >= 20 and "Cached" in states and states <= ended:  # of both commands
            return found
        time.sleep(0.1)
    return found
