"""`modetune identify`: modes from measured response functions."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from modetune.flows.commands.stopping import stoppable

if TYPE_CHECKING:
    from modetune.flows.identification.identify import Identification, IdentificationSettings

#: Functions that are named as the worst.
WORST = 5


def register(app: typer.Typer) -> None:
    """Add the command to the command line."""
    app.command()(identify)


def identify(
    frfs: Annotated[list[Path], typer.Argument(help="Files with the response functions.")],
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
    out: Annotated[Path | None, typer.Option(help="Test file to write: .csv, .h5 or .unv.")] = None,
    figures: Annotated[Path | None, typer.Option(help="Folder for figures.")] = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="One JSON object on standard output.")
    ] = False,
) -> None:
    """Identify modes from measured response functions, and write them as a test file."""
    from modetune.adapters.measurements import read_measurement
    from modetune.core.errors import CampaignError
    from modetune.flows.identification.files import check_out, write_modes
    from modetune.flows.identification.identify import identify as identify_modes

    settings = _settings(band, order, pick, criteria)
    if out is not None:
        check_out(out)
    with stoppable("stopped; the same command starts from the beginning"):
        measurement = read_measurement(frfs)
        names = ", ".join(str(path) for path in frfs)
        if measurement.frfs is None:
            missing = f"{names}: no frequency response functions are in there"
            raise CampaignError([missing, *measurement.notes])
        found = identify_modes(measurement.frfs, settings)
        if out is not None:
            write_modes(out, found, measurement.geometry, names)
        written: tuple[Path, ...] = ()
        if figures is not None:
            from modetune.flows.report.identification_figures import write_figures

            written = write_figures(figures, ", ".join(path.name for path in frfs), found)
    notes = (*measurement.notes, *found.notes)
    if as_json:
        typer.echo(json.dumps(told(found, notes, out, written)))
        return
    for line in _lines(found, notes):
        typer.echo(line)
    for path in (*([out] if out else []), *written):
        typer.echo(f"written: {path}")


def _settings(
    band: tuple[float, float] | None, order: int, pick: str | None, criteria: str
) -> IdentificationSettings:
    from modetune.core.errors import CampaignError
    from modetune.core.stabilisation import Criteria
    from modetune.flows.identification.identify import IdentificationSettings

    picked = _numbers("--pick", pick) if pick else ()
    limits = _numbers("--criteria", criteria)
    if len(limits) != 3:
        raise CampaignError("--criteria wants three numbers: frequency,damping,shape")
    return IdentificationSettings(band, order, picked, Criteria(*limits))


def told(
    found: Identification, notes: tuple[str, ...], out: Path | None, written: tuple[Path, ...]
) -> dict[str, Any]:
    """The `--json` object of `modetune identify`."""
    modes, lines = found.modes.modes, found.frfs.frequencies_hz
    return {
        "status": "identified",
        "band_hz": [float(lines[0]), float(lines[-1])],
        "order": found.settings.order,
        "functions": int(found.frac.size),
        "normalisation": modes.normalisation,
        "modes": [
            {
                "number": number,
                "frequency_hz": float(modes.frequencies_hz[place]),
                "damping_ratio": float(modes.damping_ratios[place]),
                "phase_collinearity": float(found.phase_collinearity[place]),
                "stable_orders": found.tracks[found.chosen[place]].n_stable,
            }
            for place, number in enumerate(found.modes.numbers)
        ],
        "frac": {
            "mean": float(found.frac.mean()),
            "least": float(found.frac.min()),
            "worst": [
                {"function": found.function_name(place), "frac": float(found.frac[place])}
                for place in found.worst_functions[:WORST].tolist()
            ],
        },
        "auto_mac": found.auto_mac.tolist(),
        "notes": list(notes),
        "out": str(out) if out else None,
        "figures": [str(path) for path in written],
    }


def _lines(found: Identification, notes: tuple[str, ...]) -> list[str]:
    modes = found.modes.modes
    lines = ["mode           Hz   damping     MPC   orders  largest MAC with another"]
    others = found.auto_mac.copy()
    others.flat[:: others.shape[0] + 1] = 0.0
    for place, number in enumerate(found.modes.numbers):
        lines.append(
            f"{number:4d} {modes.frequencies_hz[place]:12.4f} "
            f"{100.0 * modes.damping_ratios[place]:8.3f}% {found.phase_collinearity[place]:7.3f} "
            f"{found.tracks[found.chosen[place]].n_stable:8d}  {others[place].max():.3f}"
        )
    worst = int(found.worst_functions[0])
    lines.append(
        f"FRAC of {found.frac.size} functions: mean {found.frac.mean():.4f}, least "
        f"{found.frac[worst]:.4f} at {found.function_name(worst)}"
    )
    return [*lines, *(f"note: {note}" for note in notes)]


def _numbers(option: str, text: str) -> tuple[float, ...]:
    from modetune.core.errors import CampaignError

    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if not numbers or not all(0.0 <= number < math.inf for number in numbers):
        raise CampaignError(f"{option} wants numbers with commas between, not {text!r}")
    return numbers
