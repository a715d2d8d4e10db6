"""The embedded solver's program: solves the job in the folder it is started in."""

import sys
from pathlib import Path

from modetune.adapters.matrices.job import run_job

sys.exit(run_job(Path.cwd(), sys.stdout))
