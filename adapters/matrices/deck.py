"""The model's file: a YAML mapping that is a spring-mass system, or names matrix files.

A spring-mass system; each mass is one unknown, component x of node 1, 2, ... in their order:

    masses:  {m1: 2.0, m2: 2.5}
    springs:
      k1: {between: [ground, m1], stiffness: 1100.0}
      k2: {between: [m1, m2], stiffness: 1000.0}
    dampers:                                     # optional; modes leave them aside
      c1: {between: [ground, m1], viscous: 0.4}
      h2: {between: [m1, m2], structural: 10.0}  # imaginary part of a stiffness

Matrices (`matrix_files.py` has the forms); unknown i is component x of node i unless `dofs` names
a text file with a `node.component` a line:

    stiffness: K.mtx
    mass: M.mtx
    dofs: dofs.txt
    parts:
      wing: {stiffness: K_wing.mtx, mass: M_wing.npz}
      joint: {stiffness: "parts.h5:joint/K"}

An updated model is the same text with other numbers, or the same files with other matrices in
them: parts are then scaled too, so that 1 is again the value in the file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from modetune.adapters.matrices.index import read_index, write_index
from modetune.adapters.matrices.model import Factors, MatrixModel
from modetune.adapters.matrices.spring_mass import read_spring_mass
from modetune.adapters.numbers import Number
from modetune.adapters.solver import Deck, ModelSummary
from modetune.adapters.yaml_file import Place, YamlFile, read_yaml
from modetune.core.errors import CampaignError, ModelError
from modetune.core.modes import Integers
from modetune.core.near_names import suggestion
from modetune.core.parameters import Parameter, Values, assigned
from modetune.core.storage.files import storage_errors, writing
from modetune.core.updating.damping import DampingModel
from modetune.core.updating.observation import Observation, observe
from modetune.core.updating.results import MatrixResult

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

    values: where each part's number stands in a spring-mass system; empty for matrix files.
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
            matrices=model.matrices,
        )

    def numbers(self, parameter: Parameter) -> list[Number]:
        if parameter.expression:
            raise ModelError(
                "relations between parameters are unavailable for a model of matrices; update its "
                "parts themselves"
            )
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

    def energy_sets(self, parameter: Parameter) -> tuple[str, ...]:
        parts = self.model.targets(parameter)
        own = parameter.proportional and all(part.mass is None for part in parts)
        return parameter.targets if parts and own else ()

    def is_linear(self, parameter: Parameter) -> bool:
        return True

    def observation(
        self, matrices: MatrixResult, nodes: Integers, components: Integers
    ) -> Observation:
        return observe(matrices, nodes, components)

    def undamped(self) -> str:
        if self.model.damping(self.parameters).dampers:
            return ""
        return f"{self.file.path}: no `viscous` or `structural` damping stands in the model"

    def damping(self, base: MatrixResult) -> DampingModel:
        return self.model.damping(self.parameters)

    def edited(self, values: Values) -> EditedMatrices:
        return EditedMatrices(self.model, self._factors(values))

    def write_updated(self, values: Values, folder: Path) -> Path:
        return write_updated(self, self._factors(values), folder)

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
