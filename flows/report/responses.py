"""Measured response functions beside those of the model, superposed from its elastic modes.

The model's side needs modes of unit modal mass at sensor and exciter and the test's damping ratios;
a mode without a measured partner has their mean. What lies outside the computed modes, rigid
motion of a free structure above all, is missing, so levels between resonances may differ.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from modetune.core.errors import ModesError
from modetune.core.measurement.frf import Complexes, NormalModes, frac, modal_frf
from modetune.core.measurement.measurement import MeasuredFrfs
from modetune.core.modes import COMPONENTS, Floats, ModeSet
from modetune.core.storage.record import CampaignRecord, IterationRecord
from modetune.flows.campaign.units import KILOGRAMS

#: So many functions are shown, driving points first.
SHOWN = 6
UNITS = {"receptance": "m/N", "mobility": "(m/s)/N", "accelerance": "(m/s²)/N"}


@dataclass(frozen=True, slots=True)
class ResponseCurve:
    """A response function: whose it is, its label, and its values (n_lines,)."""

    kind: Literal["test", "before", "after"]
    label: str
    values: Complexes


@dataclass(frozen=True, slots=True)
class ResponsePair:
    """A measured function and the model's before and after, (n_lines,) each; fracs: of both."""

    title: str
    frequencies_hz: Floats
    measured: Complexes
    before: Complexes
    after: Complexes
    fracs: tuple[float, float]


def response_pairs(record: CampaignRecord) -> tuple[ResponsePair, ...]:
    """The functions that both sides have; none where the test has none or no damping."""
    frfs, ratios = record.frfs, record.test.modes.damping_ratios
    factors = {str(units): kilograms for units, kilograms in KILOGRAMS.items()}
    if frfs is None or ratios.size == 0 or record.units not in factors:
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
                before,
                after,
                (fracs[0], fracs[1]),
            )
        )
        if len(found) == SHOWN:
            break
    return tuple(found)


def _order(frfs: MeasuredFrfs) -> list[int]:
    """Driving points first, then the others as they stand."""
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
