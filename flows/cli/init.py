"""`modetune init`: a campaign file for a deck. Heavy packages are imported where needed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.near_names import listed
from modetune.core.storage.keys import Json
from modetune.flows.cli.options import AsJson, show_progress, stoppable
from modetune.flows.cli.output import print_result
from modetune.flows.report.tables import json_object
from modetune.flows.studies.study import (
    SolverChoice,
    StepChoice,
    SubcaseChoice,
    UnitsChoice,
    with_model,
)

if TYPE_CHECKING:
    from modetune.flows.studies.init.draft import Draft


def init(
    deck: Annotated[Path, typer.Argument(help="The deck: CalculiX, Nastran or matrices.")],
    test: Annotated[
        list[Path] | None, typer.Argument(help="Files of its test, if there is one.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="File to write; default: campaign.yaml next to the deck."),
    ] = None,
    solver: SolverChoice = None,
    units: UnitsChoice = None,
    subcase: SubcaseChoice = None,
    step: StepChoice = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite existing files.")] = False,
    as_json: AsJson = False,
) -> None:
    """Draft a campaign file for a deck, with its test, sensors and parameters."""
    with (
        stoppable("stopped; the same command starts from the beginning"),
        show_progress(f"reading {deck}"),
    ):
        from modetune.flows.studies.init.draft import init_campaign

        settings = with_model(None, solver, units, subcase, step)
        draft = init_campaign(deck, test or [], settings, out, force)
    print_result(summary(draft), _lines(draft), as_json)


def summary(draft: Draft) -> dict[str, Json]:
    """Return the JSON object of a draft."""
    test, sketch = draft.test, draft.sketch
    return json_object(
        draft,
        "next",
        status="written",
        written=[draft.path, *([test.identified] if test and test.identified else [])],
        solver=sketch.name,
        units=sketch.units or "m-kg-s",
        units_known=sketch.units is not None,
        units_guessed=sketch.by_units,
        subcase=sketch.model.subcase,
        step=sketch.model.step,
        cases=[json_object(item, "key number about") for item in draft.cases],
        parameters=list(draft.names),
        candidates=[
            json_object(
                item.parameter,
                "name quantity by targets",
                value=item.value,
                free=item.free,
                where=item.where,
            )
            for item in draft.candidates
        ],
        sensors=None if test is None else test.sensors,
    )


def _lines(draft: Draft) -> list[str]:
    """Return what the draft contains and what to do next."""
    sketch, test = draft.sketch, draft.test
    how = f", which {sketch.by_solver}" if sketch.by_solver else ""
    texts = [f"model    {sketch.deck}, on {sketch.name}{how}"]
    if sketch.units is None:
        texts.append(f"units    UNKNOWN ({sketch.by_units}): enter them in the file")
    else:
        why = f"; guessed: {sketch.by_units}" if sketch.by_units else ""
        texts.append(f"units    {sketch.units}{why}")
    for item in draft.cases:
        if item.number == getattr(sketch.model, item.key):
            others = listed([str(other) for other in draft.cases if other is not item])
            texts.append(f"{item.key:8} {item}; others: {others}")
    if test is not None:
        modes, left = test.measurement.modes, len(test.mapping.left_out)
        assert modes is not None
        at = f"identified into {test.identified}, at" if test.identified else "at"
        out = f", {left} left out" if left else ""
        texts += [
            f"test     {len(modes.numbers)} modes {at} {len(test.mapping.table)} sensors{out}",
            f"sensors  {test.about}",
        ]
    free = list(draft.names)
    refused = draft.design.refused
    if draft.design.parameters:
        texts.append(f"free     the deck's {len(free)} design variables: {listed(free)}")
    else:
        texts.append(
            f"free     {len(free)} of {len(draft.candidates)} candidate parameters: "
            f"{listed(free)}; the others are commented out"
        )
    if refused:
        texts.append(f"design   {len(refused)} remarks on design cards are in the file")
    return [*texts, f"written: {draft.path}", "", "Read it, then:", *(f"  {x}" for x in draft.next)]
