"""The file behind a model that is a function of Python: its values and the names of its rows.

    function: storeys (own.py, line 12)
    values: {k1: 9106.4, k2: 9106.4}
    dofs: [1.x, 2.x]

`values` are what parameters scale, by their names; `dofs` names the rows of what the function
returns. The function itself is in no file that could run it: only the Python session that has it
can.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml

from modetune.adapters.deck_numbers import Number, moved_numbers
from modetune.adapters.solver import Deck, ModelSummary
from modetune.adapters.yaml_file import YamlFile, read_yaml
from modetune.core.errors import CampaignError, ModelError
from modetune.core.modes import COMPONENTS, Integers
from modetune.core.near_names import suggestion
from modetune.core.parameters import Parameter, Values, assigned
from modetune.core.storage.files import writing


@dataclass(frozen=True)
class EditedFunction:
    """The values that a function gets, by name, and its deck."""

    deck: FunctionDeck
    values: dict[str, float]


@dataclass(frozen=True)
class FunctionDeck(Deck):
    """The values that a function starts from, and the parameters that change them.

    nodes, components: (n_dof,), of the rows of what it returns.
    """

    file: YamlFile
    values: Mapping[str, float]
    nodes: Integers
    components: Integers
    parameters: tuple[Parameter, ...]

    @property
    def summary(self) -> ModelSummary:
        return ModelSummary(
            name=self.file.path.stem,
            node_ids=frozenset(self.nodes.tolist()),
            components=frozenset(self.components.tolist()),
            n_elements=0,
            solid_shapes=False,
            file=self.file.path,
        )

    def numbers(self, parameter: Parameter) -> list[Number]:
        if parameter.name in self.values:
            where = self.file.where(("values", parameter.name))
            return [Number(parameter.name, self.values[parameter.name], where)]
        if parameter.quantity == "variable":
            return []
        raise ModelError(
            f"{self.file.where(('values',))}: {parameter.name} has no value"
            f"{suggestion(parameter.name, self.values)}; give the parameter a `value`"
        )

    def edited(self, values: Values) -> EditedFunction:
        moved = {
            number.place: there
            for parameter, value in assigned(self.parameters, values)
            for number, there in moved_numbers(parameter, self.numbers(parameter), value)
        }
        return EditedFunction(self, {**self.values, **moved})

    def write_updated(self, values: Values, folder: Path) -> Path:
        path = folder / self.file.path.name
        content = {**self.file.data, "values": self.edited(values).values}
        text = yaml.safe_dump(content, sort_keys=False)
        with writing(path) as part:
            part.write_text(text, encoding="utf-8")
        return path


def read_deck(path: Path, parameters: tuple[Parameter, ...]) -> FunctionDeck:
    """Read the file of a function's values. Raises ModelError."""
    try:
        file = read_yaml(path, "a function's values")
    except CampaignError as error:
        raise ModelError(str(error)) from error
    values, dofs = file.data.get("values"), file.data.get("dofs")
    if not isinstance(values, dict) or not values or not isinstance(dofs, list) or not dofs:
        raise ModelError(f"{path}: the file of a function requires `values` and `dofs`")
    named = [str(dof).rpartition(".") for dof in dofs]
    try:
        numbers = {str(name): float(value) for name, value in values.items()}
        nodes = [int(node) for node, _, _ in named]
        components = [COMPONENTS.index(axis) + 1 for _, _, axis in named]
    except (TypeError, ValueError) as error:
        raise ModelError(f"{path}: {error}") from error
    return FunctionDeck(file, numbers, np.array(nodes), np.array(components), parameters)
