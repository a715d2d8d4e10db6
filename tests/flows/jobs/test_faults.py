"""Campaigns on a solver that fails in every way it can, at random but seeded.

Each run of the scripted solver hangs, crashes, is killed, lies, writes half a file, gets no
licence, leaves a helper running or does its duty; what it does follows from the seed, the job's
key and the attempt, never from timing. The runs log themselves by key, so that what was run, and
what was run in vain, is counted and not believed.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from modetune.adapters.solver import Analysis, Command, Rendered, Solver
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import ModetuneError, NoResult, SolverError
from modetune.core.parameters import Values
from modetune.core.storage.campaign_record import CampaignRecord
from modetune.core.storage.store import Store
from modetune.core.updating.job_results import ModalResult, Result
from modetune.core.updating.sensitivity import ModeDerivatives
from modetune.flows.campaign.campaign import Campaign
from modetune.flows.campaign.schema import SensitivitySection
from modetune.flows.campaign.site import RetriesSection, RunSection
from modetune.flows.updating.update import update_campaign
from tests.core.storage.test_store import holdings
from tests.flows.conftest import Bench, ChainDeck, ScriptedProgram, Watcher, recased

ROOT = Path(__file__).resolve().parents[3]
CAMPAIGNS = 20
#: Generous: only a fault makes a test wait this long.
DEADLINE_S = 60.0
#: What a run does instead of its duty, and how often.
FAULTS = {
    "killed": 0.04, "crash": 0.03, "hang": 0.002, "deaf": 0.001, "silent": 0.03, "half": 0.03,
    "half_killed": 0.02, "few": 0.02, "nan": 0.02, "denied": 0.05, "slow": 0.02, "orphan": 0.02,
    "rejected": 0.002,
}  # fmt: skip
#: Runs that leave a result.
GOOD = frozenset({"good", "slow", "orphan"})
#: In every process that a run starts.
MARK = "MODETUNE_TEST_MARK"
PROGRAM = """#!/bin/sh
printf '%s %s\\n' "$2" "$1" >> "$3"
case $1 in
killed) kill -9 $$ ;;
crash) echo broken; exit 7 ;;
hang) exec sleep 600 ;;
deaf) trap '' TERM INT HUP; sleep 600; exit 0 ;;
silent) exit 0 ;;
half) echo 'END OF JOB'; printf 'modes 6\\nEND' > result; exit 0 ;;
half_killed) printf 'modes' > result; kill -9 $$ ;;
few) printf 'modes 2\\nEND\\n' > result; echo 'END OF JOB'; exit 0 ;;
denied) echo 'NO LICENCE'; exit 1 ;;
rejected) echo REJECTED; exit 1 ;;
slow) sleep 0.05 ;;
orphan) sleep 600 & ;;
esac
printf 'modes 6\\nEND\\n' > result
echo 'END OF JOB'
"""


@dataclass
class Script:
    """What the runs of each job do, by seed, key and attempt; and which jobs there were."""

    seed: int
    rates: dict[str, float]
    attempts: Counter[str] = field(default_factory=Counter)
    jobs: dict[str, tuple[Values, Analysis]] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def next(self, key: str, values: Values, analysis: Analysis) -> str:
        with self.lock:
            self.attempts[key] += 1
            self.jobs[key] = (dict(values), analysis)
            attempt = self.attempts[key]
        random = np.random.default_rng([self.seed, int(key[:12], 16), attempt])
        names = [*self.rates, "good"]
        rest = 1.0 - sum(self.rates.values())
        return str(random.choice(names, p=[*self.rates.values(), rest]))


@dataclass(frozen=True)
class FaultyProgram(ScriptedProgram):
    """The chain behind a program that does what the script says."""

    script: Script = field(default_factory=lambda: Script(0, {}))

    def render(self, deck: Values, analysis: Analysis) -> Rendered:
        def write(folder: Path) -> None:
            key = folder.name.partition(".")[0]
            # Decks are also written to be looked at, in folders of other names.
            behaviour = self.script.next(key, deck, analysis) if len(key) == 64 else "good"
            words = behaviour, key, str(self.folder / "runs.log")
            (folder / "job").write_text("\n".join(words))

        return Rendered(super().render(deck, analysis).content, write)

    def command(self, threads: int) -> Command:
        program = self.folder / "program"
        reader = (
            f'#!/bin/sh\n{{ read a; read b; read c; }} < job\nexec "{program}" "$a" "$b" "$c"\n'
        )
        start = self.folder / "start"
        if not start.exists():
            for path, text in ((program, PROGRAM), (start, reader)):
                part = path.with_suffix(f".{threading.get_ident()}")
                part.write_text(text)
                part.chmod(0o755)
                part.rename(path)
        return Command(("/bin/sh", str(start)), ((MARK, str(self.folder)),))

    def read(self, deck: Values, analysis: Analysis, folder: Path, return_code: int) -> Result:
        result = super().read(deck, analysis, folder, return_code)
        behaviour = (folder / "job").read_text().split("\n")[0]
        if behaviour == "nan":
            return spoilt(result)
        written = (folder / "result").read_text()
        if not written.endswith("END\n") or "modes 6" not in written:
            raise NoResult(f"{folder / 'result'} is not whole")
        return result


def spoilt(result: Result) -> Result:
    """The result with a number that is none."""
    if isinstance(result, MatrixResult):
        stiffness = result.upper_stiffness.copy()
        stiffness.data[0] = np.nan
        return replace(result, upper_stiffness=stiffness)
    assert isinstance(result, ModalResult | ModeDerivatives)
    eigenvalues = result.eigenvalues.copy()
    eigenvalues[0] = np.nan
    return replace(result, eigenvalues=eigenvalues)


def faulty_campaign(bench: Bench, script: Script, seed: int) -> Campaign:
    """A campaign of random size from the nominal chain to a random true one."""
    random = np.random.default_rng(seed)
    count = int(random.integers(2, 7))
    truth = {f"k{place}": float(random.uniform(0.8, 1.25)) for place in range(1, count + 1)}
    methods: list[Any] = ["finite_difference", "finite_difference", "semi_analytic", "solver"]
    sensitivity = SensitivitySection(
        method=methods[seed % 4],
        difference="central" if seed % 8 == 1 else "forward",
        step=0.005,
    )
    campaign = bench.campaign(
        truth, modes=(1, 2, 3, 4, 5, 6), shapes=seed % 3 == 0, sensitivity=sensitivity
    )
    solver = Solver(ChainDeck(), FaultyProgram(bench.folder, script=script))
    run = RunSection(
        parallel=2,
        timeout_s=2.0,
        retries=RetriesSection(stopped=4, timeout=1, no_result=4),
        licence_pause_s=0.005,
        licence_wait_s=30.0,
    )
    return recased(replace(campaign, name=f"chain{seed}", run=run), solver=solver)


def truth_of(campaign: Campaign) -> list[float]:
    random = np.random.default_rng(int(campaign.name.removeprefix("chain")))
    return [float(random.uniform(0.8, 1.25)) for _ in range(int(random.integers(2, 7)))]


def ends(campaign: Campaign, folder: Path) -> CampaignRecord | ModetuneError:
    """A campaign's record, or the error it was refused with; anything else is a fault of ours."""
    try:
        return update_campaign(campaign, folder, Watcher()).record
    except ModetuneError as error:
        return error


def is_right(campaign: Campaign, end: CampaignRecord | ModetuneError) -> bool:
    """Whether a campaign ended with the true values, or refused by a sentence of its solver's."""
    if isinstance(end, ModetuneError):
        return (isinstance(end, SolverError) and "scripted" in str(end)) or "result" in str(end)
    if end.status != "converged":
        return bool(end.reason)
    return bool(np.allclose(end.updated, truth_of(campaign), rtol=1e-4))


def runs_of(folder: Path) -> dict[str, list[str]]:
    """What the runs of each key did, in order."""
    runs: dict[str, list[str]] = {}
    log = folder / "runs.log"
    for line in log.read_text().splitlines() if log.exists() else ():
        key, behaviour = line.split()
        runs.setdefault(key, []).append(behaviour)
    return runs


def marked(folder: Path) -> list[int]:
    """Living processes that a run of this folder's solver started."""
    mark, found = f"{MARK}={folder}".encode(), []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                if mark in (entry / "environ").read_bytes().split(b"\0"):
                    found.append(int(entry.name))
            except OSError:
                continue
    return found


def assert_nothing_is_left(folder: Path) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while marked(folder):  # killed ones take a breath to go
        assert time.monotonic() < deadline, f"processes {marked(folder)} were left behind"
        time.sleep(0.02)


def assert_store_is_sound(folder: Path, script: Script) -> int:
    """Every entry whole and the right answer, nothing half written; returns how many there are."""
    store = Store(folder / "store")
    assert not (store.folder / "damaged").exists()
    assert not list(store.folder.glob("**/*.part"))
    honest, keys = ScriptedProgram(folder), [holding.key for holding in holdings(store)]
    (folder / "solver.log").write_text("END OF JOB")
    for key in keys:
        entry = store.get(key)
        assert entry is not None
        if key in script.jobs:  # not what was derived from results
            values, analysis = script.jobs[key]
            assert_same(entry.result, honest.read(values, analysis, folder, 0))
    return len(keys)


def assert_same(found: Result, expected: Result) -> None:
    if isinstance(expected, MatrixResult):
        assert isinstance(found, MatrixResult)
        np.testing.assert_array_equal(found.stiffness.toarray(), expected.stiffness.toarray())
        return
    assert isinstance(expected, ModalResult | ModeDerivatives)
    assert isinstance(found, ModalResult | ModeDerivatives)
    np.testing.assert_array_equal(found.eigenvalues, expected.eigenvalues)


def assert_nothing_ran_in_vain(folder: Path, store: Store) -> None:
    for key, behaviours in runs_of(folder).items():
        good = [place for place, behaviour in enumerate(behaviours) if behaviour in GOOD]
        assert len(good) <= 1, f"{key} ran again after it had succeeded: {behaviours}"
        assert not good or good[0] == len(behaviours) - 1, behaviours
        assert (key in store) == bool(good)


def pair_of_campaigns(folder: Path, seed: int) -> Counter[str]:
    """Two campaigns that want the same jobs at the same time, and then again on a sound solver.

    Asserts what must hold of each; returns how they ended, and counts of jobs and runs.
    """
    folder.mkdir()
    bench = Bench(folder)
    bench.script({})
    script = Script(seed, FAULTS)
    campaign = faulty_campaign(bench, script, seed)
    with ThreadPoolExecutor(2) as pool:
        folders = [folder / name for name in ("first", "second")]
        both = list(pool.map(ends, [campaign] * 2, folders))
    assert_nothing_is_left(folder)
    assert all(is_right(campaign, end) for end in both), both
    jobs = assert_store_is_sound(folder, script)
    assert_nothing_ran_in_vain(folder, campaign.store)
    script.rates = {}
    again = ends(campaign, folder / "again")
    assert isinstance(again, CampaignRecord), again
    assert again.status == "converged"
    assert is_right(campaign, again)
    assert_nothing_ran_in_vain(folder, campaign.store)
    count = Counter({"jobs": jobs, "runs": sum(map(len, runs_of(folder).values()))})
    for end in both:
        count[end.status if isinstance(end, CampaignRecord) else type(end).__name__] += 1
    return count


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MODETUNE_HOME", str(tmp_path / "home"))
    return


def test_every_campaign_on_a_faulty_solver_ends_right_and_leaves_nothing(tmp_path: Path) -> None:
    total: Counter[str] = Counter()
    for seed in range(CAMPAIGNS // 2):
        total += pair_of_campaigns(tmp_path / str(seed), seed)
    assert total["runs"] > total["jobs"] > 0, "no fault was injected"
    assert total["converged"] >= 0.8 * CAMPAIGNS, total


DRIVER = """
import sys
from pathlib import Path
from tests.flows.conftest import Bench
from tests.flows.jobs.test_faults import FAULTS, Script, ends, faulty_campaign
folder = Path(sys.argv[1])
script = Script(int(sys.argv[2]), {**FAULTS, "rejected": 0.0})
end = ends(faulty_campaign(Bench(folder), script, 5), folder / "run")
print(getattr(end, "status", end), flush=True)
"""


def start(folder: Path, seed: int) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-c", DRIVER, str(folder), str(seed)],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )


def wait_for(condition: Callable[[], bool], process: subprocess.Popen[bytes]) -> bool:
    """Wait for a condition, or the end of a process; whether the condition came first."""
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        if process.poll() is not None:
            return False
        assert time.monotonic() < deadline, "nothing happened"
        time.sleep(0.005)
    return True


def test_a_campaign_killed_again_and_again_repeats_no_finished_job(tmp_path: Path) -> None:
    store, kills = Store(tmp_path / "store"), 0
    while True:
        process = start(tmp_path, kills)
        goal = 12 + sum(map(len, runs_of(tmp_path).values()))
        if not wait_for(lambda: sum(map(len, runs_of(tmp_path).values())) >= goal, process):  # noqa: B023  # the condition lives in this turn
            break
        process.send_signal(signal.SIGKILL)
        process.communicate()
        kills += 1
        assert_nothing_is_left(tmp_path)
        assert kills < 60
    said, errors = process.communicate()
    assert said.decode().strip() == "converged", errors.decode()
    assert kills >= 2
    for key, behaviours in runs_of(tmp_path).items():
        good = [behaviour for behaviour in behaviours if behaviour in GOOD]
        # A solver may have ended well just when modetune was killed, before its result was kept.
        assert len(good) <= 1 + kills, behaviours
        assert key in store
        assert store.get(key) is not None
    assert not (store.folder / "damaged").exists()


@pytest.mark.parametrize("fault", [name for name in FAULTS if name not in ("slow", "orphan")])
def test_a_solver_that_never_does_its_duty_is_refused_in_a_sentence(
    tmp_path: Path, fault: str
) -> None:
    bench = Bench(tmp_path)
    campaign = faulty_campaign(bench, Script(1, {fault: 1.0}), 1)
    run = replace_run(campaign.run, timeout_s=0.2, licence_wait_s=0.02)
    end = ends(replace(campaign, run=run), tmp_path / "run")
    assert isinstance(end, SolverError)
    assert str(tmp_path) in str(end)
    assert_nothing_is_left(tmp_path)
    assert not list(campaign.store.folder.glob("??/*.h5"))


def replace_run(run: RunSection, **changes: Any) -> RunSection:
    return run.model_copy(update=changes)
