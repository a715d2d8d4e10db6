"""All speeds of docs/benchmarks.md in one table.

    python -m benchmarks [--rows peer-coarse e2] [--rounds 1] [--large] [--quick] [--profile]

Each row is a ratio or a time, with the values it is computed from (rows.py). If a row fails, the
error is printed and the others continue. --large uses the launcher with a million degrees of
freedom and the aircraft with 1.5 million equations. --quick uses the smallest models and a target
that is soon met, unless a row has its own: it shows that everything runs, but not the speed. The
figures of an interrupted benchmark are in runs/nightly/bench.jsonl, and are not measured again.
--profile adds the time spent in each part of modetune's campaigns. The last line of the output is
one JSON object. Exit code 1: a row has failed.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import tempfile
from pathlib import Path
from typing import get_args

from benchmarks.cost import calculix
from benchmarks.journal import FOLDER, Journal
from benchmarks.plain import cores
from benchmarks.rows import ROWS, Bench, Round
from benchmarks.table import markdown, measure, time_table, told
from benchmarks.ways import ServerUse, prefect_server

from modetune.core.errors import ModetuneError


def main(arguments: list[str] | None = None) -> None:
    """Measure the requested rows and print them as Markdown and JSON."""
    parser = argparse.ArgumentParser(prog="benchmarks", description=__doc__.partition("\n")[0])
    names = [row.name for row in ROWS]
    parser.add_argument("--rows", nargs="+", choices=names, default=names, metavar="ROW")
    parser.add_argument("--rounds", type=int, default=1, help="of all rows; prints medians")
    parser.add_argument("--large", action="store_true", help="the largest models, 20 minutes more")
    parser.add_argument("--quick", action="store_true", help="the smallest models")
    parser.add_argument(
        "--profile", action="store_true", help="print the time in parts of modetune"
    )
    parser.add_argument(
        "--server",
        choices=get_args(ServerUse),
        default="running",
        help="Prefect's server: up, started by each campaign, none.",
    )
    chosen = parser.parse_args(arguments)
    if chosen.rounds < 1:
        parser.error("--rounds must be 1 or more")
    calculix()
    with tempfile.TemporaryDirectory(prefix="modetune-bench-") as name:
        bench = Bench(Path(name), chosen.server, chosen.quick, chosen.large, chosen.profile)
        with prefect_server(chosen.server, bench.folder / "home") as bench.within:
            rows = [row for row in ROWS if row.name in chosen.rows]
            rounds = [Round(bench, number) for number in range(1, chosen.rounds + 1)]
            plan = {**vars(chosen), "rows": [row.name for row in rows]}
            journal = Journal(FOLDER / "bench.jsonl", plan)
            found = measure(rows, rounds, journal)
            journal.end()
            journal.close()
    sys.stdout.write(f"{markdown(found)}\n")
    if bench.seconds:
        sys.stdout.write(f"\n{time_table(bench.seconds)}\n")
    result = {
        "cores": cores(),
        "machine": platform.machine(),
        "rounds": chosen.rounds,
        "quick": chosen.quick,
        "large": chosen.large,
        "server": chosen.server,
        "rows": told(found),
        "seconds": bench.seconds,
    }
    sys.stdout.write(json.dumps(result) + "\n")
    sys.stdout.flush()
    if any(item.error for item in found):
        sys.exit(1)


if __name__ == "__main__":
    try:
        main()
    except ModetuneError as error:
        sys.exit(str(error))
