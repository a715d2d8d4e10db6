"""Spring-mass systems: the YAML lines of masses, springs and dampers, and their matrices."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from scipy import sparse

from modetune.adapters.matrices.model import MATRIX_KINDS, MatrixModel, MatrixPart
from modetune.adapters.yaml_file import Place, YamlFile
from modetune.core.errors import ModelError
from modetune.core.near_names import suggestion
from modetune.core.parameters import Quantity

GROUND = "ground"
#: Sections of what stands between masses, and of each the key of its number with its quantity.
LINKS: dict[str, dict[str, Quantity]] = {
    "springs": {"stiffness": "spring_stiffness"},
    "dampers": {"viscous": "viscous_damping", "structural": "structural_damping"},
}
NOTHING: dict[str, None] = dict.fromkeys(MATRIX_KINDS)


def read_spring_mass(file: YamlFile) -> tuple[MatrixModel, dict[str, Place]]:
    """The model of a spring-mass file, and where each element's number stands in it.

    Raises ModelError with every problem, each with file and line.
    """
    problems: list[str] = []
    masses = file.entries(("masses",), problems)
    links = {
        section: file.entries((section,), problems) if section in file.data else {}
        for section in LINKS
    }
    parts: dict[str, MatrixPart] = {}
    row_of = {name: row for row, name in enumerate(masses)}
    size = len(masses)
    if not masses or GROUND in masses:
        problems.append(f"{file.where(('masses',))}: a mass is needed, and none called {GROUND}")
    for name in masses:
        value = _number(file, ("masses", name), problems)
        parts[name] = MatrixPart("mass", value, None, _element(size, [row_of[name]], value))
    places: dict[str, Place] = {name: ("masses", name) for name in masses}
    for place in ((section, name) for section, names in links.items() for name in names):
        name = place[1]
        if name in parts:
            what = {"masses": "mass", "springs": "spring"}[str(places[name][0])]
            problems.append(f"{file.where(place)}: {name} is a {what} already")
        rows, key, value = _link(file, place, row_of, problems)
        parts[name] = MatrixPart(
            LINKS[place[0]][key], value, **{**NOTHING, key: _element(size, rows, value)}
        )
        places[name] = (*place, key)
    if problems:
        raise ModelError("\n".join(problems))
    zero = sparse.csr_array((size, size))
    stiffness = sum((p.stiffness for p in parts.values() if p.stiffness is not None), start=zero)
    mass = sum((p.mass for p in parts.values() if p.mass is not None), start=zero)
    model = MatrixModel(
        name=file.path.stem,
        stiffness=sparse.csr_array(stiffness),
        mass=sparse.csr_array(mass),
        nodes=np.arange(1, size + 1, dtype=np.int64),
        components=np.ones(size, dtype=np.int64),
        parts=parts,
    )
    return model, places


def _link(
    file: YamlFile, place: Place, row_of: Mapping[str, int], problems: list[str]
) -> tuple[list[int], str, float]:
    """Rows of the masses that a spring or damper holds, one or two, its key, and its value."""
    where, given, keys = file.where(place), file.entries(place, problems), LINKS[str(place[0])]
    unknown = [key for key in given if key not in ("between", *keys)]
    if unknown:
        problems.append(
            f"{where}: unknown key `{unknown[0]}`{suggestion(unknown[0], ('between', *keys))}"
        )
    ends = given.get("between")
    if not isinstance(ends, list) or len(ends) != 2 or ends[0] == ends[1]:
        problems.append(f"{where}: `between` must name two ends, such as [{GROUND}, m1]")
        ends = []
    names = [str(end) for end in ends if end != GROUND]
    problems += [f"{where}: there is no mass {name}" for name in names if name not in row_of]
    rows = [row_of[name] for name in names if name in row_of]
    own = [key for key in keys if key in given]
    if len(own) != 1:
        said = " or ".join(f"`{key}`" for key in keys)
        what = "is missing" if not own else "is given twice: a damper has one of them"
        problems.append(f"{where}: the key {said} {what}")
        return rows, next(iter(keys)), 0.0
    return rows, own[0], _number(file, (*place, own[0]), problems)


def _element(size: int, rows: list[int], value: float) -> sparse.csr_array:
    """A spring or mass on one unknown, or a spring between two."""
    signs = np.array([1.0, -1.0])[: len(rows)]
    values = value * np.outer(signs, signs).ravel()
    i, j = np.repeat(rows, len(rows)), np.tile(rows, len(rows))
    return sparse.csr_array((values, (i.astype(np.int64), j.astype(np.int64))), shape=(size, size))


def _number(file: YamlFile, place: Place, problems: list[str]) -> float:
    """The number at a place as the text has it (YAML takes 1e3 for a word and 010 for 8)."""
    word = file.word(place)
    try:
        value = float(word)
    except ValueError:
        value = math.nan
    if not 0.0 < value < math.inf:
        problems.append(
            f"{file.where(place)}: {place[1]} needs a plain number above zero, found {word!r}"
        )
        return 1.0
    return value
