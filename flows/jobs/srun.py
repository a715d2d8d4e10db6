"""Starts `srun` so that its job ends with it, however its campaign ends.

Run as a script, standard library only: `srun.py ARGUMENT...`. A campaign's programs are ended by
SIGKILL, of which srun learns nothing: a job that waits in Slurm's queue would start later, for
nobody, and hold its node. So srun stands in a process group of its own, and the kernel sends it
SIGTERM when this script ends; then it revokes its job, waiting or running.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys

PR_SET_PDEATHSIG, SIGTERM = 1, 15


def _end_with(parent: int) -> None:
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, SIGTERM)
    if os.getppid() != parent:  # it died before the kernel was told
        os._exit(1)


def main(arguments: list[str]) -> int:
    """Run srun to its end; its return code, as a shell tells it."""
    parent = os.getpid()
    ended = subprocess.run(
        ["srun", *arguments],
        check=False,
        start_new_session=True,
        preexec_fn=lambda: _end_with(parent),
    )
    return ended.returncode if ended.returncode >= 0 else 128 - ended.returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
