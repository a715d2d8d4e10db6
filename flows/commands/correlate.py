"""`modetune correlate`: two tests, two models, or one of each, side by side."""

from __future__ import annotations

import csv
import io
import json
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modetune.core.keys import number_or_null
from modetune.flows.commands.stopping import stoppable

if TYPE_CHECKING:
    from rich.table import Table

    from modetune.flows.correlation.correlate import Correlation, Orthogonality

#: Degrees of freedom that a terminal shows of the worst, and modes of a MAC matrix.
WORST, SHOWN = 10, 14

First = Annotated[
    Path, typer.Argument(help="Campaign file, campaign.h5 (or its folder), or test file.")
]
Second = Annotated[
    Path | None,
    typer.Argument(help="What it is compared with; a campaign's or record's own test if left out."),
]
At = Annotated[
    list[str] | None,
    typer.Option(help="NAME=VALUE of a parameter of the first campaign; may be repeated."),
]
SecondAt = Annotated[
    list[str] | None, typer.Option(help="The same of the second campaign; may be repeated.")
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", help="KEY.KEY=VALUE over the campaign files; may be repeated."),
]
State = Annotated[str, typer.Option(help="Which model of a record: updated, or initial.")]
Reduced = Annotated[
    str | None,
    typer.Option(help="Cross-orthogonality, by a mass matrix that guyan or serep reduces."),
]
Figures = Annotated[Path | None, typer.Option(help="Folder for figures (PNG).")]
Out = Annotated[Path | None, typer.Option(help="CSV of the pairs; NAME_sensors.csv beside it.")]
AsJson = Annotated[bool, typer.Option("--json", help="One JSON object on standard output.")]


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command()(correlate)


def correlate(
    first: First,
    second: Second = None,
    at: At = None,
    second_at: SecondAt = None,
    settings: Settings = None,
    state: State = "updated",
    orthogonality: Reduced = None,
    figures: Figures = None,
    out: Out = None,
    as_json: AsJson = False,
) -> None:
    """Compare modes: pairs, frequencies, MAC, COMAC, scale factors, and the worst sensors.

    A campaign alone is its model beside its test. Any two of campaigns, records and tests can be
    compared; a test stands first beside a model.
    """
    from modetune.core.errors import CampaignError
    from modetune.flows.correlation.sides import correlate_sources, source

    if state not in ("updated", "initial"):
        raise CampaignError(f"--state {state!r}: expected updated or initial")
    if orthogonality not in (None, "guyan", "serep"):
        raise CampaignError(f"--orthogonality {orthogonality!r}: expected guyan or serep")
    if second is None and second_at:
        raise CampaignError("--second-at is of a second campaign, and none is named")
    sources = source(first, at or ()), source(second, second_at or ()) if second else None
    with stoppable():
        found = correlate_sources(
            *sources,
            "initial" if state == "initial" else "updated",
            settings or (),
            {"guyan": "guyan", "serep": "serep"}.get(orthogonality or ""),  # type: ignore[arg-type]
        )
    written = _write(found, figures, out)
    if as_json:
        typer.echo(json.dumps({**told(found), "written": [str(path) for path in written]}))
        return
    _show(found)
    for path in written:
        typer.echo(f"written: {path}")


def told(found: Correlation) -> dict[str, Any]:
    """The `--json` object of `modetune correlate`."""
    from modetune.core.modes import dof_name

    first, second = found.first, found.second
    return {
        "status": "done",
        **{
            name: {
                "label": side.label, "kind": side.kind, "modes": list(side.numbers),
                "frequencies_hz": side.modes.frequencies_hz.tolist(),
                "auto_mac": table.tolist(), "without_pair": list(alone),
                "only_here": [dof_name(dof) for dof in only],
            }
            for name, side, table, alone, only in (
                ("first", first, found.auto_first, found.alone_first, found.only_first),
                ("second", second, found.auto_second, found.alone_second, found.only_second),
            )
        },
        "common": len(found.dofs),
        "pairs": [
            {
                "first": first.numbers[pair.first], "second": second.numbers[pair.second],
                "first_hz": float(first.modes.frequencies_hz[pair.first]),
                "second_hz": float(second.modes.frequencies_hz[pair.second]),
                "difference": pair.difference, "mac": number_or_null(pair.mac),
                "scale": number_or_null(pair.scale),
            }
            for pair in found.pairs
        ],
        "mac": found.mac.tolist(),
        "sensors": [
            {"sensor": dof_name(dof), "comac": float(c), "ecomac": float(e)}
            for dof, c, e in zip(found.dofs, found.comac, found.ecomac, strict=False)
        ],
        "worst": [dof_name(dof) for dof, _, _ in found.worst(WORST)],
        "orthogonality": _told_orthogonality(found.orthogonality),
    }  # fmt: skip


def _told_orthogonality(found: Orthogonality | None) -> dict[str, Any] | None:
    from modetune.core.modes import dof_name

    if found is None:
        return None
    tables = {"cross": found.cross, "first": found.first, "second": found.second}
    return {
        "method": found.method,
        "sensors": [dof_name(dof) for dof in found.dofs],
        **{name: abs(table).tolist() for name, table in tables.items()},
    }


def _write(found: Correlation, figures: Path | None, out: Path | None) -> list[Path]:
    written = []
    if figures is not None:
        from modetune.flows.report.correlation_figures import write_figures

        written += write_figures(found, figures)
    if out is not None:
        from modetune.core.modes import dof_name

        told_pairs = told(found)["pairs"]
        rows = [list(row.values()) for row in told_pairs]
        heads = ["first", "second", "first_hz", "second_hz", "difference", "mac", "scale"]
        written.append(_write_csv(out, heads, rows))
        if found.comac.size:
            sensors = zip(map(dof_name, found.dofs), found.comac.tolist(), found.ecomac.tolist(),
                          strict=True)  # fmt: skip
            beside = out.with_name(f"{out.stem}_sensors{out.suffix or '.csv'}")
            written.append(_write_csv(beside, ["sensor", "comac", "ecomac"], map(list, sensors)))
    return written


def _write_csv(path: Path, heads: list[str], rows: Any) -> Path:
    from modetune.core.store import writing

    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(heads)
    table.writerows(["" if cell is None else cell for cell in row] for row in rows)
    with writing(path) as part:
        part.write_text(text.getvalue(), encoding="utf-8")
    return path


def _show(found: Correlation) -> None:
    from rich.text import Text

    from modetune.flows.terminal import terminal

    console = terminal()
    console.print(_pair_table(found))
    if found.mac.size and max(found.mac.shape) <= SHOWN:
        console.print(_matrix_table(found))
    if found.comac.size:
        console.print(_sensor_table(found))
    for line in _lines(found):
        console.print(Text(line), soft_wrap=True)


def _lines(found: Correlation) -> list[str]:
    from modetune.core.modes import dof_name
    from modetune.flows.gate.findings import listed

    lines = [f"{len(found.dofs)} common degrees of freedom"] if found.dofs else [
        "no shapes on one side: pairs follow the order of frequency"
    ]  # fmt: skip
    sides = (
        (found.first, found.alone_first, found.only_first, found.auto_first),
        (found.second, found.alone_second, found.only_second, found.auto_second),
    )
    for side, alone, only, auto in sides:
        if only and found.dofs:
            lines.append(f"of {side.label} only: {listed(map(dof_name, only))}")
        if alone:
            lines.append(f"of {side.label} without a pair: mode {listed(alone, 12)}")
        if auto.shape[0] > 1:
            off = auto.copy()
            off.flat[:: off.shape[1] + 1] = -1.0
            row, column = divmod(int(off.argmax()), off.shape[1])
            lines.append(f"auto-MAC of {side.label}: at most {auto[row, column]:.3f}, modes "
                         f"{side.numbers[row]} and {side.numbers[column]}")  # fmt: skip
    if found.orthogonality is not None:
        own = abs(found.orthogonality.cross)
        values = [f"{own[pair.first, pair.second]:.3f}" for pair in found.pairs]
        lines.append(f"cross-orthogonality of the pairs ({found.orthogonality.method}, "
                     f"{len(found.orthogonality.dofs)} masters): {', '.join(values)}")  # fmt: skip
    return lines


def _pair_table(found: Correlation) -> Table:
    from rich.table import Table

    first, second = found.first, found.second
    table = Table(title=f"{second.label} beside {first.label}", title_justify="left")
    for heading in (first.label, "Hz", second.label, "Hz", "differs %", "MAC", "scale"):
        table.add_column(heading, justify="right")
    for pair in found.pairs:
        table.add_row(
            str(first.numbers[pair.first]), f"{first.modes.frequencies_hz[pair.first]:.3f}",
            str(second.numbers[pair.second]), f"{second.modes.frequencies_hz[pair.second]:.3f}",
            f"{100 * pair.difference:+.2f}", _shown(pair.mac, ".3f"), _shown(pair.scale, ".3g"),
        )  # fmt: skip
    return table


def _matrix_table(found: Correlation) -> Table:
    from rich.table import Table

    table = Table(title="MAC", title_justify="left", padding=0)
    table.add_column("", justify="right")
    for number in found.second.numbers:
        table.add_column(str(number), justify="right", min_width=4)
    for number, row in zip(found.first.numbers, found.mac, strict=True):
        table.add_row(str(number), *(f"{value:.2f}" if value >= 0.005 else "." for value in row))
    return table


def _sensor_table(found: Correlation) -> Table:
    from rich.table import Table

    from modetune.core.modes import dof_name

    table = Table(title="Least agreement", title_justify="left")
    for heading in ("sensor", "COMAC", "eCOMAC"):
        table.add_column(heading, justify="right")
    for dof, value, enhanced in found.worst(WORST):
        table.add_row(dof_name(dof), f"{value:.4f}", f"{enhanced:.4f}")
    return table


def _shown(value: float, form: str) -> str:
    return format(value, form) if isfinite(value) else "-"
