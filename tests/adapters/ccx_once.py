"""CalculiX that solves each deck once a test session: the same files and log, the second time
copied.

Stands as `bin/ccx` of a session's folder, beside `real/ccx` and `solved/`. A deck counts as the
same when its text, the arguments and the number of threads are. What fails is never kept, and what
reads further files is not either. Standard library only, no site: it starts in some 20 ms.
In the test's own process `embedded.py` calls its functions.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys

SAID = "said"
#: Cards by which a deck's text is not all that counts.
READS_MORE = (b"*INCLUDE", b"*RESTART", b"*SUBMODEL")


def place_of(home: str, folder: str, arguments: list[str], threads: str | None) -> str | None:
    """Where results of a job are kept; nothing where they cannot be."""
    deck = f"{folder}/{arguments[-1].removesuffix('.inp')}.inp" if arguments else ""
    if not os.path.isfile(deck):  # noqa: PTH113  # pathlib takes 10 ms
        return None
    with open(deck, "rb") as file:  # noqa: PTH123
        text = file.read()
    if any(card in text.upper() for card in READS_MORE):
        return None
    asked = f"{arguments} {threads}\n".encode() + text
    return f"{home}/solved/{hashlib.sha256(asked).hexdigest()}"


def copied(place: str, folder: str) -> bytes | None:
    """What CalculiX said, its files in the folder; nothing where it did not solve this deck yet."""
    if not os.path.isdir(place):  # noqa: PTH112
        return None
    for entry in os.scandir(place):
        if entry.name != SAID:
            shutil.copyfile(entry.path, f"{folder}/{entry.name}")
    with open(f"{place}/{SAID}", "rb") as file:  # noqa: PTH123
        return file.read()


def keep(place: str, folder: str, before: dict[str, tuple[int, int]], said: bytes) -> None:
    """Keep what CalculiX wrote, where it came to a good end."""
    if b"Job finished" not in said or b"*ERROR" in said:
        return
    part = f"{place}.{os.urandom(6).hex()}"
    os.makedirs(part)  # noqa: PTH103
    for name, state in files(folder).items():
        if before.get(name) != state:
            shutil.copyfile(f"{folder}/{name}", f"{part}/{name}")
    with open(f"{part}/{SAID}", "wb") as file:  # noqa: PTH123
        file.write(said)
    try:
        os.rename(part, place)  # noqa: PTH104
    except OSError:  # another one was faster
        shutil.rmtree(part)


def files(folder: str) -> dict[str, tuple[int, int]]:
    """Size and time of change of each file of the job's folder but the log."""
    return {
        entry.name: (entry.stat().st_size, entry.stat().st_mtime_ns)
        for entry in os.scandir(folder)
        if entry.is_file() and entry.name != "solver.log"
    }


def main() -> int:
    home = os.path.dirname(os.path.dirname(os.path.abspath(sys.argv[0])))  # noqa: PTH100, PTH120
    real, arguments, folder = f"{home}/real/ccx", sys.argv[1:], os.getcwd()  # noqa: PTH109
    place = place_of(home, folder, arguments, os.environ.get("OMP_NUM_THREADS"))
    if place is None:
        os.execv(real, ["ccx", *arguments])
    said = copied(place, folder)
    if said is not None:
        sys.stdout.buffer.write(said)
        return 0
    before, said = files(folder), b""
    with subprocess.Popen([real, *arguments], stdout=subprocess.PIPE) as running:
        assert running.stdout is not None
        while block := os.read(running.stdout.fileno(), 1 << 16):
            os.write(1, block)
            said += block
    if running.returncode == 0:
        keep(place, folder, before, said)
    if running.returncode < 0:
        os.kill(os.getpid(), -running.returncode)
    return running.returncode


if __name__ == "__main__":
    sys.exit(main())
