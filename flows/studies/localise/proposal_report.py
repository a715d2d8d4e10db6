"""Proposals as rows, sentences, JSON and a picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np

from modetune.core.storage.keys import Json
from modetune.flows.report.tables import Column, Table, json_object, table_of
from modetune.flows.studies.localise.proposals import Proposal, Proposals

if TYPE_CHECKING:
    from modetune.core.mesh import Mesh

#: Rows of the table, and changes that a sentence names besides the best.
SHOWN, NAMED = 10, 3


@dataclass(frozen=True, slots=True)
class ProposalRow:
    """A change that the model may lack; docs/localisation.md explains each value."""

    number: Annotated[int, Column("no.")]
    change: Annotated[str, Column("change", words=True)]
    values: Annotated[tuple[float, ...], Column("value")]
    relative_errors: Annotated[tuple[float, ...], Column("error", "%", ".2g")]
    removed: Annotated[float, Column("residual removed", "%", ".1f")]
    log_evidence: Annotated[float, Column("ln evidence", form=".1f")]
    probability: Annotated[float, Column("probability", "%", ".1f")]
    alike: Annotated[int, Column("others as good", form="d")]
    kind: str
    nodes: tuple[int, ...]
    component: int
    coordinates: tuple[tuple[float, ...], ...]
    misfit: float
    alike_changes: tuple[str, ...]


def proposal_rows(found: Proposals, mesh: Mesh) -> list[ProposalRow]:
    """Return the rows of all refined changes, the most probable first."""
    return [_row(number, item, mesh) for number, item in enumerate(found.found, start=1)]


def _row(number: int, item: Proposal, mesh: Mesh) -> ProposalRow:
    change = item.change
    places = np.zeros((0, 3))
    if mesh.nodes.size and change.nodes:
        nodes = np.array(change.nodes)
        places = mesh.coordinates[mesh.rows(nodes[np.isin(nodes, mesh.nodes)])]
    return ProposalRow(
        number=number,
        change=change.label,
        values=tuple(item.amplitudes.tolist()),
        relative_errors=tuple(item.errors.tolist()),
        removed=item.removed,
        log_evidence=item.log_evidence,
        probability=item.probability,
        alike=len(item.alike),
        kind=change.kind,
        nodes=change.nodes,
        component=change.component,
        coordinates=tuple(tuple(row) for row in places.tolist()),
        misfit=item.misfit,
        alike_changes=item.alike,
    )


def proposals_json(found: Proposals, mesh: Mesh) -> Json:
    """Return the JSON object of proposals."""
    return json_object(
        found,
        "misfit freedom scale n_changes proposed",
        probability_of_none=found.nothing,
        changes=proposal_rows(found, mesh),
    )


def proposal_table(found: Proposals, mesh: Mesh) -> Table:
    """Return the table of the most probable changes."""
    title = f"Changes that the model may lack, the best of {found.n_changes}"
    return table_of(title, proposal_rows(found, mesh)[:SHOWN], ProposalRow)


def proposal_sentence(found: Proposals) -> str:
    """Return what to conclude."""
    if not found.found or not found.proposed:
        return (
            f"no change is proposed: of {found.n_changes} changes none explains enough of what the "
            f"parameters leave (probability that none is needed: {100.0 * found.nothing:.0f} %)"
        )
    best = found.found[0]
    values = " and ".join(
        f"{value:.4g}" + (f" (error {100.0 * error:.2g} %)" if error < 1.0 else " (undetermined)")
        for value, error in zip(best.amplitudes.tolist(), best.errors.tolist(), strict=True)
    )
    text = (
        f"proposed: {best.change.label}, {values}; it removes {100.0 * best.removed:.1f} % of "
        "what the parameters leave"
    )
    if best.alike:
        others = "; ".join(best.alike[:NAMED])
        more = f" and {len(best.alike) - NAMED} more" if len(best.alike) > NAMED else ""
        text += f". The test cannot tell it from: {others}{more}"
    if found.scale > 1.5:
        text += (
            f". What it leaves is still {found.scale**0.5:.1f} times the measurement noise, so the "
            "model lacks something else too, or the deviations under `residuals` are too small"
        )
    return text
