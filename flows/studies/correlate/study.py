"""`modetune correlate`: a comparison of two tests, two models, or a test and a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.errors import CampaignError
from modetune.core.near_names import listed
from modetune.core.storage.files import writing
from modetune.core.storage.keys import Json
from modetune.flows.report.tables import Column, Table, frame, json_object, table_of
from modetune.flows.studies.correlate.request import CorrelationRequest
from modetune.flows.studies.result import StudyResult
from modetune.flows.studies.study import (
    Figures,
    SolverChoice,
    StudyContext,
    StudyOptions,
    UnitsChoice,
    split_files,
    study,
    with_model,
)

if TYPE_CHECKING:
    from modetune.flows.campaign.campaign import Campaign
    from modetune.flows.studies.correlate.correlation import Correlation, Orthogonality
    from modetune.flows.studies.correlate.sides import SideSource
    from modetune.flows.updating.forecast import Progress

#: Degrees of freedom that a terminal shows of the worst, and modes of a MAC matrix.
WORST, SHOWN = 10, 14

Out = Annotated[
    Path | None, typer.Option(help="CSV file of the pairs; NAME_sensors.csv goes next to it.")
]


@dataclass(frozen=True)
class CorrelateOptions(StudyOptions):
    """Options of the comparison of two sets of modes, which it loads itself."""

    first: Annotated[
        tuple[Path, ...],
        typer.Argument(
            help="Campaign file, deck, campaign.h5 (or its folder), or test file; separate "
            "several files of one test by commas."
        ),
        split_files,
    ]
    second: Annotated[
        tuple[Path, ...],
        typer.Argument(
            help="What to compare it with; default: the test of the campaign or record."
        ),
        split_files,
    ] = ()
    at: Annotated[
        list[str] | None,
        typer.Option(help="NAME=VALUE of a parameter of the first campaign; may be repeated."),
    ] = None
    second_at: Annotated[
        list[str] | None,
        typer.Option(help="NAME=VALUE of a parameter of the second campaign; may be repeated."),
    ] = None
    solver: SolverChoice = None
    units: UnitsChoice = None
    figures: Figures = None

    def open(self, progress: Progress, campaign: Campaign | None) -> StudyContext:
        if not self.second and self.second_at:
            raise CampaignError("--second-at is of a second campaign, and none is named")
        return StudyContext(self.first[0].stem, progress, charted=self.figures is not None)

    @property
    def solves(self) -> bool:
        from modetune.flows.studies.correlate.sides import MODELS

        return any(item.kind in MODELS for item in self.sources)

    @property
    def sources(self) -> list[SideSource]:
        """The one or two sides to compare. Raises CampaignError."""
        from modetune.flows.studies.correlate.sides import source

        sides = (self.first, self.at), (self.second, self.second_at)
        return [source(Path(",".join(map(str, files))), at or ()) for files, at in sides if files]


@study(CorrelateOptions)
def correlate(
    on: StudyContext,
    options: CorrelateOptions,
    request: CorrelationRequest,
    out: Out = None,
) -> StudyResult:
    """Compare modes: pairs, frequencies, MAC, COMAC, scale factors, and the worst sensors.

    With one campaign, compares its model with its test. Otherwise compares any two of campaigns,
    decks, records and tests; a test compared with a model always comes first.
    """
    from modetune.flows.studies.correlate.figures import correlation_charts
    from modetune.flows.studies.correlate.sides import correlate_sources

    first, *second = options.sources
    settings = with_model(options.settings, options.solver, options.units)
    found = correlate_sources(
        first, second[0] if second else None, request.state, settings, request.orthogonality
    )
    return StudyResult(
        found,
        "; ".join(_lines(found)),
        correlation_summary(found),
        _tables(found),
        _lines(found),
        charts=correlation_charts(found) if on.charted else {},
        outputs=[] if out is None else [lambda: _write(found, out)],
    )


def correlation_summary(found: Correlation) -> dict[str, Json]:
    """Return the JSON object of a correlation."""
    from modetune.core.modes import dof_name

    sides = (
        ("first", found.first, found.auto_first, found.alone_first, found.only_first),
        ("second", found.second, found.auto_second, found.alone_second, found.only_second),
    )
    told_sides = {
        name: json_object(
            side,
            "label kind",
            modes=side.numbers,
            frequencies_hz=side.modes.frequencies_hz,
            auto_mac=table,
            without_pair=alone,
            only_here=[dof_name(dof) for dof in only],
        )
        for name, side, table, alone, only in sides
    }
    return told_sides | json_object(
        found,
        "mac notes",
        status="done",
        common=len(found.dofs),
        pairs=_pairs(found),
        sensors=_sensors(found),
        worst=[dof_name(dof) for dof, _, _ in found.worst(WORST)],
        orthogonality=_orthogonality_json(found.orthogonality),
    )


@dataclass(frozen=True, slots=True)
class ComparedPair:
    """A pair of modes of both sides; difference: relative to the first."""

    first: Annotated[int, Column("first mode")]
    first_hz: Annotated[float, Column("first", "Hz")]
    second: Annotated[int, Column("second mode")]
    second_hz: Annotated[float, Column("second", "Hz")]
    difference: Annotated[float, Column("difference", "%", "+.2f")]
    mac: Annotated[float, Column("MAC", form=".3f")]
    scale: Annotated[float, Column("modal scale factor", form=".3g")]


@dataclass(frozen=True, slots=True)
class ComparedSensor:
    """How a degree of freedom agrees over all pairs."""

    sensor: Annotated[str, Column("sensor")]
    comac: Annotated[float, Column("COMAC", form=".4f")]
    ecomac: Annotated[float, Column("eCOMAC", form=".4f")]


def _pairs(found: Correlation) -> list[ComparedPair]:
    first, second = found.first, found.second
    return [
        ComparedPair(
            first.numbers[pair.first],
            float(first.modes.frequencies_hz[pair.first]),
            second.numbers[pair.second],
            float(second.modes.frequencies_hz[pair.second]),
            pair.difference,
            pair.mac,
            pair.scale,
        )
        for pair in found.pairs
    ]


def _sensors(found: Correlation) -> list[ComparedSensor]:
    from modetune.core.modes import dof_name

    values = zip(found.dofs, found.comac.tolist(), found.ecomac.tolist(), strict=False)
    return [ComparedSensor(dof_name(dof), comac, ecomac) for dof, comac, ecomac in values]


def _orthogonality_json(found: Orthogonality | None) -> dict[str, Json] | None:
    from modetune.core.modes import dof_name

    return (
        None
        if found is None
        else json_object(
            found,
            "method",
            sensors=[dof_name(dof) for dof in found.dofs],
            cross=abs(found.cross),
            first=abs(found.first),
            second=abs(found.second),
        )
    )


def _write(found: Correlation, out: Path) -> list[Path]:
    written = [_write_csv(out, _pairs(found), ComparedPair)]
    if found.comac.size:
        beside = out.with_name(f"{out.stem}_sensors{out.suffix or '.csv'}")
        written.append(_write_csv(beside, _sensors(found), ComparedSensor))
    return written


def _write_csv(path: Path, rows: Sequence[ComparedPair | ComparedSensor], kind: type) -> Path:
    with writing(path) as part:
        frame(rows, kind).to_csv(part, index=False, lineterminator="\n")
    return path


def _tables(found: Correlation) -> list[Table]:
    from modetune.core.modes import dof_name

    title = f"Pairs of modes: first {found.first.label}, second {found.second.label}"
    tables = [table_of(title, _pairs(found), ComparedPair)]
    if found.mac.size and max(found.mac.shape) <= SHOWN:
        tables.append(_matrix_table(found))
    worst = [ComparedSensor(dof_name(dof), *values) for dof, *values in found.worst(WORST)]
    return [*tables, table_of("Sensors that agree least", worst, ComparedSensor)]


def _lines(found: Correlation) -> list[str]:
    from modetune.core.modes import dof_name

    lines = (
        [f"{len(found.dofs)} common degree{'' if len(found.dofs) == 1 else 's'} of freedom"]
        if found.dofs
        else ["no shapes on one side: pairs follow the order of frequency"]
    )
    lines += found.notes
    sides = (
        (found.first, found.alone_first, found.only_first, found.auto_first),
        (found.second, found.alone_second, found.only_second, found.auto_second),
    )
    for side, alone, only, auto in sides:
        if only and found.dofs:
            lines.append(f"of {side.label} only: {listed(map(dof_name, only))}")
        if alone:
            s = "" if len(alone) == 1 else "s"
            lines.append(f"{side.label}, mode{s} without a pair: {listed(alone, 12)}")
        if auto.shape[0] > 1:
            off = auto.copy()
            off.flat[:: off.shape[1] + 1] = -1.0
            row, column = divmod(int(off.argmax()), off.shape[1])
            lines.append(
                f"auto-MAC of {side.label}: at most {auto[row, column]:.3f}, modes "
                f"{side.numbers[row]} and {side.numbers[column]}"
            )
    if found.orthogonality is not None:
        own = abs(found.orthogonality.cross)
        values = [f"{own[pair.first, pair.second]:.3f}" for pair in found.pairs]
        lines.append(
            f"cross-orthogonality of the pairs ({found.orthogonality.method}, "
            f"{len(found.orthogonality.dofs)} masters): {', '.join(values)}"
        )
    return lines


def _matrix_table(found: Correlation) -> Table:
    columns = (Column("mode"), *(Column(str(item), form=".2f") for item in found.second.numbers))
    rows = tuple(
        # A field of zeros hides what is to be seen.
        (number, *("." if value < 0.005 else value for value in row.tolist()))
        for number, row in zip(found.first.numbers, found.mac, strict=True)
    )
    title = (
        f"MAC: a row a mode of {found.first.label}, a column a mode of {found.second.label}; "
        ". is below 0.005"
    )
    return Table(title, columns, rows)
