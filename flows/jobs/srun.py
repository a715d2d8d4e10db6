"""Runs `srun` so that its job ends with the campaign.

A script with the standard library only: `srun.py ARGUMENT...`. Campaigns stop programs by SIGKILL,
which srun cannot handle: its job would stay in Slurm's queue and start later without a campaign. So
srun gets its own process group, and the kernel sends it SIGTERM when this script ends; srun then
cancels its waiting or running job.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys

PR_SET_PDEATHSIG, SIGTERM = 1, 15


def _end_with(parent: int) -> None:
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, SIGTERM)
    if os.getppid() != parent:  # the parent died before prctl
        os._exit(1)


def main(arguments: list[str]) -> int:
    """Run srun and return its exit code, 128 + N after signal N as in a shell."""
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
