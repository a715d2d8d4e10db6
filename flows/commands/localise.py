"""`modetune localise`: where a model is wrong, and whether its parameters can mend it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modetune.core.keys import number_or_null
from modetune.flows.commands.stopping import stoppable

if TYPE_CHECKING:
    from rich.table import Table

    from modetune.flows.localisation.error_maps import ErrorMaps
    from modetune.flows.localisation.localise import Localisation

#: Rows that a terminal shows of each table.
SHOWN = 12
#: A best share of the force residual below this tells of no one group.
TELLING = 0.2
#: Nodes that `--json` tells of each map, the worst.
NODES = 200


def localise(
    campaign_file: Annotated[Path, typer.Argument(help="Campaign file (YAML).")],
    record: Annotated[
        Path | None,
        typer.Option(help="Run folder or campaign.h5 whose updated model is looked at."),
    ] = None,
    configuration: Annotated[
        str | None, typer.Option(help="Which one, of a campaign with several configurations.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", help="KEY.KEY=VALUE over the campaign file; may be repeated."),
    ] = None,
    figures: Annotated[Path | None, typer.Option(help="Folder for figures (PNG).")] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="One JSON object on standard output.")
    ] = False,
) -> None:
    """Say where the model is wrong: maps of the error, what each parameter can remove of it, and
    whether any parameters can.

    Looks at the start of the campaign, or with --record at the model that updating left.
    """
    from modetune.flows.campaign import load_campaign
    from modetune.flows.localisation.localise import localise as find
    from modetune.flows.localisation.localise import place_of

    place = place_of(load_campaign(campaign_file, settings or []), record, configuration)
    campaign = place.campaign
    with stoppable():
        found = find(campaign, place.theta)
    written: list[Path] = []
    if figures is not None:
        from modetune.flows.report.localisation_figures import write_figures

        title = f"{campaign.name}: where the {'updated' if record else 'initial'} model is wrong"
        written = write_figures(title, found, campaign.solver.mesh(), campaign.surface, figures)
    if as_json:
        typer.echo(json.dumps({**told(found), "written": [str(path) for path in written]}))
        return
    _show(found)
    for path in written:
        typer.echo(f"written: {path}")


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command()(localise)


def told(found: Localisation) -> dict[str, Any]:
    """The `--json` object of `modetune localise`."""
    from modetune.flows.localisation.form_verdict import told_form

    names = found.parameters
    return {
        "status": "done",
        "parameters": [
            {"name": name, "value": value}
            for name, value in zip(names, found.theta.tolist(), strict=True)
        ],
        "modes": list(found.modes),
        "model_form": told_form(found.form, found.labels, found.sentence),
        **{
            key: [
                {
                    "parameters": [names[place] for place in item.members],
                    "changes": item.changes.tolist(),
                    "removed": item.removed,
                }
                for item in items
            ]
            for key, items in (("singles", found.singles), ("pairs", found.pairs))
        },
        "maps": None if found.maps is None else _told_maps(found.maps),
        "why_no_maps": found.why_no_maps,
        "solver_runs": {
            "modal": found.runs.modal,
            "sensitivity": found.runs.sensitivity,
            "reused": found.runs.reused,
        },
    }


def _told_maps(maps: ErrorMaps) -> dict[str, Any]:
    errors = maps.errors
    return {
        "groups": [
            {
                "name": maps.groups[place],
                "force_share": float(errors.force_shares[place]),
                "change": number_or_null(float(errors.changes[place])),
                "error_share": float(errors.error_shares[place]),
                "concentration": float(errors.concentrations[place]),
                "strain_energy_difference": errors.strain[place].tolist(),
                "kinetic_energy_difference": errors.kinetic[place].tolist(),
            }
            for place in errors.ranking.tolist()
        ],
        "pair": {
            "groups": [maps.groups[place] for place in errors.pair],
            "force_share": errors.pair_share,
            "changes": errors.pair_changes.tolist(),
        },
        "shape_misfits": maps.misfits.tolist(),
        "forces": _worst(maps.nodes.nodes.tolist(), maps.nodes.forces.tolist()),
        "strains": _worst(maps.mesh_nodes.tolist(), maps.strains.tolist()),
    }


def _worst(nodes: list[int], values: list[float]) -> list[dict[str, Any]]:
    """The nodes with the largest values, these first."""
    order = sorted(range(len(nodes)), key=lambda place: -values[place])[:NODES]
    return [{"node": nodes[place], "value": values[place]} for place in order]


def _show(found: Localisation) -> None:
    from rich.text import Text

    from modetune.flows.terminal import terminal

    console = terminal()
    if found.maps is not None:
        console.print(_group_table(found.maps))
    console.print(_removal_table(found))
    for line in _lines(found):
        console.print(Text(line), soft_wrap=True)


def _group_table(maps: ErrorMaps) -> Table:
    from rich.table import Table

    table = Table(title="Where the model is wrong, from the test's shapes", title_justify="left")
    table.add_column("group", overflow="fold")
    for heading in ("explains %", "by change %", "holds error %", "times usual",
                    "energy differs %"):  # fmt: skip
        table.add_column(heading, justify="right")
    errors = maps.errors
    for place in errors.ranking[:SHOWN].tolist():
        differs = (abs(errors.strain[place]) + abs(errors.kinetic[place])).mean()
        table.add_row(
            maps.groups[place], f"{100 * errors.force_shares[place]:.1f}",
            f"{100 * errors.changes[place]:+.1f}", f"{100 * errors.error_shares[place]:.1f}",
            f"{errors.concentrations[place]:.2f}", f"{100 * differs:.2f}",
        )  # fmt: skip
    return table


def _removal_table(found: Localisation) -> Table:
    from rich.table import Table

    table = Table(title="What parameters can remove of the residual", title_justify="left")
    table.add_column("parameters", overflow="fold")
    table.add_column("removes %", justify="right")
    table.add_column("by change %", justify="right")
    for item in (*found.singles[:SHOWN], *found.pairs[: SHOWN // 4]):
        table.add_row(
            " and ".join(found.parameters[place] for place in item.members),
            f"{100 * item.removed:.1f}",
            ", ".join(f"{100 * change:+.1f}" for change in item.changes.tolist()),
        )
    return table


def _lines(found: Localisation) -> list[str]:
    lines = []
    if found.maps is not None and found.maps.errors.pair:
        errors = found.maps.errors
        pair = " and ".join(found.maps.groups[place] for place in errors.pair)
        changes = ", ".join(f"{100 * change:+.1f}" for change in errors.pair_changes.tolist())
        lines.append(f"best pair: {pair} explain {100 * errors.pair_share:.1f} % of the force "
                     f"residual, by {changes} %")  # fmt: skip
        best = float(errors.force_shares.max())
        if best < TELLING:
            lines.append(f"no group alone explains more than {100 * best:.1f} % of the force "
                         "residual: it is measurement noise, or spread over the model")  # fmt: skip
    if found.why_no_maps:
        lines.append(f"no maps: {found.why_no_maps}")
    lines.append(found.sentence)
    runs = found.runs
    lines.append(f"solver runs: {runs.modal} modal, {runs.sensitivity} for sensitivities and "
                 f"matrices; {runs.reused} results from the store")  # fmt: skip
    return lines
