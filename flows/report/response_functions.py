"""Measured response functions compared with the model's.

Where a campaign compares response functions, the model's are those that it compared, at the
frequencies that it chose. Else they are superposed from the model's elastic modes: that needs modes
of unit modal mass at sensor and exciter and the test's damping ratios;
a mode without a measured partner has their mean. What lies outside the computed modes, rigid
motion of a free structure above all, is missing, so levels between resonances may differ.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice
from typing import Literal

import numpy as np

from modetune.core.errors import ModesError
from modetune.core.measurement.measurement import MeasuredFrfs
from modetune.core.measurement.response_functions import Complexes, NormalModes, frac, modal_frf
from modetune.core.modes import COMPONENTS, Floats, ModeSet
from modetune.core.storage.campaign_record import CampaignRecord, IterationRecord
from modetune.core.updating.responses.frf import Frf, fracs
from modetune.core.updating.responses.response import block_parts
from modetune.flows.campaign.units import KILOGRAMS, METRES
from modetune.flows.responses.frf import curve_name, receptance

#: Number of functions that are shown, driving points first.
SHOWN = 6
UNITS = {"receptance": "m/N", "mobility": "(m/s)/N", "accelerance": "(m/s²)/N"}


@dataclass(frozen=True, slots=True)
class ResponseCurve:
    """A response function: whose it is, its label, and its values (n_lines,).

    lines_hz: (n_lines,), where it is known at other frequencies than those beside it.
    """

    kind: Literal["test", "before", "after"]
    label: str
    values: Complexes
    lines_hz: Floats | None = None


@dataclass(frozen=True, slots=True)
class ResponsePair:
    """A measured function, (n_lines,), and the model's before and after, (n_compared,) each.

    compared_hz: (n_compared,), of the model's, where they are not all that were measured; fracs: of
    both.
    """

    title: str
    frequencies_hz: Floats
    measured: Complexes
    compared_hz: Floats | None
    before: Complexes
    after: Complexes
    fracs: tuple[float, float]


def response_pairs(record: CampaignRecord) -> tuple[ResponsePair, ...]:
    """Return the functions of both sides; none where the test has none or damping is unknown."""
    frfs, ratios = record.frfs, record.test.modes.damping_ratios
    factors = {str(units): kilograms for units, kilograms in KILOGRAMS.items()}
    if frfs is None or record.units not in factors:
        return ()
    if record.best.residual.has(Frf.kind):
        return tuple(islice(_compared(record, frfs), SHOWN))
    if ratios.size == 0:
        return ()
    found = []
    for place in _order(frfs):
        try:
            before, after = (
                _model(record, item, frfs, place) / factors[record.units]
                for item in (record.iterations[0], record.best)
            )
            fracs = [
                float(frac(frfs.values[:, [place], None], side[:, None, None])[0, 0])
                for side in (before, after)
            ]
        except ModesError:  # a point that is not a sensor of the modes, or modes of no known mass
            continue
        found.append(
            ResponsePair(
                _title(frfs, place),
                frfs.frequencies_hz,
                frfs.values[:, place],
                None,
                before,
                after,
                (fracs[0], fracs[1]),
            )
        )
        if len(found) == SHOWN:
            break
    return tuple(found)


def _compared(record: CampaignRecord, frfs: MeasuredFrfs) -> Iterator[ResponsePair]:
    """The functions that the campaign compares, at its lines."""
    units: tuple[float, float] = KILOGRAMS[record.units], METRES[record.units]  # type: ignore[index]
    both = [
        next(part for part in block_parts(item.residual) if part.blocks[0].kind == Frf.kind)
        for item in (record.iterations[0], record.best)
    ]
    (block,), ends = both[0].blocks, np.cumsum(both[0].blocks[0].sizes)[:-1]
    parts = [np.split(rows, ends) for rows in (block.measured, *(part.values for part in both))]
    scores = np.transpose([fracs(part) for part in both]).tolist()
    for place in _order(frfs):
        name = curve_name(frfs, place)
        if name not in block.names:
            continue
        row = block.names.index(name)
        measured, *left = (
            np.exp(real + 1j * imaginary)
            for real, imaginary in (np.split(part[row], 2) for part in parts)
        )
        every = receptance(frfs, place, *units)
        lines = np.abs(every[:, None] - measured).argmin(axis=0)
        hz, test = frfs.frequencies_hz, frfs.values[:, place]
        before, after = (test[lines] / ratio for ratio in left)
        title, (first, last) = _title(frfs, place), scores[row]
        yield ResponsePair(title, hz, test, hz[lines], before, after, (first, last))


def _order(frfs: MeasuredFrfs) -> list[int]:
    """Return driving points first, then the others in their order."""
    driving = (frfs.nodes == frfs.reference_nodes) & (frfs.components == frfs.reference_components)
    order: list[int] = np.argsort(~driving, kind="stable").tolist()
    return order


def _title(frfs: MeasuredFrfs, place: int) -> str:
    seen = f"{frfs.nodes[place]}.{COMPONENTS[frfs.components[place] - 1]}"
    driven = f"{frfs.reference_nodes[place]}.{COMPONENTS[frfs.reference_components[place] - 1]}"
    return f"{seen} for a force at {driven}"


def _model(
    record: CampaignRecord, item: IterationRecord, frfs: MeasuredFrfs, place: int
) -> Complexes:
    """The model's function in the deck's units, (n_lines,). Raises ModesError."""
    modes = item.computed
    if modes.normalisation != "mass":
        raise ModesError("the model's modes are not of unit modal mass")
    output = _row(modes, int(frfs.nodes[place]), int(frfs.components[place]))
    at = int(frfs.reference_nodes[place]), int(frfs.reference_components[place])
    ratios = record.test.modes.damping_ratios
    damping = np.full(modes.n_modes, float(ratios.mean()))
    damping[item.pairing.computed] = ratios[item.pairing.measured]
    normal = NormalModes(modes.eigenvalues, np.real(modes.mode_shapes), damping)
    values = modal_frf(frfs.frequencies_hz, normal, [output], [_row(modes, *at)], frfs.kind)
    sign = float(frfs.signs[place] * frfs.reference_signs[place])
    return np.asarray(sign * values[:, 0, 0])


def _row(modes: ModeSet, node: int, component: int) -> int:
    rows = np.flatnonzero((modes.nodes == node) & (modes.components == component))
    if rows.size == 0:
        raise ModesError(f"no sensor of the modes is at {node}.{COMPONENTS[component - 1]}")
    return int(rows[0])
