"""A draft of a campaign for a deck: model, test, sensors and parameters, as values and as text.

The text has a comment for each key, and the candidate parameters by quantity.
"""

from __future__ import annotations

import json
import os
import re
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import get_args

import numpy as np
import yaml

from modetune.adapters.solver import ModalCase
from modetune.adapters.test_files.measurements import (
    inspect_files,
    read_histories,
    read_measurement,
)
from modetune.core.errors import CampaignError
from modetune.core.measurement.measurement import Measurement
from modetune.core.storage.files import writing
from modetune.flows.campaign.campaign import load_campaign
from modetune.flows.campaign.mapping import Mapping
from modetune.flows.campaign.schema import CampaignFile, OpenFile
from modetune.flows.campaign.sketch import (
    DeckSketch,
    campaign_name,
    is_deck,
    sketch_deck,
    sketched_campaign,
)
from modetune.flows.campaign.solvers import modal_cases
from modetune.flows.campaign.units import METRES, Units
from modetune.flows.studies.identify.identification import IdentificationSettings
from modetune.flows.studies.identify.measured_functions import SpectraSettings, read_functions
from modetune.flows.studies.identify.operational_modes import identify_test
from modetune.flows.studies.init.candidate_parameters import Candidate, candidates
from modetune.flows.studies.init.design_parameters import (
    REACHES,
    DesignDraft,
    DesignParameter,
    design_parameters,
)

#: Settings of `test.sensors` to try, and the meaning of each.
POSES: tuple[tuple[dict[str, str], str], ...] = (
    ({}, "the test's axes are taken as the model's; `modetune sensors` shows each sensor's node"),
    ({"align": "fit"}, "rotation and translation were found from the points alone: look at them "
     "with `modetune sensors --picture sensors.png`"),
    ({"unmapped": "leave_out"}, "the test's axes are taken as the model's; some sensors have no "
     "node near them and are left out: look with `modetune sensors --picture sensors.png`"),
    ({"align": "fit", "unmapped": "leave_out"}, "rotation and translation were found from the "
     "points alone, and some sensors have no node near them: look with `modetune sensors`"),
)  # fmt: skip


NO_DESIGN = DesignDraft()


@dataclass(frozen=True, slots=True)
class TestDraft:
    """The test's files as the campaign names them, and how its sensors find their nodes.

    identified: the file of modes that was made from response functions, None where there were
    modes; sensors: the settings of `test.sensors`; about: what these mean; mapping: what they give.
    """

    files: tuple[Path, ...]
    measurement: Measurement
    identified: Path | None
    sensors: dict[str, str]
    about: str
    mapping: Mapping

    @property
    def has_shapes(self) -> bool:
        return self.measurement.modes is not None and self.measurement.modes.has_shapes


@dataclass(frozen=True, slots=True)
class Draft:
    """A campaign that was drafted; path: of its file; cases: subcases or steps to choose from."""

    path: Path
    sketch: DeckSketch
    test: TestDraft | None
    candidates: tuple[Candidate, ...]
    cases: tuple[ModalCase, ...] = ()
    design: DesignDraft = NO_DESIGN

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the free parameters."""
        own = tuple(item.name for item in self.design.parameters if item.variable is not None)
        return own or tuple(item.parameter.name for item in self.free)

    @property
    def free(self) -> tuple[Candidate, ...]:
        return tuple(item for item in self.candidates if item.free)

    @property
    def next(self) -> tuple[str, ...]:
        """The next commands, each with its purpose."""
        name = os.path.relpath(self.path)
        check = (f"modetune check {name}", "checks model, test and sensors before updating")
        if self.test is None:
            more = [(f"modetune modes {name}", "computes the model's modes")]
            more += [(f"modetune pretest {name}", "proposes places for sensors and exciters")]
        else:
            more = [(f"modetune screen {name}", "shows which parameters this test can determine")]
            more += [(f"modetune update {name}", "updates the model")]
        width = max(len(command) for command, _ in (check, *more))
        return tuple(f"{command:{width}}  {what}" for command, what in (check, *more))


def draft_campaign(
    deck: Path, tests: Sequence[Path], settings: Sequence[str], path: Path, force: bool = False
) -> Draft:
    """Draft a campaign for a deck, which is written to a path by `write_draft`.

    Raises CampaignError, ModelError for why there can be none.
    """
    cases = modal_cases(deck) if is_deck(deck) else ()
    if cases and not any(item.startswith(f"model.{cases[0].key}=") for item in settings):
        proposed = next((item for item in cases if item.default), cases[0])
        settings = [*settings, f"model.{proposed.key}={proposed.number}"]
    sketch = sketch_deck(deck, settings)
    found = candidates(sketch.solver)
    if not found:
        raise CampaignError(
            f"{deck} has nothing to update: {sketch.name} finds no number of a material, property, "
            "spring or mass that its elements use"
        )
    test = _test(sketch, tests, path.parent, force) if tests else None
    return Draft(path, sketch, test, tuple(found), cases)


def keep(path: Path, force: bool) -> None:
    """Leave a file that is there, unless forced. Raises CampaignError."""
    if path.exists() and not force:
        raise CampaignError(
            f"{path} exists already; name another file with --out, or overwrite it with --force"
        )


def _test(sketch: DeckSketch, tests: Sequence[Path], folder: Path, force: bool) -> TestDraft:
    """Return the test, with modes identified if it has response functions or recordings."""
    measurement, files, identified = inspect_files(tests).measurement, tuple(tests), None
    if measurement.modes is None:
        recordings = [path for path in tests if read_histories([path])[0]]
        functions, outputs = read_functions(recordings or tests, SpectraSettings())
        geometry = measurement.geometry or functions.geometry
        identified = _identified_file(folder, tests)
        keep(identified, force)
        whole = replace(functions, geometry=geometry)
        identify_test(whole, outputs, IdentificationSettings(), tests, identified)
        files = (identified, *(path for path in tests if path not in recordings and geometry))
        measurement = read_measurement(files)
    problems: list[str] = []
    for sensors, about in POSES if measurement.geometry is not None else POSES[::2]:
        named = [f"test.sensors.{key}={value}" for key, value in sensors.items()]
        files_named = f"test.modes={[str(item.resolve()) for item in files]}"
        try:
            mapping = sketched_campaign(sketch, [files_named, *named]).case.mapping
        except CampaignError as error:
            problems += [item for item in error.problems if item not in problems]
            continue
        if mapping.alignment is None:
            about = "each sensor is the node with the same number"
        return TestDraft(files, measurement, identified, sensors, about, mapping)
    raise CampaignError([f"the test cannot be mapped onto {sketch.deck}:", *problems])


#: Columns of the text.
WIDTH = 100


def campaign_text(draft: Draft) -> str:
    """Return the text of the campaign file, which runs without changes."""
    parts = (_head(draft), _model(draft), _test_lines(draft), _parameters(draft), _rest(draft))
    return "\n".join(line for part in parts for line in part) + "\n"


def _said(text: str, indent: str = "") -> list[str]:
    """Return a comment wrapped to the width."""
    return textwrap.wrap(
        " ".join(text.split()),
        WIDTH,
        initial_indent=f"{indent}# ",
        subsequent_indent=f"{indent}# ",
        break_long_words=False,
        break_on_hyphens=False,
    )


def _head(draft: Draft) -> Iterator[str]:
    yield from _said(
        f"A campaign for {draft.sketch.deck.name}, drafted by `modetune init`. Text after # is a "
        "comment. The documentation explains each key (`keys`); `modetune check` reports errors."
    )
    yield f"name: {_word(campaign_name(draft.sketch.deck))}  # names the folder runs/NAME"
    yield ""


def _model(draft: Draft) -> Iterator[str]:
    sketch = draft.sketch
    yield "model:"
    yield f"  deck: {_word(_beside(draft, sketch.deck))}"
    if sketch.by_solver:
        yield from _said(f"{sketch.name} {sketch.by_solver.partition(';')[0]}; others that may: "
                         "calculix (by translation), nastran, mystran", "  ")  # fmt: skip
    yield f"  solver: {sketch.name}"
    for item in draft.cases:
        if item.number == getattr(sketch.model, item.key):
            others = ", ".join(str(other) for other in draft.cases if other is not item)
            yield from _said(
                f"PLEASE CHECK: {item.key} {item} of several; others: {others}. States of one "
                "structure that were tested separately are `configurations`.", "  "
            )  # fmt: skip
            yield f"  {item.key}: {item.number}"
    others = ", ".join(unit for unit in get_args(Units) if unit != sketch.units)
    if sketch.units is None:
        yield from _said(
            f"PLEASE CHECK: the units are unknown ({sketch.by_units}); m-kg-s is a placeholder. "
            f"Others: {others}", "  "
        )  # fmt: skip
    elif sketch.by_units:
        yield from _said(
            f"PLEASE CHECK, a guess: {sketch.by_units}; others: {others}. Frequencies do not "
            "depend on it, masses in kg and the places of sensors do.", "  "
        )  # fmt: skip
    yield f"  units: {sketch.units or 'm-kg-s'}"
    yield ""


def _test_lines(draft: Draft) -> Iterator[str]:
    test = draft.test
    if test is None:
        yield from _said(
            "No test yet. When there is one, take the # away from these lines: modes as CSV, "
            "universal file or HDF5 (`modetune identify` makes them from response functions)."
        )
        yield "# test:"
        yield "#   modes: measured.unv"
        yield "#   sensors: {align: none}  # or fit: finds how the test's points lie in the model"
        yield ""
        return
    modes = test.measurement.modes
    assert modes is not None
    yield "test:"
    if test.identified is not None:
        yield from _said(
            f"modes identified from the response functions over their whole band; look at them "
            f"with `modetune identify {test.files[-1].name} --figures figures`, and name those "
            "that are real under `use`", "  "
        )  # fmt: skip
    hz = modes.modes.frequencies_hz
    yield from _said(
        f"{len(modes.numbers)} modes from {hz.min():.4g} to {hz.max():.4g} Hz at "
        f"{modes.modes.n_dof} sensors", "  "
    )  # fmt: skip
    names = ", ".join(_word(_beside(draft, path)) for path in test.files)
    yield f"  modes: {names}" if len(test.files) == 1 else f"  modes: [{names}]"
    yield from _said("numbers of the modes that are used; take out those you do not believe", "  ")
    yield from textwrap.wrap(
        f"use: [{', '.join(map(str, modes.numbers))}]",
        WIDTH,
        initial_indent="  ",
        subsequent_indent="    ",
    )
    yield from _sensors(draft, test)
    yield ""


def _sensors(draft: Draft, test: TestDraft) -> Iterator[str]:
    mapping, geometry = test.mapping, test.measurement.geometry
    distances = [row.distance for row in mapping.table if np.isfinite(row.distance)]
    far = f"; at most {max(distances):.3g} {mapping.unit} from their nodes" if distances else ""
    left = len(mapping.left_out)
    yield from _said(f"{test.about}{far}{f'; {left} left out' if left else ''}", "  ")
    settings = dict(test.sensors)
    if geometry is not None and mapping.alignment is not None:
        settings = {"align": "none", **settings}
        if not np.isfinite(geometry.metres):
            scale = mapping.alignment.scale * METRES[draft.sketch.units or "m-kg-s"]
            yield from _said(
                "PLEASE CHECK: the test's files do not state their unit of length; it is taken "
                f"as {scale:.4g} m. Set it with `length: mm` (m, cm, in, ft) next to `modes`.", "  "
            )  # fmt: skip
    if settings:
        yield f"  sensors: {{{', '.join(f'{key}: {value}' for key, value in settings.items())}}}"


def _parameters(draft: Draft) -> Iterator[str]:
    if draft.design.parameters:
        yield from _said(
            "The parameters are the deck's own design variables (DESVAR), in its units: bounds are "
            "their limits, deviation is how uncertain they are beforehand (10 %: PLEASE CHECK). "
            "Expressions give what their relations (DVPREL, DVMREL, DVCREL, DLINK) give."
        )
    yield from (line for text in draft.design.refused for line in _said(f"Not represented: {text}"))
    if draft.design.parameters:
        yield "parameters:"
        for own in draft.design.parameters:
            yield from _design_parameter(own)
        yield from _said(
            "Other numbers of the deck that could be parameters; their values are relative to the "
            "deck's. Use none that a design variable gives already.",
            "  ",
        )
        yield from _candidates(draft)
        yield ""
        return
    free, all_ = len(draft.free), len(draft.candidates)
    yield from _said(
        "What may change, relative to the deck's value: bounds are how far it may go, deviation is "
        "how uncertain it is beforehand (a standard deviation). "
        f"Free {'is' if free == 1 else 'are'} {free} of {all_} candidates; take a # away to free "
        "others, put one to fix them. "
        "A number without a parameter stays what the deck says."
    )
    yield "parameters:"
    yield from _candidates(draft)
    yield ""


def _candidates(draft: Draft) -> Iterator[str]:
    for quantity, group in groupby(draft.candidates, lambda item: item.expected.quantity):
        members = list(group)
        yield from _said(f"{quantity}: {members[0].expected.why}", "  ")
        for item in members:
            yield from _parameter(item)


def _design_parameter(item: DesignParameter) -> Iterator[str]:
    """Return a design variable, or a number that an expression of them gives."""
    relation = item.relation
    keys = f"name: {_word(item.name)}, quantity: {relation.quantity if relation else 'variable'}"
    if relation is not None:
        keys += f", {relation.by}: {_target(relation.targets[0])}"
        keys += f", item: {relation.item}" if relation.item else ""
    keys += ", values: absolute"
    yield from _said(item.note, "  ") if item.note else ()
    if item.variable is None:
        assert relation is not None
        yield f"  - {{{keys}, expression: {json.dumps(relation.expression)}}}"
        return
    lower, upper = item.bounds
    numbers = f"bounds: [{lower!r}, {upper!r}], deviation: {item.deviation:.6g}"
    yield f"  - {{{keys}, initial: {item.variable.initial!r}, {numbers}}}"


def _parameter(item: Candidate) -> Iterator[str]:
    own = item.parameter
    targets = [_target(name) for name in own.targets]
    target = targets[0] if len(targets) == 1 else f"[{', '.join(targets)}]"
    keys = f"name: {_word(own.name)}, quantity: {own.quantity}, {own.by}: {target}"
    if own.item:
        keys += f", item: {own.item}"
    numbers = f"bounds: [{own.lower:g}, {own.upper:g}], deviation: {own.standard_deviation:g}"
    mark = "  - " if item.free else "  # - "
    yield from _said(item.description, "  ") if item.free else ()
    yield f"{mark}{{{keys}, {numbers}}}" + ("" if item.free else f"  # {item.description}")


def _rest(draft: Draft) -> Iterator[str]:
    if draft.test is None:
        return
    yield from _said(
        "What is compared. Deviations are how exactly the test was made: 0.2 % of a frequency and "
        "5 % of a shape are those of a good modal test; better ones than yours make doubts look "
        "like findings."
    )
    shapes = draft.test.has_shapes
    yield "residuals:"
    yield "  frequency_weight: 1.0"
    if shapes:
        yield "  shape_weight: 1.0"
    yield "  frequency_deviation: 0.002"
    if shapes:
        yield "  shape_deviation: 0.05"
    yield ""
    yield "update:"
    yield "  # agreement that ends it: the largest frequency error and the lowest MAC"
    yield "  e1: {frequency: 0.01, mac: 0.9}"


def _beside(draft: Draft, path: Path) -> str:
    """A path as the campaign file names it."""
    return os.path.relpath(path.resolve(), draft.path.resolve().parent)


def _word(text: str) -> str:
    """A text as one word of YAML."""
    plain = re.fullmatch(r"[A-Za-z_./][\w./-]*", text) and yaml.safe_load(text) == text
    return text if plain else json.dumps(text)


def _target(name: str) -> str:
    """A target: numbers as Nastran decks have them, else a word."""
    return name if name.isdecimal() and str(int(name)) == name else _word(name)


def init_campaign(
    deck: Path,
    tests: Sequence[Path] = (),
    settings: Sequence[str] = (),
    out: Path | None = None,
    force: bool = False,
) -> Draft:
    """Write a campaign for a deck, next to it unless named, and read it as `check` will.

    settings: `model.solver=NAME`, `model.units=NAME`. Files that are there stay unless force.
    Raises CampaignError, ModelError for why there can be none.
    """
    path = out or deck.with_name("campaign.yaml")
    keep(path, force)
    with _removed_on_failure(_identified_file(path.parent, tests) if tests else None):
        draft = _with_design(draft_campaign(deck, tests, settings, path, force))
        try:
            _write_checked(draft)
        except CampaignError as error:
            raise CampaignError([f"a campaign for {deck} is refused:", *error.problems]) from error
    return draft


@contextmanager
def _removed_on_failure(made: Path | None) -> Iterator[None]:
    """Remove a file that is made here if anything fails, so that the command can be repeated."""
    had = made is None or made.exists()
    try:
        yield
    except BaseException:
        if made is not None and not had:
            made.unlink(missing_ok=True)
        raise


def _identified_file(folder: Path, tests: Sequence[Path]) -> Path:
    """Return the file for modes that are identified from a test."""
    return folder / f"{tests[0].stem}-modes.csv"


def _with_design(draft: Draft) -> Draft:
    """Return the draft with the deck's own design variables in place of the candidates.

    If no bounds of theirs make a campaign, the reason is added to the draft.
    """
    refused: tuple[str, ...] = ()
    for reach in REACHES:
        design = design_parameters(draft.sketch.solver, reach)
        if not design.parameters:
            return replace(draft, design=design)
        others = tuple(replace(item, free=False) for item in draft.candidates)
        found = replace(draft, design=design, candidates=others)
        try:
            _write_checked(found)
        except CampaignError as error:
            problems = (item.partition(": ")[2] or item for item in error.problems)
            why = (f"the design variables, within any bounds: {item}" for item in problems)
            refused = (*design.refused, *why)
        else:
            return found
    return replace(draft, design=DesignDraft((), refused))


def _write_checked(draft: Draft) -> None:
    """Write the campaign file and read it. Raises CampaignError, and the file is removed."""
    with writing(draft.path) as part:
        text = campaign_text(draft).encode("utf-8", "surrogateescape")  # bytes of no coding
        part.write_text(text.decode("utf-8", "replace"), encoding="utf-8")
    try:
        load_campaign(draft.path, [], CampaignFile if draft.test else OpenFile)
    except CampaignError:
        draft.path.unlink()
        raise
