"""Studies of many sets over one plain run of the solver: screening, the posterior, several starts.

Each row is a study from an empty store in a process of its own, so that its peak of memory is its
own: `python -m benchmarks.many_sets FOLDER STUDY COUNT` prints it as one JSON object. FOLDER has
the campaign.yaml of a problem (`benchmarks/problem`), COUNT is of points, samples or starts.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, get_args

Study = Literal["morris", "sobol", "sample", "starts"]
#: Walkers of a posterior; as many steps as give the samples that were asked for.
WALKERS = 32


@dataclass(frozen=True, slots=True)
class ManySets:
    """What a study cost: wall and processor seconds of the process with its solver runs, peak
    memory of the process itself, and runs of the solver, matrix jobs included."""

    study: str
    count: int
    wall_s: float
    cpu_s: float
    peak_mb: float
    runs: int


#: Rows that `make bench` shows: study, count, and the mesh of the aircraft.
ROWS: tuple[tuple[Study, int, str], ...] = (
    ("morris", 500, "coarse"),
    ("morris", 500, "fine"),
    ("sample", 20_000, "fine"),
    ("starts", 1, "fine"),
    ("starts", 8, "fine"),
    ("morris", 5_000, "coarse"),
    ("sobol", 5_000, "coarse"),
    ("morris", 20_000, "coarse"),
)


def rows(folder: Path, size: str) -> list[ManySets]:
    """The rows of one mesh of the aircraft, whose problem is in a folder."""
    return [measured(folder, study, count) for study, count, mesh in ROWS if mesh == size]


def measured(folder: Path, study: Study, count: int) -> ManySets:
    """A study in a process of its own, from an empty store."""
    asked = [sys.executable, "-m", "benchmarks.many_sets", str(folder), study, str(count)]
    root = str(Path(__file__).resolve().parents[1])
    path = os.pathsep.join(filter(None, (root, os.environ.get("PYTHONPATH"))))
    done = subprocess.run(
        asked, capture_output=True, text=True, check=True, env={**os.environ, "PYTHONPATH": path}
    )
    return ManySets(**json.loads(done.stdout.splitlines()[-1]))


def run(folder: Path, study: Study, count: int, place: Path) -> int:
    """Carry a study out with its store in a place. Returns the solver's runs."""
    from modetune.flows.campaign.campaign import load_campaign
    from modetune.flows.studies.sample.running import SamplingRequest, sample_campaign
    from modetune.flows.studies.screen.running import ScreeningRequest, screen_campaign
    from modetune.flows.updating.starts import update_from_starts
    from modetune.flows.updating.updating import Unwatched

    settings = [f"store={place / 'store'}"]
    if study == "starts":
        settings += [f"update.starts={count}", "report.page=false"]
    campaign, watched = load_campaign(folder / "campaign.yaml", settings), Unwatched()
    if study == "starts":
        runs = update_from_starts(campaign, place / "run", watched).record.runs
    elif study == "sample":
        asked = SamplingRequest(walkers=WALKERS, steps=max(100, count // WALKERS))
        runs = sample_campaign(campaign, asked, watched).runs
    else:
        runs = screen_campaign(campaign, ScreeningRequest(study, points=count), watched).runs
    return runs.modal + runs.sensitivity


def main(folder: Path, study: Study, count: int) -> None:
    """Print what a study cost."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="modetune-sets-") as place:
        runs = run(folder, study, count, Path(place))
    wall_s = time.monotonic() - began
    own, others = (
        resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    cpu_s = sum(used.ru_utime + used.ru_stime for used in (own, others))
    found = ManySets(study, count, wall_s, cpu_s, own.ru_maxrss / 1024.0, runs)
    print(json.dumps(asdict(found)))  # noqa: T201 - what the process is for


if __name__ == "__main__":
    named = [study for study in get_args(Study) if study == sys.argv[2]]
    if not named:
        sys.exit(f"{sys.argv[2]}: expected one of {', '.join(get_args(Study))}")
    main(Path(sys.argv[1]), named[0], int(sys.argv[3]))
