"""The modes that a job left, in any form that modetune reads; cut to what was asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from modetune.adapters.solver import ModalAnalysis
from modetune.adapters.test_files.measurements import read_computed
from modetune.core.errors import CampaignError, NoResult, SolverRejected
from modetune.core.modes import ModeSet, Normalisation, dof_name, mode_set
from modetune.core.near_names import listed
from modetune.core.updating.results import ModalResult

REMEDY = "under `model.command`"


def read_results(path: Path) -> ModeSet:
    """The modes of a file, at all of its nodes. Raises NoResult, SolverRejected."""
    if not path.exists():
        there = ", ".join(sorted(item.name for item in path.parent.iterdir())) or "nothing"
        raise NoResult(
            f"the program left no {path.name} in {path.parent} (`results` {REMEDY}); there is: "
            f"{there}"
        )
    try:
        return read_computed(path)
    except CampaignError as error:
        raise NoResult(f"{path} holds no modes that can be read: {error}") from error


def asked_modes(
    found: ModeSet,
    analysis: ModalAnalysis,
    components: tuple[int, ...],
    normalisation: Normalisation,
    place: str,
) -> ModalResult:
    """The lowest modes of those that were found, at the nodes of an analysis.

    place: of the results, for messages. Raises SolverRejected where there are not enough modes or
    nodes: the same deck would give the same again.
    """
    if found.n_modes < analysis.n_modes:
        raise SolverRejected(
            f"{place} holds {found.n_modes} modes where {analysis.n_modes} were asked for; write "
            "{n_modes} into the deck where it says how many, or give `most_modes` "
            f"{REMEDY} where the deck has no more"
        )
    rows = {
        dof: row
        for row, dof in enumerate(zip(found.nodes.tolist(), found.components.tolist(), strict=True))
    }
    wanted = [(node, component) for node in analysis.nodes for component in components]
    missing = [dof_name(dof) for dof in wanted if dof not in rows]
    if missing:
        raise SolverRejected(
            f"{place} has no shape at {listed(missing, 5)} "
            f"({len(missing)} of {len(wanted)} that were asked for, {len(rows)} are there); let "
            "the program write all nodes of the file of `nodes`, held ones as zeros, or give "
            f"`components` {REMEDY}"
        )
    order = np.argsort(found.frequencies_hz, kind="stable")[: analysis.n_modes]
    frequencies = found.frequencies_hz[order]
    shapes = np.real(found.mode_shapes[[rows[dof] for dof in wanted]][:, order])
    told = found.normalisation
    unknown = np.full(order.size, np.nan)
    return ModalResult(
        eigenvalues=(2.0 * np.pi * frequencies) ** 2,
        modes=mode_set(
            frequencies,
            shapes.reshape(len(wanted), order.size),
            [node for node, _ in wanted],
            [component for _, component in wanted],
            normalisation=normalisation if told == "unknown" else told,
        ),
        groups=(),
        strain_energies=np.zeros((0, order.size)),
        total_strain_energy=unknown,
        mass=float("nan"),
    )
