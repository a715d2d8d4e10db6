"""Nothing is written outside the home, the store, run folders and the outputs that a user names."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

SIX_MASS = Path(__file__).resolve().parents[3] / "configs" / "six_mass"
STRACE = shutil.which("strace")
#: Calls that make, change or move files; of opened files only those that are opened for writing.
CALLS = "openat,open,creat,mkdir,mkdirat,rename,renameat,renameat2,symlink,symlinkat,link,linkat"
OPENS = re.compile(r"\b(open|openat|creat)\(")
WRITES = re.compile(r"O_WRONLY|O_RDWR|O_CREAT|O_TRUNC|\bcreat\(")


@pytest.mark.skipif(STRACE is None, reason="strace is not here")
def test_an_update_and_a_screening_write_only_where_they_may(tmp_path: Path) -> None:
    for file in SIX_MASS.glob("*"):
        if file.suffix in (".yaml", ".csv"):
            shutil.copyfile(file, tmp_path / file.name)
    home, trace = tmp_path / "home", tmp_path / "trace"
    environment = {**os.environ, "MODETUNE_HOME": str(home), "PYTHONDONTWRITEBYTECODE": "1"}
    for words in (
        ("update", "campaign.yaml", "--set", "update.starts=1"),
        ("screen", "campaign.yaml", "--method", "local", "--out", "out.yaml", "--page", "p.html"),
    ):
        done = subprocess.run(
            [STRACE or "", "-f", "-y", "-qq", "--seccomp-bpf", "-e", f"trace={CALLS}",
             "-o", str(trace), "-e", "signal=none", "-A", sys.executable, "-m", "modetune", *words],
            cwd=tmp_path, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        if "ptrace" in done.stderr:
            pytest.skip(f"strace may not trace here: {done.stderr.splitlines()[0]}")
        assert done.returncode == 0, done.stderr
    named = [tmp_path / name for name in ("out.yaml", "p.html", "runs", ".modetune")]
    allowed = [*map(str, named), str(home), tempfile.gettempdir() + "/tmp", "/dev/"]
    written, folder = set(), str(tmp_path)
    for line in trace.read_text(errors="replace").splitlines():
        if " = -1 " in line or (OPENS.search(line) and not WRITES.search(line)):
            continue
        if found := re.search(r"AT_FDCWD<([^>]*)>", line):
            folder = found[1]  # of the process that makes the call: jobs have their own
        written |= {str(Path(folder, path)) for path in re.findall(r'"([^"]*)"', line)}
    assert any(path.endswith("campaign.h5") or "/runs/" in path for path in written)
    # Files are written aside, under a hidden name, and renamed.
    aside = re.compile(re.escape(str(tmp_path)) + r"/\.[0-9a-f]{32}\.part")
    outside = {path for path in written if not path.startswith(tuple(allowed))}
    assert {path for path in outside if not aside.fullmatch(path)} == set()
