"""`modetune identify`: modes from measured response functions."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from modetune.core.errors import CampaignError
from modetune.core.storage.keys import Json
from modetune.flows.cli.options import AsJson, Figures, begun, stoppable
from modetune.flows.report.tables import Column, json_object, show, table_of

if TYPE_CHECKING:
    from modetune.core.measurement.measurement import Measurement
    from modetune.core.measurement.time_histories import TimeHistories
    from modetune.flows.studies.identify.identify import Identification, IdentificationSettings
    from modetune.flows.studies.identify.operational import OperationalModes

#: Functions that are named as the worst.
WORST = 5


def identify(
    frfs: Annotated[
        list[Path], typer.Argument(help="Files with response functions or time histories.")
    ],
    band: Annotated[
        tuple[float, float] | None, typer.Option(help="Lowest and highest frequency, Hz.")
    ] = None,
    order: Annotated[int, typer.Option(min=2, help="Pairs of poles of the largest model.")] = 60,
    pick: Annotated[
        str | None, typer.Option(help="Take the poles nearest to these, with commas: 5.5,12.3")
    ] = None,
    criteria: Annotated[
        str, typer.Option(help="A stable pole agrees in frequency,damping,shape to this share.")
    ] = "0.01,0.05,0.02",
    estimator: Annotated[
        str | None,
        typer.Option(
            help="Response functions from time histories: h1 (default: noise of responses), or h2 "
            "(noise of the force)."
        ),
    ] = None,
    segment: Annotated[
        float | None,
        typer.Option(help="Length of their segments, s; default: an eighth of a recording."),
    ] = None,
    window: Annotated[
        str | None, typer.Option(help="Of segments: hann (default), or boxcar for blows.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Test file to write: .csv, .h5 or .unv.")] = None,
    figures: Figures = None,
    as_json: AsJson = False,
) -> None:
    """Identify modes from response functions or time histories, and write them as a test file.

    Time histories with a force become response functions first; of responses alone the modes come
    from their covariances, without a scale of shapes.
    """
    names = ", ".join(str(path) for path in frfs)
    with (
        stoppable("stopped; the same command starts from the beginning"),
        begun(f"reading {names}") as tell,
    ):
        from modetune.adapters.test_files.writing import check_out
        from modetune.flows.studies.identify.files import write_modes
        from modetune.flows.studies.identify.identify import identify as identify_modes
        from modetune.flows.studies.identify.reading import read_functions, spectra_settings

        settings = _settings(band, order, pick, criteria)
        if out is not None:
            check_out(out)
        measurement, outputs = read_functions(frfs, spectra_settings(estimator, segment, window))
        tell("identifying modes")
        if measurement.frfs is None:
            assert outputs is not None
            if figures is not None:
                raise CampaignError("--figures shows response functions, and none were measured")
            _operational(outputs, settings, measurement, names, out, as_json)
            return
        found = identify_modes(measurement.frfs, settings)
        if out is not None:
            write_modes(out, found, measurement.geometry, names)
        written: tuple[Path, ...] = ()
        if figures is not None:
            from modetune.flows.studies.identify.figures import write_figures

            written = write_figures(figures, ", ".join(path.name for path in frfs), found)
    _say(found, (*measurement.notes, *found.notes), out, written, as_json)


def _say(
    found: Identification,
    notes: tuple[str, ...],
    out: Path | None,
    written: tuple[Path, ...],
    as_json: bool,
) -> None:
    if as_json:
        typer.echo(json.dumps(told(found, notes, out, written)))
        return
    files = [f"written: {path}" for path in (*([out] if out else []), *written)]
    show(
        [table_of("Identified modes", _modes(found), IdentifiedMode), *_lines(found, notes), *files]
    )


def _operational(
    outputs: TimeHistories,
    settings: IdentificationSettings,
    measurement: Measurement,
    names: str,
    out: Path | None,
    as_json: bool,
) -> None:
    """Modes of responses alone: identified, written and told."""
    from modetune.adapters.test_files.writing import write_modes
    from modetune.flows.studies.identify.operational import operational_modes

    found = operational_modes(outputs, settings)
    notes = (*measurement.notes, *found.notes)
    if out is not None:
        source = f"identified by modetune from {' '.join(names.split())}"
        write_modes(out, found.modes, measurement.geometry, (source, *notes))
    if as_json:
        modes = _modes(found)
        said = json_object(
            found, "auto_mac", status="identified", modes=modes, notes=notes, out=out
        )
        typer.echo(json.dumps({**said, "normalisation": "max", "output_only": True}))
        return
    lines = [f"note: {note}" for note in notes] + ([f"written: {out}"] if out else [])
    show([table_of("Identified modes", _modes(found), IdentifiedMode), *lines])


def _settings(
    band: tuple[float, float] | None, order: int, pick: str | None, criteria: str
) -> IdentificationSettings:
    from modetune.core.measurement.stabilisation import Criteria
    from modetune.flows.studies.identify.identify import IdentificationSettings

    picked = _numbers("--pick", pick) if pick else ()
    limits = _numbers("--criteria", criteria)
    if len(limits) != 3:
        raise CampaignError("--criteria requires three numbers: frequency,damping,shape")
    return IdentificationSettings(band, order, picked, Criteria(*limits))


@dataclass(frozen=True, slots=True)
class IdentifiedMode:
    """An identified mode; largest_mac: with another one of them."""

    number: Annotated[int, Column("mode")]
    frequency_hz: Annotated[float, Column("frequency", "Hz", ".4f")]
    damping_ratio: Annotated[float, Column("damping ratio", "%", ".3f")]
    phase_collinearity: Annotated[float, Column("phase collinearity", form=".3f")]
    stable_orders: Annotated[int, Column("stable orders")]
    largest_mac: Annotated[float, Column("largest MAC with another", form=".3f")]


def _modes(found: Identification | OperationalModes) -> list[IdentifiedMode]:
    modes, others = found.modes.modes, found.auto_mac.copy()
    others.flat[:: others.shape[0] + 1] = 0.0
    return [
        IdentifiedMode(
            number,
            float(modes.frequencies_hz[place]),
            float(modes.damping_ratios[place]),
            float(found.phase_collinearity[place]),
            found.stable_orders[place],
            float(others[place].max()),
        )
        for place, number in enumerate(found.modes.numbers)
    ]


def told(
    found: Identification, notes: tuple[str, ...], out: Path | None, written: tuple[Path, ...]
) -> dict[str, Json]:
    """The `--json` object of `modetune identify`."""
    lines = found.frfs.frequencies_hz
    worst = [
        {"function": found.function_name(place), "frac": found.frac[place]}
        for place in found.worst_functions[:WORST].tolist()
    ]
    return json_object(
        found,
        "auto_mac",
        status="identified",
        band_hz=[lines[0], lines[-1]],
        order=found.settings.order,
        functions=found.frac.size,
        normalisation=found.modes.modes.normalisation,
        modes=_modes(found),
        frac={"mean": found.frac.mean(), "least": found.frac.min(), "worst": worst},
        notes=notes,
        out=out,
        figures=written,
    )


def _lines(found: Identification, notes: tuple[str, ...]) -> list[str]:
    worst = int(found.worst_functions[0])
    fit = (
        f"FRAC of {found.frac.size} functions: mean {found.frac.mean():.4f}, least "
        f"{found.frac[worst]:.4f} at {found.function_name(worst)}"
    )
    return [fit, *(f"note: {note}" for note in notes)]


def _numbers(option: str, text: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if not numbers or not all(0.0 <= number < math.inf for number in numbers):
        raise CampaignError(f"{option} requires numbers with commas between, not {text!r}")
    return numbers
