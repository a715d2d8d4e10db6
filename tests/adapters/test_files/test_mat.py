"""Modes and points in MATLAB's files, of all versions, by the names of their variables."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from modetune.adapters.test_files.measurements import read_measurement
from modetune.core.errors import CampaignError

FN = np.array([31.5, 88.25, 140.0])
PHI = np.array([[1.0, 0.5, -0.25], [0.0, 2.0, 1.0], [-1.0, 0.25, 0.5], [0.5, -1.5, 3.0]])
DOF = np.array([1.01, 1.03, 2.01, 2.03])
NODE = np.array([[1, 0.0, 0.0, 0.0], [2, 0.5, 0.25, 0.0]])


def save_73(path: Path, **variables: Any) -> Path:
    """A file as MATLAB writes it with -v7.3: HDF5 behind a head of 512 bytes, indices turned."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, value in variables.items():
            if isinstance(value, list):  # a cell of texts: references
                cells = [
                    file.create_dataset(
                        f"#refs#/{name}{n}", data=np.array([list(map(ord, text))]).T
                    )
                    for n, text in enumerate(value)
                ]
                for cell in cells:
                    cell.attrs["MATLAB_class"] = np.bytes_("char")
                references = np.array([[cell.ref for cell in cells]], dtype=h5py.ref_dtype)
                file.create_dataset(name, data=references).attrs["MATLAB_class"] = np.bytes_("cell")
            else:
                data = np.atleast_2d(value).T
                if np.iscomplexobj(data):
                    pairs = np.empty(data.shape, dtype=[("real", "f8"), ("imag", "f8")])
                    pairs["real"], pairs["imag"] = data.real, data.imag
                    data = pairs
                file.create_dataset(name, data=data).attrs["MATLAB_class"] = np.bytes_("double")
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64, HDF5 schema 1.00 .".ljust(124))
    return path


def check(path: Path, damped: bool = True) -> None:
    found = read_measurement([path]).modes
    assert found is not None
    np.testing.assert_allclose(found.modes.frequencies_hz, FN, rtol=1e-12)
    assert found.modes.nodes.tolist() == [1, 1, 2, 2]
    assert found.modes.components.tolist() == [1, 3, 1, 3]
    np.testing.assert_allclose(found.modes.mode_shapes, PHI, atol=1e-12)
    assert found.modes.damping_ratios.tolist() == ([0.01, 0.02, 0.03] if damped else [])


ZETA = np.array([[0.01, 0.02, 0.03]])


@pytest.mark.parametrize("form", ["4", "5"])
def test_modes_are_known_by_their_names(tmp_path: Path, form: Literal["4", "5"]) -> None:
    made, path = tmp_path / "lab.mat", tmp_path / "lab.csv"  # whatever it is called
    savemat(made, {"fn": FN, "zeta": ZETA, "phi": PHI, "dof": DOF, "node": NODE}, format=form)
    made.rename(path)
    check(path)
    found = read_measurement([path])
    assert found.geometry is not None
    np.testing.assert_array_equal(found.geometry.coordinates, NODE[:, 1:])
    assert found.notes == (
        f"{path}: frequencies are fn, shapes are phi, a column a mode, sensors are dof",
    )


def test_a_struct_of_names_and_shapes_by_rows_are_read(tmp_path: Path) -> None:
    path = tmp_path / "lab.mat"
    names = np.array(["1:+X", "1:-Z", "2:+X", "2:+Z"], dtype=object)
    turned = PHI * np.array([[1.0], [-1.0], [1.0], [1.0]])
    test = {"wn": 2.0 * np.pi * FN, "ModeShapes": turned.T, "labels": names}
    savemat(path, {"Test": test, "comment": "hammer"})
    check(path, damped=False)


def test_the_form_of_sdt_is_read(tmp_path: Path) -> None:
    path = tmp_path / "id.mat"
    seven = np.column_stack([NODE[:, :1], np.zeros((2, 3)), NODE[:, 1:]])
    poles = np.column_stack([FN, ZETA.ravel()])
    savemat(path, {"ID": {"po": poles, "res": PHI.T, "dof": DOF}, "TEST": {"Node": seven}})
    check(path)
    found = read_measurement([path]).geometry
    assert found is not None
    np.testing.assert_array_equal(found.coordinates, NODE[:, 1:])


def test_files_of_version_73_are_read(tmp_path: Path) -> None:
    plain = {"fn": FN, "zeta": ZETA, "phi": PHI, "node": NODE}
    check(save_73(tmp_path / "a.mat", **plain, dof=DOF))
    check(save_73(tmp_path / "b.mat", **plain, names=["1.x", "1.z", "2.x", "2.z"]))
    turned = np.exp(0.7j) * PHI
    found = read_measurement([save_73(tmp_path / "c.mat", fn=FN, phi=turned, dof=DOF)]).modes
    assert found is not None
    np.testing.assert_allclose(np.abs(found.modes.mode_shapes), np.abs(PHI), atol=1e-12)


def test_a_file_without_modes_is_told_by_what_it_holds(tmp_path: Path) -> None:
    plain = tmp_path / "a.mat"
    savemat(plain, {"t": np.arange(5.0), "acc": np.zeros((5, 3))})
    newer = save_73(tmp_path / "b.mat", t=np.arange(5.0), acc=np.zeros((5, 3)))
    for path, said in ((plain, "a MATLAB file"), (newer, "a MATLAB 7.3 file")):
        with pytest.raises(CampaignError) as raised:
            read_measurement([path])
        assert f"{path} is {said} without modes" in str(raised.value)
        assert "acc (5x3)" in str(raised.value)
        assert "t (1x5)" in str(raised.value)


def test_rows_that_nothing_names_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    savemat(path, {"fn": FN, "phi": PHI})
    with pytest.raises(CampaignError, match="phi has 4 rows and no variable names their nodes"):
        read_measurement([path])


def test_a_damaged_file_is_refused(tmp_path: Path) -> None:
    whole = tmp_path / "a.mat"
    savemat(whole, {"fn": FN, "phi": PHI, "dof": DOF}, do_compression=True)
    newer = save_73(tmp_path / "b.mat", fn=FN, phi=PHI, dof=DOF)
    for path in (whole, newer):
        data = path.read_bytes()
        path.write_bytes(data[: 2 * len(data) // 3])
        with pytest.raises(CampaignError, match=r"cannot be read|without modes"):
            read_measurement([path])
