"""`modetune files inspect` as a user meets it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from modetune.adapters.test_files.geometry_csv import read_geometry_csv
from modetune.adapters.test_files.measurements import read_measurement
from modetune.adapters.test_files.modes_csv import read_modes_csv
from modetune.core.errors import CampaignError
from modetune.flows.cli.main import app

MODE = """    -1
    55
NONE
NONE
NONE
NONE
NONE
         1         3         2         8         5         3
         2         6         1         4
 -1.00000E+00  5.00000E+01  0.00000E+00  0.00000E+00  0.00000E+00  0.00000E+00
        11
  1.00000E+00  1.00000E+00  0.00000E+00  0.00000E+00  2.00000E+00  2.00000E+00
    -1
    -1
    15
        11         0         0         0  1.00000E+00  2.00000E+00  3.00000E+00
        12         0         0         0  1.00000E+00  4.00000E+00  3.00000E+00
    -1
    -1
  2467
    -1
"""


@pytest.fixture
def test_file(tmp_path: Path) -> Path:
    path = tmp_path / "export.unv"
    path.write_text(MODE)
    return path


def run(*arguments: str | Path) -> str:
    result = CliRunner().invoke(app, ["files", "inspect", *map(str, arguments)])
    if result.exception is not None:
        raise result.exception
    return result.stdout


def test_a_file_is_told_in_a_few_lines(test_file: Path) -> None:
    lines = run(test_file).splitlines()
    assert lines[0] == f"{test_file}: universal, datasets 55, 15, 2467"
    assert (
        lines[1].split()
        == "points 2, 0 x 2 x 0, unit of length unknown; 0 lines, 0 triangles".split()
    )
    assert lines[2].split() == "modes 1 at 2 sensors".split()
    # |-1 + 50 i| / 2 pi, 1 / |-1 + 50 i|
    assert lines[6].replace("│", " ").split() == ["4", "7.95934", "0.02000", "1.000"]
    assert f"note: {test_file}: dataset 2467 (line 20) is not one that is read here" in lines
    assert "note: 1 of 2 points have no shape" in lines


@pytest.mark.parametrize(
    ("metres", "said"),
    [
        ("1", "in metres;"),
        ("0.001", "in millimetres;"),
        ("0.0254000508", "in inches;"),  # a factor of 39.37, as many files have it
        ("0.3048", "in feet;"),
        ("0.5", "in units of 0.5 m;"),
    ],
)
def test_a_unit_of_length_is_told_by_its_name(test_file: Path, metres: str, said: str) -> None:
    assert said in run(test_file, "--metres", metres).splitlines()[1]


def test_the_same_is_told_to_machines(test_file: Path) -> None:
    told = json.loads(run(test_file, "--json", "--metres", "0.001"))
    assert told["files"] == [
        {"path": str(test_file), "form": "universal", "datasets": {"55": 1, "15": 1, "2467": 1}}
    ]
    assert told["points"]["count"] == 2
    assert told["points"]["metres"] == 0.001
    assert told["modes"][0]["number"] == 4
    assert told["modes"][0]["phase_collinearity"] == pytest.approx(1.0)
    assert told["sensors"] == 2
    assert told["response_functions"] is None


@pytest.mark.parametrize("name", ["t.h5", "t.unv", "sub/t.uff"])
def test_the_test_is_written_in_another_form(test_file: Path, tmp_path: Path, name: str) -> None:
    assert run(test_file, "--write", tmp_path / name).endswith(f"written: {tmp_path / name}\n")
    first, second = read_measurement([test_file]), read_measurement([tmp_path / name])
    assert first.modes is not None
    assert second.modes is not None
    assert second.modes.numbers == (4,)
    np.testing.assert_allclose(
        second.modes.modes.mode_shapes, first.modes.modes.mode_shapes, rtol=1e-5
    )
    assert second.geometry is not None


def test_as_csv_points_go_into_a_file_beside_the_modes(test_file: Path, tmp_path: Path) -> None:
    run(test_file, "--write", tmp_path / "t.csv")
    assert read_modes_csv(tmp_path / "t.csv").numbers == (4,)
    assert read_geometry_csv(tmp_path / "t-points.csv").nodes.tolist() == [11, 12]
    assert "phase collinearity" in (tmp_path / "t.csv").read_text()


def test_points_alone_are_written_under_the_name_given(test_file: Path, tmp_path: Path) -> None:
    points = tmp_path / "points.unv"
    points.write_text(MODE[MODE.index("    15") - 7 :])
    run(points, "--write", tmp_path / "p.csv")
    assert read_geometry_csv(tmp_path / "p.csv").nodes.tolist() == [11, 12]


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("export.unv", "is one of the files to read"),
        ("t.xlsx", "written as .csv, .h5 or .unv"),
        ("folder.h5", "it is a folder"),
        ("export.unv/t.h5", "its parent is not a folder"),
    ],
)
def test_what_cannot_be_written_is_told(
    test_file: Path, tmp_path: Path, name: str, reason: str
) -> None:
    (tmp_path / "folder.h5").mkdir()
    with pytest.raises(CampaignError, match=reason) as raised:
        run(test_file, "--write", tmp_path / name)
    assert raised.value.exit_code == 2
    assert test_file.read_text() == MODE


def test_a_file_of_nothing_useful_is_told_and_not_written(tmp_path: Path) -> None:
    head = f"{1:5d}{0:10d}{0:5d}{0:10d} {'NONE':10}{1:10d}{1:4d} {'NONE':10}{0:10d}{0:4d}"
    form = f"{2:10d}{1:10d}{1:10d}" + f"{0.0:13.5E}{1.0:13.5E}{0.0:13.5E}"
    axis = f"{17:10d}{0:5d}{0:5d}{0:5d} {'NONE':20} {'s':20}"
    rows = [
        "    -1",
        "    58",
        *["NONE"] * 5,
        head,
        form,
        *[axis] * 4,
        f"{1.0:13.5E}",
        "    -1",
        "",
    ]
    path = tmp_path / "history.uff"
    path.write_text("\n".join(rows))
    assert "1, without a usable response function" in run(path)
    with pytest.raises(CampaignError, match="the files contain nothing that can be written"):
        run(path, "--write", tmp_path / "t.h5")


def test_what_cannot_be_read_ends_with_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(CampaignError, match="cannot be read: No such file"):
        run(tmp_path / "none.unv")
