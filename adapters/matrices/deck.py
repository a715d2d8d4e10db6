"""The file of a matrix model: a YAML mapping with a spring-mass system or names of matrix files.

In a spring-mass system each mass is one unknown: component x of node 1, 2, ... in their order.

    masses:  {m1: 2.0, m2: 2.5}
    springs:
      k1: {between: [ground, m1], stiffness: 1100.0}
      k2: {between: [m1, m2], stiffness: 1000.0}
    dampers:                                     # optional; modes ignore them
      c1: {between: [ground, m1], viscous: 0.4}
      h2: {between: [m1, m2], structural: 10.0}  # imaginary part of a stiffness

With matrix files (forms: `matrix_files.py`), unknown i is component x of node i unless `dofs`
names a text file with a `node.component` on each line, or a matrix is a DMIG: its unknowns have
names, and those of all DMIG together, ascending, are the model's.

    stiffness: K.mtx
    mass: M.mtx
    dofs: dofs.txt
    parts:
      wing: {stiffness: K_wing.mtx, mass: M_wing.npz}
      joint: {stiffness: "parts.h5:joint/K"}

An updated model is the same text with other numbers, or the same file names with other matrices.
Its parts are scaled too, so that a factor of 1 again means the value in the file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from scipy import sparse

from modetune.adapters.deck_numbers import Number
from modetune.adapters.matrices.dmig import Terms, rewrite_dmig, united
from modetune.adapters.matrices.matrix_files import (
    is_dmig,
    read_matrices,
    read_terms,
    split_reference,
    write_matrix,
)
from modetune.adapters.matrices.model import MATRIX_KINDS, Factors, MatrixModel, MatrixPart
from modetune.adapters.regular_file import read_regular
from modetune.adapters.solver import Deck, ModelSummary, Target
from modetune.adapters.yaml_file import Place, YamlFile, read_yaml
from modetune.core.algebra.matrices import MatrixResult
from modetune.core.errors import CampaignError, ModelError
from modetune.core.modes import COMPONENTS, Integers
from modetune.core.near_names import suggestion
from modetune.core.parameters import (
    Parameter,
    ParameterSet,
    Quantity,
    Values,
    assigned,
    driven_by,
)
from modetune.core.storage.files import make_folder, storage_errors, writing
from modetune.core.updating.damping_model import DampingModel
from modetune.core.updating.observation import Observation, observe
from modetune.core.updating.parameter_matrices import ParameterMatrices

SYSTEM_KEYS = {"masses", "springs", "dampers"}
MATRIX_KEYS = {"stiffness", "mass", "dofs", "parts"}


@dataclass(frozen=True, slots=True)
class EditedMatrices:
    """A model with its parts scaled."""

    model: MatrixModel
    factors: Factors


@dataclass(frozen=True, slots=True)
class MatrixDeck(Deck):
    """A model's file, what it says, and the parameters that scale its parts. It has no mesh.

    values: the place of each part's number in a spring-mass system; empty for matrix files.
    """

    file: YamlFile
    model: MatrixModel
    values: Mapping[str, Place]
    parameters: tuple[Parameter, ...]

    @property
    def summary(self) -> ModelSummary:
        model = self.model
        return ModelSummary(
            name=model.name,
            node_ids=frozenset(model.nodes.tolist()),
            components=frozenset(model.components.tolist()),
            n_elements=len(model.parts),
            matrix_shapes=True,
            solid_shapes=True,  # every unknown is one of a node, under one name
            file=self.file.path,
            matrices=self.matrices,
        )

    def numbers(self, parameter: Parameter) -> list[Number]:
        if parameter.quantity == "variable":
            return []
        parts = zip(parameter.targets, self.model.targets(parameter), strict=True)
        found = []
        for target, part in parts:
            where = self.file.where(self.values.get(target, ("parts", target)))
            if not any(matrix.count_nonzero() for matrix in part.matrices.values()):
                raise ModelError(
                    f"{where}: all matrices of part {target} are zero, so nothing depends on it: "
                    "name other files or leave it out"
                )
            found.append(Number(target, part.value, f"{where}: part {target}"))
        return found

    def targets(self) -> tuple[Target, ...]:
        return tuple(
            Target("part", (name,), "part", 1)
            if part.quantity == "matrix_factor"
            else Target("elset", (name,), part.quantity.removesuffix("_stiffness"), 1)
            for name, part in self.model.parts.items()
        )

    def energy_sets(self, parameter: Parameter) -> tuple[str, ...]:
        parts = self.model.targets(parameter)
        own = parameter.proportional and all(part.mass is None for part in parts)
        alone = not driven_by(parameter, self.parameters)
        return parameter.targets if parts and own and alone else ()

    def is_linear(self, parameter: Parameter) -> bool:
        return True  # not always, but derivatives by its matrices are exact for all values

    def matrices(self, parameters: tuple[Parameter, ...]) -> ParameterMatrices:
        """Return K and M for all values of these parameters and what expressions give of them."""
        return self.model.matrices(parameters, self._dependents(parameters))

    def observation(
        self, matrices: MatrixResult, nodes: Integers, components: Integers
    ) -> Observation:
        return observe(matrices, nodes, components)

    def undamped(self) -> str:
        if self.model.damping(()).dampers:
            return ""
        return f"{self.file.path}: the model has no `viscous` or `structural` damping"

    def damping(self, base: MatrixResult) -> DampingModel:
        free = tuple(item for item in self.parameters if not item.expression)
        return self.model.damping(free, self._dependents(free))

    def edited(self, values: Values) -> EditedMatrices:
        return EditedMatrices(self.model, self._factors(values))

    def write_updated(self, values: Values, folder: Path) -> Path:
        return write_updated(self, self._factors(values), folder)

    def _dependents(self, parameters: tuple[Parameter, ...]) -> tuple[Parameter, ...]:
        """Return the expressions that name no others than these parameters."""
        return (
            ParameterSet(parameters, tuple(item for item in self.parameters if item.expression))
            .only(range(len(parameters)))
            .dependents
        )

    def _factors(self, values: Values) -> dict[str, float]:
        return {
            target: factor
            for parameter, value in assigned(self.parameters, values)
            for target, factor in self.model.factors(parameter, value).items()
        }


def read_deck(path: Path, parameters: tuple[Parameter, ...] = ()) -> MatrixDeck:
    """Read a model file and its matrices. Raises ModelError with every problem, each with line."""
    try:
        file = read_yaml(path, "a model of matrices")
    except CampaignError as error:
        raise ModelError(str(error)) from error
    system = "masses" in file.data or "springs" in file.data
    known = SYSTEM_KEYS if system else MATRIX_KEYS
    needed = ("masses", "springs") if system else ("stiffness", "mass")
    problems = [
        f"{file.where((key,))}: unknown key `{key}`{suggestion(key, known)}"
        for key in map(str, file.data)
        if key not in known
    ]
    problems += [f"{path}: the key `{key}` is missing" for key in needed if key not in file.data]
    if problems:
        raise ModelError("\n".join(problems))
    if system:
        return MatrixDeck(file, *read_spring_mass(file), parameters)
    return MatrixDeck(file, read_index(file), {}, parameters)


def write_updated(deck: MatrixDeck, factors: Factors, folder: Path) -> Path:
    """Write the model with scaled parts into a folder; returns the main file there.

    Raises StorageUnavailable.
    """
    file, path = deck.file, folder / deck.file.path.name
    if deck.values:
        words = {
            deck.values[name]: repr(deck.model.parts[name].value * factor)
            for name, factor in factors.items()
            if factor != 1.0
        }
        text = file.replaced(words)
    else:
        with storage_errors(path):
            text = write_index(file, deck.model, factors, folder)
    with writing(path) as part:
        part.write_bytes(text.encode("utf-8"))
    return path


def read_index(file: YamlFile) -> MatrixModel:
    """Return the model whose matrices a file names.

    Raises ModelError with every problem and its line.
    """
    problems: list[str] = []
    places = _places(file, problems)
    references = [str(file.at(place)) for place in places]
    dmig = read_terms(file.path.parent, references)
    names = _dofs(file, problems)
    terms = [item for item in dmig.values() if isinstance(item, Terms)]
    if names is None and terms:
        names = united(terms)
    read = read_matrices(file.path.parent, references, dmig, names)
    matrices: dict[Place, sparse.csr_array] = {}
    for place, matrix in zip(places, read, strict=True):
        if isinstance(matrix, ModelError):
            problems.append(f"{file.where(place)}: {matrix}")
        else:
            matrices[place] = matrix
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
    if names is None:
        names = np.column_stack([np.arange(1, size + 1), np.ones(size, dtype=np.int64)])
    elif len(names) != size:
        whose = file.path.parent / str(file.data["dofs"]) if "dofs" in file.data else "the DMIG"
        problems.append(f"{whose} names {len(names)} unknowns for matrices of {size}")
    part_names = dict.fromkeys(str(place[1]) for place in matrices if place[0] == "parts")
    if problems:
        raise ModelError("\n".join(problems))
    parts = {
        name: MatrixPart(
            "matrix_factor", 1.0, *(matrices.get(("parts", name, kind)) for kind in MATRIX_KINDS)
        )
        for name in part_names
    }
    return MatrixModel(file.path.stem, stiffness, mass, names[:, 0], names[:, 1], parts)


def _places(file: YamlFile, problems: list[str]) -> list[Place]:
    """Return the places of all references in the file."""
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
    return places


def _dofs(file: YamlFile, problems: list[str]) -> Integers | None:
    """Return node and component of each unknown (n, 2), as a text file names them; None without."""
    if "dofs" not in file.data:
        return None
    path = file.path.parent / str(file.data["dofs"])
    try:
        lines = read_regular(path).decode("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        problems.append(f"{file.where(('dofs',))}: {path} cannot be read: {error}")
        return None
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
            problems.append(f"{path}, line {number}: {line.strip()} occurs twice")
            break
        found[(int(node), int(axis))] = number
    return np.array(list(found), dtype=np.int64).reshape(-1, 2)


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
    names = np.column_stack([model.nodes, model.components])
    dmig: dict[tuple[str, str], dict[str, sparse.csr_array]] = {}
    for place, matrix in new.items():
        target, name = split_reference(within[place])
        if is_dmig(within[place]):
            source = split_reference(str(file.at(place)))[0]
            dmig.setdefault((source, target), {})[name.upper()] = matrix
        else:
            write_matrix(folder, within[place], matrix)
    for (source, target), matrices in dmig.items():
        rewrite_dmig(file.path.parent / source, folder / target, matrices, names)
    if "dofs" in file.data:
        listing = folder / within[("dofs",)]
        make_folder(listing.parent)
        listing.write_bytes((file.path.parent / str(file.data["dofs"])).read_bytes())
    return file.replaced(words)


def _below(file: YamlFile, places: list[Place], words: dict[Place, str]) -> dict[Place, str]:
    """Return each reference as it is where that stays below the new folder, else by its name alone.

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


GROUND = "ground"
#: Sections of what connects masses, each with the key of its number and the quantity.
LINKS: dict[str, dict[str, Quantity]] = {
    "springs": {"stiffness": "spring_stiffness"},
    "dampers": {"viscous": "viscous_damping", "structural": "structural_damping"},
}
NOTHING: dict[str, None] = dict.fromkeys(MATRIX_KINDS)


def read_spring_mass(file: YamlFile) -> tuple[MatrixModel, dict[str, Place]]:
    """Return the model of a spring-mass file, and the place of each element's number.

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
    """Return the rows of the one or two masses of a spring or damper, its key and its value."""
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
        text = " or ".join(f"`{key}`" for key in keys)
        what = "is missing" if not own else "is given twice: a damper has one of them"
        problems.append(f"{where}: the key {text} {what}")
        return rows, next(iter(keys)), 0.0
    return rows, own[0], _number(file, (*place, own[0]), problems)


def _element(size: int, rows: list[int], value: float) -> sparse.csr_array:
    """Return a spring or mass on one unknown, or a spring between two."""
    signs = np.array([1.0, -1.0])[: len(rows)]
    values = value * np.outer(signs, signs).ravel()
    i, j = np.repeat(rows, len(rows)), np.tile(rows, len(rows))
    return sparse.csr_array((values, (i.astype(np.int64), j.astype(np.int64))), shape=(size, size))


def _number(file: YamlFile, place: Place, problems: list[str]) -> float:
    """Return the number at a place as the text has it (YAML takes 1e3 for a word and 010 for 8)."""
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
