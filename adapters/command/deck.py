"""A template and its nodes as a deck. Its parameters are the numbers of their names."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np

from modetune.adapters.command.settings import CommandSettings
from modetune.adapters.command.template import (
    N_MODES,
    SHOWN_MODES,
    Spot,
    Template,
    read_template,
    read_value,
)
from modetune.adapters.deck_numbers import Number, moved_numbers
from modetune.adapters.solver import Deck, ModelSummary
from modetune.adapters.test_files.measurements import read_measurement
from modetune.core.errors import CampaignError, ModelError
from modetune.core.mesh import Cells, Mesh
from modetune.core.parameters import Parameter, Values, assigned
from modetune.core.storage.files import writing

logger = logging.getLogger(__name__)

#: Folder next to an updated template for the deck that a program runs.
FILLED = "filled"


@dataclass(frozen=True, slots=True)
class EditedTemplate:
    """A template with new numbers at some of its spots."""

    template: Template
    numbers: Mapping[Spot, float]


@dataclass(frozen=True)
class CommandDeck(Deck):
    """A template, the nodes that its results have, and the parameters that edit it."""

    template: Template
    nodes: Mesh
    components: tuple[int, ...]
    parameters: tuple[Parameter, ...]

    @property
    def summary(self) -> ModelSummary:
        return ModelSummary(
            name=self.template.path.stem,
            node_ids=frozenset(self.nodes.nodes.tolist()),
            components=frozenset(self.components),
            n_elements=sum(cells.elements.size for cells in self.nodes.cells),
            solid_shapes=False,
            file=self.template.path,
        )

    def mesh(self) -> Mesh:
        return self.nodes

    def numbers(self, parameter: Parameter) -> list[Number]:
        spots = self.template.spots.get(parameter.name)
        if parameter.quantity == "variable" and not spots:
            return []
        if not spots:
            names = ", ".join(name for name in self.template.spots if name != N_MODES) or "none"
            raise ModelError(
                f"{self.template.path}: {parameter.name} does not occur; write a placeholder of "
                f"this name where its number is, or an edit under `model.command` that says where "
                f"(there are: {names})"
            )
        first = spots[0].number  # what else it scales keeps its ratio to it
        return [Number(spot, spot.number, spot.where, spot.number != first) for spot in spots]

    def written(self, parameter: Parameter, value: float) -> float:
        for spot in self.template.spots.get(parameter.name, ())[:1]:
            read = read_value(spot.written(parameter.number(spot.number, value)))
            return parameter.relative_to(spot.number, read)
        return value

    def edited(self, values: Values) -> EditedTemplate:
        return EditedTemplate(self.template, self._moved(values))

    def _moved(self, values: Values) -> dict[Spot, float]:
        """Return new numbers of the template. Raises ModelError."""
        return {
            number.place: there
            for parameter, value in assigned(self.parameters, values)
            if parameter.quantity != "variable"
            for number, there in moved_numbers(parameter, self.numbers(parameter), value)
        }

    def write_updated(self, values: Values, folder: Path) -> Path:
        """Write the template with new values, and below FILLED the deck that a program runs."""
        numbers = self._moved(values)
        texts = self.template.updated(numbers)
        if self.template.has_placeholders:
            filled = self.template.filled(numbers, SHOWN_MODES)
            texts |= {f"{FILLED}/{name}": text for name, text in filled.items()}
        for name, text in texts.items():
            with writing(folder / name) as part:
                part.write_bytes(text)
        return folder / self.template.files[0].name


def read_deck(
    deck: Path, settings: CommandSettings, parameters: tuple[Parameter, ...]
) -> CommandDeck:
    """Read a template and its nodes. Raises ModelError with every problem, with file and line."""
    template = read_template(deck, settings)
    if parameters:
        known = {N_MODES, *(parameter.name for parameter in parameters)}
        for name, spots in template.spots.items():
            if name not in known:
                logger.warning(
                    "%s: %s is no parameter of the campaign, and keeps its value %g",
                    spots[0].where,
                    name,
                    spots[0].number,
                )
    mesh = _read_nodes(deck.parent / settings.nodes, settings.metres)
    if set(settings.components) == set(range(1, 7)):
        lines = [item.elements.tolist() for item in mesh.cells if item.kind == "line"]
        mesh = replace(mesh, bars=frozenset(chain(*lines)))
    return CommandDeck(template, mesh, settings.components, parameters)


def _read_nodes(path: Path, metres: float) -> Mesh:
    """Return the nodes of a file of points, lines and faces as elements between them.

    metres: of the deck's unit of length, into which the file's is brought where both are known.
    """
    try:
        points = read_measurement([path]).geometry
    except CampaignError as error:
        raise ModelError(f"{error} (`nodes` under `model.command`)") from error
    if points is None:
        raise ModelError(
            f"{path} holds no points; `nodes` under `model.command` names a table "
            "`node,x,y,z`, a universal file or HDF5 with the nodes that results have"
        )
    scale = points.metres / metres
    order = np.argsort(points.nodes)
    n_lines, n_faces = points.lines.shape[0], points.faces.shape[0]
    cells = (
        Cells("line", np.arange(1, n_lines + 1), points.lines),
        Cells("triangle", np.arange(n_lines + 1, n_lines + n_faces + 1), points.faces),
    )
    turned = np.abs(points.frames - np.eye(3)).max(axis=(1, 2), initial=0.0) > 0.0
    return Mesh(
        points.nodes[order],
        points.coordinates[order] * (scale if np.isfinite(scale) else 1.0),
        tuple(item for item in cells if item.elements.size),
        {int(points.nodes[row]): points.frames[row] for row in np.flatnonzero(turned)},
    )
