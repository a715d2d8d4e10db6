"""Where the wall time of a command of modetune goes.

A thread of the process looks at what all its threads do, 50 times a second. A look goes to the
first line of PARTS that any thread is in, work of this process before waiting for CalculiX; the
thread's innermost frame of modetune decides, and what it is in the middle of importing counts as
importing. Time before the first look is that of Python's start.

    python -m benchmarks.time_spent update campaign.yaml ...

runs the command and leaves profile.json in the working folder: seconds by part.
"""

from __future__ import annotations

import atexit
import json
import os
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

PERIOD_S = 0.02
FILE = "profile.json"
IMPORTING, START, REST = "importing", "start of Python", "rest"
#: What is done, and the files of modetune in which it is.
PARTS = (
    (
        "factorisation",
        ("core/algebra/pardiso.py", "core/algebra/mumps.py", "core/algebra/factorisation.py"),
    ),
    ("modes from matrices", ("core/algebra/",)),
    ("reduced models", ("core/updating/reduced_basis.py", "core/updating/derivative_vectors.py")),
    ("parameter matrices", ("core/updating/parameter_matrices.py",)),
    ("report", ("flows/report/", "flows/server/artifacts.py")),
    ("reading results", ("adapters/calculix/", "adapters/matrices/", "adapters/nastran/")),
    ("store and record", ("core/storage/",)),
    ("pairing, steps", ("core/correlation/", "core/updating/")),
    ("solver's jobs", ("adapters/process.py",)),
    ("Prefect", ("flows/jobs/prefect", "flows/server/")),
    ("rest", ("",)),
)
ORDER = [START, IMPORTING, *(name for name, _ in PARTS)]
PACKAGE = f"{os.sep}modetune{os.sep}"


def frames(innermost: FrameType | None) -> Iterator[str]:
    """The files of a thread's frames, innermost first."""
    while innermost is not None:
        yield innermost.f_code.co_filename
        innermost = innermost.f_back


def part(innermost: FrameType) -> str:
    """What a thread does."""
    files = list(frames(innermost))
    for file in files:
        if "importlib._bootstrap" in file:
            return IMPORTING
        _, inside, place = file.rpartition(PACKAGE)
        if inside:
            return next(name for name, starts in PARTS if place.startswith(starts))
    return REST


def of_all_threads() -> str:
    """What the process does: the first of ORDER that a thread is in."""
    own = threading.get_ident()
    found = {part(frame) for thread, frame in sys._current_frames().items() if thread != own}
    return min(found or {REST}, key=ORDER.index)


def age_s() -> float:
    """Seconds since this process was started."""
    ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
    since_boot = float(Path("/proc/uptime").read_text().split()[0])
    return since_boot - ticks / os.sysconf("SC_CLK_TCK")


def look(seconds: dict[str, float]) -> None:
    """Look until the process ends; the time since the last look goes to what is seen."""
    last = time.monotonic()
    while True:
        time.sleep(PERIOD_S)
        now = time.monotonic()
        seconds[of_all_threads()] += now - last
        last = now


def profiled(folder: Path) -> dict[str, float]:
    """Seconds by part, most first, of the command that was run in a folder."""
    told: dict[str, float] = json.loads((folder / FILE).read_text())
    return dict(sorted(told.items(), key=lambda item: -item[1]))


def main() -> None:
    """Run a command of modetune, and leave where its time went."""
    seconds = defaultdict(float, {START: age_s()})
    place = Path.cwd() / FILE
    atexit.register(lambda: place.write_text(json.dumps(dict(seconds))))
    threading.Thread(target=look, args=[seconds], daemon=True).start()
    from modetune.flows.cli.main import main as command

    command()


if __name__ == "__main__":
    main()
