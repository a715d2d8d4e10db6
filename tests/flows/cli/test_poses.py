"""A test in axes of its own, laid over a symmetric plate: searched once, told by every command."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import modetune
from modetune.core.modes import Floats, Integers
from modetune.core.storage.store import Store
from tests.adapters.solved import needs_ccx
from tests.adapters.test_files.test_universal_dialects import units
from tests.adapters.test_files.universal_text import mode_55, nodes_15
from tests.command_line import run_command as run

pytestmark = needs_ccx

#: Nodes 1.. of a plate of 800 x 400 mm, 9 by 5; sensors at eight of them, no three alike.
X, Y = (100.0 * axis.ravel() for axis in np.meshgrid(np.arange(9.0), np.arange(5.0), indexing="ij"))
PLACES = np.column_stack([X, Y, np.zeros(45)])
SENSORS = np.array([1, 5, 23, 41, 45, 9, 32, 14])
TURN = Rotation.from_euler("z", 20, degrees=True).as_matrix()


def plate(folder: Path, thick: float) -> Path:
    """A free plate of shells, 4 mm, its corner at the origin `thick`."""
    cells = [
        [1 + 5 * i + j, 6 + 5 * i + j, 7 + 5 * i + j, 2 + 5 * i + j]
        for i in range(8)
        for j in range(4)
    ]
    corner = [number for number, row in enumerate(cells, 1) if PLACES[row[2] - 1].max() <= 400.0
              and PLACES[row[2] - 1, 1] <= 200.0]  # fmt: skip
    rows = ["*NODE", *(f"{n}, {x}, {y}, {z}" for n, (x, y, z) in enumerate(PLACES, 1))]
    for name, chosen in (
        ("CORNER", corner),
        ("REST", [n for n in range(1, 33) if n not in corner]),
    ):
        rows += [f"*ELEMENT, TYPE=S4, ELSET={name}"]
        rows += [f"{n}, {', '.join(map(str, cells[n - 1]))}" for n in chosen]
    rows += ["*MATERIAL, NAME=AL", "*ELASTIC", "70000., 0.3", "*DENSITY", "2.7e-9"]
    for name, height in (("CORNER", thick), ("REST", 4.0)):
        rows += [f"*SHELL SECTION, ELSET={name}, MATERIAL=AL", f"{height}"]
    rows += ["*STEP", "*FREQUENCY", "12", "*NODE FILE", "U", "*END STEP", ""]
    (folder / "plate.inp").write_text("\n".join(rows))
    return folder / "plate.inp"


def campaign(folder: Path, thick: float) -> None:
    """The plate's own modes as a test in metres whose axes are turned by 20 degrees."""
    found = modetune.modes(plate(folder, thick), settings={"model.units": "mm-t-s"}).elastic
    rows = [sensor_row(found.nodes, found.components, node) for node in SENSORS]
    shapes = found.mode_shapes[rows, :4].real
    write_test(folder, found.frequencies_hz[:4], shapes, PLACES[SENSORS - 1] @ TURN / 1000.0)
    (folder / "plate.yaml").write_text(
        "name: plate\n"
        "model: {deck: plate.inp, solver: calculix, units: mm-t-s, eigensolver: solver}\n"
        "test: {modes: [modes.csv, points.csv], length: m, sensors: {align: fit}}\n"
        "parameters:\n"
        "  - {name: E, quantity: youngs_modulus, material: AL, bounds: [0.8, 1.2]}\n"
        "update: {max_iterations: 2}\n"
    )


def sensor_row(nodes: Integers, components: Integers, node: int) -> int:
    return int(np.flatnonzero((nodes == node) & (components == 3))[0])


def write_test(folder: Path, frequencies_hz: Floats, shapes: Floats, places: Floats) -> None:
    names = [200 + number for number in range(1, len(places) + 1)]
    lines = ["mode,frequency_hz," + ",".join(f"{name}.z" for name in names)]
    lines += [
        f"{mode},{hz:.8g}," + ",".join(f"{value:.8g}" for value in column)
        for mode, (hz, column) in enumerate(zip(frequencies_hz, shapes.T, strict=True), 1)
    ]
    (folder / "modes.csv").write_text("\n".join(lines) + "\n")
    points = [f"{name},{x!r},{y!r},{z!r}" for name, (x, y, z) in
              zip(names, places.tolist(), strict=True)]  # fmt: skip
    (folder / "points.csv").write_text("\n".join(["node,x,y,z", *points]) + "\n")


def searches(folder: Path) -> list[str]:
    """Keys of the poses that the campaign's store has."""
    store = Store(folder / ".modetune" / "store")
    keys = [path.name.partition(".")[0] for path in store.entries()]
    return [key for key in keys if getattr(store.holding(key), "kind", "") == "registration"]


INFO = {"MODETUNE_LOG": "INFO"}
SEARCHING = "laying 8 test points over the model"


def test_poses_that_nothing_tells_apart_end_update_with_the_poses_to_paste(tmp_path: Path) -> None:
    campaign(tmp_path, 4.0)
    first = run(tmp_path, "check", "plate.yaml", "--json", "--no-prefect", **INFO)
    assert first.stderr.count(SEARCHING) == 1
    report = json.loads(first.stdout)
    (told,) = [item for item in report["findings"] if "mean MAC" in item["what"]]
    assert told["level"] == "doubtful"
    assert told["what"].startswith("measured shapes cannot distinguish its poses")
    assert "with `align: fit`" in told["remedy"]
    assert not any(
        "poses of the test fit equally well" in item["what"] for item in report["findings"]
    )

    # The same points on the same surface: neither searched again nor solved again.
    ended = run(tmp_path, "update", "plate.yaml", "--no-prefect", **INFO)
    assert ended.returncode == 2
    assert SEARCHING not in ended.stderr
    assert "solved in" not in ended.stderr
    paste = re.findall(r"rotation: \[[^]]*\], translation: \[[^]]*\]", ended.stderr)
    assert "rotation: [0, 0, 20], translation: [0, 0, 0]" in paste
    assert "rotation: [0, 0, -160], translation: [800, 400, 0]" in paste

    # What was told, pasted beside `align: fit`, is taken.
    text = (tmp_path / "plate.yaml").read_text()
    pasted = text.replace("{align: fit}", f"{{align: fit, {paste[0]}}}")
    (tmp_path / "plate.yaml").write_text(pasted)
    good = run(tmp_path, "sensors", "plate.yaml", **INFO)
    assert "uncertain" not in good.stdout
    assert SEARCHING not in good.stderr
    assert len(searches(tmp_path)) == 1


def test_shapes_choose_a_pose_in_each_command_at_the_cost_of_one_run(tmp_path: Path) -> None:
    campaign(tmp_path, 8.0)
    before = run(tmp_path, "sensors", "plate.yaml", **INFO)
    assert "uncertain: " in before.stdout
    assert "solved in" not in before.stderr  # no solver runs for `sensors`
    assert "mean MAC" not in run(tmp_path, "check", "plate.yaml", "--no-run").stdout

    report = json.loads(run(tmp_path, "check", "plate.yaml", "--json", "--no-prefect").stdout)
    assert report["solver_runs"]["modal"] == 1
    (told,) = [item for item in report["findings"] if "mean MAC" in item["what"]]
    assert told["level"] == "good"
    assert "select: rotation: [0, 0, 20], translation: [0, 0, 0]: mean MAC 1.000" in told["what"]

    # From the store, without a run.
    after = run(tmp_path, "sensors", "plate.yaml", "--json", **INFO)
    assert "solved in" not in after.stderr
    sensors = json.loads(after.stdout)
    assert sensors["uncertain"] == []
    assert [item["model_node"] for item in sensors["sensors"]] == SENSORS.tolist()
    assert "mean MAC" in run(tmp_path, "check", "plate.yaml", "--no-run").stdout


def test_a_kept_pose_is_believed_by_its_checksum_alone(tmp_path: Path) -> None:
    campaign(tmp_path, 8.0)
    run(tmp_path, "sensors", "plate.yaml")
    (key,) = searches(tmp_path)
    entry = Store(tmp_path / ".modetune" / "store").path(key)
    data = bytearray(entry.read_bytes())
    data[-200] ^= 1
    entry.write_bytes(bytes(data))
    again = run(tmp_path, "sensors", "plate.yaml", **INFO)
    assert "checksum" in again.stderr
    assert SEARCHING in again.stderr
    # Another place of one sensor is another question.
    text = (tmp_path / "points.csv").read_text()
    (tmp_path / "points.csv").write_text(text.replace("0.4442", "0.4443", 1))
    assert SEARCHING in run(tmp_path, "sensors", "plate.yaml", **INFO).stderr
    assert len(searches(tmp_path)) == 2


def test_check_tells_unit_and_stray_points_of_an_odd_universal_file(tmp_path: Path) -> None:
    """Marks without blanks, Windows' line ends, a factor of dataset 164 the other way round, names
    of components, one point metres away."""
    campaign(tmp_path, 8.0)
    table = np.loadtxt(tmp_path / "modes.csv", delimiter=",", skiprows=1)
    frequencies, shapes = table[:, 1].tolist(), table[:, 2:].tolist()
    names = [201, *range(202, 209), 300]
    places = [*(PLACES[SENSORS - 1] @ TURN).tolist(), [3000.0, -2500.0, 40.0]]
    values = [[*shape, 0.3] for shape in shapes]
    text = units(5, 1e-3, 1e-3) + nodes_15(
        *((name, 0, 0, tuple(place)) for name, place in zip(names, places, strict=True))
    )
    text += "".join(
        mode_55(
            mode,
            hertz,
            {name: (0.0, 0.0, value) for name, value in zip(names, shape, strict=True)},
        )
        for mode, (hertz, shape) in enumerate(zip(frequencies, values, strict=True), 1)
    )
    odd = text.replace("    -1\n", "-1\n").replace("\n", "\r\n")
    (tmp_path / "lab.unv").write_bytes(odd.encode())
    yaml = (tmp_path / "plate.yaml").read_text()
    yaml = yaml.replace("[modes.csv, points.csv], length: m", "lab.unv")
    (tmp_path / "plate.yaml").write_text(
        yaml.replace("align: fit", "align: fit, unmapped: leave_out")
    )
    report = json.loads(run(tmp_path, "check", "plate.yaml", "--json", "--no-run").stdout)
    doubts = [item["what"] for item in report["findings"] if item["level"] == "doubtful"]
    (unit,) = [what for what in doubts if "dataset 164" in what]
    assert "its code 5 means lengths in 0.001 m, its factor 0.001 the inverse" in unit
    (stray,) = [item for item in report["findings"] if item["where"] == "sensor 300.z"]
    assert stray["level"] == "doubtful"
    assert "mm away" in stray["what"]
    told = " ".join(item["what"] for item in report["findings"])
    assert "1 of 9 test points are far from the model and were left out of the fit" in told
    assert "8 sensors on 8 nodes" in told
