"""Deleting the module of a format and its line in FORMATS removes the format, and no other."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from modetune.adapters.test_files.file_kind import Form
from modetune.adapters.test_files.hdf5 import write_test_hdf5
from modetune.adapters.test_files.measurements import FORMATS, read_measurement
from modetune.adapters.test_files.modes_csv import write_modes_csv
from modetune.adapters.test_files.universal.file import write_universal
from modetune.core.measurement.measurement import Measurement
from tests.adapters.test_files.measured_tests import Wanted, made

ROOT = Path(__file__).resolve().parents[3]
#: Prints where the package lies, then the modes of each file or why it is refused.
READS = """
import sys
from pathlib import Path
import modetune
from modetune.adapters.test_files.measurements import read_measurement
from modetune.core.errors import CampaignError

print(modetune.__file__)
for name in sys.argv[1:]:
    try:
        print(read_measurement([Path(name)]).modes.modes.n_modes)
    except CampaignError as error:
        print(error)
"""


def written(folder: Path) -> list[Path]:
    """Write one test in four formats."""
    test = made(Wanted(3, parts=(True, False, False)))
    assert test.modes is not None
    modes, only = test.modes.modes, Measurement(test.modes)
    paths = [folder / f"test.{suffix}" for suffix in ("csv", "h5", "unv", "mat")]
    write_modes_csv(paths[0], test.modes.numbers, modes)
    write_test_hdf5(paths[1], only)
    write_universal(paths[2], only)
    dofs = np.column_stack([modes.nodes, modes.components])
    savemat(paths[3], {"fn": modes.frequencies_hz, "phi": modes.mode_shapes, "dof": dofs})
    return paths


def without_format(form: Form, folder: Path) -> None:
    """Copy core and adapters as a package, and delete a format there."""
    package = folder / "modetune"
    for part in ("core", "adapters"):
        ignore = shutil.ignore_patterns("__pycache__")
        shutil.copytree(ROOT / part, package / part, ignore=ignore)
    shutil.copy(ROOT / "src" / "modetune" / "__init__.py", package)
    formats = package / "adapters" / "test_files"
    home = formats / FORMATS[form].partition(".")[0]
    if home.is_dir():
        shutil.rmtree(home)
    else:
        home.with_suffix(".py").unlink()
    listed = formats / "measurements.py"
    lines = listed.read_text(encoding="utf-8").splitlines(keepends=True)
    kept = [line for line in lines if not line.startswith(f'    "{form}": ')]
    assert len(kept) == len(lines) - 1
    listed.write_text("".join(kept), encoding="utf-8")


@pytest.mark.parametrize(
    ("form", "file", "description"),
    [
        ("mat", "test.mat", "is a MATLAB file"),
        ("hdf5", "test.h5", "is a test that modetune wrote as HDF5"),
        ("universal", "test.unv", "is a universal file"),
    ],
)
def test_a_format_goes_with_its_module_and_one_line(
    form: Form, file: str, description: str, tmp_path: Path
) -> None:
    paths = written(tmp_path)
    whole = read_measurement([paths[0]]).modes
    assert whole is not None
    without_format(form, tmp_path / "copy")
    ended = subprocess.run(
        [sys.executable, "-P", "-c", READS, *map(str, paths)],
        env=os.environ | {"PYTHONPATH": str(tmp_path / "copy")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stderr
    where, *found = ended.stdout.splitlines()
    assert Path(where).parent == tmp_path / "copy" / "modetune"
    for path, line in zip(paths, found, strict=True):
        if path.name == file:
            assert f"{path} {description}, not a test that can be read; ask for" in line
        else:
            assert line == str(whole.modes.n_modes)
