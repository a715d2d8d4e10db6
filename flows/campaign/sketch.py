"""A deck instead of a campaign file: a campaign without parameters, with or without a test.

The solver follows from the form of the deck and the programs of this machine, the units from its
materials. Both are reported; the settings `model.solver` and `model.units` (`--solver`, `--units`)
override them.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from modetune.adapters.regular_file import open_regular
from modetune.adapters.solver import Solver
from modetune.adapters.yaml_file import DECK_SUFFIXES, YamlFile
from modetune.core.errors import CampaignError, ModelError, SolverMissing
from modetune.flows.campaign.campaign import Campaign, load_campaign
from modetune.flows.campaign.schema import ModelSection, OpenFile, override
from modetune.flows.campaign.solvers import bind_solver, is_nastran
from modetune.flows.campaign.units import Units, guessed_units
from modetune.flows.responses.section import section_problems

logger = logging.getLogger(__name__)

#: Files of campaigns, and of models that are matrices.
YAML = (".yaml", ".yml")
#: Results and listings of solvers, which may repeat the deck.
RESULTS = (".f06", ".op2", ".pch", ".pnh", ".frd", ".out", ".log")
#: A line that every deck has among its first characters.
DECK_LINE = re.compile(
    r"^(\*(HEADING|NODE|ELEMENT|INCLUDE|MATERIAL|PART)\b|BEGIN\s+BULK|CEND\s*$|GRID\*?[\s,]+\d)",
    re.IGNORECASE | re.MULTILINE,
)
LOOKED_AT = 1 << 18
#: Programs that run Nastran decks, in the order in which they are tried.
RUN_NASTRAN = ("nastran", "mystran", "calculix")
#: Ends of the names of files of matrix models.
OF_MATRICES = (".yaml", ".yml")
#: The place of a campaign without a file, for messages.
PLACE = Path("the command line")


@dataclass(frozen=True, slots=True)
class DeckSketch:
    """A deck with the solver that runs it.

    model: its settings. units: None where unknown. by_solver, by_units: how solver and units were
    found, empty where the user gave them.
    """

    deck: Path
    model: ModelSection
    name: str
    solver: Solver
    units: Units | None
    by_solver: str = ""
    by_units: str = ""


def is_deck(path: Path) -> bool:
    """Return whether a file is a deck, by its name or its beginning."""
    suffix = path.suffix.lower()
    if suffix in (*YAML, *RESULTS) or not path.is_file():
        return False
    if suffix in DECK_SUFFIXES:
        return True
    try:
        with open_regular(path) as file:
            start = file.read(LOOKED_AT)
    except OSError:
        return False
    return b"\0" not in start and DECK_LINE.search(start.decode("latin-1")) is not None


def is_matrix_model(path: Path) -> bool:
    """Return whether a YAML file is a model: matrices, or masses and springs."""
    if path.suffix.lower() not in YAML:
        return False
    try:
        with open_regular(path) as file:
            start = file.read(LOOKED_AT).decode("utf-8", "replace")
    except OSError:
        return False
    return re.search(r"^(stiffness|masses):", start, re.MULTILINE) is not None


def open_model(path: Path, settings: Sequence[str] = (), tests: Sequence[Path] = ()) -> Campaign:
    """Load a campaign file, or a deck as a campaign.

    tests: files of a test, instead of the campaign's own. Raises CampaignError, ModelError.
    """
    if not path.exists():
        raise CampaignError(
            f"{path} cannot be read: it is not there; expected a campaign file or a deck"
        )
    by_solver = any(item.startswith("model.solver=") for item in settings)
    if tests:
        files = json.dumps([str(item.resolve()) for item in tests])  # YAML, whatever their names
        settings = [*settings, f"test.modes={files}", "test.use=null"]
    if is_matrix_model(path):
        settings = settings if by_solver else [*settings, "model.solver=matrices"]
    elif not is_deck(path) and not (by_solver and path.suffix.lower() not in YAML):
        return load_campaign(path, list(settings), OpenFile)
    sketch = sketch_deck(path, settings)
    if sketch.by_solver:
        logger.warning("solver: %s, which %s", sketch.name, sketch.by_solver)
    if sketch.units is None and tests and sketch.solver.deck.mesh().nodes.size:
        raise CampaignError(
            f"the units of {path} are unknown ({sketch.by_units}), so a test cannot be aligned; "
            "give --units"
        )
    if sketch.by_units:
        assumed = f"units: assumed {sketch.units}, because"
        if sketch.units is None:
            assumed = "units: unknown, masses in kg assume m-kg-s;"
        logger.warning("%s %s; --units sets others", assumed, sketch.by_units)
    return sketched_campaign(sketch, settings)


def sketched_campaign(sketch: DeckSketch, settings: Sequence[str] = ()) -> Campaign:
    """Return the campaign of a deck without a file. Raises CampaignError."""
    model = {
        "deck": str(sketch.deck.resolve()),
        "solver": sketch.name,
        "units": sketch.units or "m-kg-s",
    }
    text = json.dumps({"name": campaign_name(sketch.deck), "model": model})
    return load_campaign(YamlFile(PLACE, text, {}, {}, {}), list(settings), OpenFile, sketch.solver)


def campaign_name(deck: Path) -> str:
    """Return a campaign's name from that of its deck."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", deck.stem).strip("_.-")[:64] or "model"


def sketch_deck(deck: Path, settings: Sequence[str] = ()) -> DeckSketch:
    """Bind a deck to the solver of the settings, or to the first installed one that accepts it.

    Raises CampaignError, ModelError.
    """
    own = [item for item in settings if item.startswith("model.")]
    base = {"model": {"deck": str(deck), "units": "m-kg-s"}}
    source = YamlFile(PLACE, json.dumps(base), {}, {}, {})
    try:
        section = ModelSection.model_validate(override(source, own)["model"])
    except ValidationError as error:
        raise CampaignError(section_problems(error, source, ModelSection, "model")) from None
    solver, name, by_solver = _bound(section, deck)
    if any(item.startswith("model.units=") for item in own):
        return DeckSketch(deck, section, name, solver, section.units, by_solver)
    units, by_units = guessed_units(solver)
    return DeckSketch(deck, section, name, solver, units, by_solver, by_units)


def _bound(section: ModelSection, deck: Path) -> tuple[Solver, str, str]:
    """Return the solver, its name, and how it was found.

    Raises ModelError with the reason of each solver that refuses the deck."""
    if "solver" in section.model_fields_set:
        return bind_solver(section, deck, ()), section.solver, ""
    if deck.suffix.lower() in OF_MATRICES:
        matrices = section.model_copy(update={"solver": "matrices"})
        return bind_solver(matrices, deck, ()), "matrices", ""
    if not is_nastran(deck):
        return bind_solver(section, deck, ()), section.solver, ""
    refused: dict[str, str] = {}
    for name in RUN_NASTRAN:
        try:
            solver = bind_solver(section.model_copy(update={"solver": name}), deck, ())
            solver.program.version()
        except SolverMissing:
            refused[name] = "not installed (see `modetune doctor`)"
            continue
        except ModelError as error:
            refused[name] = str(error)
            continue
        how = "runs it by translation" if name == "calculix" else "runs Nastran decks"
        missing = f"; not usable: {', '.join(refused)}" if refused else ""
        return solver, name, f"{how}{missing}; --solver selects another"
    by_reason: dict[str, list[str]] = {}
    for name, text in refused.items():
        by_reason.setdefault(text, []).append(name)
    reasons = (f"{' and '.join(names)}: {text}" for text, names in by_reason.items())
    raise ModelError("\n".join((f"no solver can run {deck}:", *reasons)))
