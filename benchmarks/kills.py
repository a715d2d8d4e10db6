"""Workers, runs, servers and whole machines killed under deployed campaigns, round after round.

Each round starts a worker and a run that is under way, kills what the round is named for, starts
another worker and waits: the run must be known to have crashed, its slot be free, the next run that
is due start, once, and come to its end. Where the server alone is killed the run must go on and its
end be known. What must hold is in tests/flows/server/test_worker.py; the first that does not ends
the benchmark. A line a round: what was killed, and seconds until it was known.

    python -m benchmarks.kills [--rounds 20]
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

from tests.flows.server.test_worker import (
    POSTER,
    RUN,
    SERVER,
    WORKER,
    Site,
    killed_round,
    killed_server_round,
)

from modetune.flows.jobs.prefect_server import stop_server

#: What is killed at one blow, in turn.
BLOWS = {
    "worker and run": (WORKER, RUN),
    "machine, server elsewhere": (WORKER, RUN, POSTER),
    "machine with its server": (WORKER, RUN, POSTER, *SERVER),
    "server": (),
}


def main() -> None:
    """Run the rounds and tell how long each took."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--rounds", type=int, default=20)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="modetune-kills-") as folder:
        site = Site(Path(folder))
        try:
            for number in range(chosen.rounds):
                name = list(BLOWS)[number % len(BLOWS)]
                began = time.monotonic()
                if BLOWS[name]:
                    known_s = killed_round(site, *BLOWS[name])
                else:
                    killed_server_round(site)
                    known_s = time.monotonic() - began
                sys.stdout.write(f"{number + 1:3d}  {name:26}  known after {known_s:5.1f} s\n")
                sys.stdout.flush()
        finally:
            site.kill(WORKER, RUN, POSTER)
            stop_server(site.home)


if __name__ == "__main__":
    main()
