"""`modetune localise`: locations of modelling errors, and whether parameters can correct them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, nan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modetune.core.errors import CampaignError
from modetune.core.near_names import listed
from modetune.core.storage.keys import Json
from modetune.flows.report.tables import Column, Table, json_object, table_of
from modetune.flows.studies.result import StudyResult, near
from modetune.flows.studies.study import (
    CampaignOptions,
    Figures,
    ModelState,
    Runs,
    StudyContext,
    study,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from modetune.core.mesh import Mesh
    from modetune.core.updating.localisation import Removal
    from modetune.flows.campaign.campaign import Campaign
    from modetune.flows.report.chart import Chart
    from modetune.flows.studies.localise.apply import Applied
    from modetune.flows.studies.localise.error_maps import ErrorMaps
    from modetune.flows.studies.localise.localisation import Localisation

#: Rows that a terminal shows of each table.
SHOWN = 12
#: A best share of the force residual below this identifies no group.
DISTINCT = 0.2
#: Added lines of a deck that a terminal shows.
CARDS = 12
#: Nodes of each map in the JSON object, the worst.
NODES = 200


@dataclass(frozen=True)
class LocaliseOptions(CampaignOptions):
    """Options of the localisation, which draws figures."""

    figures: Figures = None
    runs: Runs = Path("runs")

    def folder(self, campaign: Campaign) -> Path:
        return self.runs / campaign.name


@study(LocaliseOptions)
def localise(
    on: StudyContext,
    record: Annotated[
        Path | None,
        typer.Option(help="Run folder or campaign.h5 whose updated model to examine."),
    ] = None,
    state: Annotated[
        ModelState | None,
        typer.Option(
            help="Model to examine; default: updated, as the run folder has it, or initial where "
            "there is no update yet."
        ),
    ] = None,
    configuration: Annotated[
        str | None,
        typer.Option(help="Configuration to examine alone; default: all of them together."),
    ] = None,
    changes: Annotated[
        bool,
        typer.Option(help="Look for masses, springs and absorbers that the model lacks."),
    ] = True,
    apply: Annotated[
        int | None,
        typer.Option(min=1, help="Write the change of this number into a new deck and campaign."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="The new campaign file of --apply, in the campaign's folder (.yaml)."),
    ] = None,
) -> StudyResult:
    """Locate modelling errors, and propose changes of the model that remove them.

    Examines the updated model, or the initial one where there is no update yet: maps of the error,
    what parameters can remove, whether any can remove all, and masses, springs and absorbers that
    the model may lack. --apply 1 --out FILE writes the first of these into a new deck and campaign.
    """
    from modetune.flows.studies.localise.localisation import examined_state, one_model
    from modetune.flows.studies.localise.localisation import localise as find

    _check_apply(on.campaign, changes, apply, out)
    examined = examined_state(on.campaign, record, state, on.folder)
    on.working(f"modes and sensitivities at {examined.text}")
    found = find(on.campaign, examined, configuration, changes, on.working)
    campaign = one_model(on.campaign, configuration)
    charts: Mapping[str, Chart | Figure] = {}
    if on.charted:
        from modetune.flows.studies.localise.figures import localisation_figures

        model = "updated" if found.updated else "initial"
        title = f"{on.campaign.name}: where the {model} model is wrong"
        mesh, surface = campaign.cases[0].solver.deck.mesh(), campaign.cases[0].surface
        charts = localisation_figures(title, found, mesh, surface)
    mesh, lines, written = campaign.cases[0].solver.deck.mesh(), _lines(found), list[Path]()
    if apply is not None and out is not None:
        made = _applied(on.campaign, found, apply, out)
        written = [made.campaign, *made.decks]
        lines += [f"added: {line}" for line in made.cards[:CARDS]]
        if len(made.cards) > CARDS:
            lines.append(f"and {len(made.cards) - CARDS} more lines")
        lines.append(f"`modetune update {near(made.campaign)}` continues with it")
    return StudyResult(
        found,
        found.sentence,
        summary(found, mesh),
        tables(found, mesh),
        lines,
        written=written,
        charts=charts,
    )


def _check_apply(campaign: Campaign, changes: bool, apply: int | None, out: Path | None) -> None:
    """Raise CampaignError for what cannot be applied, before anything runs."""
    if (apply is None) != (out is None):
        raise CampaignError("--apply and --out go together: `--apply 1 --out new_campaign.yaml`")
    if apply is not None and not changes:
        raise CampaignError("--apply needs the changes that --no-changes leaves out")
    if out is not None:
        from modetune.flows.studies.localise.apply import check_place

        check_place(campaign, out)


def _applied(campaign: Campaign, found: Localisation, number: int, out: Path) -> Applied:
    from modetune.flows.studies.localise.apply import applied

    if found.proposals is None:
        raise CampaignError(f"--apply: no changes were found, {found.why_no_proposals}")
    known = found.proposals.found
    if number > len(known):
        raise CampaignError(f"--apply {number}: there are {len(known)} changes")
    return applied(campaign, known[number - 1], out)


def summary(found: Localisation, mesh: Mesh) -> dict[str, Json]:
    """Return the JSON object of a localisation."""
    from modetune.flows.report.form_verdict import form_json
    from modetune.flows.studies.localise.proposal_report import proposals_json

    values = zip(found.parameters, found.theta.tolist(), strict=True)
    return json_object(
        found,
        "modes why_no_maps why_no_proposals examined updated remarks",
        status="done",
        parameters=[{"name": name, "value": value} for name, value in values],
        model_form=form_json(found.form, found.verdict.labels, found.sentence),
        singles=_removals(found, found.singles),
        pairs=_removals(found, found.pairs),
        maps=None if found.maps is None else _maps_json(found.maps),
        proposals=None if found.proposals is None else proposals_json(found.proposals, mesh),
        solver_runs=found.runs,
    )


@dataclass(frozen=True, slots=True)
class RemovalRow:
    """Share of the weighted residual that parameters together can remove; 1 is all."""

    parameters: Annotated[tuple[str, ...], Column("parameters", words=True)]
    changes: Annotated[tuple[float, ...], Column("by a change of", "%", "+.1f")]
    on_bound: Annotated[bool, Column("on a bound")]
    removed: Annotated[float, Column("residual removed", "%", ".1f")]


@dataclass(frozen=True, slots=True)
class GroupRow:
    """Modelling error of a group of elements; docs/localisation.md explains each value."""

    name: Annotated[str, Column("group")]
    force_share: Annotated[float, Column("force residual explained", "%", ".1f")]
    change: Annotated[float, Column("by a change of", "%", "+.1f")]
    on_bound: Annotated[bool, Column("on a bound")]
    change_range: Annotated[tuple[float, ...], Column("without one sensor", "%", "+.1f")]
    error_share: Annotated[float, Column("error's energy in it", "%", ".1f")]
    concentration: Annotated[float, Column("times its share of all energy", form=".2f")]
    energy_difference: Annotated[float, Column("energy difference", "%", ".2f")]
    strain_energy_difference: tuple[float, ...]
    kinetic_energy_difference: tuple[float, ...]


def _removals(found: Localisation, items: Sequence[Removal]) -> list[RemovalRow]:
    return [
        RemovalRow(
            tuple(found.parameters[place] for place in item.members),
            tuple(item.changes.tolist() if item.explains else [nan] * item.changes.size),
            item.at_bound and item.explains,
            item.removed,
        )
        for item in items
    ]


def _groups(maps: ErrorMaps) -> list[GroupRow]:
    """The groups, those that explain most first."""
    import numpy as np

    errors = maps.errors
    examined = errors.stability.groups.tolist()
    ranges = dict(zip(examined, errors.stability.ranges.tolist(), strict=False))
    return [
        GroupRow(
            name=maps.groups[place],
            force_share=float(errors.force_shares[place]),
            change=float(errors.changes[place]),
            on_bound=bool(errors.at_bound[place]) and isfinite(errors.changes[place]),
            change_range=tuple(ranges.get(place, ())),
            error_share=float(errors.error_shares[place]),
            concentration=float(errors.concentrations[place]),
            energy_difference=float(
                np.maximum(abs(errors.strain[place]), abs(errors.kinetic[place])).mean()
            ),
            strain_energy_difference=tuple(errors.strain[place].tolist()),
            kinetic_energy_difference=tuple(errors.kinetic[place].tolist()),
        )
        for place in errors.ranking.tolist()
    ]


def _maps_json(maps: ErrorMaps) -> dict[str, Json]:
    errors = maps.errors
    pair = {
        "groups": [maps.groups[place] for place in errors.pair],
        "force_share": errors.pair_share,
        "changes": errors.pair_changes,
    }
    return json_object(
        maps,
        groups=_groups(maps),
        pair=pair,
        shape_misfits=maps.misfits,
        condition_numbers=maps.conditions,
        rounding_errors=maps.roundings,
        unstable_without=maps.upsets,
        forces=_worst(maps.nodes.nodes.tolist(), maps.nodes.forces.tolist()),
        strains=_worst(maps.mesh_nodes.tolist(), maps.strains.tolist()),
    )


def _worst(nodes: list[int], values: list[float]) -> list[dict[str, Any]]:
    """The nodes with the largest values, in descending order."""
    order = sorted(range(len(nodes)), key=lambda place: -values[place])[:NODES]
    return [{"node": nodes[place], "value": values[place]} for place in order]


def tables(found: Localisation, mesh: Mesh) -> list[Table]:
    """Groups, if there are maps, the residual that parameters can remove, and changes that the
    model may lack; the first of each."""
    removals = _removals(found, (*found.singles[:SHOWN], *found.pairs[: SHOWN // 4]))
    shown = [table_of("What parameters can remove of the residual", removals, RemovalRow)]
    if found.maps is not None:
        groups = _groups(found.maps)[:SHOWN]
        title = "Where the model is wrong, from the test's shapes"
        shown.insert(0, table_of(title, groups, GroupRow))
    if found.proposals is not None:
        from modetune.flows.studies.localise.proposal_report import proposal_table

        shown.append(proposal_table(found.proposals, mesh))
    return shown


def _lines(found: Localisation) -> list[str]:
    lines = [f"examined: {found.examined}", *found.remarks]
    if found.maps is not None:
        lines += _map_lines(found.maps, found.modes)
    if found.why_no_maps:
        lines.append(f"no maps: {found.why_no_maps}")
    lines.append(found.sentence)
    if found.proposals is not None:
        from modetune.flows.studies.localise.proposal_report import proposal_sentence

        lines.append(proposal_sentence(found.proposals))
    elif found.why_no_proposals:
        lines.append(f"no changes are proposed: {found.why_no_proposals}")
    runs = found.runs
    lines.append(
        f"solver runs: {runs.modal} modal, {runs.sensitivity} for sensitivities and "
        f"matrices, {runs.reused} cached"
    )
    return lines


def _map_lines(maps: ErrorMaps, modes: Sequence[int]) -> list[str]:
    lines, errors = [], maps.errors
    if errors.pair:
        pair = " and ".join(maps.groups[place] for place in errors.pair)
        changes = " and ".join(f"{100 * change:+.1f} %" for change in errors.pair_changes.tolist())
        lines.append(
            f"best pair: {pair} explain {100 * errors.pair_share:.1f} % of the force "
            f"residual, by changes of {changes}"
        )
    best = float(errors.force_shares.max(initial=0.0))
    if best < DISTINCT:
        lines.append(
            f"no group alone explains more than {100 * best:.1f} % of the force "
            "residual: it is measurement noise, or spread over the model"
        )
    elif maps.upsets:
        lines.append(
            f"the ranking depends on single sensors: without {listed(maps.upsets, 6)} another "
            "group comes first, so do not rely on one group"
        )
    elif errors.stability.varies:
        low, high = errors.stability.ranges[0].tolist()
        lines.append(
            f"the change of {maps.groups[errors.stability.groups[0]]} depends on single sensors: "
            f"{100 * low:+.1f} to {100 * high:+.1f} % without one of them"
        )
    if maps.spoiled.any():
        names = ", ".join(
            str(mode) for mode, bad in zip(modes, maps.spoiled.tolist(), strict=True) if bad
        )
        lines.append(f"left out of the maps, because rounding spoils their expansion: mode {names}")
    worst = int(maps.conditions.argmax())
    lines.append(
        f"condition number of the expansion: up to {maps.conditions[worst]:.0e} (mode "
        f"{modes[worst]}); rounding error of the expanded shapes at most "
        f"{maps.roundings[~maps.spoiled].max():.0e}"
    )
    return lines
