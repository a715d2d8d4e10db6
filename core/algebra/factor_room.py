"""Where the factors of a matrix have room: in memory, in single precision, or in files.

PARDISO states after its symbolic phase how much memory the factors will take. Added to what this
process holds and what its vectors will take, it fits or does not. If it does not, and
whoever asks can do with the factors of a similar matrix, half as much is taken in single precision.
Where that does not fit either MUMPS puts them in files, and the vectors go there with them. The
order of the unknowns is the same in all cases, and found once. Files of factors are written once a
factorisation and read twice a solution.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from shutil import disk_usage

from scipy import sparse

from modetune.core.algebra.elimination_order import elimination_order
from modetune.core.algebra.mumps import REMEDY, FactorFiles, Mumps, is_available
from modetune.core.algebra.pardiso import Pardiso
from modetune.core.errors import SolverExhausted
from modetune.core.machine import physical_memory
from modetune.core.modes import Integers

logger = logging.getLogger(__name__)

#: Number of vectors in files for each one in memory.
WORKED_ON = 4
#: Share of a machine's or container's memory that is used for planning: the rest is left to the
#: system and to other processes.
PLANNED = 0.9
#: Names the memory that a program started by a campaign may take, bytes.
MEMORY_VARIABLE = "MODETUNE_MEMORY_BYTES"
#: Limits of the container that this process is in (control groups, versions 2 and 1), bytes.
CONTAINER = ("memory.max", "memory.limit_in_bytes")


@dataclass(frozen=True, slots=True)
class FactorRoom:
    """What factors may take.

    memory_bytes: of this process, all that it holds; disk_bytes: of files; files: makes an empty
    folder for the files of one matrix, with what removes it; memory_key, disk_key: what users call
    both limits; single: factors in single precision wherever they will do, nowhere, or (None) where
    those in double precision do not fit in memory.
    """

    memory_bytes: int
    disk_bytes: int
    files: Callable[[], FactorFiles]
    memory_key: str = "the limit of memory"
    disk_key: str = "the limit of disk"
    single: bool | None = None


_room: ContextVar[FactorRoom | None] = ContextVar("factor_room", default=None)


@contextmanager
def factor_room(room: FactorRoom) -> Iterator[None]:
    """Within this context, and in this thread only, factors take no more than this room."""
    token = _room.set(room)
    try:
        yield
    finally:
        _room.reset(token)


def roomy_factors(
    upper: sparse.csr_array, *, matching: bool = False, columns: int = 0, similar: int | None = None
) -> Pardiso | Mumps:
    """A matrix with its unknowns ordered, for factors in memory or in files.

    upper, matching: as for `Pardiso`; columns: vectors (n,) that will be in memory with the
    factors; similar: the same where the factors are those of a similar matrix, None where these
    will not do. Raises as `Pardiso` does, SolverExhausted where neither memory nor disk suffices.
    """
    room = _room.get()
    ordered = _ordered(upper, matching)
    if room is None:
        return ordered.in_memory(single=False)
    factors, text = _roomy(ordered, columns, similar, room)
    if factors.held:
        logger.info("%s", text)
    return factors


def factor_forecast(
    upper: sparse.csr_array, columns: int, similar: int | None, room: FactorRoom
) -> tuple[bool, str]:
    """Whether factors go to disk, and what they take, in words; the unknowns are only ordered.

    Raises as `roomy_factors` does.
    """
    factors, text = _roomy(_ordered(upper), columns, similar, room)
    factors.close()
    return isinstance(factors, Mumps), text


@dataclass(frozen=True, slots=True)
class _Ordered:
    """A matrix with the order of its unknowns, the same wherever its factors go; with matching
    PARDISO finds its own."""

    upper: sparse.csr_array
    matching: bool
    order: Integers | None

    def in_memory(self, single: bool) -> Pardiso:
        return Pardiso(self.upper, matching=self.matching, single=single, order=self.order)

    def in_files(self, files: FactorFiles, single: bool) -> Mumps:
        order = elimination_order(self.upper) if self.matching else self.order
        return Mumps(self.upper, files, single=single, order=order)


def _ordered(upper: sparse.csr_array, matching: bool = False) -> _Ordered:
    return _Ordered(upper, matching, None if matching else elimination_order(upper))


def _roomy(
    ordered: _Ordered, columns: int, similar: int | None, room: FactorRoom
) -> tuple[Pardiso | Mumps, str]:
    held, single = _resident(), similar is not None and room.single is True
    factors = ordered.in_memory(single)
    told, vector = factors.memory, 8 * factors.n
    vectors, peak = vector * (similar or 0 if single else columns), told.peak
    text = (
        f"the factors of {factors.n} equations{factors.held} take {_gb(peak)}, in addition to "
        f"{_gb(held + vectors)} in memory, and {_gb(room.memory_bytes)} may be "
        f"taken ({room.memory_key}, or else what machine or container have)"
    )
    if held + vectors + peak <= room.memory_bytes:
        return factors, f"{text}: they stay in memory"
    factors.close()
    held = _resident()  # what ordering took may have gone back to the system by now
    if similar is not None and room.single is None:
        single, vectors, peak = True, vector * similar, told.single_peak
        text = f"{text}; in single precision {_gb(peak)}, in addition to {_gb(held + vectors)}"
        if held + vectors + peak <= room.memory_bytes:
            message = "these are used, and products in double precision give the same modes"
            return ordered.in_memory(True), f"{text}: {message}"
    if not is_available():
        raise SolverExhausted(
            f"{text}: on disk they require MUMPS, which is unavailable: {REMEDY}, or raise "
            f"{room.memory_key}"
        )
    files = room.files()
    try:
        in_files = ordered.in_files(files, single)
    except BaseException:
        files.remove()
        raise
    try:
        return in_files, _said_of_files(in_files, room, held + vectors // WORKED_ON, vectors, text)
    except SolverExhausted:
        in_files.close()
        raise


def _said_of_files(factors: Mumps, room: FactorRoom, beside: int, vectors: int, text: str) -> str:
    """Return the message on factors in files. Raises SolverExhausted if they do not fit there.

    beside, vectors: other data in memory, and vectors in files, in bytes.
    """
    least, disk = beside + factors.memory, factors.disk + vectors
    free = disk_usage(factors.files.folder).free
    if least > room.memory_bytes:
        raise SolverExhausted(
            f"{text}; with factors on disk too it is {_gb(least)}; raise {room.memory_key}, take a "
            "machine with more memory, a smaller model, or fewer modes"
        )
    if disk > room.disk_bytes:
        raise SolverExhausted(
            f"{text}; on disk they take up to {_gb(disk)}, more than the {_gb(room.disk_bytes)} of "
            f"{room.disk_key}; raise one of both"
        )
    if disk > free:
        raise SolverExhausted(
            f"{text}; on disk they take up to {_gb(disk)}, and the disk of {factors.files.folder} "
            f"has {_gb(free)}; free some space, or raise {room.memory_key}"
        )
    return (
        f"{text}: they go to disk, up to {_gb(disk)} below {factors.files.folder.parent}, written "
        "once a factorisation and read twice a solution"
    )


def machine_memory() -> int:
    """Memory that this machine or container lets processes have together, bytes, with some left
    for the system; or what a campaign gave to a program that it started."""
    if given := os.environ.get(MEMORY_VARIABLE):
        return int(given)
    limits = [physical_memory()]
    for folder in _control_groups(Path("/proc/self/cgroup"), Path("/sys/fs/cgroup")):
        limits += [limit for name in CONTAINER if (limit := _number(folder / name))]
    return int(PLANNED * min(limits))


def _control_groups(told: Path, root: Path) -> Iterator[Path]:
    """Folders of the groups that a process is in and of those above: each limits it."""
    try:
        lines = told.read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, kinds, path = line.split(":", 2)
        if kinds in ("", "memory"):
            group = Path(path.lstrip("/"))
            for part in (group, *group.parents):
                yield root / kinds / part


def _number(path: Path) -> int | None:
    """The number in a file; None where there is none (`max`)."""
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return None


def _resident() -> int:
    """Memory that this process holds, bytes, without the files that it has mapped."""
    try:
        resident, mapped = map(int, Path("/proc/self/statm").read_text().split()[1:3])
    except OSError:
        return 0
    return (resident - mapped) * os.sysconf("SC_PAGE_SIZE")


def _gb(size: int) -> str:
    return f"{size / 1e9:.3g} GB"
