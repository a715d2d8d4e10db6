"""What docs/platforms.md says of Windows and macOS, as far as it can be tried without them."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path, PurePosixPath

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: What these systems lack of Linux. `os.statvfs` stays, as `shutil` has its own way on Windows.
LACKS = {
    "windows": {
        "modules": ["fcntl", "resource", "pwd", "grp", "termios"],
        "os": ["fork", "forkpty", "getuid", "geteuid", "getgid", "killpg", "setsid", "getpgid",
               "sched_getaffinity", "sysconf", "O_NONBLOCK", "O_NOFOLLOW", "O_DIRECTORY",
               "O_CLOEXEC", "mkfifo", "posix_fadvise", "getloadavg"],
    },
    "macos": {"modules": [], "os": ["sched_getaffinity", "posix_fadvise"]},
}  # fmt: skip
WORK = """
import os, sys
import asyncio, concurrent.futures, multiprocessing, random, shutil, subprocess, tempfile
lacks, platform = {lacks!r}, {platform!r}
sys.modules.update(dict.fromkeys(lacks["modules"]))
for name in lacks["os"]:
    if hasattr(os, name):
        delattr(os, name)

import numpy as np
import modetune
import modetune.core.machine
assert "fcntl" not in lacks["modules"] or sys.modules["fcntl"] is None
if platform == "macos":  # it has fork, and no supervisor of ours
    modetune.core.machine.sys = type("sys", (), {{"platform": "darwin"}})

def chain(k1, k2):
    return np.array([[k1 + k2, -k2], [-k2, k2]]), np.eye(2)

eigenvalues, shapes = np.linalg.eigh(chain(900.0, 1000.0)[0])
test = {{"frequencies_hz": np.sqrt(eigenvalues) / 2 / np.pi, "mode_shapes": shapes,
        "dofs": ["1.x", "2.x"]}}
for version in ("1", "1"):
    run = modetune.update(model=chain, test=test, version=version, name="chain", prefect=True,
                          parameters={{"k1": 1000.0, "k2": 1000.0}})
    print(run.converged, run.record.runs.modal > 0, (run.folder / "report.html").is_file())
print(len(modetune.read_record(run.folder).modes))
print(modetune.read_test({measured!r}).modes.modes.n_modes)
from modetune.core.measurement.measurement import MeasuredFrfs
hz, roots, one = np.arange(1.0, 12.0, 0.02), np.sqrt(eigenvalues), np.ones(2, dtype=np.int64)
lines = 2.0 * np.pi * hz[:, None]
values = sum(
    shapes[:, mode] * shapes[0, mode] / (root**2 - lines**2 + 0.02j * root * lines)
    for mode, root in enumerate(roots)
)
frfs = MeasuredFrfs("receptance", hz, values, np.arange(1, 3), one, np.ones(2), one, one,
                    np.ones(2), np.zeros((0, 0)))
found = modetune.identify(frfs, (1.5, 11.0), 20)
print(found.modes.modes.frequencies_hz.round(3).tolist())
try:
    modetune.modes({campaign!r})
except modetune.ModetuneError as error:
    print(error)
"""


@pytest.mark.parametrize("platform", LACKS)
def test_functions_are_updated_and_tests_read_without_what_linux_has(
    platform: str, tmp_path: Path
) -> None:
    six_mass = ROOT / "configs" / "six_mass"
    text = WORK.format(
        lacks=LACKS[platform],
        platform=platform,
        measured=str(six_mass / "measured.csv"),
        campaign=str(six_mass / "campaign.yaml"),
    )
    environment = {name: text for name, text in os.environ.items() if name != "MODETUNE_NO_PREFECT"}
    done = subprocess.run(
        [sys.executable, "-c", text],
        cwd=tmp_path,
        env={
            **environment,
            "USERNAME": "somebody",
            "MODETUNE_HOME": str(tmp_path / "home"),
            "MODETUNE_STORE": str(tmp_path / "store"),
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    first, second, record, test, identified, refused = done.stdout.splitlines()
    assert (first, second) == ("True True True", "True False True")  # stored under a lease
    assert (record, test) == ("2", "3")
    # eigenvalues 1450 -+ root(1450^2 - 900,000), (rad/s)^2
    assert identified == "[2.992, 8.032]"
    assert refused.startswith("`")
    assert "modetune runs it on Linux only; on Windows use WSL 2" in refused


def test_names_of_files_are_possible_on_windows() -> None:
    done = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True)
    paths = [PurePosixPath(line) for line in done.stdout.splitlines()]
    assert len(paths) > 1000
    reserved = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)
    wrong = [
        path
        for path in paths
        if re.search(r'[<>:"|?*\\]|[. ]$', str(path))
        or any(reserved.fullmatch(part) for part in path.parts)
        or len(str(path)) > 160  # of 260 with the folder of the clone
    ]
    assert wrong == []
    assert [name for name, n in Counter(str(path).lower() for path in paths).items() if n > 1] == []
