"""Arrays of a foreign HDF5 file, read by a separate program.

HDF5 crashes, hangs or takes all memory on some files with a wrong byte, so that it is this program
that ends (`read_hdf5` bounds its time and memory), and not the campaign. It leaves the arrays of
each dataset or group as N.npz in its folder, or what is wrong as N.txt; a number a line of
names.txt.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from modetune.adapters.process import run_process
from modetune.adapters.regular_file import largest
from modetune.adapters.solver import Command
from modetune.core.algebra.matrices import CSR
from modetune.core.errors import ModelError, SolverError
from modetune.core.modes import Floats

#: Deflate makes at most 1032 bytes of one; what says that it holds more than its file can is wrong.
DEFLATE = 1032
#: In place of a name: every array of numbers and every text, by its path, as MATLAB means it.
ALL = "*"
#: What Python and HDF5 take before they read a dataset, bytes of address space.
BASE_MEMORY = 2 << 30
#: Seconds that reading takes at most, to start and for each byte of the file (20 MB/s).
START_S, S_PER_BYTE = 15.0, 5e-8
#: What h5py and NumPy raise on files that are damaged or something else.
_NOTHING = (OSError, ValueError, KeyError, TypeError, AttributeError, RuntimeError, MemoryError)


def read_hdf5(path: Path, names: Sequence[str]) -> dict[str, dict[str, Floats] | ModelError]:
    """Return the arrays of each name: `dense`, or data, indices, indptr of a CSR matrix.

    The name ALL gives what the file holds, by path: arrays in MATLAB's order of indices, texts and
    lists of texts as arrays of text. An error replaces an array that cannot be read.
    """
    with tempfile.TemporaryDirectory(prefix="modetune-") as place:
        folder = Path(place)
        (folder / "names.txt").write_text("\n".join(names), encoding="utf-8")
        arguments = (sys.executable, "-P", "-m", __name__, str(path.resolve()))
        command = Command(arguments, (("OPENBLAS_NUM_THREADS", "1"), ("OMP_NUM_THREADS", "1")))
        longest = START_S + S_PER_BYTE * path.stat().st_size
        try:
            run_process(command, folder, longest, threading.Event())
            ended = "HDF5 broke off"
        except SolverError as error:
            ended = str(error).partition("\n")[0].partition(str(folder))[2].strip() or "HDF5 failed"
        return {name: _read_one(folder, number, ended) for number, name in enumerate(names)}


def _read_one(folder: Path, number: int, ended: str) -> dict[str, Floats] | ModelError:
    arrays, text = folder / f"{number}.npz", folder / f"{number}.txt"
    if arrays.is_file():
        with np.load(arrays, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    return ModelError(text.read_text(encoding="utf-8") if text.is_file() else ended)


def _everything(file: h5py.File) -> dict[str, NDArray[Any]]:
    """Return all numbers and texts of a file; MATLAB's references lead only to texts."""
    found: dict[str, NDArray[Any]] = {}

    def take(name: str, item: object) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith("#"):
            _bound(name, [item])
            _bound_memory(BASE_MEMORY + 3 * sum(array.nbytes for array in found.values()))
            array = _text(item) if item.attrs.get("MATLAB_class") == b"char" else item[()]
            if item.dtype.kind == "O":
                targets = [file[reference] for reference in np.ravel(array)]
                array = np.array([str(_text(target)) for target in targets])
            if item.dtype.names == ("real", "imag"):
                array = array["real"] + 1j * array["imag"]
            if array.dtype.kind in "iufcUV" and not item.attrs.get("MATLAB_empty", 0):
                found[name] = array.T

    file.visititems(take)
    if sum(array.nbytes for array in found.values()) > largest(0.25):
        raise ModelError("it holds too much to be read as a whole")
    return found


def _text(dataset: h5py.Dataset) -> NDArray[Any]:
    """Return a MATLAB text, which has a number for each character."""
    if dataset.dtype.kind not in "iu":
        raise ModelError(f"{dataset.name!r} is not a text")
    return np.array("".join(map(chr, np.ravel(dataset[()]).tolist())))


def _arrays(file: h5py.File, name: str) -> dict[str, NDArray[Any]]:
    if name == ALL:
        return _everything(file)
    if name not in file:
        raise ModelError(f"it has no dataset or group {name!r}")
    found = file[name]
    datasets = {"dense": found} if isinstance(found, h5py.Dataset) else {p: found[p] for p in CSR}
    for part, dataset in datasets.items():
        if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "iufcV":
            raise ModelError(f"{part} of {name!r} is not an array of numbers")
    _bound(name, list(datasets.values()))
    _bound_memory(BASE_MEMORY + 3 * sum(dataset.nbytes for dataset in datasets.values()))
    return {part: np.asarray(dataset[()]) for part, dataset in datasets.items()}


def _bound(name: str, datasets: Sequence[h5py.Dataset]) -> None:
    """Refuse what the file cannot hold, or memory cannot."""
    for dataset in datasets:
        held = dataset.id.get_storage_size()
        if dataset.nbytes > DEFLATE * held + 4096:
            raise ModelError(f"{name!r} declares {dataset.nbytes} bytes and holds {held}")
        if dataset.nbytes > largest(0.25):
            raise ModelError(f"{name!r} has {dataset.nbytes / 1e9:.3g} GB, too much to be read")


def _bound_memory(size: int) -> None:
    import resource  # Windows has none, and no process of this program

    _, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = size if hard == resource.RLIM_INFINITY else min(size, hard)
    resource.setrlimit(resource.RLIMIT_AS, (most, hard))


def main(path: Path) -> None:
    """Read the names of names.txt in the folder of this process."""
    for number, name in enumerate(Path("names.txt").read_text(encoding="utf-8").splitlines()):
        _bound_memory(BASE_MEMORY)
        part = Path(f"{number}.part.npz")
        try:
            with h5py.File(path, "r") as file:
                np.savez(part, allow_pickle=False, **_arrays(file, name))
            shutil.move(part, f"{number}.npz")
        except (ModelError, *_NOTHING) as error:
            Path(f"{number}.txt").write_text(str(error) or type(error).__name__, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
