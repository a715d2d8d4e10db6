"""`modetune identify`: identify modes from measured response functions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import typer

from modetune.core.errors import CampaignError
from modetune.core.near_names import named
from modetune.core.storage.keys import Json
from modetune.flows.cli.options import AsJson, show_progress, stoppable
from modetune.flows.cli.output import print_result
from modetune.flows.report.tables import Column, json_object, table_of
from modetune.flows.studies.study import Figures

if TYPE_CHECKING:
    from modetune.flows.studies.identify.identification import (
        Identification,
        IdentificationSettings,
    )
    from modetune.flows.studies.identify.measured_functions import SpectraSettings
    from modetune.flows.studies.identify.operational_modes import OperationalModes

#: Number of worst functions to list.
WORST = 5


def identify(
    frfs: Annotated[
        list[Path], typer.Argument(help="Files with response functions or time histories.")
    ],
    band: Annotated[
        tuple[float, float] | None, typer.Option(help="Lowest and highest frequency, Hz.")
    ] = None,
    order: Annotated[
        int, typer.Option(min=2, help="Number of pole pairs of the largest model.")
    ] = 60,
    pick: Annotated[
        str | None, typer.Option(help="Take the poles nearest to these frequencies, Hz: 5.5,12.3")
    ] = None,
    criteria: Annotated[
        str, typer.Option(help="Relative tolerances of a stable pole: frequency,damping,shape.")
    ] = "0.01,0.05,0.02",
    estimator: Annotated[
        str | None,
        typer.Option(
            help="Response functions from time histories: h1 (default, for noise on the "
            "responses), or h2 (for noise on the force)."
        ),
    ] = None,
    segment: Annotated[
        float | None,
        typer.Option(
            help="Length of the segments of time histories, s; default: an eighth of a recording."
        ),
    ] = None,
    window: Annotated[
        str | None,
        typer.Option(help="Window of the segments: hann (default), or boxcar for impacts."),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Test file to write: .csv, .h5 or .unv.")] = None,
    figures: Figures = None,
    as_json: AsJson = False,
) -> None:
    """Identify modes from response functions or time histories.

    Writes them to a test file. Converts time histories with a measured force to response functions
    first. From responses alone, it identifies modes by their covariances; the shapes then have no
    scale.
    """
    with (
        stoppable("stopped; the same command starts from the beginning"),
        show_progress(f"reading {', '.join(map(str, frfs))}") as tell,
    ):
        from modetune.flows.studies.identify.measured_functions import read_functions
        from modetune.flows.studies.identify.operational_modes import identify_test

        settings = _settings(band, order, pick, criteria)
        measurement, outputs = read_functions(frfs, _spectra(estimator, segment, window))
        tell("identifying modes")
        found, drawn = identify_test(measurement, outputs, settings, frfs, out, figures)
        about, lines = _fit(found, drawn)
        files = drawn if out is None else (out, *drawn)
    modes, notes = _modes(found), (*measurement.notes, *found.notes)
    about |= json_object(found, "auto_mac", status="identified", modes=modes, notes=notes, out=out)
    table = table_of("Identified modes", modes, IdentifiedMode)
    lines += [*(f"note: {note}" for note in notes), *(f"written: {path}" for path in files)]
    print_result(about, [table, *lines], as_json)


def _settings(
    band: tuple[float, float] | None, order: int, pick: str | None, criteria: str
) -> IdentificationSettings:
    from modetune.core.measurement.stabilisation import Criteria
    from modetune.flows.studies.identify.identification import IdentificationSettings

    picked = _numbers("--pick", pick) if pick else ()
    limits = _numbers("--criteria", criteria)
    if len(limits) != 3:
        raise CampaignError("--criteria requires three numbers: frequency,damping,shape")
    return IdentificationSettings(band, order, picked, Criteria(*limits))


def _spectra(estimator: str | None, segment: float | None, window: str | None) -> SpectraSettings:
    from modetune.core.measurement.time_histories import Estimator, Window
    from modetune.flows.studies.identify.measured_functions import SpectraSettings

    return SpectraSettings(
        None if estimator is None else named("--estimator", estimator, get_args(Estimator)),
        segment,
        None if window is None else named("--window", window, get_args(Window)),
    )


@dataclass(frozen=True, slots=True)
class IdentifiedMode:
    """An identified mode; largest_mac: the largest MAC with another identified mode."""

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


def _fit(
    found: Identification | OperationalModes, figures: tuple[Path, ...]
) -> tuple[dict[str, Json], list[str]]:
    """Return the JSON keys of response functions, and their fit in a sentence."""
    from modetune.flows.studies.identify.identification import Identification

    about = json_object(normalisation=found.modes.modes.normalisation)
    if not isinstance(found, Identification):
        return about | {"output_only": True}, []
    lines, frac = found.frfs.frequencies_hz, found.frac
    worst = [
        {"function": found.function_name(place), "frac": frac[place]}
        for place in found.worst_functions[:WORST].tolist()
    ]
    about |= json_object(
        band_hz=[lines[0], lines[-1]],
        order=found.settings.order,
        functions=frac.size,
        frac={"mean": frac.mean(), "least": frac.min(), "worst": worst},
        figures=figures,
    )
    fit = f"FRAC of {frac.size} functions: mean {frac.mean():.4f}, minimum {frac.min():.4f} at "
    return about, [fit + str(worst[0]["function"])]


def _numbers(option: str, text: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if not numbers or not all(0.0 <= number < math.inf for number in numbers):
        raise CampaignError(f"{option} requires numbers separated by commas, not {text!r}")
    return numbers
