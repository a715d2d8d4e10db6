"""Solver jobs on the warm workers of a Dask cluster: how much of their time they work.

A program that sleeps stands for the solver of a chain of three masses; its reader finds the modes.
`modetune screen --method lhs` runs a design of 1,000 points on the most workers, and of eight a
worker on half as many, and so on down to one; `--method sobol` another of ten a worker on the
most. All workers are started before, and have run a job. The efficiency is

    jobs x seconds asleep / (workers x wall time of the command),

so the command's start, its tables, the lone job of the first model and idle workers in the last
round count against it. The milliseconds of a job are all that, less full rounds of sleep.

    python -m benchmarks.scale_out [--most 32] [--sleep 20] [--points 1000] [--prefect]

Finished pieces are kept in runs/nightly/scale-out.jsonl. The last line of the output is one JSON
object.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from importlib import import_module
from pathlib import Path

from benchmarks.journal import FOLDER, Journal
from benchmarks.ways import ServerUse, importing, modetune, prefect_server, told

from modetune.core.errors import ModetuneError

#: Points that each worker computes in the smaller designs.
EACH = 8
#: Points that Sobol indices of the chain take.
LEAST = 40
#: Seconds that all workers have to start.
START_S = 300.0
CAMPAIGN = """\
name: sleepers
model:
  deck: chain.txt
  solver: command
  units: m-kg-s
  command:
    run: [sleep, "{sleep:g}"]
    version: "1"
    most_modes: 3
    reader: chain_modes.py:modes
    nodes: nodes.csv
    components: [x]
test: {{modes: measured.csv}}
residuals: {{shape_weight: 0.0}}
parameters:
  - {{name: k1, quantity: number, bounds: [0.5, 2.0]}}
  - {{name: k2, quantity: number, bounds: [0.5, 2.0]}}
  - {{name: k3, quantity: number, bounds: [0.5, 2.0]}}
run:
  engine: dask
  parallel: {workers}
  dask: {{scheduler: "{scheduler}", workers: {workers}}}
store: store
"""
READER = """\
import numpy as np

def modes(folder):
    k1, k2, k3 = map(float, (folder / "chain.txt").read_text().split())
    stiffness = [[k1 + k2, -k2, 0.0], [-k2, k2 + k3, -k3], [0.0, -k3, k3]]
    eigenvalues, shapes = np.linalg.eigh(stiffness)
    return np.sqrt(eigenvalues) / (2.0 * np.pi), shapes, np.array([1, 2, 3]), np.array([1, 1, 1])
"""


def write_campaign(folder: Path, workers: int, scheduler: str, sleep: float) -> Path:
    """Write the chain with its program that sleeps so many seconds, and return its campaign."""
    folder.mkdir()
    (folder / "chain.txt").write_text("{k1=1000.0} {k2=1500.0} {k3=1200.0}\n")
    (folder / "chain_modes.py").write_text(READER)
    (folder / "nodes.csv").write_text("node,x,y,z\n1,1,0,0\n2,2,0,0\n3,3,0,0\n")
    (folder / "measured.csv").write_text("mode,1,2,3\nfrequency_hz,2.5,6.9,10.1\n")
    place = folder / "campaign.yaml"
    place.write_text(CAMPAIGN.format(workers=workers, scheduler=scheduler, sleep=sleep))
    return place


@contextmanager
def cluster(workers: int, folder: Path) -> Iterator[str]:
    """A Dask scheduler on loopback with so many worker processes; its address."""
    folder.mkdir()
    told_in = folder / "scheduler.json"
    dask = [sys.executable, "-m", "dask", "scheduler", "--host", "127.0.0.1"]
    dask += ["--port", "0", "--dashboard-address", "127.0.0.1:0"]
    dask += ["--scheduler-file", str(told_in)]
    started = [_start(dask, folder, "scheduler")]
    worker = [sys.executable, "-m", "dask", "worker"]
    worker += ["--scheduler-file", str(told_in), "--host", "127.0.0.1", "--no-dashboard"]
    worker += ["--nworkers", str(workers), "--nthreads", "1", "--memory-limit", "0"]
    worker += ["--local-directory", str(folder)]
    try:
        started.append(_start(worker, folder, "workers"))
        with import_module("distributed").Client(
            scheduler_file=str(told_in), timeout=START_S
        ) as client:
            client.wait_for_workers(workers, timeout=START_S)
            address: str = client.scheduler.address
        yield address
    finally:
        for process in reversed(started):
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def _start(command: Sequence[str], folder: Path, name: str) -> subprocess.Popen[bytes]:
    with (folder / f"{name}.log").open("wb") as log:
        return subprocess.Popen(
            command, cwd=folder, stdout=log, stderr=log, start_new_session=True, env=importing()
        )


def measure(
    workers: int, method: str, points: int, sleep: float, server: ServerUse
) -> dict[str, float]:
    """Jobs and wall seconds of a design on warm workers, and seconds when repeated."""
    with tempfile.TemporaryDirectory(prefix="modetune-scale-") as name:
        folder = Path(name)
        home = folder / "home"
        with prefect_server(server, home), cluster(workers, folder / "cluster") as scheduler:
            warm = write_campaign(folder / "warm", workers, scheduler, 0.1)
            screen(warm, "lhs", max(2 * workers, EACH), home, "none")
            place = write_campaign(folder / "measured", workers, scheduler, sleep)
            jobs, wall_s = screen(place, method, points, home, server)
            none, again_s = screen(place, method, points, home, server)
    assert none == 0
    return {"jobs": jobs, "wall_s": wall_s, "again_s": again_s}


def screen(
    place: Path, method: str, points: int, home: Path, server: ServerUse
) -> tuple[int, float]:
    """Run a screening; how many jobs it ran, and its wall seconds."""
    words = ["screen", str(place), "--method", method, "--points", str(points)]
    ended = modetune(words, place.parent, home, server)
    answer = told(ended, f"screening with {method}")
    runs = answer["solver_runs"]
    return runs["modal"] + runs["sensitivity"], ended.cost.wall_s


def main(arguments: list[str] | None = None) -> None:
    """Measure from the most workers down, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--most", type=int, default=32, help="the largest number of workers")
    parser.add_argument("--sleep", type=float, default=20.0, help="seconds of a job")
    parser.add_argument("--points", type=int, default=1000, help="on the most workers")
    parser.add_argument("--prefect", action="store_true", help="as tasks on a Prefect server")
    chosen = parser.parse_args(arguments)
    server: ServerUse = "running" if chosen.prefect else "none"
    designs = [
        (chosen.most, "lhs", chosen.points),
        (chosen.most, "sobol", max(10 * chosen.most, LEAST)),
    ]
    workers = chosen.most // 2
    while workers:
        designs.append((workers, "lhs", EACH * workers))
        workers //= 2
    heads = "workers", "method", "jobs", "s", "efficiency", "ms a job", "again, s"
    sys.stdout.write(f"| {' | '.join(heads)} |\n|{' --- |' * len(heads)}\n")
    with closing(Journal(FOLDER / "scale-out.jsonl", vars(chosen))) as journal:
        for workers, method, points in designs:
            piece = f"{workers} {method}"
            if piece not in journal.results:
                journal.add(piece, measure(workers, method, points, chosen.sleep, server))
            sys.stdout.write(line(workers, method, journal.results[piece], chosen.sleep) + "\n")
            sys.stdout.flush()
        journal.end()
    sys.stdout.write(json.dumps(journal.results) + "\n")


def line(workers: int, method: str, found: Mapping[str, float], sleep: float) -> str:
    """A row of the table."""
    jobs, wall_s = found["jobs"], found["wall_s"]
    efficiency = jobs * sleep / (workers * wall_s)
    beyond = wall_s - math.ceil(jobs / workers) * sleep
    return (
        f"| {workers} | {method} | {jobs:.0f} | {wall_s:.1f} | {efficiency:.3f} | "
        f"{1e3 * beyond / jobs:.0f} | {found['again_s']:.1f} |"
    )


if __name__ == "__main__":
    try:
        main()
    except ModetuneError as error:
        sys.exit(str(error))
