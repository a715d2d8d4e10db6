"""Models whose matrices stand in files of their own: reading and writing what the index names."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np
from scipy import sparse

from modetune.adapters.matrices.matrix_files import read_matrices, split_reference, write_matrix
from modetune.adapters.matrices.model import MATRIX_KINDS, Factors, MatrixModel, MatrixPart
from modetune.adapters.regular_file import read_regular
from modetune.adapters.yaml_file import Place, YamlFile
from modetune.core.errors import ModelError
from modetune.core.modes import COMPONENTS, Integers


def read_index(file: YamlFile) -> MatrixModel:
    """The model whose matrices a file names. Raises ModelError with every problem and its line."""
    problems: list[str] = []
    matrices = dict(_matrices(file, problems))
    stiffness, mass = matrices.get(("stiffness",)), matrices.get(("mass",))
    if stiffness is None or mass is None or problems:
        raise ModelError("\n".join(problems))
    size = stiffness.shape[0]
    problems += [
        f"{file.where(place)}: the matrix is {matrix.shape[0]} x {matrix.shape[1]}, but "
        f"`stiffness` is {size} x {size}"
        for place, matrix in matrices.items()
        if matrix.shape != stiffness.shape
    ]
    nodes, components = _dofs(file, size, problems)
    names = dict.fromkeys(str(place[1]) for place in matrices if place[0] == "parts")
    if problems:
        raise ModelError("\n".join(problems))
    parts = {
        name: MatrixPart(
            "matrix_factor", 1.0, *(matrices.get(("parts", name, kind)) for kind in MATRIX_KINDS)
        )
        for name in names
    }
    return MatrixModel(file.path.stem, stiffness, mass, nodes, components, parts)


def _matrices(file: YamlFile, problems: list[str]) -> list[tuple[Place, sparse.csr_array]]:
    """Place and matrix of everything the file names."""
    places: list[Place] = [("stiffness",), ("mass",)]
    for name in file.entries(("parts",), problems) if "parts" in file.data else {}:
        given = file.entries(("parts", name), problems)
        if not given or not set(given) <= set(MATRIX_KINDS):
            problems.append(
                f"{file.where(('parts', name))}: part {name} needs one or several of "
                f"{', '.join(f'`{kind}`' for kind in MATRIX_KINDS)}, and nothing else"
            )
            continue
        places += [("parts", name, kind) for kind in given]
    references = [str(file.at(place)) for place in places]
    found = []
    for place, matrix in zip(places, read_matrices(file.path.parent, references), strict=True):
        if isinstance(matrix, ModelError):
            problems.append(f"{file.where(place)}: {matrix}")
        else:
            found.append((place, matrix))
    return found


def _dofs(file: YamlFile, size: int, problems: list[str]) -> tuple[Integers, Integers]:
    """Node and component of each unknown."""
    if "dofs" not in file.data:
        return np.arange(1, size + 1, dtype=np.int64), np.ones(size, dtype=np.int64)
    path = file.path.parent / str(file.data["dofs"])
    try:
        lines = read_regular(path).decode("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        problems.append(f"{file.where(('dofs',))}: {path} cannot be read: {error}")
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    found: dict[tuple[int, int], int] = {}
    for number, line in enumerate(lines, start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        node, _, component = line.strip().partition(".")
        axis = COMPONENTS.index(component) + 1 if component in COMPONENTS else component
        if not (node.isdecimal() and len(node) < 19) or str(axis) not in "123456" or axis == "":
            problems.append(
                f"{path}, line {number}: {line.strip()!r} is not an unknown such as 101.x"
            )
            break
        if (int(node), int(axis)) in found:
            problems.append(f"{path}, line {number}: {line.strip()} stands twice")
            break
        found[(int(node), int(axis))] = number
    else:
        if len(found) != size:
            problems.append(f"{path} names {len(found)} unknowns for matrices of {size}")
    names = np.array(list(found), dtype=np.int64).reshape(-1, 2)
    return names[:, 0], names[:, 1]


def write_index(file: YamlFile, model: MatrixModel, factors: Factors, folder: Path) -> str:
    """Write all matrices of an updated model below a folder; returns the main file's text."""
    scaled = model.assembled(factors)
    new: dict[Place, sparse.csr_array] = {("stiffness",): scaled.stiffness, ("mass",): scaled.mass}
    for name, part in model.parts.items():
        for kind, matrix in part.matrices.items():
            new[("parts", name, kind)] = sparse.csr_array(factors.get(name, 1.0) * matrix)
    words: dict[Place, str] = {}
    within = _below(file, [*new, ("dofs",)] if "dofs" in file.data else list(new), words)
    for name in {split_reference(reference)[0] for reference in within.values()}:
        (folder / name).unlink(missing_ok=True)  # of an earlier run
    for place, matrix in new.items():
        write_matrix(folder, within[place], matrix)
    if "dofs" in file.data:
        target = folder / within[("dofs",)]
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes((file.path.parent / str(file.data["dofs"])).read_bytes())
    return file.replaced(words)


def _below(file: YamlFile, places: list[Place], words: dict[Place, str]) -> dict[Place, str]:
    """Each reference as it is where that stays below the new folder, else by its name alone.

    Changed ones are added to words.
    """
    found: dict[Place, str] = {}
    for place in places:
        name, dataset = split_reference(str(file.at(place)))
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts:
            name = path.name
            words[place] = f'"{name}:{dataset}"' if dataset else f'"{name}"'
        found[place] = f"{name}:{dataset}" if dataset else name
    return found
