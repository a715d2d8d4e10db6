"""Campaigns on a solver that fails at random, for as long as one likes.

The campaigns and what must hold of them are those of tests/flows/jobs/test_faults.py, larger
(central differences, about 100 jobs each) and with other seeds. Each turn runs two campaigns that
want the same jobs at the same time, then the same campaign on a sound solver; it ends with an
error at the first orphan process, damaged entry, wrong answer or job that ran again after success.

    python -m benchmarks.soak [--campaigns 500] [--seed 1000]
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.flows.jobs.test_faults import pair_of_campaigns


def main() -> None:
    """Run the soak and tell how the campaigns ended."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--campaigns", type=int, default=500)
    parser.add_argument("--seed", type=int, default=1000)
    chosen = parser.parse_args()
    logging.getLogger("modetune").setLevel(logging.CRITICAL)
    total: Counter[str] = Counter()
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="modetune-soak-") as folder:
        os.environ["MODETUNE_HOME"] = str(Path(folder) / "home")
        for turn in range(chosen.campaigns // 2):
            total += pair_of_campaigns(Path(folder) / str(turn), chosen.seed + turn, larger=2)
            wall_s = time.monotonic() - started
            sys.stdout.write(f"{2 * turn + 2} campaigns, {wall_s:.0f} s: {dict(total)}\n")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
