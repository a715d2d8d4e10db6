"""`python -m modetune.adapters.matrices` is the embedded solver."""

import sys
from pathlib import Path

from modetune.adapters.matrices.program import run_job

sys.exit(run_job(Path.cwd(), sys.stdout))
